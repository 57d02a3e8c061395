"""The prior of the intersection in machine code: the densities that `Junction` states, slot by slot."""

from __future__ import annotations

import math

import numba as nb

from models.intersection.angles import MIN_SEPARATION
from models.intersection.packing import ANGLE, ARM, BEND, ENTRIES, EXITS, GAP, HEAD, MAX_ARMS, MIN_ARMS, SHIFT, WIDTH

# rows of the prior's numbers, at the head of the kernel's floats
CENTRE_STD, GAP_MAX, LOG_WIDTH, WIDTH_SPREAD, BEND_STD, SHIFT_STD, MIN_LANES, MAX_LANES = range(8)
NUM_PRIOR = 8
LOG_2PI = math.log(2 * math.pi)


@nb.njit(cache=True)
def log_normal(x, std):  # type: ignore[no-untyped-def]
    """log N(x; 0, std^2); zero where std = 0: the value is a constant."""
    if std == 0.0:
        return 0.0
    return -0.5 * (x / std) ** 2 - math.log(std) - 0.5 * LOG_2PI


@nb.njit(cache=True)
def log_exits(entries, numbers):  # type: ignore[no-untyped-def]
    """log p(exits | entries): uniform, and not zero where entries are."""
    low = 1.0 if entries < 0.5 else numbers[MIN_LANES]
    return -math.log(numbers[MAX_LANES] - low + 1.0)


@nb.njit(cache=True)
def lanes_fit(entries, exits, numbers):  # type: ignore[no-untyped-def]
    """Whether an arm may have these lane counts."""
    low, high = numbers[MIN_LANES], numbers[MAX_LANES]
    return low <= entries <= high and low <= exits <= high and entries + exits >= 1.0


@nb.njit(cache=True)
def log_slot(z, a, numbers):  # type: ignore[no-untyped-def]
    """log density of a slot but for its angle."""
    o = HEAD + a * ARM
    if not 0.0 <= z[o + GAP] <= numbers[GAP_MAX] or not lanes_fit(z[o + ENTRIES], z[o + EXITS], numbers):
        return -math.inf
    value = -math.log(numbers[GAP_MAX]) - math.log(numbers[MAX_LANES] - numbers[MIN_LANES] + 1.0)
    value += log_exits(z[o + ENTRIES], numbers)
    if numbers[WIDTH_SPREAD] > 0.0:
        log_width = math.log(z[o + WIDTH])
        value += log_normal(log_width - numbers[LOG_WIDTH], numbers[WIDTH_SPREAD]) - log_width
    return value + log_normal(z[o + BEND], numbers[BEND_STD]) + log_normal(z[o + SHIFT], numbers[SHIFT_STD])


@nb.njit(cache=True)
def apart(z, num, angle, skip):  # type: ignore[no-untyped-def]
    """Whether an angle keeps its distance from the active arms other than `skip`."""
    for a in range(num):
        if a != skip:
            gap = angle - z[HEAD + a * ARM + ANGLE]
            gap -= 2.0 * math.pi * math.floor(gap / (2.0 * math.pi) + 0.5)
            if abs(gap) < MIN_SEPARATION:
                return False
    return True


@nb.njit(cache=True)
def log_prior(z, numbers):  # type: ignore[no-untyped-def]
    """log p(z) of a packed state, inactive slots included (pseudo-priors)."""
    num = int(z[0])
    if not MIN_ARMS <= num <= MAX_ARMS:
        return -math.inf
    for a in range(num):
        if not apart(z, num, z[HEAD + a * ARM + ANGLE], a):
            return -math.inf
    value = -math.log(MAX_ARMS - MIN_ARMS + 1.0) - MAX_ARMS * LOG_2PI
    value -= (num - 1.0) * math.log1p(-num * MIN_SEPARATION / (2.0 * math.pi))
    value += log_normal(z[1], numbers[CENTRE_STD]) + log_normal(z[2], numbers[CENTRE_STD])
    for a in range(MAX_ARMS):
        value += log_slot(z, a, numbers)
    return value
