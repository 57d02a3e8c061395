"""From the numbers of lane courses to centre lines and bands."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.intersection.course_evidence import CourseEvidence
from models.intersection.course_kernel import centre_line
from models.intersection.course_nodes import ARM_WAVE, END, HEAD, INNER_WAVE, LOCAL, RIPPLED, WAVY

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


class Layout:
    """Sites in one vector of numbers, constants included, and the part of it that each lane depends on."""

    def __init__(self, evidence: CourseEvidence, sites: tuple[str, ...]) -> None:
        sizes = [evidence.loc[name].size for name in sites]
        ends = np.cumsum([0, *sizes])
        self.size = int(ends[-1])
        self.sites = {name: slice(ends[i], ends[i + 1]) for i, name in enumerate(sites)}
        num = len(evidence.connections)
        self.where = np.zeros((num, WIDTHS[len(sites)]), np.int64)
        self.where[:, 1], self.where[:, 2] = 1, self.sites["lane_width"].start
        for end in range(2):
            first, arm = HEAD + END * end, evidence.connections[:, 2 * end]
            for field, name in enumerate(ARM_SITES):
                self.where[:, first + field] = self.sites[name].start + arm
            own = [self.sites["offset"].start + evidence.stubs[:, end]]
            own += [self.sites[name].start + 2 * np.arange(num) + end for name in ("advance", "handle")]
            self.where[:, first + len(ARM_SITES) : first + END] = np.stack(own, 1)
            if "arm_wave" in sites:
                first = RIPPLED + 2 * ARM_WAVE * end
                self.where[:, first : first + ARM_WAVE] = self._rows("arm_wave", arm, ARM_WAVE)
                first += ARM_WAVE
                self.where[:, first : first + ARM_WAVE] = self._rows("lane_wave", evidence.stubs[:, end], ARM_WAVE)
        if "inner_wave" in sites:
            self.where[:, LOCAL:RIPPLED] = self._rows("inner_wave", np.arange(num), INNER_WAVE)

    def _rows(self, name: str, rows: Ints, width: int) -> Ints:
        return np.asarray(self.sites[name].start + width * rows[:, None] + np.arange(width))

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
