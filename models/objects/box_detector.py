"""A detector of boxes that also says how much it likes each: PointRCNN and its like."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from models.objects.motion import Body
from models.objects.sensors import Placed, RangeBearing, Scalars

Floats = NDArray[np.float64]
FALL, NEAR = 0.2, 12.0  # scores of the same object fall by so much to the metre, from here on [m]


@dataclass(frozen=True, kw_only=True)
class BoxDetector(RangeBearing):
    """Range [m] and bearing [rad] of the middle of a box, the axis it lies along (front and back are not told apart
    [rad]), height of its bottom z, height, width, length [m], and a score, any number that grows with confidence.

    noise_std       (8,) at score 0; across the line of sight in metres, not radians
    sharpening      noise falls with the score s by exp(-sharpening s), but for that of the score itself
    clutter_density false alarms are uniform in the view with so many to the square metre; their z, sizes and scores
                    normal: `clutter_shape` (5, 2), mean and standard deviation

    The score is an entry of the state: how well an object is liked stays much the same from scan to scan, so that many
    detections of one object do not count as so many independent opinions."""

    sharpening: float = 0.15
    clutter_density: float = 2.7e-4
    clutter_shape: tuple[tuple[float, float], ...] = ((0.0, 1.0),) * 5
    soft: float = 4.0  # how softly the view ends at its farthest [m]
    half_width: float = 1.2  # of an object: one that is partly in the image may be seen [m]

    names: ClassVar[tuple[str, ...]] = ("range", "bearing", "axis", "z", "height", "width", "length", "score")
    reads: ClassVar[tuple[str, ...]] = ("heading", "z", "height", "width", "length", "score")

    @property
    def view_settings(self) -> tuple[float, ...]:
        return (self.angle / 2, self.reach[1], self.soft, self.half_width)

    @property
    def noise_settings(self) -> tuple[float, ...]:
        return (*self.noise_std, self.sharpening)

    @staticmethod
    def measure(body: Body, at: Scalars, ops: Any) -> Scalars:
        place = RangeBearing.measure(body, at, ops)
        score = body.score - FALL * ops.fmax(place[0] - NEAR, 0.0)
        return (*place, body.heading, body.z, body.height, body.width, body.length, score)

    @staticmethod
    def spread(z: Scalars, settings: Scalars, ops: Any) -> Scalars:
        along, across, *rest, score, sharpening = settings
        factor = ops.exp(-sharpening * z[7])
        return (along * factor, across * factor / ops.fmax(z[0], 1.0), *(std * factor for std in rest), score)

    @staticmethod
    def view(body: Body, at: Scalars, settings: Scalars, ops: Any) -> Any:
        half, far, soft, half_width = settings
        distance, bearing = RangeBearing.measure(body, at, ops)
        bearing = ops.atan2(ops.sin(bearing), ops.cos(bearing))
        wide = half_width / distance
        inside = ops.fmin(ops.fmax((half + wide - ops.fabs(bearing)) / (2 * wide), 0.0), 1.0)
        return ops.fmin(1.5 * inside, 1.0) * (0.5 + 0.5 * ops.tanh(0.5 * (far - distance) / soft))

    def place(self, values: Floats, noise: Floats, at: Floats) -> Placed:
        found = super().place(values, noise, at)
        return found._replace(heading=values[:, 2:3], heading_std=np.sqrt(noise[:, 2, 2]))

    @property
    def span(self) -> Floats:
        loc, std = np.array(self.clutter_shape).T
        return np.vstack([super().span, (0.0, math.pi), np.stack([loc - 3 * std, loc + 3 * std], 1)])

    def clutter_intensity(self, values: Floats) -> Floats:
        loc, std = np.array(self.clutter_shape).T
        log = -0.5 * np.square((values[..., 3:] - loc) / std).sum(-1) - np.log(std * math.sqrt(2 * math.pi)).sum()
        return self.clutter_density * values[..., 0] / math.pi * np.exp(log)
