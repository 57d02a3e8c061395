"""How objects move: formulas over scalars, with the noise that their model of motion is wrong by.

    x' = f(x, dt) + L(x, dt) e,   e ~ N(0, I)

The first entries of a state are those of the motion; `extras` follow: what an object is like (its box) or where it
points, each a random walk,   e' = e + N(0, q^2 dt).

CTRA is the motion of vehicles in [K15], section V-A.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.formula import Formula
from models.program import InputError

Floats = NDArray[np.float64]
Scalars = Sequence[Any]

ANGLES = {
    "heading": 2 * math.pi,
    "bearing": 2 * math.pi,
    "axis": math.pi,
}  # entries of states and measurements that are angles, and their period


class Body(NamedTuple):
    """What a sensor can see of an object: position [m], velocity [m/s], heading [rad], and its box [m] where the state
    has one; None where it has not. z is the height of its lower side."""

    x: Any
    y: Any
    vx: Any
    vy: Any
    heading: Any = None
    length: Any = None
    width: Any = None
    height: Any = None
    z: Any = None


@dataclass(frozen=True)
class Motion:
    """What all models of motion have. `noises` are names of the standard deviations that scale L, extras last."""

    extras: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Of the state's entries, extras last."""
        raise NotImplementedError

    @property
    def noises(self) -> tuple[str, ...]:
        """Of the noise's standard deviations, extras last."""
        raise NotImplementedError

    def move(self, x: Scalars, dt: Any, ops: Any) -> Scalars:
        """f of the motion's own entries."""
        raise NotImplementedError

    def noise(self, x: Scalars, dt: Any, std: Scalars, ops: Any) -> list[Scalars]:
        """The columns of L, motion's own entries only."""
        raise NotImplementedError

    def body(self, x: Scalars, ops: Any) -> Body:
        """What a sensor sees of the state, extras included."""
        raise NotImplementedError


@dataclass(frozen=True)
class ConstantVelocity(Motion):
    """Straight on at the same speed; white acceleration of density q^2 [m^2/s^3] along and across the heading where
    `heading` is an extra, else along x and y alike.

        x' = x + vx dt,  vx' = vx,   Q = q^2 [[dt^3 / 3, dt^2 / 2], [dt^2 / 2, dt]]   (Bar-Shalom et al. 2001, 6.2.2)
    """

    @property
    def names(self) -> tuple[str, ...]:
        return ("x", "y", "vx", "vy", *self.extras)

    @property
    def noises(self) -> tuple[str, ...]:
        return ("along", "across", *self.extras)

    def move(self, x: Scalars, dt: Any, ops: Any) -> Scalars:
        return (x[0] + x[2] * dt, x[1] + x[3] * dt, x[2], x[3])

    def noise(self, x: Scalars, dt: Any, std: Scalars, ops: Any) -> list[Scalars]:
        cos, sin = 1.0, 0.0
        if "heading" in self.extras:
            heading = x[4 + self.extras.index("heading")]
            cos, sin = ops.cos(heading), ops.sin(heading)
        columns = list[Scalars]()
        for (cx, cy), q in zip(((cos, sin), (-sin, cos)), std, strict=True):
            for place, speed in _integrated_white(dt, q, ops):
                columns.append((cx * place, cy * place, cx * speed, cy * speed))
        return columns

    def body(self, x: Scalars, ops: Any) -> Body:
        return Body(*x[:4], **dict(zip(self.extras, x[4:], strict=True)))


