"""Figures of multi-object tracking against [K15], Kunz et al. (2015), and Stone Soup: python -m benchmarks.tracking

    --quick          few scenes
    --json           one JSON object on the standard output and nothing else
    --only KEY,KEY   only the measurements that yield these figures

Everything runs on one thread, warm, and is measured at the time of the call. Stone Soup (extra `peers`) runs on the
same scans in the same process; its settings were chosen on other scenes (python -m benchmarks.tracking_tune)."""

from __future__ import annotations

import sys
from typing import Any

from benchmarks import command

PARTS = ("tracking_speed", "tracking_peers", "tracking_accuracy", "kitti_tracking", "kitti_baseline")
BENCHMARK = command.in_parts("benchmarks.tracking", "Tracking against [K15]", PARTS, "tracking_trials")
measurements = BENCHMARK.measurements


def main(words: list[str] | None = None, effort: Any = None) -> int:
    """The command; `effort` replaces both --quick and the full one. Returns the exit code."""
    return command.main(BENCHMARK, words, effort)


if __name__ == "__main__":
    sys.exit(main())
