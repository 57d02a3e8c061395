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
