"""A conjugate Gaussian: every engine must be exact on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from models.capability import Move, Proposal
from models.program import Latents


class Readings(NamedTuple):
    """Readings of a line.

    t  (N,) where
    y  (N,) what was read; None simulates
    """

    t: Tensor
    y: Tensor | None


@dataclass(frozen=True)
class ConjugateGaussian:
    """A line read with Gaussian noise.

    beta ~ N(0, diag(prior_std^2)),   y_n ~ N(beta_0 + beta_1 t_n, noise_std^2)
    """

    prior_std: tuple[float, float] = (2.0, 1.0)
    noise_std: float = 0.5
    step: float = 0.4  # half width of the random walk

    def __call__(self, evidence: Readings) -> None:
        std = torch.tensor(self.prior_std)
        beta = pyro.sample("beta", dist.Normal(torch.zeros(2), std).to_event(1))  # (*B, 2)
        mean = beta[..., :1] + beta[..., 1:] * evidence.t  # (*B, N)
        pyro.sample("y", dist.Normal(mean, self.noise_std).to_event(1), obs=evidence.y)

    def exact(self, evidence: Readings) -> tuple[Tensor, Tensor, Tensor]:
        """Posterior mean (2,), covariance (2, 2) and log evidence, in closed form."""
        assert evidence.y is not None
        design = torch.stack([torch.ones_like(evidence.t), evidence.t], -1)
        prior = torch.diag(torch.tensor(self.prior_std, dtype=torch.float64) ** 2)
        covariance = torch.linalg.inv(torch.linalg.inv(prior) + design.T @ design / self.noise_std**2)
        mean = covariance @ design.T @ evidence.y / self.noise_std**2
        spread = design @ prior @ design.T + self.noise_std**2 * torch.eye(len(evidence.t))
        marginal = dist.MultivariateNormal(torch.zeros(len(evidence.t), dtype=torch.float64), spread)
        return mean, covariance, marginal.log_prob(evidence.y)

    def moves(self) -> tuple[Move, ...]:
        """A symmetric uniform walk."""
        return (Move("walk", 1.0, 2, self._walk),)

    def _walk(self, z: Latents, u: Tensor) -> Proposal:
        zero = u.new_zeros(len(u))
        beta = z["beta"] + self.step * (2.0 * u - 1.0)
        return Proposal({"beta": beta}, 1.0 - u, zero, zero, zero, torch.ones(u.shape[0], dtype=torch.bool))
