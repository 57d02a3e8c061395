"""A hierarchical Gaussian for tests of engines on factors: exact answers, local latents, factors of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray

from models.capability import Factors
from models.toys.gaussian import Readings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Hierarchy:
    """Groups of readings of a line, each with an offset of its own.

    line ~ N(0, I_2),   offset_g ~ N(0, offset_std^2),   y_gn ~ N(line_0 + line_1 t_n + offset_g, noise_std^2)

    Evidence: t (N,), y (G, N). x = (line, offset / offset_std), one factor for each group."""

    num_groups: int = 3
    offset_std: float = 0.7
    noise_std: float = 0.5

    def __call__(self, evidence: Readings) -> None:
        line = pyro.sample("line", dist.Normal(torch.zeros(2), 1.0).to_event(1))
        offset = pyro.sample("offset", dist.Normal(torch.zeros(self.num_groups), self.offset_std).to_event(1))
        mean = (line[..., :1] + line[..., 1:] * evidence.t)[..., None, :] + offset[..., None]
        pyro.sample("y", dist.Normal(mean, self.noise_std).to_event(2), obs=evidence.y)

    def designs(self, evidence: Readings) -> Array:
        """(G, N, D): the mean of y_gn is design @ x."""
        t = evidence.t.numpy()
        design = np.zeros((self.num_groups, len(t), 2 + self.num_groups))
        design[..., 0], design[..., 1] = 1.0, t
        for g in range(self.num_groups):
            design[g, :, 2 + g] = self.offset_std
        return design

    def factors(self, evidence: Readings) -> Factors:
        design, y = self.designs(evidence), evidence.y.numpy()  # type: ignore[union-attr]
        const = -len(evidence.t) * (np.log(self.noise_std) + 0.5 * np.log(2 * np.pi))

        def evaluate(x: Array) -> Array:
            gap = (y - np.einsum("gnd,sd->sgn", design, x)) / self.noise_std
            return -0.5 * np.einsum("sgn,sgn->sg", gap, gap) + const

        def gradient(x: Array) -> tuple[Array, Array]:
            gap = (y - np.einsum("gnd,sd->sgn", design, x)) / self.noise_std**2
            return evaluate(x).sum(-1), np.einsum("sgn,gnd->sd", gap, design)

        def latents(x: Array) -> dict[str, Array]:
            return {"line": x[..., :2], "offset": self.offset_std * x[..., 2:]}

        def whiten(state: dict[str, Any]) -> Array:
            return np.concatenate([np.asarray(state["line"]), np.asarray(state["offset"]) / self.offset_std])

        depends = np.concatenate([np.ones((self.num_groups, 2), bool), np.eye(self.num_groups, dtype=bool)], 1)
        sites = {"line": slice(0, 2), "offset": slice(2, 2 + self.num_groups)}
        return Factors(evaluate, gradient, depends, sites, latents, whiten)

    def exact(self, evidence: Readings) -> tuple[Array, Array, float]:
        """Posterior mean (D,) and covariance (D, D) of x, log evidence."""
        size = 2 + self.num_groups
        design, y = self.designs(evidence).reshape(-1, size), evidence.y.numpy().reshape(-1)  # type: ignore[union-attr]
        covariance = np.linalg.inv(np.eye(size) + design.T @ design / self.noise_std**2)
        spread = torch.from_numpy(design @ design.T + self.noise_std**2 * np.eye(len(y)))
        marginal = dist.MultivariateNormal(torch.zeros(len(y), dtype=torch.float64), spread)
        return covariance @ design.T @ y / self.noise_std**2, covariance, float(marginal.log_prob(torch.from_numpy(y)))


def readings(model: Hierarchy, num: int = 6, seed: int = 0) -> Readings:
    """Evidence simulated from one prior draw."""
    rng = np.random.default_rng(seed)
    blank = Readings(torch.linspace(-1.0, 1.0, num, dtype=torch.float64), None)
    mean = model.designs(blank) @ rng.standard_normal(2 + model.num_groups)
    return blank._replace(y=torch.from_numpy(mean + model.noise_std * rng.standard_normal(mean.shape)))
