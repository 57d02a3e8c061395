"""Night roads from cues to a checked course, timed: the work that the figures of the road count."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.configured import quiet_engine
from experiments.road_metrics import RoadCheck, check_course
from experiments.scenarios.road import night_road
from experiments.scenarios.scene import Scene
from inference.posterior import Posterior
from inference.progress import Progress
from models.road.course import RoadCourse

Engine = Callable[..., Posterior]


class Effort(NamedTuple):
    """How much to measure.

    scenes  frozen ones
    some    of them, where the reference posterior or hundreds of steps are needed
    timed   of them, for times
    show    progress bars on the standard error
    """

    scenes: int
    some: int
    timed: int
    show: bool = False


FULL = Effort(scenes=1000, some=200, timed=60)
QUICK = Effort(scenes=100, some=40, timed=20)
MODEL = RoadCourse()


def best() -> Engine:
    """The best engine within 15 ms: adaptive importance sampling, as configured."""
    return quiet_engine("importance")


def reference() -> Engine:
    """The same from the prior with many rounds: it owes nothing to a mode that a fit found."""
    return quiet_engine("importance", transform="prior", num_draws=512, num_rounds=24)


class Trial(NamedTuple):
    """One scene: its posterior against the truth, and the processor time from evidence to posterior [ms]."""

    check: RoadCheck
    ms: float
    posterior: Posterior


@lru_cache(maxsize=4)
def frozen(num: int, **options: Any) -> tuple[Scene, ...]:
    """The first `num` frozen scenes under options of `night_road`."""
    return tuple(night_road(seed, **options) for seed in range(num))


def drive(engine: Engine, scenes: Iterable[Scene], what: str, total: int, show: bool) -> list[Trial]:
    """Run every scene with a seed of its own, after one that is not counted."""
    out: list[Trial] = []
    engine(MODEL, MODEL.prepare(frozen(1)[0].data), seed=0)
    with Progress(what, total, show) as bar:
        for seed, scene in enumerate(scenes):
            evidence = MODEL.prepare(scene.data)
            began = time.process_time()
            posterior = engine(MODEL, evidence, seed=seed)
            spent = 1e3 * (time.process_time() - began)
            out.append(Trial(check_course(posterior, scene.truth["line"]), spent, posterior))
            bar.advance(1)
    return out


@lru_cache
def best_checks(effort: Effort) -> list[RoadCheck]:
    """The best engine on all frozen scenes: many figures count the same runs."""
    trials = drive(best(), frozen(effort.scenes), "frozen scenes", effort.scenes, effort.show)
    return [trial.check for trial in trials]


def shares(hits: Iterable[bool]) -> list[float]:
    """0/1 outcomes."""
    return [float(hit) for hit in hits]


def paired_loss(before: Iterable[bool], after: Iterable[bool]) -> tuple[float, str]:
    """Share lost between two outcomes of the same scenes, and its standard error in words."""
    gap: NDArray[np.float64] = np.array(shares(before)) - np.array(shares(after))
    return float(gap.mean()), f"n = {len(gap)}, s.e. {gap.std() / max(len(gap), 1) ** 0.5:.3f}"
