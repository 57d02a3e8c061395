"""The distribution of cues along a road that may fork or join another: it simulates them, and scores them.

Things are what is detected: a static cue is one, all detections of a vehicle are one. Each follows one of the courses,
which one is unknown and summed out,

    p(cues) = prod_things sum_c share_c p(cues of the thing | course c, offset)

with the density of models.road.cue_kernel, clutter and changes of lanes included. Where both courses run together it
makes no difference which one a cue follows, and with one course this is models.road.along_road.

There are no derivatives: engines that need some take differences.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from models.clothoid import Clothoid, Points, evaluate
from models.clothoid_kernel import COLUMNS
from models.program import InputError
from models.road.along_road import cue_arrays, scatter
from models.road.evidence import RoadEvidence
from models.road.fork_kernel import lay_courses, log_likelihoods

if TYPE_CHECKING:
    from models.road.fork import ForkedRoad

Floats = NDArray[np.float64]


class Fork(NamedTuple):
    """One or two courses, batched.

    main         (*B, 4) lateral [m] and heading [rad] of the start, curvature there [1/m], its rate [1/m^2]
    num_courses  (*B) 1 or 2
    joins        (*B) 1 where the second course ends on the first, 0 where it begins on it
    shared       (*B) length of what both share [m]
    bend         (*B, 2) what the second one's curvature [1/m] and rate [1/m^2] have more where they part, seen from
                 the shared part
    """

    main: Tensor
    num_courses: Tensor
    joins: Tensor
    shared: Tensor
    bend: Tensor


class CuesAlongFork(TorchDistribution):
    """Cues (N, 3), rows (x, y, direction of motion), beside one or two courses at offsets (*B, G)."""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.real, 2)

    def __init__(self, model: ForkedRoad, evidence: RoadEvidence, fork: Fork, offset: Tensor) -> None:
        self.model, self.evidence = model, evidence
        scalars = (fork.num_courses, fork.joins, fork.shared)
        rows = (fork.main, fork.bend, offset)
        batch = torch.broadcast_shapes(*(v.shape for v in scalars), *(v.shape[:-1] for v in rows))
        main, bend, self.offset = (v.expand((*batch, v.shape[-1])) for v in rows)
        num_courses, joins, shared = (v.expand(batch) for v in scalars)
        self.fork = Fork(main, num_courses, joins, shared, bend)
        super().__init__(batch, torch.Size([len(evidence.group), 3]), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        z = packed(self.fork, self.offset)
        seen = value.expand((*self.batch_shape, *self.event_shape)).reshape(len(z), -1, 3).numpy()
        parts = [slice(None)] if value.dim() == 2 else [slice(i, i + 1) for i in range(len(z))]
        out, none = np.empty(len(z)), np.empty((len(z), 0))
        for part in parts:
            data = kernel_data(self.model, self.evidence, seen[part][0])
            log_likelihoods(z[part], *data, none[part], out[part])  # type: ignore[call-arg]
        return torch.from_numpy(out).reshape(self.batch_shape)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        if self.evidence.arc is None:
            raise InputError("simulating cues needs to know where they stand: give the evidence arc lengths (arc)")
        if self.model.road.likelihood == "paper":
            raise InputError("the likelihood 'paper' is no density of positions, so it cannot simulate; choose 'exact'")
        shape, (things, num) = (*sample_shape, *self.batch_shape), things_of(self.evidence)
        follows = torch.rand((*shape, num)) < self.model.share
        which = follows[..., torch.from_numpy(things)]  # (*B, N)
        first, second = both_courses(self.model, self.fork, torch.from_numpy(self.evidence.arc))
        points = Points(*(torch.where(which, b, a) for a, b in zip(first, second, strict=True)))
        offset = self.offset.expand((*shape, self.offset.shape[-1]))[..., torch.from_numpy(self.evidence.group)]
        return scatter(points, offset, self.evidence, self.model.road)


def things_of(evidence: RoadEvidence) -> tuple[NDArray[np.int64], int]:
    """Which thing (N,) each cue is a detection of, and how many things there are."""
    own = np.where(evidence.moves, evidence.group, len(evidence.names) + np.arange(len(evidence.group)))
    kinds, thing = np.unique(own, return_inverse=True)
    return thing.astype(np.int64), len(kinds)


def packed(fork: Fork, offset: Tensor) -> Floats:
    """States as models.road.fork_kernel packs them, (S, D)."""
    scalars = torch.stack([v.double() for v in (fork.num_courses, fork.joins, fork.shared)], -1)
    z = torch.cat([scalars, fork.bend, fork.main, offset], -1)
    return z.reshape(-1, z.shape[-1]).contiguous().numpy()


def kernel_settings(model: ForkedRoad) -> Floats:
    """What the kernel reads of the model."""
    prior, stds = model.road.prior, (*model.bends_std.tolist(), model.forking, model.joining, model.share)
    return np.array([prior.behind, prior.length, model.least, model.most, *stds, *model.main_std.tolist()])


def kernel_data(model: ForkedRoad, evidence: RoadEvidence, cues: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """What the kernel reads of the model and its cues (N, 3): floats and ints."""
    rows, group = cue_arrays(model.road, evidence, cues)
    thing, num = things_of(evidence)
    offsets = (evidence.offset_loc, evidence.offset_std)
    counts = [len(evidence.names), len(group), model.road.num_samples, model.road.likelihood == "paper", num]
    floats = np.concatenate([kernel_settings(model), *offsets, rows.ravel()])
    return floats, np.concatenate([counts, group, thing]).astype(np.int64)


def sampled_courses(model: ForkedRoad, fork: Fork) -> tuple[Floats, Floats]:
    """Samples of both courses, (S, num, 7) each, columns as in models.clothoid_kernel. The second means nothing
    where there is none."""
    z = packed(fork, fork.main[..., :0])
    first, second = np.empty((2, len(z), model.road.num_samples, COLUMNS))
    lay_courses(z, kernel_settings(model), first, second)  # type: ignore[call-arg]
    return first, second


def log_odds_of_second(model: ForkedRoad, evidence: RoadEvidence, fork: Fork, offset: Tensor) -> Floats:
    """Log odds (S, N) that each cue follows the second course, of forks with two."""
    if evidence.cues is None:
        raise InputError("this evidence has no cues (they await simulation); give them before inference")
    z, (thing, num) = packed(fork, offset), things_of(evidence)
    odds = np.empty((len(z), num))
    data = kernel_data(model, evidence, evidence.cues.numpy())
    log_likelihoods(z, *data, odds, np.empty(len(z)))  # type: ignore[call-arg]
    return odds[:, thing]


def both_courses(model: ForkedRoad, fork: Fork, arc: Tensor) -> tuple[Points, Points]:
    """Points (*B, N) of both courses at arc lengths (N,) along the first; they are the same where there is one only.

    Beyond the place where they part, the second is as far from it as the arc length says."""
    length, arc = model.road.prior.length, arc.expand(*fork.shared.shape, -1)
    zero = torch.zeros_like(fork.shared)
    lateral, heading, curvature, rate = fork.main.unbind(-1)
    main = Clothoid(zero - model.road.prior.behind, lateral, heading, curvature, rate, zero + length)
    joins, shared = fork.joins.double(), fork.shared
    place = torch.where(joins > 0.0, length - shared, shared)
    sign = 1.0 - 2.0 * joins  # of the way from the shared part on
    at = Points(*(v[..., 0] for v in evaluate(main, place[..., None])))
    there = Clothoid(
        at.x,
        at.y,
        at.heading + math.pi * joins,
        sign * at.curvature + fork.bend[..., 0],
        main.rate + fork.bend[..., 1],
        length - shared,
    )
    way = sign[..., None] * (arc - place[..., None])
    branch = evaluate(there, way)
    branch = branch._replace(
        heading=branch.heading - math.pi * joins[..., None], curvature=sign[..., None] * branch.curvature
    )
    parted = (way > 0.0) & (fork.num_courses == 2)[..., None]
    first = evaluate(main, arc)
    return first, Points(*(torch.where(parted, b, a) for a, b in zip(first, branch, strict=True)))
