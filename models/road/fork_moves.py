"""Steps over roads with one or two courses, in machine code; the batched path and the compiled chain call `propose`.

What cues see of a road is where it is across itself, well near the car and ever less beyond. So walks take their steps
in metres across the road, by polynomials of the arc length u in [0, 1] that are orthogonal under the weight (1 - u)^2:
along the main course those of Jacobi, along the second v^2 and v^3 - 5/8 v^2 of its way v from where it parts. On
simulated roads the posterior of their coefficients is a ball but for the first, which `shift` serves; by Legendre's
polynomials, weight 1, the others correlate by .9. How narrow it is is not known beforehand: a step draws its size
first, from SMALLEST to 1 of the longest, evenly in its logarithm, and keeps it for the way back.

    walk         the main course; half of the times the second goes along, half of the times it keeps its curvature
    shift        the main course to one side, all offsets to the other
    offset       of one group
    bend         the second course from where it parts
    slide        the place where they part, the end of the second where it was
    swap         which of the two is the main one
    birth_death  of the second course; its numbers are exchanged for draws of their prior, whose levels go back in u'
    refresh      the same without birth or death: always taken while there is one course
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.clothoid_kernel import NODES, WEIGHTS
from models.intersection.moves import normal_cdf, normal_quantile, split_choice
from models.overwrite import overwrite
from models.road.fork_kernel import (
    BEND_STD,
    COURSES,
    HEAD,
    JOINING,
    JOINS,
    LEAST,
    LENGTH,
    MAIN,
    MOST,
    SECOND_BEND,
    SECOND_RATE,
    SHARED,
)

NAMES = ("walk", "shift", "offset", "bend", "slide", "swap", "birth_death", "refresh")
PROBABILITIES = np.array([0.21, 0.08, 0.18, 0.19, 0.19, 0.03, 0.1, 0.02])
WALK, SHIFT, OFFSET, BEND, SLIDE, SWAP, BIRTH_DEATH, REFRESH = range(len(NAMES))
LONGEST = np.array([1.5, 4.0, 4.0, 10.0, 100.0, 0.0, 0.0, 0.0])  # steps [m]
SMALLEST = 0.03
NUM_UNIFORMS = 6
# values and derivatives at the start of the polynomials 0 to 3: P_n^(2, 0)(2 u - 1)
JACOBI = np.array([[1.0, 0.0, 0.0, 0.0], [-1.0, 4.0, 0.0, 0.0], [1.0, -10.0, 30.0, 0.0], [-1.0, 18.0, -126.0, 336.0]])


@nb.njit(error_model="numpy")
def walk(z, u, longest, settings, z_new, u_new):  # type: ignore[no-untyped-def]
    """The main course across itself. u[:4] steps, u[4] their size, u[5] whether the second goes along."""
    length, moved = settings[LENGTH], np.empty(4)
    for j in range(4):
        moved[j] = longest * (2.0 * u[j] - 1.0)
        u_new[j] = 1.0 - u[j]
    step_across(moved, length, z_new)
    if u[5] < 0.5 and z[COURSES] == 2.0:
        more, more_rate = z_new[MAIN + 2] - z[MAIN + 2], z_new[MAIN + 3] - z[MAIN + 3]
        if z[JOINS] == 1.0:
            z_new[SECOND_BEND] += more + more_rate * (length - z[SHARED])
        else:
            z_new[SECOND_BEND] -= more + more_rate * z[SHARED]
        z_new[SECOND_RATE] -= more_rate


@nb.njit(error_model="numpy")
def bend(z, u, longest, settings, z_new, u_new):  # type: ignore[no-untyped-def]
    """The second course across itself. u[0], u[1] steps of v^2 and v^3 - 5/8 v^2."""
    way = settings[LENGTH] - z[SHARED]
    square, cube = longest * (2.0 * u[0] - 1.0), longest * (2.0 * u[1] - 1.0)
    z_new[SECOND_BEND] += 2.0 * (square - 5.0 / 8.0 * cube) / way**2
    z_new[SECOND_RATE] += 6.0 * cube / way**3
    u_new[0], u_new[1] = 1.0 - u[0], 1.0 - u[1]


@nb.njit(error_model="numpy")
def slide(z, u, longest, settings, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """The length shared, the end of the second course as far across as before, for u[5] < 1/2 in the same direction.

    Its way is w before and w' after. Across the other course it is a v^2 + b v^3, v = way / w, with bend = 2 a / w^2
    and rate = 6 b / w^3. Keeping a and b has the Jacobian (w / w')^5; keeping a + b and the direction (2 a + 3 b) / w
    has (w / w')^4."""
    z_new[SHARED] += longest * (2.0 * u[0] - 1.0)
    u_new[0] = 1.0 - u[0]
    if not settings[LEAST] < z_new[SHARED] < settings[MOST]:
        return False
    way, new_way = settings[LENGTH] - z[SHARED], settings[LENGTH] - z_new[SHARED]
    a, b = z[SECOND_BEND] * way**2 / 2.0, z[SECOND_RATE] * way**3 / 6.0
    log_q[2] = 5.0 * math.log(way / new_way)
    if u[5] < 0.5:
        end, direction = a + b, (2.0 * a + 3.0 * b) * new_way / way
        a, b = 3.0 * end - direction, direction - 2.0 * end
        log_q[2] = 4.0 * math.log(way / new_way)
    z_new[SECOND_BEND], z_new[SECOND_RATE] = 2.0 * a / new_way**2, 6.0 * b / new_way**3
    return True


@nb.njit(error_model="numpy")
def swap(z, settings, z_new):  # type: ignore[no-untyped-def]
    """The second course for the main one. Let f(u) be how far across the main one it is: zero where both are one road,
    so no polynomial. The main course moves by the nearest one, sum_j a_j P_j with

        a_j = (2 j + 3) int_0^1 (1 - u)^2 P_j(u) f(u) du

    and f changes its sign, which undoes itself: a_j is linear in the bends, and its Jacobian is 1."""
    length, shared, joins = settings[LENGTH], z[SHARED], z[JOINS] == 1.0
    way, moved = length - shared, np.zeros(4)
    for i in range(len(NODES)):
        v = way * NODES[i]  # from where they part
        u = (way - v if joins else shared + v) / length
        f = 0.5 * z[SECOND_BEND] * v**2 + z[SECOND_RATE] * v**3 / 6.0
        weight = WEIGHTS[i] * way / length * (1.0 - u) ** 2 * (-f if joins else f)
        for j in range(4):
            value = JACOBI[j, 0] + u * (JACOBI[j, 1] + u * (JACOBI[j, 2] / 2.0 + u * JACOBI[j, 3] / 6.0))
            moved[j] += (2 * j + 3) * weight * value
    step_across(moved, length, z_new)
    z_new[SECOND_BEND], z_new[SECOND_RATE] = -z[SECOND_BEND], -z[SECOND_RATE]


@nb.njit(error_model="numpy")
def step_across(moved, length, z_new):  # type: ignore[no-untyped-def]
    """Move the main course by sum_j moved_j P_j [m]."""
    for j in range(4):
        for i in range(j + 1):
            z_new[MAIN + i] += moved[j] * JACOBI[j, i] / length**i


@nb.njit(error_model="numpy")
def exchange(z, u, settings, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """The numbers of the second course for draws of their prior. u[0] kind, u[1] length shared, u[2], u[3] bends.

    u[0] below `joining` makes a road that joins; what is left of u[0] tells nothing and travels back with the old
    kind."""
    joining, span = settings[JOINING], settings[MOST] - settings[LEAST]
    joins = u[0] < joining
    left = u[0] / joining if joins else (u[0] - joining) / (1.0 - joining)
    u_new[0] = joining * left if z[JOINS] == 1.0 else joining + (1.0 - joining) * left
    z_new[JOINS] = 1.0 if joins else 0.0
    log_q[0] = math.log(joining if joins else 1.0 - joining)
    log_q[1] = math.log(joining if z[JOINS] == 1.0 else 1.0 - joining)
    z_new[SHARED] = settings[LEAST] + span * u[1]
    u_new[1] = (z[SHARED] - settings[LEAST]) / span
    for i in range(2):
        level = normal_quantile(u[2 + i])
        before, std = z[SECOND_BEND + i] / settings[BEND_STD + i], settings[BEND_STD + i]
        z_new[SECOND_BEND + i] = std * level
        u_new[2 + i] = normal_cdf(before)
        log_q[0] -= 0.5 * level**2
        log_q[1] -= 0.5 * before**2


def propose(kind, z, u, floats, ints, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """One involution (z, u) -> (z', u') of the packed state; False where the step leaves the state space.

    log_q = (log q(z -> z'), log q(z' -> z), log Jacobian), constants that cancel left out."""
    overwrite(z_new, z)
    overwrite(u_new, u)
    log_q[0] = log_q[1] = log_q[2] = 0.0
    if kind == BIRTH_DEATH or kind == REFRESH:
        exchange(z, u, floats, z_new, u_new, log_q)
        if kind == BIRTH_DEATH:
            z_new[COURSES] = 3.0 - z[COURSES]
        return True
    longest = LONGEST[kind] * SMALLEST ** (1.0 - u[4])
    if kind == WALK:
        walk(z, u, longest, floats, z_new, u_new)
        return True
    if kind == SHIFT or kind == OFFSET:
        step = longest * (2.0 * u[0] - 1.0)
        u_new[0] = 1.0 - u[0]
        if kind == OFFSET:
            z_new[HEAD + split_choice(u[1], len(z) - HEAD)[0]] += step
            return True
        z_new[MAIN] += step
        for o in range(HEAD, len(z)):
            z_new[o] -= step
        return True
    if z[COURSES] != 2.0:
        return False
    if kind == SWAP:
        swap(z, floats, z_new)
        return True
    if kind == SLIDE:
        return slide(z, u, longest, floats, z_new, u_new, log_q)
    bend(z, u, longest, floats, z_new, u_new)
    return True
