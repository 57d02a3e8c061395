"""Polylines sampled after [M19]: the compiled density, its memory, its move, and the chain."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.lane_papers import m19_refine
from experiments.scenarios.protocol import protocol
from inference import diagnostics, rjmcmc
from models.intersection.offset_courses import OffsetCourses, OffsetEvidence, centre_lines
from models.program import check, simulate, terms
from tests.involution import assert_involution, uniforms
from tests.small_lanes import error, small_scene, true_routes

MODEL = OffsetCourses(offset_std=1.0, bend_std=0.5)
ROUTED = true_routes(small_scene())
EVIDENCE = MODEL.prepare(ROUTED)


def test_a_step_and_its_reverse_cancel() -> None:
    (walk,) = MODEL.moves()
    assert_involution(walk, simulate(MODEL, EVIDENCE, num=3, seed=0), uniforms(walk, 3, seed=1), num_jacobians=1)


def test_steps_are_normal() -> None:
    (walk,) = MODEL.moves()
    num = 4000
    zero = {"offsets": torch.zeros(num, 1, 20, dtype=torch.float64)}
    steps = walk.propose(zero, uniforms(walk, num, seed=2)).latents["offsets"].sum((1, 2)).numpy() / MODEL.step_std
    assert abs(steps.mean()) < 4 / np.sqrt(num)
    assert abs(np.square(steps).mean() - 1.0) < 4 * np.sqrt(2 / num)
    assert abs((np.abs(steps) < 1.0).mean() - 0.6827) < 4 * np.sqrt(0.6827 * 0.3173 / num)


def test_kernel_is_the_density_of_the_program_whatever_was_evaluated_before() -> None:
    check(MODEL, EVIDENCE)
    draws, kernel = simulate(MODEL, EVIDENCE, num=6, seed=3), MODEL.kernel(EVIDENCE)
    split = terms(MODEL, draws, EVIDENCE)
    cache, out = np.zeros(kernel.cache_size), np.empty(2)
    packed = kernel.pack({"offsets": draws["offsets"].numpy()})
    for row in (0, 1, 2, 1, 0, 3, 5, 4, 4, 0):
        z = packed[row].copy()
        kernel.evaluate(z, kernel.floats, kernel.ints, cache, out)
        assert out[0] == pytest.approx(float(split.prior["offsets"][row]))
        assert out[1] == pytest.approx(float(split.likelihood["points"][row]))
        if row % 2:
            kernel.commit(cache)
    z[7] += 0.1  # one lane differs from the state evaluated last, none from that of a new cache
    fresh = np.empty(2)
    kernel.evaluate(z, kernel.floats, kernel.ints, cache, out)
    kernel.evaluate(z, kernel.floats, kernel.ints, np.zeros(kernel.cache_size), fresh)
    np.testing.assert_array_equal(out, fresh)


def test_likelihood_of_a_straight_lane_is_that_of_its_points() -> None:
    rng = np.random.default_rng(4)
    points = np.stack([rng.uniform(0.0, 9.0, 50), rng.normal(size=50)], 1)
    stations = np.stack([np.array([3.0 * i, 0.0, 0.0, 1.0]) for i in range(4)])[None]
    segments = np.zeros((1, 3, 6))
    for i in range(3):
        own = points[(points[:, 0] // 3.0).astype(int) == i]
        scatter = (own - own.mean(0)).T @ (own - own.mean(0))
        segments[0, i] = [len(own), *own.mean(0), scatter[0, 0], scatter[0, 1], scatter[1, 1]]
    model = OffsetCourses(num_offsets=4, position_std=0.6)
    tilted = torch.tensor([[0.0, 0.3, 0.6, 0.9]], dtype=torch.float64)  # the line y = x / 10
    found = terms(model, {"offsets": tilted}, OffsetEvidence(stations, segments)).likelihood["points"]
    lateral = torch.from_numpy((points[:, 1] - 0.1 * points[:, 0]) / np.hypot(1.0, 0.1))
    assert float(found) == pytest.approx(float(torch.distributions.Normal(0.0, 0.6).log_prob(lateral).sum()))


def test_points_lie_on_the_segments_beside_them() -> None:
    """Every segment's points lie nearer to its own middle than to that of any segment two or more away."""
    middles = 0.5 * (EVIDENCE.stations[:, 1:, :2] + EVIDENCE.stations[:, :-1, :2])
    for own, segments in zip(middles, EVIDENCE.segments, strict=True):
        apart = np.linalg.norm(segments[:, None, 1:3] - own, axis=-1)  # (segment, middle)
        nearest = apart.argmin(1)
        assert (np.abs(nearest - np.arange(len(own))) <= 1)[segments[:, 0] > 0].all()
    assert EVIDENCE.segments[..., 0].sum() == len(ROUTED.tracks.points)


def test_a_chain_without_points_returns_the_prior() -> None:
    model = OffsetCourses(num_offsets=4, offset_std=1.0, bend_std=1.0, step_std=2.0)
    stations = np.stack([np.array([3.0 * i, 0.0, 0.0, 1.0]) for i in range(4)])[None]
    blind = OffsetEvidence(stations, np.zeros((1, 3, 6)))
    knobs = {"num_chains": 4, "num_steps": 40_000, "warmup": 1000, "thin": 20}
    draws = rjmcmc.run(model, blind, seed=5, start="data", **knobs).draws["offsets"][:, :, 0]
    covariance = np.linalg.inv(model.precision())
    for i in range(4):
        for j in range(i + 1):
            product = draws[..., i] * draws[..., j]
            assert abs(product.mean() - covariance[i, j]) < 4 * diagnostics.standard_error(product)


def test_the_chain_finds_the_lanes() -> None:
    """The first courses are half a metre off on average, sampled ones about 16 cm on the protocol."""
    scene = protocol(2)
    routed = true_routes(scene)
    first = centre_lines(OffsetCourses().prepare(routed), {})
    found, _ = m19_refine(routed, seed=0)
    errors = [np.mean([error(a, b) for a, b in zip(ls, scene.truth.lines, strict=True)]) for ls in (first, found)]
    assert errors[1] < 0.22 < errors[0]
