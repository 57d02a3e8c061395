"""Tracks that drove the same lane: they run together wherever both were seen.

Groups begin with the longest track that is in none and gather what is within SAME metres of it
(models.intersection.laid_tracks). Then each group's course is the mean of its tracks, and every track goes to the group
that it fits best, SWEEPS times; groups within JOIN metres of one another are merged, the closest first. Nothing bounds
the number of lanes; slip lanes part from their neighbours where their tracks do; and a track that was seen on a part of
its way only belongs wherever that part fits. The order of the tracks plays no part.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from models.intersection.laid_tracks import Courses, Laid, Ways, distances, profiles

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
SAME = 1.2  # [m] from the rest of a group, less than half a lane of 2.7 m
JOIN = 0.8 * SAME  # groups know their means better than tracks do
SWEEPS = 3
NEARNESS = 0.3  # share of the mean distance that decides between groups that both fit


def group_tracks(every: Ways, sigma: float) -> tuple[Ints, list[Laid]]:
    """The group (T,) of every track, counted from the one with the longest track on, and all tracks along each group.

    sigma  noise of a point [m]"""
    courses = Courses(every)
    group, laid = gather(courses, np.full(len(every.pieces), -1), [], sigma)
    for _ in range(SWEEPS):
        group, laid = reassign(courses, group, laid, sigma)
    group, laid = merge(courses, group, laid, sigma)
    return reassign(courses, group, laid, sigma)


def gather(courses: Courses, group: Ints, laid: list[Laid], sigma: float) -> tuple[Ints, list[Laid]]:
    """Put tracks without a group, the longest first, into new ones with all others that fit."""
    group, laid = group.copy(), list(laid)
    for track in np.argsort(-courses.every.length, kind="stable"):
        if group[track] < 0:
            group[track] = len(laid)
            laid.append(courses.along(np.array([track])))
            apart, _ = from_group(laid[-1], group, len(laid) - 1, sigma)
            group[(group < 0) & (apart < SAME)] = len(laid) - 1
    return group, laid


def from_group(laid: Laid, group: Ints, number: int, sigma: float) -> tuple[Array, Array]:
    """Distance and mean distance (T,) of all tracks from a group, of its own ones from its others."""
    own = (group == number)[:, None]
    count, total = profiles(laid, group, [number])
    return distances(laid.num, laid.total, count - laid.num * own, total - laid.total * own, sigma)


def reassign(courses: Courses, group: Ints, laid: list[Laid], sigma: float) -> tuple[Ints, list[Laid]]:
    """Every track in the group that it fits best, new ones for those that fit nowhere; new courses for all."""
    cost = np.full((len(laid), len(group)), math.inf)
    for number, course in enumerate(laid):
        apart, mean = from_group(course, group, number, sigma)
        cost[number] = np.where(apart < SAME, apart + NEARNESS * np.where(np.isfinite(mean), mean, 0.0), math.inf)
    best = np.where(np.isfinite(cost.min(0)), cost.argmin(0), -1)
    return renewed(courses, gather(courses, best, laid, sigma)[0])


def renewed(courses: Courses, group: Ints) -> tuple[Ints, list[Laid]]:
    """Groups counted anew without the empty ones, and their courses."""
    names, group = np.unique(group, return_inverse=True)
    group = group.reshape(-1)
    return group, [courses.along(np.flatnonzero(group == number)) for number in range(len(names))]


def merge(courses: Courses, group: Ints, laid: list[Laid], sigma: float) -> tuple[Ints, list[Laid]]:
    """Join the two groups that are closest, again and again, while they are within JOIN metres."""
    group, laid, num = group.copy(), list(laid), len(laid)
    apart = np.full((num, num), math.inf)
    for a in range(num):
        apart[a, :a] = [between(laid, group, a, b, sigma) for b in range(a)]
    while apart.min() < JOIN:
        gone, kept = np.unravel_index(apart.argmin(), apart.shape)
        group[group == gone] = kept
        laid[kept] = courses.along(np.flatnonzero(group == kept))
        apart[gone], apart[:, gone] = math.inf, math.inf
        for other in np.unique(group[group != kept]):
            pair = max(other, kept), min(other, kept)
            apart[pair] = between(laid, group, *pair, sigma)
    return renewed(courses, group)


def between(laid: list[Laid], group: Ints, a: int, b: int, sigma: float) -> float:
    """Distance of two groups along the longer one's course [m]."""
    along = laid[a] if len(laid[a].curve) >= len(laid[b].curve) else laid[b]
    count, total = profiles(along, group, [a, b])
    return float(distances(count[:1], total[:1], count[1:], total[1:], sigma)[0][0])
