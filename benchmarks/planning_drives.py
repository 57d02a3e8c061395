"""Closed loops: every scenario of experiments.drive, and every recorded one where the data is there."""

from __future__ import annotations

import time
from functools import lru_cache
from pathlib import Path

import numpy as np

from benchmarks.configured import made
from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.planning_scene import Effort
from experiments.closed_loop import drive
from experiments.closed_loop_metrics import metrics
from experiments.goal_metrics import goals
from inference.progress import Progress

ROOT = Path(__file__).resolve().parents[1]
RECORDED = ROOT.parent / "shared" / "data" / "planning"
SIMULATED = ("follow", "stop_line", "parked_car", "cut_in", "merge", "roundabout", "box")
EMPTY = {"DEU_Starnberg-1_1_T-1": ["+scenario.start=50", "+scenario.duration=25"]}  # a map without a problem
PARTS = ("scenario", "driver", "planner", "loop")


def drives(effort: Effort) -> dict[str, list[str]]:
    """{name: words of its config}; few of them where few scenes are asked for."""
    told = {name: [f"scenario=drive_{name}"] for name in SIMULATED}
    for path in sorted(RECORDED.glob("*.xml.gz")):
        name = path.name.split(".")[0]
        told[name] = ["experiment=commonroad", f"+scenario.file={path}", *EMPTY.get(name, [])]
    names = list(told)
    return {name: told[name] for name in names[:: max(len(names) // effort.scenes, 1)]}


@lru_cache
def scores(effort: Effort) -> dict[str, dict[str, float]]:
    """{name: metrics of its drive}"""
    found, words = {}, drives(effort)
    with Progress("drives", len(words), effort.show) as bar:
        for name, told in words.items():
            scenario, mind, planner, loop = made(told, *PARTS, root="drive")
            began = time.process_time()
            driven = drive(scenario, mind, planner, loop, seed=0)
            spent = time.process_time() - began
            found[name] = metrics(driven) | goals(driven) | {"cycles": len(driven.plans), "seconds": spent}
            bar.advance(1)
    return found


def closed_loops(effort: Effort) -> Values:
    found = scores(effort)
    recorded = [name for name in found if name not in SIMULATED]
    told = f"{len(found)} drives, {len(recorded)} of them recorded" + ("" if recorded else " (no data)")

    def total(key: str) -> Value:
        each = {name: one[key] for name, one in found.items() if one[key]}
        where = ", ".join(f"{name} {count:g}" for name, count in each.items())
        return Value(float(sum(each.values())), f"{told}; {where}" if where else told)

    def largest(key: str) -> Value:
        each = {name: one[key] for name, one in found.items() if key in one}
        if not each:
            return Value(None, f"{told}; none of them tells it")
        worst = max(each, key=lambda name: each[name])
        return Value(each[worst], f"of {len(each)} drives, in {worst}")

    hit = {name: one["collisions"] for name, one in found.items() if one["collisions"]}
    cycles = [one["cycles"] for one in found.values()]
    emergency = np.average([one["emergency"] for one in found.values()], weights=cycles)
    asked = {name: one["goal_reached"] for name, one in found.items() if "goal_reached" in one}
    missed = ", ".join(name for name, reached in asked.items() if not reached)
    ms = np.median([one["cycle_median_ms"] for one in found.values()])
    return {
        "collisions_at_fault": total("collisions_at_fault"),
        "collisions": Value(float(sum(hit.values())), ", ".join(f"{name} {count:g}" for name, count in hit.items())),
        "limit_violations": total("limit_violations"),
        "stops_passed": total("stops_passed"),
        "stop_error_m": largest("stop_error_m"),
        "gap_error_m": largest("gap_error_m"),
        "emergency_share": Value(float(emergency), f"of {sum(cycles):g} cycles"),
        "unclear_share": Value(float(np.average([one["unclear"] for one in found.values()], weights=cycles))),
        "goal_share": Value(
            float(np.mean([*asked.values()])) if asked else None, f"of {len(asked)}; not {missed or '-'}"
        ),
        "cycle_ms": Value(float(ms), "median over drives of the median over cycles"),
        "cycle_p99_ms": largest("cycle_p99_ms"),
    }


MEASUREMENTS = (
    Measurement(
        (
            Figure(
                "collisions_at_fault",
                "",
                "road users and boundary lines touched in closed loop, over all simulated and recorded scenarios, "
                "without those who drive into the vehicle from behind, or where it has stood for a second",
                at_most=0.0,
            ),
            Figure("collisions", "", "the same with those; recorded road users do not react"),
            Figure(
                "limit_violations",
                "",
                "control steps of 10 ms driven beyond a limit by more than 2 %: accelerations, curvature, speed",
                at_most=0.0,
            ),
            Figure("stops_passed", "", "stop points passed without permission", at_most=0.0),
            Figure("stop_error_m", "m", "distance of the front from a stop point it stands at, largest", at_most=0.15),
            Figure(
                "gap_error_m",
                "m",
                "gap to a lead that keeps a speed against the one wanted, largest",
                at_most=0.3,
            ),
            Figure("emergency_share", "", "share of cycles that ended in an emergency stop"),
            Figure("unclear_share", "", "share of cycles whose plan may touch something, standing ones included"),
            Figure("goal_share", "", "share of the recorded problems whose goal is reached as asked for, in time"),
            Figure("cycle_ms", "ms", "wall time of a cycle from tracks to plan", "cycles of 150 ms"),
            Figure("cycle_p99_ms", "ms", "the same, exceeded by one cycle of a hundred, largest over the drives"),
        ),
        closed_loops,
    ),
)
