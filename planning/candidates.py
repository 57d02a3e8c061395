"""Candidate motions after Werling et al. (2010): jerk-optimal polynomials to a fan of ends, and what each costs.

    along    C_s = k_j int(s'''^2) + k_t T + k_s (s(T) - s_target(T))^2      to a place that may move (quintic)
                                   ... + k_s (s'(T) - v_target)^2            to a speed (quartic; [K15] says quintic)
    across   C_d = k_j int(d'''^2) + k_t T + k_d (d(T) - d_target)^2
    total    k_lon C_s + k_lat C_d

End times lie on the grid of planning cycles, and what is left of the previous plan is a candidate too, its cost told
anew against today's target: in a world that does not change, the next plan is then the rest of the last one
(Bellman), to rounding.

Near standstill an offset is told by the way w from the start, d(w), so that it stays drivable. Its cost is that of a
motion at the speed v where both ways of telling meet: T = W / v, int(d'''(t)^2 dt) = v^5 int(d'''(w)^2 dw).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.program import InputError
from planning.frenet import FrenetState
from planning.polynomials import Polynomials, quartics, quintics, squared_jerk

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Weights:
    """k_j [s^5/m^2], k_t [1/s], k_s [1/m^2, for speeds s^2/m^2], k_d [1/m^2]; k_lon, k_lat.

    An error e is left alone where k_s e^2 costs less than mending it: 720 k_j e^2 / T^5 + k_t T in the best T. With
    these values that is below .1 m and .05 m/s."""

    jerk: float = 0.1
    time: float = 0.5
    along: float = 50.0
    across: float = 50.0
    longitudinal: float = 1.0
    lateral: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value < math.inf:
                raise InputError(f"weights: {name} is {value}, but must be 0 or more and finite")


class Keep(NamedTuple):
    """Drive at a speed [m/s]."""

    speed: float

    def costs(self, place: Floats, speed: Floats, time: Floats) -> Floats:
        """Squared distances of ends from the target."""
        return (speed - self.speed) ** 2


class Reach(NamedTuple):
    """Be at a place that moves: s(t) = place + speed t + acceleration t^2 / 2, speed never below 0 [m, s].

    behind  how far short of it an end may fall; past: how far beyond it [m]
    until   when it stands still at the latest [s]"""

    place: float
    speed: float = 0.0
    acceleration: float = 0.0
    behind: float = 6.0
    past: float = 2.0
    until: float = math.inf

    def target(self, time: ArrayLike) -> tuple[Floats, Floats]:
        """Place and speed at times; a target that brakes stands still in the end."""
        given = np.asarray(time, float)
        end = min(self.until, self.speed / -self.acceleration if self.acceleration < 0 else math.inf)
        t: Floats = np.minimum(given, end)
        speed = np.where(given < end, self.speed + self.acceleration * t, 0.0)
        return self.place + self.speed * t + self.acceleration * t**2 / 2, speed

    def costs(self, place: Floats, speed: Floats, time: Floats) -> Floats:
        """Squared distances of ends from the target, in place and in speed."""
        wanted, pace = self.target(time)
        return (place - wanted) ** 2 + (speed - pace) ** 2


Goal = Keep | Reach


def follow(rear: float, speed: float, acceleration: float, front: float, *, gap: float, headway: float) -> Reach:
    """Behind a lead vehicle whose rear is at `rear`: gap + headway * its speed short of it with one's own front, which
    is `front` ahead of the reference point. It stands still when the lead vehicle does."""
    wanted, until = speed - headway * acceleration, math.inf
    if acceleration < 0:
        until = max(speed, 0.0) / -acceleration
    return Reach(rear - front - gap - headway * speed, max(wanted, 0.0), acceleration, until=until)


def stop(place: float, front: float) -> Reach:
    """With one's front at `place`, or up to a metre before it."""
    return Reach(place - front, 0.0, 0.0, behind=1.0, past=0.0)


def merge(ahead: tuple[float, float], behind: tuple[float, float]) -> Reach:
    """Midway between two vehicles, each (s [m], speed [m/s])."""
    return Reach((ahead[0] + behind[0]) / 2, max((ahead[1] + behind[1]) / 2, 0.0))


