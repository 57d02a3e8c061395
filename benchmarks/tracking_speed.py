"""How long a scan takes, and how much memory the filter adds."""

from __future__ import annotations

import subprocess
import sys
import time
from functools import lru_cache
from pathlib import Path

import numpy as np

from benchmarks.configured import configured
from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.tracking_trials import Effort
from experiments.scenarios.urban_sensors import urban_sensors
from inference.lmb import Belief, Knobs, step
from inference.progress import Progress
from models.multi_object import no_objects

ROOT = Path(__file__).resolve().parents[1]
WARM_UP = 60  # scans that are not counted: tracks begin, caches fill
SCENES = 3
PAPER = "slightly above 2 ms, one core of 2011"
SCENE = "of an urban scene with a radar, a laser and a camera"


@lru_cache
def scan_ms(number: int, seconds: float, scenes: int, show: bool) -> tuple[np.ndarray, float]:
    """Processor time of each scan [ms], prediction, update and births, and the mean number of objects that the filter
    holds. The first run of all is not counted: it compiles."""
    model, times, held = configured("model", "traffic_urban"), list[float](), list[int]()
    runs = [urban_sensors(0, 2, 1.0), *(urban_sensors(seed, number, seconds) for seed in range(scenes))]
    with Progress(f"{number} objects", len(runs), show) as bar:
        for run, scene in enumerate(runs):
            belief, knobs = Belief(None, no_objects(len(model.names))), Knobs()
            for at, scan in enumerate(scene.data.scans):
                began = time.process_time()
                belief, _ = step(model, belief, scan, at, knobs)
                spent = time.process_time() - began
                if run and at >= WARM_UP:
                    times.append(1e3 * spent)
                    held.append(len(belief.objects.label))
            bar.advance(1)
    return np.array(times), float(np.mean(held))


def scan_times(effort: Effort) -> Values:
    found: Values = {}
    for key, number in (("20", 20), ("100", effort.objects)):
        times, held = scan_ms(number, effort.seconds, min(SCENES, effort.scenes), effort.show)
        told = f"{len(times)} scans, {held:.0f} objects held, p99 {np.quantile(times, 0.99):.3g} ms"
        found[f"ms_{key}"] = Value(float(np.median(times)), told)
        if number == 20:
            found["p99_ms_20"] = Value(float(np.quantile(times, 0.99)), f"{len(times)} scans")
    return found


def memory(effort: Effort) -> Values:
    """In a process of its own, where nothing else has grown before."""
    words = [sys.executable, "-m", "benchmarks.tracking_memory", str(effort.objects), str(effort.seconds)]
    told = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    if told.returncode:
        return {"mem_mb_100": Value(None, f"skipped: {told.stderr.strip().splitlines()[-1]}")}
    return {"mem_mb_100": Value(float(told.stdout), f"{effort.seconds:g} s of scans, results kept")}


MEASUREMENTS = (
    Measurement(
        (
            Figure(
                "ms_20",
                "ms",
                f"processor time to predict, update and begin tracks by one scan of one sensor, one thread, warm, "
                f"median over scans {SCENE}, 20 road users",
                PAPER,
                at_most=0.3,
            ),
            Figure("ms_100", "ms", "the same with 100 road users", PAPER, at_most=0.7),
            Figure("p99_ms_20", "ms", "time that one scan of a hundred exceeds, 20 road users", PAPER, at_most=1.0),
        ),
        scan_times,
    ),
    Measurement(
        (
            Figure(
                "mem_mb_100",
                "MB",
                "resident memory that tracking 100 road users adds at its peak, to a process that has compiled code "
                "and scans",
            ),
        ),
        memory,
    ),
)
