"""Lanes of recorded traffic: which tracks drove which lane, and the courses of these lanes.

Recorded vehicles break what a model of straight arms assumes: lanes of any width, slip lanes, six lanes side by side,
tracks that show a part of their way only. Here no structure is estimated. Tracks that run together are one lane
(models.intersection.track_groups), who changes lanes is left out (models.intersection.between_lanes), and lanes get
their arms from where they begin and end (models.intersection.lane_names). All of that is preparation, a function of the
tracks; what is random, and what engines infer, are the courses of the lanes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.capability import Squares
from models.intersection.between_lanes import in_between
from models.intersection.free_courses import FreeCourses
from models.intersection.free_evidence import FreeEvidence
from models.intersection.halves import crossing
from models.intersection.laid_tracks import ways
from models.intersection.lane_names import name_lanes
from models.intersection.routes import RoutedTracks, Routes
from models.intersection.track_groups import group_tracks
from models.intersection.tracks import Tracks
from models.program import InputError

Array = NDArray[np.float64]


class TrafficEvidence(NamedTuple):
    """The tracks, the lanes they drove, directions (K,) of the arms [rad], and what courses are learnt from."""

    tracks: Tracks
    routes: Routes
    angle: Array
    courses: FreeEvidence


@dataclass(frozen=True)
class TrafficLanes:
    """A program of the courses of lanes that are found from the tracks themselves.

    courses     of the lanes; its position_std is also the noise of a point where tracks are compared
    min_tracks  that a lane needs: a single one may be anybody's detour"""

    courses: FreeCourses = field(default_factory=FreeCourses)
    min_tracks: int = 2

    def __post_init__(self) -> None:
        if self.min_tracks < 1:
            raise InputError(f"min_tracks is {self.min_tracks}, but a lane needs a track; choose 1 or more")

    def __call__(self, evidence: TrafficEvidence) -> None:
        self.courses(evidence.courses)

    def prepare(self, tracks: Tracks) -> TrafficEvidence:
        """Find the lanes. Raises InputError where there is none."""
        routes, angle = find_lanes(tracks, self.courses.position_std, self.min_tracks)
        return TrafficEvidence(tracks, routes, angle, self.courses.prepare(RoutedTracks(tracks, {}, routes)))

    def start(self, evidence: TrafficEvidence) -> dict[str, Array]:
        return self.courses.start(evidence.courses)

    def squares(self, evidence: TrafficEvidence) -> Squares:
        return self.courses.squares(evidence.courses)


def find_lanes(tracks: Tracks, sigma: float, min_tracks: int) -> tuple[Routes, Array]:
    """Lanes that tracks drove, with the arm -1 on the side where a lane was not seen to reach one, and the directions
    (K,) of the arms [rad].

    sigma  noise of a point [m]

    A track is on no route if it changes lanes, or if fewer than `min_tracks` drove as it did. Lanes that share both
    stubs are one, however their tracks cross the interior. The order of the tracks plays no part.
    Raises InputError where no lane has enough tracks."""
    every = ways(tracks)
    group, laid = group_tracks(every, sigma)
    size = np.bincount(group, minlength=len(laid))
    rejected = in_between(group, laid)
    lanes = [n for n in range(len(laid)) if size[n] >= min_tracks and n not in rejected]
    if not lanes:
        raise InputError(
            f"none of {len(group)} tracks shares its lane with enough others: a lane needs {min_tracks} tracks, but at "
            f"most {size.max()} run together; give more tracks, or lower model.min_tracks"
        )
    names, angle = name_lanes([laid[n].curve for n in lanes], size[lanes], crossing(every.path, every.offsets))
    connections, number = np.unique(names, axis=0, return_inverse=True)
    route_of = np.full(len(laid), -1)
    route_of[lanes] = number.reshape(-1)
    return Routes(connections, route_of[group]), angle


def half_lanes(routes: Routes) -> int:
    """Lanes that were seen on one side of the junction only."""
    return int((routes.connections[:, ::2] < 0).any(1).sum())
