"""Detectors of boxes: on laser points, and in the image of a camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from models.objects.motion import Body
from models.objects.perception import logistic
from models.objects.sensors import Placed, RangeBearing, Scalars, Sensor, placed

Floats = NDArray[np.float64]
CLOSE = 0.3  # corners behind the camera or nearer to its plane are taken to be here [m]


def seen_from(body: Body, at: Scalars, ops: Any) -> tuple[Any, Any]:
    """Where a body is in the frame of the sensor: forward and to the left [m]."""
    dx, dy, cos, sin = body.x - at[0], body.y - at[1], ops.cos(at[2]), ops.sin(at[2])
    return cos * dx + sin * dy, cos * dy - sin * dx


@dataclass(frozen=True, kw_only=True)
class BoxSensor(Sensor):
    """What such detectors share: an object that is partly in the image may be seen.

    far         range at which half of the objects are detected that would be nearer by [m]
    softness    of that range [m]
    half_width  of an object [m]: detection falls with the share of it that is in view, once a third is out of it
    """

    softness: float = 4.0
    half_width: float = 1.2

    @property
    def view_settings(self) -> tuple[float, ...]:
        return (self.angle / 2, self.reach[1], self.softness, self.half_width)

    @staticmethod
    def view(body: Body, at: Scalars, settings: Scalars, ops: Any) -> Any:
        half, far, softness, half_width = settings
        forward, left = seen_from(body, at, ops)
        distance, bearing = ops.sqrt(forward * forward + left * left + 1e-9), ops.atan2(left, forward + 1e-12)
        wide = ops.atan2(half_width, distance)
        inside = ops.fmin(ops.fmax((half + wide - ops.fabs(bearing)) / (2 * wide), 0.0), 1.0)
        return ops.fmin(1.5 * inside, 1.0) * logistic((far - distance) / softness, ops)


@dataclass(frozen=True, kw_only=True)
class BoxDetector(BoxSensor):
    """Range [m] and bearing [rad] of the middle of a box, the axis it lies along (front and back are not told apart
    [rad]), height z of its lower side in the world, its height, width and length [m].

    clutter_density  false alarms are uniform in the view, so many to the square metre (`clutter` is not read)
    clutter_shape    (4, 2) mean and standard deviation of their z, height, width and length, which are normal"""

    clutter_density: float = 2.7e-4
    clutter_shape: tuple[tuple[float, float], ...] = ((0.0, 30.0), (1.5, 0.15), (1.6, 0.12), (3.9, 0.45))

    names: ClassVar[tuple[str, ...]] = ("range", "bearing", "axis", "z", "height", "width", "length")
    reads: ClassVar[tuple[str, ...]] = ("heading", "z", "height", "width", "length")

    @staticmethod
    def measure(body: Body, at: Scalars, ops: Any) -> Scalars:
        place = RangeBearing.measure(body, at, ops)
        return (*place, body.heading - at[2], body.z, body.height, body.width, body.length)

    def place(self, values: Floats, noise: Floats, at: Floats) -> Placed:
        return placed(values, noise, at)._replace(heading=values[:, 2:3] + at[2], heading_std=np.sqrt(noise[:, 2, 2]))

    @property
    def span(self) -> Floats:
        loc, std = np.array(self.clutter_shape).T
        half = min(self.angle / 2, math.pi)
        around = [self.reach, (-half, half), (-math.pi / 2, math.pi / 2)]
        return np.vstack([around, np.stack([loc - 3 * std, loc + 3 * std], 1)])

    @property
    def false_alarms(self) -> float:
        (near, far), half = self.reach, min(self.angle / 2, math.pi)
        return self.clutter_density * half * (far**2 - near**2)

    def clutter_quantile(self, uniform: Floats) -> Floats:
        from scipy.special import ndtri

        found, (near, far) = super().clutter_quantile(uniform), self.reach
        loc, std = np.array(self.clutter_shape).T
        found[..., 0] = np.sqrt(near**2 + (far**2 - near**2) * uniform[..., 0])
        found[..., 3:] = loc + std * ndtri(uniform[..., 3:])
        return found

    def clutter_intensity(self, values: Floats) -> Floats:
        loc, std = np.array(self.clutter_shape).T
        log = -0.5 * np.square((values[..., 3:] - loc) / std).sum(-1) - np.log(std * math.sqrt(2 * math.pi)).sum()
        return self.clutter_density / math.pi * values[..., 0] * np.exp(log)


@dataclass(frozen=True, kw_only=True)
class ImageBox(BoxSensor):
    """A box in the image: the angles to its left and its right side, left positive [rad], and how tall it is, as the
    tangent height / distance. It begins no track: where it is says no range well. False alarms are uniform over the
    view, up to `tallest`.

    blur  share of the tangent that is added to the noise of each: errors grow with the box

    A side that the border of the image cuts off says little: scans give it a large noise of its own.

    The camera is taken to look level: pitch and roll of the car are left out. How high the box stands in the image is
    not read, so a pitch a makes only `tall` wrong, at an angle e below the horizon by a^2 + 2 a e of itself at most:
    .03 rad at .1 rad make .7 %, a tenth of `blur`."""

    births: bool = False
    blur: tuple[float, float, float] = (0.05, 0.05, 0.07)
    tallest: float = 0.5

    names: ClassVar[tuple[str, ...]] = ("left", "right", "tall")
    reads: ClassVar[tuple[str, ...]] = ("heading", "height", "width", "length")

    @property
    def noise_settings(self) -> tuple[float, ...]:
        return (*self.noise_std, *self.blur)

    @staticmethod
    def measure(body: Body, at: Scalars, ops: Any) -> Scalars:
        forward, left = seen_from(body, at, ops)
        cos, sin = ops.cos(body.heading - at[2]), ops.sin(body.heading - at[2])
        ahead, angles = list[Any](), list[Any]()
        for along, across in ((0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)):
            u, v = along * body.length, across * body.width
            ahead.append(ops.fmax(forward + cos * u - sin * v, CLOSE))
            angles.append(ops.atan2(left + sin * u + cos * v, ahead[-1]))
        return (_of_all(ops.fmax, angles), _of_all(ops.fmin, angles), body.height / _of_all(ops.fmin, ahead))

    @staticmethod
    def spread(z: Scalars, settings: Scalars, ops: Any) -> Scalars:
        return tuple(std + blur * ops.fabs(z[2]) for std, blur in zip(settings[:3], settings[3:], strict=True))

    @property
    def span(self) -> Floats:
        half = min(self.angle / 2, math.pi / 2)
        return np.array([(-half, half), (-half, half), (0.0, self.tallest)])


def _of_all(pick: Any, four: list[Any]) -> Any:
    """The most or the least of four."""
    a, b, c, d = four
    return pick(pick(a, b), pick(c, d))
