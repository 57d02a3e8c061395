"""What a track weighs: its measurements being given, all that is Gaussian about it is integrated out.

A window is T scans by time, with G measurements in all, numbered scan after scan. A track is a tuple of measurements
that one object made, rising, at most one of a scan; what is in no track is a false alarm. With rho(z) the intensity of
measurements of objects that no scan has shown before, a track from scan f to scan l weighs

    w = rho(z_f) prod_(f < s <= l) a_s q_s * e
    e = sum_(s > l) (1 - a_s) prod_(l < r < s) a_r m_r + prod_(r > l) a_r m_r

    a_s  probability to have survived since the scan before
    q_s  sum_c w_c p_D N(z_s; h_c, H_c P_c H_c' + R) where the track has a measurement, else m_s
    m_s  sum_c w_c (1 - p_D), to be missed
    e    to be missed ever after, whenever it goes: the end of an object is summed over

over components c: kinds, headings, and where it may have come from. None is ever merged or left out, so that this is
the density of the model itself where its formulas are linear (and p_D is the same all over a component); else they are
linearised as in inference.lmb. A partition of the measurements into tracks and false alarms has the density

    p(partition | Z)  proportional to  prod_tracks w prod_false lambda_c(z)

of which `Trail.log_weight` is the part of one track, log w - sum_track log lambda_c(z).

Objects that arrived at known places, but were not shown yet, wait: a Poisson process of as many as are expected, of
which each scan leaves those that it missed. Objects hide nobody here: else no track could be weighed without the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference.lmb import moved
from inference.track_kernel import see
from inference.tracking import MEMORY
from models.multi_object import Bernoullis, Components, HasObjects, View, no_components, no_objects, together
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Track = tuple[int, ...]
LEAST = 1e-100  # intensity of false alarms, where a sensor has none: it makes no logarithm infinite
FORGOTTEN = 1e-9  # objects that wait are forgotten once so few are expected
SUREST = 1.0 - 1e-12  # arrival: of one that is surer, no finite number can be expected
GONE = 1e-15  # an object that is less probably still there is gone


class Window(NamedTuple):
    """T scans with G measurements.

    scans        by time
    seconds      (T,) since the scan before
    offset       (T + 1,) measurements of scan t are offset[t] ... offset[t + 1] - 1
    scan         (G,) of each measurement
    log_clutter  (G,) log lambda_c
    views        (T,) of nobody: they hold the measurements
    prior        (T,) components of what may first be shown by each measurement of a scan
    born         (T,) the same, conditioned on it
    log_first    (G,) log rho
    """

    scans: tuple[Any, ...]
    seconds: Floats
    offset: Ints
    scan: Ints
    log_clutter: Floats
    views: tuple[View, ...]
    prior: tuple[Components, ...]
    born: tuple[Components, ...]
    log_first: Floats


class Row(NamedTuple):
    """A track after a scan: log of what it weighs so far, weights (C,), means (C, n) and covariances (C, n, n)."""

    log_sum: float
    weight: Floats
    mean: Floats
    covariance: Floats


class Trail(NamedTuple):
    """A track, filtered.

    log_weight  log w - sum log lambda_c, -inf where it is impossible
    kind        (C,) of its components
    rows        of its scans, from first to last measurement
    alive       probability that it is still there at the scan of its last measurement, and at each later one until it
                surely is not
    """

    log_weight: float
    kind: Ints
    rows: list[Row]
    alive: Floats


def window_of(model: HasObjects, scans: Sequence[Any]) -> Window:
    """The window of scans. Raises InputError for none, and for one that the model cannot use."""
    if not len(scans):
        raise InputError("a window needs at least one scan, but got none; wait for the first")
    scans = tuple(sorted(model.check(scans), key=lambda scan: float(scan.time)))
    times = np.array([scan.time for scan in scans])
    size, waiting = len(model.names), no_objects(len(model.names))
    views, prior, born, first = list[View](), list[Components](), list[Components](), list[Floats]()
    seconds = np.diff(times, prepend=times[:1])
    for number, (scan, gap) in enumerate(zip(scans, seconds.tolist(), strict=True)):
        if gap > 0.0:
            waiting, arrived = moved(model, waiting, gap), model.arrivals(gap)
            expected = -np.log1p(-np.minimum(arrived.existence, SUREST))
            waiting = together(waiting, arrived._replace(existence=expected))
        new = _with_all(model.unseen(scan, scans[max(number - MEMORY, 0) : number]), waiting)
        view = model.view(scan, no_objects(size), new)
        mine = picked(new, np.arange(len(new.weight)), new.offset)
        first.append(see(*mine, np.arange(len(view.values)), *view, np.inf))
        views.append(model.view(scan, no_objects(size), no_components(size)))
        prior.append(new)
        born.append(mine)
        waiting = _missed(model, scan, waiting)
    count = [len(view.values) for view in views]
    with np.errstate(divide="ignore"):
        log_first = np.log(np.concatenate(first))
    return Window(
        scans,
        seconds,
        np.cumsum([0, *count]),
        np.repeat(np.arange(len(scans)), count),
        np.log(np.maximum(np.concatenate([view.clutter for view in views]), LEAST)),
        tuple(views),
        tuple(prior),
        tuple(born),
        log_first,
    )


def _with_all(new: Components, waiting: Bernoullis) -> Components:
    """Groups of new components, each joined by all that wait."""
    if not len(waiting.label):
        return new
    num, parts = len(new.offset) - 1, waiting.components
    weight = parts.weight * waiting.existence[parts.group]
    order = np.argsort(np.concatenate([new.group, np.repeat(np.arange(num), len(weight))]), kind="stable")
    rest = zip(new[1:], (weight, *parts[2:]), strict=True)
    joined = [np.concatenate([a, *([b] * num)])[order] for a, b in rest]
    return Components(new.offset + len(weight) * np.arange(num + 1), *joined)


def _missed(model: HasObjects, scan: Any, waiting: Bernoullis) -> Bernoullis:
    """Those that a scan did not show, but for too few."""
    num = len(waiting.label)
    if not num:
        return waiting
    view = model.view(scan, no_objects(len(model.names)), waiting.components)
    existence = waiting.existence * see(*waiting.components, np.full(num, -1), *view, np.inf)
    keep = existence > FORGOTTEN
    return Bernoullis(waiting.label[keep], existence[keep], groups(waiting.components, keep))


def groups(components: Components, keep: Any) -> Components:
    """Some groups of components: keep (T,) says which."""
    size = np.diff(components.offset)
    return picked(components, np.repeat(keep, size), np.cumsum([0, *size[keep]]))


def group(components: Components, t: int) -> Components:
    """Group t alone."""
    begin, end = components.offset[t], components.offset[t + 1]
    return picked(components, np.arange(begin, end), np.array([0, end - begin]))


def picked(components: Components, rows: Any, offset: Ints) -> Components:
    """Some components, copied, in groups of their own."""
    _, weight, kind, mean, covariance = components
    return Components(offset, weight[rows], kind[rows], mean[rows], covariance[rows])


def joined(parts: Sequence[Components]) -> Components:
    """All groups of all."""
    offset = np.cumsum([0, *(size for part in parts for size in np.diff(part.offset))])
    return Components(offset, *(np.concatenate(values) for values in list(zip(*parts, strict=True))[1:]))


def follow(
    model: HasObjects,
    window: Window,
    tracks: Sequence[Track],
    known: Sequence[tuple[Trail, int] | None],
    *,
    gate: float,
) -> list[Trail]:
    """Filter tracks side by side. `known` has for each a trail whose first so many rows are its own, too, if any.

    A measurement farther than the gate (squared Mahalanobis distance) from all components makes a track impossible."""
    num, num_scans, size = len(tracks), len(window.scans), len(model.names)
    chosen = np.full((num, num_scans), -1)
    for i, track in enumerate(tracks):
        when = window.scan[list(track)]
        chosen[i, when] = np.array(track) - window.offset[when]
    first, last = (np.array([window.scan[track[end]] for track in tracks]) for end in (0, -1))
    begin = first + [0 if part is None else part[1] - 1 for part in known]
    kinds, rows = list[Ints](), list[list[Row]]()
    for i, part in enumerate(known):
        if part is None:
            start = group(window.born[first[i]], int(chosen[i, first[i]]))
            rows.append([Row(float(window.log_first[tracks[i][0]]), start.weight, start.mean, start.covariance)])
            kinds.append(start.kind)
        else:
            rows.append(part[0].rows[: part[1]])
            kinds.append(part[0].kind)
    log_sum = np.array([row[-1].log_sum for row in rows])
    alive, gone, lost = np.ones(num), np.zeros(num), np.zeros((num, num_scans))
    who, parts = np.zeros(0, dtype=np.int64), no_components(size)
    for s in range(int(begin.min()), num_scans):
        if len(who):
            objects = Bernoullis(who, np.ones(len(who)), parts)
            after = moved(model, objects, float(window.seconds[s])) if window.seconds[s] > 0.0 else _still(objects)
            parts, stays = after.components, after.existence
            view = model.view(window.scans[s], no_objects(size), parts)
            factor = stays * see(*parts, chosen[who, s], *view, gate)
            within = s <= last[who]
            with np.errstate(divide="ignore"):
                log_sum[who] += np.where(within, np.log(factor), 0.0)
            gone[who] += np.where(within, 0.0, alive[who] * (1.0 - stays))
            alive[who] *= np.where(within, 1.0, factor)
            for k in np.flatnonzero(within):
                at = slice(parts.offset[k], parts.offset[k + 1])
                own = (parts.weight[at], parts.mean[at], parts.covariance[at])
                rows[who[k]].append(Row(float(log_sum[who[k]]), *own))
            lost[who, s] = gone[who]
            keep = np.where(within, log_sum[who] > -np.inf, alive[who] > GONE)
            if not keep.all():
                for i in who[~keep]:
                    lost[i, s + 1 :] = gone[i]
                who, parts = who[keep], groups(parts, keep)
        entering = np.flatnonzero((begin == s) & (log_sum > -np.inf))
        if len(entering):
            starts = [Components(np.array([0, len(kinds[i])]), *_state(kinds[i], rows[i][-1])) for i in entering]
            who, parts = np.concatenate([who, entering]), joined([parts, *starts])
    end = gone + alive
    return [_trail(window, *each) for each in zip(tracks, log_sum, end, lost, last, kinds, rows, strict=True)]


def _still(objects: Bernoullis) -> Bernoullis:
    """The same objects, to be written on."""
    parts = objects.components
    return objects._replace(components=picked(parts, np.arange(len(parts.weight)), parts.offset))


def _state(kind: Ints, row: Row) -> tuple[Floats, Ints, Floats, Floats]:
    return row.weight, kind, row.mean, row.covariance


def _trail(
    window: Window, track: Track, log_sum: float, end: float, lost: Floats, last: int, kind: Ints, rows: list[Row]
) -> Trail:
    """Of probability `end` to be missed after the last scan, and lost (T,) to be so and have gone by each."""
    if not log_sum > -math.inf:
        return Trail(-math.inf, kind, rows, np.zeros(0))
    weight = float(log_sum) + math.log(end) - float(window.log_clutter[list(track)].sum())
    alive = np.maximum(1.0 - np.concatenate([[0.0], lost[last + 1 :]]) / end, 0.0)
    return Trail(weight, kind, rows, np.trim_zeros(alive, "b"))
