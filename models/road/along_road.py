"""The distribution of cues along a road: it simulates them, and scores them in machine code.

Given the course and the offsets, a cue at arc length l is placed beside the course and seen with noise
(models.road.cues); a share of cues is clutter, anywhere across the road. `log_prob` knows no arc length: a cue may be
anywhere along the road, and only what it says across the road and about its direction counts
(models.road.cue_kernel). Gradients are first derivatives; a second one raises.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from models.clothoid import Points, evaluate, hermite
from models.compiled_density import compiled_log_prob
from models.program import InputError
from models.road.cue_kernel import WIDTH
from models.road.evidence import RoadEvidence
from models.road.kernel import explain, slopes_in_course

if TYPE_CHECKING:
    from models.road.course import RoadCourse

Floats = NDArray[np.float64]


class CuesAlongRoad(TorchDistribution):
    """Cues (N, 3), rows (x, y, direction of motion), beside courses (*B, 6) at offsets (*B, G)."""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.real, 2)

    def __init__(self, model: RoadCourse, evidence: RoadEvidence, course: Tensor, offset: Tensor) -> None:
        self.model, self.evidence = model, evidence
        batch = torch.broadcast_shapes(course.shape[:-1], offset.shape[:-1])
        self.course = course.expand((*batch, course.shape[-1]))
        self.offset = offset.expand((*batch, offset.shape[-1]))
        super().__init__(batch, torch.Size([len(evidence.group), 3]), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        numbers = torch.cat([self.course, self.offset], -1)
        value = value.expand((*self.batch_shape, *self.event_shape))
        return compiled_log_prob(numbers, value, self._evaluate)

    def _evaluate(self, numbers: Floats, cues: Floats) -> tuple[Floats, Floats]:
        height, slope = np.empty(len(numbers)), np.empty_like(numbers)
        rows = cue_arrays(self.model, self.evidence, cues)
        slopes_in_course(numbers, *kernel_settings(self.model), *rows, height, slope)  # type: ignore[call-arg]
        return height, slope

    def sample(self, sample_shape: Any = ()) -> Tensor:
        if self.evidence.arc is None:
            raise InputError("simulating cues needs to know where they stand: give the evidence arc lengths (arc)")
        if self.model.likelihood == "paper":
            raise InputError("the likelihood 'paper' is no density of positions, so it cannot simulate; choose 'exact'")
        shape = (*sample_shape, *self.batch_shape)
        course, offset = self.course.expand((*shape, 6)), self.offset.expand((*shape, self.offset.shape[-1]))
        points = evaluate(
            hermite(course[..., :3], course[..., 3:]), torch.from_numpy(self.evidence.arc).expand(*shape, -1)
        )
        return scatter(points, offset[..., torch.from_numpy(self.evidence.group)], self.evidence, self.model)

    def whitened(self, value: Tensor) -> Tensor:
        """Residuals across the road and of the direction, and the probability of following the road, (*B, N, 3)."""
        numbers = torch.cat([self.course, self.offset], -1).detach().reshape(-1, self.offset.shape[-1] + 6).numpy()
        rows = value.detach().expand((*self.batch_shape, *self.event_shape)).reshape(len(numbers), -1, 3).numpy()
        out, settings = np.empty_like(rows), kernel_settings(self.model)
        for i, z in enumerate(numbers):
            cues = cue_arrays(self.model, self.evidence, rows[i])
            explain(z, *settings, *cues, out[i])  # type: ignore[call-arg]
        return torch.from_numpy(out).reshape((*self.batch_shape, *self.event_shape))


def scatter(points: Points, offset: Tensor, evidence: RoadEvidence, model: RoadCourse) -> Tensor:
    """Cues (*B, N, 3) seen beside points (*B, N) of a course at offsets (*B, N) [m], by torch's random numbers."""
    noise = torch.randn((*offset.shape, 4), dtype=torch.float64)
    clutter = torch.rand((*offset.shape, 3), dtype=torch.float64) - 0.5  # which, where across, where to
    clutter[..., 0] += 0.5
    is_clutter = clutter[..., 0] < model.clutter
    aside = torch.where(
        is_clutter, clutter[..., 1] * model.clutter_width, torch.from_numpy(evidence.spread) * noise[..., 0]
    )
    root = torch.linalg.cholesky(torch.from_numpy(evidence.covariance))
    blur = (root @ noise[..., 1:3, None])[..., 0]
    measured = np.isfinite(evidence.flow_spread)
    flow_std = torch.from_numpy(np.hypot(np.where(measured, evidence.flow_spread, 0.0), evidence.flow_std))
    away = torch.where(is_clutter, clutter[..., 2] * 2.0 * math.pi, flow_std * noise[..., 3])
    if model.lane_changes > 0:
        group, more = torch.from_numpy(evidence.group), torch.randn((*offset.shape, 2), dtype=torch.float64)
        chance = torch.rand((*offset.shape[:-1], len(evidence.names)), dtype=torch.float64)[..., group]
        leaves = torch.from_numpy(evidence.moves) & (chance < model.lane_changes)
        spread, there = torch.from_numpy(evidence.spread), (model.change_std, model.change_turn)
        aside = torch.where(leaves, spread * noise[..., 0] + there[0] * more[..., 0], aside)
        away = torch.where(leaves, flow_std * noise[..., 3] + there[1] * more[..., 1], away)
    direction = points.heading + torch.from_numpy(evidence.turn) + away
    x = points.x - torch.sin(points.heading) * (offset + aside) + blur[..., 0]
    y = points.y + torch.cos(points.heading) * (offset + aside) + blur[..., 1]
    return torch.stack([x, y, torch.where(torch.from_numpy(measured), direction, 0.0)], -1)