@dataclass(frozen=True)
class ConstantTurn(Motion):
    """On a circle at the same speed (CTRV), or with the same acceleration (CTRA, `accelerates`).

        x' = x + int_0^dt (v + a s) cos(psi + w s) ds,   psi' = psi + w dt,   v' = v + a dt

    The integral is Gauss's with three points: exact to dt^7 and without the singularity of the closed form at w = 0.
    White noise drives the yaw rate (`turn`, [rad/s^1.5]), and acceleration (`push`, [m/s^2.5]; of CTRV [m/s^1.5]);
    `slip` [m/s^0.5] is a random walk of the position. What the noise of a step does to the position of the same step by
    way of the heading is left out (dt^3)."""

    accelerates: bool = True

    @property
    def names(self) -> tuple[str, ...]:
        own = ("x", "y", "heading", "speed", "yaw_rate", "acceleration")
        return (*own[: 5 + self.accelerates], *self.extras)

    @property
    def noises(self) -> tuple[str, ...]:
        return ("push", "turn", "slip", *self.extras)

    def move(self, x: Scalars, dt: Any, ops: Any) -> Scalars:
        px, py, heading, speed, rate = x[:5]
        a = x[5] if self.accelerates else 0.0
        for node, weight in _GAUSS:
            angle, way = heading + rate * (node * dt), (speed + a * (node * dt)) * (weight * dt)
            px, py = px + way * ops.cos(angle), py + way * ops.sin(angle)
        return (px, py, heading + rate * dt, speed + a * dt, rate, *([a] if self.accelerates else []))

    def noise(self, x: Scalars, dt: Any, std: Scalars, ops: Any) -> list[Scalars]:
        push, turn, slip = std
        cos, sin, rest = ops.cos(x[2]), ops.sin(x[2]), (0.0,) * self.accelerates
        columns = list[Scalars]()
        if self.accelerates:
            for place, speed, a in _twice_integrated_white(dt, push, ops):
                columns.append((cos * place, sin * place, 0.0, speed, 0.0, a))
        else:
            for place, speed in _integrated_white(dt, push, ops):
                columns.append((cos * place, sin * place, 0.0, speed, 0.0))
        for angle, rate in _integrated_white(dt, turn, ops):
            columns.append((0.0, 0.0, angle, 0.0, rate, *rest))
        step = slip * ops.sqrt(dt)
        return [*columns, (step, 0.0, 0.0, 0.0, 0.0, *rest), (0.0, step, 0.0, 0.0, 0.0, *rest)]

    def body(self, x: Scalars, ops: Any) -> Body:
        own = 5 + self.accelerates
        vx, vy = x[3] * ops.cos(x[2]), x[3] * ops.sin(x[2])
        return Body(x[0], x[1], vx, vy, x[2], **dict(zip(self.extras, x[own:], strict=True)))


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)
_GAUSS = tuple(zip((0.5 * (1.0 + _NODES)).tolist(), (0.5 * _WEIGHTS).tolist(), strict=True))


def _integrated_white(dt: Any, q: Any, ops: Any) -> tuple[Scalars, ...]:
    """Columns of the Cholesky factor of q^2 [[dt^3 / 3, dt^2 / 2], [dt^2 / 2, dt]]."""
    root = q * ops.sqrt(dt)
    return (root * dt / math.sqrt(3.0), root * math.sqrt(3.0) / 2), (0.0, root / 2)


def _twice_integrated_white(dt: Any, q: Any, ops: Any) -> tuple[Scalars, ...]:
    """Columns of that of q^2 [[dt^5 / 20, dt^4 / 8, dt^3 / 6], [dt^4 / 8, dt^3 / 3, dt^2 / 2], [., ., dt]]."""
    root = q * ops.sqrt(dt)
    first = (root * dt * dt / math.sqrt(20.0), root * dt * math.sqrt(20.0) / 8, root * math.sqrt(20.0) / 6)
    return first, (0.0, root * dt / math.sqrt(48.0), root / math.sqrt(3.0)), (0.0, 0.0, root / 3)


def check_length(what: str, values: Any, names: Sequence[str]) -> None:
    """Raises InputError where what a motion or a sensor gives is not one value for each name."""
    if not hasattr(values, "__len__"):
        raise InputError(f"{what} gives {type(values).__name__}, but must give a tuple of ({', '.join(names)})")
    if len(values) != len(names):
        raise InputError(f"{what} gives {len(values)} values, but must give {len(names)}: ({', '.join(names)})")


@lru_cache
def move_formula(motion: Motion) -> Formula:
    """(x; step) -> f(x). A step is dt and standard deviations by `noises`, which f does not read."""
    own = len(motion.names) - len(motion.extras)

    def move(x: Scalars, p: Scalars, ops: Any) -> Scalars:
        moved = motion.move(x, p[0], ops)
        check_length(f"{type(motion).__name__}.move", moved, motion.names[:own])
        return (*moved, *x[own:])

    return Formula("move", move, len(motion.names), 1 + len(motion.noises))


@lru_cache
def noise_formula(motion: Motion) -> Formula:
    """(x; step) -> L (n, m), row after row."""
    size, num = len(motion.names), 1 + len(motion.noises)
    own, first = size - len(motion.extras), num - len(motion.extras)

    def noise(x: Scalars, p: Scalars, ops: Any) -> Scalars:
        columns = [*motion.noise(x, p[0], p[1:first], ops)]
        for column in columns:
            check_length(f"a column of {type(motion).__name__}.noise", column, motion.names[:own])
        columns = [(*column, *(0.0,) * (size - own)) for column in columns]
        for entry, q in zip(range(own, size), p[first:num], strict=True):
            step = q * ops.sqrt(p[0])
            columns.append(tuple(step if i == entry else 0.0 for i in range(size)))
        return tuple(column[i] for i in range(size) for column in columns)

    return Formula("noise", noise, size, num)
