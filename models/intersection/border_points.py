"""Points on the borders of lanes, markings or curbs, and which border of an arm each is on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.intersection.state import lane_points

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
TOLERANCE = 1.0  # [m] from the border of the structure that a point is on, at most
SIDES: tuple[tuple[Literal[1, -1], str], ...] = ((1, "entries"), (-1, "exits"))


class BorderPoints(NamedTuple):
    """Points of an intersection's borders.

    points  (2, M) about the origin [m]
    arm     (M,), end (M,) 0 on the entry side and 1 on the exit side; sorted by both
    number  (M,) k of the border between lanes k - 1 and k of that side: where a lane k - 1/2 would run
    """

    points: Tensor
    arm: Ints
    end: Ints
    number: Ints


def place_borders(points: Array, structure: Mapping[str, Any], onset: Array) -> BorderPoints:
    """Every point on the nearest border of the structure; points farther than TOLERANCE from all, or nearer to the
    centre than the interior begins on that arm, are left out.

    Borders nearer to each other than 2 TOLERANCE, the inner ones of both sides beside a narrow gap, are left out too:
    points that may be on either would push them apart.

    points  (M, 2); structure {site: (*event)}; onset (K,) where interiors begin [m]"""
    names, apart = [], []
    for arm in range(int(structure["num_arms"])):
        out = np.array([np.cos(structure["angle"][arm]), np.sin(structure["angle"][arm])])
        along = (points - structure["centre"]) @ out
        for end, (side, count) in enumerate(SIDES):
            for number in range(int(structure["gap"][arm] < 2 * TOLERANCE), int(structure[count][arm]) + 1):
                beside = lane_points(structure, arm, number - 0.5, side, along)
                names.append((arm, end, number))
                apart.append(np.where(along > onset[arm], np.hypot(*(points - beside).T), np.inf))
    nearest = np.argmin(apart, 0)
    kept = np.flatnonzero(np.min(apart, 0) < TOLERANCE)
    kept = kept[np.argsort(nearest[kept], kind="stable")]
    arm, end, number = np.array(names)[nearest[kept]].T
    about = torch.from_numpy(np.ascontiguousarray((points[kept] - structure["centre"]).T))
    return BorderPoints(about, arm, end, number)
