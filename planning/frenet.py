"""The state of a vehicle along a reference line, from and to the plane.

The reference point is the middle of the rear axle, whose path has the vehicle's heading as its tangent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.program import InputError
from planning.kinematics import KINEMATICS
from planning.polynomials import NOTHING
from planning.reference import ReferenceLine
from planning.reference_kernel import BEYOND_ENDS, FOUND

Floats = NDArray[np.float64]
STEEPEST = math.radians(75)  # between the vehicle and the line: beyond it, arc length hardly grows with the way


class Pose(NamedTuple):
    """x, y [m], heading [rad], speed [m/s], acceleration along the path [m/s^2], curvature of the path [1/m]."""

    x: float
    y: float
    heading: float
    speed: float
    acceleration: float = 0.0
    curvature: float = 0.0


class FrenetState(NamedTuple):
    """Arc length s with its time derivatives ds, dds; offset d, its slope dd/ds and bend d^2 d/ds^2 (1/m).

    By arc length, because a standing vehicle has a direction too. In time: d' = slope s', d'' = bend s'^2 + slope s''.
    """

    s: float
    ds: float
    dds: float
    d: float
    slope: float = 0.0
    bend: float = 0.0

    @property
    def lateral(self) -> tuple[float, float, float]:
        """d, d', d'' in time."""
        return self.d, self.slope * self.ds, self.bend * self.ds**2 + self.slope * self.dds


def to_frenet(line: ReferenceLine, pose: Pose, start: float | None = None) -> FrenetState:
    """The state along the line, its foot searched from arc length `start`.

        slope = w tan(heading - theta),   s' = v cos(heading - theta) / w,   w = 1 - kappa d

    and bend and s'' from curvature and acceleration, in which planning.kinematics is linear.
    Raises InputError off the line: beyond its ends, beyond its centre of curvature, across it, or NaN."""
    if not all(map(math.isfinite, pose)):
        raise InputError(f"the vehicle's state {pose} is not finite")
    found, ended = line.project([pose[:2]], None if start is None else [start])
    s, d = map(float, found[0])
    if ended[0] != FOUND:
        why = "before or after the line" if ended[0] == BEYOND_ENDS else "at the line's centre of curvature"
        raise InputError(f"the vehicle at ({pose.x:.2f}, {pose.y:.2f}) is {why} (s {s:.1f} m, d {d:.1f} m)")
    _, _, theta, kappa, rate = map(float, line.at(s))
    w, turned = 1.0 - kappa * d, math.remainder(pose.heading - theta, 2 * math.pi)
    if abs(turned) > STEEPEST:
        raise InputError(
            f"the vehicle heads {math.degrees(turned):.0f} degrees away from the line at s {s:.1f} m; "
            f"choose a line that runs its way (within {math.degrees(STEEPEST):.0f} degrees)"
        )
    slope = w * math.tan(turned)
    n = w / math.cos(turned)  # way per arc length
    narrowing = -(rate * d + kappa * slope)  # dw/ds
    bend = (pose.curvature * n**3 + slope * (narrowing - kappa * slope)) / w - kappa * w
    ds = pose.speed / n
    stretching = (w * narrowing + slope * bend) / n  # dn/ds
    return FrenetState(s, ds, (pose.acceleration - stretching * ds**2) / n, d, slope, bend)


def to_pose(line: ReferenceLine, state: FrenetState) -> Pose:
    """Where the vehicle is and how it moves there."""
    return Pose(*to_poses(line, [state])[0].tolist())


def to_poses(line: ReferenceLine, states: Sequence[FrenetState]) -> Floats:
    """Poses (K, 6) of K states.

    With s' = 1 and s'' = 0 the kinematics tell n = ds_path/ds, dn/ds and the curvature; v = n s'."""
    s, ds, dds, d, slope, bend = np.array(states, float).T
    _, _, theta, kappa, rate = line.at(s).T
    one = np.ones_like(s)
    n, stretching, curvature, w = KINEMATICS(np.stack([one, 0 * one, kappa, rate, d, slope, bend], -1), NOTHING).T
    x, y = line.place(s, d).T
    return np.stack([x, y, theta + np.arctan2(slope, w), n * ds, n * dds + stretching * ds**2, curvature], -1)
