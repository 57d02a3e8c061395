"""The course of a road over the frames of a drive: a clothoid that is carried along while the road unrolls.

State of a frame: `road`, the clothoid (y, heading, curvature k, rate r) at x = -behind in the car's present frame, and
`offset`, o of the groups of cues; `course` is road once more in the numbers of models.road.course.

    first      the prior of models.road.prior at the start of the clothoid, and those of the offsets
    carried    by the car's motion T from frame to frame: the point of the clothoid where T (clothoid) has x = -behind
                   y, heading <- those there, + N(0, J P J' + ds diag(slip)^2)
               P the drift of the inertial unit over the frame (models.road.ego), J the slope of (y, heading) in it,
               slip what a clothoid leaves out, and in heading what a bias of the unit that lasts adds
    unrolled   roads are pieces of clothoids; one of mean length `piece` ends, and another rate begins, anywhere. The
               first two moments of that are those of
                   dk = r ds,   dr = -(k / length^2 + r / piece) ds + rate_std sqrt(2 / piece) dW
               whose stationary law is the prior again, with length = curvature_std / rate_std: bends without end. A
               step over ds is  (k, r) <- F (k, r) + N(0, S - F S F'),   F = exp(A ds),   S = diag(variances of k, r)
    offsets    o <- mean + c (o - mean) + N(0, (1 - c^2) std^2), with c = e^(-ds / row) of what stands, a row that keeps
               its distance for about so long, and e^(-seconds / keeping) of vehicles, each in its lane
    cues       of this frame only, as in models.road.course (`course`: likelihood, clutter, kinds)

Before any cue, every frame has the prior of the first but for y and heading, which the car's own motion leads away.
A bias of the inertial unit is drawn anew for each frame; it lasts longer in truth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray
from pyro.distributions import TorchDistribution
from scipy.linalg import block_diag, expm
from torch import Tensor
from torch.distributions import constraints

from models.capability import GaussianStep, State
from models.clothoid import Clothoid, evaluate
from models.compiled_density import compiled_log_prob
from models.program import InputError
from models.road.along_road import cue_arrays, scatter
from models.road.course import RoadCourse
from models.road.drive import RoadDrive, RoadFrame, road_frames
from models.road.ego import Drift
from models.road.evidence import COURSE_LABELS, ROAD_LABELS, RoadEvidence, offset_labels
from models.road.frame_kernel import ROAD, frame_densities, frame_slopes
from models.unroll import unroll

Floats = NDArray[np.float64]
USUAL_COURSE, USUAL_DRIFT = RoadCourse(), Drift()
CARRY_STEPS = 3  # of Newton: the first is off by the square of the turn over a frame
STEEPEST = 0.2  # cosine of a heading; a road that turns back is not carried along


class Moved(NamedTuple):
    """Where a state moves: means (*B, 4 + G) of road and offsets, Cholesky factor (4, 4) of the road's noise, standard
    deviations (G,) of the offsets'."""

    mean: Tensor
    tril: Floats
    std: Floats


