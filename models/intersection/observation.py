"""Tracks given the lanes of an intersection, as a Pyro distribution over the compiled density."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from models.intersection.evidence import JunctionEvidence
from models.intersection.kernel import bound_data, compiled_evaluate, memory_size
from models.intersection.moments import CHORD
from models.intersection.packing import MAX_ARMS, pack
from models.program import InputError

if TYPE_CHECKING:
    from models.intersection.state import Junction


class TracksOnLanes(TorchDistribution):
    """Points (3, N) of half tracks on the lanes of an intersection; x, y about the origin, heading.

        p(points | I) = prod_halves p(half | I), see models.intersection.density

    `sample` draws from the exact density; the closest-lane likelihoods are scores and cannot simulate."""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.real, 2)

    def __init__(
        self, model: Junction, evidence: JunctionEvidence, num_arms: Tensor, centre: Tensor, arms: dict[str, Tensor]
    ) -> None:
        self.model, self.evidence = model, evidence
        batch = torch.broadcast_shapes(num_arms.shape, centre.shape[:-1], *(v.shape[:-1] for v in arms.values()))
        wide = {"centre": centre.expand(*batch, 2), **{n: v.expand(*batch, MAX_ARMS) for n, v in arms.items()}}
        self.latents = {"num_arms": num_arms.expand(batch), **wide}
        super().__init__(batch, torch.Size([3, len(evidence.s)]), validate_args=False)

    def expand(self, batch_shape: Any, _instance: Any = None) -> TracksOnLanes:
        own = len(self.batch_shape)
        wide = {n: v.expand(torch.Size(batch_shape) + v.shape[own:]) for n, v in self.latents.items()}
        arms = {n: v for n, v in wide.items() if n not in ("num_arms", "centre")}
        return TracksOnLanes(self.model, self.evidence, wide["num_arms"], wide["centre"], arms)

    def _rows(self) -> dict[str, Tensor]:
        """The latents with all batch dimensions in one."""
        own = len(self.batch_shape)
        return {n: v.reshape((-1, *v.shape[own:])) for n, v in self.latents.items()}

    def _packed(self) -> np.ndarray:
        flat = {n: v.numpy() for n, v in self._rows().items()}
        return pack(flat, self.model.constants, self.evidence.origin)

    def log_prob(self, value: Tensor) -> Tensor:
        if self.model.likelihood != "exact" and value is not self.evidence.points:
            raise InputError(
                f"likelihood '{self.model.likelihood}' scores the tracks that its evidence was prepared from; "
                "prepare() other tracks, or use likelihood=exact"
            )
        z, evaluate = self._packed(), compiled_evaluate(self.model)
        out, points = np.empty((len(z), 2)), value.reshape(value.shape[:-2].numel(), 3, value.shape[-1])
        for b, observed in enumerate(points):
            floats, ints = bound_data(self.model, self.evidence, self.evidence._replace(points=observed).moments)
            cache = np.zeros(int(memory_size(ints)))
            for row in range(len(z)) if len(points) == 1 else (b,):
                evaluate(z[row], floats, ints, cache, out[row])
        shape = torch.broadcast_shapes(self.batch_shape, value.shape[:-2])
        return torch.from_numpy(out[:, 1].copy()).reshape(shape)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        if self.model.likelihood != "exact":
            raise NotImplementedError(
                f"likelihood '{self.model.likelihood}' is a score of closest lanes, not a density; "
                "simulate with likelihood='exact'"
            )
        wide = self.expand(torch.Size(sample_shape) + self.batch_shape) if len(sample_shape) else self
        rows = wide._rows()
        each = ({n: v[b] for n, v in rows.items()} for b in range(len(rows["num_arms"])))
        points = [_draw_points(wide.model, wide.evidence, one) for one in each]
        return torch.stack(points).reshape(wide.batch_shape + torch.Size([3, len(wide.evidence.s)]))


def _draw_points(model: Junction, evidence: JunctionEvidence, one: dict[str, Tensor]) -> Tensor:
    """One draw of all points (3, N): labels, then common offsets, then points (moments.py, top)."""
    num_halves, noise = evidence.num_halves, model.noise
    half = torch.repeat_interleave(torch.arange(num_halves), torch.from_numpy(np.diff(evidence.starts)))
    incoming = torch.arange(num_halves) < evidence.num_entries
    active = (torch.arange(MAX_ARMS) < one["num_arms"]).double()
    field = lambda name: one[name] if name in one else torch.full((MAX_ARMS,), model.constants[name])  # noqa: E731
    arm = torch.zeros(num_halves, dtype=torch.long)
    lane = torch.zeros(num_halves)
    lost = torch.rand(num_halves) < model.clutter
    for side, lanes in ((incoming, one["entries"]), (~incoming, one["exits"])):
        label = active * lanes  # lanes per arm
        lost = lost | (side & (label.sum() == 0))
        count = int(side.sum())
        if count:
            arm[side] = torch.multinomial(label.clamp(min=1e-300), count, replacement=True)
            lane[side] = torch.floor(torch.rand(count) * lanes[arm[side]])
    sign = torch.where(incoming, 1.0, -1.0)
    angle, bend = field("angle")[arm], field("bend")[arm]
    offset = field("shift")[arm] + sign * (one["gap"][arm] / 2 + (lane + 0.5) * field("width")[arm])
    offset = offset + noise.offset * torch.randn(num_halves)
    phase = noise.phase * torch.randn(num_halves)
    s = torch.from_numpy(evidence.s)
    across = offset[half] + bend[half] * s * (s - CHORD) / 2 + noise.position * torch.randn(len(s))
    along = s + phase[half] + noise.along * torch.randn(len(s))
    cos, sin = torch.cos(angle[half]), torch.sin(angle[half])
    centre = one["centre"] - torch.from_numpy(evidence.origin)
    x, y = centre[0] + along * cos - across * sin, centre[1] + along * sin + across * cos
    heading = angle[half] + torch.where(incoming, math.pi, 0.0)[half] + bend[half] * (s - CHORD / 2)
    heading = heading + noise.heading * torch.randn(len(s))
    anywhere = 2 * math.pi * torch.rand(len(s)) - math.pi
    stray = torch.cat([model.clutter_std * torch.randn(2, len(s)), anywhere[None]])
    return torch.where(lost[half], stray, torch.stack([x, y, heading]))
