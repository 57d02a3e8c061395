"""How long a scan takes, and how much memory the filter adds."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

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
KINDS = ("car", "bicycle", "pedestrian")
PAPER = "slightly above 2 ms, one core of 2011"
SCENE = "of an urban scene with a radar, a laser and a camera"


@lru_cache
def scan_ms(number: int, seconds: float, scenes: int, show: bool, kinds: tuple[str, ...]) -> tuple[np.ndarray, float]:
    """Processor time of each scan [ms], prediction, update and births, and the mean number of objects that the filter
    holds. The first run of all is not counted: it compiles."""
    model, times, held = urban_model(kinds), list[float](), list[int]()
    runs = [urban_sensors(seed, number, seconds, kinds) for seed in range(scenes)]
    runs.insert(0, urban_sensors(0, len(kinds), 1.0, kinds))
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


def urban_model(kinds: tuple[str, ...]) -> Any:
    """The model of the urban scene, of some of its kinds; the camera tells kinds apart where there are several."""
    model = configured("model", "traffic_urban")
    if kinds == model.kind_names:
        return model
    own = tuple(replace(kind, share=1.0 / len(kinds)) for kind in model.kinds if kind.name in kinds)
    return replace(model, kinds=own, sensors=tuple(replace(sensor, confusion=None) for sensor in model.sensors))


def scan_times(effort: Effort) -> Values:
    found: Values = {}
    cases = (("20", 20, KINDS[:1]), ("100", effort.objects, KINDS[:1]))
    cases += (("20_kinds", 20, KINDS), ("100_kinds", effort.objects, KINDS))
    for key, number, kinds in cases:
        times, held = scan_ms(number, effort.seconds, min(SCENES, effort.scenes), effort.show, kinds)
        told = f"{len(times)} scans, {held:.0f} objects held, p99 {np.quantile(times, 0.99):.3g} ms"
        found[f"ms_{key}"] = Value(float(np.median(times)), told)
        if key == "20":
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
                f"median over scans {SCENE}, 20 cars, one kind of objects",
                PAPER,
                at_most=0.3,
            ),
            Figure("ms_100", "ms", "the same with 100 cars", PAPER, at_most=0.7),
            Figure("p99_ms_20", "ms", "time that one scan of a hundred exceeds, 20 cars", PAPER, at_most=1.0),
            Figure("ms_20_kinds", "ms", "as ms_20, of 20 road users of three kinds that the filter tells apart", PAPER),
            Figure("ms_100_kinds", "ms", "the same with 100 road users", PAPER),
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