def kernel_settings(model: RoadCourse) -> tuple[int, bool]:
    """What the kernels read of a model: samples of a course, and whether as printed."""
    return model.num_samples, model.likelihood == "paper"


def cue_arrays(model: RoadCourse, evidence: RoadEvidence, cues: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """What the kernels read of cues (N, 3): rows (N, WIDTH) of models.road.cue_kernel, groups (N,)."""
    paper = model.likelihood == "paper"
    position = np.where(evidence.moves, model.beta_vehicle, model.beta_static) if paper else 1.0
    deviation = evidence.flow_spread if paper else np.hypot(evidence.flow_spread, evidence.flow_std)
    precision = (math.sqrt(model.beta_flow) if paper else 1.0) / deviation
    measured = precision > 0
    rows = np.zeros((len(cues), WIDTH))
    rows[:, :3] = cues
    rows[:, 3], rows[:, 4], rows[:, 5] = (evidence.covariance[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    rows[:, 6], rows[:, 7], rows[:, 8] = evidence.spread**2 / position, precision, evidence.turn
    rows[:, 9] = _log_constant(precision, measured)
    rows[:, 11] = math.inf
    if paper:
        return rows, evidence.group
    if model.clutter > 0:
        rows[:, 9] += math.log1p(-model.clutter)
        rows[:, 10] = model.clutter / model.clutter_width / np.where(measured, 2 * math.pi, 1.0)
    rows[:, 11], rows[:, 12] = model.prior.behind + model.reach, model.reach_std**2
    rows[:, 13], rows[:, 14] = model.lane_changes * evidence.moves, rows[:, 6] + model.change_std**2
    rows[:, 15] = 1.0 / np.hypot(deviation, model.change_turn)
    rows[:, 16] = _log_constant(rows[:, 15], measured)
    return rows, evidence.group


def _log_constant(precision: Floats, measured: NDArray[np.bool_]) -> Floats:
    """Logarithms of what normalises the normal densities of a cue, but for the variance across."""
    flow = np.where(measured, np.log(np.where(measured, precision, 1.0)) - 0.5 * math.log(2 * math.pi), 0.0)
    return np.asarray(flow - 0.5 * math.log(2 * math.pi))
