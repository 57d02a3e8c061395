"""The course of every lane as a polyline for Markov chain Monte Carlo, after [M19].

Meyer et al. (2019), "Anytime lane-level intersection estimation", refine lanes by sampling, as [M20] recounts: with a
smoothness term, slowly, and to 14 cm. What we specify: every lane keeps `num_offsets` stations at equal distances
along its first course, two stubs joined by a straight line as in [M20] section IV-B. Its vertices lie beside the
stations; the latents are

    offsets  (L, n) of the vertices to the left of their stations [m]

with a normal prior on them and on their second differences. A point belongs to the segment that its foot on the first
course lies on; its distance from that segment's line is normal. Steps move one offset at a time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.capability import Kernel, Move, Proposal, compiled
from models.intersection import offset_kernel
from models.intersection.course_evidence import course_evidence
from models.intersection.offset_kernel import MOMENTS, NUM_UNIFORMS, STATION
from models.intersection.routes import RoutedTracks
from models.intersection.spline_courses import first_lines, tracks_by_lane

Array = NDArray[np.float64]


class OffsetEvidence(NamedTuple):
    """The first course of every lane, and its points segment by segment.

    stations  (L, n, 4) x, y and the unit normal to the left [m]
    segments  (L, n - 1, 6) number of points, their mean x, y and sums of squared deviations xx, xy, yy
    """

    stations: Array
    segments: Array


@dataclass(frozen=True)
class OffsetCourses:
    """Polylines about the first course of every lane."""

    num_offsets: int = 20  # of a lane
    offset_std: float = 5.0  # [m]
    bend_std: float = 1.0  # of the second differences of offsets [m]
    position_std: float = 1.0  # of a point across its lane [m]
    step_std: float = 0.5  # of a move [m]

    def __call__(self, evidence: OffsetEvidence) -> None:
        lanes, num = evidence.stations.shape[:2]
        each = dist.MultivariateNormal(torch.zeros(num), precision_matrix=torch.from_numpy(self.precision()))
        offsets = pyro.sample("offsets", each.expand([lanes]).to_event(1))
        pyro.factor("points", log_likelihoods(self, evidence, offsets))

    def precision(self) -> Array:
        """(n, n) of the prior of the offsets of a lane."""
        second = np.diff(np.eye(self.num_offsets), 2, axis=0)
        return np.eye(self.num_offsets) / self.offset_std**2 + second.T @ second / self.bend_std**2

    def prepare(self, routed: RoutedTracks) -> OffsetEvidence:
        """Evidence of this model. Raises InputError where no track is on a route."""
        return offset_evidence(routed, self.num_offsets)

    def start(self, evidence: OffsetEvidence) -> dict[str, Tensor]:
        """The first courses themselves."""
        return {"offsets": torch.zeros(evidence.stations.shape[:2], dtype=torch.float64)}

    def moves(self) -> tuple[Move, ...]:
        """One offset at a time."""
        return (Move("walk", 1.0, NUM_UNIFORMS, self._walk),)

    def _walk(self, latents: dict[str, Tensor], u: Tensor) -> Proposal:
        shape, step = latents["offsets"].shape, compiled(offset_kernel.propose, "propose")
        z, numbers = (np.ascontiguousarray(a.numpy()).reshape(len(u), -1) for a in (latents["offsets"], u))
        z_new, u_new, log_q = np.empty_like(z), np.empty_like(numbers), np.empty((len(u), 3))
        for b in range(len(u)):
            step(0, z[b], numbers[b], np.array([self.step_std]), np.zeros(1, np.int64), z_new[b], u_new[b], log_q[b])
        new = {"offsets": torch.from_numpy(z_new).reshape(shape)}
        forward, backward, jacobian = torch.from_numpy(log_q).unbind(-1)
        valid = torch.ones(len(u), dtype=torch.bool)
        return Proposal(new, torch.from_numpy(u_new), forward, backward, jacobian, valid)

    def kernel(self, evidence: OffsetEvidence) -> Kernel:
        """The same density and moves in machine code."""
        lanes, num = evidence.stations.shape[:2]
        floats, ints = packed(self, evidence)
        return Kernel(
            move_names=("walk",),
            probabilities=np.ones(1),
            num_uniforms=NUM_UNIFORMS,
            size=lanes * num,
            floats=floats,
            ints=ints,
            cache_size=offset_kernel.cache_size(lanes, num),
            propose=compiled(offset_kernel.propose, "propose"),
            evaluate=compiled(offset_kernel.evaluate, "evaluate"),
            commit=compiled(offset_kernel.commit, "commit"),
            pack=lambda latents: np.array(latents["offsets"], dtype=np.float64).reshape(-1, lanes * num),
            unpack=lambda z: {"offsets": z.reshape((*z.shape[:-1], lanes, num))},
        )


def packed(model: OffsetCourses, evidence: OffsetEvidence) -> tuple[Array, NDArray[np.int64]]:
    """The kernel's floats and ints."""
    lanes, num = evidence.stations.shape[:2]
    log_det = float(np.linalg.slogdet(model.precision())[1])
    log_prior = 0.5 * lanes * (log_det - num * math.log(2 * math.pi))
    log_likelihood = -evidence.segments[..., 0].sum() * (math.log(model.position_std) + 0.5 * math.log(2 * math.pi))
    weights = [model.offset_std**-2, model.bend_std**-2, model.position_std**-2]
    settings = [model.step_std, *weights, log_prior, log_likelihood]
    floats = np.concatenate([settings, evidence.stations.ravel(), evidence.segments.ravel()])
    return floats, np.array([lanes, num], dtype=np.int64)


