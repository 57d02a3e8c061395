"""From the points of a laser scan to boxes, before any filter: [K15] fuses what sensors measure, and of a scan that is
the box of each cluster of points.

    clusters  points nearer than `GAP` to each other belong together
    corner    what is seen of a box is a corner of two sides at most, those that face the sensor. At each heading a of
              a fine grid every point goes to the nearer of the two (Zhang et al. 2017, "Efficient L-shape fitting for
              vehicle detection using laser scanners", which searches in the same way), with the squares S(a) about them
    size      shapes s are the usual sizes of road users, along one side or along the other. A side with points on it is
              as long as it is seen, up to the next beam at either end; the other one is at least as long as seen
    middle    half a size behind each side that is seen. Its mean and covariance are those of the mixture over headings
              and shapes, weighted by exp(-S(a) / (2 std^2)) p(sizes seen | s) share_s: an unseen rear half of a car
              and a heading that few points leave open are in the covariance

Clusters next to something nearer are left out, for it may hide a part of them. What a box is wrong by lasts while the
object is seen from the same side: a filter that takes errors for independent from scan to scan is too sure.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import log_ndtr

from experiments.scenarios.laser_beams import Laser, Sweep

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
GAP = 0.8  # [m]
FEWEST = 3  # points of a cluster, and of a side that tells how long it is
HEADINGS = np.radians(np.arange(90.0))  # of one side
# share; length and width with their standard deviations [m]: cars, bicycles, pedestrians
SHAPES = ((0.6, 4.5, 0.4, 1.8, 0.15), (0.2, 1.8, 0.2, 0.6, 0.1), (0.2, 0.5, 0.1, 0.5, 0.1))


class Boxes(NamedTuple):
    """M boxes, seen from the sensor.

    middle      (M, 2) [m]
    covariance  (M, 2, 2) of the middle
    heading     (M,) of one of the sides, in [0, pi / 2) [rad]: the likeliest
    size        (M, 2) along that side and across it, expected [m]
    """

    middle: Floats
    covariance: Floats
    heading: Floats
    size: Floats

    @property
    def values(self) -> Floats:
        """(M, 2) range [m] and bearing [rad] of the middle."""
        return np.stack([np.hypot(*self.middle.T), np.arctan2(self.middle[:, 1], self.middle[:, 0])], -1)

    @property
    def noise(self) -> Floats:
        """(M, 2, 2) covariances of `values`, to first order."""
        distance = self.values[:, 0]
        unit = self.middle / distance[:, None]
        across = np.stack([-unit[:, 1], unit[:, 0]], -1) / distance[:, None]
        slope = np.stack([unit, across], 1)
        return slope @ self.covariance @ slope.swapaxes(1, 2)


def boxes(sweep: Sweep, laser: Laser) -> Boxes:
    """The box of each cluster of a sweep that is seen as a whole and has three points or more."""
    found = [fit for points in clusters(sweep) if (fit := fit_box(points, laser)) is not None]
    if not found:
        return Boxes(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros((0, 2)))
    middle, covariance, heading, size = (np.array(part) for part in zip(*found, strict=True))
    return Boxes(middle, covariance, heading, size)


def clusters(sweep: Sweep) -> list[Floats]:
    """Points (n, 2) [m] of each cluster, seen from the sensor, in the order of their first beams."""
    padded = np.concatenate([[np.inf], sweep.distance, [np.inf]])
    kept = list[Floats]()
    for beams in beams_of(sweep):
        hidden = padded[beams[0]] < sweep.distance[beams[0]] or padded[beams[-1] + 2] < sweep.distance[beams[-1]]
        if len(beams) >= FEWEST and not hidden:
            kept.append(points_of(sweep, beams))
    return kept


def beams_of(sweep: Sweep) -> list[Ints]:
    """The beams (n,) of each cluster, in the order of the first ones."""
    hit = np.flatnonzero(np.isfinite(sweep.distance))
    pairs = cKDTree(points_of(sweep, hit)).query_pairs(GAP, output_type="ndarray")
    near = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(hit), len(hit)))
    number, label = connected_components(near, directed=False)
    return [hit[label == cluster] for cluster in range(number)]


def points_of(sweep: Sweep, beams: Ints) -> Floats:
    """(n, 2) where beams end [m]."""
    along = np.stack([np.cos(sweep.bearing[beams]), np.sin(sweep.bearing[beams])], -1)
    return np.asarray(sweep.distance[beams, None] * along)


def fit_box(points: Floats, laser: Laser) -> tuple[Floats, Floats, float, Floats] | None:
    """Middle, its covariance, heading and size of the box of points (n, 2), as Boxes has them; None where the sensor is
    inside every such box."""
    step, std = laser.step, laser.range_std
    cos, sin = np.cos(HEADINGS), np.sin(HEADINGS)
    axes = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], 1)  # (A, 2, 2)
    c = axes @ points.T  # (A, 2, n) along each side
    low, high = c.min(-1), c.max(-1)
    back = np.where(low > 0.0, 1.0, np.where(high < 0.0, -1.0, 0.0))  # away from the sensor; 0: no side across faces it
    near = np.where(back > 0.0, low, high)
    away = np.where(back[..., None] != 0.0, np.abs(c - near[..., None]), np.inf)
    on = np.arange(2)[None, :, None] == away.argmin(1)[:, None]  # (A, 2, n) points on the side across each axis
    count = on.sum(-1)
    edge = np.where(count > 0, (c * on).sum(-1) / np.maximum(count, 1), near)
    squares = (np.square(c - edge[..., None]) * on).sum((1, 2))
    squares[(back == 0.0).all(1)] = np.inf
    if not np.isfinite(squares).any():
        return None
    # where the next beam along a side would have met it, beyond either end: du = (h^2 + u^2) / h dphi
    plane = np.maximum(np.abs(edge[:, ::-1]), 1e-3)
    below, beyond = (step * (np.square(plane) + np.square(end)) / plane for end in (low, high))
    nearer, farther = np.where(back > 0.0, (below, beyond), (beyond, below))
    sharp = count > 1
    front = np.where(sharp, edge, near - 0.5 * back * nearer)
    front_var = np.where(sharp, std**2 / np.maximum(count, 1), np.square(nearer) / 12 + std**2)
    across = back == 0.0  # both ends are those of a side that faces the sensor
    # sizes (A, H, 2) by shape, given how long the sides seem that have points on them
    extent = np.where(across, high - low + 0.5 * (below + beyond), np.abs(np.where(back > 0.0, high, low) - front))
    extent += np.where(across, 0.0, 0.5 * farther)
    vague = (np.where(across, np.square(below), 0.0) + np.square(farther)) / 12 + 2 * std**2
    seen = ((count[:, ::-1] >= FEWEST) & (np.maximum(below, beyond) < 0.5 * GAP))[:, None]
    extent, vague = np.where(seen, extent[:, None], (high - low)[:, None]), vague[:, None]
    share, mean, spread = _shapes()
    total = spread + np.where(seen, vague, std**2)
    surprise = -0.5 * (np.square(extent - mean) / total + np.log(2 * math.pi * total))
    told = np.where(seen, surprise, log_ndtr((mean - extent) / np.sqrt(total)))
    size = np.where(seen, (mean * vague + extent * spread) / (spread + vague), np.maximum(mean, extent))
    left = np.where(seen, spread * vague / (spread + vague), spread)
    # the middle along each axis
    centre = 0.5 * (low + high) + 0.25 * (beyond - below)
    centre_var = (np.square(below) + np.square(beyond)) / 48 + 0.5 * std**2
    middle = np.where(across[:, None], centre[:, None], front[:, None] + 0.5 * back[:, None] * size)
    variance = np.where(across[:, None], centre_var[:, None], front_var[:, None] + 0.25 * left)
    log_weight = -0.5 * squares[:, None] / std**2 + told.sum(-1) + np.log(share)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    place = middle @ axes  # (A, H, 2) in the frame of the sensor
    own = np.einsum("adi,ahd,adj->ahij", axes, variance, axes)
    best = np.einsum("ah,ahi->i", weight, place)
    gap = place - best
    covariance = np.einsum("ah,ahij->ij", weight, own + gap[..., :, None] * gap[..., None, :])
    a = int(weight.sum(1).argmax())
    return best, covariance, float(HEADINGS[a]), weight[a] @ size[a] / weight[a].sum()


def _shapes() -> tuple[Floats, Floats, Floats]:
    """Shares (H,), and sizes along both axes, their means and variances (H, 2)."""
    table = np.array(SHAPES)
    mean, spread = table[:, 1::2], np.square(table[:, 2::2])
    return np.tile(table[:, 0] / 2, 2), np.concatenate([mean, mean[:, ::-1]]), np.concatenate([spread, spread[:, ::-1]])
