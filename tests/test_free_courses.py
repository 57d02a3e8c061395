"""Free courses: splines that lanes share, the sum of squares, and what comes back from curves and junctions."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.stats import multivariate_normal, norm

from experiments.scenarios.protocol import drive, protocol
from inference import least_squares
from models.intersection.first_fit import smoothest
from models.intersection.free_courses import FreeCourses
from models.intersection.free_evidence import FreeEvidence
from models.intersection.free_kernel import free_nodes
from models.intersection.free_lines import centre_lines, lane_bands, lane_displacements, lane_nodes, pack
from models.intersection.free_splines import ENDS, bridge
from models.intersection.routes import RoutedTracks, Routes
from models.program import InputError, check, log_joint, simulate, terms
from tests.small_lanes import error, true_routes

Array = NDArray[np.float64]
MODEL = FreeCourses()
SCENE = protocol(14, max_lanes=2)
ROUTED = true_routes(SCENE)
EVIDENCE = MODEL.prepare(ROUTED)
TURNED = true_routes(protocol(14, max_lanes=2, heading_std=0.1))


def bare(lines: list[Array], connections: list[tuple[int, int, int, int]], seed: int, tracks: int = 4) -> RoutedTracks:
    """Vehicles on lines, of which no structure is known."""
    data, lane = drive(lines, np.random.SeedSequence(seed), 1.0, None, tracks)
    return RoutedTracks(data, {}, Routes(np.array(connections), lane))


def arc(radius: float, turn: float, arms: float = 40.0) -> Array:
    """Straight on, then around a circle to the left, then straight on: a point every 0.25 m."""
    inner = np.arange(0.0, radius * turn, 0.25)
    outer = np.arange(0.0, arms, 0.25)
    heading = np.concatenate([np.zeros(len(outer)), inner / radius, np.full(len(outer), turn)])
    return 0.25 * np.cumsum(np.stack([np.cos(heading), np.sin(heading)], 1), axis=0)


BESIDE = arc(1e6, 2e-5, 40.0) - np.array([0.0, 3.0])
BACK = bare([arc(7.0, math.pi), BESIDE], [(0, 0, 0, 0), (0, 1, 1, 0)], 0)  # both stubs of the first share an arm
EVERY = pytest.mark.parametrize("routed", [ROUTED, TURNED, BACK], ids=["positions", "headings", "u-turn"])


def estimate(model: FreeCourses, evidence: FreeEvidence) -> tuple[list[Array], list[Array], list[Array]]:
    """Lines and 90 % bands."""
    found = least_squares.run(model, evidence, seed=0, tolerance=1e-3)
    return centre_lines(evidence, found.estimate), *lane_bands(evidence, found.estimate, found.resample(500, 0), 0.9)


# Splines


@pytest.mark.parametrize("free", [slice(5, 11), slice(0, 12), slice(6, 16), slice(0, 16)])
def test_a_bridge_is_normal_given_its_ends(free: slice) -> None:
    """Against the conditional of the joint normal of all controls whose third differences are N(v, 1)."""
    rng, num, anchor = np.random.default_rng(1), 16, 0.3
    thirds, third = rng.normal(size=num - ENDS), np.diff(np.eye(num), ENDS, axis=0)
    precision, weighted = third.T @ third, third.T @ thirds
    if free == slice(0, num):
        precision[[0, 8, 15], [0, 8, 15]] += anchor**2
    found, held = bridge(thirds, free, anchor), np.delete(np.arange(num), free)
    covariance = np.linalg.inv(precision[free, free])
    np.testing.assert_allclose(found.own @ found.own.T, covariance, rtol=1e-6, atol=1e-9)
    given = rng.normal(size=len(held))
    mean = covariance @ (weighted[free] - precision[free][:, held] @ given)
    np.testing.assert_allclose(found.given @ given + found.own @ found.middle, mean, atol=1e-6)


def test_the_smoothing_is_that_of_the_largest_marginal_likelihood() -> None:
    """Against the dense density of y ~ N(A m, A A' std^2 + I), up to what std does not change."""
    rng, stds = np.random.default_rng(2), np.array([0.1, 0.5, 2.0])
    design, middle = rng.normal(size=(30, 6)), rng.normal(size=6)
    for true in stds:
        y = design @ (middle + true * rng.normal(size=6)) + rng.normal(size=30)
        exact = [
            multivariate_normal(design @ middle, std**2 * design @ design.T + np.eye(30)).logpdf(y) for std in stds
        ]
        z, std = smoothest(design.T @ design, -design.T @ y, middle, stds)
        assert std == stds[np.argmax(exact)]
        precision = design.T @ design + np.eye(6) / std**2
        np.testing.assert_allclose(z, np.linalg.solve(precision, design.T @ y + middle / std**2))


# The sum of squares


def draw(evidence: FreeEvidence, seed: int) -> dict[str, Array]:
    draws = simulate(FreeCourses(offset_std=0.2, inner_std=0.05), evidence, num=1, seed=seed)
    return {name: value[0].numpy() for name, value in draws.items()}


def test_displacements_are_the_derivatives_of_the_nodes() -> None:
    state = draw(EVIDENCE, 3)
    z = pack(EVIDENCE, state)
    for nodes, reference, design, where in zip(
        lane_nodes(EVIDENCE, state), EVIDENCE.reference, EVIDENCE.design, EVIDENCE.where, strict=True
    ):
        left, moved = np.stack([-nodes[:, 3], nodes[:, 2]], 1), np.empty_like(nodes)
        for p in (0, len(where) // 2, len(where) - 1):
            free_nodes(z[where] + 1e-3 * np.eye(len(where))[p], reference, design, moved)
            numeric = ((moved - nodes)[:, :2] * left).sum(1) / 1e-3
            np.testing.assert_allclose(nodes[:, 5 + p], numeric, atol=1e-8)


def test_what_arms_share_moves_all_their_lanes_the_same_way() -> None:
    """Entries and exits alike: the slope of an arm turns the outer ends of all its lanes to one side."""
    first, connections = EVIDENCE.loc["offset"].size, EVIDENCE.connections
    turned: dict[int, list[Array]] = {}
    for lane, (reference, design, where) in enumerate(
        zip(EVIDENCE.reference, EVIDENCE.design, EVIDENCE.where, strict=True)
    ):
        left = np.stack([-reference[:, 3], reference[:, 2]], 1)
        for end, node in ((0, 5), (2, -6)):
            arm = int(connections[lane, end])
            slope = design[node, np.flatnonzero(where == first + 2 * arm)]
            turned.setdefault(arm, []).append(slope * left[node])
    for moves in turned.values():
        assert len(moves) > 1
        for move in moves[1:]:
            np.testing.assert_allclose(move, moves[0], atol=0.15)  # of about 1 m
    assert min(np.linalg.norm(moves[0]) for moves in turned.values()) > 0.5


@EVERY
def test_cost_gradient_and_hessian_are_those_of_single_points(routed: RoutedTracks) -> None:
    """Every point against the nearest of all nodes of its lane: J' J and J' r with a row for each residual."""
    evidence = MODEL.prepare(routed)
    state, squares = draw(evidence, 4), MODEL.squares(evidence)
    size, cost, rows, residuals = len(squares.loc), 0.0, [], []
    for lane, nodes in enumerate(lane_nodes(evidence, state)):
        own = np.zeros((len(nodes), size))
        own[:, evidence.where[lane]] = nodes[:, 5:]
        tracks = evidence.tracks[evidence.starts[lane] : evidence.starts[lane + 1]]
        x = np.concatenate(
            [evidence.points.numpy()[:, evidence.offsets[t] : evidence.offsets[t + 1]].T for t in tracks]
        )
        near = ((x[:, None, :2] - nodes[None, :, :2]) ** 2).sum(-1).argmin(1)
        at, gap = nodes[near], x[:, :2] - nodes[near, :2]
        along = (gap * at[:, 2:4]).sum(1)
        lateral = at[:, 2] * gap[:, 1] - at[:, 3] * gap[:, 0] + at[:, 4] * (1.0 - along**2) / 2
        rows.append(-own[near])
        residuals.append(lateral)
        if evidence.heading:
            spread = np.sqrt(MODEL.heading_std**2 + at[:, 4] ** 2)
            turn = np.angle(np.exp(1j * (x[:, 2] - np.arctan2(at[:, 3], at[:, 2]) - at[:, 4] * along))) / spread
            cost += 0.5 * float((turn**2).sum()) + float(np.log(spread / MODEL.heading_std).sum())
            k = near[inner := (near > 0) & (near < len(nodes) - 1)]
            apart = np.linalg.norm(nodes[k + 1, :2] - nodes[k - 1, :2], axis=1) * spread[inner]
            rows.append(-(own[k + 1] - own[k - 1]) / apart[:, None])
            residuals.append(turn[inner])
        cost += 0.5 * float((lateral**2).sum())
    jacobian, residual = np.concatenate(rows), np.concatenate(residuals)
    hessian, gradient = np.empty((size, size)), np.empty(size)
    assert squares.evaluate(squares.pack(state), hessian, gradient) == pytest.approx(cost, rel=1e-10)
    expected = jacobian.T @ jacobian
    np.testing.assert_allclose(np.tril(hessian), np.tril(expected), atol=1e-9 * expected.max())
    np.testing.assert_allclose(gradient, jacobian.T @ residual, atol=1e-8 * np.abs(gradient).max())


@EVERY
def test_log_joint_is_that_of_the_squares(routed: RoutedTracks) -> None:
    evidence = MODEL.prepare(routed)
    check(MODEL, evidence)
    squares, draws = MODEL.squares(evidence), simulate(MODEL, evidence, num=3, seed=5)
    assert list(draws) == list(squares.sites)
    found, size = log_joint(MODEL, draws, evidence), len(squares.loc)
    for row in range(3):
        z = squares.pack({name: value[row] for name, value in draws.items()})
        prior = float(norm.logpdf(z, squares.loc, squares.scale).sum())
        cost = squares.evaluate(z, np.empty((size, size)), np.empty(size))
        assert float(found[row]) == pytest.approx(squares.log_const - cost + prior, rel=1e-12, abs=1e-9)


def test_other_points_are_refused() -> None:
    latents = {name: torch.from_numpy(value) for name, value in MODEL.start(EVIDENCE).items()}
    other = EVIDENCE._replace(points=EVIDENCE.points.clone())
    assert terms(MODEL, latents, EVIDENCE).likelihood["points"] < 0
    with pytest.raises(InputError, match="no track is on a route"):
        MODEL.prepare(ROUTED._replace(routes=Routes(ROUTED.routes.connections, np.full(other.offsets.size - 1, -1))))
    with pytest.raises(InputError, match="route 1 has no track"):
        MODEL.prepare(bare([arc(20.0, 1.0)], [(0, 0, 1, 0)], 0)._replace(routes=_two_routes()))
    with pytest.raises(InputError, match="knots must be finite and positive"):
        FreeCourses(knots=0.0)


def _two_routes() -> Routes:
    return Routes(np.array([[0, 0, 1, 0], [0, 0, 2, 0]]), np.zeros(4, dtype=np.int64))


# Recovery


@pytest.mark.parametrize(("radius", "turn"), [(1e6, 1e-5), (25.0, 1.5), (7.0, math.pi)], ids=["straight", "left", "u"])
def test_a_lane_is_found_to_its_own_deviation(radius: float, turn: float) -> None:
    """Root mean square of the errors of 20 drives over what their bands promise, 1.645 deviations of a normal on either
    side. Jumps of the curvature are no random walk, and smoothing parameters are taken for known: a fifth more."""
    line, ratios = arc(radius, turn), []
    for seed in range(20):
        evidence = MODEL.prepare(bare([line], [(0, 0, 1, 0)], seed))
        lines, left, right = estimate(MODEL, evidence)
        nodes = lines[0][3:-3]
        off = np.linalg.norm(line[None] - nodes[:, None], axis=-1).min(1)
        ratios.append(np.sqrt((off**2).mean() / (((left[0] + right[0])[3:-3] / 2 / 1.645) ** 2).mean()))
    assert np.mean(ratios) < 1.2 + 2 * np.std(ratios) / math.sqrt(len(ratios))


def drawn(evidence: FreeEvidence, model: FreeCourses, seed: int) -> tuple[dict[str, Array], FreeEvidence]:
    """A state of the prior, and evidence about it from vehicles on its lines, with the same reference curves."""
    state = {name: value[0].numpy() for name, value in simulate(model, evidence, num=1, seed=seed).items()}
    data, lane = drive(centre_lines(evidence, state), np.random.SeedSequence(seed), 1.0, None, None)
    points = np.vstack([(data.points - evidence.origin).T, np.zeros(len(data.points))])
    starts = np.searchsorted(lane, np.arange(len(evidence.connections) + 1))
    table = {"offsets": data.offsets, "tracks": np.arange(len(lane)), "starts": starts}
    return state, evidence._replace(points=torch.from_numpy(points), **table)


def test_bands_hold_lanes_of_the_prior_as_often_as_they_say() -> None:
    """The standard error is that of the shares of single junctions; 0.01 for what linear bands leave out."""
    model = FreeCourses(offset_std=0.5, arm_bow_std=0.5, inner_std=0.1)
    even = EVIDENCE._replace(scale={name: np.ones_like(value) for name, value in EVIDENCE.scale.items()})
    shares = []
    for seed in range(30):
        state, evidence = drawn(even, model, seed)
        found = least_squares.run(model, evidence, seed=seed, tolerance=1e-3)
        bands = lane_bands(evidence, found.estimate, found.resample(500, seed), 0.9)
        true = lane_displacements(evidence, found.estimate, {name: value[None] for name, value in state.items()})
        inside = [(x[:, 0] <= left) & (x[:, 0] >= -right) for x, left, right in zip(true, *bands, strict=True)]
        shares.append(np.concatenate(inside).mean())
    assert abs(np.mean(shares) - 0.9) < 0.01 + 3 * np.std(shares) / math.sqrt(len(shares))


def test_lanes_of_one_stub_are_one_until_they_part() -> None:
    """Two lanes from one entry, straight on and to the left, are the same line outside; twice the tracks would bring
    the error there down by a factor of 0.71."""
    lines, alone, errors = [arc(1e6, 2e-5, 50.0), arc(20.0, 1.5, 50.0)], FreeCourses(shared=False), []
    for seed in range(10):
        routed = bare(lines, [(0, 0, 1, 0), (0, 0, 2, 0)], seed)
        straight, left = estimate(MODEL, MODEL.prepare(routed))[0]
        np.testing.assert_allclose(np.interp(left[2:25, 0], *straight.T), left[2:25, 1], atol=2e-3)
        apart = estimate(alone, alone.prepare(routed))[0][1]
        errors.append([(line[5:40, 1] ** 2).mean() for line in (left, apart)])
    shared, alone_error = np.sqrt(np.mean(errors, 0))
    assert shared < 0.85 * alone_error


def test_lanes_with_one_end_only() -> None:
    """Tracks that cover one side: no stub at the other, where the lane is free to end."""
    lines = [arc(20.0, 1.5), arc(20.0, 1.5)[: 40 * 4]]
    evidence = MODEL.prepare(bare(lines, [(0, 0, 1, 0), (0, 0, -1, -1)], 1))
    for line, found in zip(lines, estimate(MODEL, evidence)[0], strict=True):
        assert error(found, line) < 0.35


def test_the_order_of_tracks_and_lanes_changes_nothing() -> None:
    connections, track_route = ROUTED.routes
    turned = Routes(connections[::-1], len(connections) - 1 - track_route)
    lines = [estimate(MODEL, MODEL.prepare(r))[0] for r in (ROUTED, ROUTED._replace(routes=turned))]
    for line, other in zip(lines[0], lines[1][::-1], strict=True):
        np.testing.assert_allclose(line, other, atol=5e-3)
