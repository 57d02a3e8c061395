"""Figures of planning against [K15], Kunz et al. (2015), section IV, and public planners: python -m benchmarks.planning

    --quick          few scenes
    --json           one JSON object on the standard output and nothing else
    --only KEY,KEY   only the measurements that yield these figures

Everything runs on one thread, warm, and is measured at the time of the call. frenetix (extra `peers`) runs in the same
process; the reactive planner where WAYBAYES_REACTIVE names a Python that has it."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING

from benchmarks import command
from benchmarks import figure as fig

if TYPE_CHECKING:
    from benchmarks.planning_scene import Effort

PARTS = ("planning_speed", "planning_peers", "planning_optimal", "planning_repeat", "planning_drives")


def measurements() -> tuple[fig.Measurement, ...]:
    """All measurements but the yardstick, in the order of the table."""
    return tuple(m for part in PARTS for m in import_module(f"benchmarks.{part}").MEASUREMENTS)


def efforts() -> tuple[Effort, Effort]:
    """The full one and the quick one."""
    from benchmarks.planning_scene import FULL, QUICK

    return FULL, QUICK


def main(words: list[str] | None = None, effort: Effort | None = None) -> int:
    """The command; `effort` replaces both --quick and the full one. Returns the exit code."""
    return command.main(
        command.Benchmark("benchmarks.planning", "Planning against [K15]", measurements, efforts), words, effort
    )


if __name__ == "__main__":
    sys.exit(main())
