"""Cues become groups with priors; what no course can be computed from is refused, what says little is flagged."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from experiments.run import run
from experiments.scenarios.road import night_road
from experiments.scenarios.scene import Scene
from inference import least_squares
from models.clothoid import Clothoid, evaluate
from models.program import InputError, check
from models.road.course import RoadCourse
from models.road.cues import KINDS, CueKind, Cues, line_of_sight
from models.road.evidence import RoadEvidence
from models.road.prior import CoursePrior, course_moments

MODEL = RoadCourse()
RADAR = CueKind("radar", right=(-5.0, 1.0), left=(7.0, 1.0), std=0.4)
LIDAR = CueKind("lidar", right=(-4.0, 2.0), left=(6.0, 2.0), std=0.1)


def cues(*rows: tuple[str, bool, int, float, float]) -> Cues:
    """Rows of kind, left, track, x, y."""
    kind, left, track, x, y = zip(*rows, strict=True) if rows else ((), (), (), (), ())
    position = np.array([x, y], dtype=float).T.reshape(-1, 2)
    num = len(kind)
    return Cues(
        kind=np.array(kind, dtype=np.str_),
        left=np.array(left, dtype=bool),
        track=np.array(track, dtype=np.int64),
        position=position,
        covariance=np.tile(0.01 * np.eye(2), (num, 1, 1)),
        flow=np.where(np.isin(kind, ["car", "truck"]), 0.1, np.nan),
        flow_std=np.full(num, 0.02),
        confidence=np.full(num, 0.25),
    )


MIXED = cues(
    ("delineator", False, 1, 20, -3),
    ("car", True, 9, 30, 3),
    ("delineator", True, 3, 40, 5),
    ("car", False, 8, 50, 0),
    ("delineator", False, 2, 60, -3),
    ("car", True, 9, 25, 3),
)


def test_static_cues_share_an_offset_by_kind_and_side_and_vehicles_have_their_own() -> None:
    found = MODEL.prepare(MIXED)
    assert found.names == ("delineator left", "delineator right", "car 8", "car 9")
    assert found.group.tolist() == [1, 3, 0, 2, 1, 3]
    assert found.offset_loc.tolist() == [5.5, -3.5, 0.0, 3.5]
    assert found.offset_std.tolist() == [1.0, 1.0, 0.4, 0.4]
    np.testing.assert_allclose(found.turn, [0, math.pi, 0, 0, 0, math.pi])
    np.testing.assert_allclose(found.spread, [0.4, 0.5, 0.4, 0.5, 0.4, 0.5])  # std / sqrt(0.25)
    np.testing.assert_allclose(found.flow_spread, [math.inf, 0.1, math.inf, 0.1, math.inf, 0.1])
    assert found.cues is not None
    assert found.cues[:, 2].tolist() == [0.0, 0.1, 0.0, 0.1, 0.0, 0.1]
    assert found.flags == ()
    check(MODEL, found)


def test_a_new_sensor_is_one_more_kind() -> None:
    model = RoadCourse(extra_kinds=(RADAR, LIDAR))
    rows = [("radar", False, 1, 20, -5), ("lidar", True, 2, 30, 6), ("marking", True, 3, 10, 1.7)]
    found = model.prepare(cues(*rows))
    assert found.names == ("lidar left", "marking left", "radar right")
    assert found.offset_loc.tolist() == [6.0, 1.75, -5.0]
    posterior = least_squares.run(model, found, seed=0, num_draws=200)
    assert posterior.draws["offset"].shape == (1, 200, 3)
    with pytest.raises(InputError, match="no kind of cue is called 'lidar'; there are guardrail"):
        MODEL.prepare(cues(*rows))


def test_a_kind_of_a_known_name_replaces_it() -> None:
    wide = CueKind("delineator", right=(-9.0, 1.0), left=(9.0, 1.0), std=0.2)
    assert RoadCourse(extra_kinds=(wide,)).prepare(MIXED).offset_loc[:2].tolist() == [9.0, -9.0]


def broken(**fields: Any) -> Cues:
    """MIXED with one entry of each given field changed, {field: (row, value)}."""
    changed = {}
    for name, (row, value) in fields.items():
        changed[name] = np.array(getattr(MIXED, name))
        changed[name][row] = value
    return MIXED._replace(**changed)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (cues(), "there are no cues; a road course needs at least one"),
        (broken(position=(2, [math.nan, 1.0])), r"cue 2 \(delineator\) has the position \[nan, 1.0\]; drop the cue"),
        (
            broken(covariance=(1, -np.eye(2))),
            r"cue 1 \(car\) has the covariance .*; give a symmetric positive definite",
        ),
        (broken(covariance=(1, [[1, 1], [1, 1]])), r"cue 1 \(car\) has the covariance \[\[1.0, 1.0\], \[1.0, 1.0\]\]"),
        (broken(covariance=(1, [[1, 0.5], [0, 1]])), "give a symmetric"),
        (broken(flow=(3, math.inf)), r"cue 3 \(car\) has the flow inf; give radians, or nan"),
        (broken(flow_std=(3, 0.0)), r"cue 3 \(car\) has the flow_std 0.0; make it positive"),
        (broken(confidence=(0, 1.5)), r"cue 0 \(delineator\) has the confidence 1.5; give a number in \(0, 1\]"),
        (broken(kind=(0, "delinator")), "no kind of cue is called 'delinator'; did you mean 'delineator'"),
        (broken(track=(4, 1)), "cues 0 and 4 are both delineator 1 though it stands still; join them"),
        (broken(position=(5, [30, 3])), "cues 1 and 5 are both car 9 at the same place; drop one"),
    ],
)
def test_what_no_course_can_be_computed_from_is_one_sentence(given: Cues, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        MODEL.prepare(given)


@pytest.mark.parametrize(
    ("rows", "flag"),
    [
        ([("pole", True, 1, 30, 6)], "there is only one cue"),
        ([("pole", True, 1, 30, 6), ("lantern", True, 2, 50, 7)], "all cues are on the left"),
        ([("pole", True, 1, -5, 6), ("pole", False, 2, -8, -4)], "all cues are behind the car"),
        ([("pole", True, 1, -5, 6), ("pole", False, 2, -8, -4), ("pole", False, 3, 8, -4)], "2 of 3 cues are behind"),
    ],
)
def test_poor_evidence_is_flagged_and_its_posterior_honestly_wide(
    rows: list[tuple[str, bool, int, float, float]], flag: str
) -> None:
    """Where the road ends is known to a third of what the prior says at best: its standard deviation is 33 m."""
    found = MODEL.prepare(cues(*rows))
    assert any(flag in sentence for sentence in found.flags)
    posterior = least_squares.run(MODEL, found, seed=0, num_draws=1000)
    assert posterior.info["converged"]
    assert posterior.sd("course")[4] > 10.0


def test_a_run_shows_what_speaks_against_its_evidence() -> None:
    scene = Scene(cues(("pole", True, 1, 30, 6)), None, "one pole", {})
    result = run(lambda: scene, MODEL, partial(least_squares.run, num_draws=100))
    assert result.flags[0] == "there is only one cue: the course is little more than its prior"


def test_noise_along_the_line_of_sight_is_along_it() -> None:
    found = line_of_sight(np.array([[3.0, 4.0], [10.0, 0.0]]), np.array([2.0, 1.0]), np.array([0.1, 0.5]))
    np.testing.assert_allclose(found[0] @ [0.6, 0.8], 4.0 * np.array([0.6, 0.8]))
    np.testing.assert_allclose(found[0] @ [-0.8, 0.6], 0.01 * np.array([-0.8, 0.6]))
    np.testing.assert_allclose(found[1], np.diag([1.0, 0.25]))


def test_kinds_without_spread_are_refused() -> None:
    with pytest.raises(InputError, match=r"right of the cue kind 'x' has a standard deviation of 0\.0; make it > 0"):
        CueKind("x", right=(0.0, 0.0), left=(0.0, 1.0), std=0.1)
    with pytest.raises(InputError, match="flow_std of the cue kind 'x' is inf"):
        CueKind("x", right=(0.0, 1.0), left=(0.0, 1.0), std=0.1, flow_std=math.inf)
    assert len({kind.name for kind in KINDS}) == len(KINDS)


def test_prior_of_the_course_has_the_moments_of_its_roads() -> None:
    """Against 20000 roads drawn: means and covariances within 4.5 of their standard errors."""
    prior, num = CoursePrior(), 20000
    draw = torch.randn(7, num, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).numpy()
    stds = [prior.behind_std, prior.lateral_std, prior.heading_std, prior.curvature_std, prior.rate_std]
    x, y, heading, curvature, rate = draw[:5] * np.array(stds)[:, None]
    length = prior.length + prior.length_std * draw[5]
    road = Clothoid(*(torch.from_numpy(v) for v in (x - prior.behind, y, heading, curvature, rate, length)))
    end = evaluate(road, road.length[:, None])
    roads = np.stack([x - prior.behind, y, heading, *(v[:, 0].numpy() for v in end[:3])], -1)
    mean, tril = course_moments(prior)
    scale = np.sqrt(np.diag(tril @ tril.T))
    scores = (roads - mean) / scale
    products = scores[:, :, None] * scores[:, None]
    assert np.all(np.abs(scores.mean(0)) < 4.5 / math.sqrt(num))
    expected = tril @ tril.T / np.outer(scale, scale)
    assert np.all(np.abs(products.mean(0) - expected) < 4.5 * products.std(0) / math.sqrt(num))
    assert expected[4, 5] > 0.97  # the end lies where it points


def test_prior_without_spread_is_refused() -> None:
    with pytest.raises(InputError, match=r"rate_std of the course prior must be finite and positive, but is 0\.0"):
        CoursePrior(rate_std=0.0)


def test_evidence_of_markings_alone_is_a_baseline() -> None:
    scene = night_road(0, markings=True)
    painted = MODEL.prepare(scene.data.take(scene.data.kind == "marking"))
    assert isinstance(painted, RoadEvidence)
    assert painted.names == ("marking left", "marking right")
    posterior, whole = (least_squares.run(MODEL, e, seed=0) for e in (painted, MODEL.prepare(scene.data)))
    assert posterior.sd("course")[4] > 1.5 * whole.sd("course")[4]  # they end at 70 m
