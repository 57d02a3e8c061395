"""How far lanes of either family are from the true ones, and what choosing by evidence brings."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache, partial
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.junction import DEFAULT, Effort, Setting, attempt, configured
from benchmarks.junction_lanes import HEADING_STD
from benchmarks.junction_structure import DATA
from experiments.course_choice import Rival
from experiments.lane_metrics import lane_error
from experiments.lanes import refine_lanes
from experiments.scenarios.junction import junction, names
from experiments.scenarios.protocol import protocol
from experiments.scenarios.scene import Scene
from inference import least_squares
from inference.progress import Progress
from models.intersection.course_family import Courses, centre_lines
from models.program import InputError

SEEDS = 2  # of every real junction
KNOBS = {"num_steps": 25, "tolerance": 0.1, "num_draws": 1}


@lru_cache
def families() -> tuple[tuple[Courses, tuple[str, ...]], ...]:
    """Both families of the config engine=lanes_choice, with the scales that each learns."""
    from hydra import compose, initialize_config_module
    from hydra.utils import instantiate

    with initialize_config_module("configs", version_base="1.3"):
        config = compose("run", ["engine=lanes_choice"]).engine
    rival: Rival = instantiate(config.rival)
    return (instantiate(config.courses), tuple(config.refine.learn)), (rival.courses, tuple(rival.learn))


class Pair(NamedTuple):
    """Lane errors [cm] and log evidences [nats] of lanes on arms and of free curves, in one scene."""

    arms: float
    free: float
    arms_evidence: float
    free_evidence: float

    @property
    def chosen(self) -> float:
        return self.free if self.free_evidence > self.arms_evidence else self.arms


def compare(structure: Setting, scenes: Iterable[Scene], what: str, total: int, show: bool) -> list[Pair]:
    """Both families on the same structure and routes; a scene whose tracks are refused is left out."""
    out = []
    with Progress(what, total, show) as bar:
        for seed, scene in enumerate(scenes):
            try:
                found = attempt(structure, scene.data, seed).posterior
            except InputError:
                continue
            evidence, errors, scores = structure.model.prepare(scene.data), [], []
            for courses, learn in families():
                engine = partial(least_squares.run, **KNOBS, learn=learn)
                posterior, own, _ = refine_lanes(structure.model, evidence, found, engine, courses, seed)
                errors.append(lane_error(centre_lines(own, posterior.estimate), scene.truth)["lane_error_cm"])
                scores.append(float(posterior.log_evidence or 0.0))
            out.append(Pair(*errors, *scores))
            bar.advance(1)
    return out


def values(prefix: str, pairs: list[Pair]) -> Values:
    detail = f"n = {len(pairs)}"
    best = fmean(min(p.arms, p.free) for p in pairs)
    return {
        f"{prefix}_arms": Value(fmean(p.arms for p in pairs), detail),
        f"{prefix}_free": Value(fmean(p.free for p in pairs), detail),
        f"{prefix}_chosen": Value(
            fmean(p.chosen for p in pairs),
            f"{detail}, free in {sum(p.free_evidence > p.arms_evidence for p in pairs)}, best of both {best:.2f}",
        ),
    }


def on_protocol(effort: Effort) -> Values:
    scenes = (protocol(i) for i in range(effort.few))
    return values("family_cm", compare(DEFAULT, scenes, "family_cm", effort.few, effort.show))


def on_real(effort: Effort) -> Values:
    """Vehicles simulated on the real junctions, the first SEEDS of real_lane_cm."""
    seeds = min(SEEDS, effort.real_seeds)
    settings = (
        ("real_family_cm", "clean", None),
        ("real_family_cm_heading", "clean", HEADING_STD),
        ("other_family_cm", None, None),
    )
    out: Values = {}
    for key, quality, std in settings:
        if not Path(DATA).exists():
            out |= {f"{key}_{name}": Value(None, "the data folder is absent") for name in ("arms", "free", "chosen")}
            continue
        chosen = sorted(set(names(quality, DATA)) - (set() if quality else set(names("clean", DATA))))
        structure = DEFAULT._replace(model=configured("junction_real"))
        pairs: list[Pair] = []
        for name in chosen:
            scenes = (junction(name, seed, heading_std=std, data_root=DATA) for seed in range(seeds))
            pairs += compare(structure, scenes, name, seeds, effort.show)
        out |= values(key, pairs)
    return out


def figures(prefix: str, where: str) -> tuple[Figure, ...]:
    return (
        Figure(f"{prefix}_arms", "cm", f"lane error of lanes on arms (engine=lanes_real), {where}"),
        Figure(f"{prefix}_free", "cm", "the same of free curves (engine=lanes_free)"),
        Figure(f"{prefix}_chosen", "cm", "the same of the family with the larger evidence (engine=lanes_choice)"),
    )


MEASUREMENTS = (
    Measurement(figures("family_cm", "on the protocol"), on_protocol),
    Measurement(
        (
            *figures("real_family_cm", "on the real junctions marked clean"),
            *figures("real_family_cm_heading", "there with headings of sd .1 rad"),
            *figures("other_family_cm", "on the real junctions that are not marked clean"),
        ),
        on_real,
    ),
)
