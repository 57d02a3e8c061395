"""Peak memory that the filter adds [MB], of a process of its own: python -m benchmarks.tracking_memory OBJECTS SECONDS

Reads and resets the peak of resident memory in /proc, as Linux has it."""

from __future__ import annotations

import sys
from pathlib import Path

from benchmarks.timing import single_thread

STATUS, RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def resident_mb(name: str) -> float:
    """VmRSS, now, or VmHWM, at the peak."""
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith(name))
    return float(line.split()[1]) / 1024.0


def main(words: list[str]) -> int:
    number, seconds = int(words[0]), float(words[1])
    if not RESET.exists():
        print("needs /proc of Linux", file=sys.stderr)
        return 1
    single_thread()
    from benchmarks.configured import configured
    from benchmarks.tracking_trials import lmb
    from experiments.scenarios.urban_sensors import urban_sensors

    model, engine = configured("model", "traffic_urban"), lmb()
    engine(model, urban_sensors(0, 2, 1.0).data.scans)  # compiles
    scans = urban_sensors(0, number, seconds).data.scans
    before = resident_mb("VmRSS")
    RESET.write_text("5")
    tracks = engine(model, scans)
    print(resident_mb("VmHWM") - before)
    del tracks
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
