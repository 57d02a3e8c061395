"""What the compiled functions of a road of pieces read: the prior, the cues and a reference road.

Fits given the knots (models.road.segment_moves) begin at a road that the cues lie along and that has more pieces than
needed. It begins itself at RoadCourse's start, so that no row of cues is taken for another, and bends as the fog lifts,
as there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from models.capability import compiled
from models.clothoid import hermite, sample
from models.clothoid_kernel import COLUMNS
from models.program import InputError
from models.road.along_road import cue_arrays
from models.road.cue_kernel import SPREADS, WIDTH
from models.road.evidence import RoadEvidence
from models.road.segment_kernel import SHAPE, evaluate, samples_of
from models.road.segment_moves import improve

if TYPE_CHECKING:
    from models.road.segments import SegmentedRoad

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

REFERENCE_KNOTS = 6
FOGS = (3.0, 1.0, 0.4, 0.0, 0.0)  # spread added to that of the cues while the reference road is found [m]


class Bound(NamedTuple):
    """Numbers and whole numbers, laid out as models.road.segment_kernel says."""

    floats: Floats
    ints: Ints


class Reference(NamedTuple):
    """A road that fits begin at: offsets (G,) [m], samples (num, 7) of the road, and the step between them [m]."""

    offset: Floats
    table: Floats
    step: float


def log_counts(slots: int, mean: float) -> Floats:
    """Log probabilities (slots + 1,) of a truncated Poisson."""
    counts = np.arange(slots + 1.0)
    shares = counts * math.log(mean) - np.array([math.lgamma(count + 1.0) for count in counts])
    return np.asarray(shares - np.logaddexp.reduce(shares))


def linear_prior(model: SegmentedRoad, offset: tuple[Floats, Floats], slots: int) -> tuple[Floats, Floats]:
    """Mean and standard deviation (G + 5 + K,) of the linear numbers, given those of the offsets."""
    prior = model.course.prior
    loc = [-prior.behind, *np.zeros(SHAPE - 1 + slots)]
    std = [prior.behind_std, prior.lateral_std, prior.heading_std, prior.curvature_std, prior.rate_std]
    return np.r_[offset[0], loc], np.r_[offset[1], std, np.full(slots, prior.curvature_std)]


def even_state(model: SegmentedRoad, offset: Floats, num: int, slots: int) -> Floats:
    """The prior's mean with `num` of `slots` knots active, at equal distances; the others are in the middle."""
    place = np.full(slots, 0.5)
    place[:num] = np.arange(1, num + 1) / (num + 1.0)
    return np.r_[num, linear_prior(model, (offset, offset), slots)[0], model.course.prior.length * place]


def bound(
    model: SegmentedRoad, offset: tuple[Floats, Floats], slots: int, cues: Floats, group: Ints, reference: Reference
) -> Bound:
    """Everything in two rows. offset is the prior mean and standard deviation (G,) of the offsets."""
    counts, paper = log_counts(slots, model.knots_mean), model.course.likelihood == "paper"
    parts = (counts, *linear_prior(model, offset, slots), *reference[:2], cues)
    floats = np.concatenate([[model.course.prior.length, reference.step], *(part.ravel() for part in parts)])
    whole = [slots, len(offset[0]), len(reference.table), len(cues), paper]
    return Bound(floats, np.concatenate([whole, group]).astype(np.int64))


def bound_evidence(model: SegmentedRoad, evidence: RoadEvidence) -> Bound:
    """Prior, cues, and the reference road that they lie along. Raises InputError for evidence without cues."""
    if evidence.cues is None:
        raise InputError("this evidence has no cues (they await simulation); give them before inference")
    cues, group = cue_arrays(model.course, evidence, evidence.cues.numpy())
    sharp, prior = cues[:, SPREADS].copy(), (evidence.offset_loc, evidence.offset_std)
    at, z = first_road(model, evidence), even_state(model, prior[0], REFERENCE_KNOTS, REFERENCE_KNOTS)
    for fog in FOGS:
        cues[:, SPREADS] = sharp + fog**2
        if not improve(z, *bound(model, prior, REFERENCE_KNOTS, cues, group, at)):  # type: ignore[call-arg]
            raise FloatingPointError("the reference road of this evidence is not finite; check the cues' covariances")
        at = laid(model, z, len(prior[0]), REFERENCE_KNOTS)
    return bound(model, prior, model.max_knots, cues, group, at)


def bound_nothing(model: SegmentedRoad, num_groups: int) -> Bound:
    """No cues: offsets are taken for standard normal, which they need not be, and the reference road is straight."""
    prior = (np.zeros(num_groups), np.ones(num_groups))
    reference = laid(model, even_state(model, prior[0], 0, model.max_knots), num_groups, model.max_knots)
    return bound(model, prior, model.max_knots, np.empty((0, WIDTH)), np.empty(0, np.int64), reference)


def laid(model: SegmentedRoad, z: Floats, num_groups: int, slots: int) -> Reference:
    """The road and the offsets of a state."""
    length, num = model.course.prior.length, model.course.num_samples
    return Reference(z[1 : 1 + num_groups].copy(), samples_of(z, num_groups, slots, length, num), length / (num - 1))


def first_road(model: SegmentedRoad, evidence: RoadEvidence) -> Reference:
    """RoadCourse's start."""
    found = {site: np.asarray(value, dtype=np.float64) for site, value in model.course.start(evidence).items()}
    start, end = (torch.from_numpy(part) for part in np.split(found["course"], 2))
    road, num = hermite(start, end), model.course.num_samples
    x, y, heading, curvature = (column.numpy() for column in sample(road, num))
    arc = np.linspace(0.0, float(road.length), num)
    table = np.column_stack([x, y, heading, np.cos(heading), np.sin(heading), curvature, arc])
    return Reference(found["offset"], table, float(road.length) / (num - 1))


def best_start(model: SegmentedRoad, evidence: RoadEvidence) -> Floats:
    """The most probable of the fits with 0, 1, .. max_knots knots at equal distances."""
    floats, ints = bound_evidence(model, evidence)
    best, height = even_state(model, evidence.offset_loc, 0, model.max_knots), -math.inf
    room, out = np.empty(model.course.num_samples * COLUMNS), np.empty(2)
    for num in range(model.max_knots + 1):
        z = even_state(model, evidence.offset_loc, num, model.max_knots)
        if improve(z, floats, ints):
            compiled(evaluate, "evaluate")(z, floats, ints, room, out)
            if out.sum() > height:
                best, height = z, float(out.sum())
    return best
