"""What a road of an unknown number of pieces is worth where the road is not one clothoid."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import lru_cache
from statistics import fmean, median

from benchmarks.configured import configured, quiet_engine
from benchmarks.figure import Figure, Measurement, Value, Values, share
from benchmarks.road_trials import Effort, best, paired_loss, shares
from experiments.road_metrics import RoadCheck, check_course
from experiments.scenarios.road import night_road
from experiments.scenarios.scene import Scene
from inference.posterior import Posterior
from inference.progress import Progress

FIRST = 2000  # seed; those below 1000 are frozen
FARTHEST = 140.0  # [m]
SCHEDULE = {"start": "data", "num_chains": 4, "num_steps": 5000, "warmup": 1000, "thin": 10}
Run = Callable[[Scene, int], Posterior]


def of_pieces(scene: Scene, seed: int) -> Posterior:
    """model=segmented_road by reversible jump."""
    model = configured("model", "segmented_road")
    return quiet_engine("rjmcmc", **SCHEDULE)(model, model.prepare(scene.data), seed=seed)


def of_one(scene: Scene, seed: int) -> Posterior:
    """model=road_course by the best engine within 15 ms."""
    model = configured("model", "road_course")
    return best()(model, model.prepare(scene.data), seed=seed)


@lru_cache
def checked(run: Run, num: int, mismatch: bool, show: bool) -> tuple[list[RoadCheck], float]:
    """Checks of scenes from FIRST on, and the mean processor time from cues to posterior [s]."""
    run(night_road(FIRST), 0)
    checks, spent = [], 0.0
    with Progress(f"roads, {run.__name__}", num, show) as bar:
        for seed in range(num):
            scene = night_road(FIRST + seed, mismatch=mismatch)
            began = time.process_time()
            posterior = run(scene, seed)
            spent += time.process_time() - began
            checks.append(check_course(posterior, scene.truth["line"]))
            bar.advance(1)
    return checks, spent / num


def compared(effort: Effort) -> Values:
    values: Values = {}
    for end, mismatch in (("", True), ("_clothoid", False)):
        found = {}
        for name, run in (("pieces", of_pieces), ("one", of_one)):
            checks, seconds = checked(run, effort.some, mismatch, effort.show)
            found[name], last = checks, checks[0].at(FARTHEST)
            errors = [abs(check.error[last]) for check in checks]
            told = f"n = {len(checks)}, at 80 m {median(abs(c.error[c.at(80.0)]) for c in checks):.2f} m"
            values |= {
                f"{name}_wide_140{end}": share(shares(check.inside("wide") for check in checks)),
                f"{name}_mid_140{end}": share(shares(check.inside("mid") for check in checks)),
                f"{name}_lat_m_140{end}": Value(float(median(errors)), told),
                f"{name}_cover90_140{end}": share(shares(check.covered[last] for check in checks)),
                f"{name}_false{end}": share(shares(check.outcome == "false" for check in checks)),
                f"{name}_range_m{end}": Value(fmean(check.reach for check in checks), f"{seconds:.2f} s a scene"),
            }
        gain, told = paired_loss(*((c.inside("mid") for c in found[name]) for name in ("pieces", "one")))
        values[f"pieces_gain_mid{end}"] = Value(gain, told)
    return values


def figures() -> tuple[Figure, ...]:
    listed = []
    for end, road in (("", "of three pieces (mismatch=true)"), ("_clothoid", "of one clothoid")):
        for name, model in (("pieces", "segmented_road, rjmcmc"), ("one", "road_course, importance")):
            scenes = f"night roads {road}, seeds from {FIRST} on, {model}"
            listed += [
                Figure(f"{name}_wide_140{end}", "share", f"{scenes}: wholly inside the wide tube, 5 to 140 m"),
                Figure(f"{name}_mid_140{end}", "share", "the same, mid tube"),
                Figure(f"{name}_lat_m_140{end}", "m", "the same: median distance from the truth 140 m ahead"),
                Figure(f"{name}_cover90_140{end}", "share", "the same: truth inside the central 90 % of draws there"),
                Figure(f"{name}_false{end}", "share", "the same: outside the mid tube before the calibrated range"),
                Figure(f"{name}_range_m{end}", "m", "the same: mean calibrated range"),
            ]
        listed.append(Figure(f"pieces_gain_mid{end}", "share", f"pieces_mid_140{end} less one_mid_140{end}"))
    return tuple(listed)


PIECES = Measurement(figures(), compared)
MEASUREMENTS = (PIECES,)
