"""Detections of the last seconds in the frame that the car has now, [T17] section 2.2 ("data buffering").

The car's way is integrated from a 6-axis inertial measurement unit; on flat ground its yaw rate w and its acceleration
a along the car matter. Going back from now, where pose and speed v are known, in steps of dt:

    heading -= w dt,   v -= a dt,   (x, y) -= v dt (cos, sin)(heading at the middle of the step)

A unit drifts. Its errors are a bias that is constant over the buffer and white noise; with F the derivative of one step
in (x, y, heading, v, bias of w, bias of a), the covariance of what was integrated follows

    P <- F P F' + dt diag(0, 0, yaw_noise^2, acceleration_noise^2, 0, 0),   P_0 = diag(0, 0, 0, speed_std^2, biases^2)

A detection p with covariance S, taken at pose (x, y, heading) with drift P, is now at (x, y) + R(heading) p with
covariance R S R' + J P J', J = d position / d (x, y, heading). Drift that detections share is counted for each as if it
were its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.program import InputError
from models.road.cues import Cues

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Drift:
    """Errors of an inertial measurement unit and of the speed, one standard deviation. Ours, of a unit for cars."""

    yaw_bias: float = 2e-3  # [rad/s]
    yaw_noise: float = 1e-3  # [rad / sqrt(s)]
    acceleration_bias: float = 0.05  # [m/s^2]
    acceleration_noise: float = 0.02  # [m/s / sqrt(s)]
    speed_std: float = 0.1  # now, from the wheels [m/s]

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value) or value < 0:
                raise InputError(f"{field.name} of the drift must be finite and not negative, but is {value}")


class Motion(NamedTuple):
    """Readings of the unit in rising order of time, the last one now.

    time          (M,) [s]
    yaw_rate      (M,) to the left [rad/s]
    acceleration  (M,) ahead [m/s^2]
    speed         now [m/s]
    """

    time: Floats
    yaw_rate: Floats
    acceleration: Floats
    speed: float


class Way(NamedTuple):
    """Where the car was at the times of its readings, in its frame of now.

    time   (M,) [s]
    pose   (M, 3) x, y [m], heading [rad]
    drift  (M, 3, 3) covariance of the pose
    """

    time: Floats
    pose: Floats
    drift: Floats


def integrate(motion: Motion, drift: Drift) -> Way:
    """The car's way back from now. Raises InputError for readings that are no motion."""
    time, num = motion.time, len(motion.time)
    if num == 0 or not all(np.isfinite(v).all() for v in motion) or np.any(np.diff(time) <= 0):
        raise InputError(
            f"the motion of the car needs finite readings at rising times, but has {num} of them from "
            f"{time[:1].tolist()} to {time[-1:].tolist()}; sort them and drop doubles"
        )
    pose, covariance = np.zeros((num, 3)), np.zeros((num, 3, 3))
    x = y = heading = 0.0
    speed, P = motion.speed, np.diag([0.0, 0.0, 0.0, drift.speed_std, drift.yaw_bias, drift.acceleration_bias]) ** 2
    for i in range(num - 1, 0, -1):
        dt = time[i] - time[i - 1]
        yaw_rate = 0.5 * (motion.yaw_rate[i] + motion.yaw_rate[i - 1])
        acceleration = 0.5 * (motion.acceleration[i] + motion.acceleration[i - 1])
        middle, mean = heading - 0.5 * yaw_rate * dt, speed - 0.5 * acceleration * dt
        cos, sin, way = math.cos(middle), math.sin(middle), mean * dt
        x, y, heading, speed = x - way * cos, y - way * sin, heading - yaw_rate * dt, speed - acceleration * dt
        F = np.eye(6)
        F[0, 2:] = way * sin, -dt * cos, -0.5 * dt * way * sin, 0.5 * dt**2 * cos
        F[1, 2:] = -way * cos, -dt * sin, 0.5 * dt * way * cos, 0.5 * dt**2 * sin
        F[2, 4], F[3, 5] = -dt, -dt
        P = F @ P @ F.T + dt * np.diag([0.0, 0.0, drift.yaw_noise, drift.acceleration_noise, 0.0, 0.0]) ** 2
        pose[i - 1], covariance[i - 1] = (x, y, heading), P[:3, :3]
    return Way(time, pose, covariance)


def compensate(cues: Cues, time: Floats, motion: Motion, drift: Drift, *, period: float = 2.0) -> Cues:
    """The cues detected in the last `period` seconds, each in the car's frame at its time (N,) [s], as seen from now.

    Their covariances, and the noise of directions of motion, have grown by the drift. Raises InputError for a time that
    no reading of the motion covers."""
    way = integrate(motion, drift)
    young = time >= way.time[-1] - period
    late, early = time > way.time[-1], young & (time < way.time[0])
    if np.any(late | early) or not np.isfinite(time).all():
        i = int(np.flatnonzero(late | early | ~np.isfinite(time))[0])
        raise InputError(
            f"cue {i} was detected at {time[i]} s, but the car's motion is known from {way.time[0]} s to "
            f"{way.time[-1]} s; give the readings of that time or drop the cue"
        )
    cues, time = cues.take(young), time[young]
    x, y, heading = (np.interp(time, way.time, column) for column in way.pose.T)
    flat = way.drift.reshape(-1, 9).T
    P = np.stack([np.interp(time, way.time, column) for column in flat], -1).reshape(-1, 3, 3)
    cos, sin = np.cos(heading), np.sin(heading)
    R = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    turned = np.einsum("nij,nj->ni", R, cues.position)
    J = np.zeros((len(time), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -turned[:, 1], turned[:, 0]
    grown = R @ cues.covariance @ R.transpose(0, 2, 1) + J @ P @ J.transpose(0, 2, 1)
    return cues._replace(
        position=np.stack([x, y], -1) + turned,
        covariance=0.5 * (grown + grown.transpose(0, 2, 1)),
        flow=cues.flow + heading,
        flow_std=np.hypot(cues.flow_std, np.sqrt(P[:, 2, 2])),
    )


def fuse(cues: Cues) -> Cues:
    """One cue for each object that stands: the mean of its detections, weighted by their information.

    Vehicles keep all their detections. Errors of the detections of one object count as independent; its confidence is
    the highest of theirs."""
    stands = np.isnan(cues.flow)
    keep, position, covariance = ~stands, cues.position.copy(), cues.covariance.copy()
    confidence = cues.confidence.copy()
    for kind, track in sorted({(str(k), int(t)) for k, t in zip(cues.kind[stands], cues.track[stands], strict=True)}):
        same = np.flatnonzero(stands & (cues.kind == kind) & (cues.track == track))
        information = np.linalg.inv(cues.covariance[same])
        first = same[0]
        covariance[first] = np.linalg.inv(information.sum(0))
        position[first] = covariance[first] @ np.einsum("nij,nj->i", information, cues.position[same])
        confidence[first] = cues.confidence[same].max()
        keep[first] = True
    return cues._replace(position=position, covariance=covariance, confidence=confidence).take(keep)
