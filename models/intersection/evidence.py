"""What the intersection program reads: half tracks with their fixed positions along the lane."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.intersection import halves as hv
from models.intersection.moments import (
    COUNT,
    CXX,
    CYY,
    MX,
    MY,
    NUM_COEFFICIENTS,
    along_moments,
    coefficients,
    log_normaliser,
    moments,
)
from models.intersection.tracks import Tracks
from models.program import InputError

if TYPE_CHECKING:
    from models.intersection.state import Junction

Array = NDArray[np.float64]
MIN_POINTS = 8  # of a half track


class JunctionEvidence(NamedTuple):
    """Half tracks, entries first.

    points       (3, N) x, y about the origin [m] and heading [rad], half by half; None simulates
    s            (N,) distance from the origin along the lane [m]: a fixed covariate
    starts       (H + 1,) half h holds points starts[h]:starts[h + 1]
    num_entries  of the halves; not `entries`, which is a site of the program
    origin       (2,) where the tracks meet [m]
    heading      whether headings were measured
    whole        the tracks as given, about the origin: [M20]'s likelihoods split them at the latent centre
    """

    points: Tensor | None
    s: Array
    starts: NDArray[np.int64]
    num_entries: int
    origin: Array
    heading: bool
    whole: Tracks | None

    @property
    def num_halves(self) -> int:
        return len(self.starts) - 1

    @property
    def moments(self) -> Array:
        """(12, H) of the points."""
        assert self.points is not None
        x, y, phi = np.ascontiguousarray(self.points.numpy())
        return np.asarray(moments(x, y, phi, self.s, self.starts))


def junction_evidence(tracks: Tracks, model: Junction) -> JunctionEvidence:
    """Split tracks into halves outside the inner radius about where they meet.

    Raises InputError where no track is long enough or none crosses."""
    offsets = np.ascontiguousarray(tracks.offsets, dtype=np.int64)
    points = np.ascontiguousarray(tracks.points, dtype=np.float64)
    if len(offsets) < 2 or not np.isfinite(points).all():
        raise InputError(f"tracks must be finite points of at least one vehicle; got {len(offsets) - 1} vehicles")
    path = hv.smooth(points, offsets)
    origin = hv.crossing(path, offsets)
    measured = tracks.heading is not None
    turn = hv.path_headings(path, offsets)
    phi = hv.unwrap(np.asarray(tracks.heading), offsets) if measured else turn
    begin, end, entries = hv.outer_halves(path, turn, offsets, origin, model.inner_radius, MIN_POINTS)
    if len(begin) == 0:
        raise InputError(
            f"none of the {len(offsets) - 1} tracks comes within {hv.CROSSES:g} m of where they meet, "
            f"({origin[0]:.1f}, {origin[1]:.1f}), and has {MIN_POINTS} points on a straight part farther than "
            f"{hv.LEAST_RADIUS:g} m from it; give tracks that cross the junction"
        )
    observed, s, starts = hv.gather_halves(points, path, phi, begin, end, entries, origin)
    whole = Tracks(points - origin, phi, offsets) if model.likelihood != "exact" else None
    return JunctionEvidence(torch.from_numpy(observed), s, starts, int(entries), origin, measured, whole)


def scaled(evidence: JunctionEvidence, observed: Array, model: Junction) -> Array:
    """Coefficients of the density, (18, H), from moments (12, H)."""
    noise = model.noise
    out = np.empty((NUM_COEFFICIENTS, observed.shape[1]))
    heading = noise.heading if evidence.heading else math.inf
    along = along_moments(evidence.s, evidence.starts)
    coefficients(observed, along, noise.position, noise.along, noise.offset, noise.phase, heading, out)
    return out


def clutter_costs(evidence: JunctionEvidence, observed: Array, model: Junction) -> tuple[Array, Array]:
    """(H,) log normaliser of a half on a lane, and -log density of a stray half beyond it.

    The points of a stray half are N(origin, clutter_std^2 I), its headings uniform on the circle."""
    along = along_moments(evidence.s, evidence.starts)
    noise = model.noise if evidence.heading else model.noise._replace(heading=math.inf)
    front, num, variance = log_normaliser(along, noise), along[COUNT], model.clutter_std**2
    squares = observed[CXX] + observed[CYY] + num * (observed[MX] ** 2 + observed[MY] ** 2)
    stray = num * math.log(2 * math.pi * variance) + 0.5 * squares / variance
    if evidence.heading:
        stray = stray + num * math.log(2 * math.pi)
    return front, stray + front
