"""One cycle of the commonroad-reactive-planner, timed: run by benchmarks.planning_peers in that planner's own Python.

Reads {path, speed, pose, heading, start, repeats} as JSON from the standard input; writes {ms, candidates}. The road is
one lane along the path without other vehicles; one process, its densest fan of 60 steps of .05 s."""

import json
import logging
import sys
import time

import numpy as np
from commonroad.scenario.lanelet import Lanelet, LaneletNetwork
from commonroad.scenario.scenario import Scenario, ScenarioID
from commonroad_clcs.config import CLCSParams
from commonroad_rp.reactive_planner import ReactivePlanner
from commonroad_rp.state import ReactivePlannerState
from commonroad_rp.utility.config import ReactivePlannerConfiguration
from commonroad_rp.utility.utils_coordinate_system import CoordinateSystem

LEVEL = 3  # its densest but one that plan() tries


def main() -> None:
    told = json.load(sys.stdin)
    path = np.array(told["path"])
    heading = np.arctan2(*np.gradient(path, axis=0).T[::-1])
    left = np.stack([-np.sin(heading), np.cos(heading)], -1)
    scenario = Scenario(0.05, ScenarioID.from_benchmark_id("ZAM_Road-1_1_T-1", "2020a"))
    lane = Lanelet(path + 6 * left, path, path - 6 * left, 1)
    scenario.add_objects(LaneletNetwork.create_from_lanelet_list([lane]))
    config = ReactivePlannerConfiguration()
    config.planning.dt, config.planning.time_steps_computation = 0.05, 60
    config.planning.__post_init__()
    config.debug.multiproc, config.debug.logging_level = False, "ERROR"
    config.scenario = scenario
    logging.disable(logging.CRITICAL)
    state = ReactivePlannerState(
        time_step=0,
        position=np.array(told["pose"]),
        steering_angle=0.0,
        velocity=told["start"][1],
        orientation=told["heading"],
        acceleration=0.0,
        yaw_rate=0.0,
    )
    planner = ReactivePlanner(config)
    way = CoordinateSystem(path, clcs_params=CLCSParams())
    planner.reset(initial_state_cart=state, collision_checker=planner.collision_checker, coordinate_system=way)
    spent, counts = [], []
    for _ in range(told["repeats"]):
        planner.set_desired_velocity(told["speed"], told["start"][1])
        began = time.process_time()
        found = planner.plan(current_sampling_level=LEVEL)
        spent.append(1e3 * (time.process_time() - began))
        counts.append(planner.total_count_samples)
        if found is None:
            raise RuntimeError("it found no plan")
    print(json.dumps({"ms": float(np.median(spent)), "candidates": int(np.median(counts))}), flush=True)


if __name__ == "__main__":
    main()
