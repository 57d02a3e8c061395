"""A drive as the evidence of models.road.frames: the cues of each frame, and how the car moved from frame to frame."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from models.program import InputError
from models.road.course import RoadCourse
from models.road.cues import Cues
from models.road.ego import Drift, Motion, integrate
from models.road.evidence import RoadEvidence

Floats = NDArray[np.float64]


class RoadDrive(NamedTuple):
    """F frames.

    cues    detected in each frame, in the frame of the car then; objects that stand keep their `track`
    motion  readings from the frame before to each frame; of the first, whatever there is
    """

    cues: tuple[Cues, ...]
    motion: tuple[Motion, ...]


class RoadFrame(NamedTuple):
    """One frame; groups are those of the whole drive.

    cues      (N, 3) as in RoadEvidence; None simulates
    evidence  of these cues, but for the cues themselves
    moves     (G,) which groups are vehicles
    pose      (3,) x, y [m] and heading [rad] of the car one frame ago, seen from now
    drift     (3, 3) covariance of the pose
    seconds   since the frame before
    """

    cues: Tensor | None
    evidence: RoadEvidence
    moves: NDArray[np.bool_]
    pose: Floats
    drift: Floats
    seconds: float


def road_frames(drive: RoadDrive, course: RoadCourse, drift: Drift) -> tuple[RoadFrame, ...]:
    """Frames of a drive. A frame may be without cues, but not all of them.

    What stands is seen again and again, and errs from its row each time by the same: with that stray e of variance s^2
    and m independent errors of variance v, the mean of m sightings has the variance s^2 + v / m. So has the mean of m
    independent sightings of variance m s^2 + v each, and s^2 is multiplied by m here. m counts the whole drive.

    Raises InputError for a drive without frames or without cues, for cues that no course can be computed from and for
    readings that are no motion, with the number of the frame."""
    num = len(drive.cues)
    if num == 0 or num != len(drive.motion):
        raise InputError(
            f"the drive has {num} frames of cues and {len(drive.motion)} of motion; give one or more of both"
        )
    each = [_in_frame(t, course.prepare, cues) if len(cues.kind) else None for t, cues in enumerate(drive.cues)]
    if not (some := [evidence for evidence in each if evidence is not None]):
        raise InputError(f"none of the {num} frames of the drive has a cue; wait for a detection")
    prior = {n: p for e in some for n, *p in zip(e.names, e.offset_loc, e.offset_std, strict=True)}
    names = tuple(prior)
    loc, std = np.array(list(prior.values())).T
    moves = np.isin(names, [e.names[g] for e in some for g in e.group[e.moves]])
    times = Counter(key for cues in drive.cues for key in objects(cues))
    frames = list[RoadFrame]()
    for t, (cues, motion, evidence) in enumerate(zip(drive.cues, drive.motion, each, strict=True)):
        way = _in_frame(t, partial(integrate, drift=drift), motion)
        seen = [times[key] for key in objects(cues)]
        own = without_cues(some[0]) if evidence is None else evidence
        group = np.array([names.index(own.names[g]) for g in own.group], dtype=np.int64)
        spread = np.where(own.moves, own.spread, own.spread * np.sqrt(seen))
        shared = own._replace(cues=None, group=group, offset_loc=loc, offset_std=std, spread=spread, names=names)
        seconds = float(way.time[-1] - way.time[0])
        frames.append(RoadFrame(own.cues, shared, moves, way.pose[0], way.drift[0], seconds))
    return tuple(frames)


def objects(cues: Cues) -> list[tuple[str, int]]:
    """Kind and track of each cue: which object it is."""
    return [(str(kind), int(track)) for kind, track in zip(cues.kind, cues.track, strict=True)]


def without_cues(evidence: RoadEvidence) -> RoadEvidence:
    """The same groups, and nothing seen of them."""
    none: dict[str, Any] = {
        name: value[:0]
        for name, value in evidence._asdict().items()
        if isinstance(value, np.ndarray | Tensor) and name not in ("offset_loc", "offset_std")
    }
    return evidence._replace(**none, flags=())


def _in_frame(number: int, work: Any, given: Any) -> Any:
    """What is wrong with a frame is told with its number."""
    try:
        return work(given)
    except InputError as error:
        raise InputError(f"frame {number}: {error}") from error
