"""Moves between partitions of the measurements of a window into tracks (Oh, Russell and Sastry 2009, III).

A move draws measurements from distributions that do not depend on the partition, and then does what they say, or
nothing where it makes no sense. So the same draw, or another of known probability, leads back:

    birth     draws g_1, then g_2 ~ N(. | g_1), ..., as many as a geometric number says. If all are false alarms they
              become a track; if they are one, all of it, they become false alarms. Death is the same draw: ratio 1
    extend    draws g, g_1, ... likewise. If g ends a track and the others are false alarms, they follow it; if they are
              all that follows it, they become false alarms: ratio 1
    attach    draws g, then h ~ B(. | g). If g is a false alarm and h of a track without a measurement in g's scan, g
              joins it; if both are of one track, g leaves it. Before and after, h may be any other measurement of the
              track: ratio 1. It extends a track or reduces it by one, and fills or makes a gap
    exchange  draws g, then k of the same scan: each takes the other's place, in tracks or among false alarms. The same
              pair leads back: ratio 1. It updates one assignment, or two
    relink    draws g, then h ~ N(. | g), or the end of the track ("none"). With n what follows g in its track, and p
              what h follows in another, links g - n and p - h become g - h and p - n: tails are switched; where n or p
              is missing, tracks are merged, or one passes its tail on; h = none splits behind g. Then

                  q = N(h | g) + N(n | p) [n and p]
                  q' = N(n | g) [n] + N(h | p) [p] + N(none | g) [neither]

A share DEFENCE of every partner is drawn uniformly from all measurements, so that any partition can be reached.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference.lmb import moved
from inference.track_kernel import see, weights_of
from inference.track_weight import Track, Window
from models.multi_object import Bernoullis, HasObjects, no_objects

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Owner = Mapping[int, Track]  # the track of each measurement that is in one

NAMES = ("birth", "extend", "attach", "exchange", "relink")
SHARES = (0.15, 0.15, 0.2, 0.2, 0.3)
DEFENCE = 0.05
LONGER = 0.7  # share of births and extensions that go on after each measurement
CUT = 0.2  # share of relinks that split


class Edit(NamedTuple):
    """Tracks that go and tracks that come, of the same measurements or of false alarms; log q' / q."""

    removed: tuple[Track, ...]
    added: tuple[Track, ...]
    log_ratio: float = 0.0


class Partners(NamedTuple):
    """p(h | g): informed choices of each of G measurements, and a share of uniform ones.

    offset      (G + 1,) choices of g
    choice      (E,) rising
    share       (E,) their probabilities
    cumulative  (E,) the same, summed up
    """

    offset: Ints
    choice: Ints
    share: Floats
    cumulative: Floats

    def draw(self, g: int, rng: np.random.Generator) -> int:
        a, b = self.offset[g], self.offset[g + 1]
        if a == b or rng.random() < DEFENCE:
            return int(rng.random() * (len(self.offset) - 1))
        return int(self.choice[a + min(int(np.searchsorted(self.cumulative[a:b], rng.random())), b - a - 1)])

    def probability(self, h: int, g: int) -> float:
        """Of h to be drawn for g."""
        a, b = self.offset[g], self.offset[g + 1]
        anyone = 1.0 / (len(self.offset) - 1)
        if a == b:
            return anyone
        at = a + int(np.searchsorted(self.choice[a:b], h))
        if at == b or self.choice[at] != h:
            return DEFENCE * anyone
        return DEFENCE * anyone + (1.0 - DEFENCE) * float(self.share[at])


class Proposals(NamedTuple):
    """Whom moves draw: N of later scans, B of other scans, those of the same scan."""

    later: Partners
    near: Partners
    same: Partners


def partners(rows: Ints, columns: Ints, weight: Floats, num: int) -> Partners:
    """Those of positive weight, with probabilities proportional to it; pairs may be repeated."""
    key, where = np.unique(rows * num + columns, return_inverse=True)
    total = np.bincount(where, weight, len(key))
    key, total = key[total > 0.0], total[total > 0.0]
    row = key // num
    offset = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=num))])
    share = total / np.bincount(row, total, num)[row]
    running = np.cumsum(share)
    before = np.concatenate([[0.0], running])[offset[:-1]]
    return Partners(offset, key % num, share, running - before[row])


def proposals(model: HasObjects, window: Window, *, reach: int) -> Proposals:
    """Partners within `reach` scans: N by what a track of g alone weighs with h, having been missed in between; B the
    same both ways; of a scan by 1 / (1 + squared distance, in standard deviations of the measurement)."""
    num, size = len(window.scan), len(model.names)
    rows, columns, weight = list[Ints](), list[Ints](), list[Floats]()
    for t, born in enumerate(window.born):
        alone = np.arange(window.offset[t], window.offset[t + 1])
        objects = Bernoullis(alone, np.ones(len(alone)), born)
        for s in range(t + 1, min(t + 1 + reach, len(window.scans)) if len(alone) else t):
            objects = moved(model, objects, float(window.seconds[s]))
            parts = objects.components
            view = model.view(window.scans[s], no_objects(size), parts)
            table = weights_of(parts.offset, parts.weight, parts.kind, parts.covariance, *view, np.inf)
            found = objects.existence[:, None] * table
            g, j = np.nonzero(found > 0.0)
            rows.append(alone[g])
            columns.append(window.offset[s] + j)
            weight.append(found[g, j])
            parts = parts._replace(weight=parts.weight.copy())
            missed = see(*parts, np.full(len(alone), -1), *view, np.inf)
            objects = Bernoullis(alone, objects.existence * missed, parts)
    none = np.zeros(0, dtype=np.int64)
    g, h, w = np.concatenate([none, *rows]), np.concatenate([none, *columns]), np.concatenate([np.zeros(0), *weight])
    later = partners(g, h, w, num)
    whose, share = np.repeat(np.arange(num), np.diff(later.offset)), np.tile(later.share, 2)
    both = np.concatenate([whose, later.choice])
    near = partners(both, np.concatenate([later.choice, whose]), share, num)
    return Proposals(later, near, _same(window))


