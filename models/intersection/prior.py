"""The prior of the intersection in machine code: the densities that `Junction` states, slot by slot."""

from __future__ import annotations

import math

import numba as nb

from models.intersection.angles import MIN_SEPARATION
from models.intersection.packing import ANGLE, ARM, BEND, ENTRIES, EXITS, GAP, HEAD, MAX_ARMS, MIN_ARMS, SHIFT, WIDTH
from models.intersection.wrap import wrap

# the prior's numbers, at the head of the kernel's floats: settings, then logarithms made once from them
CENTRE_STD, GAP_MAX, LOG_WIDTH, WIDTH_SPREAD, BEND_STD, SHIFT_STD, MIN_LANES, MAX_LANES = range(8)
LOG_HEAD, LOG_SLOT, LOG_SOME, LOG_ANY = range(8, 12)
NUM_PRIOR = 12
LOG_2PI = math.log(2 * math.pi)


def prior_numbers(
    centre_std: float, gap_max: float, width: float, spreads: tuple[float, float, float], min_lanes: int, max_lanes: int
) -> list[float]:
    """Settings of the prior and the logarithms of its normalisers; spreads of log width, bend, shift, 0 fixes one."""
    log_head = -2.0 * math.log(centre_std) - LOG_2PI - math.log(MAX_ARMS - MIN_ARMS + 1.0) - MAX_ARMS * LOG_2PI
    log_slot = -math.log(gap_max) - math.log(max_lanes - min_lanes + 1.0)
    log_slot -= sum(math.log(std) + 0.5 * LOG_2PI for std in spreads if std > 0)
    log_some, log_any = -math.log(max_lanes), -math.log(max_lanes - min_lanes + 1.0)
    settings = [centre_std, gap_max, math.log(width), *spreads, float(min_lanes), float(max_lanes)]
    return [*settings, log_head, log_slot, log_some, log_any]


@nb.njit(fastmath={"arcp", "contract"}, error_model="numpy")
def square(x, std):  # type: ignore[no-untyped-def]
    """(x / std)^2 / 2; zero where std = 0: the value is a constant."""
    return 0.5 * (x / std) ** 2 if std > 0.0 else 0.0


@nb.njit
def lanes_fit(entries, exits, numbers):  # type: ignore[no-untyped-def]
    """Whether an arm may have these lane counts."""
    low, high = numbers[MIN_LANES], numbers[MAX_LANES]
    return low <= entries <= high and low <= exits <= high and entries + exits >= 1.0


@nb.njit(fastmath={"arcp", "contract"}, error_model="numpy")
def log_slot(z, a, numbers):  # type: ignore[no-untyped-def]
    """log density of a slot but for its angle."""
    o = HEAD + a * ARM
    if not 0.0 <= z[o + GAP] <= numbers[GAP_MAX] or not lanes_fit(z[o + ENTRIES], z[o + EXITS], numbers):
        return -math.inf
    value = numbers[LOG_SLOT] + (numbers[LOG_SOME] if z[o + ENTRIES] < 0.5 else numbers[LOG_ANY])
    if numbers[WIDTH_SPREAD] > 0.0:
        log_width = math.log(z[o + WIDTH])
        value -= square(log_width - numbers[LOG_WIDTH], numbers[WIDTH_SPREAD]) + log_width
    return value - square(z[o + BEND], numbers[BEND_STD]) - square(z[o + SHIFT], numbers[SHIFT_STD])


@nb.njit
def apart(z, num, angle, skip):  # type: ignore[no-untyped-def]
    """Whether an angle keeps its distance from the active arms other than `skip`."""
    for a in range(num):
        if a != skip:
            if abs(wrap(angle - z[HEAD + a * ARM + ANGLE])) < MIN_SEPARATION:
                return False
    return True


@nb.njit
def log_head(z, numbers):  # type: ignore[no-untyped-def]
    """log density of the number of arms, the centre and the angles of all slots."""
    num = int(z[0])
    if not MIN_ARMS <= num <= MAX_ARMS:
        return -math.inf
    for a in range(1, num):
        if not apart(z, a, z[HEAD + a * ARM + ANGLE], a):
            return -math.inf
    value = numbers[LOG_HEAD] - (num - 1.0) * math.log1p(-num * MIN_SEPARATION / (2.0 * math.pi))
    return value - square(z[1], numbers[CENTRE_STD]) - square(z[2], numbers[CENTRE_STD])


@nb.njit
def log_prior(z, numbers):  # type: ignore[no-untyped-def]
    """log p(z) of a packed state, inactive slots included (pseudo-priors)."""
    value = log_head(z, numbers)
    for a in range(MAX_ARMS):
        value += log_slot(z, a, numbers)
    return value
