"""Figures of the intersection against [M20], Meyer, Walter, Lauer (2020): python -m benchmarks.intersection

    --quick          100 scenes instead of 1000
    --json           one JSON object on the standard output and nothing else
    --only KEY,KEY   only the measurements that yield these figures

Everything runs on one thread, warm, and is measured at the time of the call."""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from statistics import median
from typing import TYPE_CHECKING

from benchmarks import figure as fig
from benchmarks.timing import LOOP, reference_loop_ns, single_thread

if TYPE_CHECKING:
    from benchmarks.junction import Effort

REFERENCE = fig.Figure(
    "reference_loop_ns",
    "ns",
    f"one iteration of x <- exp(-x), {LOOP} in a row in machine code: a yardstick of the machine for all times; "
    "median of readings before and after",
)


def measurements() -> tuple[fig.Measurement, ...]:
    """All measurements but the yardstick, in the order of the table."""
    from benchmarks import (
        junction_lanes,
        junction_likelihoods,
        junction_maps,
        junction_speed,
        junction_structure,
        junction_traffic,
    )

    parts = (junction_speed, junction_structure, junction_likelihoods, junction_lanes, junction_maps, junction_traffic)
    return tuple(measurement for part in parts for measurement in part.MEASUREMENTS)


def select(only: list[str]) -> list[fig.Measurement]:
    """The measurements that yield the figures named; all of them for an empty list.

    Raises InputError for a name that no measurement yields."""
    from models.program import InputError

    every = measurements()
    known = [f.key for m in every for f in m.figures]
    unknown = [key for key in only if key not in [REFERENCE.key, *known]]
    if unknown:
        raise InputError(f"no figure is named {', '.join(unknown)}; there are {', '.join(known)}")
    return [m for m in every if not only or any(f.key in only for f in m.figures)]


def measure(chosen: list[fig.Measurement], effort: Effort) -> tuple[list[fig.Figure], fig.Values, int]:
    """Figures, their values, and how many measurements failed; the yardstick is taken before and after."""
    readings = reference_loop_ns()
    values: fig.Values = {}
    failed = 0
    for measurement in chosen:
        try:
            values |= measurement.measure(effort)
        except Exception as error:  # what is measured already must not be lost
            traceback.print_exc()
            failed += 1
            values |= {f.key: fig.Value(None, f"failed: {error}") for f in measurement.figures}
    readings += reference_loop_ns()
    yardstick = fig.Value(median(readings), f"{min(readings):.2f} to {max(readings):.2f}: far apart on a busy machine")
    return [REFERENCE, *(f for m in chosen for f in m.figures)], {REFERENCE.key: yardstick} | values, failed


def main(words: list[str] | None = None, effort: Effort | None = None) -> int:
    """The command; `effort` replaces both --quick and the full one. Returns the exit code:
    0, 1 where a measurement failed, 2 for a wrong word."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.intersection", description="Figures against [M20].")
    parser.add_argument("--quick", action="store_true", help="100 scenes instead of 1000")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--only", default="", metavar="KEY,KEY", help="only what yields these figures")
    options = parser.parse_args(words)
    single_thread()
    from benchmarks.junction import FULL, QUICK
    from models.program import InputError

    try:
        chosen = select([key.strip() for key in options.only.split(",") if key.strip()])
    except InputError as mistake:
        print(mistake, file=sys.stderr)
        return 2
    effort = effort or (QUICK if options.quick else FULL)._replace(show=sys.stderr.isatty())
    began = time.perf_counter()
    figures, values, failed = measure(chosen, effort)
    run = fig.machine() | {"scenes": effort.scenes, "seconds": round(time.perf_counter() - began)}
    if options.json:
        print(fig.as_json(figures, values, run))
    else:
        fig.print_table("Intersections against [M20]", figures, values, run)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
