"""Small maps and road users for the tests of planning, and a closed loop in which the vehicle does as planned."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from planning.behaviour import Manners, Memory, behave
from planning.decision import Decided, Light, Permissions, Rules, decide
from planning.frenet import FrenetState
from planning.planner import Planner, plan
from planning.plans import Plan
from planning.road import Floats, Lane, Route, StopPoint, Tracks, no_tracks
from planning.scene import Scene
from planning.situation import Network, Predictions, along, predict

PLANNER = Planner()
WIDTH = 3.5


def lane(centre: Floats, width: float = WIDTH, **more: Any) -> Lane:
    """About a centre line (N, 2)."""
    ahead = np.gradient(centre, axis=0)
    ahead /= np.hypot(*ahead.T)[:, None]
    left = np.stack([-ahead[:, 1], ahead[:, 0]], -1) * width / 2
    return Lane(centre + left, centre - left, **more)


def straight(x0: float, y0: float, x1: float, y1: float, **more: Any) -> Lane:
    """From one point to another."""
    num = max(int(math.hypot(x1 - x0, y1 - y0) / 2), 3)
    return lane(np.stack([np.linspace(x0, x1, num), np.linspace(y0, y1, num)], -1), **more)


def arc(x: float, y: float, radius: float, start: float, turn: float, **more: Any) -> Lane:
    """About (x, y), from the angle `start` on by `turn` (left where positive) [rad]."""
    angle = start + np.linspace(0.0, turn, max(int(abs(turn) * radius), 8))
    return lane(np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], -1), **more)


def two_way(length: float = 400.0, speed: float = 10.0) -> dict[int, Lane]:
    """Lane 1 to the east, lane 2 beside it to the west."""
    east = straight(0.0, 0.0, length, 0.0, beside=(2, None), opposite=(True, False), speed=speed)
    west = straight(length, WIDTH, 0.0, WIDTH, beside=(1, None), opposite=(True, False), speed=speed)
    return {1: east, 2: west}


def crossing(speed: float = 10.0) -> dict[int, Lane]:
    """Lanes 1 and 2 to the east, one after the other; lane 3 across lane 2 to the north, at x = 100."""
    return {
        1: straight(0.0, 0.0, 90.0, 0.0, successors=(2,), speed=speed),
        2: straight(90.0, 0.0, 250.0, 0.0, speed=speed),
        3: straight(100.0, -120.0, 100.0, 120.0, speed=speed),
    }


CROSSING_ZONE = np.array([[97.0, -3.0], [103.0, -3.0], [103.0, 3.0], [97.0, 3.0]])


class User(NamedTuple):
    """A road user that goes straight at one speed."""

    x: float
    y: float
    heading: float = 0.0
    speed: float = 0.0
    kind: str = "car"
    acceleration: float = 0.0

    def after(self, t: float) -> User:
        way = self.speed * t
        return self._replace(x=self.x + way * math.cos(self.heading), y=self.y + way * math.sin(self.heading))


SIZES = {"car": (4.6, 1.9), "bicycle": (1.8, 0.7), "pedestrian": (0.6, 0.6)}


def tracks(users: Sequence[User], *, std: float = 0.1, speed_std: float = 0.2, existence: float = 1.0) -> Tracks:
    """As a tracker tells them, labels from 0 on."""
    if not users:
        return no_tracks()
    num = len(users)
    columns = {
        name: np.array([getattr(u, name) for u in users], float) for name in ("heading", "speed", "acceleration")
    }
    return Tracks(
        np.arange(num),
        np.array([u.kind for u in users]),
        np.array([[u.x, u.y] for u in users], float),
        np.broadcast_to(std**2 * np.eye(2), (num, 2, 2)).copy(),
        columns["heading"],
        columns["speed"],
        columns["acceleration"],
        np.full(num, speed_std),
        np.array([SIZES[u.kind] for u in users]),
        np.full(num, existence),
    )


class Cycle(NamedTuple):
    """What happened in one."""

    time: float
    state: FrenetState
    predictions: Predictions
    permissions: Permissions
    scene: Scene
    memory: Memory
    plan: Plan


def closed_loop(
    roads: Network,
    route: Route,
    state: FrenetState,
    world: Callable[[float], Sequence[User]],
    *,
    stop_points: Sequence[StopPoint] = (),
    lights: Callable[[float], Mapping[str, str | Light]] = lambda t: {},
    cycles: int = 100,
    planner: Planner = PLANNER,
    manners: Manners = Manners(),
    rules: Rules = Rules(),
    until: Callable[[Cycle], bool] = lambda cycle: False,
) -> list[Cycle]:
    """Cycles of a vehicle that is where its plan wanted it."""
    times = planner.step * np.arange(1, planner.num_steps + 1)
    memory, decided, previous, told = Memory(), Decided(), None, []
    for n in range(cycles):
        t = n * planner.fans.cycle
        predictions = predict(roads, tracks(world(t)), times)
        places = along(route, predictions)
        permissions = decide(
            route, state, planner.vehicle, predictions, stop_points, lights(t), decided, rules, places=places
        )
        decided = permissions.memory
        scene, memory = behave(
            planner, route, state, predictions, stop_points, permissions, memory, manners, places=places
        )
        previous = plan(planner, scene, previous, planner.fans.cycle)
        told.append(Cycle(t, state, predictions, permissions, scene, memory, previous))
        state = previous.states([planner.fans.cycle])[0]
        if until(told[-1]):
            break
    return told
