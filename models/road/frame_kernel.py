"""What the cues of one frame say of a clothoid, in machine code, for many clothoids at once.

Numbers z = (y, heading, curvature, rate) of the clothoid where it begins, at a fixed x, and the offsets of the groups,
all in metres and radians. The density of a cue is that of models.road.cue_kernel.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from models.clothoid_kernel import COLUMNS, COS, CURVATURE, HEADING, LENGTH, RATE, SIN, X, Y, sample_one
from models.road.course_slopes import moments, sample_row
from models.road.cue_kernel import nearest_sample, score_cue

ROAD = 4  # numbers of the clothoid in z


@nb.njit(error_model="numpy")
def lay_road(z, begin, length, clothoid, table):  # type: ignore[no-untyped-def]
    """Clothoid (6,) and samples of z, from x = begin on; returns their step."""
    clothoid[X], clothoid[Y], clothoid[HEADING] = begin, z[0], z[1]
    clothoid[CURVATURE], clothoid[RATE], clothoid[LENGTH] = z[2], z[3], length
    return sample_one(clothoid, table)


@nb.njit(cache=True, error_model="numpy")
def frame_densities(z, begin, length, num, paper, cues, group, out):  # type: ignore[no-untyped-def]
    """Log density of all cues, out (S,), at numbers z (S, 4 + G).

    begin, length  of the clothoid [m], num of its samples; paper, cues and group as in models.road.kernel"""
    clothoid, table, rows = np.empty(6), np.empty((num, COLUMNS)), np.empty((0, 6))
    for i in range(len(z)):
        step = lay_road(z[i], begin, length, clothoid, table)
        out[i] = 0.0
        for n in range(len(cues)):
            k = nearest_sample(cues, n, table, step)
            out[i] += score_cue(paper, cues, n, z[i, ROAD + group[n]], table, k, rows)[0]


@nb.njit(cache=True, error_model="numpy")
def frame_slopes(z, begin, length, num, paper, cues, group, out, gradient, information):  # type: ignore[no-untyped-def]
    """The same with its gradient (S, 4 + G) and, unless empty, minus its expected second derivatives
    (S, 4 + G, 4 + G)."""
    clothoid, table, rows = np.empty(6), np.empty((num, COLUMNS)), np.empty((3, 6))
    moment, row = np.empty((num, 4)), np.empty(6)
    gradient[:] = 0.0
    information[:] = 0.0
    for i in range(len(z)):
        step = lay_road(z[i], begin, length, clothoid, table)
        moments(table, step, moment)
        out[i] = 0.0
        for n in range(len(cues)):
            k, o = nearest_sample(cues, n, table, step), ROAD + group[n]
            log_density, weight = score_cue(paper, cues, n, z[i, o], table, k, rows)
            out[i] += log_density
            c, s = table[k, COS], table[k, SIN]
            dx, dy = cues[n, 0] - table[k, X], cues[n, 1] - table[k, Y]
            along, across = dx * c + dy * s, dy * c - dx * s
            for r in range(3):
                residual, u, v, by_offset = rows[r, 0], rows[r, 1], rows[r, 2], rows[r, 5]
                turn = rows[r, 3] + u * across - v * along
                sample_row(v * s - u * c, -u * s - v * c, turn, rows[r, 4], k, clothoid, table, moment, row)
                gradient[i, o] -= weight * residual * by_offset
                for a in range(ROAD):
                    gradient[i, a] -= weight * residual * row[1 + a]  # after x, which is fixed
                if len(information) > 0:
                    information[i, o, o] += weight * by_offset**2
                    for a in range(ROAD):
                        information[i, o, a] += weight * by_offset * row[1 + a]
                        information[i, a, o] += weight * by_offset * row[1 + a]
                        for b in range(ROAD):
                            information[i, a, b] += weight * row[1 + a] * row[1 + b]
