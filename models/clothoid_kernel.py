"""Clothoids in machine code, for compiled densities: the equations are those of models.clothoid.

Nothing here raises. Ends that no sane clothoid joins get length inf, curvature and rate 0: test the length before
the numbers are used.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.intersection.wrap import wrap

X, Y, HEADING, CURVATURE, RATE, LENGTH = range(6)  # numbers of a clothoid, ordered as models.clothoid.Clothoid
COS, SIN, BEND, ARC = 3, 4, 5, 6  # columns of a table after x, y and heading; then curvature and arc length
COLUMNS = 7

MAX_STRETCH = 8.0  # length over chord beyond which ends are refused: they point away from each other
MIN_CHORD = 1e-6  # [m]: nearer ends have no direction
# sin(bow) averages zero near bow = (p + q) * polynomial in p / pi, q / pi: Bertolazzi and Frego (2013), section 4
GUESS = (2.989696028701907, 0.716228953608281, -0.458969738821509, -0.502821153340377, 0.261062141752652)
GUESS_LAST = -0.045854475238709
_x, _w = np.polynomial.legendre.leggauss(16)
NODES, WEIGHTS = (_x + 1.0) / 2.0, _w / 2.0  # Gauss-Legendre on [0, 1]
HALLEY_STEPS = 5  # at most; the fourth changes nothing for any headings
ANCHOR = 16
SETTLED = 1e-6  # [rad]; the step cubes the error


@nb.njit(error_model="numpy")
def guess_bow(p, q):  # type: ignore[no-untyped-def]
    """A start for the steps: within 0.6 rad of the bow for any p and q, and far nearer on roads."""
    a, b = p / math.pi, q / math.pi
    ab, squares = a * b, a * a + b * b
    inner = GUESS[0] + ab * (GUESS[1] + ab * GUESS[2]) + (GUESS[3] + ab * GUESS[4]) * squares
    return (p + q) * (inner + GUESS_LAST * squares * squares)


@nb.njit(error_model="numpy")
def hermite_one(x0, y0, heading0, x1, y1, heading1, out):  # type: ignore[no-untyped-def]
    """The clothoid from (x0, y0, heading0) to (x1, y1, heading1) into out (6,): x, y, heading, curvature, rate, length
    [m, m, rad, 1/m, 1/m^2, m]."""
    out[X], out[Y], out[HEADING], out[CURVATURE], out[RATE], out[LENGTH] = x0, y0, heading0, 0.0, 0.0, np.inf
    dx, dy = x1 - x0, y1 - y0
    chord, along = math.hypot(dx, dy), math.atan2(dy, dx)
    p, q = wrap(heading0 - along), wrap(heading1 - along)
    if not (MIN_CHORD < chord < np.inf and math.isfinite(p) and math.isfinite(q)):
        return
    bow = guess_bow(p, q)
    shrink = 0.0
    for _ in range(HALLEY_STEPS):
        g = g1 = g2 = h = h1 = h2 = 0.0
        for i in range(len(NODES)):
            t, weight = NODES[i], WEIGHTS[i]
            slope = t * t - t
            angle = bow * slope + (q - p) * t + p
            sin, cos = weight * math.sin(angle), weight * math.cos(angle)
            g, g1, g2 = g + sin, g1 + slope * cos, g2 - slope * slope * sin
            h, h1, h2 = h + cos, h1 - slope * sin, h2 - slope * slope * cos
        step = -2.0 * g * g1 / (2.0 * g1 * g1 - g * g2)
        bow, shrink = bow + step, h + step * (h1 + 0.5 * step * h2)
        if abs(step) < SETTLED:
            break
    if shrink * MAX_STRETCH >= 1.0:
        out[LENGTH] = chord / shrink
        out[CURVATURE], out[RATE] = (q - p - bow) / out[LENGTH], 2.0 * bow / out[LENGTH] ** 2


@nb.njit(error_model="numpy")
def sample_one(clothoid, table):  # type: ignore[no-untyped-def]
    """Samples at equal steps of arc length, both ends included, into table (num, 7): x, y, heading, its cosine and
    sine, curvature, arc length. clothoid (6,) as hermite_one fills it, of finite length; returns the step [m].

    From half step to half step the direction is rotated by a turn that is itself rotated by rate step^2 / 4: much
    cheaper than cosines. Every ANCHOR samples it is computed anew, before rounding adds up."""
    step, heading0 = clothoid[LENGTH] / (len(table) - 1), clothoid[HEADING]
    curvature, rate = clothoid[CURVATURE], clothoid[RATE]
    x, y, half = clothoid[X], clothoid[Y], 0.5 * step
    cos = sin = turn_cos = turn_sin = 0.0
    more_cos, more_sin = math.cos(rate * half * half), math.sin(rate * half * half)
    for k in range(len(table)):
        s = k * step
        heading, bend = heading0 + s * (curvature + 0.5 * rate * s), curvature + rate * s
        if k % ANCHOR == 0:
            turn = half * (bend + 0.5 * rate * half)
            cos, sin, turn_cos, turn_sin = math.cos(heading), math.sin(heading), math.cos(turn), math.sin(turn)
        table[k, X], table[k, Y], table[k, HEADING] = x, y, heading
        table[k, COS], table[k, SIN], table[k, BEND], table[k, ARC] = cos, sin, bend, s
        sum_cos, sum_sin = cos, sin
        for weight in (4.0, 1.0):
            cos, sin = cos * turn_cos - sin * turn_sin, sin * turn_cos + cos * turn_sin
            turn_cos, turn_sin = turn_cos * more_cos - turn_sin * more_sin, turn_sin * more_cos + turn_cos * more_sin
            sum_cos, sum_sin = sum_cos + weight * cos, sum_sin + weight * sin
        x += step / 6.0 * sum_cos
        y += step / 6.0 * sum_sin
    return step
