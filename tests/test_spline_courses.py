"""The spline refinement of [M20]: its least squares, its two minima, its frames."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from benchmarks.lane_papers import m20_refine
from experiments.scenarios.protocol import protocol
from inference.squares import minimise
from models.intersection.course_evidence import course_evidence
from models.intersection.routes import Routes
from models.intersection.spline_courses import SplineCourses, SplineEvidence, centre_lines, first_lines, stages
from models.program import InputError, check, log_joint, simulate
from models.spline import ORDER
from tests.small_lanes import error, small_scene, true_routes

Array = NDArray[np.float64]
SCENE = small_scene()
ROUTED = true_routes(SCENE)
MODEL = SplineCourses(control_std=0.5)  # near the first courses, where neighbours feel each other
EVIDENCE = MODEL.prepare(ROUTED)


def design(evidence: SplineEvidence) -> Array:
    """(N, L n) of all points by scipy's basis, from the tracks."""
    lanes, num = evidence.first.shape
    out = np.zeros((len(evidence.y), lanes * num))
    row = 0
    for lane, (cos, sin, first, spacing) in enumerate(evidence.frames):
        tracks = np.flatnonzero(ROUTED.routes.track_route == lane)
        offsets = ROUTED.tracks.offsets
        points = np.concatenate([ROUTED.tracks.points[offsets[t] : offsets[t + 1]] for t in tracks])
        knots = first + spacing * np.arange(-3, num + 1)
        x = np.clip(points @ np.array([cos, sin]), first, knots[num])  # scipy allows no rounding beyond the knots
        rows = BSpline.design_matrix(x, knots, 3).toarray()
        out[row : row + len(x), lane * num : (lane + 1) * num] = rows
        row += len(x)
    return out


def solve(model: SplineCourses, evidence: SplineEvidence) -> Array:
    squares = model.squares(evidence)
    path = minimise(squares, np.zeros(len(squares.loc)), num_steps=6, damping=0.0, tolerance=1e-12)
    return np.asarray(squares.loc + squares.scale * path.state.x)


def test_data_on_a_spline_give_that_spline_back() -> None:
    true = EVIDENCE.first + np.random.default_rng(1).normal(0.0, 0.5, EVIDENCE.first.shape)
    evidence = EVIDENCE._replace(y=torch.from_numpy(design(EVIDENCE) @ true.reshape(-1)))
    model = SplineCourses(coupled=False, control_std=1e5)
    np.testing.assert_allclose(solve(model, evidence), true.reshape(-1), atol=1e-6)


def test_noisy_data_give_the_solution_of_numpy() -> None:
    model = SplineCourses(coupled=False, position_std=0.7, control_std=3.0)
    size = EVIDENCE.first.size
    rows = np.vstack([design(EVIDENCE) / 0.7, np.eye(size) / 3.0])
    right = np.concatenate([EVIDENCE.y.numpy() / 0.7, EVIDENCE.first.reshape(-1) / 3.0])
    np.testing.assert_allclose(solve(model, EVIDENCE), np.linalg.lstsq(rows, right)[0], atol=1e-7)


def two_lanes(apart: float, turns: tuple[float, float] = (0.0, 0.0)) -> tuple[SplineEvidence, Array]:
    """Evidence without points, and controls of two straight lanes along the world's x-axis in turned frames."""
    first, spacing, num = -20.0, 3.0, 20
    frames = np.array([[np.cos(a), np.sin(a), first, spacing] for a in turns])
    middles = first + spacing * np.arange(-1, num - 1)
    lines = [height / np.cos(a) - np.tan(a) * middles for a, height in zip(turns, (0.0, apart), strict=True)]
    pairs, at = np.tile([0, 1], (11, 1)), np.linspace(-10.0, 10.0, 11)
    none = (torch.zeros(0, dtype=torch.float64), np.zeros((0, ORDER), np.int64), np.zeros((0, ORDER)))
    return SplineEvidence(*none, frames, np.stack(lines), pairs, at), np.stack(lines)


def neighbour_cost(apart: float, turns: tuple[float, float] = (0.0, 0.0)) -> tuple[float, Array]:
    """Cost of e2 and its gradient."""
    evidence, controls = two_lanes(apart, turns)
    size = controls.size
    hessian, gradient = np.empty((size, size)), np.empty(size)
    return SplineCourses().squares(evidence).evaluate(controls.reshape(-1), hessian, gradient), gradient


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_neighbours_rest_where_they_coincide_and_a_lane_width_apart(side: float) -> None:
    at = np.linspace(-0.4, 3.9, 431)
    costs = np.array([neighbour_cost(side * d)[0] for d in at])
    lowest = np.flatnonzero((costs[1:-1] < costs[:-2]) & (costs[1:-1] < costs[2:])) + 1
    np.testing.assert_allclose(at[lowest], [0.0, 2.7], atol=1e-9)
    np.testing.assert_allclose(costs[lowest], 0.0, atol=1e-20)
    assert costs[at.searchsorted(1.35)] == pytest.approx(11 * 0.5 * (1.35 * 1.35) ** 2)


def test_neighbours_farther_apart_than_delta_are_left_alone() -> None:
    assert neighbour_cost(3.99)[0] > 100.0
    for apart in (4.01, -4.01, 20.0):
        cost, gradient = neighbour_cost(apart)
        assert cost == 0.0 and not gradient.any()