@dataclass(frozen=True)
class RoadFrames:
    """How the road is seen, and how it unrolls."""

    course: RoadCourse = USUAL_COURSE
    drift: Drift = USUAL_DRIFT
    piece: float = 300.0  # of road with one rate of curvature, about [m]
    row: float = 2000.0  # over which a row of static cues keeps its offset [m]
    keeping: float = 30.0  # for which a vehicle keeps its place in the lane [s]
    slip: float = 0.01  # of the road aside from its clothoid [m / sqrt(m)]
    slip_heading: float = 1e-3  # [rad / sqrt(m)]

    def __post_init__(self) -> None:
        for field in fields(self)[2:]:
            value = getattr(self, field.name)
            if not math.isfinite(value) or value <= 0:
                raise InputError(f"{field.name} must be finite and positive, but is {value}")

    def __call__(self, frames: Sequence[RoadFrame]) -> None:
        unroll(self)(frames)

    def prepare(self, drive: RoadDrive) -> tuple[RoadFrame, ...]:
        """The frames of a drive; see models.road.drive for what raises."""
        return road_frames(drive, self.course, self.drift)

    def labels(self, frames: Sequence[RoadFrame]) -> dict[str, tuple[str, ...]]:
        """What the numbers of each frame's state are."""
        own = {"road": ROAD_LABELS, "offset": offset_labels(frames[0].evidence), "course": COURSE_LABELS}
        return {
            site: tuple(f"frame {t}: {n}" for t in range(len(frames)) for n in names) for site, names in own.items()
        }

    def initial(self, frame: RoadFrame) -> State:
        return self._sample(self._first(frame))

    def transition(self, state: State, frame: RoadFrame) -> State:
        return self._sample(self._next(state, frame))

    def observe(self, state: State, frame: RoadFrame) -> None:
        if len(frame.evidence.group):
            pyro.sample("cues", CuesAlongClothoid(self, frame.evidence, state["road"], state["offset"]), obs=frame.cues)

    def gaussian_step(self, state: State | None, frame: RoadFrame) -> GaussianStep:
        """The same, packed: z = (road, offset)."""
        mean, road_tril, std = self._first(frame) if state is None else self._next(state, frame)
        if frame.cues is None:
            raise InputError("a frame has no cues (they await simulation); give them before inference")
        arguments = self.arguments(frame.evidence, frame.cues.numpy())

        def density(z: Floats) -> Floats:
            out = np.empty(len(z))
            frame_densities(np.ascontiguousarray(z), *arguments, out)  # type: ignore[call-arg]
            return out

        def slopes(z: Floats) -> tuple[float, Floats, Floats]:
            height, slope, information = np.empty(1), np.empty((1, len(z))), np.empty((1, len(z), len(z)))
            frame_slopes(np.ascontiguousarray(z[None]), *arguments, height, slope, information)  # type: ignore[call-arg]
            return float(height[0]), slope[0], information[0]

        def unpack(z: Floats) -> State:
            return self._state(torch.from_numpy(z[:, :ROAD].copy()), torch.from_numpy(z[:, ROAD:].copy()))

        tril = block_diag(road_tril, np.diag(std))
        return GaussianStep(np.atleast_2d(mean.numpy()), tril, density, slopes, unpack)

    def arguments(self, evidence: RoadEvidence, cues: Floats) -> tuple[Any, ...]:
        """What the kernels read besides the numbers, for cues (N, 3)."""
        course, rows = self.course, cue_arrays(self.course, evidence, cues)
        prior = course.prior
        return -prior.behind, prior.length, course.num_samples, course.likelihood == "paper", *rows

    def clothoid(self, road: Tensor) -> Clothoid:
        """The clothoids of roads (*B, 4)."""
        y, heading, curvature, rate = road.unbind(-1)
        prior = self.course.prior
        return Clothoid(
            torch.full_like(y, -prior.behind), y, heading, curvature, rate, torch.full_like(y, prior.length)
        )

    def _sample(self, moved: Moved) -> State:
        mean, road_tril, std = moved
        road = pyro.sample("road", dist.MultivariateNormal(mean[..., :ROAD], scale_tril=torch.from_numpy(road_tril)))
        offset = pyro.sample("offset", dist.Normal(mean[..., ROAD:], torch.from_numpy(std)).to_event(1))
        return self._state(road, offset)

    def _state(self, road: Tensor, offset: Tensor) -> State:
        """The state with its `course` (*B, 6), C = (x, y, heading) of start and end as RoadCourse has it."""
        clothoid = self.clothoid(road)
        arc = torch.stack([torch.zeros_like(clothoid.length), clothoid.length], -1)
        course = torch.stack(evaluate(clothoid, arc)[:3], -1).flatten(-2)
        return {"road": road, "offset": offset, "course": course}

    def _first(self, frame: RoadFrame) -> Moved:
        prior, evidence = self.course.prior, frame.evidence
        std = [prior.lateral_std, prior.heading_std, prior.curvature_std, prior.rate_std]
        mean = torch.from_numpy(np.r_[np.zeros(ROAD), evidence.offset_loc])
        return Moved(mean, np.diag(std), evidence.offset_std)

    def _next(self, state: State, frame: RoadFrame) -> Moved:
        prior, evidence, ds = self.course.prior, frame.evidence, float(np.hypot(*frame.pose[:2]))
        stationary = np.diag([prior.curvature_std, prior.rate_std]) ** 2
        pull = (prior.rate_std / prior.curvature_std) ** 2
        F = expm(ds * np.array([[0.0, 1.0], [-pull, -1.0 / self.piece]]))
        J = np.array([[0.0, 1.0, -prior.behind - frame.pose[0]], [0.0, 0.0, 1.0]])
        start = J @ frame.drift @ J.T + max(ds, 1e-3) * np.diag([self.slip, self.slip_heading]) ** 2
        bend = stationary - F @ stationary @ F.T + 1e-9 * stationary
        place = self._carried(state["road"], frame)
        turned = state["road"][..., 2:] @ torch.from_numpy(F.T.copy())
        keep = np.where(frame.moves, math.exp(-frame.seconds / self.keeping), math.exp(-ds / self.row))
        loc = torch.from_numpy(evidence.offset_loc)
        offset = loc + torch.from_numpy(keep) * (state["offset"] - loc)
        tril = np.linalg.cholesky(block_diag(start, bend))
        return Moved(torch.cat([place, turned, offset], -1), tril, evidence.offset_std * np.sqrt(1.0 - keep**2 + 1e-9))

    def _carried(self, road: Tensor, frame: RoadFrame) -> Tensor:
        """y and heading (*B, 2) at x = -behind of the clothoid as it is seen from now."""
        before, (x, y, turn) = self.clothoid(road), frame.pose.tolist()
        cos, sin, begin = math.cos(turn), math.sin(turn), before.x
        seen = before._replace(
            x=x + cos * begin - sin * before.y, y=y + sin * begin + cos * before.y, heading=before.heading + turn
        )
        arc = torch.zeros_like(begin)
        for _ in range(CARRY_STEPS):
            at = evaluate(seen, arc[..., None])
            arc = arc + (begin - at.x[..., 0]) / torch.cos(at.heading[..., 0]).clamp(min=STEEPEST)
        at = evaluate(seen, arc[..., None])
        return torch.cat([at.y, at.heading], -1)


