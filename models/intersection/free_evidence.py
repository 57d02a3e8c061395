"""What free courses are learnt from: points sorted into lanes, and a reference curve for every lane with the spline
that displaces it."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.intersection.first_fit import Scales, first_course, spline_values
from models.intersection.free_numbers import numbers
from models.intersection.free_shape import shape
from models.intersection.reference import tangents
from models.intersection.routes import RoutedTracks
from models.intersection.stubs import find_stubs
from models.program import InputError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class FreeEvidence(NamedTuple):
    """Points of all tracks on routes, and the reference curves of their lanes.

    points       (3, N) x, y about the origin [m], heading [rad]
    offsets      (T + 1,) of the tracks
    tracks       indices of tracks, lane by lane; starts (L + 1,)
    connections  (L, 4) as in Routes
    reference    L arrays (n, 4): x, y, unit tangent of the nodes
    design       L arrays (n, D): displacement of the nodes by each number of the lane
    where        L arrays (D,): which of all numbers these are
    loc          {site: value}, the middle of each prior
    scale        {site: factors on its standard deviation}: lanes by themselves are more and less rough inside
    origin       (2,) [m]
    heading      whether headings were measured
    """

    points: Tensor
    offsets: Ints
    tracks: Ints
    starts: Ints
    connections: Ints
    reference: list[Array]
    design: list[Array]
    where: list[Ints]
    loc: dict[str, Array]
    scale: dict[str, Array]
    origin: Array
    heading: bool


def free_evidence(routed: RoutedTracks, spacing: float, knots: float, scales: Scales, shared: bool) -> FreeEvidence:
    """Points about their mean, sorted into lanes, with reference curves that the tracks of each lane were fitted to.

    spacing of the nodes, knots of the splines [m]; whether lanes of an arm are shared. The structure is not read.
    Raises InputError where no track is on a route, or a route has no track."""
    tracks, _, (connections, track_route) = routed
    on_route = np.flatnonzero(track_route >= 0)
    if len(on_route) == 0:
        raise InputError("no track is on a route; give tracks that cross the junction")
    order = on_route[np.argsort(track_route[on_route], kind="stable")]
    starts = np.searchsorted(track_route[order], np.arange(len(connections) + 1))
    empty = np.flatnonzero(np.diff(starts) == 0)
    if len(empty):
        raise InputError(f"route {empty[0]} has no track; leave it out of the connections")
    origin = tracks.points[np.concatenate([np.arange(*tracks.offsets[t : t + 2]) for t in order])].mean(0)
    heading = np.zeros(len(tracks.points)) if tracks.heading is None else tracks.heading
    points = np.vstack([(tracks.points - origin).T, heading])
    of_track = np.split(points[:2].T, tracks.offsets[1:-1])
    lines, stds = [], []
    for a, b in pairwise(starts):
        line, std = first_course([of_track[t] for t in order[a:b]], spacing, knots, scales)
        lines.append(line)
        stds.append(std)
    ends = connections if shared else np.full_like(connections, -1)
    stubs = find_stubs(lines, ends, np.diff(starts).astype(np.float64), knots, spacing, scales.position)
    shapes = [shape(line, pair, stubs, knots, spacing) for line, pair in zip(lines, stubs.sides, strict=True)]
    loc, scale, lanes = numbers(shapes, stubs, knots, scales.inner / scales.offset, np.array(stds) / scales.inner)
    pairs = list(zip(shapes, lanes, strict=True))
    return FreeEvidence(
        torch.from_numpy(points),
        tracks.offsets.astype(np.int64),
        order,
        starts,
        connections.astype(np.int64),
        [np.hstack([each.nodes, tangents(each.nodes)]) for each in shapes],
        [spline_values(each.t, knots, len(own.controls)) @ own.controls for each, own in pairs],
        [own.where for own in lanes],
        loc,
        scale,
        origin,
        tracks.heading is not None,
    )
