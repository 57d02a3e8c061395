"""Border points as a cue of lane courses: which border they are on, their density, and what they make known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.stats import norm

from benchmarks.junction_lanes import default
from experiments.lane_metrics import lane_error
from experiments.scenarios.protocol import protocol
from experiments.scenarios.scene import Scene
from inference import least_squares
from models.intersection.border_points import TOLERANCE, BorderPoints, place_borders
from models.intersection.course_borders import PointsOnBorders
from models.intersection.course_evidence import CourseEvidence
from models.intersection.course_lines import centre_lines, layout_of
from models.intersection.courses import LaneCourses
from models.intersection.state import Junction, lane_points
from models.program import InputError, check, fix, log_joint, simulate, terms
from tests.small_lanes import true_routes

Array = NDArray[np.float64]
MODEL = LaneCourses(bend_std=0.0005, shift_std=0.3, width_std=0.1, border_std=0.2)
WAVY = replace(MODEL, arm_wave_std=0.2, lane_wave_std=0.1)
SCENE = protocol(15, max_lanes=2, tracks=1, borders=0.2)


def evidence_of(model: LaneCourses, scene: Scene = SCENE) -> CourseEvidence:
    return model.prepare(true_routes(scene))


def borders_of(evidence: CourseEvidence) -> BorderPoints:
    assert evidence.borders is not None
    return evidence.borders


def offsets_of(evidence: CourseEvidence, latents: dict[str, Array]) -> Array:
    """Distance (M,) of every point from its border, which runs where lane number - 1/2 would, by `lane_points`."""
    latents = evidence.loc | latents
    arms = {name: latents[name] for name in ("angle", "gap", "bend", "shift", "centre")}
    arms["width"] = latents["lane_width"] + latents["width"]
    out = []
    for point, arm, end, number in zip(*(borders_of(evidence)._replace(points=points(evidence))), strict=True):
        side = 1 if end == 0 else -1
        along = (point - arms["centre"]) @ [math.cos(arms["angle"][arm]), math.sin(arms["angle"][arm])]
        before, here, behind = lane_points(arms, int(arm), number - 0.5, side, along + np.array([-1e-3, 0.0, 1e-3]))
        tangent = (behind - before) / np.linalg.norm(behind - before)
        out.append(tangent[0] * (point - here)[1] - tangent[1] * (point - here)[0])
    return np.array(out)


def points(evidence: CourseEvidence) -> Array:
    return borders_of(evidence).points.numpy().T


def draw(model: LaneCourses, evidence: CourseEvidence, num: int = 1) -> dict[str, torch.Tensor]:
    return simulate(model, evidence, num=num, seed=3)


# Which border a point is on


def test_points_are_on_the_borders_that_they_were_drawn_on() -> None:
    """Two lanes each way and a gap of 3 m: three borders on either side; the others of the scene are left out."""
    structure = {
        "num_arms": np.asarray(1),
        "centre": np.array([4.0, -2.0]),
        "angle": np.array([0.5]),
        "gap": np.array([3.0]),
        "width": np.array([3.2]),
        "entries": np.array([2]),
        "exits": np.array([1]),
    }
    s = np.array([12.0, 30.0])
    wanted = [(0, 0, 0), (0, 0, 2), (0, 1, 0), (0, 1, 1)]
    lines = [lane_points(structure, 0, number - 0.5, 1 - 2 * end, s) for _, end, number in wanted]
    beyond = lane_points(structure, 0, 1.5 + 1.1 * TOLERANCE / 3.2, 1, s)  # outside of the outermost border
    inner = lane_points(structure, 0, 0.5, 1, np.array([9.0]))  # nearer to the centre than the interior begins
    seen = np.concatenate([*lines[::-1], beyond, inner])
    found = place_borders(seen, structure, np.array([10.0]))
    assert list(zip(found.arm, found.end, found.number, strict=True)) == [name for name in wanted for _ in s]
    np.testing.assert_allclose(found.points.numpy().T + structure["centre"], np.concatenate(lines))


def test_inner_borders_beside_a_narrow_gap_are_left_out() -> None:
    evidence = evidence_of(MODEL)
    narrow = SCENE.truth.gap < 2 * TOLERANCE
    assert 0 < narrow.sum() < len(narrow)
    borders = borders_of(evidence)
    assert set(borders.arm[borders.number == 0]) == set(np.flatnonzero(~narrow))


def test_simulated_points_scatter_about_their_borders_by_their_noise() -> None:
    truth = SCENE.truth
    state = {"angle": truth.angle, "gap": truth.gap, "lane_width": np.asarray(2.7), "width": np.zeros(len(truth.gap))}
    apart = offsets_of(evidence_of(MODEL), state)
    assert abs(apart.std() / 0.2 - 1.0) < 4 / math.sqrt(2 * len(apart))
    assert abs(apart.mean()) < 4 * 0.2 / math.sqrt(len(apart))


# The density


def test_border_points_are_normal_about_their_borders() -> None:
    evidence = evidence_of(MODEL)
    latents = draw(MODEL, evidence)
    found = terms(MODEL, latents, evidence).likelihood["borders"]
    apart = offsets_of(evidence, {name: value[0].numpy() for name, value in latents.items()})
    assert float(found[0]) == pytest.approx(norm.logpdf(apart, scale=0.2).sum(), rel=1e-6)


@pytest.mark.parametrize("model", [MODEL, WAVY, replace(MODEL, angle_std=0.0, lane_width_std=0.0)])
def test_log_joint_is_that_of_the_squares(model: LaneCourses) -> None:
    evidence = evidence_of(model)
    squares, latents = model.squares(evidence), draw(model, evidence, 2)
    check(model, evidence)
    for row, found in enumerate(log_joint(model, latents, evidence)):
        x = (squares.pack({n: v[row] for n, v in latents.items()}) - squares.loc) / squares.scale
        prior = -0.5 * float(x @ x) - float(np.log(squares.scale).sum()) - 0.5 * len(x) * math.log(2 * math.pi)
        cost = squares.dense(squares.loc + squares.scale * x)[0]
        assert float(found) == pytest.approx(squares.log_const - cost + prior, rel=1e-12)


def of_borders(model: LaneCourses, evidence: CourseEvidence, z: Array) -> tuple[float, Array, Array]:
    """Cost, Hessian and gradient of the border points alone."""
    both, without = model.squares(evidence), model.squares(evidence._replace(borders=None))
    cost, hessian, gradient = (a - b for a, b in zip(both.dense(z), without.dense(z), strict=True))
    return cost, hessian, gradient


def test_hessian_is_that_of_the_residuals() -> None:
    """J^T J by central differences; the slope of a bent border is held while its points move, which costs little."""
    evidence = evidence_of(MODEL)
    squares = MODEL.squares(evidence)
    z = squares.pack({name: value[0] for name, value in draw(MODEL, evidence).items()})
    cost, hessian, _ = of_borders(MODEL, evidence, z)
    residuals = lambda at: offsets_of(evidence, squares.unpack(at)) / MODEL.border_std  # noqa: E731
    assert cost == pytest.approx(0.5 * float(residuals(z) @ residuals(z)), rel=1e-6)
    steps = 1e-4 * np.diag(squares.scale)
    jacobian = np.stack([(residuals(z + step) - residuals(z - step)) / 2e-4 for step in steps], 1)
    found, expected = squares.scale * hessian * squares.scale[:, None], jacobian.T @ jacobian
    size = np.sqrt(np.maximum(expected.diagonal(), 1e-9))
    np.testing.assert_allclose(found / np.outer(size, size), expected / np.outer(size, size), atol=5e-3)
    assert np.count_nonzero(expected.diagonal() > 1.0) >= 3 + 4 * len(evidence.loc["angle"])


@pytest.mark.parametrize("model", [MODEL, WAVY])
def test_gradient_is_that_of_the_cost(model: LaneCourses) -> None:
    """In units of 1 / sqrt(H_ii), what a number alone is known to; near the data, as the slopes of a border are held
    while its points move."""
    evidence = evidence_of(model)
    squares = model.squares(evidence)
    z = squares.pack({name: value[0] for name, value in draw(model, evidence).items()})
    z = squares.loc + 0.2 * (z - squares.loc)
    _, hessian, gradient = of_borders(model, evidence, z)
    moved = np.flatnonzero(hessian.diagonal() > 0.0)
    sd = hessian.diagonal()[moved] ** -0.5
    cost = lambda at: of_borders(model, evidence, at)[0]  # noqa: E731
    steps = [1e-2 * width * np.eye(len(z))[p] for p, width in zip(moved, sd, strict=True)]
    numeric = np.array([(cost(z + step) - cost(z - step)) / 2e-2 for step in steps])
    np.testing.assert_allclose(gradient[moved] * sd, numeric, atol=0.01 * np.abs(numeric).max())
    assert np.all(gradient[np.setdiff1d(np.arange(len(z)), moved)] == 0.0)


def test_sites_can_be_fixed() -> None:
    evidence = evidence_of(MODEL)
    latents = {name: value[0] for name, value in draw(MODEL, evidence).items()}
    held = fix(MODEL, gap=latents["gap"])
    rest = {name: value for name, value in latents.items() if name != "gap"}
    assert float(log_joint(held, rest, evidence)) == pytest.approx(float(log_joint(MODEL, latents, evidence)))


def test_other_borders_are_refused() -> None:
    evidence = evidence_of(MODEL)
    layout = layout_of(evidence, evidence.loc)
    numbers = torch.from_numpy(layout.pack(evidence.loc))
    seen = PointsOnBorders(borders_of(evidence), 0.2, numbers, layout.sides)
    with pytest.raises(InputError, match=r"borders that their evidence was prepared from; prepare\(\) others"):
        seen.log_prob(borders_of(evidence).points.clone())


# What they make known


def refined(scene: Scene) -> tuple[float, float, float]:
    """Lane error [cm], width of the lanes over all arms and its posterior deviation [m]."""
    courses = default().courses
    evidence = courses.prepare(true_routes(scene))
    posterior = least_squares.run(courses, evidence, seed=0, **default().knobs | {"num_draws": 500})
    error = lane_error(centre_lines(evidence, posterior.estimate), scene.truth)["lane_error_cm"]
    return error, float(posterior.estimate["lane_width"]), float(posterior.sd("lane_width"))


def test_borders_make_the_width_of_lanes_observable() -> None:
    """Where all K arms have one lane each way, tracks tell width + gap, and a width that both priors, of one deviation
    s, spread to s / sqrt(1 + K); 500 draws show that to 3 %, and what tracks tell is known to some centimetres. Borders
    leave less than a third of it."""
    model, scenes = default().courses, [protocol(1, max_lanes=1, borders=borders) for borders in (None, 0.2)]
    assert model.lane_width_std == model.gap_std
    (_, _, blind), (_, width, seen) = (refined(scene) for scene in scenes)
    assert blind == pytest.approx(model.gap_std / math.sqrt(1 + len(scenes[0].truth.gap)), rel=0.15)
    assert seen < blind / 3
    assert abs(width - 2.7) < 4 * seen


def test_borders_make_lanes_better() -> None:
    """The mean error over six junctions falls by a tenth and more."""
    errors = [[refined(protocol(seed, borders=borders))[0] for borders in (None, 0.2)] for seed in range(6)]
    without, seen = np.mean(errors, 0)
    assert seen < 0.9 * without


def test_borders_reach_the_courses_through_the_structure() -> None:
    assert Junction().prepare(SCENE.data).tracks.borders is SCENE.data.borders


@pytest.mark.parametrize("std", [0.0, -1.0, math.nan])
def test_borders_need_noise(std: float) -> None:
    with pytest.raises(InputError, match="give a positive standard deviation, or null"):
        protocol(0, borders=std)


def test_borders_change_nothing_else_of_a_scene() -> None:
    plain = protocol(15, max_lanes=2, tracks=1)
    np.testing.assert_array_equal(plain.data.points, SCENE.data.points)
    assert plain.data.borders is None