class CuesAlongClothoid(TorchDistribution):
    """Cues (N, 3), rows (x, y, direction of motion), beside clothoids (*B, 4) at offsets (*B, G)."""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.real, 2)

    def __init__(self, model: RoadFrames, evidence: RoadEvidence, road: Tensor, offset: Tensor) -> None:
        self.model, self.evidence = model, evidence
        batch = torch.broadcast_shapes(road.shape[:-1], offset.shape[:-1])
        self.road, self.offset = road.expand((*batch, ROAD)), offset.expand((*batch, offset.shape[-1]))
        super().__init__(batch, torch.Size([len(evidence.group), 3]), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        numbers = torch.cat([self.road, self.offset], -1)
        value = value.expand((*self.batch_shape, *self.event_shape))
        return compiled_log_prob(numbers, value, self._evaluate)

    def _evaluate(self, numbers: Floats, cues: Floats) -> tuple[Floats, Floats]:
        height, slope, empty = np.empty(len(numbers)), np.empty_like(numbers), np.empty((0, 0, 0))
        frame_slopes(numbers, *self.model.arguments(self.evidence, cues), height, slope, empty)  # type: ignore[call-arg]
        return height, slope

    def sample(self, sample_shape: Any = ()) -> Tensor:
        if self.evidence.arc is None:
            raise InputError("simulating cues needs to know where they stand: give the evidence arc lengths (arc)")
        if self.model.course.likelihood == "paper":
            raise InputError("the likelihood 'paper' is no density of positions, so it cannot simulate; choose 'exact'")
        shape = (*sample_shape, *self.batch_shape)
        road, offset = self.road.expand((*shape, ROAD)), self.offset.expand((*shape, self.offset.shape[-1]))
        points = evaluate(self.model.clothoid(road), torch.from_numpy(self.evidence.arc).expand(*shape, -1))
        return scatter(points, offset[..., torch.from_numpy(self.evidence.group)], self.evidence, self.model.course)
