"""Directions of the arms: uniform on the circle, no two active ones closer than 25 degrees."""

from __future__ import annotations

import math
from typing import Any

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

MIN_SEPARATION = math.radians(25.0)


class HardCoreAngles(TorchDistribution):
    """Angles of labelled slots of which the first num_arms are active.

        p(angle) = (2 pi)^-S [all active pairs >= delta apart] / Z_K,   Z_K = (1 - K delta / 2 pi)^(K - 1)

    Inactive slots are uniform (pseudo-prior). Z_K is the chance that K uniform points on the circle keep
    apart; leaving it out turns a uniform prior of K into one that prefers few arms.
    Raises ValueError for more arms than fit on the circle."""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.interval(-math.pi, math.pi), 1)

    def __init__(self, num_arms: Tensor, slots: int) -> None:
        if slots * MIN_SEPARATION >= 2 * math.pi:
            raise ValueError(f"{slots} arms do not fit on the circle")
        self.num_arms, self.slots = num_arms, slots
        super().__init__(num_arms.shape, torch.Size([slots]), validate_args=False)

    def expand(self, batch_shape: Any, _instance: Any = None) -> HardCoreAngles:
        return HardCoreAngles(self.num_arms.expand(batch_shape), self.slots)

    def log_prob(self, value: Tensor) -> Tensor:
        active = torch.arange(self.slots) < self.num_arms[..., None]
        gap = _wrap(value[..., :, None] - value[..., None, :])
        pair = active[..., :, None] & active[..., None, :] & ~torch.eye(self.slots, dtype=torch.bool)
        apart = ((gap.abs() >= MIN_SEPARATION) | ~pair).all(-1).all(-1)
        count = self.num_arms.double()
        log_z = (count - 1) * torch.log1p(-count * MIN_SEPARATION / (2 * math.pi))
        density = -self.slots * math.log(2 * math.pi) - log_z
        return torch.where(apart, density, -torch.inf)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Exact: K arms with exponential gaps that fill the circle left free by the separations."""
        shape = torch.Size(sample_shape) + self.batch_shape
        count = self.num_arms.expand(shape)
        slot = torch.arange(self.slots).expand(*shape, self.slots)
        active = slot < count[..., None]
        gap = torch.empty(*shape, self.slots, dtype=torch.float64).exponential_() * active
        free = 2 * math.pi - count[..., None] * MIN_SEPARATION
        gap = MIN_SEPARATION + free * gap / gap.sum(-1, keepdim=True)
        around = 2 * math.pi * torch.rand(*shape, 1, dtype=torch.float64) + gap.cumsum(-1)
        order = torch.where(active, torch.rand(*shape, self.slots), 2.0).argsort(-1)  # shuffles the active
        around = torch.where(active, around.gather(-1, order), 2 * math.pi * torch.rand(*shape, self.slots))
        return _wrap(around)

    def from_standard(self, x: Tensor) -> Tensor:
        """Angles (*batch, S) from standard normal numbers: with the separations cut out, the other active arms are
        uniform on what is left of the circle after the first one.

            angle_1 = 2 pi u_1 - pi,   angle_i = angle_1 + w_i + delta (1 + #{active j > 1: w_j < w_i})
            w_i = (2 pi - K delta) u_i,   u = Phi(x)

        An isometry but for the scale, with jumps where two arms would pass one another. Where the first arm points
        to +-pi, its number runs off to infinity on both sides."""
        u = torch.special.ndtr(x)
        first, others, free = u[..., :1] * (2 * math.pi) - math.pi, self._others(), self._free()
        around = first + free * u + MIN_SEPARATION * (1 + _rank(u, others))
        return torch.where(others, _wrap(around), u * (2 * math.pi) - math.pi)

    def to_standard(self, value: Tensor) -> Tensor:
        """The inverse of `from_standard`."""
        others, beyond = self._others(), torch.remainder(value - value[..., :1], 2 * math.pi)
        left = (beyond - MIN_SEPARATION * (1 + _rank(beyond, others))) / self._free()
        return torch.special.ndtri(torch.where(others, left, (value + math.pi) / (2 * math.pi)))

    def _others(self) -> Tensor:
        """(*batch, S): the active slots but the first."""
        slot = torch.arange(self.slots)
        return (slot > 0) & (slot < self.num_arms[..., None])

    def _free(self) -> Tensor:
        """(*batch, 1): what is left of the circle without the separations."""
        return 2 * math.pi - self.num_arms[..., None].double() * MIN_SEPARATION


def _rank(value: Tensor, among: Tensor) -> Tensor:
    """(*batch, S): how many of the slots `among` have a smaller value."""
    return ((value[..., None, :] < value[..., :, None]) & among[..., None, :]).sum(-1)


def _wrap(angle: Tensor) -> Tensor:
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
