"""What an anytime user would have had: courses in their tubes after a part of the iterations.

After s iterations of an engine the best course it knows (of variational inference, the mean of q) is, over N scenes,

    TPR(s)   share whose course is wholly inside the tube to 140 m, and offered
    FPR(s)   share whose course is not, though offered
    abstain  share where nothing is offered, whatever s: the final draws' calibrated range is below LEAST_RANGE

which add up to one. 100 % of the iterations are the first count whose TPR is within half a point of the last one; 25,
50 and 75 % are counted from there. [T17] section 3 counts so, and gives neither its tubes nor when it abstains.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.road_metrics import LEAST_RANGE, at_ranges, check_course, half_width, lateral_offsets
from experiments.scenarios.scene import Scene
from inference.posterior import Posterior
from inference.progress import Progress
from models.program import InputError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
HALF_A_POINT = 0.005
QUARTERS = (0.25, 0.5, 0.75, 1.0)
PAPER = {"tpr": (0.615, 0.745, 0.818, 0.9218), "fpr": (0.364, 0.229, 0.154, 0.0468)}  # [T17] section 3, at QUARTERS


class Outcomes(NamedTuple):
    """Of one engine on N scenes, at S counts of iterations.

    step     (S,) iterations done
    inside   (N, S) whether the course is inside the tube
    offered  (N,) whether the final draws are trusted so far that a course is offered
    """

    step: Floats
    inside: Bools
    offered: Bools

    @property
    def tpr(self) -> Floats:
        """(S,)"""
        return np.asarray((self.inside & self.offered[:, None]).mean(0))

    @property
    def fpr(self) -> Floats:
        """(S,)"""
        return np.asarray((~self.inside & self.offered[:, None]).mean(0))

    @property
    def abstain(self) -> float:
        return float((~self.offered).mean())


def inside_along(posterior: Posterior, line: Floats, tube: str = "wide") -> Bools:
    """Whether each snapshot's course is in a tube about a true line (M, 2 or 3) at all ranges to 140 m, (S,).

    Raises InputError for a posterior without snapshots of a course."""
    shots = posterior.snapshots
    if shots is None or "course" not in shots.states:
        raise InputError(
            "anytime needs snapshots of a road course along the iterations, and this engine keeps none; set "
            "num_snapshots to 1 or more, or choose an engine such as bbvi and a model such as road_course"
        )
    apart = lateral_offsets(shots.states["course"], at_ranges(line))
    return np.asarray((np.abs(apart) <= half_width(tube)).all(1))


def outcomes(
    engine: Callable[..., Posterior], model: Any, scenes: Iterable[Scene], num: int, what: str, show: bool
) -> Outcomes:
    """Run an engine on `num` scenes, each with its number as the seed.

    Raises InputError for scenes without a true line, and where the snapshots of scenes lie at different iterations."""
    steps, inside, offered = list[Floats](), list[Bools](), list[bool]()
    with Progress(what, num, show) as bar:
        for seed, scene in enumerate(scenes):
            if not isinstance(scene.truth, dict) or "line" not in scene.truth:
                raise InputError(f"{scene.name} has no true road course; choose a scenario such as night_road")
            posterior = engine(model, model.prepare(scene.data), seed=seed)
            line = scene.truth["line"]
            inside.append(inside_along(posterior, line))
            offered.append(check_course(posterior, line).reach >= LEAST_RANGE)
            assert posterior.snapshots is not None
            steps.append(np.asarray(posterior.snapshots.step, dtype=float))
            if not np.array_equal(steps[0], steps[-1]):
                raise InputError(
                    "anytime needs an engine whose iterations are the same on every scene, but its snapshots are not; "
                    "choose one with a fixed number of steps, such as bbvi"
                )
            bar.advance(1)
    return Outcomes(steps[0], np.array(inside), np.array(offered))


def quarters(rate: Floats) -> tuple[int, dict[str, float]]:
    """Index of the first of rates (S,) along the iterations, the first of them at none, that is within half a point of
    the last; and rates at 25, 50, 75 and 100 % of the iterations up to there, linear between counts."""
    full = int(np.argmax(np.abs(rate - rate[-1]) <= HALF_A_POINT))
    at = at_quarters(rate, full)
    return full, {f"{100 * share:.0f} %": float(value) for share, value in zip(QUARTERS, at, strict=True)}


def at_quarters(values: Floats, full: int) -> Floats:
    """Values (S,) along equally spaced counts, at QUARTERS of the count with index `full`, (4,)."""
    return np.asarray(np.interp([share * full for share in QUARTERS], np.arange(len(values)), values))


def rows(found: Outcomes) -> list[dict[str, float]]:
    """A record for each of QUARTERS: share of the iterations, iterations, and the three outcomes with the standard
    error of the TPR, at (hits + 1/2) / (N + 1): without failures too it is not zero."""
    full, _ = quarters(found.tpr)
    num = len(found.offered)
    columns = zip(QUARTERS, *(at_quarters(v, full) for v in (found.step, found.tpr, found.fpr)), strict=True)
    out = []
    for share, steps, tpr, fpr in columns:
        smooth = (num * tpr + 0.5) / (num + 1)
        error = (smooth * (1.0 - smooth) / num) ** 0.5
        numbers = {"share": share, "steps": steps, "tpr": tpr, "tpr:se": error, "fpr": fpr, "abstain": found.abstain}
        out.append({name: float(value) for name, value in numbers.items()})
    return out
