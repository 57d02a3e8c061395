"""What the cues of one frame say of a clothoid, in machine code, for many clothoids at once.

Numbers z = (y, heading, curvature, rate) of the clothoid where it begins, at a fixed x, and the offsets of the groups,
all in metres and radians. The density of a cue is that of models.road.cue_kernel.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from models.clothoid_kernel import COLUMNS, CURVATURE, HEADING, LENGTH, RATE, X, Y, sample_one
from models.road.cue_kernel import find_samples, score_groups
from models.road.kernel import linearise

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
    clothoid, table, near = np.empty(6), np.empty((num, COLUMNS)), np.empty(len(cues), np.int64)
    groups = z.shape[1] - ROAD
    height, changes = np.empty(groups), np.empty(groups)
    for i in range(len(z)):
        find_samples(cues, table, lay_road(z[i], begin, length, clothoid, table), near)
        score_groups(paper, cues, group, near, z[i, ROAD:], table, height, changes)
        out[i] = height.sum()


@nb.njit(cache=True, error_model="numpy")
def frame_slopes(z, begin, length, num, paper, cues, group, out, gradient, information):  # type: ignore[no-untyped-def]
    """The same with its gradient (S, 4 + G) and, unless empty, minus its expected second derivatives
    (S, 4 + G, 4 + G)."""
    size, full = z.shape[1], len(information) > 0
    clothoid, table = np.empty(6), np.empty((num, COLUMNS))
    slope = np.empty(size + 2)  # by x and length too, which are fixed
    square = np.empty((size + 2, size + 2)) if full else np.empty((0, 0))
    own = np.array([Y, HEADING, CURVATURE, RATE] + [6 + g for g in range(size - ROAD)])
    for i in range(len(z)):
        lay_road(z[i], begin, length, clothoid, table)
        out[i] = linearise(clothoid, z[i, ROAD:], num, paper, cues, group, slope, square)
        for a in range(size):
            gradient[i, a] = slope[own[a]]
            if full:
                for b in range(a + 1):
                    information[i, a, b] = information[i, b, a] = square[own[a], own[b]]
