"""What one cue says of a course, in machine code: its log density and its residuals.

At the sample of the course nearest to the cue, with direction t = (cos, sin), normal n and curvature k,

    along = t . (p - f),   across = n . (p - f)

`exact`: the cue may be anywhere along the course (a flat density), and across it is normal about its offset o,

    lateral  = across - k along^2 / 2 - o          distance from the parabola through the sample
    variance = m' Sigma m + spread^2               m the normal at the foot of the cue
    turn     = wrap(direction of motion - heading - k along - pi of oncoming traffic)
    p        = (1 - clutter) N(lateral; 0, variance) N(turn; 0, flow) + clutter / width / (2 pi)

where clutter is anything that does not follow the road: a false detection, a side street, a vehicle changing lanes. In
a bend, noise along the road moves cues across it by the order of k Sigma: less than a tenth of a standard deviation,
and no correction of that order that was tried made slopes at the truth less biased.

`paper`, [T17] eq. 4 and 5: the error is the distance from the predicted point on the normal of the sample, and one less
the correlation of the directions; both normal with variance sigma^2 / beta. There is no clutter.

Residuals r_i and rows J_i are such that -weight sum_i r_i J_i is the gradient of the log density in the local numbers
(along, across, heading, curvature, offset) and weight sum_i J_i J_i' its expected curvature; weight is the probability
that the cue follows the road.
"""

from __future__ import annotations

import math

import numba as nb

from models.clothoid_kernel import BEND, COS, HEADING, SIN, X, Y
from models.intersection.wrap import wrap

# columns of a cue
PX, PY, FLOW, SXX, SXY, SYY, SPREAD, PRECISION, TURN, CONSTANT, CLUTTER = range(11)
WIDTH = 11  # SPREAD is a variance [m^2], PRECISION 1 / std [1/rad], CONSTANT a log density, CLUTTER a density or 0
ROOT_HALF = math.sqrt(0.5)


@nb.njit(error_model="numpy")
def nearest_sample(cues, n, table, step):  # type: ignore[no-untyped-def]
    """The sample of a table (num, 6) that is nearest to cue n, by a walk from where the chord says it is."""
    last = len(table) - 1
    chord_x, chord_y = table[last, X] - table[0, X], table[last, Y] - table[0, Y]
    share = ((cues[n, PX] - table[0, X]) * chord_x + (cues[n, PY] - table[0, Y]) * chord_y) / (chord_x**2 + chord_y**2)
    k = int(min(max(share, 0.0), 1.0) * last + 0.5)
    for _ in range(4):
        along = (cues[n, PX] - table[k, X]) * table[k, COS] + (cues[n, PY] - table[k, Y]) * table[k, SIN]
        new = min(max(k + math.floor(along / step + 0.5), 0), last)
        if new == k:
            break
        k = new
    along = (cues[n, PX] - table[k, X]) * table[k, COS] + (cues[n, PY] - table[k, Y]) * table[k, SIN]
    other = min(max(k + (1 if along > 0.0 else -1), 0), last)  # inside a bend either may be beyond half a step
    here = (cues[n, PX] - table[k, X]) ** 2 + (cues[n, PY] - table[k, Y]) ** 2
    there = (cues[n, PX] - table[other, X]) ** 2 + (cues[n, PY] - table[other, Y]) ** 2
    return other if there < here else k


@nb.njit(error_model="numpy")
def exact_cue(cues, n, offset, table, k, rows):  # type: ignore[no-untyped-def]
    """(log density, weight) of cue n about sample k; residuals (3,) and their rows (3, 5) into rows (3, 6), if any."""
    c, s, bend = table[k, COS], table[k, SIN], table[k, BEND]
    dx, dy = cues[n, PX] - table[k, X], cues[n, PY] - table[k, Y]
    along, across = dx * c + dy * s, dy * c - dx * s
    q = bend * along
    mx, my, norm = -s - c * q, c - s * q, 1.0 / (1.0 + q * q)
    sx, sy = cues[n, SXX] * mx + cues[n, SXY] * my, cues[n, SXY] * mx + cues[n, SYY] * my
    variance = cues[n, SPREAD] + norm * (mx * sx + my * sy)
    lateral = across - 0.5 * q * along - offset
    root = 1.0 / math.sqrt(variance)
    e = lateral * root
    turn = wrap(cues[n, FLOW] - table[k, HEADING] - q - cues[n, TURN]) * cues[n, PRECISION]
    log_road, weight = cues[n, CONSTANT] - 0.5 * (e * e + turn * turn), 1.0
    if cues[n, CLUTTER] > 0.0:
        road = root * math.exp(log_road)
        weight = road / (road + cues[n, CLUTTER])
        log_density = math.log(road + cues[n, CLUTTER])
    else:
        log_density = log_road + math.log(root)
    if len(rows) == 0:
        return log_density, weight
    swing = -2.0 * ROOT_HALF * norm * (my * sx - mx * sy) / variance  # d variance / d heading, over sqrt(2) variance
    rows[0, 0], rows[0, 1], rows[0, 2], rows[0, 3] = e, -q * root, root, 0.0
    rows[0, 4], rows[0, 5] = -0.5 * along * along * root, -root
    rows[1, 0], rows[1, 1], rows[1, 2], rows[1, 3] = (1.0 - e * e) * ROOT_HALF, swing * norm * bend, 0.0, swing
    rows[1, 4], rows[1, 5] = swing * norm * along, 0.0
    rows[2, 0], rows[2, 1], rows[2, 2], rows[2, 3] = turn, -bend * cues[n, PRECISION], 0.0, -cues[n, PRECISION]
    rows[2, 4], rows[2, 5] = -along * cues[n, PRECISION], 0.0
    return log_density, weight


@nb.njit(error_model="numpy")
def paper_cue(cues, n, offset, table, k, rows):  # type: ignore[no-untyped-def]
    """The same as printed."""
    c, s = table[k, COS], table[k, SIN]
    dx, dy = cues[n, PX] - table[k, X], cues[n, PY] - table[k, Y]
    root = 1.0 / math.sqrt(cues[n, SPREAD])
    along, lateral = (dx * c + dy * s) * root, (dy * c - dx * s - offset) * root
    turn = cues[n, FLOW] - table[k, HEADING] - cues[n, TURN]
    anti = (1.0 - math.cos(turn)) * cues[n, PRECISION]
    log_density = cues[n, CONSTANT] + math.log(root) - 0.5 * (along * along + lateral * lateral + anti * anti)
    if len(rows) == 0:
        return log_density, 1.0
    rows[:] = 0.0
    rows[0, 0], rows[0, 1] = along, root
    rows[1, 0], rows[1, 2], rows[1, 5] = lateral, root, -root
    rows[2, 0], rows[2, 3] = anti, -math.sin(turn) * cues[n, PRECISION]
    return log_density, 1.0


@nb.njit(error_model="numpy")
def score_cue(paper, cues, n, offset, table, k, rows):  # type: ignore[no-untyped-def]
    """(log density, weight) and rows of one or the other."""
    if paper:
        return paper_cue(cues, n, offset, table, k, rows)
    return exact_cue(cues, n, offset, table, k, rows)
