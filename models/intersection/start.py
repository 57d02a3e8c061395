"""A first state from the data: arms where half tracks point, lanes where they lie.

Directions of the halves are gathered greedily, the largest group within GROUP first; then gap and lane
counts of every arm follow from the lateral positions of its halves."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numba as nb
import numpy as np
import torch

from models.intersection.angles import MIN_SEPARATION
from models.intersection.evidence import JunctionEvidence
from models.intersection.moments import CXS, CYS, MX, MY
from models.intersection.moves import insertion_sort
from models.intersection.packing import ANGLE, ARM, ENTRIES, EXITS, GAP, HEAD, MAX_ARMS, MIN_ARMS, SIZE, WIDTH, unpack
from models.intersection.wrap import wrap
from models.program import InputError

if TYPE_CHECKING:
    from models.intersection.state import Junction

GROUP = math.radians(10.0)  # halves of one arm
TAKEN = math.radians(14.0)  # halves near an arm that belong to it
SMALLEST = 2  # halves of an arm


@nb.njit(cache=True)
def group_directions(directions, angles):  # type: ignore[no-untyped-def]
    """Arm directions from half track directions, largest group first; returns how many."""
    left = np.ones(len(directions), np.bool_)
    num = 0
    while num < MAX_ARMS and left.any():
        most, seed = 0, 0
        for i in range(len(directions)):
            if not left[i]:
                continue
            near = 0
            for j in range(len(directions)):
                near += 1 if left[j] and abs(wrap(directions[j] - directions[i])) < GROUP else 0
            if near > most:
                most, seed = near, i
        turn = 0.0
        for j in range(len(directions)):
            gap = wrap(directions[j] - directions[seed])
            if left[j] and abs(gap) < GROUP:
                turn += gap
        angle = wrap(directions[seed] + turn / most)
        for j in range(len(directions)):
            left[j] = left[j] and abs(wrap(directions[j] - angle)) >= TAKEN and j != seed
        apart = True
        for a in range(num):
            apart = apart and abs(wrap(angle - angles[a])) >= MIN_SEPARATION
        if apart and most >= SMALLEST:
            angles[num] = angle
            num += 1
    return num


@nb.njit
def lane_range(offsets, width, most):  # type: ignore[no-untyped-def]
    """Inner edge and number of lanes that hold sorted lateral offsets."""
    low, high = offsets[len(offsets) // 10], offsets[-1 - len(offsets) // 10]
    count = min(max(int((high - low) / width + 0.5) + 1, 1), most)
    return 0.5 * (low + high) - 0.5 * count * width, float(count)


@nb.njit(cache=True)
def fill_arms(z, num, mean, directions, entries, width, max_lanes, gap_max, one_way):  # type: ignore[no-untyped-def]
    """Gap, entries and exits of the arms from the means (2, H) of their halves."""
    for a in range(num):
        o = HEAD + a * ARM
        angle, edges = z[o + ANGLE], np.zeros(2)
        for side in range(2):
            offsets = np.empty(mean.shape[1])
            count = 0
            for h in range(mean.shape[1]):
                if (h < entries) != (side == 0) or abs(wrap(directions[h] - angle)) >= TAKEN:
                    continue
                across = -math.sin(angle) * mean[0, h] + math.cos(angle) * mean[1, h]
                offsets[count] = across if side == 0 else -across
                count += 1
            if count == 0:
                z[o + ENTRIES + side] = 0.0 if one_way else 1.0
                edges[side] = np.nan
                continue
            insertion_sort(offsets[:count])
            edges[side], z[o + ENTRIES + side] = lane_range(offsets[:count], width, max_lanes)
        if z[o + ENTRIES] + z[o + EXITS] < 0.5:
            z[o + ENTRIES] = 1.0
        known = edges[~np.isnan(edges)]  # inner edges of the sides that were driven
        both = 2.0 * known.mean() if len(known) > 0 else 0.0
        z[o + GAP] = min(max(both, 0.05 * gap_max), 0.95 * gap_max)


def start_from_halves(model: Junction, evidence: JunctionEvidence) -> dict[str, Any]:
    """{site: (*event)}; raises InputError where the halves point in fewer than two directions."""
    observed = evidence.moments
    directions = np.arctan2(observed[CYS], observed[CXS])  # slope of the points over s
    angles = np.zeros(MAX_ARMS)
    num = group_directions(directions, angles)
    if num < MIN_ARMS:
        raise InputError(
            f"the tracks leave in {num} direction(s) only, but a junction has at least {MIN_ARMS} arms; "
            "give tracks from more arms or use start=prior"
        )
    z = np.zeros(SIZE)
    z[0] = num
    slots = z[HEAD:].reshape(MAX_ARMS, ARM)
    slots[:, ANGLE], slots[:, GAP], slots[:, ENTRIES], slots[:, EXITS] = angles, 0.5 * model.gap_max, 1.0, 1.0
    slots[:, WIDTH] = model.width
    fill_arms(
        z,
        num,
        observed[[MX, MY]],
        directions,
        evidence.num_entries,
        model.width,
        model.max_lanes,
        model.gap_max,
        model.one_way,
    )
    return {name: torch.as_tensor(value) for name, value in unpack(z, model.constants, evidence.origin).items()}


def m20_start(model: Junction, evidence: JunctionEvidence) -> dict[str, Any]:
    """{site: (*event)}: three arms 120 degrees apart, gap 1 m, one lane each way, at the mean of the points.

    With likelihood=exact that is the mean of the points on arms: it knows no others."""
    assert evidence.points is not None
    points = evidence.points[:2].numpy().T if evidence.whole is None else evidence.whole.rows[:2].T
    z = np.zeros(SIZE)
    z[0], z[1:HEAD] = 3, points.mean(0)
    slots = z[HEAD:].reshape(MAX_ARMS, ARM)
    slots[:, ANGLE] = np.array([0.0, 1.0, -1.0, 0.0, 0.0, 0.0, 0.0]) * 2.0 * math.pi / 3.0
    slots[:, GAP], slots[:, ENTRIES], slots[:, EXITS], slots[:, WIDTH] = 1.0, 1.0, 1.0, model.width
    return {name: torch.as_tensor(value) for name, value in unpack(z, model.constants, evidence.origin).items()}
