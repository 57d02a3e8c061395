"""What scenarios of traffic share: states of objects over time, told as truth and seen by sensors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.scene import TrafficTruth
from models.objects.motion import Motion
from models.objects.scans import Scan
from models.objects.scene import simulate_scan
from models.objects.sensors import Sensor, mounted
from models.objects.traffic import Traffic

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class World(NamedTuple):
    """N objects at T times, as a model of motion has them.

    time   (T,) rising [s]
    state  (T, N, n) nan where an object is not there
    kind   (N,) index of its kind, as in the model
    size   (N, 2) length and width [m], nan where objects are points
    """

    time: Floats
    state: Floats
    kind: Ints
    size: Floats

    def present(self, t: int) -> Ints:
        """Indices of the objects that are there at time t."""
        return np.flatnonzero(np.isfinite(self.state[t, :, 0]))


def points(time: Floats, state: Floats) -> World:
    """Objects of one kind and no size."""
    num = state.shape[1]
    return World(time, state, np.zeros(num, dtype=np.int64), np.full((num, 2), np.nan))


def see(model: Traffic, sensor: str, world: World, t: int, pose: Floats, rng: np.random.Generator) -> tuple[Scan, Ints]:
    """A scan of those that are there at time t, by the model's sensor on a car at `pose`; and of each measurement the
    object that made it, -1 of a false alarm."""
    there = world.present(t)
    found, source = simulate_scan(
        model, sensor, float(world.time[t]), pose, world.kind[there], world.state[t, there], rng
    )
    made = source >= 0
    whose = np.full(len(source), -1, dtype=np.int64)
    whose[made] = there[source[made]]
    return found, whose


def in_view(sensors: tuple[Sensor, ...], motion: Motion, world: World, pose: Floats) -> NDArray[np.bool_]:
    """(T, N) whether an object is within the view of any of the sensors, on a car at pose (T, 3)."""
    inside = np.zeros(world.state.shape[:2], dtype=bool)
    for t, own in enumerate(pose):
        body = motion.body(tuple(world.state[t].T), np)
        for sensor in sensors:
            inside[t] |= sensor.view(body, tuple(mounted(own, sensor.mount)), sensor.settings[3:], np) > 0.5
    return inside


def truth_of(world: World, motion: Motion, told: NDArray[np.bool_] | None = None) -> TrafficTruth:
    """Who was where; `told` (T, N) leaves others out, such as those that no sensor can see."""
    there = np.isfinite(world.state[..., 0])
    if told is not None:
        there &= told
    when, who = np.nonzero(there)
    body = motion.body(tuple(world.state[when, who].T), np)
    heading = np.full(len(when), np.nan) if body.heading is None else body.heading
    return TrafficTruth(
        time=world.time,
        offset=np.concatenate([[0], np.cumsum(there.sum(1))]).astype(np.int64),
        label=who.astype(np.int64),
        x=body.x,
        y=body.y,
        vx=body.vx,
        vy=body.vy,
        heading=heading,
        length=world.size[who, 0],
        width=world.size[who, 1],
        kind=world.kind[who],
    )
