"""How long planning takes: candidates judged, feet of points found, emitted formulas against one written by hand."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.planning_scene import FANS, LINE, PLANNER, Effort, fan, scene
from planning.kinematics import LIMITS, MARGINS, Limits
from planning.planner import judge
from planning.reference_kernel import FOUND

POINTS = 20_000


def times_ms(work: Callable[[], Any], repeats: int) -> np.ndarray:
    """Processor time of each call [ms], after three that are not counted."""
    spent = np.empty(repeats + 3)
    for n in range(len(spent)):
        began = time.process_time()
        work()
        spent[n] = 1e3 * (time.process_time() - began)
    return spent[3:]


def judged(effort: Effort) -> Values:
    """Fans, costs and their order, boundary lines, tables of road users and every judgement are in the time."""
    found: Values = {}
    for size in FANS:
        for key, lazy in ((f"ms_{size}", False), (f"ms_lazy_{size}", True)):
            if lazy and size != 3000:
                continue
            spent = times_ms(
                lambda size=size, lazy=lazy: judge(  # type: ignore[misc]
                    PLANNER, scene(PLANNER), fan(PLANNER, size), PLANNER.comfort, first_good=lazy
                ),
                effort.repeats,
            )
            told = judge(PLANNER, scene(PLANNER), fan(PLANNER, size), PLANNER.comfort, first_good=lazy)
            good = int((told.reason == 0).sum())
            looked = int((told.reason >= 0).sum())
            found[key] = Value(float(np.median(spent)), f"{looked} looked at, {good} good, {effort.repeats} calls")
    return found


def projection(effort: Effort) -> Values:
    """Points up to 4 m beside the line, from starts wrong by up to half a metre."""
    rng = np.random.default_rng(0)
    s, d = rng.uniform(2.0, LINE.length - 2.0, POINTS), rng.uniform(-4.0, 4.0, POINTS)
    points, start = LINE.place(s, d), s + rng.uniform(-0.5, 0.5, POINTS)
    spent = times_ms(lambda: LINE.project(points, start), effort.repeats)
    at, ended = LINE.project(points, start)
    if (ended != FOUND).any():
        raise RuntimeError(f"{(ended != FOUND).sum()} points have no foot")
    error = float(np.abs(at - np.stack([s, d], -1)).max())
    us = 1e3 * float(np.median(spent)) / POINTS
    told = f"{POINTS} points"
    return {"projection_us": Value(us, told), "projection_error_m": Value(error, told)}


@lru_cache
def _loops() -> tuple[Callable[..., float], Callable[..., float]]:
    """Both kernels in the same loop over points."""
    from numba import njit

    from benchmarks.plain_margins import margins

    emitted = MARGINS.scalar()

    def loop(value: Any) -> Any:
        @njit(error_model="numpy")
        def least(x, p):  # type: ignore[no-untyped-def]
            worst = 0.0
            for i in range(len(x)):
                a = x[i]
                g = value(a[0], a[1], a[2], a[3], a[4], a[5], a[6], p[0], p[1], p[2], p[3], p[4], p[5])
                low = min(min(min(g[0], g[1]), min(g[2], g[3])), min(min(g[4], g[5]), min(g[6], g[7])))
                worst += min(low, min(g[8], g[9])) + g[10] + g[11]
            return worst

        return least

    return loop(emitted), loop(margins)


def emitted(effort: Effort) -> Values:
    """Turn by turn, so that both meet the same machine."""
    rng = np.random.default_rng(0)
    x = np.column_stack([rng.uniform(1, 20, POINTS), rng.normal(0, 0.5, (POINTS, 6)) * [2, 0.02, 0.01, 2, 1, 1]])
    p = np.array([getattr(Limits(), name) for name in LIMITS])
    first, second = _loops()
    if not np.isclose(first(x, p), second(x, p), rtol=1e-10):
        raise RuntimeError("the emitted kernel and the one written by hand differ")
    pairs = np.array(
        [
            (times_ms(lambda: first(x, p), 5).min(), times_ms(lambda: second(x, p), 5).min())
            for _ in range(effort.repeats)
        ]
    )
    ratio = float(np.median(pairs[:, 0] / pairs[:, 1]))
    ns = 1e6 * np.median(pairs, 0) / POINTS
    return {"emitted_ratio": Value(ratio, f"{ns[0]:.1f} and {ns[1]:.1f} ns a point")}


SIZED = "60 steps, all limits, boundary lines, 8 uncertain vehicles; the fan, its costs and all tables made anew"
MEASUREMENTS = (
    Measurement(
        (
            Figure("ms_3000", "ms", f"processor time to judge each of 3000 candidates: {SIZED}", at_most=10.0),
            Figure("ms_lazy_3000", "ms", "the same, cheapest first, up to the first good one"),
            Figure("ms_10000", "ms", "as ms_3000, 10000 candidates", at_most=20.0),
        ),
        judged,
    ),
    Measurement(
        (
            Figure("projection_us", "us", "processor time of a foot point from a warm start", at_most=0.5),
            Figure("projection_error_m", "m", "largest error of its arc length and offset", at_most=1e-6),
        ),
        projection,
    ),
    Measurement(
        (
            Figure(
                "emitted_ratio",
                "",
                "time of the emitted kernel of limits / of one written by hand, inlined",
                at_most=1.2,
            ),
        ),
        emitted,
    ),
)