@dataclass(frozen=True)
class Fans:
    """How many ends, and when.

    cycle      [s] between plans; end times are its multiples
    soonest       [s] of end times; the latest are
    latest        across, latest_speed to a speed, latest_place to a place [s]. Later than the horizon: an end that is
                  best beyond the latest moves on with every cycle, and plans are then not the rest of those before
    num_speeds, num_places
    ways       lengths of lateral motions near standstill [m]
    slow       [m/s] below which they are told by the way
    """

    cycle: float = 0.15
    soonest: float = 0.9
    latest: float = 3.0
    latest_speed: float = 6.0
    latest_place: float = 9.0
    num_speeds: int = 13
    num_places: int = 9
    ways: tuple[float, ...] = (4.0, 6.0, 9.0, 13.0, 18.0)
    slow: float = 3.0

    def __post_init__(self) -> None:
        for name in ("cycle", "soonest", "slow"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"fans: {name} is {getattr(self, name)}, but must be positive and finite")
        if round(self.soonest / self.cycle) < 1:
            raise InputError(f"fans: soonest is {self.soonest}, less than half a cycle of {self.cycle} s")
        for name in ("latest", "latest_speed", "latest_place"):
            if not self.soonest <= getattr(self, name) < math.inf:
                raise InputError(f"fans: {name} is {getattr(self, name)}, sooner than soonest, {self.soonest}")
        for name in ("num_speeds", "num_places"):
            if getattr(self, name) < 1:
                raise InputError(f"fans: {name} is {getattr(self, name)}, but must be 1 or more")
        if not self.ways or not all(0.0 < way < math.inf for way in self.ways):
            raise InputError(f"fans: ways are {self.ways}, but must be one or more positive lengths [m]")

    def times(self, latest: float) -> Floats:
        """On the grid of cycles."""
        cycles = np.arange(round(self.soonest / self.cycle), round(latest / self.cycle) + 1)
        return self.cycle * cycles.astype(np.float64)


class Longitudinal(NamedTuple):
    """N motions along the line and their costs."""

    motion: Polynomials
    cost: Floats


class Lateral(NamedTuple):
    """N motions across the line: d(t), or d(way) where by_way, its durations then lengths [m]; targets d(T)."""

    motion: Polynomials
    by_way: NDArray[np.bool_]
    target: Floats
    cost: Floats


def longitudinal(
    state: FrenetState, goal: Goal, fans: Fans, weights: Weights, rest: Polynomials | None
) -> Longitudinal:
    """All of a goal, and `rest`, what is left of the last plan."""
    start = (state.s, state.ds, state.dds)
    if isinstance(goal, Keep):
        speeds = np.unique(np.maximum(goal.speed + np.linspace(-goal.speed, 2.0, fans.num_speeds), 0.0))
        T, v = _grid(fans.times(fans.latest_speed), np.union1d(speeds, [goal.speed]))
        motion = quartics(start, v, T)
    else:
        offsets = np.linspace(-goal.behind, goal.past, fans.num_places)
        T, offset = _grid(fans.times(fans.latest_place), np.union1d(offsets, [0.0]))
        place, speed = goal.target(T)
        motion = quintics(start, np.stack([place + offset, speed, np.zeros_like(speed)], -1), T)
    if rest is not None:
        motion = _joined(motion, rest)
    return Longitudinal(motion, longitudinal_cost(motion, goal, weights))


def longitudinal_cost(motion: Polynomials, goal: Goal, weights: Weights) -> Floats:
    """C_s (N,)."""
    end = motion.end()
    off = goal.costs(end[:, 0], end[:, 1], motion.duration)
    cost: Floats = weights.jerk * squared_jerk(motion) + weights.time * motion.duration + weights.along * off
    return cost


def lateral(
    state: FrenetState,
    targets: Floats,
    wanted: float,
    fans: Fans,
    weights: Weights,
    rest: Lateral | None,
) -> Lateral:
    """To offsets `targets` (N,), of which `wanted` costs nothing, and the `rest` of the last plan."""
    by_way = state.ds < fans.slow
    ends, start = (
        (np.asarray(fans.ways), (state.d, state.slope, state.bend))
        if by_way
        else (fans.times(fans.latest), state.lateral)
    )
    T, d = _grid(ends, targets)
    motion = quintics(start, np.stack([d, np.zeros_like(d), np.zeros_like(d)], -1), T)
    told = np.full(len(T), by_way)
    if rest is not None:
        motion, told, d = _joined(motion, rest.motion), np.r_[told, rest.by_way], np.r_[d, rest.target]
    pace = np.where(told, fans.slow, 1.0)
    jerk, time = squared_jerk(motion) * pace**5, motion.duration / pace
    cost = weights.jerk * jerk + weights.time * time + weights.across * (d - wanted) ** 2
    return Lateral(motion, told, d, cost)


def _joined(motion: Polynomials, rest: Polynomials) -> Polynomials:
    return Polynomials(
        np.concatenate([motion.coefficients, rest.coefficients]), np.concatenate([motion.duration, rest.duration])
    )


def _grid(a: ArrayLike, b: ArrayLike) -> tuple[Floats, Floats]:
    first, second = np.meshgrid(np.asarray(a, float), np.asarray(b, float), indexing="ij")
    return first.ravel(), second.ravel()
