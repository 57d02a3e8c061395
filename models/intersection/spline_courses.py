"""The course of every lane as a B-spline, [M20] section IV as printed.

Each lane (an entry and an exit that some track drove) is the graph of a cubic spline, eq. 5,

    y = f(x) = sum_i c_i N_i(x)

in a frame of its own: the x-axis points along the mean direction of its tracks, from the world's origin. It starts as
two straight stubs on the arms of the structure, joined by a straight line. Points draw it by e1 = p_y - f(p_x); then
lanes next to one another on an arm are drawn together by e2 = d (|d| - width), which lets them coincide or lie a lane
width apart. Both are printed squared (eq. 6 and 8); we take them for residuals, whose squares are the cost.

The paper does not say, and we choose: no weight between e1 in metres and e2 in square metres; delta = 4 m; neighbours
are lanes on the same or on adjacent stubs of an arm, in the same direction; e2 is taken every metre of x along
their stubs, where the structure says that they are parallel; the knots span the points of the lane.

A lane that turns by more than about 130 degrees folds back in its frame: no function describes it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.capability import Squares
from models.intersection.course_evidence import CourseEvidence, course_evidence
from models.intersection.course_lines import lane_nodes
from models.intersection.routes import RoutedTracks
from models.intersection.spline_kernel import add_neighbours, add_points
from models.spline import ORDER, basis, evaluate

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
LINE_STEP = 0.5  # between the points of centre lines, along x [m]


class SplineEvidence(NamedTuple):
    """Points of all lanes, lane by lane, in the frames of their lanes.

    y            (N,) across each lane [m]
    controls_at  (N, 4) which of the L n controls count at the x of each point, with weights (N, 4)
    frames       (L, 4) cosine and sine of the x-axis, first knot and spacing of the knots [m]
    first        (L, n) controls of the stubs joined by straight lines [m]
    pairs        (P, 2) lane and neighbour of every x `at` (P,) along the lane where they ought to be parallel [m]
    """

    y: Tensor
    controls_at: Ints
    weights: Array
    frames: Array
    first: Array
    pairs: Ints
    at: Array


@dataclass(frozen=True)
class SplineCourses:
    """Splines of [M20] with wide normal priors about their first courses, which make them a proper density.

    coupled  whether neighbours draw each other (e2)
    """

    coupled: bool = True
    num_controls: int = 20  # [M20] section IV-D
    width: float = 2.7  # of a lane, [M20] section III-B [m]
    delta: float = 4.0  # neighbours farther apart are left alone [m]
    position_std: float = 1.0  # of a point across its lane [m]
    gap_std: float = 1.0  # of e2 [m^2]
    spacing: float = 1.0  # of the points where neighbours are compared [m]
    control_std: float = 100.0  # [m]

    def __call__(self, evidence: SplineEvidence) -> None:
        first = torch.from_numpy(evidence.first)
        controls = pyro.sample("controls", dist.Normal(first, self.control_std).to_event(2))  # (*B, L, n)
        counting = controls.flatten(-2)[..., torch.from_numpy(evidence.controls_at)]  # (*B, N, 4)
        mean = (counting * torch.from_numpy(evidence.weights)).sum(-1)
        pyro.sample("y", dist.Normal(mean, self.position_std).to_event(1), obs=evidence.y)
        if self.coupled:
            pyro.factor("neighbours", -neighbour_costs(self, evidence, controls))

    def prepare(self, routed: RoutedTracks) -> SplineEvidence:
        """Evidence of this model. Raises InputError where no track is on a route."""
        return spline_evidence(routed, self)

    def squares(self, evidence: SplineEvidence) -> Squares:
        """The same density as a compiled sum of squares."""
        size, shape = evidence.first.size, evidence.first.shape
        log_const = -len(evidence.y) * (math.log(self.position_std) + 0.5 * math.log(2 * math.pi))
        return Squares(
            evidence.first.reshape(-1),
            np.full(size, self.control_std),
            {"controls": slice(0, size)},
            {"controls": shape},
            partial(_evaluate, self, evidence, evidence.y.numpy()),
            log_const,
        )


def stages(model: SplineCourses) -> tuple[SplineCourses, SplineCourses]:
    """The two problems that [M20] section IV-D solves one after the other: 10 iterations with the points alone, then
    with neighbours too, from where the first ended. Both have the same latents."""
    return replace(model, coupled=False), replace(model, coupled=True)


def _evaluate(
    model: SplineCourses, evidence: SplineEvidence, y: Array, z: Array, hessian: Array, gradient: Array
) -> float:
    hessian[:], gradient[:] = 0.0, 0.0
    controls = z.reshape(evidence.first.shape)
    points = (evidence.controls_at, evidence.weights, y, model.position_std)
    cost = float(add_points(controls, *points, hessian, gradient))
    if model.coupled:
        cost += _add_neighbours(model, evidence, controls, hessian, gradient)
    return cost


def _add_neighbours(
    model: SplineCourses, evidence: SplineEvidence, controls: Array, hessian: Array, gradient: Array
) -> float:
    places = (evidence.frames, evidence.pairs, evidence.at)
    return float(add_neighbours(controls, *places, model.width, model.delta, model.gap_std, hessian, gradient))


def neighbour_costs(model: SplineCourses, evidence: SplineEvidence, controls: Tensor) -> Tensor:
    """Half the sum of squared e2, (*B,), for controls (*B, L, n); without derivatives."""
    batch, shape = controls.shape[:-2], evidence.first.shape
    size = evidence.first.size
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    rows = controls.detach().reshape(-1, *shape).numpy()
    costs = [_add_neighbours(model, evidence, np.ascontiguousarray(row), hessian, gradient) for row in rows]
    return torch.tensor(costs, dtype=torch.float64).reshape(batch)


def first_lines(courses: CourseEvidence) -> list[Array]:
    """Every lane as its two straight stubs and the straight line that joins them, L arrays (4, 2) [m].

    [M20] section IV-B. A stub runs from as far out as the lane was driven to where the borders of arms meet."""
    corners = []
    for nodes, counts in zip(lane_nodes(courses, {}), courses.counts, strict=True):
        inner = np.cumsum(counts[:2])
        corners.append(nodes[[0, *inner, -1], :2] + courses.origin)
    return corners


def tracks_by_lane(courses: CourseEvidence) -> list[list[Array]]:
    """The tracks of every lane, each (n, 2) [m]."""
    points = courses.points[:2].numpy().T + courses.origin
    of_track = np.split(points, courses.offsets[1:-1])
    return [[of_track[t] for t in tracks] for tracks in np.split(courses.tracks, courses.starts[1:-1])]


def spline_evidence(routed: RoutedTracks, model: SplineCourses) -> SplineEvidence:
    """Points in the frames of their lanes, and which lanes are neighbours where.

    Raises InputError where no track is on a route."""
    courses = course_evidence(routed, 1.0)  # nodes a metre apart
    lines, num = first_lines(courses), model.num_controls
    frames, first, y, controls_at, weights = np.empty((len(lines), 4)), np.empty((len(lines), num)), [], [], []
    for lane, tracks in enumerate(tracks_by_lane(courses)):
        frames[lane, :2] = mean_direction(tracks)
        x, across = in_frame(frames[lane], np.concatenate(tracks))
        start, spacing = float(x.min()), float(x.max() - x.min()) / (num - ORDER + 1)
        frames[lane, 2:] = start, spacing
        middles = start + spacing * np.arange(-1, num - 1)  # controls lie above these x
        along, aside = in_frame(frames[lane], longer(lines[lane]))
        first[lane] = np.interp(middles, np.maximum.accumulate(along), aside)
        pieces, lane_weights, _ = basis(x, start, spacing, num)
        controls_at.append(lane * num + pieces[:, None] + np.arange(ORDER))
        weights.append(lane_weights)
        y.append(across)
    points = (torch.from_numpy(np.concatenate(y)), np.concatenate(controls_at), np.concatenate(weights))
    return SplineEvidence(*points, frames, first, *neighbours(courses.connections, frames, num, lines, model.spacing))


def longer(line: Array) -> Array:
    """A polyline (n, 2) with its first and last segments twice as long: (n + 2, 2)."""
    return np.concatenate([[2 * line[0] - line[1]], line, [2 * line[-1] - line[-2]]])


def mean_direction(tracks: list[Array]) -> Array:
    """Unit vector along the mean step of tracks (n, 2)."""
    total = np.sum([points[-1] - points[0] for points in tracks], axis=0)
    return np.asarray(total / np.linalg.norm(total))


def in_frame(frame: Array, points: Array) -> tuple[Array, Array]:
    """x and y (N,) of points (N, 2) in a frame (cosine, sine, ...)."""
    cos, sin = frame[:2]
    return points @ np.array([cos, sin]), points @ np.array([-sin, cos])


def neighbours(connections: Ints, frames: Array, num: int, lines: list[Array], spacing: float) -> tuple[Ints, Array]:
    """Pairs (P, 2) of lanes on the same or on adjacent stubs of an arm, and x (P,) along the stub of the first."""
    pairs, at = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
    ends = connections.reshape(-1, 2, 2)  # lane, entry or exit, (arm, lane of the arm)
    for lane, (frame, line) in enumerate(zip(frames, lines, strict=True)):
        x, last = in_frame(frame, line)[0], frame[2] + frame[3] * (num - ORDER + 1)
        stubs = (np.arange(frame[2], x[1], spacing), np.arange(last, x[2], -spacing))
        for end, stub in enumerate(stubs):
            apart = ends[:, end] - ends[lane, end]
            beside = (apart[:, 0] == 0) & (np.abs(apart[:, 1]) <= 1) & (np.arange(len(lines)) != lane)
            for other in np.flatnonzero(beside):
                pairs.append(np.tile([lane, other], (len(stub), 1)))
                at.append(stub)
    return np.concatenate(pairs), np.concatenate(at)


def centre_lines(evidence: SplineEvidence, latents: Mapping[str, Any]) -> list[Array]:
    """Centre lines of all lanes in driving order, L arrays (n, 2) [m], for one state {site: (*event)}.

    Where `latents` has no controls, the lines that the refinement starts from."""
    lines = []
    for frame, controls in zip(evidence.frames, np.asarray(latents.get("controls", evidence.first)), strict=True):
        cos, sin, start, spacing = frame
        length = spacing * (len(controls) - ORDER + 1)
        x = start + np.linspace(0.0, length, math.ceil(length / LINE_STEP) + 1)
        y = evaluate(controls, start, spacing, x)
        lines.append(np.stack([cos * x - sin * y, sin * x + cos * y], 1))
    return lines
