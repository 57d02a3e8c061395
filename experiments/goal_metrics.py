"""Whether a drive reached the goal of its scenario (info of experiments.scenarios.commonroad_drive), by its middle.

goal_reached     1 where, at some look of the loop, place, time, speed and heading were all as asked for
goal_place       1 where the place was ever reached
goal_time_s      when that was first so
goal_distance_m  least distance from the place
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.closed_loop import Drive
from experiments.closed_loop_metrics import ego_middles

ROUNDING = 1e-6  # of times [s]


def goals(drive: Drive) -> dict[str, float]:
    """All of the above; nothing for a scene without a goal."""
    told = drive.scene.info.get("goals", ())
    if not told:
        return {}
    ego, time = ego_middles(drive), drive.log.looked
    apart = np.stack([distance(goal, ego) for goal in told])  # (G, K)
    met = np.stack([(d <= 0.0) & asked(goal, ego, time) for goal, d in zip(told, apart, strict=True)])
    at_place = (apart <= 0.0).any(0)
    out = {"goal_reached": float(met.any()), "goal_place": float(at_place.any()), "goal_distance_m": float(apart.min())}
    return out | ({"goal_time_s": float(time[at_place.argmax()])} if at_place.any() else {})


def distance(goal: Mapping[str, Any], ego: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) of the middle from the nearest of a goal's places [m]; 0 where it has none."""
    import shapely

    if not goal["places"]:
        return np.zeros(len(ego))
    places = shapely.unary_union([shapely.Polygon(place).buffer(0.0) for place in goal["places"]])
    return np.asarray(shapely.distance(shapely.points(ego[:, :2]), places))


def asked(goal: Mapping[str, Any], ego: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(K,) whether time, speed and heading are within a goal's."""
    first, last = goal["time"]
    kept = (time >= first - ROUNDING) & (time <= last + ROUNDING)
    kept &= (ego[:, 3] >= goal["speed"][0]) & (ego[:, 3] <= goal["speed"][1])
    return kept & within_turn(ego[:, 2], goal["heading"])


def within_turn(heading: NDArray[np.float64], span: Sequence[float]) -> NDArray[np.bool_]:
    """Whether headings are in an interval of angles, whatever full turns lie between them."""
    low, high = span
    if high - low >= 2 * math.pi:
        return np.ones(len(heading), bool)
    return np.remainder(heading - low + ROUNDING, 2 * math.pi) <= high - low + 2 * ROUNDING
