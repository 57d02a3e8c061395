"""Routes that are one lane: tracks that were put on neighbouring lanes of an arm, but drove the same one.

Both routes' tracks are laid along the first one's course; where no stretch of `window` metres finds them farther apart
than `same` metres on average (Routing), they are one. Neighbouring lanes are about 3 m apart somewhere; of one lane,
only the noise of the tracks and how its drivers keep off its middle lie between."""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from models.intersection.course_evidence import CourseEvidence
from models.intersection.course_kernel import sum_points
from models.intersection.course_lines import lane_nodes
from models.intersection.routes import ROUTING, Routes, Routing

Ints = NDArray[np.int64]


@nb.njit(cache=True, error_model="numpy")
def lateral_sums(points, offsets, tracks, nodes):  # type: ignore[no-untyped-def]
    """Points and summed lateral distances at every node of a course, (3, n), of some tracks."""
    sums, noise = np.zeros((3, len(nodes))), np.array([1.0, np.inf])
    for t in tracks:
        sum_points(points, offsets[t], offsets[t + 1], nodes, len(nodes), noise, sums)
    return sums


@nb.njit(cache=True, error_model="numpy")
def stretch_distance(one, other, span):  # type: ignore[no-untyped-def]
    """Largest mean distance over stretches of `span` nodes where either has points at half of them; inf without any."""
    num, most = one.shape[1], -1.0
    span = min(span, num)
    window = np.zeros((2, 2))  # points and summed distances of either in the stretch that ends at node i
    for i in range(num):
        for row in range(2):
            window[0, row] += one[row, i]
            window[1, row] += other[row, i]
            if i >= span:
                window[0, row] -= one[row, i - span]
                window[1, row] -= other[row, i - span]
        if i >= span - 1 and min(window[0, 0], window[1, 0]) >= 0.5 * span:
            most = max(most, abs(window[0, 1] / window[0, 0] - window[1, 1] / window[1, 0]))
    return most if most >= 0.0 else np.inf


def merge_routes(evidence: CourseEvidence, routes: Routes, spacing: float, routing: Routing = ROUTING) -> Routes:
    """The same routes, those that are one lane in one; the lane with more tracks gives its name."""
    connections, points = routes.connections, np.ascontiguousarray(evidence.points.numpy())
    size = np.bincount(routes.track_route[routes.track_route >= 0], minlength=len(connections))
    near = np.abs(connections[:, None, 1::2] - connections[None, :, 1::2]).max(-1) <= 1
    near &= (connections[:, None, ::2] == connections[None, :, ::2]).all(-1)
    if near.sum() == len(connections):  # every lane by itself
        return routes
    becomes, span, courses = np.arange(len(connections)), round(routing.window / spacing), lane_nodes(evidence, {})
    of_lane = [evidence.tracks[a:b] for a, b in zip(evidence.starts[:-1], evidence.starts[1:], strict=True)]
    for i in np.argsort(-size, kind="stable"):
        own = None
        for j in np.flatnonzero(near[i] & (becomes == np.arange(len(becomes)))):
            if j == i or becomes[i] != i or size[j] > size[i]:
                continue
            own = lateral_sums(points, evidence.offsets, of_lane[i], courses[i]) if own is None else own
            theirs = lateral_sums(points, evidence.offsets, of_lane[j], courses[i])
            if stretch_distance(own, theirs, span) < routing.same:
                becomes[j] = i
    kept = np.flatnonzero(becomes == np.arange(len(becomes)))
    number = np.searchsorted(kept, becomes)
    on_route = routes.track_route >= 0
    return Routes(connections[kept], np.where(on_route, number[routes.track_route], -1))
