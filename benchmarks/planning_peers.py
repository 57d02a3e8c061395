"""Planning against public Frenet planners: frenetix in this process, the reactive planner in an environment of its own.

frenetix 0.4 (C++; extra `peers`) makes, fills in and checks the same fan on one thread. The commonroad-reactive-planner
pins packages that exclude ours: name a Python that has it in WAYBAYES_REACTIVE, else its figure is left out."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.planning_scene import LINE, PLANNER, SPEED, START, WIDE, Effort, fan, scene, vehicles
from benchmarks.planning_speed import times_ms
from planning.planner import judge
from planning.shapes import boundary, no_obstacles

SIZE = 3000
WHEELBASE = 2.8


def frenetix_handler(collision: bool) -> Any:
    """Its kinematics and feasibility functions, limits so wide that nothing is turned down; with `collision` the
    collision probabilities of the same eight vehicles."""
    import frenetix
    from frenetix.trajectory_functions import FillCoordinates
    from frenetix.trajectory_functions import cost_functions as costs
    from frenetix.trajectory_functions import feasability_functions as checks

    handler = frenetix.TrajectoryHandler(dt=PLANNER.step)
    heading = float(LINE.at(START.s)[2])
    way = frenetix.CoordinateSystemWrapper(np.ascontiguousarray(LINE.table[::2, :2]))
    handler.add_function(FillCoordinates(False, heading, way, PLANNER.horizon))
    handler.add_feasability_function(checks.CheckYawRateConstraint(1.5, WHEELBASE, True))
    handler.add_feasability_function(checks.CheckAccelerationConstraint(100.0, 100.0, True))
    handler.add_feasability_function(checks.CheckCurvatureConstraint(1.5, WHEELBASE, True))
    handler.add_feasability_function(checks.CheckCurvatureRateConstraint(WHEELBASE, 100.0, True))
    if collision:
        around = vehicles(PLANNER.num_steps + 1, PLANNER.step)
        predicted = {}
        for m in range(len(around.pose)):
            path = []
            for (x, y, turned), S in zip(around.pose[m], around.covariance[m], strict=True):
                wide = np.zeros((6, 6), order="F")
                wide[:2, :2] = S
                facing = np.array([0.0, 0.0, np.sin(turned / 2), np.cos(turned / 2)])
                path.append(frenetix.PoseWithCovariance(np.array([x, y, 0.0]), facing, wide))
            predicted[m] = frenetix.PredictedObject(m, path, *map(float, around.size[m]))
        size = (PLANNER.vehicle.length, PLANNER.vehicle.width)
        handler.add_cost_function(
            costs.CalculateCollisionProbabilityFast("collision", 1.0, predicted, *size, WHEELBASE / 2)
        )
    return handler


def sampling_matrix() -> np.ndarray:
    """The fan of 3000 as frenetix takes it: start and end times, states along, states across."""
    made = fan(PLANNER, SIZE)
    rows = []
    for T, v in zip(made.longitudinal.motion.duration, made.longitudinal.motion.end()[:, 1], strict=True):
        for d in np.unique(made.lateral.target):
            for _ in range(len(made.lateral.cost) // len(np.unique(made.lateral.target))):
                rows.append([0.0, T, *START[:3], v, 0.0, *START.lateral, d, 0.0, 0.0])
    return np.array(rows)


def frenetix(effort: Effort) -> Values:
    """Turn by turn in one process; ours judges with limits as wide, so that every step of every candidate is done."""
    keys = ("ratio_frenetix_kinematics", "ratio_frenetix_collision")
    try:
        import frenetix  # noqa: F401
    except ImportError:
        return dict.fromkeys(keys, Value(None, "skipped: frenetix is not installed (extra peers)"))
    matrix, found = sampling_matrix(), Values()
    for key, collision in zip(keys, (False, True), strict=True):
        handler = frenetix_handler(collision)

        def theirs(handler: Any = handler) -> None:
            handler.reset_Trajectories()
            handler.generate_trajectories(matrix, False)
            handler.evaluate_all_current_functions(True)

        given = scene(PLANNER)._replace(boundary=boundary([], PLANNER.radius))
        if not collision:
            given = given._replace(obstacles=no_obstacles(PLANNER.num_steps))

        def ours(given: Any = given) -> Any:
            return judge(PLANNER, given, fan(PLANNER, SIZE), WIDE, first_good=False)

        repeats = max(effort.repeats // 4, 3)
        both = np.array([(times_ms(theirs, 1)[0], times_ms(ours, 3).min()) for _ in range(repeats)])
        ms = np.median(both, 0)
        good = int((ours().reason == 0).sum())
        told = f"{ms[0]:.3g} and {ms[1]:.3g} ms for {len(matrix)} candidates, {good} of ours pass"
        found[key] = Value(float(np.median(both[:, 0] / both[:, 1])), told)
    return found


def reactive(effort: Effort) -> Values:
    """A cycle each on the same road without others: that planner's own plan(), and ours over as many candidates."""
    python = os.environ.get("WAYBAYES_REACTIVE")
    if not python:
        return {"ratio_reactive": Value(None, "skipped: WAYBAYES_REACTIVE names no Python that has it")}
    road = json.dumps({"path": LINE.table[::4, :2].tolist(), "speed": SPEED, "start": [START.s, START.ds, START.d],
                       "pose": LINE.place(START.s, START.d).tolist(), "heading": float(LINE.at(START.s)[2]),
                       "repeats": effort.repeats})  # fmt: skip
    script = Path(__file__).with_name("reactive_peer.py")
    told = subprocess.run([python, str(script)], input=road, capture_output=True, text=True)
    if told.returncode:
        return {"ratio_reactive": Value(None, f"skipped: {told.stderr.strip().splitlines()[-1]}")}
    theirs = json.loads(told.stdout.splitlines()[-1])
    size = 3000
    spent = times_ms(
        lambda: judge(PLANNER, scene(PLANNER), fan(PLANNER, size), PLANNER.comfort, first_good=False), effort.repeats
    )
    each = theirs["ms"] / theirs["candidates"], float(np.median(spent)) / size
    told_ms = f"{theirs['ms']:.0f} ms for {theirs['candidates']} candidates, {np.median(spent):.2g} ms for {size}"
    return {"ratio_reactive": Value(each[0] / each[1], told_ms)}


MEASUREMENTS = (
    Measurement(
        (
            Figure(
                "ratio_frenetix_kinematics",
                "",
                "time of frenetix / ours to make 3000 candidates of 61 steps, compute their motion and check limits so "
                "wide that all pass, one process",
                at_least=10.0,
            ),
            Figure(
                "ratio_frenetix_collision",
                "",
                "the same with collision probabilities with 8 vehicles; ours is the chance constraint",
                at_least=20.0,
            ),
        ),
        frenetix,
    ),
    Measurement(
        (
            Figure(
                "ratio_reactive",
                "",
                "time a candidate of the commonroad-reactive-planner's own cycle / ours with limits, boundary lines "
                "and 8 vehicles, each in its own process",
                at_least=50.0,
            ),
        ),
        reactive,
    ),
)
