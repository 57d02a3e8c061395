"""Figures of multi-object tracking against [K15], Kunz et al. (2015), and Stone Soup: python -m benchmarks.tracking

    --quick          few scenes
    --json           one JSON object on the standard output and nothing else
    --only KEY,KEY   only the measurements that yield these figures

Everything runs on one thread, warm, and is measured at the time of the call. Stone Soup (extra `peers`) runs on the
same scans in the same process; its settings were chosen on other scenes (python -m benchmarks.tracking_tune)."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING

from benchmarks import command
from benchmarks import figure as fig

if TYPE_CHECKING:
    from benchmarks.tracking_trials import Effort

PARTS = ("tracking_speed", "tracking_peers", "tracking_accuracy", "kitti_tracking", "kitti_baseline")


def measurements() -> tuple[fig.Measurement, ...]:
    """All measurements but the yardstick, in the order of the table."""
    return tuple(m for part in PARTS for m in import_module(f"benchmarks.{part}").MEASUREMENTS)


def efforts() -> tuple[Effort, Effort]:
    """The full one and the quick one."""
    from benchmarks.tracking_trials import FULL, QUICK

    return FULL, QUICK


def main(words: list[str] | None = None, effort: Effort | None = None) -> int:
    """The command; `effort` replaces both --quick and the full one. Returns the exit code."""
    return command.main(
        command.Benchmark("benchmarks.tracking", "Tracking against [K15]", measurements, efforts), words, effort
    )


if __name__ == "__main__":
    sys.exit(main())
