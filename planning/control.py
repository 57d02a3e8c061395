"""Control along a planned motion, and the vehicle that is controlled.

The vehicle is a kinematic bicycle told at its rear axle; drive and steering follow commands with first-order lags:

    x' = v cos theta,  y' = v sin theta,  theta' = v kappa,  v' = a
    a' = (a_cmd - a) / tau_drive,   kappa' = (kappa_cmd - kappa) / tau_steer

Along, a state-space controller: of the errors x = (place, speed, acceleration) against the plan

    a_cmd = a_ff - K x,   eigenvalues of (A - B K) = exp(pole dt)

(A, B) being the lagged drive at its own time step. Across, with the offset e and the angle psi from the plan's path,

    kappa_cmd = kappa_ff - k1 e - k2 psi      so that  e'' + k2 e' + k1 e = 0  in way, k1 = p1 p2, k2 = -(p1 + p2)

which needs no speed. Both feed forward what lets a lag arrive at the plan's value after a step:
(r(t + dt) - phi r(t)) / (1 - phi), phi = exp(-dt / tau). [K15], section IV-A: two separate controllers, the one along
in state space.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.program import InputError
from planning.frenet import Pose
from planning.kinematics import Limits

Floats = NDArray[np.float64]
NIMBLE = 1.0  # [m/s] below which lateral acceleration limits no curvature


@dataclass(frozen=True)
class Lags:
    """Time constants of the drive and of the steering [s]."""

    drive: float = 0.15
    steer: float = 0.08

    def __post_init__(self) -> None:
        for name in ("drive", "steer"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"lags: {name} is {getattr(self, name)}, but must be positive and finite [s]")


@dataclass(frozen=True)
class Control:
    """Settings of both controllers.

    lags    of the vehicle as the controllers believe them
    along   poles of place, speed and acceleration [1/s]
    across  poles of the offset [1/m]
    step    [s] between commands
    """

    lags: Lags = field(default_factory=Lags)
    along: tuple[float, float, float] = (-1.5, -2.0, -6.0)
    across: tuple[float, float] = (-0.25, -0.25)
    step: float = 0.01

    def __post_init__(self) -> None:
        for name, num in (("along", 3), ("across", 2)):
            poles = getattr(self, name)
            if len(poles) != num or not all(-math.inf < pole < 0 for pole in poles):
                raise InputError(f"control: the poles {name} are {poles}, but must be {num} negative numbers")
        if not 0 < self.step < math.inf:
            raise InputError(f"control: step is {self.step}, but must be positive and finite [s]")

    @cached_property
    def along_gains(self) -> Floats:
        """(3,) K of place, speed and acceleration."""
        return state_feedback(*lagged_drive(self.lags.drive, self.step), np.exp(np.array(self.along) * self.step))

    @property
    def across_gains(self) -> tuple[float, float]:
        """k1 [1/m^2], k2 [1/m]."""
        return self.across[0] * self.across[1], -(self.across[0] + self.across[1])


class Command(NamedTuple):
    """What the drive and the steering are told: acceleration [m/s^2], curvature [1/m]."""

    acceleration: float
    curvature: float


def lagged_drive(lag: float, step: float) -> tuple[Floats, Floats]:
    """A (3, 3), B (3,) of (place, speed, acceleration) over a step with a constant command, exactly."""
    gone = lag * -math.expm1(-step / lag)  # integral of exp(-t / lag)
    kept = gone / lag
    A = np.array([[1.0, step, lag * (step - gone)], [0.0, 1.0, gone], [0.0, 0.0, 1.0 - kept]])
    return A, np.array([step**2 / 2 - lag * (step - gone), step - gone, kept])


def state_feedback(A: Floats, B: Floats, poles: Floats) -> Floats:
    """K that gives A - B K these eigenvalues (Ackermann's formula)."""
    reach = np.stack([np.linalg.matrix_power(A, k) @ B for k in range(len(B))], -1)
    wanted = sum(c * np.linalg.matrix_power(A, len(B) - k) for k, c in enumerate(np.poly(poles)))
    gains: Floats = np.linalg.solve(reach.T, np.eye(len(B))[-1]) @ wanted
    return gains


def errors(pose: Pose, reference: Pose) -> tuple[float, float, float]:
    """Along the plan [m], across it [m] and the angle to it [rad]; the plan's path goes on with its curvature up to
    the vehicle's foot."""
    dx, dy = pose.x - reference.x, pose.y - reference.y
    cos, sin = math.cos(reference.heading), math.sin(reference.heading)
    ahead = dx * cos + dy * sin
    left = dy * cos - dx * sin - reference.curvature * ahead**2 / 2
    return ahead, left, math.remainder(pose.heading - reference.heading - reference.curvature * ahead, 2 * math.pi)


def command(control: Control, limits: Limits, pose: Pose, now: Pose, following: Pose) -> Command:
    """What to do at a pose where the plan is at `now`, and a step later at `following`, within the limits.

    Raises InputError for numbers that are not finite."""
    for name, given in (("vehicle", pose), ("plan", now), ("plan, a step later,", following)):
        for field_name, value in zip(given._fields, given, strict=True):
            if not math.isfinite(value):
                raise InputError(f"control: the {name} has {field_name} = {value}")
    ahead, left, angle = errors(pose, now)
    off = (ahead, pose.speed - now.speed, pose.acceleration - now.acceleration)
    acceleration = _forward(now.acceleration, following.acceleration, control.lags.drive, control.step)
    acceleration -= _dot(control.along_gains, off)
    k1, k2 = control.across_gains
    curvature = _forward(now.curvature, following.curvature, control.lags.steer, control.step) - k1 * left - k2 * angle
    sharpest = min(limits.curvature, limits.lateral_acceleration / max(pose.speed, NIMBLE) ** 2)
    hardest = min(limits.acceleration, limits.power / max(pose.speed, NIMBLE))
    return Command(_within(acceleration, -limits.braking, hardest), _within(curvature, -sharpest, sharpest))


def moved(lags: Lags, pose: Pose, told: Command, step: float) -> Pose:
    """The vehicle a step later, commands held: lags and speed exact, heading and place by Simpson's rule.

    It does not roll backwards: brakes hold it at rest."""
    v, a, kappa = [], [], []
    for t in (0.0, step / 2, step):
        left = math.exp(-t / lags.drive)
        a.append(told.acceleration + (pose.acceleration - told.acceleration) * left)
        gained = told.acceleration * t + (pose.acceleration - told.acceleration) * lags.drive * (1.0 - left)
        v.append(max(pose.speed + gained, 0.0))
        kappa.append(told.curvature + (pose.curvature - told.curvature) * math.exp(-t / lags.steer))
    turn = [speed * bend for speed, bend in zip(v, kappa, strict=True)]
    theta = (
        pose.heading,
        pose.heading + step * (5 * turn[0] + 8 * turn[1] - turn[2]) / 24,
        pose.heading + step * (turn[0] + 4 * turn[1] + turn[2]) / 6,
    )
    weight = (step / 6, 4 * step / 6, step / 6)
    x = pose.x + sum(w * speed * math.cos(angle) for w, speed, angle in zip(weight, v, theta, strict=True))
    y = pose.y + sum(w * speed * math.sin(angle) for w, speed, angle in zip(weight, v, theta, strict=True))
    return Pose(x, y, theta[2], v[2], a[2] if v[2] > 0.0 else max(a[2], 0.0), kappa[2])


def _forward(now: float, following: float, lag: float, step: float) -> float:
    """The command with which a lag gets from the one value to the other in a step."""
    return now + (following - now) / -math.expm1(-step / lag)


def _dot(a: Floats, b: Sequence[float]) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _within(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
