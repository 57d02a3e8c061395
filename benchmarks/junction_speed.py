"""How long a sample, a first start and a later start take."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from itertools import chain
from pathlib import Path
from statistics import fmean, median
from typing import Any

from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.junction import ANNEALED, Effort, Setting, Trial, attempt, m20
from experiments.scenarios.protocol import protocol
from inference.progress import Progress
from models.intersection.state import Junction

ROOT = Path(__file__).resolve().parents[1]
POPULATION = 64  # chains
SAMPLE = (
    "wall time of the compiled chain (5000 steps with random numbers and ten snapshots; preparation and compilation "
    "excluded) over evaluated proposals, one thread, median over protocol scenes"
)


def timed(setting: Setting, num: int, repeats: int, what: str, show: bool) -> list[list[Trial]]:
    """Trials of the first `num` scenes, the same `repeats` times each, after an untimed one."""
    attempt(setting, protocol(0).data, 0)
    with Progress(what, num, show) as bar:
        trials = []
        for seed in range(num):
            tracks = protocol(seed).data
            trials.append([attempt(setting, tracks, seed) for _ in range(repeats)])
            bar.advance(1)
    return trials


def sample_time(trials: list[list[Trial]]) -> Value:
    """Median over all runs; beside it that of the quickest run of each scene, which other work disturbed least."""
    times = [[t.us_per_sample for t in scene] for scene in trials]
    quickest = median(min(scene) for scene in times)
    detail = f"{len(times)} scenes x {len(times[0])} runs; quickest of each {quickest:.2f}"
    return Value(median(chain.from_iterable(times)), detail)


def default_samples(effort: Effort) -> Values:
    job = Setting(Junction(), ANNEALED)
    cold = Setting(Junction(), ANNEALED | {"start_temperature": 1.0})
    trials = timed(job, effort.timed, effort.repeats, "us_per_sample", effort.show)
    return {
        "us_per_sample": sample_time(trials),
        "us_per_sample_t1": sample_time(timed(cold, effort.timed, effort.repeats, "us_per_sample_t1", effort.show)),
        "invalid_share": Value(
            fmean(scene[0].posterior.info["invalid_share"] for scene in trials), f"{len(trials)} scenes"
        ),
    }


def m20_samples(effort: Effort) -> Values:
    num = max(effort.timed // 2, 1)
    return {"us_per_sample_m20": sample_time(timed(m20(), num, effort.repeats, "us_per_sample_m20", effort.show))}


def point_samples(effort: Effort) -> Values:
    point = m20("point")
    short = point._replace(knobs=point.knobs | {"num_steps": 300, "warmup": 300})
    num = max(effort.timed // 4, 1)
    return {"us_per_sample_point": sample_time(timed(short, num, 1, "us_per_sample_point", effort.show))}


SAMPLES = (
    Measurement(
        (
            Figure("us_per_sample", "us", f"{SAMPLE}: Junction(), annealed as structure_5000", "9.8", at_most=2.5),
            Figure("us_per_sample_t1", "us", "the same at T = 1 throughout", "9.8", at_most=2.5),
            Figure("invalid_share", "share", "proposals of us_per_sample that left the state space: not evaluated"),
        ),
        default_samples,
    ),
    Measurement(
        (Figure("us_per_sample_m20", "us", f"{SAMPLE}: [M20] with one lane per half track, as structure_m20", "9.8"),),
        m20_samples,
    ),
    Measurement(
        (
            Figure(
                "us_per_sample_point",
                "us",
                "as us_per_sample_m20, but 300 steps and the closest lane of every point, as [M20] prints it",
                "9.8",
            ),
        ),
        point_samples,
    ),
)


def population_ratio(effort: Effort) -> Values:
    """Both paths on one scene; seconds per evaluated sample."""
    knobs = ANNEALED | {"num_chains": POPULATION}
    steps = {"batched": 20 * effort.repeats, "compiled": 200 * effort.repeats}
    cost, tracks = {}, protocol(1).data
    for path, num in steps.items():
        for length in (2, num):  # the first warms up
            part = knobs | {"path": path, "num_steps": length, "warmup": length}
            cost[path] = attempt(Setting(Junction(), part), tracks, 0).us_per_sample
    ratio = cost["batched"] / cost["compiled"]
    detail = f"{cost['batched']:.1f} us / {cost['compiled']:.2f} us"
    return {"torch_population_ratio": Value(ratio, detail)}


POPULATION_RATIO = Measurement(
    (
        Figure(
            "torch_population_ratio",
            "",
            f"time per evaluated sample of the generic batched path over that of the compiled chain: {POPULATION} "
            "chains, Junction(), same evidence, same first state, one thread",
        ),
    ),
    population_ratio,
)


def start_up(cache: str) -> tuple[float, float]:
    """Seconds from the start of a process to its first posterior, and how many of them compile."""
    began = time.time()
    command = [sys.executable, "-m", "benchmarks.first_posterior"]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"NUMBA_CACHE_DIR": cache}, capture_output=True, text=True, check=True
    )
    report: dict[str, Any] = json.loads(done.stdout)
    return report["finished"] - began, report["compiling"]


def starts(effort: Effort) -> Values:
    with tempfile.TemporaryDirectory() as cache, Progress("cold and warm start", 2, effort.show) as bar:
        cold, compiling = start_up(cache)
        bar.advance(1)
        warm, _ = min(start_up(cache) for _ in range(2))
        bar.advance(1)
    return {
        "cold_compile_s": Value(cold, f"{compiling:.1f} s compile"),
        "compile_s": Value(compiling),
        "warm_start_s": Value(warm, "better of 2"),
    }


STARTS = Measurement(
    (
        Figure(
            "cold_compile_s",
            "s",
            "a new process with an empty compilation cache: from its start to the first polished posterior of a small "
            "scene, imports included",
            at_most=30.0,
        ),
        Figure("compile_s", "s", "of it: compilation by numba"),
        Figure("warm_start_s", "s", "the same in a later process, which finds the cache filled", at_most=3.0),
    ),
    starts,
)

MEASUREMENTS = (*SAMPLES, STARTS, POPULATION_RATIO)
