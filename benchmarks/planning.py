"""Figures of planning against [K15], Kunz et al. (2015), section IV, and public planners: python -m benchmarks.planning

    --quick          few scenes
    --json           one JSON object on the standard output and nothing else
    --only KEY,KEY   only the measurements that yield these figures

Everything runs on one thread, warm, and is measured at the time of the call. frenetix (extra `peers`) runs in the same
process; the reactive planner where WAYBAYES_REACTIVE names a Python that has it."""

from __future__ import annotations

import sys
from typing import Any

from benchmarks import command

PARTS = ("planning_speed", "planning_peers", "planning_optimal", "planning_repeat", "planning_drives")
BENCHMARK = command.in_parts("benchmarks.planning", "Planning against [K15]", PARTS, "planning_scene")
measurements = BENCHMARK.measurements


def main(words: list[str] | None = None, effort: Any = None) -> int:
    """The command; `effort` replaces both --quick and the full one. Returns the exit code."""
    return command.main(BENCHMARK, words, effort)


if __name__ == "__main__":
    sys.exit(main())
