"""What stands beside a night road and drives on it, and how far a camera sees it.

[T17] publishes no scenes. Ours: rows of static cues at equal distances on either side, of which the camera misses one
in twenty near by and one in three far away; up to four vehicles with a history of six detections each.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
NEAREST, FARTHEST = 12.0, 153.0  # arc lengths where vehicles are seen; the car is at about 10 [m]
HISTORY = 6  # detections of a vehicle
MARKING_REACH, MARKING_GAP = 70.0, 5.0  # markings are seen to, and every [m]


class Row(NamedTuple):
    """Static cues of one kind on one side, `gap` [m] apart."""

    kind: str
    left: bool
    gap: float


class Layout(NamedTuple):
    """N cues by kind (N,), side (N,), object (N,) and arc length along the course (N,) [m]."""

    kind: list[str]
    left: list[bool]
    track: list[int]
    arc: list[float]

    def add(self, kind: str, left: bool, track: int, arc: float) -> None:
        """One more cue."""
        for column, value in zip(self, (kind, left, track, arc), strict=True):
            column.append(value)  # type: ignore[attr-defined]


def place_row(layout: Layout, row: Row, reach: float, rng: np.random.Generator) -> None:
    """The cues of a row that are detected, up to `reach` [m]."""
    for arc in np.arange(rng.uniform(0.0, row.gap), reach, row.gap):
        if rng.random() < 0.95 - 0.25 * arc / 155.0:
            layout.add(row.kind, row.left, len(layout.kind), float(arc))


def place_vehicle(layout: Layout, kind: str, oncoming: bool, first: float, step: float) -> None:
    """A vehicle first seen at arc length `first` [m], moving `step` [m] between detections."""
    track = len(layout.kind)
    for arc in first + step * np.arange(HISTORY):
        if NEAREST < arc < FARTHEST:
            layout.add(kind, oncoming, track, float(arc))


def place_traffic(layout: Layout, rng: np.random.Generator) -> None:
    """Up to four vehicles, four of ten of them oncoming."""
    for _ in range(rng.integers(0, 5)):
        oncoming = rng.random() < 0.4
        kind = str(rng.choice(["car", "truck"], p=[0.75, 0.25]))
        step = -8.0 if oncoming else rng.uniform(2.0, 4.0)
        place_vehicle(layout, kind, bool(oncoming), rng.uniform(25.0, 145.0), step)


def place_markings(layout: Layout, rng: np.random.Generator) -> None:
    """Points of both borders of the lane, as far as head lamps show them."""
    for left in (False, True):
        row = Row("marking", left, MARKING_GAP)
        place_row(layout, row, 10.0 + MARKING_REACH, rng)


def random_layout(rng: np.random.Generator) -> tuple[str, Layout]:
    """A rural road, a highway or a street in town, with at least five static cues and eight in all."""
    while True:
        place, layout = str(rng.choice(["rural", "highway", "urban"])), Layout([], [], [], [])
        if place == "rural":
            gap = float(rng.choice([25.0, 50.0]))
            rows = [Row("delineator", False, gap)] + [Row("delineator", True, gap)] * (rng.random() < 0.8)
        elif place == "highway":
            rows = [Row("delineator", False, 50.0), Row("delineator", True, 50.0), Row("guardrail", True, 20.0)]
            rows += [Row("guardrail", False, 20.0)] * (rng.random() < 0.5)
        else:
            rows = [Row("lantern", False, float(rng.choice([25.0, 35.0])))]
            rows += [Row("lantern", True, float(rng.choice([25.0, 35.0])))] * (rng.random() < 0.6)
        reach = rng.uniform(110.0, 155.0)
        for row in rows:
            place_row(layout, row, reach, rng)
        static = len(layout.kind)
        place_traffic(layout, rng)
        if static >= 5 and len(layout.kind) >= 8:
            return place, layout
