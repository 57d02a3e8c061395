"""Figures of the intersection against [M20], Meyer, Walter, Lauer (2020): python -m benchmarks.intersection

    --quick          100 scenes instead of 1000
    --json           one JSON object on the standard output and nothing else
    --only KEY,KEY   only the measurements that yield these figures

Everything runs on one thread, warm, and is measured at the time of the call."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from benchmarks import command
from benchmarks import figure as fig

if TYPE_CHECKING:
    from benchmarks.junction import Effort


def measurements() -> tuple[fig.Measurement, ...]:
    """All measurements but the yardstick, in the order of the table."""
    from benchmarks import (
        junction_lanes,
        junction_likelihoods,
        junction_maps,
        junction_speed,
        junction_structure,
        junction_traffic,
        lane_families,
    )

    structure = (junction_speed, junction_structure, junction_likelihoods)
    parts = (*structure, junction_lanes, lane_families, junction_maps, junction_traffic)
    return tuple(measurement for part in parts for measurement in part.MEASUREMENTS)


def efforts() -> tuple[Effort, Effort]:
    """The full one and the quick one."""
    from benchmarks.junction import FULL, QUICK

    return FULL, QUICK


def main(words: list[str] | None = None, effort: Effort | None = None) -> int:
    """The command; `effort` replaces both --quick and the full one. Returns the exit code."""
    title = "Intersections against [M20]"
    return command.main(command.Benchmark("benchmarks.intersection", title, measurements, efforts), words, effort)


if __name__ == "__main__":
    sys.exit(main())
