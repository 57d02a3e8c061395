"""A road that may split, or that another road may join: the wish at the end of [T17].

    num_courses in {1, 2}              is there a second course at all
    main   ~ N(0, prior of the road)   lateral and heading of its start, curvature there and its rate
    offset ~ N(prior of the kind)      as in RoadCourse, the same for both courses
    joins  ~ Bernoulli(joining)        does the second course end on the main one, or begin on it
    shared ~ U(least, most)            length of road that both share
    bend   ~ N(0, diag(bend_std, bend_rate_std)^2)   what the second one's curvature and rate have more where they part
    cues   ~ CuesAlongFork             each thing beside one of the courses, the other cues clutter

The main course is the one that the car is on. A split shares the road from its start on; a road that joins shares it to
its end, and is a split as one sees it who drives the other way: one geometry serves both (models.road.fork_kernel).
The two courses leave each other without a kink. With one course the numbers of the second keep their prior, and the
density of the cues is that of RoadCourse; the main course is given by the clothoid's own numbers here, its start is
`behind` metres behind the car and its length known, as neither can be seen.

The two are no set of slots: one is a clothoid throughout, the other only from where they part. Two roads that are both
nearly so can be named either way round, which is no factorial but two states; the move `swap` leads from one to the
other. Posts that stand in a row share their offset whichever course they follow, and the side of a cue is that of its
course. A second course that parts where cues no longer reach cannot be told from none, so that without one its
probability falls to that of such courses, not to zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.capability import Kernel, Move, Proposal, compiled
from models.clothoid import Clothoid, evaluate, hermite
from models.program import InputError, Latents, quiet_doubles, terms, total
from models.road import fork_kernel, fork_moves
from models.road.along_fork import CuesAlongFork, Fork, kernel_data, kernel_settings, packed
from models.road.course import RoadCourse
from models.road.cues import Cues
from models.road.evidence import ROAD_LABELS, RoadEvidence, offset_labels
from models.road.fork_kernel import COURSES, HEAD, JOINS, MAIN, SECOND_BEND, SECOND_RATE, SHARED

Floats = NDArray[np.float64]
USUAL = RoadCourse()
FIRST_SHARED, FIRST_BENDS = 12, 24  # forks that a start is the best of, of either kind


@dataclass(frozen=True)
class ForkedRoad:
    """What the road is as long as it is one, and what may part from it. All numbers of the second course are ours."""

    dimension: ClassVar[str] = "num_courses"

    road: RoadCourse = USUAL
    forking: float = 0.5  # probability of a second course
    joining: float = 0.5  # of joining, given a second course, rather than leaving
    least: float = 20.0  # of the road shared [m]
    most: float = 125.0
    bend_std: float = 1 / 150  # [1/m]
    bend_rate_std: float = 1 / 15000  # [1/m^2]
    share: float = 0.5  # of things that follow the second course

    def __post_init__(self) -> None:
        for name in ("forking", "joining", "share"):
            if not 0 < getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; give a probability between 0 and 1")
        for name in ("bend_std", "bend_rate_std"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name} must be finite and positive, but is {getattr(self, name)}")
        length, num = self.road.prior.length, self.road.num_samples
        edge = 2.0 * length / (num - 1)
        if not edge <= self.least < self.most <= length - edge:
            raise InputError(
                f"the road shared is {self.least} to {self.most} m long; of a course of {length} m with samples every "
                f"{edge / 2:.3g} m choose least < most in [{edge:.3g}, {length - edge:.3g}]"
            )

    def __call__(self, evidence: RoadEvidence) -> None:
        loc, std = torch.from_numpy(evidence.offset_loc), torch.from_numpy(evidence.offset_std)
        kinds = torch.tensor([0.0, 1.0 - self.forking, self.forking])
        main = pyro.sample("main", dist.Normal(torch.zeros(4), self.main_std).to_event(1))
        offset = pyro.sample("offset", dist.Normal(loc, std).to_event(1))
        num_courses = pyro.sample("num_courses", dist.Categorical(kinds))
        joins = pyro.sample("joins", dist.Categorical(torch.tensor([1.0 - self.joining, self.joining])))
        shared = pyro.sample("shared", dist.Uniform(self.least, self.most))
        bend = pyro.sample("bend", dist.Normal(torch.zeros(2), self.bends_std).to_event(1))
        fork = Fork(main, num_courses, joins, shared, bend)
        pyro.sample("cues", CuesAlongFork(self, evidence, fork, offset), obs=evidence.cues)

    @property
    def main_std(self) -> Tensor:
        """(4,) of the site `main`."""
        prior = self.road.prior
        stds = (prior.lateral_std, prior.heading_std, prior.curvature_std, prior.rate_std)
        return torch.tensor(stds, dtype=torch.float64)

    @property
    def bends_std(self) -> Tensor:
        """(2,) of the site `bend`."""
        return torch.tensor((self.bend_std, self.bend_rate_std), dtype=torch.float64)

    def prepare(self, cues: Cues) -> RoadEvidence:
        """Evidence of this model, as RoadCourse prepares it."""
        return self.road.prepare(cues)

    def labels(self, evidence: RoadEvidence) -> dict[str, tuple[str, ...]]:
        """What the numbers of each site are."""
        return {
            "main": ROAD_LABELS,
            "num_courses": ("number of courses",),
            "joins": ("joins (1) or leaves (0)",),
            "shared": ("road shared [m]",),
            "bend": ("curvature of the second against the main course [1/m]", "and its rate [1/m²]"),
            "offset": offset_labels(evidence),
        }

    def moves(self) -> tuple[Move, ...]:
        """The moves of models.road.fork_moves, batched; the compiled chain calls the same function."""
        chances = zip(fork_moves.NAMES, fork_moves.PROBABILITIES, strict=True)
        return tuple(
            Move(name, float(chance), fork_moves.NUM_UNIFORMS, partial(self._propose, kind))
            for kind, (name, chance) in enumerate(chances)
        )

    def _propose(self, kind: int, latents: Latents, u: Tensor) -> Proposal:
        z, numbers = pack(latents), np.ascontiguousarray(u.numpy())
        z_new, u_new, log_q = np.empty_like(z), np.empty_like(numbers), np.empty((len(z), 3))
        valid, step = np.empty(len(z), dtype=np.bool_), compiled(fork_moves.propose, "propose")
        floats, none = kernel_settings(self), np.zeros(1, dtype=np.int64)
        for b in range(len(z)):
            valid[b] = step(kind, z[b], numbers[b], floats, none, z_new[b], u_new[b], log_q[b])
        new = {n: torch.from_numpy(np.ascontiguousarray(v)) for n, v in unpack(z_new).items()}
        forward, backward, jacobian = torch.from_numpy(log_q).unbind(-1)
        return Proposal(new, torch.from_numpy(u_new), forward, backward, jacobian, torch.from_numpy(valid))

    def kernel(self, evidence: RoadEvidence) -> Kernel:
        """The same density and moves in machine code."""
        if evidence.cues is None:
            raise InputError("this evidence has no cues (they await simulation); give them before inference")
        floats, ints = kernel_data(self, evidence, evidence.cues.numpy())
        return Kernel(
            move_names=fork_moves.NAMES,
            probabilities=fork_moves.PROBABILITIES,
            num_uniforms=fork_moves.NUM_UNIFORMS,
            size=HEAD + len(evidence.names),
            floats=floats,
            ints=ints,
            cache_size=1,
            propose=compiled(fork_moves.propose, "propose"),
            evaluate=compiled(fork_kernel.evaluate, "evaluate"),
            commit=compiled(fork_kernel.commit, "commit"),
            pack=pack,
            unpack=unpack,
        )

    def start(self, evidence: RoadEvidence) -> dict[str, Any]:
        """The best of the one course that RoadCourse starts with, and of many forks of it."""
        found = self.road.start(evidence)
        start, end = (torch.from_numpy(v) for v in np.split(found["course"], 2))
        one = self._state(main_from(hermite(start, end), self.road.prior.behind), torch.from_numpy(found["offset"]))
        shared = torch.linspace(self.least, self.most, FIRST_SHARED, dtype=torch.float64)
        level = (torch.arange(FIRST_BENDS, dtype=torch.float64) + 0.5) / FIRST_BENDS
        bends = self.bend_std * torch.special.ndtri(level)
        grid = torch.cartesian_prod(torch.tensor([0.0, 1.0], dtype=torch.float64), shared, bends)
        states = {n: v.expand((1 + len(grid), *v.shape)).clone() for n, v in one.items()}
        states["num_courses"][1:] = 2
        states["joins"][1:] = grid[:, 0].long()
        states["shared"][1:], states["bend"][1:, 0] = grid[:, 1], grid[:, 2]
        split = terms(self, states, evidence)
        best = int((total(split.prior) + total(split.likelihood)).argmax())
        return {n: v[best].numpy() for n, v in states.items()}

    def _state(self, main: Tensor, offset: Tensor) -> Latents:
        """One course; the numbers of the second are the middle of their prior."""
        middle = torch.tensor(0.5 * (self.least + self.most), dtype=torch.float64)
        bend = torch.zeros(2, dtype=torch.float64)
        return {
            "main": main, "offset": offset, "num_courses": torch.tensor(1), "joins": torch.tensor(0),
            "shared": middle, "bend": bend,
        }  # fmt: skip


def main_from(road: Clothoid, behind: float) -> Tensor:
    """The site `main` (4,) of a clothoid that starts about `behind` metres behind the car: the same line from there."""
    with quiet_doubles():
        arc = (-behind - road.x) / torch.cos(road.heading)
        at = evaluate(road, arc[None])
        return torch.stack([at.y[0], at.heading[0], at.curvature[0], road.rate])


def pack(latents: dict[str, Any]) -> Floats:
    """{site: (B, *event)} to packed states (B, D)."""
    values = {n: torch.as_tensor(v) for n, v in latents.items()}
    return packed(Fork(*(values[name] for name in Fork._fields)), values["offset"])


def unpack(z: Floats) -> dict[str, NDArray[Any]]:
    """Packed states (*batch, D) to {site: (*batch, *event)}."""
    return {
        "main": z[..., MAIN:HEAD],
        "offset": z[..., HEAD:],
        "num_courses": z[..., COURSES].astype(np.int64),
        "joins": z[..., JOINS].astype(np.int64),
        "shared": z[..., SHARED],
        "bend": z[..., SECOND_BEND : SECOND_RATE + 1],
    }
