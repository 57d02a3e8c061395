"""Lanes as independent splines, the baseline of held-out scores: the spline of [M20], one for each lane by itself.

    f(s) = sum_i c_i N_i(s),   c = argmin sum_n (d_n - f(s_n))^2 / std^2 + |c|^2 / 100^2

N are cubic B-splines with 20 uniform controls as in [M20] section IV-D, but about the lane's reference curve in place
of a straight axis, so that no turn folds. s_n and d_n are how far along the curve and beside it point n lies. The wide
prior only keeps controls that no point reaches. There is no e2, which needs a lane width.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from experiments.lanes import Lanes
from models.intersection.free_evidence import FreeEvidence
from models.intersection.routes import Routes
from models.spline import ORDER, basis

Array = NDArray[np.float64]
CONTROLS = 20
CONTROL_STD = 100.0  # [m]


def spline_lanes(evidence: FreeEvidence, routes: Routes, std: float, edge: float) -> Lanes:
    """The lanes of the evidence, each by itself.

    std   of a point across its lane [m]
    edge  standard deviations from the middle to the edge of a band"""
    lines, half = [], []
    of_track = np.split(evidence.points[:2].numpy().T, evidence.offsets[1:-1])
    for number, reference in enumerate(evidence.reference):
        own = evidence.tracks[evidence.starts[number] : evidence.starts[number + 1]]
        place, normal = reference[:, :2], np.stack([-reference[:, 3], reference[:, 2]], -1)
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
        points = np.concatenate([of_track[t] for t in own])
        nearest = cKDTree(place).query(points)[1]
        gap = points - place[nearest]
        along = arc[nearest] + (gap * reference[nearest, 2:]).sum(-1)
        here = dense_basis(np.clip(along, 0.0, arc[-1]), arc[-1])
        precision = here.T @ here / std**2 + np.eye(CONTROLS) / CONTROL_STD**2
        controls = np.linalg.solve(precision, here.T @ (gap * normal[nearest]).sum(-1) / std**2)
        there = dense_basis(arc, arc[-1])
        lines.append(place + normal * (there @ controls)[:, None] + evidence.origin)
        half.append(edge * np.sqrt(np.einsum("ni,ni->n", there, np.linalg.solve(precision, there.T).T)))
    return Lanes(lines, half, half, routes)


def dense_basis(s: Array, length: float) -> Array:
    """N_i at s (n,) in [0, length], (n, CONTROLS)."""
    pieces, weights, _ = basis(s, 0.0, length / (CONTROLS - ORDER + 1), CONTROLS)
    out = np.zeros((len(s), CONTROLS))
    np.put_along_axis(out, pieces[:, None] + np.arange(ORDER), weights, 1)
    return out
