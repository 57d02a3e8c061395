"""Figures of the road course against [T17], Trusheim, Condurache, Mertins: python -m benchmarks.road

    --quick          100 scenes instead of 1000
    --json           one JSON object on the standard output and nothing else
    --only KEY,KEY   only the measurements that yield these figures

Everything runs on one thread, warm, and is measured at the time of the call. Times are of the processor. The cut of
the calibrated range was chosen on other seeds (python -m benchmarks.road_cut)."""

from __future__ import annotations

import sys
from typing import Any

from benchmarks import command

PARTS = ("road_accuracy", "road_robust", "road_segments", "road_speed")
BENCHMARK = command.in_parts("benchmarks.road", "Roads against [T17]", PARTS, "road_trials")
measurements = BENCHMARK.measurements


def main(words: list[str] | None = None, effort: Any = None) -> int:
    """The command; `effort` replaces both --quick and the full one. Returns the exit code."""
    return command.main(BENCHMARK, words, effort)


if __name__ == "__main__":
    sys.exit(main())
