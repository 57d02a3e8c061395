"""Gradient estimators are unbiased, and each device lowers the variance that it is there for.

Of a Gaussian target the gradient of the ELBO is known: with precision P and mean m of p, and u = mean + T e,

    P (m - mean) by the mean,   T^-T - P T by T,   1 - P_dd sd_d^2 by log sd_d of a mean field

Estimates of many seeds are compared with it by their own standard error: 4.5 of them, which one in a few thousand sets
of twenty numbers exceeds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from inference import gradients
from inference.gradients import Gaussian, blocks, overdispersed, reading, reparameterised, score
from inference.transform import Affine, Target, standard, target_of
from models.capability import Factors
from tests.hierarchy import Hierarchy, readings

Array = NDArray[np.float64]
MODEL = Hierarchy(num_groups=3)
EVIDENCE = readings(MODEL)
FACTORS = MODEL.factors(EVIDENCE)
MEAN, COVARIANCE, _ = MODEL.exact(EVIDENCE)
D, S, REPEATS = 5, 24, 800
LOC = MEAN + np.array([0.1, -0.1, 0.2, 0.0, -0.2])
ROOT = np.array([[0.3, 0, 0, 0, 0], [0.1, 0.3, 0, 0, 0], [-0.3, 0, 0.5, 0, 0], [-0.2, 0, 0, 0.4, 0], [0, 0, 0, 0, 0.6]])
TARGET = target_of(FACTORS, Affine(LOC, ROOT))
Q = Gaussian(np.array([0.3, -0.2, 0.1, 0.5, 0.0]), np.log(np.array([0.6, 0.9, 0.7, 1.2, 0.8])))
RNG = np.random.default_rng(0)
LOWER = np.tril(0.3 * RNG.standard_normal((D, D)), -1)
TAU = np.array([1.7, 2.5])


def exact(target: Target, q: Gaussian) -> Array:
    tril = target.affine.tril
    precision = tril.T @ np.linalg.inv(COVARIANCE) @ tril
    centre = np.linalg.solve(tril, MEAN - target.affine.loc)
    by_mean, sd = precision @ (centre - q.mean), np.exp(q.log_sd)
    if q.lower is None:
        return np.concatenate([by_mean, 1.0 - precision.diagonal() * sd**2])
    root = q.lower + np.diag(sd)
    by_root = np.linalg.inv(root).T - precision @ root
    return np.concatenate([by_mean, sd * by_root.diagonal(), by_root[np.tril_indices(D, -1)]])


def estimates(one: Callable[[Array], Array], repeats: int = REPEATS, num: int = S, seed: int = 1) -> Array:
    """(repeats, P)."""
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    return np.stack([one(rng.standard_normal((num, D))) for _ in range(repeats)])


def z_scores(found: Array, truth: Array) -> Array:
    return (found.mean(0) - truth) / (found.std(0) / np.sqrt(len(found)))


def widened(target: Target, tau: Array = TAU, q: Gaussian = Q, controlled: bool = True) -> Callable[[Array], Array]:
    reads = reading(target, True)
    plan = blocks(FACTORS.sites, reads, S)
    return lambda noise: overdispersed(target, q, noise, 1.0, reads, controlled, plan, tau)[0]


def scored(target: Target, rao_blackwell: bool, control_variates: bool) -> Callable[[Array], Array]:
    reads = reading(target, rao_blackwell)
    return lambda noise: score(target, Q, noise, 1.0, reads, control_variates)


ESTIMATORS: dict[str, Callable[[Target], Callable[[Array], Array]]] = {
    "score": lambda target: scored(target, False, False),
    "rao_blackwell": lambda target: scored(target, True, False),
    "control_variates": lambda target: scored(target, False, True),
    "both": lambda target: scored(target, True, True),
    "overdispersed": widened,
    "overdispersed_raw": lambda target: widened(target, controlled=False),
    "reparameterised": lambda target: lambda noise: reparameterised(target, Q, noise, 1.0),
}


@pytest.mark.parametrize("name", ESTIMATORS)
def test_estimates_are_unbiased(name: str) -> None:
    found = estimates(ESTIMATORS[name](TARGET))
    assert np.abs(z_scores(found, exact(TARGET, Q))).max() < 4.5


def test_full_rank_estimates_are_unbiased() -> None:
    q = Q._replace(lower=LOWER)
    found = estimates(lambda noise: reparameterised(TARGET, q, noise, 1.0))
    assert np.abs(z_scores(found, exact(TARGET, q))).max() < 4.5


def test_rao_blackwellisation_and_control_variates_lower_the_variance() -> None:
    names = ("score", "rao_blackwell", "control_variates", "both", "reparameterised")
    variance = {name: estimates(ESTIMATORS[name](TARGET), 400).var(0) for name in names}
    local = [2, 3, 4, D + 2, D + 3, D + 4]  # whose F is without the factors of other groups
    assert (variance["rao_blackwell"][local] < variance["score"][local]).all()
    assert (variance["both"][local] < variance["control_variates"][local]).all()
    assert variance["control_variates"].sum() < 0.5 * variance["score"].sum()
    assert variance["reparameterised"].sum() < 0.5 * variance["both"].sum()


def test_a_number_that_no_two_factors_share_keeps_its_own_signal() -> None:
    """What other groups do is no noise to a local latent: its estimate is the same whatever their readings are."""
    wild = EVIDENCE._replace(y=EVIDENCE.y.clone())  # type: ignore[union-attr]
    wild.y[1:] += 50.0
    noise = np.random.default_rng(2).standard_normal((S, D))
    quiet, loud = (scored(target_of(MODEL.factors(e), standard(D)), True, True)(noise) for e in (EVIDENCE, wild))
    local, others = [2, D + 2], [0, 1, 3, 4]
    assert quiet[local] == pytest.approx(loud[local], rel=1e-12)
    assert (np.abs(quiet[others] - loud[others]) > 1.0).all()


def test_sites_that_never_meet_are_widened_together() -> None:
    reads = reading(TARGET, True)
    plan = blocks({"a": slice(0, 2), "b": slice(2, 3), "c": slice(3, 5)}, reads, S)
    assert [block.columns for block in plan] == [slice(0, 2), slice(2, 5)]
    assert [block.rows for block in plan] == [slice(0, 12), slice(12, 24)]
    assert np.array_equal(plan[1].coupled, np.eye(3))
    assert np.array_equal(plan[0].coupled, np.ones((2, 2)))
    assert len(blocks({"a": slice(0, 2), "b": slice(2, 5)}, reading(TARGET, False), S)) == 2


def test_unweighted_overdispersed_estimates_are_seen_to_be_biased(monkeypatch: pytest.MonkeyPatch) -> None:
    """The test above would notice a lost weight."""
    whole = gradients.terms
    monkeypatch.setattr(gradients, "terms", lambda strength, noise, weight, cv: whole(strength, noise, None, cv))
    found = estimates(widened(TARGET))
    assert np.abs(z_scores(found, exact(TARGET, Q))).max() > 20


def product() -> Factors:
    """Two numbers of one site whose scores see each other: log p(y | x) = -x_0^2 x_1^2."""
    return Factors(
        evaluate=lambda x: -np.square(x).prod(1, keepdims=True),
        gradient=lambda x: (-np.square(x).prod(1), -2 * x * np.square(x[:, ::-1])),
        depends=np.ones((1, 2), bool),
        sites={"x": slice(0, 2)},
        latents=lambda x: {"x": x},
        whiten=lambda state: np.asarray(state["x"], dtype=np.float64),
    )


def test_numbers_of_a_block_that_meet_are_weighted_together() -> None:
    """E_q log p = -m_0 m_1 - (m_0 + m_1) / 2, m_d = mean_d^2 + sd_d^2: on a quadratic a lost weight would not show."""
    target, num = target_of(product(), standard(2)), 24
    q, reads = Gaussian(np.array([0.4, -0.3]), np.log(np.array([0.7, 0.5]))), reading(target, True)
    plan = blocks(target.factors.sites, reads, num)
    moment = np.square(q.mean) + np.exp(2 * q.log_sd)
    pull = -2 * moment[::-1] - 1.0
    truth = np.concatenate([pull * q.mean, pull * np.exp(2 * q.log_sd) + 1.0])
    rng = np.random.default_rng(np.random.SeedSequence(6))
    noises = (rng.standard_normal((num, 2)) for _ in range(REPEATS))
    found = np.stack([overdispersed(target, q, e, 1.0, reads, True, plan, np.array([2.0]))[0] for e in noises])
    assert np.abs(z_scores(found, truth)).max() < 4.5


def test_slope_of_the_variance_by_tau_is_its_finite_difference() -> None:
    """Without control variates, whose coefficients move with tau a little: E[y^2] by brute force."""
    reads, num = reading(TARGET, True), 40000
    plan = blocks(FACTORS.sites, reads, num)
    noise = np.random.default_rng(3).standard_normal((num, D))

    def log_power(tau: Array) -> tuple[Array, Array]:
        kept: list[Array] = []
        whole = gradients.terms
        gradients.terms = lambda *arguments: kept.append(whole(*arguments)) or kept[-1].copy()  # type: ignore
        try:
            _, slopes = overdispersed(TARGET, Q, noise, 1.0, reads, False, plan, tau)
        finally:
            gradients.terms = whole
        return np.array([np.log((y**2).mean(0)).mean() for y in kept]), slopes

    eps = 0.02
    for i in range(2):
        step = np.where(np.arange(2) == i, eps, 0.0)
        high, low = (log_power(TAU * np.exp(sign * step))[0][i] for sign in (1, -1))
        assert log_power(TAU)[1][i] == pytest.approx((high - low) / (2 * eps), abs=0.05)


def heavy() -> Target:
    """One number whose score estimates live in the tails of q: log p = -|u|^4."""
    factors = Factors(
        evaluate=lambda x: -(x**4),
        gradient=lambda x: (-(x[:, 0] ** 4), -4 * x**3),
        depends=np.ones((1, 1), bool),
        sites={"x": slice(0, 1)},
        latents=lambda x: {"x": x},
        whiten=lambda state: np.atleast_1d(np.asarray(state["x"], dtype=np.float64)),
    )
    return target_of(factors, standard(1))


def test_a_wider_proposal_lowers_the_variance_where_its_slope_says_so() -> None:
    target, q, num = heavy(), Gaussian(np.array([0.2]), np.array([0.0])), 16
    reads = reading(target, True)
    plan = blocks(target.factors.sites, reads, num)
    rng = np.random.default_rng(np.random.SeedSequence(4))

    def spread(tau: float) -> tuple[float, float]:
        found = [
            overdispersed(target, q, rng.standard_normal((num, 1)), 1.0, reads, True, plan, np.array([tau]))
            for _ in range(800)
        ]
        return float(np.sum(np.var([g for g, _ in found], 0))), float(np.mean([s for _, s in found]))

    (narrow, falls), (wide, _), (_, rises) = spread(1.0), spread(2.0), spread(20.0)
    assert falls < -0.5 and rises > 0.1
    assert wide < 0.5 * narrow


def test_reparameterised_gradient_vanishes_without_noise_where_q_is_the_posterior() -> None:
    target = target_of(FACTORS, Affine(MEAN, np.linalg.cholesky(COVARIANCE)))
    noise = np.random.default_rng(5).standard_normal((3, D))
    exactly = Gaussian(np.zeros(D), np.zeros(D))
    assert reparameterised(target, exactly, noise, 1.0) == pytest.approx(np.zeros(2 * D), abs=1e-9)
