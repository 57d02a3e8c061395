"""From tracks to half tracks: where they cross, which part is on which arm, how far out each point is."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.intersection.wrap import wrap

SMOOTHING = 4  # points on either side
END = 24  # points at a track's end that show an arm's direction
TURN = 0.25  # change of direction that ends an arm [rad]
LASTING = 5  # points that must have turned: smoothed noise lasts, too
MARGIN = 4  # points left out before a turn
ENOUGH = 30.0  # [m] of a half track
CROSSES = 40.0  # [m] from the crossing: a track that stays farther away is none of its vehicles
LEAST_EXTENT = 4.0  # [m] from end to end: a standing vehicle shows no direction
LEAST_RADIUS = 12.0  # [m] inside which no point is on an arm


@nb.njit(cache=True)
def smooth(points, offsets):  # type: ignore[no-untyped-def]
    """Moving average of 2 SMOOTHING + 1 points, shorter towards the ends of a track."""
    out = np.empty_like(points)
    for t in range(len(offsets) - 1):
        first, last = offsets[t], offsets[t + 1]
        for i in range(first, last):
            reach = min(SMOOTHING, i - first, last - 1 - i)
            sx = sy = 0.0
            for j in range(i - reach, i + reach + 1):
                sx += points[j, 0]
                sy += points[j, 1]
            out[i, 0], out[i, 1] = sx / (2 * reach + 1), sy / (2 * reach + 1)
    return out


@nb.njit(cache=True)
def path_headings(path, offsets):  # type: ignore[no-untyped-def]
    """Driving direction along a smoothed path, unwrapped along each track [rad]."""
    out = np.zeros(len(path))
    for t in range(len(offsets) - 1):
        first, last = offsets[t], offsets[t + 1]
        before = 0.0
        for i in range(first, last):
            low, high = max(first, i - SMOOTHING), min(last - 1, i + SMOOTHING)
            angle = math.atan2(path[high, 1] - path[low, 1], path[high, 0] - path[low, 0])
            before = angle if i == first else before + wrap(angle - before)
            out[i] = before
    return out


@nb.njit(cache=True)
def unwrap(heading, offsets):  # type: ignore[no-untyped-def]
    """Headings without jumps of 2 pi along each track."""
    out = heading.copy()
    for t in range(len(offsets) - 1):
        for i in range(offsets[t] + 1, offsets[t + 1]):
            out[i] = out[i - 1] + wrap(heading[i] - out[i - 1])
    return out


@nb.njit(cache=True)
def crossing(path, offsets):  # type: ignore[no-untyped-def]
    """Where the lines through the outer ends of the tracks meet, by least squares, (2,).

    minimise sum_ends (n . (c - p))^2, with a weak pull to the mean of all points"""
    mx, my = path[:, 0].mean(), path[:, 1].mean()
    weak = 0.01 * (len(offsets) - 1) + 1e-9
    a, b, d, u, v = weak, 0.0, weak, weak * mx, weak * my
    for t in range(len(offsets) - 1):
        first, last = offsets[t], offsets[t + 1]
        size = min(END, (last - first) // 2)
        if size < 6:
            continue
        for begin in (first, last - size):
            half = size // 2
            x0 = path[begin : begin + half, 0].mean()
            y0 = path[begin : begin + half, 1].mean()
            x1 = path[begin + half : begin + size, 0].mean()
            y1 = path[begin + half : begin + size, 1].mean()
            length = math.hypot(x1 - x0, y1 - y0)
            if length < 1.0:
                continue
            nx, ny = -(y1 - y0) / length, (x1 - x0) / length
            offset = nx * 0.5 * (x0 + x1) + ny * 0.5 * (y0 + y1)
            a += nx * nx
            b += nx * ny
            d += ny * ny
            u += nx * offset
            v += ny * offset
    det = a * d - b * b
    return np.array([(d * u - b * v) / det, (a * v - b * u) / det])


@nb.njit
def closest_index(path, first, last, x, y):  # type: ignore[no-untyped-def]
    """Index of the point of path[first:last] closest to (x, y): every sixth, then around the best."""
    best, index = 1e300, first
    for i in range(first, last, 6):
        d = (path[i, 0] - x) ** 2 + (path[i, 1] - y) ** 2
        if d < best:
            best, index = d, i
    for i in range(max(first, index - 5), min(last, index + 6)):
        d = (path[i, 0] - x) ** 2 + (path[i, 1] - y) ** 2
        if d < best:
            best, index = d, i
    return index


@nb.njit
def straight_end(turn, outer, inner, margin):  # type: ignore[no-untyped-def]
    """How far in from its outer end a half track keeps its direction: the first index that is left out.

    Walks from index `outer` towards `inner` and stops where LASTING headings in a row differ by more than TURN from
    the mean of the outermost third, `margin` points before it; the third itself is straight by definition, or the
    noise of short steps would take whole tracks away."""
    step = 1 if inner >= outer else -1
    third = max(abs(inner - outer) // 3, 3)
    mean = 0.0
    for j in range(third):
        mean += turn[outer + step * j] / third
    run = 0
    for j in range(third, abs(inner - outer)):
        run = run + 1 if abs(wrap(turn[outer + step * j] - mean)) > TURN else 0
        if run == LASTING:
            return outer + step * max(j + 1 - LASTING - margin, 0)
    return inner


@nb.njit(cache=True)
def outer_halves(path, turn, offsets, centre, inner_radius, min_points):  # type: ignore[no-untyped-def]
    """Parts of the tracks on the arms, entries first: begin, end (H,), number of entries.

    The entry half ends where the track first comes inside inner_radius or begins to turn, the exit half begins where
    it leaves it last or has turned; a half that does not reach out far enough to leave ENOUGH metres comes closer. A
    track that stays CROSSES metres away does not cross."""
    num = len(offsets) - 1
    begin, end = np.zeros(2 * num, np.int64), np.zeros(2 * num, np.int64)
    count, entries = 0, 0
    for side in range(2):
        for t in range(num):
            first, last = offsets[t], offsets[t + 1]
            k = closest_index(path, first, last, centre[0], centre[1])
            if (path[k, 0] - centre[0]) ** 2 + (path[k, 1] - centre[1]) ** 2 > CROSSES * CROSSES:
                continue
            step, outer = (-1, first) if side == 0 else (1, last - 1)
            reach = math.hypot(path[outer, 0] - centre[0], path[outer, 1] - centre[1])
            keep2 = min(max(reach - ENOUGH, LEAST_RADIUS), inner_radius) ** 2
            while first <= k < last and (path[k, 0] - centre[0]) ** 2 + (path[k, 1] - centre[1]) ** 2 < keep2:
                k += step
            low, high = (first, k + 1) if side == 0 else (k, last)
            if high - low < min_points:
                continue
            if side == 0:
                high = straight_end(turn, low, high, MARGIN)
            else:
                low = straight_end(turn, high - 1, low, MARGIN)
            extent = math.hypot(path[high - 1, 0] - path[low, 0], path[high - 1, 1] - path[low, 1])
            if high - low >= min_points and extent > LEAST_EXTENT:
                begin[count], end[count] = low, high
                count += 1
        if side == 0:
            entries = count
    return begin[:count], end[:count], entries


@nb.njit(cache=True)
def gather_halves(points, path, phi, begin, end, entries, origin):  # type: ignore[no-untyped-def]
    """Points of all halves one after the other, about the origin: observed (3, N), s (N,), starts.

    s is the distance from the origin along the half's own mean outward direction: a covariate."""
    num = len(begin)
    starts = np.zeros(num + 1, np.int64)
    for h in range(num):
        starts[h + 1] = starts[h] + end[h] - begin[h]
    observed, s = np.empty((3, starts[num])), np.empty(starts[num])
    for h in range(num):
        first, last = begin[h], end[h]
        middle = (first + last) // 2
        dx = path[middle:last, 0].mean() - path[first:middle, 0].mean()
        dy = path[middle:last, 1].mean() - path[first:middle, 1].mean()
        length = math.hypot(dx, dy) * (1.0 if h >= entries else -1.0)
        dx, dy = dx / length, dy / length
        for i in range(first, last):
            j = starts[h] + i - first
            observed[0, j], observed[1, j] = points[i, 0] - origin[0], points[i, 1] - origin[1]
            observed[2, j] = phi[i]
            s[j] = dx * (path[i, 0] - origin[0]) + dy * (path[i, 1] - origin[1])
    return observed, s, starts
