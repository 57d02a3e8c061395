"""Height of a kerb along the road: is it lowered for a driveway, and where? The dimension is unknown."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from models.capability import Move, Proposal
from models.program import Latents


class Profile(NamedTuple):
    s: Tensor  # (N,) along the road [m]
    h: Tensor | None  # (N,) measured height [m]; None simulates


@dataclass(frozen=True)
class CurbHeight:
    """h(s) = full - lowered depth [logistic(2 (s - begin)) - logistic(2 (s - begin - width))] + noise"""

    dimension: ClassVar[str] = "lowered"
    length: float = 40.0  # of the kerb [m]
    noise_std: float = 0.03  # [m]

    def __call__(self, evidence: Profile) -> None:
        lowered = pyro.sample("lowered", dist.Categorical(probs=torch.tensor([0.5, 0.5])))[..., None]
        full = pyro.sample("full", dist.Normal(0.12, 0.02))[..., None]  # [m]
        depth = pyro.sample("depth", dist.Normal(0.09, 0.02))[..., None]  # [m]
        begin = pyro.sample("begin", dist.Uniform(0.0, self.length))[..., None]  # [m]
        width = pyro.sample("width", dist.LogNormal(1.4, 0.3))[..., None]  # [m]
        ramp = torch.sigmoid(2.0 * (evidence.s - begin)) - torch.sigmoid(2.0 * (evidence.s - begin - width))
        pyro.sample("h", dist.Normal(full - lowered * depth * ramp, self.noise_std).to_event(1), obs=evidence.h)

    def moves(self) -> tuple[Move, ...]:
        return Move("toggle", 0.2, 1, self._toggle), Move("jump", 0.2, 1, self._jump), Move("walk", 0.6, 4, self._walk)

    def _toggle(self, z: Latents, u: Tensor) -> Proposal:
        zero = u.new_zeros(len(u))
        return Proposal(z | {"lowered": 1 - z["lowered"]}, u, zero, zero, zero, zero == 0)

    def _jump(self, z: Latents, u: Tensor) -> Proposal:
        zero = u.new_zeros(len(u))
        return Proposal(z | {"begin": u[:, 0] * self.length}, z["begin"][:, None] / self.length, *[zero] * 3, zero == 0)

    def _walk(self, z: Latents, u: Tensor) -> Proposal:
        zero, sizes = u.new_zeros(len(u)), {"full": 0.006, "depth": 0.015, "begin": 0.6, "width": 0.8}
        new = z | {name: z[name] + size * (2 * u[:, i] - 1) for i, (name, size) in enumerate(sizes.items())}
        valid = (new["begin"] > 0) & (new["begin"] < self.length) & (new["width"] > 0)
        return Proposal(new, 1 - u, zero, zero, zero, valid)
