"""Vehicles so close that noise alone confuses them: where a filter for each, fed with nearest neighbours, swaps them.

[K15] gives this as the reason for its multi-object filter. All drive the same way at the same speed, but each sways
along and across by an Ornstein-Uhlenbeck velocity of its own, which no filter assumes:

    abreast   side by side
    column    one behind the other
    meeting   side by side, apart at first and at last; in between they come to `spacing`, stay, and part again, none
              crossing another's way
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.moving_objects import points, see, truth_of
from experiments.scenarios.scene import Scene
from models.objects.motion import ConstantVelocity
from models.objects.scans import Recording
from models.objects.sensors import Position
from models.objects.traffic import Kind, Traffic
from models.program import InputError

Floats = NDArray[np.float64]
STEP = 0.2  # between scans [s]
SPEED = 12.0  # [m/s]
SWAY, KEEPING = 0.05, 4.0  # standard deviation of the own velocity [m/s], and how long it is kept [s]
APART = 3.0  # times `spacing`, of those that have yet to meet
MIDDLE = (0.3, 0.7)  # share of the time between which they are close
EXTENT = 250.0  # half width of the square in which false alarms are [m]


def close_targets(
    seed: int = 0,
    pattern: Literal["abreast", "column", "meeting"] = "meeting",
    number: int = 4,
    spacing: float = 3.0,
    noise: float = 1.0,
    duration: float = 20.0,
    detection: float = 0.95,
    clutter: float = 5.0,
) -> Scene:
    """Positions of close vehicles, every 0.2 s.

    number     of vehicles
    spacing    between their middles where they are close [m]
    noise      standard deviation of x and y [m]
    duration   [s]
    detection  probability to detect a vehicle
    clutter    false alarms a scan, in a square of 500 m

    Raises InputError for fewer than two vehicles and for numbers out of range."""
    if seed < 0 or number < 2 or not 0.0 <= clutter < math.inf:
        raise InputError(
            f"scenario close_targets: seed is {seed}, number {number} and clutter {clutter}; "
            "give seed >= 0, two vehicles or more, and clutter >= 0"
        )
    if not all(0.0 < value < math.inf for value in (spacing, noise)) or not STEP <= duration <= 35.0:
        raise InputError(
            f"scenario close_targets: spacing is {spacing}, noise {noise} and duration {duration}; "
            f"give positive numbers, and {STEP} to 35 s, in which the vehicles stay in the square"
        )
    way_seed, scan_seed = np.random.SeedSequence(seed).spawn(2)
    time = np.round(STEP * np.arange(round(duration / STEP) + 1), 6)
    state = ways(time, pattern, number, spacing, np.random.default_rng(way_seed))
    sensor = Position(name="plots", noise_std=(noise, noise), detection=detection, clutter=clutter, extent=EXTENT)
    model, world = Traffic((sensor,), ConstantVelocity(), (Kind(noise=(0.5, 0.5)),)), points(time, state)
    seeds = scan_seed.spawn(len(time))
    scans = tuple(
        see(model, "plots", world, t, np.zeros(3), np.random.default_rng(own))[0] for t, own in enumerate(seeds)
    )
    info = {"scenario": "close_targets", "seed": seed, "pattern": pattern, "number": number, "spacing_m": spacing}
    info |= {"noise_m": noise, "duration_s": duration, "detection": detection, "clutter": clutter, "scans": len(scans)}
    return Scene(Recording(scans), truth_of(world, model.motion), f"close_targets {pattern} {seed}", info)


def ways(time: Floats, pattern: str, number: int, spacing: float, rng: np.random.Generator) -> Floats:
    """(T, N, 4) x, y, vx, vy."""
    rank = np.arange(number) - 0.5 * (number - 1)
    place = np.zeros((len(time), number, 2))
    place[..., 0] = SPEED * (time - time.mean())[:, None]
    if pattern == "column":
        place[..., 0] -= spacing * rank
    else:
        share = (time - time[0]) / (time[-1] - time[0])
        gap = np.full(len(time), spacing)
        if pattern == "meeting":
            away = np.maximum(MIDDLE[0] - share, share - MIDDLE[1]) / MIDDLE[0]
            gap *= 1.0 + (APART - 1.0) * np.sin(0.5 * math.pi * np.maximum(away, 0.0)) ** 2
        place[..., 1] = gap[:, None] * rank
    place += sway(time, number, rng)
    return np.concatenate([place, np.gradient(place, time, axis=0)], -1)


def sway(time: Floats, number: int, rng: np.random.Generator) -> Floats:
    """(T, N, 2) [m], from none at first: the integral of the velocity
    u <- c u + N(0, (1 - c^2) SWAY^2),  c = e^(-dt / KEEPING)."""
    step = time[1] - time[0]
    keep = math.exp(-step / KEEPING)
    own = np.empty((len(time), number, 2))
    own[0] = SWAY * rng.standard_normal((number, 2))
    for t in range(1, len(time)):
        own[t] = keep * own[t - 1] + math.sqrt(1.0 - keep**2) * SWAY * rng.standard_normal((number, 2))
    return step * (np.cumsum(own, 0) - own[0])
