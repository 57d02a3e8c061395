"""A road of an unknown number of clothoids, one after the other, seen through cues that follow it.

Curvature runs evenly from its value at the start to those at the knots, and on from the last at a rate of its own:

    num_knots ~ Poisson(knots_mean), truncated at max_knots
    knot_k ~ U(0, length),  knot_curvature_k ~ N(0, curvature_std^2)           slots k < num_knots are active
    start ~ N((-behind, 0, 0), diag(behind_std, lateral_std, heading_std)^2)   x, y, heading
    curvature ~ N(0, curvature_std^2),  rate ~ N(0, rate_std^2)
    offset_g ~ N(mu_g, std_g^2),  cues ~ CuesAlongPieces

Without knots it is a clothoid with the prior and the likelihood of RoadCourse, but for its length, which is known: what
lies beyond goes on at the last rate. [T17] has one clothoid; the rest is ours. Curvatures have a prior, not changes of
their rate, so that a road with more knots bends no more sharply. Slots hold a set: they are exchangeable, inactive ones
keep values of their prior, and what is reported of a road is where it leads.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from models.capability import Kernel, Move, Proposal, compiled
from models.clothoid import Points
from models.clothoid_kernel import BEND, COLUMNS, HEADING, X, Y
from models.program import InputError, Latents
from models.road.along_road import cue_arrays, scatter
from models.road.course import RoadCourse
from models.road.cues import Cues
from models.road.evidence import COURSE_LABELS, RoadEvidence, offset_labels
from models.road.segment_data import best_start, bound_evidence, bound_nothing, log_counts
from models.road.segment_kernel import SHAPE, commit, cue_densities, evaluate, pack, samples_of, unpack
from models.road.segment_moves import NAMES, PROBABILITIES, propose

Floats = NDArray[np.float64]
USUAL_COURSE = RoadCourse()
FINE = 0.25  # between the samples that simulated cues stand beside [m]


@dataclass(frozen=True)
class SegmentedRoad:
    """Likelihood, kinds of cues and the prior of single clothoids are those of `course`; its length_std is not used."""

    dimension: ClassVar[str] = "num_knots"

    course: RoadCourse = USUAL_COURSE
    max_knots: int = 4
    knots_mean: float = 1.5  # before truncation; one in 100 m

    def __post_init__(self) -> None:
        if self.max_knots < 1:
            raise InputError(f"max_knots is {self.max_knots}; give 1 or more, or use RoadCourse for a single clothoid")
        if not 0 < self.knots_mean < math.inf:
            raise InputError(f"knots_mean must be finite and positive, but is {self.knots_mean}")

    def __call__(self, evidence: RoadEvidence) -> None:
        prior, size = self.course.prior, [self.max_knots]
        counts = torch.from_numpy(log_counts(self.max_knots, self.knots_mean))
        place = torch.tensor([-prior.behind, 0.0, 0.0])
        spread = torch.tensor([prior.behind_std, prior.lateral_std, prior.heading_std])
        bends = dist.Normal(0.0, prior.curvature_std)
        loc, std = torch.from_numpy(evidence.offset_loc), torch.from_numpy(evidence.offset_std)
        road = {
            "num_knots": pyro.sample("num_knots", dist.Categorical(logits=counts)),
            "start": pyro.sample("start", dist.Normal(place, spread).to_event(1)),
            "curvature": pyro.sample("curvature", bends),
            "rate": pyro.sample("rate", dist.Normal(0.0, prior.rate_std)),
            "knot": pyro.sample("knot", dist.Uniform(0.0, prior.length).expand(size).to_event(1)),
            "knot_curvature": pyro.sample("knot_curvature", bends.expand(size).to_event(1)),
            "offset": pyro.sample("offset", dist.Normal(loc, std).to_event(1)),
        }
        pyro.sample("cues", CuesAlongPieces(self, evidence, road), obs=evidence.cues)

    def prepare(self, cues: Cues) -> RoadEvidence:
        """Evidence of this model. Raises InputError for cues that no course can be computed from."""
        return self.course.prepare(cues)

    def labels(self, evidence: RoadEvidence) -> dict[str, tuple[str, ...]]:
        """What the numbers of each site are."""
        return {
            "num_knots": ("number of knots",),
            "start": COURSE_LABELS[:3],
            "curvature": ("start curvature [1/m]",),
            "rate": ("curvature rate past the last knot [1/m²]",),
            "offset": offset_labels(evidence),
        }

    def start(self, evidence: RoadEvidence) -> dict[str, Any]:
        """The most probable of the fits with 0, 1, .. max_knots knots at equal distances."""
        return unpack(best_start(self, evidence), self.max_knots)

    def moves(self) -> tuple[Move, ...]:
        """The moves of models.road.segment_moves as they are without cues, of the size of the prior: slow, where cues
        say much. Those of `kernel` are scaled to the posterior."""
        return batched_moves(self, None)

    def kernel(self, evidence: RoadEvidence) -> Kernel:
        """The density and the moves in machine code."""
        data = bound_evidence(self, evidence)
        return Kernel(
            move_names=NAMES,
            probabilities=np.array(PROBABILITIES),
            num_uniforms=num_uniforms(self),
            size=1 + len(evidence.offset_loc) + SHAPE + 2 * self.max_knots,
            floats=data.floats,
            ints=data.ints,
            cache_size=self.course.num_samples * COLUMNS,
            propose=compiled(propose, "propose"),
            evaluate=compiled(evaluate, "evaluate"),
            commit=compiled(commit, "commit"),
            pack=pack,
            unpack=partial(unpack, slots=self.max_knots),
        )


class CuesAlongPieces(TorchDistribution):
    """Cues (N, 3), rows (x, y, direction of motion), beside roads of pieces: {site: (*B, *event)}.

    The density of cues beside a course, models.road.cue_kernel, along another line. It has no gradient: torch refuses
    one, and engines take differences."""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.real, 2)

    def __init__(self, model: SegmentedRoad, evidence: RoadEvidence, road: Latents) -> None:
        self.model, self.evidence, self.road = model, evidence, road
        events = {name: 0 if name in ("num_knots", "curvature", "rate") else 1 for name in road}
        batch = torch.broadcast_shapes(*(value.shape[: value.dim() - events[name]] for name, value in road.items()))
        super().__init__(batch, torch.Size([len(evidence.group), 3]), validate_args=False)

    def _states(self, shape: tuple[int, ...]) -> Floats:
        """(*shape, size)."""
        states = pack({name: value.numpy() for name, value in self.road.items()})
        return np.ascontiguousarray(np.broadcast_to(states, (*shape, states.shape[-1])))

    def log_prob(self, value: Tensor) -> Tensor:
        seen = value.numpy()
        states = self._states(torch.broadcast_shapes(self.batch_shape, seen.shape[:-2]))
        shape, rows = states.shape[:-1], states.reshape(-1, states.shape[-1])
        heights, course = np.empty(len(rows)), self.model.course
        road = (len(self.evidence.offset_loc), self.model.max_knots, course.prior.length, course.num_samples)
        each = np.broadcast_to(seen, (*shape, *self.event_shape)).reshape(len(rows), *self.event_shape)
        for part in [slice(0, len(rows))] if seen.ndim == 2 else [slice(i, i + 1) for i in range(len(rows))]:
            cues = cue_arrays(course, self.evidence, each[part.start])
            cue_densities(rows[part], *road, course.likelihood == "paper", *cues, heights[part])  # type: ignore[call-arg]
        return torch.from_numpy(heights.reshape(shape))

    def sample(self, sample_shape: Any = ()) -> Tensor:
        arc, course = self.evidence.arc, self.model.course
        if arc is None:
            raise InputError("simulating cues needs to know where they stand: give the evidence arc lengths (arc)")
        if course.likelihood == "paper":
            raise InputError("the likelihood 'paper' is no density of positions, so it cannot simulate; choose 'exact'")
        shape, offset = (*sample_shape, *self.batch_shape), self.road["offset"]
        points = points_at(self._states(shape), offset.shape[-1], self.model.max_knots, arc)
        aside = offset.expand((*shape, offset.shape[-1]))[..., torch.from_numpy(self.evidence.group)]
        return scatter(points, aside, self.evidence, course)


def points_at(states: Floats, num_groups: int, slots: int, arc: Floats) -> Points:
    """Points (*B, N) at arc lengths (N,) [m]: from the nearest of fine samples on along its circle."""
    num = 1 + math.ceil(max(float(arc.max()), FINE) / FINE)
    nearest = np.clip(np.rint(arc / FINE), 0, num - 1).astype(np.int64)
    table = samples_of(states, num_groups, slots, (num - 1) * FINE, num)[..., nearest, :]
    on = arc - nearest * FINE
    middle = table[..., HEADING] + 0.5 * on * table[..., BEND]
    columns = (
        table[..., X] + on * np.cos(middle),
        table[..., Y] + on * np.sin(middle),
        table[..., HEADING] + on * table[..., BEND],
        table[..., BEND],
    )
    return Points(*(torch.from_numpy(np.ascontiguousarray(column)) for column in columns))


def num_uniforms(model: SegmentedRoad) -> int:
    """Numbers that a move reads, at most: one and those of the road."""
    return 1 + SHAPE + model.max_knots


def batched_moves(model: SegmentedRoad, evidence: RoadEvidence | None) -> tuple[Move, ...]:
    """The compiled involutions as moves over batches of latents, scaled by the evidence, if any."""

    @functools.lru_cache
    def data(num_groups: int) -> Any:
        return bound_nothing(model, num_groups) if evidence is None else bound_evidence(model, evidence)

    def involution(kind: int, latents: Latents, u: Tensor) -> Proposal:
        z = pack({name: value.numpy() for name, value in latents.items()})
        z_new, u_new, log_q = np.empty_like(z), np.empty(u.shape), np.empty((len(z), 3))
        valid, numbers = np.empty(len(z), dtype=np.bool_), np.ascontiguousarray(u.numpy())
        step, (floats, ints) = compiled(propose, "propose"), data(latents["offset"].shape[-1])
        for b in range(len(z)):
            valid[b] = step(kind, z[b], numbers[b], floats, ints, z_new[b], u_new[b], log_q[b])
        new = {name: torch.from_numpy(np.asarray(value)) for name, value in unpack(z_new, model.max_knots).items()}
        forward, backward, jacobian = torch.from_numpy(log_q).unbind(-1)
        return Proposal(new, torch.from_numpy(u_new), forward, backward, jacobian, torch.from_numpy(valid))

    return tuple(
        Move(name, share, num_uniforms(model), partial(involution, kind))
        for kind, (name, share) in enumerate(zip(NAMES, PROBABILITIES, strict=True))
    )
