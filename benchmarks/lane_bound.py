"""How small the lane error can be: a bound of Cramer-Rao type for the protocol, its structure and family being known.

    F = diag(prior sd)^-2 + tracks * sum over lanes of the integral along them of
        J J' / position^2 + J_s J_s' / (heading^2 + curvature^2 position^2)
    bound = mean over lanes of the mean along them of sqrt(2 / pi) sqrt(J' F^-1 J)

J is the displacement of a centre line to the left per unit of every unknown number, J_s its derivative along the line,
the change of heading; tracks have a point every metre. sqrt(2 / pi) sd is the mean of a normal's absolute value. Where
along its lane a vehicle was is not known: across a bend that spreads its heading by curvature position.

Unknown are the centre of the junction, the direction and the gap of every arm, the distance where the interior begins
on it, and the two Bezier handles of every lane; lane widths and straight arms are known. Handles have the prior of the
generator, U(0.85, 1.15), as a normal one. The generator computes the beginning of interiors from the rest, but that is
ours, and an estimator is told it within 5 m only.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from experiments.lane_metrics import DROPPED
from experiments.scenarios import paths
from experiments.scenarios.interiors import STRETCH
from experiments.scenarios.scene import JunctionTruth, join_tracks
from models.intersection.course_evidence import CourseEvidence
from models.intersection.course_lines import lane_nodes, layout_of
from models.intersection.courses import LaneCourses
from models.intersection.routes import RoutedTracks, Routes

Floats = NDArray[np.float64]

POSITION_STD = 1.0  # of the protocol [m]
PRIOR_STD = {
    "centre": math.inf,
    "angle": math.inf,
    "gap": math.inf,
    "onset": 5.0,  # [m]
    "handle": (STRETCH[1] - STRETCH[0]) / math.sqrt(12.0),
}


def lane_bound(truth: JunctionTruth, heading_std: float | None = None, tracks_per_lane: float = 4.0) -> float:
    """The least mean lane error of a junction of the protocol [m].

    heading_std      of measured headings [rad]; None measures none
    tracks_per_lane  vehicles on each lane, 4 in the mean of the protocol

    The lines of the truth say only how far lanes were driven: interiors are Bezier curves, their handles in the middle
    of the prior."""
    evidence = true_courses(truth)
    information = np.diag(np.concatenate([np.full(evidence.loc[n].size, std**-2.0) for n, std in PRIOR_STD.items()]))
    lanes = []
    for nodes, slopes in zip(lane_nodes(evidence, {}), displacements(evidence), strict=True):
        s = paths.arc_length(nodes[:, :2])
        points = tracks_per_lane * lengths(s)[:, None]
        information += slopes.T @ (points / POSITION_STD**2 * slopes)
        if heading_std is not None:
            turn = np.gradient(slopes, s, axis=0)
            information += turn.T @ (points / (heading_std**2 + (nodes[:, 4:5] * POSITION_STD) ** 2) * turn)
        lanes.append((s, slopes))
    covariance = np.linalg.inv(information)
    errors = []
    for s, slopes in lanes:
        std = np.sqrt(np.einsum("np,pq,nq->n", slopes, covariance, slopes))
        weights = np.where((s >= DROPPED) & (s <= s[-1] - DROPPED), lengths(s), 0.0)
        errors.append(math.sqrt(2 / math.pi) * np.average(std, weights=weights))
    return float(np.mean(errors))


def true_courses(truth: JunctionTruth) -> CourseEvidence:
    """The true lines as tracks on their own routes: the middles of the priors are the truth."""
    structure = {name: getattr(truth, name) for name in ("centre", "angle", "gap", "entries", "exits", "width")}
    structure["num_arms"] = np.array(len(truth.angle))
    routes = Routes(truth.connections, np.arange(len(truth.lines)))
    return LaneCourses().prepare(RoutedTracks(join_tracks(truth.lines, None), structure, routes))


def displacements(evidence: CourseEvidence) -> list[Floats]:
    """How far the nodes of every lane move to the left per unit of every unknown, L arrays (n, P) ordered as
    PRIOR_STD."""
    layout = layout_of(evidence, {})
    unknown = np.concatenate([np.arange(layout.size)[layout.sites[name]] for name in PRIOR_STD])
    out = []
    for nodes, where in zip(lane_nodes(evidence, {}), layout.where, strict=True):
        slopes = np.zeros((len(nodes), layout.size))
        slopes[:, where] = nodes[:, 5:]
        out.append(slopes[:, unknown])
    return out


def lengths(s: Floats) -> Floats:
    """Piece of the line that each node at arc length s (n,) stands for, (n,) [m]."""
    steps = np.diff(s, prepend=s[0], append=s[-1])
    return (steps[1:] + steps[:-1]) / 2
