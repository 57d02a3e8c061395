"""Small scenes for tests of the intersection: a few half tracks of a few points, with fixed positions."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from inference.calibration import predict
from models.intersection.evidence import JunctionEvidence
from models.intersection.state import Junction
from models.program import Latents, simulate

# The tests' own settings, whatever the defaults are: every latent that an arm can have, and [M20]'s straight arms.
SETTINGS: dict[str, Any] = {
    "max_lanes": 6,
    "one_way": True,
    "gap_max": 8.0,
    "centre_std": 10.0,
    "width": 3.0,
    "width_spread": 0.15,
    "bend_std": 0.003,
    "shift_std": 0.3,
    "position_std": 1.0,
    "along_std": 3.0,
    "offset_std": 0.3,
    "phase_std": 20.0,
    "heading_std": 0.3,
    "clutter": 0.02,
    "clutter_std": 40.0,
}
NO_BENDS: dict[str, Any] = SETTINGS | {"width_spread": 0.0, "bend_std": 0.0, "shift_std": 0.0}
FULL = Junction(**SETTINGS)


def blank_evidence(
    num_entries: int = 5, num_exits: int = 4, num_points: int = 10, seed: int = 0, heading: bool = True
) -> JunctionEvidence:
    """Half tracks of about `num_points` points, 20 to 60 m from the origin, whose positions are to be simulated."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(max(num_points - 3, 1), num_points + 4, num_entries + num_exits)
    s = np.concatenate([np.zeros(0), *(20.0 + 40.0 * np.sort(rng.random(n)) for n in sizes)])
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    num = len(starts) - 1
    origin = np.array([3.0, -7.0])
    return JunctionEvidence(None, s, starts, np.arange(num), num, num_entries, origin, heading, None, None)


NOTHING = blank_evidence(0, 0)._replace(points=torch.zeros(3, 0, dtype=torch.float64))  # no half track at all


def states(model: Junction, num: int, seed: int, evidence: JunctionEvidence = NOTHING) -> Latents:
    """Prior draws of the latents (num, *event)."""
    return simulate(model, evidence, num=num, seed=seed)


def one(latents: Latents, row: int) -> Latents:
    return {name: value[row] for name, value in latents.items()}


def with_points(model: Junction, latents: Latents, blank: JunctionEvidence, seed: int) -> JunctionEvidence:
    """Evidence simulated from one state (*event)."""
    batch = predict(model, {n: v[None] for n, v in latents.items()}, blank, seed=seed)
    return batch._replace(points=batch.points[0])
