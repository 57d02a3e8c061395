"""Simulation-based calibration of road courses: the truth is a draw like any other, 40, 80 and 140 m ahead.

Course, offsets, places of the cues and cues come from the model itself (`exact`, clutter and all); only which cues
there are, and how exactly the camera measures at their places on a straight road, is that of night scenes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import kstest

from experiments.road_metrics import RANGES, TOLD, at_ranges, lateral_offsets
from experiments.scenarios.road import along, camera, night_road
from inference import importance
from inference.posterior import Posterior
from models.clothoid import hermite
from models.program import simulate
from models.road.course import RoadCourse
from models.road.evidence import RoadEvidence

Floats = NDArray[np.float64]
NUM = 200
MODEL = RoadCourse()
AT = np.isin(RANGES, TOLD)


def drawn(model: RoadCourse, seed: int) -> tuple[RoadEvidence, Floats]:
    """A scene of the model, and its true line (M, 3)."""
    evidence, rng = model.prepare(night_road(10_000 + seed).data), np.random.default_rng(seed)
    far = rng.uniform(0.0, 220.0, (50, len(evidence.group)))
    seen = rng.random(far.shape) < ndtr((model.prior.behind + model.reach - far) / model.reach_std)
    arc = np.take_along_axis(far, seen.argmax(0)[None], 0)[0]
    straight = np.stack([arc - model.prior.behind, evidence.offset_loc[evidence.group]], -1)
    blank = evidence._replace(cues=None, arc=arc, covariance=camera(straight, evidence.moves))
    draw = simulate(model, blank, num=1, seed=seed)
    road = along(hermite(*draw["course"][0].split(3)))
    return blank._replace(cues=draw["cues"][0]), np.stack([v.numpy() for v in road.points[:3]], -1)


def ranks(model: RoadCourse, own: RoadCourse) -> Floats:
    """Posterior probability under `own` that the road is left of the true one, (NUM, 3), for scenes of `model`."""
    out = np.empty((NUM, len(TOLD)))
    for seed in range(NUM):
        evidence, line = drawn(model, seed)
        posterior = importance.run(own, evidence, seed=seed)
        out[seed] = share_left(posterior, line)
    return out


def share_left(posterior: Posterior, line: Floats) -> Floats:
    apart = lateral_offsets(posterior.draws["course"][0], at_ranges(line))[:, AT]
    return np.asarray(posterior.weights[0] @ (apart < 0.0))


def uniform(found: Floats) -> float:
    """The least p-value of Kolmogorov and Smirnov's tests of the three columns, folded at the median and not."""
    folded = np.abs(2.0 * found - 1.0)
    return float(min(kstest(column, "uniform").pvalue for column in np.concatenate([found, folded], 1).T))


def test_the_truth_is_a_draw_like_any_other() -> None:
    """One of six p-values is below .002 in one of a hundred runs; shares inside the 90 % band within 3.5 s.e."""
    found = ranks(MODEL, MODEL)
    assert uniform(found) > 0.002
    covered = ((found > 0.05) & (found < 0.95)).mean(0)
    assert np.all(np.abs(covered - 0.9) < 3.5 * np.sqrt(0.09 / NUM))


def test_the_test_sees_clutter_that_the_model_does_not_know() -> None:
    assert uniform(ranks(MODEL, RoadCourse(clutter=0.0))) < 0.002
