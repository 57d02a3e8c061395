"""How the samples of a clothoid move with the ends that it joins, in machine code.

    samples (x, y, heading, curvature)   in (x, y, heading, curvature, rate, length) of the clothoid     sample_row
    those numbers                        in C = (x, y, heading) of start and end                         hermite_slopes

The first is the derivative of Simpson's sums, the second that of the root of the Hermite fit (models.clothoid); both
are exact for what models.clothoid_kernel computes.
"""

from __future__ import annotations

import math

import numba as nb

from models.clothoid_kernel import BEND, COS, CURVATURE, HEADING, LENGTH, NODES, RATE, WEIGHTS, X, Y
from models.intersection.wrap import wrap


@nb.njit(error_model="numpy")
def moments(table, step, out):  # type: ignore[no-untyped-def]
    """Integrals from the start to each sample of s (cos, sin) and s^2 / 2 (cos, sin), out (num, 4), by Simpson.

    The directions half way between samples are in the table: Simpson made the positions from them."""
    out[0, 0] = out[0, 1] = out[0, 2] = out[0, 3] = 0.0
    for k in range(len(table) - 1):
        s0, s1 = k * step, (k + 1) * step
        s = 0.5 * (s0 + s1)
        for axis in range(2):
            v0, v1 = table[k, COS + axis], table[k + 1, COS + axis]
            middle = 6.0 / step * (table[k + 1, axis] - table[k, axis]) - v0 - v1  # four times
            out[k + 1, axis] = out[k, axis] + step / 6.0 * (s0 * v0 + s * middle + s1 * v1)
            out[k + 1, 2 + axis] = out[k, 2 + axis] + step / 12.0 * (s0 * s0 * v0 + s * s * middle + s1 * s1 * v1)


@nb.njit(error_model="numpy")
def sample_row(by_x, by_y, by_heading, by_curvature, k, clothoid, table, moment, out):  # type: ignore[no-untyped-def]
    """Chain derivatives in sample k to derivatives in the clothoid's numbers, out (6,)."""
    share = k / (len(table) - 1.0)
    s, curvature, rate, length = share * clothoid[LENGTH], clothoid[CURVATURE], clothoid[RATE], clothoid[LENGTH]
    dx, dy = table[k, X] - clothoid[X], table[k, Y] - clothoid[Y]
    c1, s1, c2, s2 = moment[k, 0], moment[k, 1], moment[k, 2], moment[k, 3]
    out[X], out[Y] = by_x, by_y
    out[HEADING] = by_heading - by_x * dy + by_y * dx
    out[CURVATURE] = by_curvature - by_x * s1 + by_y * c1 + by_heading * s
    out[RATE] = by_curvature * s - by_x * s2 + by_y * c2 + by_heading * 0.5 * s * s
    stretch_x = dx - curvature * s1 - 2.0 * rate * s2
    stretch_y = dy + curvature * c1 + 2.0 * rate * c2
    turn = by_heading * table[k, BEND] + by_curvature * rate
    out[LENGTH] = (by_x * stretch_x + by_y * stretch_y) / length + turn * share


@nb.njit(error_model="numpy")
def hermite_slopes(course, clothoid, out):  # type: ignore[no-untyped-def]
    """d (curvature, rate, length) / d C, out (3, 6), of the clothoid that joins C = course (6,).

    With p, q the headings against the chord, integrals C_f = int f cos, S_f = int f sin of the angle
    b (t^2 - t) + (q - p) t + p, and the bow b their root S_1 = 0:   db = -(C_(1-t) dp + C_t dq) / C_(t^2-t)."""
    dx, dy = course[3] - course[0], course[4] - course[1]
    chord = math.hypot(dx, dy)
    along, length = math.atan2(dy, dx), clothoid[LENGTH]
    p, q = wrap(course[2] - along), wrap(course[5] - along)
    bow = 0.5 * clothoid[RATE] * length**2
    c_t = c_bow = s_t = s_bow = 0.0
    for i in range(len(NODES)):
        t = NODES[i]
        angle = bow * (t * t - t) + (q - p) * t + p
        cos, sin = WEIGHTS[i] * math.cos(angle), WEIGHTS[i] * math.sin(angle)
        c_t, s_t = c_t + t * cos, s_t + t * sin
        c_bow, s_bow = c_bow + (t * t - t) * cos, s_bow + (t * t - t) * sin
    shrink = chord / length  # C_1; S_1 = 0
    bow_p, bow_q = -(shrink - c_t) / c_bow, -c_t / c_bow
    shrink_p, shrink_q = s_t - s_bow * bow_p, -s_t - s_bow * bow_q
    for i in range(6):
        by_chord = by_along = 0.0
        if i % 3 < 2:
            sign = -1.0 if i < 3 else 1.0
            by_chord = sign * (dx if i % 3 == 0 else dy) / chord
            by_along = sign * (-dy if i % 3 == 0 else dx) / chord**2
        by_p, by_q = (1.0 if i == 2 else 0.0) - by_along, (1.0 if i == 5 else 0.0) - by_along
        by_bow = bow_p * by_p + bow_q * by_q
        by_length = by_chord / shrink - length / shrink * (shrink_p * by_p + shrink_q * by_q)
        out[0, i] = (by_q - by_p - by_bow) / length - clothoid[CURVATURE] / length * by_length
        out[1, i] = 2.0 * by_bow / length**2 - 2.0 * clothoid[RATE] / length * by_length
        out[2, i] = by_length
