"""An outline: the rectangle that laser points show of an object, sides that nobody sees left open.

An object is seen as several points, and those tell of a rectangle ([K15], section VI; Granstroem, Reuter, Meissner and
Scheel 2014, who track cars under an assumed rectangular shape and weigh partitions of the points into objects). Here
points are clustered and fitted before the filter, one measurement for each object, so that no filter changes. Length
and width are in the state, and sides that are seen at different times add up.

What is measured is where the middle is and a tensor of the size,

    A = L u u' + W v v',   u along the heading and v across it

and not an axis and two sizes: which side of a rectangle is the length, one scan cannot know (the rear of a car is as
wide as a bicycle is long), and an axis with the sizes along it jumps where the two change places, wherever the cut is
made. A is the same for (axis, L, W) and (axis + pi / 2, W, L), so it is smooth in the state, and needs no cut.

A side that nobody sees is no zero in a measurement but a direction without information: where the rear of a car is at
r, and its far end is hidden,

    middle = r + s u / 2,   A = s u u' + W v v',   whatever s is:   noise + UNSEEN^2 j j',   j = (u / 2, u u')

so that the rear alone is measured, and what was known of the length stays. `noise` of a scan has it so; the density of
s in it is divided out again (`feature`): objects are not less probable than false alarms for showing less.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from models.objects.motion import Body
from models.objects.scans import Scan
from models.objects.sensors import Placed, Scalars, Sensor

Floats = NDArray[np.float64]
UNSEEN = 1000.0  # standard deviation of a size that was not seen: a thousand scans know it to 32 m [m]


@dataclass(frozen=True, kw_only=True)
class LaserOutline(Sensor):
    """Middle of a rectangle in the frame of the sensor, ahead and aside [m], and the entries of its tensor A, (ahead,
    ahead), (ahead, aside) and (aside, aside) [m].

    False alarms are uniform in the rectangle about the view and have sizes up to `largest` [m]."""

    largest: float = 12.0
    names: ClassVar[tuple[str, ...]] = ("ahead", "aside", "extent", "skew", "breadth")
    reads: ClassVar[tuple[str, ...]] = ("heading", "length", "width")

    @staticmethod
    def measure(body: Body, at: Scalars, ops: Any) -> Scalars:
        dx, dy = body.x - at[0], body.y - at[1]
        cos, sin = ops.cos(at[2]), ops.sin(at[2])
        c, s = ops.cos(body.heading - at[2]), ops.sin(body.heading - at[2])
        ahead, aside = cos * dx + sin * dy, cos * dy - sin * dx
        extent, breadth = body.length * c * c + body.width * s * s, body.length * s * s + body.width * c * c
        return (ahead, aside, extent, (body.length - body.width) * c * s, breadth)

    def place(self, values: Floats, noise: Floats, at: Floats) -> Placed:
        """The four headings that a rectangle leaves open share the circle, for a square tells none of them."""
        cos, sin = math.cos(at[2]), math.sin(at[2])
        turn = np.array([[cos, -sin], [sin, cos]])
        axis = 0.5 * np.arctan2(2 * values[:, 3], values[:, 2] - values[:, 4]) + at[2]
        heading = axis[:, None] + 0.5 * math.pi * np.arange(4)
        return Placed(at[:2] + values[:, :2] @ turn.T, turn @ noise[:, :2, :2] @ turn.T, heading)

    @property
    def span(self) -> Floats:
        far, half = self.reach[1], min(self.angle / 2, math.pi)
        low = (far * min(math.cos(half), 0.0), -far * math.sin(min(half, math.pi / 2)), 0.0, -0.5 * self.largest, 0.0)
        return np.array([low, (far, -low[1], self.largest, -low[3], self.largest)]).T

    def feature(self, scan: Scan, num_kinds: int) -> Floats:
        """With the density of unseen sizes divided out: false alarms have them with 1 / largest, objects with that of
        UNSEEN, which stands for one. L + W, the trace of A, has UNSEEN^2 for each of them."""
        found = super().feature(scan, num_kinds)
        if scan.noise is None:
            return found
        trace = scan.noise[:, 2, 2] + 2 * scan.noise[:, 2, 4] + scan.noise[:, 4, 4]
        unseen = np.round(trace / UNSEEN**2)
        return found * ((math.sqrt(2 * math.pi) * UNSEEN / self.largest) ** unseen)[:, None]
