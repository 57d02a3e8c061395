"""What one cue says of a course, in machine code: its log density and its residuals.

At the sample of the course nearest to the cue, with direction t = (cos, sin), normal n and curvature k,

    along = t . (p - f),   across = n . (p - f)

`exact`: the cue stands at arc length l with density seen(l) = Phi((reach - l) / reach_std), for cameras see so far and
not farther; across the course it is normal about its offset o,

    lateral  = across - k along^2 / 2 - o          distance from the parabola through the sample
    variance = m' Sigma m + spread^2               m the normal at the foot of the cue, t the tangent
    slant    = t' Sigma m / variance               how far along a cue is moved for each metre across
    turn     = wrap(direction of motion - heading - k along - pi of oncoming traffic)
    sight    = (reach - l - along + slant lateral) / sqrt(reach_std^2 + t' Sigma t - slant t' Sigma m)
    p        = (1 - clutter) N(lateral; 0, variance) N(turn; 0, flow) Phi(sight) + clutter / width / (2 pi)

Phi(sight) is the mean of seen(l) over where the cue may stand, given where it was measured. Without it the last cues
are taken where noise has put them, beyond the sight as often as not, and bends are underestimated there. Clutter is
anything that does not follow the road: a false detection, a side street. In a bend, noise along the road moves cues
across it by the order of k Sigma, which is left out: no correction of that order that was tried made slopes at the
truth less biased.

A vehicle v that changes lanes (probability c, all its detections together) is farther aside and turned,

    p_v      = (1 - c) prod_n p_n + c prod_n N(lateral_n; 0, variance_n + change_std^2) N(turn_n; 0, flow^2 + ..)

for single detections tell too little of it, and its last ones would bend the road (`score_groups`).

`paper`, [T17] eq. 4 and 5: the error is the distance from the predicted point on the normal of the sample, and one less
the correlation of the directions; both normal with variance sigma^2 / beta. There is no clutter and no end of sight.

Residuals r_i and rows J_i are such that -weight sum_i r_i J_i is the gradient of the log density in the local numbers
(along, across, heading, curvature, offset, arc length of the sample), and weight sum_i J_i J_i' its expected curvature;
weight is the probability that the cue follows the road.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.clothoid_kernel import ARC, BEND, COS, HEADING, SIN, X, Y
from models.intersection.wrap import wrap

# columns of a cue
PX, PY, FLOW, SXX, SXY, SYY, SPREAD, PRECISION, TURN, CONSTANT, CLUTTER, REACH, BLUR = range(13)
# SPREAD and BLUR (reach_std^2) are variances [m^2], PRECISION 1 / std [1/rad], CONSTANT a log density,
# CLUTTER a density or 0, REACH [m] from the start of the course, inf for no end of the sight
CHANGES, SPREAD_THERE, PRECISION_THERE, CONSTANT_THERE = range(13, 17)
# CHANGES is how probably its vehicle changes lanes, the others what it has then
WIDTH = 17
SPREADS = [SPREAD, SPREAD_THERE]  # what fog adds to
RESIDUALS = 4  # of a cue, at most
LOCAL = 7  # a residual and its slopes in along, across, heading, curvature, offset, arc length
ROOT_HALF = math.sqrt(0.5)
LOG_ROOT = 0.5 * math.log(2.0 * math.pi)
UNDERFLOW = -30.0  # past that erfc does
FAR_INSIDE = 6.5  # standard deviations of sight from where log Phi is flat


@nb.njit(error_model="numpy")
def nearest_sample(cues, n, table, step):  # type: ignore[no-untyped-def]
    """The sample of a table (num, 7) that is nearest to cue n, by a walk from where the chord says it is."""
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
def exact_cue(cues, n, offset, table, k, changes, rows):  # type: ignore[no-untyped-def]
    """(log density, weight) of cue n about sample k; residuals and slopes into rows (RESIDUALS, LOCAL), if any.

    changes  whether it is of a vehicle that changes lanes: it may be farther aside, and is no clutter"""
    spread, precision, constant, clutter = cues[n, SPREAD], cues[n, PRECISION], cues[n, CONSTANT], cues[n, CLUTTER]
    if changes:
        spread, precision, clutter = cues[n, SPREAD_THERE], cues[n, PRECISION_THERE], 0.0
        constant = cues[n, CONSTANT_THERE]
    c, s, bend = table[k, COS], table[k, SIN], table[k, BEND]
    dx, dy = cues[n, PX] - table[k, X], cues[n, PY] - table[k, Y]
    along, across = dx * c + dy * s, dy * c - dx * s
    q = bend * along
    mx, my, norm = -s - c * q, c - s * q, 1.0 / (1.0 + q * q)
    sx, sy = cues[n, SXX] * mx + cues[n, SXY] * my, cues[n, SXY] * mx + cues[n, SYY] * my
    variance = spread + norm * (mx * sx + my * sy)
    lateral = across - 0.5 * q * along - offset
    root = 1.0 / math.sqrt(variance)
    e = lateral * root
    turn = wrap(cues[n, FLOW] - table[k, HEADING] - q - cues[n, TURN]) * precision
    height, weight = constant - 0.5 * (e * e + turn * turn), 1.0
    skew = norm * (my * sx - mx * sy)  # t' Sigma m
    slant, blur, sight, seen = skew / variance, 1.0, math.inf, 1.0
    if cues[n, REACH] < math.inf:
        blur = math.sqrt(cues[n, BLUR] + cues[n, SXX] + cues[n, SYY] - (variance - spread) - slant * skew)
        sight = (cues[n, REACH] - table[k, ARC] - along + slant * lateral) / blur
    if sight < FAR_INSIDE:
        seen = 0.5 * math.erfc(-sight * ROOT_HALF) if sight > UNDERFLOW else 0.0
    if clutter > 0.0:
        road = root * seen * math.exp(height)
        weight = road / (road + clutter)
        log_density = math.log(road + clutter)
    elif seen > 0.0:
        log_density = height + math.log(root * seen)
    else:
        log_density = height + math.log(root) + normal_share(sight, seen)[0]
    if len(rows) == 0:
        return log_density, weight
    rows[:] = 0.0
    swing = -2.0 * ROOT_HALF * slant  # d variance / d heading, over sqrt(2) variance
    rows[0, 0], rows[0, 1], rows[0, 2] = e, -q * root, root
    rows[0, 4], rows[0, 5] = -0.5 * along * along * root, -root
    rows[1, 0], rows[1, 1], rows[1, 3] = (1.0 - e * e) * ROOT_HALF, swing * norm * bend, swing
    rows[1, 4] = swing * norm * along
    rows[2, 0], rows[2, 1], rows[2, 3] = turn, -bend * precision, -precision
    rows[2, 4] = -along * precision
    if sight < FAR_INSIDE:
        _, mills, bent = normal_share(sight, seen)
        pull = math.sqrt(bent)
        unlike = 2.0 * (variance - spread) - cues[n, SXX] - cues[n, SYY]  # m' Sigma m - t' Sigma t
        slant_turn = (unlike + 2.0 * slant * skew) / variance  # d slant / d heading
        blur_turn = 2.0 * (skew - slant * unlike - slant * slant * skew)  # d blur^2 / d heading
        by_turn = (slant_turn * lateral - 0.5 * sight * blur_turn / blur) / blur
        scale = pull / blur
        rows[3, 0] = -mills / pull
        rows[3, 1], rows[3, 2] = -scale * (1.0 + slant * q) + pull * by_turn * norm * bend, scale * slant
        rows[3, 3], rows[3, 5], rows[3, 6] = pull * by_turn, -scale * slant, -scale
        rows[3, 4] = -0.5 * scale * slant * along * along + pull * by_turn * norm * along
    return log_density, weight


@nb.njit(error_model="numpy")
def normal_share(x, share):  # type: ignore[no-untyped-def]
    """log Phi(x), its slope phi / Phi, and minus its second derivative; share is Phi(x), or 0 past UNDERFLOW."""
    if share > 0.0:
        slope = math.exp(-0.5 * x * x - LOG_ROOT) / share
        return math.log(share), slope, slope * (x + slope)
    y = 1.0 / (x * x)
    series = -y * (1.0 - 3.0 * y * (1.0 - 5.0 * y * (1.0 - 7.0 * y)))
    log_share = -0.5 * x * x - math.log(-x) - LOG_ROOT + math.log1p(series)
    return log_share, -x / (1.0 + series), -x * x * series / (1.0 + series) ** 2


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
    return exact_cue(cues, n, offset, table, k, False, rows)


@nb.njit(error_model="numpy")
def find_samples(cues, table, step, near):  # type: ignore[no-untyped-def]
    """The nearest sample of every cue, near (N,)."""
    for n in range(len(cues)):
        near[n] = nearest_sample(cues, n, table, step)


@nb.njit(error_model="numpy")
def score_groups(paper, cues, group, near, offset, table, out, changes, rows=None, weights=None):  # type: ignore[no-untyped-def]
    """Log densities of groups, out (G,), at offsets (G,) [m], and the probability of each to change lanes, (G,).

    near     (N,) the sample of the table that each cue is scored about
    rows     (2, N, RESIDUALS, LOCAL) of every cue if it follows the road, and if its vehicle changes lanes; the latter
             are not filled where it cannot
    weights  (2, N) probabilities of both"""
    none, there = np.empty((0, LOCAL)), np.zeros(len(offset))
    out[:] = 0.0
    changes[:] = 0.0
    for n in range(len(cues)):
        g, k = group[n], near[n]
        if weights is None:  # known when this is compiled
            out[g] += score_cue(paper, cues, n, offset[g], table, k, none)[0]
        else:
            height, weights[0, n] = score_cue(paper, cues, n, offset[g], table, k, rows[0, n])
            out[g] += height
        if cues[n, CHANGES] > 0.0:
            changes[g] = cues[n, CHANGES]
            there[g] += exact_cue(cues, n, offset[g], table, k, True, none if rows is None else rows[1, n])[0]
    for g in range(len(offset)):
        if changes[g] > 0.0:
            out[g], changes[g] = with_changes(changes[g], out[g], there[g])
    if weights is not None:
        for n in range(len(cues)):
            weights[0, n] *= 1.0 - changes[group[n]]
            weights[1, n] = changes[group[n]]


@nb.njit(error_model="numpy")
def with_changes(chance, stays, leaves):  # type: ignore[no-untyped-def]
    """Log density of a vehicle that changes lanes with a chance, from those if it stays and if it leaves; and the
    probability that it leaves."""
    stays, leaves = math.log1p(-chance) + stays, math.log(chance) + leaves
    most = max(stays, leaves)
    total = most + math.log(math.exp(stays - most) + math.exp(leaves - most))
    return total, math.exp(leaves - total)
