"""Particles of objects: draws, their weights and moments, against dense algebra."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from inference.object_particles import LEAST_MISS, draw, draw_prior, log_corrections, moments, widen

Floats = NDArray[np.float64]
RNG = np.random.default_rng(7)
MEAN, SLOPE, NOISE = (
    RNG.standard_normal((3, 3)),
    RNG.standard_normal((3, 2, 3)),
    np.array([np.eye(2), [[2, 0.5], [0.5, 1]]]),
)
ROOTS = RNG.standard_normal((3, 3, 3)) * np.array([1.0, 1.0, 0.0])[:, None, None]  # the third cloud is one point
ROOTS[1, :, 2] = 0.0  # the second is flat
P = ROOTS @ ROOTS.swapaxes(1, 2)
PERIOD = np.array([math.inf, 4.0])
PREDICTED = RNG.uniform(-1.9, 1.9, (3, 2))
VALUES, SORT = np.array([[0.4, 1.8], [-1.0, -1.8], [0.7, 1.5]]), np.array([0, 1, 0])
PAIRS = [(0, 0), (0, 1), (0, -1), (1, -1), (1, 1), (0, 1), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)]


def off(z: Floats, h: Floats) -> Floats:
    return np.array([z[0] - h[0], math.remainder(z[1] - h[1], PERIOD[1])])


def test_draws_have_the_mean_and_covariance_of_kalmans_update() -> None:
    """Drawn by no noise and by unit vectors: the mean, and the columns of a root. Components that are flat, or a point,
    alternate with others, and so do measurements of two sorts of noise, across the seam of an angle."""
    pairs = np.repeat(np.array(PAIRS), 4, axis=0)
    normal = np.tile(np.vstack([np.zeros(3), np.eye(3)]), (len(PAIRS), 1))
    found = draw(*pairs.T.copy(), MEAN, P, PREDICTED, SLOPE, VALUES, NOISE, SORT, PERIOD, normal).reshape(-1, 4, 3)
    for (c, j), (middle, *ends) in zip(PAIRS, found, strict=True):
        m, V, H = MEAN[c], P[c], SLOPE[c]
        if j >= 0:
            gain = V @ H.T @ np.linalg.inv(H @ V @ H.T + NOISE[SORT[j]])
            m, V = m + gain @ off(VALUES[j], PREDICTED[c]), V - gain @ H @ V
        np.testing.assert_allclose(middle, m, atol=1e-9)
        root = np.array(ends).T - middle[:, None]
        np.testing.assert_allclose(root @ root.T, V, atol=1e-6)  # the root of rounding


def test_draws_of_the_prior_are_of_each_component() -> None:
    order = [0, 0, 1, 2, 1, 0]
    normal = np.tile(np.vstack([np.zeros(3), np.eye(3)]), (len(order), 1))
    found = draw_prior(np.repeat(order, 4), MEAN, P, normal).reshape(-1, 4, 3)
    for c, (middle, *ends) in zip(order, found, strict=True):
        np.testing.assert_allclose(middle, MEAN[c], atol=1e-12)
        root = np.array(ends).T - middle[:, None]
        np.testing.assert_allclose(root @ root.T, P[c], atol=1e-6)
        np.testing.assert_allclose(root, np.tril(root), atol=1e-12)


def test_narrow_and_nearly_flat_components_keep_their_width() -> None:
    V = np.array([[1.0, 1.0 - 1e-6], [1.0 - 1e-6, 1.0]])
    found = draw_prior(np.zeros(2, dtype=np.int64), np.zeros((1, 2)), V[None], np.eye(2)).T
    np.testing.assert_allclose(found @ found.T, V, rtol=1e-12)


def test_corrections_are_ratios_of_exact_and_linear_likelihoods() -> None:
    """Two sorts of noise, across the seam of an angle; and of p_D, or of 1 - p_D for what was missed."""
    component, measurement = np.array(PAIRS).T.copy()
    num = len(PAIRS)
    state, seen = RNG.standard_normal((num, 3)), RNG.uniform(-1.9, 1.9, (num, 2))
    seen[:, 1] = -0.9 * VALUES[measurement, 1]  # more than half a period off
    detected, detection = RNG.uniform(0.1, 0.9, num), np.array([0.3, 0.5, 0.8])
    about = (MEAN, PREDICTED, SLOPE, detection, VALUES, NOISE, SORT, PERIOD)
    found = log_corrections(state, seen, detected, component, measurement, *about)
    for p, (c, j) in enumerate(PAIRS):
        if j < 0:
            expected = math.log((1.0 - detected[p]) / (1.0 - detection[c]))
        else:
            exact = off(VALUES[j], seen[p])
            linear = off(VALUES[j], PREDICTED[c]) - SLOPE[c] @ (state[p] - MEAN[c])
            R = NOISE[SORT[j]]
            squares = [e @ np.linalg.solve(R, e) for e in (exact, linear)]
            expected = math.log(detected[p] / detection[c]) - 0.5 * (squares[0] - squares[1])
        assert found[p] == pytest.approx(expected, abs=1e-9)


def test_what_cannot_be_missed_but_is_has_finite_weights() -> None:
    component, missed, one = np.zeros(2, dtype=np.int64), np.full(2, -1), np.ones(1)
    about = (MEAN, PREDICTED, SLOPE, one, VALUES, NOISE, SORT, PERIOD)
    found = log_corrections(np.zeros((2, 3)), np.zeros((2, 2)), np.array([1.0, 0.5]), component, missed, *about)
    np.testing.assert_allclose(found, [0.0, math.log(0.5 / LEAST_MISS)], rtol=1e-12)


@pytest.mark.parametrize("period", [math.tau, 100.0])
def test_moments_of_several_clouds_are_weighted_and_unwound(period: float) -> None:
    """Lopsided, within half a period of their middle and across the seam; one cloud weighs nothing."""
    rng, num = np.random.default_rng(0), 300
    group, weight = rng.integers(0, 3, num), rng.random(num)
    weight[group == 1] = 0.0
    x = np.stack([rng.normal(3.0, 1.0, num), period * (0.45 + 0.15 * np.minimum(rng.exponential(1.0, num), 2.5))], 1)
    wound = x - np.outer(rng.integers(-1, 3, num), [0.0, period])
    mean, V = moments(group, 3, weight, wound, np.array([math.inf, period]))
    for g in (0, 2):
        own = group == g
        expected = np.average(x[own], 0, weight[own])
        turns = (mean[g] - expected) / [1.0, period]
        np.testing.assert_allclose(turns, [0.0, round(turns[1])], atol=1e-12)
        np.testing.assert_allclose(V[g], np.cov(x[own].T, aweights=weight[own], bias=True), atol=1e-9)
    assert not mean[1].any()
    assert not V[1].any()


def test_moments_far_from_the_origin_keep_their_digits() -> None:
    """A thousand kilometres away, of a cloud that is probably not there: its width is a centimetre nonetheless."""
    rng, weight = np.random.default_rng(0), np.full(100, 1e-3)
    x, one, none = 0.01 * rng.standard_normal((100, 1)), np.zeros(100, dtype=np.int64), np.full(1, math.inf)
    _, V = moments(one, 1, weight, x + 1e6, none)
    np.testing.assert_allclose(V[0, 0, 0], x.var(), rtol=1e-6)


def test_kernels_are_of_each_cloud_and_know_of_angles() -> None:
    """x <- m + sqrt(1 - h^2) (x - m) the short way, P <- P + h^2 V."""
    mean, V, h = np.array([[0.0, 1.9], [1.0, 0.0]]), np.array([np.eye(2), [[2.0, 0.5], [0.5, 1.0]]]), 0.6
    state, before = np.array([[1.0, -1.9], [2.0, 1.0]]), np.array([0.1 * np.eye(2), 0.2 * np.eye(2)])
    covariance = before.copy()
    widen(np.array([0, 1]), mean, V, PERIOD, h, state, covariance)
    np.testing.assert_allclose(state, [[0.8, 1.9 + 0.8 * 0.2], [1.8, 0.8]], atol=1e-12)
    np.testing.assert_allclose(covariance, before + 0.36 * V, atol=1e-12)
