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
from models.intersection.split import prefix_sums, split_table
from models.intersection.tracks import Tracks
from models.program import InputError

if TYPE_CHECKING:
    from models.intersection.state import Junction

Array = NDArray[np.float64]
MIN_POINTS = 8  # of a half track


class WholeTracks(NamedTuple):
    """Tracks that a latent centre splits, see models.intersection.split.

    rows     (3, N) x, y about the origin [m], heading [rad]
    offsets  (T + 1,) of the tracks
    sums     running sums along each track
    table    where each cell of the centre splits each track
    """

    rows: Array
    offsets: NDArray[np.int64]
    sums: Array
    table: NDArray[np.int64]


class JunctionEvidence(NamedTuple):
    """Half tracks, entries first.

    points       (3, N) x, y about the origin [m] and heading [rad], half by half; None simulates
    s            (N,) distance from the origin along the lane [m]: a fixed covariate
    starts       (H + 1,) half h holds points starts[h]:starts[h + 1]
    track        (H,) the track of each half, num_tracks of all tracks
    num_entries  of the halves; not `entries`, which is a site of the program
    origin       (2,) where the tracks meet [m]
    heading      whether headings were measured
    tracks       as given; None where half tracks were simulated
    whole        the same about the origin: [M20]'s likelihoods split them at the latent centre
    """

    points: Tensor | None
    s: Array
    starts: NDArray[np.int64]
    track: NDArray[np.int64]
    num_tracks: int
    num_entries: int
    origin: Array
    heading: bool
    tracks: Tracks | None
    whole: WholeTracks | None

    @property
    def num_halves(self) -> int:
        return len(self.starts) - 1

    @property
    def moments(self) -> Array:
        """(12, H) of the points."""
        assert self.points is not None
        x, y, phi = np.ascontiguousarray(self.points.numpy())
        return np.asarray(moments(x, y, phi, self.s, self.starts))


def checked(tracks: Tracks) -> tuple[Array, Array | None, NDArray[np.int64]]:
    """Points, headings and offsets as machine code may read them. Raises InputError: it would not check bounds."""
    points = np.ascontiguousarray(tracks.points, dtype=np.float64)
    offsets = np.ascontiguousarray(tracks.offsets, dtype=np.int64)
    heading = None if tracks.heading is None else np.ascontiguousarray(tracks.heading, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise InputError(f"tracks need points of shape (N, 2), but these are {points.shape}")
    if len(offsets) < 2 or offsets[0] != 0 or offsets[-1] != len(points) or (np.diff(offsets) < 0).any():
        raise InputError(f"the offsets of tracks must rise from 0 to their {len(points)} points, but are {offsets}")
    if heading is not None and heading.shape != (len(points),):
        raise InputError(f"tracks need one heading a point, {len(points)}, but have {heading.shape}")
    for name, values in (("points", points), ("headings", heading)):
        if values is not None and not np.isfinite(values).all():
            row = int(np.argwhere(~np.isfinite(values))[0, 0])
            track = int(np.searchsorted(offsets, row, side="right")) - 1
            raise InputError(f"the {name} of track {track} are not finite at its point {row - offsets[track]}")
    if heading is not None and np.abs(heading).max() > 1e4:
        raise InputError(f"headings must be radians, but reach {np.abs(heading).max():g}")
    return points, heading, offsets


def whole_tracks(points: Array, phi: Array, offsets: NDArray[np.int64], path: Array) -> WholeTracks:
    """Tables of tracks about the origin for likelihoods that split them at the latent centre."""
    rows = np.ascontiguousarray(np.vstack([points.T, phi]))
    return WholeTracks(rows, offsets, prefix_sums(rows, offsets), split_table(np.ascontiguousarray(path), offsets))


def junction_evidence(tracks: Tracks, model: Junction) -> JunctionEvidence:
    """Split tracks into halves outside the inner radius about where they meet.

    Raises InputError where no track is long enough or none crosses."""
    points, heading, offsets = checked(tracks)
    path = hv.smooth(points, offsets)
    origin = hv.crossing(path, offsets)
    measured = heading is not None
    turn = hv.path_headings(path, offsets)
    phi = turn if heading is None else hv.unwrap(heading, offsets)
    begin, end, entries = hv.outer_halves(path, turn, offsets, origin, model.inner_radius, MIN_POINTS)
    if len(begin) == 0:
        raise InputError(
            f"none of the {len(offsets) - 1} tracks comes within {hv.CROSSES:g} m of where they meet, "
            f"({origin[0]:.1f}, {origin[1]:.1f}), and has {MIN_POINTS} points on a straight part farther than "
            f"{hv.LEAST_RADIUS:g} m from it; give tracks that cross the junction"
        )
    observed, s, starts = hv.gather_halves(points, path, phi, begin, end, entries, origin)
    whole = None if model.likelihood == "exact" else whole_tracks(points - origin, phi, offsets, path - origin)
    track = np.searchsorted(offsets, begin, side="right") - 1
    num = len(offsets) - 1
    halves = (torch.from_numpy(observed), s, starts, track, num, int(entries))
    return JunctionEvidence(*halves, origin, measured, Tracks(points, heading, offsets, tracks.borders), whole)


def scaled(evidence: JunctionEvidence, observed: Array, model: Junction) -> Array:
    """Coefficients of the density, (19, H), from moments (12, H)."""
    noise = model.noise
    out = np.empty((NUM_COEFFICIENTS, observed.shape[1]))
    heading = noise.heading if evidence.heading else math.inf
    along = along_moments(evidence.s, evidence.starts)
    coefficients(
        observed, along, evidence.num_entries, noise.position, noise.along, noise.offset, noise.phase, heading, out
    )
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
