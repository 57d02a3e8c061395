"""What sensors report: scans, and the checks that they are usable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.program import InputError

Floats = NDArray[np.float64]


class Scan(NamedTuple):
    """All M measurements of one sensor at one time. Sensors are never coupled: each reports its own.

    sensor    name of the sensor, as the model has it
    time      [s]
    values    (M, d) as the sensor measures
    pose      (3,) of the car in the world then: x, y [m], heading [rad]
    noise     (M, d, d) covariances, None for those of the sensor
    score     (M,) what the detector thinks of each: the probability that it is no false alarm; None where it has no
              opinion
    likeness  (M, C) p(looks of the measurement | kind), up to a factor by measurement; None where it shows no kind
    """

    sensor: str
    time: float
    values: Floats
    pose: Floats
    noise: Floats | None = None
    score: Floats | None = None
    likeness: Floats | None = None


class Recording(NamedTuple):
    """What all sensors of a car reported, in the order in which it arrived: late scans come late."""

    scans: tuple[Scan, ...]


def check_scan(scan: Scan, names: Sequence[str], num_kinds: int) -> Scan:
    """The scan, its numbers as arrays of float64. A scan without measurements is one, too.

    names          of what its sensor measures
    num_kinds      of objects, for its likeness

    Raises InputError naming sensor, time, value and what to do: for a time, a pose, values, covariances, scores or a
    likeness that are not finite, of another shape than they should be, or out of their range."""
    if not (math.isfinite(scan.time) and scan.time >= 0.0):
        raise InputError(
            f"a scan of sensor '{scan.sensor}' has time {scan.time} s; give the seconds since a start, 0 or later"
        )
    where, num = f"the scan of sensor '{scan.sensor}' at {scan.time:g} s", len(scan.values)

    def numbers(name: str, value: Any, shape: tuple[int, ...], cure: str = "leave that measurement out") -> Floats:
        found = np.asarray(value, dtype=np.float64)
        if not found.size and not math.prod(shape):
            return np.zeros(shape)
        if found.shape != shape:
            raise InputError(f"{where} has {name} of shape {found.shape}; give {shape}")
        if not np.isfinite(found).all():
            at = tuple(np.argwhere(~np.isfinite(found))[0].tolist())
            raise InputError(f"{where} has {found[at]} in its {name}, at {list(at)}; {cure}")
        return found

    values = numbers(f"values of ({', '.join(names)})", scan.values, (num, len(names)))
    pose = numbers("pose (x, y, heading)", scan.pose, (3,), "give where the car was")
    noise, score, likeness = scan.noise, scan.score, scan.likeness
    if noise is not None:
        noise = numbers("covariances", noise, (num, len(names), len(names)))
        odd = np.abs(noise - noise.swapaxes(1, 2)).max((1, 2), initial=0.0) > 1e-9 * np.abs(noise).max(
            (1, 2), initial=0.0
        )
        bad = np.flatnonzero(odd | (np.linalg.eigvalsh(noise)[:, 0] <= 0.0)) if num else np.zeros(0, dtype=np.int64)
        if len(bad):
            raise InputError(
                f"{where} has a covariance that is not symmetric and positive definite, of measurement {bad[0]}: "
                f"{noise[bad[0]].tolist()}; give the variances of the sensor there"
            )
    if score is not None:
        score = numbers("scores", score, (num,))
        if (wrong := (score < 0.0) | (score > 1.0)).any():
            raise InputError(
                f"{where} has the score {score[wrong][0]:g}, but scores are probabilities; calibrate them into [0, 1]"
            )
    if likeness is not None:
        likeness = numbers("likeness by kind", likeness, (num, num_kinds))
        if (wrong := (likeness < 0.0).any(1) | (likeness.sum(1) == 0.0)).any():
            raise InputError(
                f"{where} has the likeness {likeness[wrong][0].tolist()}; give p(looks | kind), which some kind has"
            )
    return scan._replace(time=float(scan.time), values=values, pose=pose, noise=noise, score=score, likeness=likeness)