def _same(window: Window) -> Partners:
    rows, columns, weight = list[Ints](), list[Ints](), list[Floats]()
    for start, view in zip(window.offset[:-1], window.views, strict=True):
        num = len(view.values)
        gap = view.values[:, None] - view.values[None]
        finite = np.isfinite(view.period)
        turn = np.where(finite, view.period, 1.0)
        gap = np.where(finite, gap - turn * np.floor(gap / turn + 0.5), gap)
        std = np.sqrt(np.diagonal(view.noise, axis1=1, axis2=2))[view.sort]
        g, k = np.nonzero(~np.eye(num, dtype=bool))
        rows.append(start + g)
        columns.append(start + k)
        weight.append(1.0 / (1.0 + np.square(gap[g, k] / std[g]).sum(-1)))
    return partners(np.concatenate(rows), np.concatenate(columns), np.concatenate(weight), len(window.scan))


def propose(owner: Owner, window: Window, by: Proposals, move: int, rng: np.random.Generator) -> Edit | None:
    """What a move of NAMES draws; None where it makes no sense."""
    g = int(rng.random() * len(window.scan))
    if move < 2:
        sequence = [g] if move == 0 else [g, by.later.draw(g, rng)]
        while rng.random() < LONGER:
            sequence.append(by.later.draw(sequence[-1], rng))
        return (birth, extend)[move](owner, window.scan, tuple(sequence))
    if move == 2:
        return attach(owner, window.scan, g, by.near.draw(g, rng))
    if move == 3:
        return exchange(owner, window.scan, g, by.same.draw(g, rng))
    return relink(owner, window.scan, g, None if rng.random() < CUT else by.later.draw(g, rng), by.later)


def birth(owner: Owner, scan: Ints, sequence: Track) -> Edit | None:
    """A track of false alarms, or false alarms of a track."""
    if owner.get(sequence[0]) == sequence:
        return Edit((sequence,), ())
    return Edit((), (sequence,)) if _rise(scan, sequence) and not any(g in owner for g in sequence) else None


def extend(owner: Owner, scan: Ints, sequence: Track) -> Edit | None:
    """False alarms to the end of a track, or the end of a track to false alarms; the first stays in the track."""
    mine, more = owner.get(sequence[0]), sequence[1:]
    if mine is None:
        return None
    head = mine[: mine.index(sequence[0]) + 1]
    if mine == head + more:
        return Edit((mine,), (head,))
    free = mine == head and not any(g in owner for g in more)
    return Edit((mine,), (mine + more,)) if free and _rise(scan, sequence) else None


def _rise(scan: Ints, sequence: Track) -> bool:
    """Whether each measurement is of a later scan than the one before."""
    return all(scan[a] < scan[b] for a, b in itertools.pairwise(sequence))


def attach(owner: Owner, scan: Ints, g: int, h: int) -> Edit | None:
    """g to the track of h, or away from it."""
    mine, other = owner.get(g), owner.get(h)
    if other is None or g == h:
        return None
    if mine is None:
        free = all(scan[k] != scan[g] for k in other)
        return Edit((other,), (tuple(sorted((*other, g))),)) if free else None
    return Edit((mine,), (tuple(k for k in mine if k != g),)) if mine == other else None


def exchange(owner: Owner, scan: Ints, g: int, k: int) -> Edit | None:
    """g in the place of k, and k in that of g."""
    if g == k or scan[g] != scan[k] or not (g in owner or k in owner):
        return None
    tracks = tuple(owner[m] for m in (g, k) if m in owner)
    place = {g: k, k: g}
    return Edit(tracks, tuple(tuple(place.get(m, m) for m in track) for track in tracks))


def relink(owner: Owner, scan: Ints, g: int, h: int | None, later: Partners) -> Edit | None:
    """h after g; none: the end of a track after g."""
    mine = owner.get(g)
    if mine is None:
        return None
    cut = mine.index(g) + 1
    head, rest = mine[:cut], mine[cut:]
    if h is None:
        if not rest:
            return None
        return Edit((mine,), (head, rest), math.log((1.0 - CUT) * later.probability(rest[0], g) / CUT))
    other = owner.get(h)
    if other is None or other == mine or scan[g] >= scan[h]:
        return None
    cut = other.index(h)
    front, tail = other[:cut], other[cut:]
    if front and rest and scan[front[-1]] >= scan[rest[0]]:
        return None
    there, back = later.probability(h, g), 0.0 if front or rest else CUT / (1.0 - CUT)
    if front and rest:
        there += later.probability(rest[0], front[-1])
    if rest:
        back += later.probability(rest[0], g)
    if front:
        back += later.probability(h, front[-1])
    added = (head + tail, front + rest) if front or rest else (head + tail,)
    return Edit((mine, other), added, math.log(back / there))


def apply(owner: dict[int, Track], edit: Edit) -> None:
    """Make an edit, in place."""
    for track in edit.removed:
        for g in track:
            del owner[g]
    for track in edit.added:
        for g in track:
            owner[g] = track


def tracks_of(owner: Owner) -> tuple[Track, ...]:
    """The tracks of a partition, by first measurement."""
    return tuple(sorted(set(owner.values())))


def owner_of(tracks: Sequence[Track]) -> dict[int, Track]:
    """The partition that tracks make."""
    return {g: track for track in tracks for g in track}
