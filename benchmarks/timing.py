"""Time on one thread, and how fast the machine is while it is timed."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
LOOP = 1_000_000  # iterations
REPEATS = 7


def single_thread() -> None:
    """Pin the numerical libraries to one thread; call it before any of them is imported."""
    os.environ.update(dict.fromkeys(THREADS, "1"))
    import torch

    torch.set_num_threads(1)


def reference_loop_ns() -> list[float]:
    """Times of one iteration of x <- exp(-x) in machine code [ns], REPEATS of them: every step waits for the last."""
    import numba as nb

    @nb.njit
    def loop(x: float, n: int) -> float:
        for _ in range(n):
            x = math.exp(-x)
        return x

    loop(1.0, 1)
    times = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        loop(1.0, LOOP)
        times.append(1e9 * (time.perf_counter() - began) / LOOP)
    return times


def p95(values: Iterable[float]) -> float:
    """The value that one in twenty exceeds."""
    ranked = sorted(values)
    return ranked[math.ceil(0.95 * len(ranked)) - 1]
