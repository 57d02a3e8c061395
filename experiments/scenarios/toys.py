"""Scenes of the two toys, simulated from the models themselves: well-specified by construction."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from experiments.scenarios.scene import Scene
from models.program import InputError, Latents, fix, observe, simulate
from models.toys.gaussian import ConjugateGaussian, Readings
from models.toys.slot_road import Markings, SlotRoad


def line(seed: int = 0, num: int = 30, noise_std: float = 0.5) -> Scene:
    """Readings of a line drawn from the prior of ConjugateGaussian.

    num        readings, evenly spread over t in [-1, 1]
    noise_std  of a reading; the model's own default is the same

    Raises InputError for no readings."""
    _check_num("line", num)
    model = ConjugateGaussian(noise_std=noise_std)
    return _simulated("line", model, Readings(torch.linspace(-1.0, 1.0, num, dtype=torch.float64), None), seed)


def slot_road(
    seed: int = 0, num: int = 60, num_knots: int | None = 2, noise_std: float = 0.1, rate_std: float = 1e-3
) -> Scene:
    """Detections of one marking drawn from the prior of SlotRoad.

    num        detections, evenly spread over the visible road
    num_knots  active knots; None draws their number from the prior
    noise_std  of the detector [m]; the model's own default is the same
    rate_std   of the curvature rates [1/m^2]; the model's own default is the same

    Raises InputError for no detections and for more knots than the model has slots."""
    _check_num("slot_road", num)
    road = SlotRoad(noise_std=noise_std, rate_std=rate_std)
    if num_knots is not None and not 0 <= num_knots <= road.max_knots:
        raise InputError(f"scenario slot_road: num_knots is {num_knots}; choose 0 to {road.max_knots}")
    s = torch.linspace(0.0, road.length, num, dtype=torch.float64)
    fixed = {} if num_knots is None else {"num_knots": torch.tensor(num_knots)}
    return _simulated("slot_road", fix(road, **fixed), Markings(s, None), seed, fixed)


def _check_num(name: str, num: int) -> None:
    if num < 1:
        raise InputError(f"scenario {name}: num is {num}, but there must be something to see; choose 1 or more")


def _simulated(name: str, model: Any, evidence: Any, seed: int, fixed: Latents | None = None) -> Scene:
    """One draw of the program: its observations are the data, its latents the truth."""
    child = int(np.random.SeedSequence(seed).generate_state(1)[0])
    draw = {site: value[0] for site, value in simulate(model, evidence, num=1, seed=child).items()}
    data, latents = observe(evidence, draw | (fixed or {}))
    truth = {site: value.numpy() for site, value in latents.items()}
    info: dict[str, Any] = {"seed": seed, "num": len(evidence[0])}
    return Scene(data, truth, name, info)
