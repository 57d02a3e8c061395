"""What lane courses are learnt from: points sorted into lanes, and what the structure says about the lanes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.intersection.border_points import BorderPoints, place_borders
from models.intersection.borders import BEYOND, FARTHEST, interior_radius
from models.intersection.course_nodes import ARM_WAVE, INNER_WAVE
from models.intersection.routes import RoutedTracks, distinct
from models.program import InputError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class CourseEvidence(NamedTuple):
    """Points of all tracks on routes, and what the structure says about the lanes.

    points       (3, N) x, y about the origin [m], heading [rad]
    offsets      (T + 1,) of the tracks
    tracks       indices of tracks, lane by lane; starts (L + 1,)
    connections  (L, 4) as in Routes
    stubs        (L, 2) which of the S driven lanes of arms each lane begins and ends on
    loc          {site: value}, the middle of each prior
    reach        (L, 2) distance from the centre to which each lane was driven on either arm [m]
    counts       (L, 3) nodes on the entry arm, pieces of the interior, nodes on the exit arm
    origin       (2,) [m]
    heading      whether headings were measured
    first        {site: value} where the structure itself is another than loc
    borders      points on the borders of lanes, where any were seen
    """

    points: Tensor
    offsets: Ints
    tracks: Ints
    starts: Ints
    connections: Ints
    stubs: Ints
    loc: dict[str, Array]
    reach: Array
    counts: Ints
    origin: Array
    heading: bool
    first: dict[str, Array]
    borders: BorderPoints | None = None


def course_evidence(routed: RoutedTracks, spacing: float) -> CourseEvidence:
    """Points about the estimated centre, sorted into lanes, with the priors' middles from the structure.

    spacing  of the nodes [m]

    Raises InputError where no track is on a route."""
    tracks, structure, (connections, track_route) = routed
    on_route = np.flatnonzero(track_route >= 0)
    if len(on_route) == 0:
        raise InputError("no track has both an entry and an exit lane; give tracks that cross the junction")
    order = on_route[np.argsort(track_route[on_route], kind="stable")]
    starts = np.searchsorted(track_route[order], np.arange(len(connections) + 1))
    origin = np.asarray(structure["centre"], dtype=np.float64)
    heading = np.zeros(len(tracks.points)) if tracks.heading is None else tracks.heading
    points = np.vstack([(tracks.points - origin).T, heading])
    ends = np.stack([connections[:, :2], connections[:, 2:]], 1)  # (L, 2, 2)
    keys = np.concatenate([np.insert(ends[:, e], 0, e, axis=1) for e in range(2)])
    stubs = distinct(keys)[1].reshape(2, -1).T
    loc = prior_middles(structure, connections, int(stubs.max()) + 1)
    reach = farthest(points, tracks.offsets, order, track_route, connections, loc["angle"])
    counts = node_counts(loc, connections, reach, spacing)
    table = (tracks.offsets.astype(np.int64), order, starts, connections.astype(np.int64), stubs.astype(np.int64))
    arms = slice(int(structure["num_arms"]))
    first = {"width": np.asarray(structure["width"], dtype=np.float64)[arms] - loc["lane_width"]}
    if "bend" in structure:
        first["bend"] = np.asarray(structure["bend"], dtype=np.float64)[arms]
    measured, borders = tracks.heading is not None, None
    if tracks.borders is not None:
        borders = place_borders(tracks.borders, structure, loc["onset"])
    return CourseEvidence(torch.from_numpy(points), *table, loc, reach, counts, origin, measured, first, borders)


def prior_middles(structure: Mapping[str, Any], connections: Ints, num_stubs: int) -> dict[str, Array]:
    """The middle of every prior: the structure's estimate; interiors begin where borders meet."""
    num = int(structure["num_arms"])
    field = lambda name: np.asarray(structure[name], dtype=np.float64)[:num]  # noqa: E731
    loc = {"centre": np.zeros(2), "angle": field("angle"), "gap": field("gap")}
    width = field("width")
    loc["lane_width"], loc["width"] = np.asarray(width.mean()), np.zeros(num)
    loc["bend"], loc["shift"] = np.zeros(num), field("shift") if "shift" in structure else np.zeros(num)
    left = loc["gap"] / 2 + field("entries") * width
    right = loc["gap"] / 2 + field("exits") * width
    loc["onset"] = interior_radius(loc["angle"], left, right)
    loc["offset"], loc["advance"] = np.zeros(num_stubs), np.zeros((len(connections), 2))
    loc["handle"] = np.ones((len(connections), 2))
    loc["arm_wave"], loc["lane_wave"] = np.zeros((num, ARM_WAVE)), np.zeros((num_stubs, ARM_WAVE))
    loc["inner_wave"] = np.zeros((len(connections), INNER_WAVE))
    return loc


def farthest(points: Array, offsets: Ints, order: Ints, track_route: Ints, connections: Ints, angle: Array) -> Array:
    """How far out on its entry and its exit arm each lane was driven, (L, 2) [m]."""
    reach = np.zeros((len(connections), 2))
    for end in range(2):
        outermost = offsets[order] if end == 0 else offsets[order + 1] - 1
        arm = angle[connections[track_route[order], 2 * end]]
        along = points[0, outermost] * np.cos(arm) + points[1, outermost] * np.sin(arm)
        np.maximum.at(reach[:, end], track_route[order], along)
    return np.maximum(reach, FARTHEST + 2 * BEYOND)


def node_counts(loc: dict[str, Array], connections: Ints, reach: Array, spacing: float) -> Ints:
    """Nodes of each lane, about `spacing` apart; fixed, so that the density does not jump."""
    onset = loc["onset"][connections[:, ::2]]
    arms = np.maximum(np.ceil((reach - onset) / spacing), 2)
    a, b = loc["angle"][connections[:, 0]], loc["angle"][connections[:, 2]]
    chord = np.hypot(
        onset[:, 1] * np.cos(b) - onset[:, 0] * np.cos(a), onset[:, 1] * np.sin(b) - onset[:, 0] * np.sin(a)
    )
    inside = np.maximum(np.ceil(1.2 * np.maximum(chord, 5.0) / spacing), 4)
    return np.stack([arms[:, 0], inside, arms[:, 1]], 1).astype(np.int64)
