"""The numbers of free courses: which site holds what of which lane, in what order, and where their priors are."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.intersection.free_shape import Shape
from models.intersection.free_splines import ENDS, Numbered, bridge, lane_controls, stub_controls
from models.intersection.reference import arc_length, turns
from models.intersection.stubs import Stubs

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
SITES = ("offset", "arm_bow", "stub_bow", "arm_jerk", "stub_jerk", "inner")


class Numbers(NamedTuple):
    """loc     {site: middles of the priors}
    scale   {site: factors on the standard deviations}
    lanes   every lane's controls in all numbers, site after site"""

    loc: dict[str, Array]
    scale: dict[str, Array]
    lanes: list[Numbered]


class Sites:
    """Places in one vector of numbers: of every site one part for each arm, stub or lane."""

    def __init__(self, sizes: dict[str, list[int]]) -> None:
        self.parts: dict[str, list[slice]] = {}
        self.first: dict[str, int] = {}
        self.loc: dict[str, Array] = {}
        total = 0
        for site, each in sizes.items():
            self.parts[site] = [slice(int(a), int(b)) for a, b in pairwise(np.cumsum([0, *each]))]
            self.first[site] = total
            self.loc[site] = np.zeros(max(sum(each), 1))  # where nothing is shared, a number that moves nothing
            total += len(self.loc[site])

    def where(self, site: str, part: int) -> Ints:
        """Among all numbers those of a part."""
        here = self.parts[site][part]
        return np.arange(here.start, here.stop) + self.first[site]


def numbers(shapes: list[Shape], stubs: Stubs, knots: float, anchor: float, rough: Array) -> Numbers:
    """All numbers of lanes with these shapes and stubs.

    anchor  as in `bridge`; rough (L,) factors on the standard deviations of lanes between stubs"""
    of_stub = [stub.pieces for stub in stubs.stubs]
    of_arm = [max(s.pieces for s in stubs.stubs if s.arm == arm) for arm in range(len(stubs.axes))]
    free = [int(each.pieces.sum()) + ENDS - sum(k + ENDS for k in each.pieces[::2] if k > 0) for each in shapes]
    bows = [2] * len(of_arm), [2] * len(of_stub)
    sites = Sites(dict(zip(SITES, ([1] * len(of_stub), *bows, of_arm, of_stub, free), strict=True)))
    for arm, axis in enumerate(stubs.axes):
        thirds = turns(axis, arc_length(axis), of_arm[arm], knots)
        sites.loc["arm_jerk"][sites.parts["arm_jerk"][arm]] = thirds
    controls = []
    for number, stub in enumerate(stubs.stubs):
        parts = zip(SITES[:5], (number, stub.arm, number, stub.arm, number), strict=True)
        where = [sites.where(site, part) for site, part in parts]
        controls.append(Numbered(stub_controls(stub.pieces, of_arm[stub.arm]), np.concatenate(where)))
    lanes = []
    for lane, each in enumerate(shapes):
        given = [controls[side.stub].first(side.pieces + ENDS) for side in stubs.sides[lane] if side.pieces]
        begin = each.pieces[0] + ENDS if each.pieces[0] else 0
        thirds = turns(each.nodes, each.t, int(each.pieces.sum()), knots)
        link = bridge(thirds, slice(begin, begin + free[lane]), anchor)
        sites.loc["inner"][sites.parts["inner"][lane]] = link.middle
        lanes.append(lane_controls(link, begin, given, each.pieces[2] > 0, sites.where("inner", lane)))
    scale = {site: np.ones_like(value) for site, value in sites.loc.items()} | {"inner": np.repeat(rough, free)}
    return Numbers(sites.loc, scale, lanes)
