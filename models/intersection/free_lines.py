"""From the numbers of free courses to centre lines and bands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.intersection.course_lines import edges
from models.intersection.free_evidence import FreeEvidence
from models.intersection.free_kernel import free_nodes

Array = NDArray[np.float64]


def lane_nodes(evidence: FreeEvidence, latents: Mapping[str, Any]) -> list[Array]:
    """Nodes of all lanes, see `free_kernel.displace`; where `latents` is empty, of the reference curves."""
    z, out = pack(evidence, latents), []
    for reference, design, where in zip(evidence.reference, evidence.design, evidence.where, strict=True):
        nodes = np.empty((len(reference), 5 + design.shape[1]))
        free_nodes(z[where], reference, design, nodes)
        out.append(nodes)
    return out


def pack(evidence: FreeEvidence, latents: Mapping[str, Any]) -> Array:
    """{site: (*batch, *event)} to (*batch, D); sites that are absent are 0."""
    parts = []
    for name, loc in evidence.loc.items():
        value = np.asarray(latents.get(name, np.zeros_like(loc)), dtype=np.float64)
        parts.append(value.reshape((*value.shape[: value.ndim - loc.ndim], -1)))
    return np.concatenate(parts, -1)


def centre_lines(evidence: FreeEvidence, latents: Mapping[str, Any]) -> list[Array]:
    """Centre lines of all lanes in driving order, L arrays (n, 2) [m], for one state {site: (*event)}."""
    return [nodes[:, :2] + evidence.origin for nodes in lane_nodes(evidence, latents)]


def lane_displacements(evidence: FreeEvidence, estimate: Mapping[str, Any], draws: Mapping[str, Array]) -> list[Array]:
    """How far to the left of the estimate's centre lines the draws' lines lie, L arrays (n, D) [m].

    draws  {site: (D, *event)}; displacements are linear in what separates a draw from the estimate"""
    apart = pack(evidence, draws) - pack(evidence, estimate)
    pairs = zip(lane_nodes(evidence, estimate), evidence.where, strict=True)
    return [nodes[:, 5:] @ apart[:, where].T for nodes, where in pairs]


def lane_bands(
    evidence: FreeEvidence, estimate: Mapping[str, Any], draws: Mapping[str, Array], level: float
) -> tuple[list[Array], list[Array]]:
    """How far left and right of the estimate's centre lines the draws' lines lie, L arrays (n,) each [m].

    draws  {site: (D, *event)}, equally weighted, see `lane_displacements`"""
    return edges(lane_displacements(evidence, estimate, draws), level)
