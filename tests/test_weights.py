"""Log weights: normalisation, effective size, resampling."""

from __future__ import annotations

import numpy as np
import pytest

from inference import weights


def test_normalised_weights_sum_to_one_whatever_their_scale() -> None:
    log_weights = np.array([[-1000.0, -1001.0], [-1002.0, -np.inf]])
    found = weights.normalise(log_weights)
    expected = np.exp([0.0, -1.0, -2.0]) / np.exp([0.0, -1.0, -2.0]).sum()
    np.testing.assert_allclose(found.reshape(-1), [*expected, 0.0], rtol=1e-12)


@pytest.mark.parametrize("bad", [[np.nan, 0.0], [-np.inf, -np.inf], [np.inf, 0.0]])
def test_weights_without_a_finite_maximum_are_refused(bad: list[float]) -> None:
    with pytest.raises(FloatingPointError, match="no finite maximum"):
        weights.normalise(np.array(bad))


def test_effective_size_counts_equal_weights_and_ignores_zeros() -> None:
    assert weights.effective_size(np.zeros((2, 5))) == pytest.approx(10.0)
    assert weights.effective_size(np.array([0.0, 0.0, -np.inf])) == pytest.approx(2.0)


def test_systematic_resampling_keeps_each_count_within_one_of_its_share() -> None:
    log_weights = np.random.default_rng(0).normal(size=50)
    shares = weights.normalise(log_weights)
    for uniform in (0.0, 0.3, 0.999999):
        counts = np.bincount(weights.systematic(log_weights, 200, uniform), minlength=50)
        assert np.all(np.abs(counts - 200 * shares) < 1.0)


def test_systematic_resampling_is_unbiased() -> None:
    """Averaged over a fine grid of the one uniform number; the grid's error is at most 1 / 1000 a count."""
    log_weights = np.log([0.1, 0.25, 0.65])
    grid = (np.arange(1000) + 0.5) / 1000
    counts = np.mean([np.bincount(weights.systematic(log_weights, 7, u), minlength=3) for u in grid], axis=0)
    np.testing.assert_allclose(counts, 7 * np.array([0.1, 0.25, 0.65]), atol=2e-3)


def test_log_mean_and_relative_error_are_those_of_the_weights() -> None:
    log_weights = np.random.default_rng(0).normal(size=50)
    w = np.exp(log_weights)
    assert weights.log_mean(log_weights - 700.0) == pytest.approx(np.log(w.mean()) - 700.0)
    assert weights.relative_error(log_weights) == pytest.approx(w.std() / w.mean() / np.sqrt(50))


def test_tempered_weights_have_the_size_asked_for() -> None:
    log_weights = 10.0 * np.random.default_rng(0).normal(size=200)
    power = weights.temper(log_weights, 100.0)
    assert weights.effective_size(power * log_weights) == pytest.approx(100.0, rel=1e-4)
    assert weights.temper(log_weights, 100.0, most=0.5 * power) == 0.5 * power
    assert weights.temper(np.zeros(200), 100.0) == 1.0
    zeros = np.where(np.arange(200) < 150, -np.inf, 0.0)
    assert 0.0 < weights.temper(zeros, 100.0) < 1e-12


@pytest.mark.parametrize("spread", [0.3, 1.0, 3.0])
def test_pareto_shape_is_that_of_arviz(spread: float) -> None:
    log_weights = spread * np.random.default_rng(1).normal(size=2000)
    import arviz

    assert weights.pareto_k(log_weights) == pytest.approx(float(arviz.psislw(log_weights)[1]), abs=1e-9)


def test_pareto_shape_of_pareto_weights_is_theirs() -> None:
    """Weights with tail P(w > t) = t^(-1/k); of 600 in the fit, the standard error is about (1 + k) / sqrt(600)."""
    uniforms = np.random.default_rng(2).random(40000)
    for k in (0.4, 0.9):
        assert weights.pareto_k(-k * np.log(uniforms)) == pytest.approx(k, abs=3 * (1 + k) / np.sqrt(600))


def test_a_weight_beside_which_the_others_vanish_has_the_heaviest_tail() -> None:
    assert weights.pareto_k(-800.0 * np.arange(1000)) == np.inf


def test_a_handful_of_weights_has_no_tail() -> None:
    assert np.isnan(weights.pareto_k(np.zeros(10)))
    assert np.isnan(weights.pareto_k(np.zeros(1000)))
