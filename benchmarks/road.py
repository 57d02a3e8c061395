"""Figures of the road course against [T17], Trusheim, Condurache, Mertins: python -m benchmarks.road

    --quick          100 scenes instead of 1000
    --json           one JSON object on the standard output and nothing else
    --only KEY,KEY   only the measurements that yield these figures

Everything runs on one thread, warm, and is measured at the time of the call. Times are of the processor. The cut of
the calibrated range was chosen on other seeds (python -m benchmarks.road_cut)."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from benchmarks import command
from benchmarks import figure as fig

if TYPE_CHECKING:
    from benchmarks.road_trials import Effort


def measurements() -> tuple[fig.Measurement, ...]:
    """All measurements but the yardstick, in the order of the table."""
    from benchmarks import road_accuracy, road_robust, road_segments, road_speed

    parts = (road_accuracy, road_robust, road_segments, road_speed)
    return tuple(m for part in parts for m in part.MEASUREMENTS)


def efforts() -> tuple[Effort, Effort]:
    """The full one and the quick one."""
    from benchmarks.road_trials import FULL, QUICK

    return FULL, QUICK


def main(words: list[str] | None = None, effort: Effort | None = None) -> int:
    """The command; `effort` replaces both --quick and the full one. Returns the exit code."""
    return command.main(
        command.Benchmark("benchmarks.road", "Roads against [T17]", measurements, efforts), words, effort
    )


if __name__ == "__main__":
    sys.exit(main())
