"""Uniform numbers in machine code from a state of one's own: SplitMix64 (Steele, Lea and Flood 2014).

numba's own generator belongs to the thread, not to the caller. Here the state is an array uint64 (1,); any seed will
do."""

from __future__ import annotations

import numba as nb
import numpy as np

STEP = np.uint64(0x9E3779B97F4A7C15)
FIRST, SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
UNIT = 2.0**-53


@nb.njit(error_model="numpy")
def scramble(x):  # type: ignore[no-untyped-def]
    """A uint64 that looks unrelated to x, one to one."""
    x = (x ^ (x >> np.uint64(30))) * FIRST
    x = (x ^ (x >> np.uint64(27))) * SECOND
    return x ^ (x >> np.uint64(31))


@nb.njit(error_model="numpy")
def uniform(random):  # type: ignore[no-untyped-def]
    """The next number in [0, 1)."""
    random[0] += STEP
    return (scramble(random[0]) >> np.uint64(11)) * UNIT