def log_likelihoods(model: OffsetCourses, evidence: OffsetEvidence, offsets: Tensor) -> Tensor:
    """log p(points | offsets), (*B,), for offsets (*B, L, n); without derivatives."""
    floats, ints = packed(model, evidence)
    rows = np.ascontiguousarray(offsets.detach().numpy()).reshape(-1, ints.prod())
    values = [offset_kernel.log_likelihood(row, floats, ints) for row in rows]
    return torch.tensor(values, dtype=torch.float64).reshape(offsets.shape[:-2])


def offset_evidence(routed: RoutedTracks, num: int) -> OffsetEvidence:
    """Stations along the first courses and the points beside them.

    Raises InputError where no track is on a route."""
    courses = course_evidence(routed, 1.0)  # nodes a metre apart
    lines = first_lines(courses)
    stations, segments = np.empty((len(lines), num, STATION)), np.empty((len(lines), num - 1, MOMENTS))
    for lane, (line, tracks) in enumerate(zip(lines, tracks_by_lane(courses), strict=True)):
        lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        s = np.linspace(0.0, lengths[-1], num)
        stations[lane, :, :2] = np.stack([np.interp(s, lengths, column) for column in line.T], 1)
        forward = np.gradient(stations[lane, :, :2], axis=0)
        stations[lane, :, 2:] = forward @ np.array([[0.0, 1.0], [-1.0, 0.0]]) / np.hypot(*forward.T)[:, None]
        points = np.concatenate(tracks)
        segment = np.clip(foot(line, lengths, points) / s[1], 0, num - 2).astype(np.int64)
        segments[lane] = segment_moments(points, segment, num - 1)
    return OffsetEvidence(stations, segments)


def foot(line: Array, lengths: Array, points: Array) -> Array:
    """How far along a polyline (n, 2) with arc lengths (n,) the nearest place to each point (N, 2) lies, (N,) [m]."""
    steps = np.diff(line, axis=0)
    apart = points[:, None] - line[:-1]  # (N, n - 1, 2)
    share = np.clip((apart * steps).sum(-1) / (steps**2).sum(-1), 0.0, 1.0)
    nearest = np.square(apart - share[..., None] * steps).sum(-1).argmin(1)
    chosen = share[np.arange(len(points)), nearest]
    return np.asarray(lengths[nearest] + chosen * np.diff(lengths)[nearest])


def segment_moments(points: Array, segment: NDArray[np.int64], num: int) -> Array:
    """(num, 6) of points (N, 2), each on its segment (N,)."""
    count = np.bincount(segment, minlength=num)
    mean = np.stack([np.bincount(segment, column, num) for column in points.T], 1) / np.maximum(count, 1)[:, None]
    x, y = (points - mean[segment]).T
    squares = [np.bincount(segment, product, num) for product in (x * x, x * y, y * y)]
    return np.column_stack([count, mean, *squares])


def centre_lines(evidence: OffsetEvidence, latents: Mapping[str, Any]) -> list[Array]:
    """Centre lines of all lanes in driving order, L arrays (n, 2) [m], for one state {site: (*event)}."""
    offsets = np.asarray(latents.get("offsets", np.zeros(evidence.stations.shape[:2])))
    return list(evidence.stations[..., :2] + offsets[..., None] * evidence.stations[..., 2:])
