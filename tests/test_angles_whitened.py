"""The directions of arms are whitened exactly, so that engines of continuous numbers run on a fixed structure."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from models.intersection.angles import MIN_SEPARATION, HardCoreAngles
from models.intersection.packing import MAX_ARMS

NUM_ARMS = [2, 4, 7]


def numbers(num: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(0).standard_normal((num, MAX_ARMS)))


@pytest.mark.parametrize("num_arms", NUM_ARMS)
def test_the_map_and_its_inverse_cancel(num_arms: int) -> None:
    prior, x = HardCoreAngles(torch.tensor(num_arms), MAX_ARMS), numbers(200)
    angle = prior.from_standard(x)
    assert bool(torch.isfinite(prior.log_prob(angle)).all()), "arms keep apart"
    torch.testing.assert_close(prior.to_standard(angle), x, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("num_arms", NUM_ARMS)
def test_density_of_the_image_is_that_of_the_prior(num_arms: int) -> None:
    """log p(T(x)) + log |dT/dx| = log N(x; 0, I)."""
    prior = HardCoreAngles(torch.tensor(num_arms), MAX_ARMS)
    for x in numbers(5):
        jacobian = torch.autograd.functional.jacobian(prior.from_standard, x)
        height = prior.log_prob(prior.from_standard(x)) + torch.linalg.slogdet(jacobian)[1]
        assert float(height) == pytest.approx(float(torch.distributions.Normal(0.0, 1.0).log_prob(x).sum()), rel=1e-10)


def test_images_of_normal_numbers_are_the_prior() -> None:
    """The smallest gap of four arms, against draws by exponential gaps: two samples, Kolmogorov and Smirnov."""
    prior = HardCoreAngles(torch.tensor(4), MAX_ARMS)

    def smallest(angle: torch.Tensor) -> np.ndarray:
        arms = np.sort(angle[:, :4].numpy(), axis=1)
        return np.diff(np.concatenate([arms, arms[:, :1] + 2 * np.pi], 1), axis=1).min(1)

    torch.manual_seed(1)
    drawn = smallest(prior.sample(torch.Size([2000])))
    mapped = smallest(prior.from_standard(numbers(2000)))
    assert mapped.min() > MIN_SEPARATION - 1e-9
    assert stats.ks_2samp(drawn, mapped).pvalue > 0.001
