"""Lanes as polylines with offsets in machine code: single-site moves and a density that remembers its lanes.

    vertex i of a lane = station i + o_i normal i
    log prior      = - sum o^2 / (2 offset_std^2) - sum (o_{i-1} - 2 o_i + o_{i+1})^2 / (2 bend_std^2) + const
    log likelihood = - sum d^2 / (2 position_std^2) + const

d is the distance of a point from the line through the two vertices of its segment; for all points of a segment it
follows from their number, mean and scatter.
"""

from __future__ import annotations

import math

import numba as nb

from models.intersection.window import window
from models.overwrite import overwrite

NUM_UNIFORMS = 3
# floats: settings, then the stations of all lanes and the points of all segments; ints: lanes, stations of each
STEP_STD, OFFSET_WEIGHT, BEND_WEIGHT, POINT_WEIGHT, LOG_PRIOR, LOG_LIKELIHOOD = range(6)
SETTINGS = 6
STATION = 4  # x, y and the normal
MOMENTS = 6  # number, mean x, y and sums of squared deviations xx, xy, yy


def propose(kind, z, u, floats, ints, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """Move one offset, any of them, by N(0, step_std^2) in Box and Muller's form; u[2] + 1/2 turns the step round."""
    overwrite(z_new, z)
    overwrite(u_new, u)
    site = min(int(u[0] * len(z)), len(z) - 1)
    z_new[site] += floats[STEP_STD] * math.sqrt(-2.0 * math.log(1.0 - u[1])) * math.cos(2.0 * math.pi * u[2])
    u_new[2] = u[2] + 0.5 if u[2] < 0.5 else u[2] - 0.5
    log_q[0] = log_q[1] = log_q[2] = 0.0
    return True


@nb.njit(error_model="numpy")
def lane_prior(offsets, floats):  # type: ignore[no-untyped-def]
    """Log prior of the offsets (n,) of a lane, without its constant."""
    squares, bends = 0.0, 0.0
    for i in range(len(offsets)):
        squares += offsets[i] ** 2
        if 0 < i < len(offsets) - 1:
            bends += (offsets[i - 1] - 2.0 * offsets[i] + offsets[i + 1]) ** 2
    return -0.5 * (floats[OFFSET_WEIGHT] * squares + floats[BEND_WEIGHT] * bends)


@nb.njit(error_model="numpy")
def lane_likelihood(offsets, lane, lanes, floats):  # type: ignore[no-untyped-def]
    """Log likelihood of the points of a lane, without its constant."""
    num, squares = len(offsets), 0.0
    stations = window(floats, SETTINGS, (lanes, num, STATION))[lane]
    segments = window(floats, SETTINGS + lanes * num * STATION, (lanes, num - 1, MOMENTS))[lane]
    x, y = stations[0, 0] + offsets[0] * stations[0, 2], stations[0, 1] + offsets[0] * stations[0, 3]
    for i in range(num - 1):
        end, points = stations[i + 1], segments[i]
        next_x, next_y = end[0] + offsets[i + 1] * end[2], end[1] + offsets[i + 1] * end[3]
        length = math.hypot(next_x - x, next_y - y)
        nx, ny = (y - next_y) / length, (next_x - x) / length
        mean = nx * (points[1] - x) + ny * (points[2] - y)
        squares += points[0] * mean**2 + nx * nx * points[3] + 2.0 * nx * ny * points[4] + ny * ny * points[5]
        x, y = next_x, next_y
    return -0.5 * floats[POINT_WEIGHT] * squares


@nb.njit
def log_likelihood(z, floats, ints):  # type: ignore[no-untyped-def]
    """Log likelihood of a packed state."""
    lanes, num, total = ints[0], ints[1], floats[LOG_LIKELIHOOD]
    for lane in range(lanes):
        total += lane_likelihood(z[lane * num : (lane + 1) * num], lane, lanes, floats)
    return total


def cache_size(lanes: int, num: int) -> int:
    """Room for two rows of every lane, the current one and the one evaluated last, and which is which."""
    return 1 + 2 * lanes + 2 * lanes * (num + 3)


def evaluate(z, floats, ints, cache, out):  # type: ignore[no-untyped-def]
    """out = (log prior, log likelihood) of a packed state; only lanes that differ from the current state are new."""
    lanes, num = ints[0], ints[1]
    cache[0] = lanes
    current, latest = window(cache, 1, (lanes,)), window(cache, 1 + lanes, (lanes,))
    rows = window(cache, 1 + 2 * lanes, (lanes, 2, num + 3))  # known, prior, likelihood, offsets
    out[0], out[1] = floats[LOG_PRIOR], floats[LOG_LIKELIHOOD]
    for lane in range(lanes):
        offsets, row = window(z, lane * num, (num,)), rows[lane, int(current[lane])]
        known = row[0] == 1.0
        for i in range(num):
            known = known and row[3 + i] == offsets[i]
        latest[lane] = current[lane] if known else 1.0 - current[lane]
        row = rows[lane, int(latest[lane])]
        if not known:
            row[0], row[1] = 1.0, lane_prior(offsets, floats)
            row[2] = lane_likelihood(offsets, lane, lanes, floats)
            overwrite(row[3:], offsets)
        out[0] += row[1]
        out[1] += row[2]


def commit(cache):  # type: ignore[no-untyped-def]
    """Keep the rows evaluated last."""
    lanes = int(cache[0])
    for lane in range(lanes):
        cache[1 + lane] = cache[1 + lanes + lane]