@pytest.mark.parametrize("turns", [(0.3, 0.3), (0.3, -0.5), (-0.4, 0.1)])
def test_distance_of_parallel_lanes_does_not_depend_on_their_frames(turns: tuple[float, float]) -> None:
    assert neighbour_cost(1.0, turns)[0] == pytest.approx(11 * 0.5 * (1.0 * 1.7) ** 2)


@pytest.mark.parametrize("coupled", [False, True])
def test_gradient_is_that_of_finite_differences(coupled: bool) -> None:
    model, rng = replace(MODEL, coupled=coupled), np.random.default_rng(2)
    squares = model.squares(EVIDENCE)
    size = len(squares.loc)
    hessian, gradient, unused = np.empty((size, size)), np.empty(size), np.empty(size)
    for _ in range(5):  # at several points
        z, direction = squares.loc + 0.3 * rng.normal(size=size), rng.normal(size=size)
        squares.evaluate(z, hessian, gradient)
        ends = [squares.evaluate(z + step * direction, hessian, unused) for step in (1e-6, -1e-6)]
        assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(gradient @ direction, rel=1e-6)


@pytest.mark.parametrize("coupled", [False, True])
def test_squares_are_the_density_of_the_program(coupled: bool) -> None:
    model = replace(MODEL, coupled=coupled)
    check(model, EVIDENCE)
    squares, draws = model.squares(EVIDENCE), simulate(model, EVIDENCE, num=4, seed=0)
    size = len(squares.loc)
    hessian, gradient = np.empty((size, size)), np.empty(size)
    for row, height in zip(draws["controls"], log_joint(model, draws, EVIDENCE), strict=True):
        z = squares.pack({"controls": row})
        prior = -0.5 * np.square((z - squares.loc) / squares.scale).sum()
        prior -= np.log(squares.scale).sum() + 0.5 * size * np.log(2 * np.pi)
        assert float(height) == pytest.approx(squares.log_const - squares.evaluate(z, hessian, gradient) + prior)


def test_neighbours_add_to_the_cost_of_the_program() -> None:
    alone, together = stages(MODEL)
    draws = simulate(MODEL, EVIDENCE, num=4, seed=0)
    assert bool((log_joint(together, draws, EVIDENCE) < log_joint(alone, draws, EVIDENCE) - 1.0).all())


def test_first_courses_are_the_lanes_of_the_arms_joined_by_straight_lines() -> None:
    for corners, true in zip(first_lines(course_evidence(ROUTED, 1.0)), SCENE.truth.lines, strict=True):
        apart = np.linalg.norm(corners[1:3, None] - true, axis=-1).min(1)
        assert apart.max() < 0.15  # true lines have a point every 0.25 m
        for a, b, end in ((corners[0], corners[1], true[:2]), (corners[2], corners[3], true[-2:])):
            along = (b - a) / np.linalg.norm(b - a)
            np.testing.assert_allclose((end[1] - end[0]) / np.linalg.norm(end[1] - end[0]), along, atol=1e-6)


def test_first_splines_follow_the_first_courses() -> None:
    """A spline with a control above each 5 m cuts the corners and is straight elsewhere."""
    lines = first_lines(course_evidence(ROUTED, 1.0))
    for line, corners in zip(centre_lines(EVIDENCE, {}), lines, strict=True):
        off_corners = np.linalg.norm(line[:, None] - corners[1:3], axis=-1).min(1) > 15.0
        assert off_corners.sum() > 40
        for point in line[off_corners]:
            assert min(distance(point, a, b) for a, b in pairwise(corners)) < 1e-9


def distance(point: Array, a: Array, b: Array) -> float:
    """Of a point from the line through a and b [m]."""
    along = (b - a) / np.linalg.norm(b - a)
    return abs(float(along[0] * (point - a)[1] - along[1] * (point - a)[0]))


def test_moving_the_world_moves_the_lanes() -> None:
    by = np.array([4.5e5, 5.4e6])
    tracks = ROUTED.tracks._replace(points=ROUTED.tracks.points + by)
    structure = dict(ROUTED.structure) | {"centre": ROUTED.structure["centre"] + by}
    moved, _ = m20_refine(ROUTED._replace(tracks=tracks, structure=structure))
    for line, other in zip(m20_refine(ROUTED)[0], moved, strict=True):
        np.testing.assert_allclose(other - by, line, atol=1e-4)


def test_neighbours_sharpen_the_lanes() -> None:
    """Points alone leave about 16 cm on the protocol, with neighbours about 10 cm."""
    scene = protocol(2)
    routed, model = true_routes(scene), SplineCourses()
    evidence = model.prepare(routed)
    alone = centre_lines(evidence, {"controls": solve(stages(model)[0], evidence).reshape(evidence.first.shape)})
    together, _ = m20_refine(routed)
    errors = [np.mean([error(a, b) for a, b in zip(ls, scene.truth.lines, strict=True)]) for ls in (alone, together)]
    assert errors[1] < 0.8 * errors[0] < 0.2


def test_tracks_without_routes_are_refused() -> None:
    nowhere = Routes(np.zeros((0, 4), np.int64), np.full(len(ROUTED.tracks.offsets) - 1, -1))
    with pytest.raises(InputError, match="no track has both an entry and an exit lane"):
        SplineCourses().prepare(ROUTED._replace(routes=nowhere))
