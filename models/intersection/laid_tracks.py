"""Tracks laid along a curve: where each runs beside it, and how far that is from where others do.

A curve is divided into bins of BIN metres; in each, a track a has n_a points at the mean lateral position y_a. Two
profiles are as far apart as they are on average over the WINDOW bins where they differ most, beyond what noise says,

    distance = max over windows of |sum w (y_a - y_b)| / W - 2 sigma / sqrt(W),   w = n_a n_b / (n_a + n_b),  W = sum w

Where a single bin is more than PARTED metres apart beyond noise, they are infinitely so. Neither width nor straightness
is assumed: the curve may turn as it likes. Points of a track that leaves the curve, or crosses it, count as FAR beside
it: it is apart from whoever stays.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from models.intersection.course_kernel import nearest_node, rough_node
from models.intersection.evidence import checked
from models.intersection.halves import path_headings, smooth
from models.intersection.reference import reference_curve, resampled, tangents
from models.intersection.tracks import Tracks
from models.intersection.wrap import wrap

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
BIN = 6  # nodes of a curve, about a metre apart
WINDOW = 4  # bins: 24 m
FEW = 2.0  # points that both profiles need in a bin
SHARED = 2  # bins that two profiles must share: less says nothing
PARTED = 3.0  # [m] in a single bin, beyond noise: one of the two has left
FAR = 6.0  # [m] beside a curve, at most
TURNED = math.radians(45.0)  # a point driven in a direction farther from the curve's has left it
ROUNDS = 2  # of moving a curve to the middle of its tracks


class Ways(NamedTuple):
    """T tracks with their directions.

    points   (N, 2) [m]; path (N, 2) the same smoothed, heading (N,) its direction [rad]
    offsets  (T + 1,)
    pieces   T arrays (n, 2), the points of each
    length   (T,) driven [m]
    """

    points: Array
    path: Array
    heading: Array
    offsets: Ints
    pieces: list[Array]
    length: Array


class Laid(NamedTuple):
    """T tracks along a curve (n, 2): points (T, B) in each bin, sums (T, B) of lateral positions [m]."""

    curve: Array
    num: Array
    total: Array


def ways(tracks: Tracks) -> Ways:
    """Tracks with directions from their smoothed paths. Raises InputError for tracks that cannot be read."""
    points, _, offsets = checked(tracks)
    path = smooth(points, offsets)
    steps = [np.linalg.norm(np.diff(piece, axis=0), axis=1).sum() for piece in np.split(path, offsets[1:-1])]
    pieces = np.split(points, offsets[1:-1])
    return Ways(points, path, path_headings(path, offsets), offsets, pieces, np.array(steps))


@nb.njit(cache=True, error_model="numpy")
def lay_tracks(points, heading, offsets, nodes, count, total):  # type: ignore[no-untyped-def]
    """Fill count and total (T, B) of tracks with points (N, 2) and directions (N,) along nodes (n, 4) x, y, tangent.

    Points beyond the ends of the curve are left out."""
    last = len(nodes) - 1
    for t in range(len(offsets) - 1):
        for i in range(offsets[t], offsets[t + 1]):
            x, y = points[i, 0], points[i, 1]
            j = nearest_node(nodes, last + 1, x, y, rough_node(nodes, last + 1, x, y))
            dx, dy, ux, uy = x - nodes[j, 0], y - nodes[j, 1], nodes[j, 2], nodes[j, 3]
            along = ux * dx + uy * dy
            if (j == 0 and along < -1.0) or (j == last and along > 1.0):
                continue
            lateral = -uy * dx + ux * dy
            if abs(lateral) > FAR or abs(wrap(heading[i] - math.atan2(uy, ux))) > TURNED:
                lateral = FAR  # on one side for all: who crosses must not be near on average
            count[t, j // BIN] += 1.0
            total[t, j // BIN] += lateral


def lay(every: Ways, curve: Array) -> Laid:
    """All tracks along a curve (n, 2) with a point every metre."""
    shape = len(every.pieces), (len(curve) - 1) // BIN + 1
    count, total = np.zeros(shape), np.zeros(shape)
    nodes = np.hstack([curve, tangents(curve)])
    lay_tracks(every.points, every.heading, every.offsets, nodes, count, total)
    return Laid(curve, count, total)


class Courses:
    """Mean courses of groups of tracks, with all tracks laid along them; those asked for before are remembered."""

    def __init__(self, every: Ways) -> None:
        self.every = every
        self.known: dict[bytes, Laid] = {}

    def along(self, members: Ints) -> Laid:
        """All tracks along the mean course of some (their indices, rising)."""
        key = members.tobytes()
        if key not in self.known:
            self.known[key] = lay(self.every, mean_course(some(self.every, members)))
        return self.known[key]


def some(every: Ways, members: Ints) -> Ways:
    """A part of the tracks."""
    offsets = np.cumsum([0, *(len(every.pieces[t]) for t in members)])
    rows = np.concatenate([np.arange(*every.offsets[t : t + 2]) for t in members])
    pieces = [every.pieces[t] for t in members]
    return Ways(every.points[rows], every.path[rows], every.heading[rows], offsets, pieces, every.length[members])


def mean_course(those: Ways) -> Array:
    """The mean course (n, 2) of tracks on one lane, a point about every metre.

    It begins as their reference curve and is moved ROUNDS times by their mean lateral position, linear between the
    middles of bins."""
    curve = reference_curve(those.pieces, 1.0)
    for _ in range(ROUNDS):
        laid = lay(those, curve)
        count, total = laid.num.sum(0), laid.total.sum(0)
        seen = count >= FEW
        middle = BIN * (np.arange(len(count)) + 0.5) - 0.5
        beside = np.interp(np.arange(len(curve)), middle[seen], total[seen] / count[seen])
        along = tangents(curve)
        curve = resampled(curve + beside[:, None] * np.stack([-along[:, 1], along[:, 0]], 1), 1.0)
    return curve


def profiles(laid: Laid, group: Ints, numbers: list[int]) -> tuple[Array, Array]:
    """Points (G, B) in each bin and sums of lateral positions of the tracks of some groups."""
    member = (group == np.array(numbers)[:, None]).astype(np.float64)  # (G, T)
    return member @ laid.num, member @ laid.total


def distances(count: Array, total: Array, counts: Array, totals: Array, sigma: float) -> tuple[Array, Array]:
    """Distance and mean distance (T,) [m] of profiles (T, B) from others, (T, B) or (1, B); inf without SHARED bins.

    sigma  noise of a point [m]"""
    both = (count >= FEW) & (counts >= FEW)
    weight = np.where(both, count * counts / np.maximum(count + counts, 1.0), 0.0)
    gap = weight * (total / np.maximum(count, 1.0) - totals / np.maximum(counts, 1.0))
    inside, sums = _windows(weight), _windows(gap)
    seen = inside > 0.0
    safe = np.where(seen, inside, 1.0)
    beyond = np.where(seen, np.abs(sums) / safe - 2.0 * sigma / np.sqrt(safe), 0.0).max(1)
    mean = np.abs(gap.sum(1)) / np.maximum(weight.sum(1), 1e-9)
    parted = (np.abs(gap) > weight * PARTED + 2.0 * sigma * np.sqrt(weight)).any(1)
    enough = (both.sum(1) >= SHARED) & ~parted
    return np.where(enough, np.maximum(beyond, 0.0), math.inf), np.where(enough, mean, math.inf)


def _windows(values: Array) -> Array:
    """Sums over WINDOW bins, (T, B) to (T, B - WINDOW + 1); over all where there are fewer."""
    span = min(WINDOW, values.shape[1])
    sums = np.cumsum(np.pad(values, ((0, 0), (1, 0))), axis=1)
    return np.asarray(sums[:, span:] - sums[:, :-span])
