"""What free courses are learnt from: points sorted into lanes, and a reference curve for every lane with the spline
that displaces it."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.intersection.free_kernel import free_equations, free_nodes
from models.intersection.reference import arc_length, reference_curve, resampled
from models.intersection.routes import RoutedTracks
from models.program import InputError
from models.spline import ORDER, basis

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
ROUNDS = 4  # of fits, each about the one before


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
    origin: Array
    heading: bool


def free_evidence(
    routed: RoutedTracks, spacing: float, knots: float, scales: tuple[float, float, float]
) -> FreeEvidence:
    """Points about their mean, sorted into lanes, with reference curves that the tracks of each lane were fitted to.

    spacing of the nodes, knots of the splines [m]; scales are the standard deviations of place, jerk and position [m].
    The structure is not read. Raises InputError where no track is on a route, or a route has no track."""
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
    parts: list[Array] = []
    for a, b in pairwise(starts):
        mine = [of_track[t] for t in order[a:b]]
        line = reference_curve(mine, spacing)
        for _ in range(ROUNDS):
            line = resampled(fitted(line, mine, knots, scales), spacing)
        parts.append(line)
    design, jerks = zip(*(lane_spline(line, knots) for line in parts), strict=True)
    number = np.cumsum([0, *(len(each) for each in jerks)]) + 3 * len(parts)
    where = [np.r_[3 * i : 3 * i + 3, number[i] : number[i + 1]] for i in range(len(parts))]
    table = (tracks.offsets.astype(np.int64), order, starts, connections.astype(np.int64))
    reference = [np.hstack([line, tangents(line)]) for line in parts]
    loc = {"place": np.zeros((len(parts), 3)), "jerk": np.concatenate(jerks)}
    measured = tracks.heading is not None
    return FreeEvidence(torch.from_numpy(points), *table, reference, list(design), where, loc, origin, measured)


def lane_spline(line: Array, knots: float) -> tuple[Array, Array]:
    """The spline beside a reference curve (n, 2): design (n, D) and the middles of its jerks (D - 3,).

    Controls c = Q t + T^+ v: t lie beside the ends and the middle of the lane on a parabola, which is what third
    differences T do not see, and v = T c are those. By f'' = (c_(k-1) - 2 c_k + c_(k+1)) / h^2 at the knots, the change
    of the lane's own curvature from knot to knot is v + h^2 (kappa_(k+1) - kappa_k) over h^2, with the curvature kappa
    of the reference: about 0 if v is about minus the latter."""
    s = arc_length(line)
    num = max(math.ceil(s[-1] / knots), 1) + ORDER - 1
    pieces, weights, _ = basis(s, 0.0, knots, num)
    values = np.zeros((len(s), num))
    np.put_along_axis(values, pieces[:, None] + np.arange(ORDER), weights, 1)
    x = np.linspace(-1.0, 1.0, num)
    parabola = np.stack([x * (x - 1) / 2, 1 - x**2, x * (x + 1) / 2], 1)
    third = np.diff(np.eye(num), ORDER - 1, axis=0)
    design = values @ np.hstack([parabola, np.linalg.pinv(third)])
    at_knots = np.interp(knots * np.arange(num - ORDER + 2), s, curvatures(line))
    return design, -(knots**2) * np.diff(at_knots)


def tangents(line: Array) -> Array:
    """Unit tangents (n, 2) of a polyline by central differences."""
    steps = np.gradient(line, axis=0)
    return np.asarray(steps / np.linalg.norm(steps, axis=1)[:, None])


def curvatures(line: Array) -> Array:
    """(n,) of a polyline [1/m]."""
    nodes = np.empty((len(line), 5))
    free_nodes(np.empty(0), np.hstack([line, tangents(line)]), np.empty((len(line), 0)), nodes)
    return nodes[:, 4]


def fitted(line: Array, tracks: list[Array], knots: float, scales: tuple[float, float, float]) -> Array:
    """The lane (n, 2) that one Gauss-Newton step leads to from a reference curve: the mode of its prior with positions.

    scales as in `free_evidence`"""
    design, middle = lane_spline(line, knots)
    size = design.shape[1]
    loc, scale = np.concatenate([np.zeros(3), middle]), np.full(size, scales[1])
    scale[:3] = scales[0]
    offsets = np.cumsum([0, *(len(t) for t in tracks)])
    points = np.vstack([np.concatenate(tracks).T, np.zeros(offsets[-1])])
    reference = np.hstack([line, tangents(line)])
    own = (np.arange(size), design.reshape(-1), np.array([size]), reference, np.array([len(line)]))
    data = (np.arange(len(tracks)), np.array([0, len(tracks)]), offsets, points, np.array([scales[2], np.inf]))
    hessian, gradient = np.empty((size, size)), np.empty(size)
    free_equations(np.zeros(size), own, data, hessian, gradient)  # type: ignore[call-arg]
    z = np.linalg.solve(hessian + np.diag(scale**-2), loc / scale**2 - gradient)
    nodes = np.empty((len(line), 5 + size))
    free_nodes(z, reference, design, nodes)
    return nodes[:, :2]
