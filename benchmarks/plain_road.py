"""The road course as people write it for Pyro alone, in torch and without machine code: what its inference is timed on.

The density is that of models.road.course.RoadCourse, likelihood `exact`, cue by cue as in models.road.cue_kernel; the
tests hold both equal. Every cue is scored about the nearest of all samples of the course, found without gradients."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from models.clothoid import hermite_or_inf, sample, wrap_angle
from models.road.course import RoadCourse
from models.road.evidence import RoadEvidence
from models.road.kernel import NO_ROAD
from models.road.prior import course_moments

LOG_ROOT = 0.5 * math.log(2.0 * math.pi)


@dataclass(frozen=True)
class PlainRoad:
    """`road` as a Pyro program of torch alone."""

    road: RoadCourse

    def __call__(self, evidence: RoadEvidence) -> None:
        mean, tril = (torch.from_numpy(v) for v in course_moments(self.road.prior))
        loc, std = torch.from_numpy(evidence.offset_loc), torch.from_numpy(evidence.offset_std)
        course = pyro.sample("course", dist.MultivariateNormal(mean, scale_tril=tril))
        offset = pyro.sample("offset", dist.Normal(loc, std).to_event(1))
        pyro.sample("cues", PlainCues(self.road, evidence, course, offset), obs=evidence.cues)


class PlainCues(TorchDistribution):
    """Cues (N, 3) beside courses (*B, 6) at offsets (*B, G): their density alone."""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.real, 2)

    def __init__(self, road: RoadCourse, evidence: RoadEvidence, course: Tensor, offset: Tensor) -> None:
        self.road, self.evidence, self.course, self.offset = road, evidence, course, offset
        batch = torch.broadcast_shapes(course.shape[:-1], offset.shape[:-1])
        super().__init__(batch, torch.Size([len(evidence.group), 3]), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        road, seen = self.road, self.evidence
        group = torch.from_numpy(seen.group)
        spread, covariance = torch.from_numpy(seen.spread) ** 2, torch.from_numpy(seen.covariance)
        xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
        measured = torch.from_numpy(np.isfinite(seen.flow_spread))
        flow_std = torch.where(measured, torch.from_numpy(np.hypot(seen.flow_spread, seen.flow_std)), 1.0)
        line = hermite_or_inf(self.course[..., :3], self.course[..., 3:])
        there = line.length < torch.inf
        line = line._replace(length=torch.where(there, line.length, road.prior.length))
        points = sample(line, road.num_samples)
        px, py, flow = value.unbind(-1)
        with torch.no_grad():
            gap = torch.cdist(value[..., :2], torch.stack((points.x, points.y), -1))  # (*B, N, num)
            nearest = gap.argmin(-1)
        x, y, heading, bend = (v.gather(-1, nearest) for v in points)  # (*B, N)
        arc = nearest * (line.length / (road.num_samples - 1))[..., None]
        cos, sin = torch.cos(heading), torch.sin(heading)
        dx, dy = px - x, py - y
        along, across = dx * cos + dy * sin, dy * cos - dx * sin
        q = bend * along
        mx, my = -sin - cos * q, cos - sin * q  # normal at the foot, times the root of 1 + q^2
        norm = 1.0 / (1.0 + q * q)
        sx, sy = xx * mx + xy * my, xy * mx + yy * my
        blur = norm * (mx * sx + my * sy)  # m' Sigma m
        skew = norm * (my * sx - mx * sy)  # t' Sigma m
        lateral = across - 0.5 * q * along - self.offset[..., group]
        turn = wrap_angle(flow - heading - q - torch.from_numpy(seen.turn))

        def follows(more: float, turned: float) -> Tensor:
            variance, direction = spread + more**2 + blur, torch.hypot(flow_std, torch.tensor(turned))
            slant = skew / variance
            std = (road.reach_std**2 + xx + yy - blur - slant * skew).sqrt()
            sight = (road.prior.behind + road.reach - arc - along + slant * lateral) / std
            place = -0.5 * (lateral * lateral / variance + variance.log()) - LOG_ROOT
            motion = torch.where(measured, -0.5 * (turn / direction) ** 2 - direction.log() - LOG_ROOT, 0.0)
            return place + motion + torch.special.log_ndtr(sight)

        stray = math.log(road.clutter / road.clutter_width) - measured * math.log(2.0 * math.pi)
        stays = torch.logaddexp(math.log1p(-road.clutter) + follows(0.0, 0.0), stray)
        leaves = follows(road.change_std, road.change_turn)
        member = torch.nn.functional.one_hot(group, len(seen.names)).double()  # (N, G)
        stays, leaves = stays @ member, leaves @ member
        swerves = torch.logaddexp(math.log1p(-road.lane_changes) + stays, math.log(road.lane_changes) + leaves)
        moves = torch.from_numpy(seen.moves).double() @ member > 0.0
        return torch.where(there, torch.where(moves, swerves, stays).sum(-1), NO_ROAD * len(seen.names))
