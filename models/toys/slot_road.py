"""One lane marking whose curvature rate changes at an unknown number of knots.

The smallest model with slots: `num_knots` of `max_knots` slots are active, the others keep values
from their prior (normalised pseudo-priors), so the state space has one dimension throughout. Slots
are labelled; a relabelling is the same road, and reports sort the active knots by position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from models.capability import Move, Proposal
from models.program import Latents


class Markings(NamedTuple):
    """Detections of one marking.

    s  (N,) arc length [m]
    d  (N,) lateral offset [m]; None simulates
    """

    s: Tensor
    d: Tensor | None


@dataclass(frozen=True)
class SlotRoad:
    """Lateral offset of a marking along the road.

    d(s) = d0 + psi0 s + kappa0 s^2 / 2 + sum_k rate_k (s - knot_k)_+^3 / 6 + noise
    num_knots ~ Poisson(knots_mean) truncated at max_knots
    """

    dimension: ClassVar[str] = "num_knots"

    max_knots: int = 4
    knots_mean: float = 1.0  # before truncation
    length: float = 100.0  # visible road [m]
    offset_std: float = 2.0  # d0 [m]
    angle_std: float = 0.1  # psi0 [rad]
    curvature_std: float = 0.01  # kappa0 [1/m]
    rate_std: float = 1e-3  # curvature rate [1/m^2]
    noise_std: float = 0.1  # detector [m]

    def __call__(self, evidence: Markings) -> None:
        slots = torch.arange(self.max_knots)
        counts = torch.arange(self.max_knots + 1.0)
        d0 = pyro.sample("d0", dist.Normal(0.0, self.offset_std))
        psi0 = pyro.sample("psi0", dist.Normal(0.0, self.angle_std))
        kappa0 = pyro.sample("kappa0", dist.Normal(0.0, self.curvature_std))
        num_knots = pyro.sample("num_knots", dist.Categorical(logits=dist.Poisson(self.knots_mean).log_prob(counts)))
        size = [self.max_knots]
        knot = pyro.sample("knot", dist.Uniform(0.0, self.length).expand(size).to_event(1))  # (*B, K)
        rate = pyro.sample("rate", dist.Normal(0.0, self.rate_std).expand(size).to_event(1))  # (*B, K)
        active = slots < num_knots[..., None]  # (*B, K)
        mean = offset(evidence.s, d0, psi0, kappa0, knot, rate * active)
        pyro.sample("d", dist.Normal(mean, self.noise_std).to_event(1), obs=evidence.d)

    def moves(self) -> tuple[Move, ...]:
        """Walks over one coordinate group each, and birth or death of a knot."""
        return (
            Move("walk", 0.4, 3, self._walk_base),
            Move("shift", 0.15, 2, self._shift_knot),
            Move("scale", 0.15, 2, self._scale_rate),
            Move("birth_death", 0.3, 4, self._birth_death),
        )

    def _walk_base(self, z: Latents, u: Tensor) -> Proposal:
        """Uniform walk of (d0, psi0, kappa0)."""
        step = 2.0 * u - 1.0
        width = 0.15 * self.noise_std
        new = z | {
            "d0": z["d0"] + width * 2 * step[:, 0],
            "psi0": z["psi0"] + width * 8 / self.length * step[:, 1],
            "kappa0": z["kappa0"] + width * 16 / self.length**2 * step[:, 2],
        }
        zero = u.new_zeros(len(u))
        return Proposal(new, 1.0 - u, zero, zero, zero, torch.ones(len(u), dtype=torch.bool))

    def _pick(self, z: Latents, u: Tensor) -> tuple[Tensor, Tensor]:
        """An active slot from a uniform number; False where there is none."""
        count = z["num_knots"]
        slot = (u * count).long().clamp(max=(count - 1).clamp(min=0))
        return slot, count > 0

    def _shift_knot(self, z: Latents, u: Tensor) -> Proposal:
        """Move one active knot by U[-10, 10] m."""
        slot, valid = self._pick(z, u[:, 0])
        knot = z["knot"].gather(1, slot[:, None])[:, 0] + 20.0 * (u[:, 1] - 0.5)
        valid = valid & (knot >= 0) & (knot <= self.length)
        zero = u.new_zeros(len(u))
        new = z | {"knot": z["knot"].scatter(1, slot[:, None], knot[:, None])}
        return Proposal(new, torch.stack([u[:, 0], 1.0 - u[:, 1]], 1), zero, zero, zero, valid)

    def _scale_rate(self, z: Latents, u: Tensor) -> Proposal:
        """Multiply one active rate by -e^s or e^s, s ~ U[-1, 1]: Jacobian e^s."""
        slot, valid = self._pick(z, u[:, 0])
        flip = torch.where(u[:, 1] < 0.25, -1.0, 1.0)
        part = torch.where(u[:, 1] < 0.25, u[:, 1] / 0.25, (u[:, 1] - 0.25) / 0.75)  # uniform
        log_scale = 2.0 * part - 1.0
        rate = z["rate"].gather(1, slot[:, None])[:, 0] * flip * log_scale.exp()
        back = torch.where(u[:, 1] < 0.25, 0.25 * (1.0 - part), 0.25 + 0.75 * (1.0 - part))
        zero = u.new_zeros(len(u))
        new = z | {"rate": z["rate"].scatter(1, slot[:, None], rate[:, None])}
        return Proposal(new, torch.stack([u[:, 0], back], 1), zero, zero, log_scale, valid)

    def _birth_death(self, z: Latents, u: Tensor) -> Proposal:
        """Half births into a uniform slot, half deaths of a uniform active knot.

        A birth draws the knot from its prior and swaps it with the values of the first inactive
        slot, which travel back in u'; the two slots are swapped so that any active slot can be the newest.
        """
        count, rows = z["num_knots"], torch.arange(len(u))
        birth = u[:, 0] < 0.5
        valid = torch.where(birth, count < self.max_knots, count > 0)
        last = torch.where(birth, count, count - 1).clamp(0, self.max_knots - 1)  # slot that changes
        num = (last + 1).double()
        place = (u[:, 1] * num).long().clamp(max=last)  # active slot born or dying
        knot, rate = z["knot"].clone(), z["rate"].clone()
        normal = dist.Normal(0.0, self.rate_std)

        # death: bring the dying knot to the last active slot; birth: fill it, then send it to its place
        for values in (knot, rate):
            dying = ~birth
            values[rows[dying], last[dying]], values[rows[dying], place[dying]] = (
                values[rows[dying], place[dying]],
                values[rows[dying], last[dying]],
            )
        old_knot, old_rate = knot[rows, last], rate[rows, last]
        knot[rows, last] = u[:, 2] * self.length
        rate[rows, last] = normal.icdf(u[:, 3].clamp(1e-15, 1 - 1e-15))
        new_rate = rate[rows, last].clone()
        for values in (knot, rate):
            values[rows[birth], last[birth]], values[rows[birth], place[birth]] = (
                values[rows[birth], place[birth]],
                values[rows[birth], last[birth]],
            )

        back = torch.stack([(u[:, 0] + 0.5) % 1.0, u[:, 1], old_knot / self.length, normal.cdf(old_rate)], 1)
        log_forward = normal.log_prob(new_rate) - math.log(self.length)
        log_backward = normal.log_prob(old_rate) - math.log(self.length)
        new = z | {"num_knots": torch.where(valid, count + 2 * birth.long() - 1, count), "knot": knot, "rate": rate}
        return Proposal(new, back, log_forward, log_backward, u.new_zeros(len(u)), valid)


def offset(s: Tensor, d0: Tensor, psi0: Tensor, kappa0: Tensor, knot: Tensor, rate: Tensor) -> Tensor:
    """Lateral offset (*B, N) at arc lengths s (N,) of a marking with curvature rates (*B, K)."""
    ramp = (s - knot[..., None]).clamp(min=0.0) ** 3 / 6.0  # (*B, K, N)
    base = d0[..., None] + psi0[..., None] * s + kappa0[..., None] * s**2 / 2.0
    return base + (rate[..., None] * ramp).sum(-2)
