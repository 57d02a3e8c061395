"""Two courses that share a part, and the density of cues along them, in machine code.

The courses are laid as tables of samples at equal steps, the second from the first: it is the same up to the place
where they part, and from there on a clothoid of its own. A road that joins is one that leaves, laid on the same table
turned round. What a cue says of a course is models.road.cue_kernel.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.clothoid_kernel import ARC, BEND, COLUMNS, COS, CURVATURE, HEADING, RATE, SIN, X, Y, sample_one
from models.clothoid_kernel import LENGTH as LENGTH_OF
from models.intersection.window import window
from models.road.cue_kernel import WIDTH, find_samples, score_groups

# a packed state: number of courses, whether the second joins, length shared, what its curvature and rate have more;
# lateral and heading of the start of the main course, curvature, rate; offsets
COURSES, JOINS, SHARED, SECOND_BEND, SECOND_RATE, MAIN = range(6)
HEAD = MAIN + 4
# floats: settings, then mean and standard deviation of the offsets, then the cues row by row
BEHIND, LENGTH, LEAST, MOST, BEND_STD, BEND_RATE_STD, FORKING, JOINING, SHARE, MAIN_STD = range(10)
SETTINGS = MAIN_STD + 4
# ints: counts, then the group and the thing of each cue
GROUPS, CUES, SAMPLES, PAPER, THINGS = range(5)
COUNTS = 5


@nb.njit(error_model="numpy")
def turn_round(table, half_turn):  # type: ignore[no-untyped-def]
    """Samples (num, 7) as one meets them on the way back, in place; half_turn is pi or, to undo it, -pi."""
    num = len(table)
    for k in range((num + 1) // 2):
        other = num - 1 - k
        for j in range(COLUMNS):
            table[k, j], table[other, j] = table[other, j], table[k, j]
    for k in range(num):
        table[k, HEADING] += half_turn
        table[k, COS], table[k, SIN], table[k, BEND] = -table[k, COS], -table[k, SIN], -table[k, BEND]


@nb.njit(error_model="numpy")
def go_on(piece, distance, pair):  # type: ignore[no-untyped-def]
    """A clothoid (6,) seen from `distance` [m] farther along, in place; pair (2, 7) is scratch."""
    piece[LENGTH_OF] = distance
    sample_one(piece, pair)
    piece[X], piece[Y], piece[HEADING], piece[CURVATURE] = pair[1, X], pair[1, Y], pair[1, HEADING], pair[1, BEND]


@nb.njit(error_model="numpy")
def lay_second(z, first, step, second):  # type: ignore[no-untyped-def]
    """Samples of the second course into second (num, 7), from those of the first."""
    joins, shared, rate = z[JOINS] == 1.0, z[SHARED], z[MAIN + 3]
    second[:] = first
    if joins:
        turn_round(second, math.pi)
    k = min(max(int(shared / step), 0), len(first) - 3)  # whatever the number: a bad index would go unnoticed
    piece, pair = np.empty(6), np.empty((2, COLUMNS))
    piece[X], piece[Y], piece[HEADING] = second[k, X], second[k, Y], second[k, HEADING]
    piece[CURVATURE], piece[RATE] = second[k, BEND], rate
    go_on(piece, shared - k * step, pair)
    piece[CURVATURE] += z[SECOND_BEND]
    piece[RATE] += z[SECOND_RATE]
    go_on(piece, (k + 1) * step - shared, pair)
    rest = second[k + 1 :]
    piece[LENGTH_OF] = (len(rest) - 1) * step
    sample_one(piece, rest)
    if joins:
        turn_round(second, -math.pi)
    for i in range(len(second)):
        second[i, ARC] = i * step


@nb.njit(error_model="numpy")
def lay_first(z, floats, first):  # type: ignore[no-untyped-def]
    """Samples of the first course into first (num, 7); returns their step [m]."""
    clothoid = np.empty(6)
    clothoid[X], clothoid[LENGTH_OF] = -floats[BEHIND], floats[LENGTH]
    for i in range(4):
        clothoid[Y + i] = z[MAIN + i]
    return sample_one(clothoid, first)


@nb.njit(cache=True, error_model="numpy")
def lay_courses(z, floats, first, second):  # type: ignore[no-untyped-def]
    """Samples of both courses, first and second (S, num, 7), of packed states z (S, D)."""
    for i in range(len(z)):
        step = lay_first(z[i], floats, first[i])
        lay_second(z[i], first[i], step, second[i])


@nb.njit(error_model="numpy")
def log_likelihood(z, floats, ints, odds):  # type: ignore[no-untyped-def]
    """Log density of the cues at a packed state; odds (things,), unless empty, is filled with the log odds that a thing
    follows the second course."""
    groups, num_cues, num, things = ints[GROUPS], ints[CUES], ints[SAMPLES], ints[THINGS]
    cues = window(floats, SETTINGS + 2 * groups, (num_cues, WIDTH))
    group, thing = window(ints, COUNTS, (num_cues,)), window(ints, COUNTS + num_cues, (num_cues,))
    first, second, near = np.empty((num, COLUMNS)), np.empty((num, COLUMNS)), np.empty(num_cues, np.int64)
    paper, forks, step = ints[PAPER] == 1, z[COURSES] == 2.0, lay_first(z, floats, first)
    if forks:
        lay_second(z, first, step, second)
    along, offset, changes, total = np.zeros((2, things)), np.empty(things), np.empty(things), 0.0
    for n in range(num_cues):
        offset[thing[n]] = z[HEAD + group[n]]
    for course in range(2 if forks else 1):
        table = second if course else first
        find_samples(cues, table, step, near)
        score_groups(paper, cues, thing, near, offset, table, along[course], changes)
    for t in range(things):
        if not forks:
            total += along[0, t]
            continue
        one, other = along[0, t] + math.log(1.0 - floats[SHARE]), along[1, t] + math.log(floats[SHARE])
        total += max(one, other) + math.log1p(math.exp(-abs(one - other)))
        if len(odds) > 0:
            odds[t] = other - one
    return total


@nb.njit(cache=True, error_model="numpy")
def log_likelihoods(z, floats, ints, odds, out):  # type: ignore[no-untyped-def]
    """`log_likelihood` of packed states z (S, D) into out (S,); odds (S, things), or (S, 0)."""
    for i in range(len(z)):
        out[i] = log_likelihood(z[i], floats, ints, odds[i])


@nb.njit(error_model="numpy")
def normal(value, loc, std):  # type: ignore[no-untyped-def]
    """Log density."""
    return -0.5 * ((value - loc) / std) ** 2 - math.log(std) - 0.5 * math.log(2.0 * math.pi)


@nb.njit(error_model="numpy")
def log_prior(z, floats, ints):  # type: ignore[no-untyped-def]
    """Log prior density of a packed state, that of all sites of the program."""
    if not floats[LEAST] <= z[SHARED] <= floats[MOST]:
        return -math.inf
    total = math.log(floats[FORKING] if z[COURSES] == 2.0 else 1.0 - floats[FORKING])
    total += math.log(floats[JOINING] if z[JOINS] == 1.0 else 1.0 - floats[JOINING])
    total -= math.log(floats[MOST] - floats[LEAST])
    for i in range(2):
        total += normal(z[SECOND_BEND + i], 0.0, floats[BEND_STD + i])
    for i in range(4):
        total += normal(z[MAIN + i], 0.0, floats[MAIN_STD + i])
    for g in range(ints[GROUPS]):
        total += normal(z[HEAD + g], floats[SETTINGS + g], floats[SETTINGS + ints[GROUPS] + g])
    return total


def evaluate(z, floats, ints, cache, out):  # type: ignore[no-untyped-def]
    """out = (log prior, log likelihood) of a packed state."""
    out[0], out[1] = log_prior(z, floats, ints), -math.inf
    if out[0] > -math.inf:
        out[1] = log_likelihood(z, floats, ints, cache[:0])


def commit(cache):  # type: ignore[no-untyped-def]
    """Nothing is remembered."""
