"""What a scenario hands over: the data a model reads, and what is true about them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.intersection.tracks import Tracks

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Scene(NamedTuple):
    """One scene to learn from.

    data   what the model reads
    truth  what made it, None where nobody knows
    name   of the scene, as the report shows it
    info   plain numbers and strings for the manifest
    """

    data: Any
    truth: Any
    name: str
    info: dict[str, Any]


class JunctionTruth(NamedTuple):
    """A junction of K arms, T_l lane stubs on them and L drivable connections.

    Lanes are counted from the middle of the arm outwards; looking outward from the centre in
    right-hand traffic, entries are on the left and exits on the right.

    centre       (2,) [m]
    angle        (K,) direction from the centre to the arm [rad]
    gap          (K,) between the inner borders of the two driving directions [m], nan where unknown
    entries      (K,) lanes that lead into the junction
    exits        (K,) lanes that lead out of it
    width        (K,) lane width, nan where unknown [m]
    radius       (K,) distance from the centre where the interior begins [m]
    lines        L centre lines (n, 2) in driving order, a point every 0.25 m
    connections  (L, 4) entry arm, entry lane, exit arm, exit lane of each line
    track_lane   (T,) the line each track drove, -1 where unknown
    driven       (K,) arms that vehicles used; None where all are: only these can be found
    """

    centre: Floats
    angle: Floats
    gap: Floats
    entries: Ints
    exits: Ints
    width: Floats
    radius: Floats
    lines: list[Floats]
    connections: Ints
    track_lane: Ints
    driven: NDArray[np.bool_] | None = None


class TrafficTruth(NamedTuple):
    """Who was where, at each of T times; R rows in all, those of time t being offset[t] ... offset[t + 1] - 1.

    time           (T,) never decreasing [s]; times of scans that see the traffic must be among them
    offset         (T + 1,)
    label          (R,) who it is, the same over time
    x, y           (R,) middle of the object in the world [m]
    vx, vy         (R,) [m/s], nan where unknown
    heading        (R,) [rad], nan where unknown
    length, width  (R,) [m], nan where objects are points
    kind           (R,) index of its kind, as in the model, -1 where unknown
    """

    time: Floats
    offset: Ints
    label: Ints
    x: Floats
    y: Floats
    vx: Floats
    vy: Floats
    heading: Floats
    length: Floats
    width: Floats
    kind: Ints

    @property
    def position(self) -> Floats:
        """(R, 2) [m]."""
        return np.stack([self.x, self.y], -1)


def join_tracks(points: list[Floats], headings: list[Floats] | None) -> Tracks:
    """Put single tracks, each (n, 2) with headings (n,), behind one another."""
    offsets = np.cumsum([0] + [len(p) for p in points])
    heading = None if headings is None else np.concatenate(headings)
    return Tracks(np.concatenate(points), heading, offsets.astype(np.int64))
