"""Log likelihood of half tracks given the lanes of an intersection, in machine code.

One arm's row holds, for every half track, the cost of belonging to that arm; the rows of all arms
together make the likelihood. `exact` sums over the unknown lane labels,

    log p(half) = log( (1 - clutter) / L  sum_arm sum_lane exp(-cost) + clutter p_0(half) )

`half` and `point` keep the closest lane only, as [M20] section III-B does, and add the multinomial
coefficient of the track counts per lane: log T! - sum_l log n_l! - T log L. They are scores, not
normalised densities. `point` associates every point by itself, as printed; `half` every half track.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.intersection.moments import (
    A0,
    A_K,
    A_KK,
    A_KX,
    A_KY,
    A_X,
    A_XX,
    A_XY,
    A_Y,
    A_YY,
    CHORD,
    OUTGOING,
    SIDE,
    W_ACROSS,
    W_ALONG,
    W_HEADING,
    S,
    T,
    X,
    Y,
)
from models.intersection.wrap import wrap

EXACT, HALF, POINT = 0, 1, 2
LIKELIHOODS = {"exact": EXACT, "half": HALF, "point": POINT}
NEGLIGIBLE = 25.0  # an arm with less than exp(-25) of the best one's weight is left out of the sum
FAR_LANE = 18.0  # a lane with less than exp(-18) of the closest one's weight is left out of the sum
NO_LANE = 1e18  # cost where an arm has no lane of the driving direction
LOG_FACTORIAL = np.array([math.lgamma(n + 1.0) for n in range(256)])
FAST = {"reassoc", "contract", "arcp", "nsz", "nnan"}


@nb.njit(fastmath=FAST, error_model="numpy")
def scatter_row(coef, dx, dy, bend, out):  # type: ignore[no-untyped-def]
    """Cost of the scatter of every half track around lanes of direction (dx, dy) and this bend, (H,)."""
    xx, yy, xy = dx * dx, dy * dy, dx * dy
    kx, ky, kk = bend * dx, bend * dy, bend * bend
    for h in range(coef.shape[1]):
        straight = coef[A0, h] + xx * coef[A_XX, h] + yy * coef[A_YY, h] + xy * coef[A_XY, h]
        straight += dx * coef[A_X, h] + dy * coef[A_Y, h]
        out[h] = straight + ky * coef[A_KY, h] - kx * coef[A_KX, h] + bend * coef[A_K, h] + kk * coef[A_KK, h]


@nb.njit(fastmath=FAST, error_model="numpy")
def closest_lane(beyond, width, top):  # type: ignore[no-untyped-def]
    """Number of the lane, 0 the innermost and `top` the outermost, whose middle is closest."""
    k = np.floor(beyond / width + 0.5)  # math.floor would make a whole number of it and back
    k = k if k > 0.0 else 0.0
    return k if k < top else top


@nb.njit(fastmath=FAST, error_model="numpy")
def beyond_innermost(coef, h, dx, dy, axis, arm):  # type: ignore[no-untyped-def]
    """Distance of a half from the middle of the innermost lane of an arm of direction (dx, dy), outwards [m]."""
    across = -dy * coef[X, h] + dx * coef[Y, h] - axis - arm[5] * coef[T, h]
    return coef[SIDE, h] * across - 0.5 * arm[1] - 0.5 * arm[4]


@nb.njit(fastmath=FAST, error_model="numpy")
def axis_of(dx, dy, cx, cy, arm):  # type: ignore[no-untyped-def]
    """Distance of the axis of an arm of direction (dx, dy) from the origin, to the left [m]."""
    return -dy * cx + dx * cy + arm[6]


@nb.njit(fastmath=FAST, error_model="numpy")
def lane_number(coef, h, cx, cy, dx, dy, arm):  # type: ignore[no-untyped-def]
    """Number of the lane of an arm of direction (dx, dy) that is closest to a half, 0 the innermost."""
    top = arm[2] - 1.0 if coef[SIDE, h] > 0.0 else arm[3] - 1.0
    return closest_lane(beyond_innermost(coef, h, dx, dy, axis_of(dx, dy, cx, cy, arm), arm), arm[4], top)


@nb.njit(fastmath=FAST, error_model="numpy")
def mean_row(coef, cx, cy, dx, dy, arm, scatter, cost):  # type: ignore[no-untyped-def]
    """Cost of every half track with its closest lane of an arm, (H,); NO_LANE where it has none of the side.

    arm = (angle, gap, entries, exits, width, bend, shift), (dx, dy) its direction; scatter (H,) from `scatter_row`.
    One loop from 0 over whole rows with one store: this is what compilers turn into vector code."""
    width, bend = arm[4], arm[5]
    axis, along = axis_of(dx, dy, cx, cy, arm), dx * cx + dy * cy
    in_top, out_top = arm[2] - 1.0, arm[3] - 1.0
    outgoing = arm[0] - 0.5 * CHORD * bend
    for h in range(coef.shape[1]):
        top = in_top if coef[SIDE, h] > 0.0 else out_top
        beyond = beyond_innermost(coef, h, dx, dy, axis, arm)
        r = beyond - width * closest_lane(beyond, width, top)
        v = dx * coef[X, h] + dy * coef[Y, h] - along - coef[S, h]
        p = wrap(coef[OUTGOING, h] - outgoing - bend * coef[S, h])
        mean = coef[W_ACROSS, h] * r * r + coef[W_ALONG, h] * v * v + coef[W_HEADING, h] * p * p
        value = scatter[h] + 0.5 * mean
        cost[h] = value if top >= 0.0 else NO_LANE


@nb.njit(error_model="numpy")
def sum_lanes_row(coef, cx, cy, dx, dy, arm, stray, cost):  # type: ignore[no-untyped-def]
    """Turn the cost of the closest lane of an arm into -log sum over its lanes of exp(-cost), (H,).

    Halves that are far better off as stray ones are left alone: they add nothing that counts."""
    width = arm[4]
    axis = axis_of(dx, dy, cx, cy, arm)
    for h in range(coef.shape[1]):
        if cost[h] > stray[h] + 3.0 * NEGLIGIBLE:
            continue
        top = arm[2] - 1.0 if coef[SIDE, h] > 0.0 else arm[3] - 1.0
        beyond = beyond_innermost(coef, h, dx, dy, axis, arm)
        k = closest_lane(beyond, width, top)
        unit, r = 0.5 * coef[W_ACROSS, h] * width, beyond - k * width
        up = unit * (width - 2.0 * r) if k < top else FAR_LANE
        down = unit * (width + 2.0 * r) if k > 0.0 else FAR_LANE
        if up >= FAR_LANE and down >= FAR_LANE:
            continue
        extra = 0.0
        for side in range(2):
            sign, room = (1.0, int(top - k)) if side == 0 else (-1.0, int(k))
            for j in range(1, room + 1):
                more = unit * j * (j * width - 2.0 * sign * r)
                if more > FAR_LANE:
                    break
                extra += math.exp(-more)
        if extra < 1e-3:  # log(1 + extra), to 1e-13
            cost[h] -= extra * (1.0 - extra * (0.5 - extra / 3.0))
        else:
            cost[h] -= math.log1p(extra)


@nb.njit(fastmath=FAST, error_model="numpy")
def two_lowest(rows, pick, num_arms, low, second):  # type: ignore[no-untyped-def]
    """The lowest and the second lowest cost of every half over the arms, (H,)."""
    low[:] = NO_LANE
    second[:] = NO_LANE
    for a in range(num_arms):
        row = rows[int(pick[a]), a]
        for h in range(len(low)):
            value, least = row[h], low[h]
            above = value if value > least else least
            low[h] = value if value < least else least
            second[h] = above if above < second[h] else second[h]


@nb.njit(fastmath=FAST, error_model="numpy")
def best_alone(side, labels, shares, stray, low, second):  # type: ignore[no-untyped-def]
    """Log likelihood as if every half were where it is best; `second` becomes what its next best place costs more.

    labels  log probability of a lane (exits, entries), shares log probability of a stray half"""
    total = 0.0
    for h in range(len(low)):
        label, share = (labels[1], shares[1]) if side[h] > 0.0 else (labels[0], shares[0])
        lane, alone = low[h] - label, stray[h] - share
        best = lane if lane < alone else alone
        total -= best
        other, more = second[h] - label - best, (lane if lane > alone else alone) - best
        second[h] = more if more < other else other
    return total


@nb.njit(error_model="numpy")
def sum_arms(rows, pick, num_arms, side, lanes, stray, log_clutter, log_kept, low, second):  # type: ignore[no-untyped-def]
    """Log likelihood of all halves, labels summed out.

    rows         (2, A, H) costs; rows[pick[a], a] is the one that counts
    side         (H,) +1 entries, -1 exits
    lanes        lanes of all arms (exits, entries); where there is none every half is stray
    stray        (H,) -log p_0 minus the Gaussian normaliser of the half
    log_clutter  log of the share of clutter, log_kept of the rest
    low, second  (H,) from `two_lowest`; second is used up"""
    some = (lanes[0] > 0.5, lanes[1] > 0.5)
    labels = (
        log_kept - math.log(lanes[0]) if some[0] else -NO_LANE,
        log_kept - math.log(lanes[1]) if some[1] else -NO_LANE,
    )
    shares = (log_clutter if some[0] else 0.0, log_clutter if some[1] else 0.0)
    total = best_alone(side, labels, shares, stray, low, second)
    for h in range(len(low)):
        if second[h] < NEGLIGIBLE:
            label, share = (labels[1], shares[1]) if side[h] > 0.0 else (labels[0], shares[0])
            alone = stray[h] - share
            best = min(low[h] - label, alone)
            weight = math.exp(best - alone)
            for a in range(num_arms):
                weight += math.exp(best - (rows[int(pick[a]), a, h] - label))
            total += math.log(weight)
    return total


@nb.njit(error_model="numpy")
def closest_arms(coef, cx, cy, arms, rows, pick, num_arms, first, last, num_lanes, counts):  # type: ignore[no-untyped-def]
    """Score of halves first:last of one side with the closest lane each and multinomial counts.

    arms  (A, 7) of the state; a half without points, of weight 0, is on no lane"""
    if last == first:
        return 0.0
    if num_lanes < 0.5:
        return -math.inf
    counts[:] = 0.0
    total = 0.0
    for h in range(first, last):
        if coef[W_ACROSS, h] == 0.0:
            continue
        low, arm = math.inf, 0
        for a in range(num_arms):
            value = rows[int(pick[a]), a, h]
            if value < low:
                low, arm = value, a
        total -= low
        dx, dy = math.cos(arms[arm, 0]), math.sin(arms[arm, 0])
        counts[arm, int(lane_number(coef, h, cx, cy, dx, dy, arms[arm]))] += 1.0
    return total + multinomial(counts, num_lanes)


@nb.njit(error_model="numpy")
def multinomial(counts, num_lanes):  # type: ignore[no-untyped-def]
    """log T! - sum log n! - T log L of the track counts per lane."""
    tracks, total = 0.0, 0.0
    for a in range(counts.shape[0]):
        for lane in range(counts.shape[1]):
            count = counts[a, lane]
            tracks += count
            if count > 1.0:
                total -= LOG_FACTORIAL[int(count)] if count < 256.0 else math.lgamma(count + 1.0)
    return total + math.lgamma(tracks + 1.0) - tracks * math.log(num_lanes)


@nb.njit(error_model="numpy")
def closest_points(points, begin, end, first, last, side, cx, cy, arms, num_arms, num_lanes, noise, counts):  # type: ignore[no-untyped-def]
    """Score of halves first:last of one side, every point with its closest lane ([M20] III-B).

    Half h holds points begin[h]:end[h], rows (x, y, heading); noise = (position, heading) deviations.
    A half counts for the lane that is closest to most of its points, one without points for none."""
    if last == first:
        return 0.0
    if num_lanes < 0.5:
        return -math.inf
    counts[:] = 0.0
    votes = counts.copy()
    turns = np.empty((2, num_arms))
    for a in range(num_arms):
        turns[0, a], turns[1, a] = math.cos(arms[a, 0]), math.sin(arms[a, 0])
    total = 0.0
    for h in range(first, last):
        if begin[h] == end[h]:
            continue
        votes[:] = 0.0
        for i in range(begin[h], end[h]):
            low, arm, lane = math.inf, 0, 0
            for a in range(num_arms):
                num = arms[a, 2] if side > 0 else arms[a, 3]
                if num < 0.5:
                    continue
                angle, gap, width = arms[a, 0], arms[a, 1], arms[a, 4]
                across = turns[0, a] * (points[1, i] - cy) - turns[1, a] * (points[0, i] - cx) - arms[a, 6]
                e = side * across - 0.5 * gap - 0.5 * width
                k = min(max(math.floor(e / width + 0.5), 0.0), num - 1.0)
                r = (e - k * width) / noise[0]
                p = points[2, i] - angle - (math.pi if side > 0 else 0.0)
                p = wrap(p) / noise[1]
                cost = 0.5 * (r * r + p * p)
                if cost < low:
                    low, arm, lane = cost, a, int(k)
            total -= low
            votes[arm, lane] += 1.0
        most = votes.argmax()
        counts[most // counts.shape[1], most % counts.shape[1]] += 1.0
    return total + multinomial(counts, num_lanes)
