"""The command that all benchmarks share: which figures, how much effort, a table or JSON.

--quick          fewer scenes
--json           one JSON object on the standard output and nothing else
--only KEY,KEY   only the measurements that yield these figures"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module
from statistics import median
from typing import Any, NamedTuple

from benchmarks import figure as fig
from benchmarks.timing import LOOP, reference_loop_ns, single_thread

REFERENCE = fig.Figure(
    "reference_loop_ns",
    "ns",
    f"one iteration of x <- exp(-x), {LOOP} in a row in machine code: a yardstick of the machine for all times; "
    "median of readings before and after",
)


class Benchmark(NamedTuple):
    """One command.

    name          of its module
    title         of its table
    measurements  all but the yardstick, in the order of the table; called once threads are pinned
    efforts       (full, quick): each has fields `scenes` and `show`; called then too
    """

    name: str
    title: str
    measurements: Callable[[], tuple[fig.Measurement, ...]]
    efforts: Callable[[], tuple[Any, Any]]


def in_parts(name: str, title: str, parts: Sequence[str], trials: str) -> Benchmark:
    """The command whose modules benchmarks.PART each have MEASUREMENTS; FULL and QUICK are in benchmarks.TRIALS."""

    def measurements() -> tuple[fig.Measurement, ...]:
        return tuple(m for part in parts for m in import_module(f"benchmarks.{part}").MEASUREMENTS)

    def efforts() -> tuple[Any, Any]:
        told = import_module(f"benchmarks.{trials}")
        return told.FULL, told.QUICK

    return Benchmark(name, title, measurements, efforts)


def select(every: tuple[fig.Measurement, ...], only: list[str]) -> list[fig.Measurement]:
    """The measurements that yield the figures named; all of them for an empty list.

    Raises InputError for a name that no measurement yields."""
    from models.program import InputError

    known = [f.key for m in every for f in m.figures]
    unknown = [key for key in only if key not in [REFERENCE.key, *known]]
    if unknown:
        raise InputError(f"no figure is named {', '.join(unknown)}; there are {', '.join(known)}")
    return [m for m in every if not only or any(f.key in only for f in m.figures)]


def measure(chosen: list[fig.Measurement], effort: Any) -> tuple[list[fig.Figure], fig.Values, int]:
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


def main(benchmark: Benchmark, words: list[str] | None, effort: Any = None) -> int:
    """The command; `effort` replaces both --quick and the full one. Returns the exit code:
    0, 1 where a measurement failed, 2 for a wrong word."""
    parser = argparse.ArgumentParser(prog=f"python -m {benchmark.name}", description=benchmark.title)
    parser.add_argument("--quick", action="store_true", help="fewer scenes")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--only", default="", metavar="KEY,KEY", help="only what yields these figures")
    options = parser.parse_args(words)
    single_thread()
    from models.program import InputError

    try:
        chosen = select(benchmark.measurements(), [key.strip() for key in options.only.split(",") if key.strip()])
    except InputError as mistake:
        print(mistake, file=sys.stderr)
        return 2
    full, quick = benchmark.efforts()
    effort = effort or (quick if options.quick else full)._replace(show=sys.stderr.isatty())
    began = time.perf_counter()
    figures, values, failed = measure(chosen, effort)
    run = fig.machine() | {"scenes": effort.scenes, "seconds": round(time.perf_counter() - began)}
    if options.json:
        print(fig.as_json(figures, values, run))
    else:
        fig.print_table(benchmark.title, figures, values, run)
    return 1 if failed else 0
