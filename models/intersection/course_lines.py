"""From the numbers of lane courses to centre lines and bands."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.intersection.course_evidence import CourseEvidence
from models.intersection.course_kernel import centre_line
from models.intersection.course_nodes import ARM_WAVE, INNER_WAVE, LOCAL, RIPPLED, WAVY

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
ARM_SITES = ("angle", "gap", "width", "bend", "shift", "onset")
PLAIN = ("centre", "lane_width", *ARM_SITES, "offset", "advance", "handle")
SITES = (*PLAIN, "inner_wave", "arm_wave", "lane_wave")
WIDTHS = {len(PLAIN): LOCAL, len(PLAIN) + 1: RIPPLED, len(SITES): WAVY}  # numbers of a lane, by how many sites


def needed(latent: Iterable[str]) -> tuple[str, ...]:
    """The sites that lanes are computed from where these are latent: the first ones, in blocks."""
    last = max((SITES.index(name) for name in latent), default=0)
    return SITES[: next(num for num in WIDTHS if num > last)]


class Column(NamedTuple):
    """Where one number of a lane is found: entry `place` of the row of a site that belongs to the lane's `owner`."""

    site: int
    owner: int
    width: int
    place: int


SELF, ARM, STUB, LANE = 0, 1, 3, 5  # owners: the junction, entry and exit arm, entry and exit stub, the lane itself


@lru_cache
def columns(sites: tuple[str, ...]) -> NDArray[np.int64]:
    """The numbers of a lane in the order of `course_nodes`, rows of `Column`, (D', 4)."""
    of = {name: sites.index(name) for name in sites}
    out = [Column(of["centre"], SELF, 2, 0), Column(of["centre"], SELF, 2, 1), Column(of["lane_width"], SELF, 1, 0)]
    for end in range(2):
        out += [Column(of[name], ARM + end, 1, 0) for name in ARM_SITES]
        out += [Column(of["offset"], STUB + end, 1, 0)]
        out += [Column(of[name], LANE, 2, end) for name in ("advance", "handle")]
    if "inner_wave" in sites:
        out += [Column(of["inner_wave"], LANE, INNER_WAVE, i) for i in range(INNER_WAVE)]
    if "arm_wave" in sites:
        for end in range(2):
            out += [Column(of["arm_wave"], ARM + end, ARM_WAVE, i) for i in range(ARM_WAVE)]
            out += [Column(of["lane_wave"], STUB + end, ARM_WAVE, i) for i in range(ARM_WAVE)]
    return np.array(out)


class Layout:
    """Sites in one vector of numbers, constants included, and the part of it that each lane depends on.

    where  (L, D') of the numbers of `course_nodes`
    sides  (2 K, D') the same for what all lanes of one side of an arm share, entries and exits arm by arm; -1 for the
           rest"""

    def __init__(self, evidence: CourseEvidence, sites: tuple[str, ...]) -> None:
        ends = np.cumsum([0, *(evidence.loc[name].size for name in sites)])
        self.size = int(ends[-1])
        self.sites = {name: slice(int(ends[i]), int(ends[i + 1])) for i, name in enumerate(sites)}
        num, arms = len(evidence.connections), len(evidence.loc["angle"])
        owners = np.column_stack(
            [np.zeros(num, np.int64), evidence.connections[:, ::2], evidence.stubs, np.arange(num)]
        )
        site, owner, width, place = columns(sites).T
        self.where = np.ascontiguousarray(ends[site] + width * owners[:, owner] + place)
        arm, end = np.divmod(np.arange(2 * arms)[:, None], 2)
        self.sides = np.where(
            (owner == SELF) | (owner == ARM + end), ends[site] + width * np.where(owner == SELF, 0, arm) + place, -1
        )

    def pack(self, latents: Mapping[str, Any]) -> Array:
        """{site: (*event)} to (D,)."""
        return np.concatenate([np.asarray(latents[name], dtype=np.float64).reshape(-1) for name in self.sites])


def centre_lines(evidence: CourseEvidence, latents: Mapping[str, Any]) -> list[Array]:
    """Centre lines of all lanes in driving order, L arrays (n, 2), for one state {site: (*event)}."""
    return [nodes[:, :2] + evidence.origin for nodes in lane_nodes(evidence, latents)]


def layout_of(evidence: CourseEvidence, latents: Mapping[str, Any]) -> Layout:
    """The layout of a state, with the waves it has."""
    return Layout(evidence, needed(name for name in SITES if name in latents))


def lane_nodes(evidence: CourseEvidence, latents: Mapping[str, Any]) -> list[Array]:
    """Nodes of all lanes, see `course_nodes`."""
    layout = layout_of(evidence, latents)
    z = layout.pack(evidence.loc | dict(latents))
    lanes, out = np.ascontiguousarray(evidence.connections[:, 1::2]), []
    for lane, counts in enumerate(evidence.counts):
        nodes = np.empty((counts.sum() + 1, 5 + layout.where.shape[1]))
        centre_line(z[layout.where[lane]], lanes[lane], evidence.reach[lane], counts, nodes)
        out.append(nodes)
    return out


def lane_displacements(
    evidence: CourseEvidence, estimate: Mapping[str, Any], draws: Mapping[str, Array]
) -> list[Array]:
    """How far to the left of the estimate's centre lines the draws' lines lie, L arrays (n, D) [m].

    draws  {site: (D, *event)}; displacements are linear in what separates a draw from the estimate"""
    layout = layout_of(evidence, estimate)
    here = layout.pack(evidence.loc | dict(estimate))
    num = len(next(iter(draws.values())))
    there = [draws.get(n, np.broadcast_to(evidence.loc[n], (num, *evidence.loc[n].shape))) for n in layout.sites]
    apart = np.concatenate([values.reshape(num, -1) for values in there], 1) - here
    pairs = zip(lane_nodes(evidence, estimate), layout.where, strict=True)
    return [nodes[:, 5:] @ apart[:, index].T for nodes, index in pairs]


def lane_bands(
    evidence: CourseEvidence, estimate: Mapping[str, Any], draws: Mapping[str, Array], level: float
) -> tuple[list[Array], list[Array]]:
    """How far left and right of the estimate's centre lines the draws' lines lie, L arrays (n,) each [m].

    draws  {site: (D, *event)}, equally weighted, see `lane_displacements`"""
    return edges(lane_displacements(evidence, estimate, draws), level)


def edges(displacements: Iterable[Array], level: float) -> tuple[list[Array], list[Array]]:
    """The band of each lane from displacements to the left, L arrays (n, D): how far it reaches to the left and to the
    right of the line, L arrays (n,) each [m].

    Between the two edges lies the share `level` of the D draws at each point, half of the rest on either side."""
    left, right = [], []
    for across in displacements:
        low, high = np.quantile(across, [0.5 - level / 2, 0.5 + level / 2], axis=1)
        left.append(high)
        right.append(-low)
    return left, right
