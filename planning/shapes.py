"""What must not touch: the vehicle as circles, other road users as rectangles of uncertain place, boundary lines.

Circles after Ziegler and Stiller (2010): n equal ones along the vehicle that cover its rectangle. A circle of radius R
at c and a rectangle whose nearest point is c - q are apart by |q| - R. Where the rectangle's place is wrong by
e ~ N(0, S), they can touch only if e . q / |q| >= |q| - R, so

    P(touch) <= Phi(-(|q| - R) / sigma),   sigma^2 = q' S q / |q|^2

and the chance constraint P <= Phi(-z) holds where |q| - R >= z sigma. Without uncertainty it is the distance. Any
other direction bounds P too: along and across the rectangle they keep a place that is uncertain ahead, like that of
oncoming traffic in the next lane, from counting as uncertain to the side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.formula import Formula
from models.program import InputError

Floats = NDArray[np.float64]
MOST_CELLS = 20_000_000  # of that grid: some 4 km by 4 km
CELL = 1.0  # of the grid in which segments of boundary lines are found [m]


@dataclass(frozen=True)
class Vehicle:
    """A rectangle of length and width [m]; its middle lies `middle` ahead of the rear axle [m]."""

    length: float = 4.9
    width: float = 1.9
    middle: float = 1.4
    num_circles: int = 3

    def __post_init__(self) -> None:
        for name in ("length", "width", "num_circles"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"vehicle: {name} is {getattr(self, name)}, but must be positive and finite")
        if not math.isfinite(self.middle) or self.num_circles != int(self.num_circles):
            raise InputError(f"vehicle: middle is {self.middle} and num_circles {self.num_circles}: a length, a number")

    @property
    def front(self) -> float:
        """From the rear axle to the front [m]."""
        return self.middle + self.length / 2

    @property
    def circles(self) -> Floats:
        """(n,) their middles, ahead of the rear axle [m]."""
        return self.middle + self.length * ((np.arange(self.num_circles) + 0.5) / self.num_circles - 0.5)

    @property
    def radius(self) -> float:
        """[m], the least with which they cover the rectangle."""
        return math.hypot(self.length / 2 / self.num_circles, self.width / 2)


def _clearance(x: Sequence[Any], p: Sequence[Any], ops: Any) -> tuple[Any, ...]:
    px, py = x
    ox, oy, cos, sin, half_length, half_width, along, mixed, across, z, radius = p
    ahead, left = (px - ox) * cos + (py - oy) * sin, (py - oy) * cos - (px - ox) * sin
    qx = ahead - ops.fmin(ops.fmax(ahead, -half_length), half_length)
    qy = left - ops.fmin(ops.fmax(left, -half_width), half_width)
    squared = qx * qx + qy * qy
    spread = ops.fmax(qx * qx * along + 2 * qx * qy * mixed + qy * qy * across, 0.0)  # of a flat one, to rounding
    root = ops.sqrt(squared)
    beside = ops.fabs(left) - half_width - radius - z * ops.sqrt(ops.fmax(across, 0.0))
    beyond = ops.fabs(ahead) - half_length - radius - z * ops.sqrt(ops.fmax(along, 0.0))
    return (ops.fmax(squared - radius * root - z * ops.sqrt(spread), root * ops.fmax(beside, beyond)),)


# |q| times the largest of |q| - R - z sigma and the same along and across the rectangle: positive where a circle at x
# is clear of it; covariance in the rectangle's frame
CLEARANCE = Formula("clearance", _clearance, 2, 11)


def _sigmas(x: Sequence[Any], p: Sequence[Any], ops: Any) -> tuple[Any, ...]:
    px, py = x
    ox, oy, cos, sin, half_length, half_width, along, mixed, across, radius = p
    ahead, left = (px - ox) * cos + (py - oy) * sin, (py - oy) * cos - (px - ox) * sin
    qx = ahead - ops.fmin(ops.fmax(ahead, -half_length), half_length)
    qy = left - ops.fmin(ops.fmax(left, -half_width), half_width)
    root = ops.sqrt(qx * qx + qy * qy)
    spread = ops.fmax(qx * qx * along + 2 * qx * qy * mixed + qy * qy * across, 0.0)
    towards = ops.fmax(ops.sqrt(spread) / ops.fmax(root, EXACT), EXACT)
    beside = (ops.fabs(left) - half_width - radius) / ops.fmax(ops.sqrt(ops.fmax(across, 0.0)), EXACT)
    beyond = (ops.fabs(ahead) - half_length - radius) / ops.fmax(ops.sqrt(ops.fmax(along, 0.0)), EXACT)
    return (ops.fmax((root - radius) / towards, ops.fmax(beside, beyond)),)


# the largest z with which CLEARANCE is not negative: P(touch) <= Phi(-z) of a circle at x; places are known to EXACT
EXACT = 1e-9  # [m]
SIGMAS = Formula("sigmas", _sigmas, 2, 10)


ROUND = 6  # the exponent of the smooth outline: at 6 a car with circles of 1.35 m grows by 3 cm at its sides
BEARINGS = 64  # of half a circle, at which it is fitted
FITTED = 1.003  # what it is widened by, for the bearings between


def _outline(x: Sequence[Any], p: Sequence[Any], ops: Any) -> tuple[Any, ...]:
    px, py = x
    ox, oy, cos, sin, half_length, half_width = p
    u = ((px - ox) * cos + (py - oy) * sin) / half_length
    v = ((py - oy) * cos - (px - ox) * sin) / half_width
    uu, vv = u * u, v * v
    return (ops.log(uu * uu * uu + vv * vv * vv + 1e-12) / ROUND,)


# log of the norm (|u|^6 + |v|^6)^(1/6), negative inside an outline that holds all x where CLEARANCE <= 0
OUTLINE = Formula("outline", _outline, 2, 6)


def outlines(table: Floats, radius: float) -> Floats:
    """p (..., 6) of OUTLINE, for rows (..., 11) of Obstacles.table and circles of a radius [m].

    A circle at q from the rectangle is just clear at |q| = radius + z sigma(q / |q|), so the outline must hold the
    rectangle's corners moved by that in every direction. Its half axes are those of that shape, scaled together by
    the largest value of the norm on it."""
    bearing = np.pi * np.arange(BEARINGS) / BEARINGS  # the other half is the same
    cos, sin = np.cos(bearing), np.sin(bearing)
    along, mixed, across, z = (table[..., k, None] for k in (6, 7, 8, 9))
    spread = along * cos**2 + 2 * mixed * cos * sin + across * sin**2
    far = radius + z * np.sqrt(np.maximum(spread, 0.0))
    x, y = table[..., 4, None] + far * np.abs(cos), table[..., 5, None] + far * np.abs(sin)
    half = np.stack([x.max(-1), y.max(-1)], -1)
    norm = ((x / half[..., :1]) ** ROUND + (y / half[..., 1:]) ** ROUND).max(-1) ** (1 / ROUND)
    return np.concatenate([table[..., :4], half * FITTED * norm[..., None]], -1)


class Obstacles(NamedTuple):
    """M rectangles at K times, the horizon's steps without the first, and how likely each is met.

    pose         (M, K, 3) x, y, heading
    size         (M, 2) length, width [m]
    covariance   (M, K, 2, 2) of x, y, in the plane's axes [m^2]
    probability  (M,) that there is such an object and that it moves this way
    """

    pose: Floats
    size: Floats
    covariance: Floats
    probability: Floats

    def table(self, risk: float, radius: float, reach: float) -> Floats:
        """(M', 11, K): for each object and time p of CLEARANCE with radius left out, and the squared distance between
        middles beyond which nothing can touch. Objects less likely than `risk` each are left out.

        risk    allowed for each object: probability * Phi(-z) = risk, z >= 0
        radius  of the vehicle's circles [m]
        reach   from the vehicle's middle to its farthest point [m]"""
        from scipy.special import ndtri

        kept = self.probability > risk
        pose, size, S = self.pose[kept], self.size[kept], self.covariance[kept]
        z = np.maximum(-ndtri(risk / self.probability[kept]), 0.0)[:, None]  # (M', 1)
        cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        along = cos**2 * S[..., 0, 0] + 2 * cos * sin * S[..., 0, 1] + sin**2 * S[..., 1, 1]
        across = sin**2 * S[..., 0, 0] - 2 * cos * sin * S[..., 0, 1] + cos**2 * S[..., 1, 1]
        mixed = cos * sin * (S[..., 1, 1] - S[..., 0, 0]) + (cos**2 - sin**2) * S[..., 0, 1]
        half = np.broadcast_to(size[:, None] / 2, (*cos.shape, 2))
        widest = z * np.sqrt(np.maximum(np.linalg.eigvalsh(S)[..., 1], 0.0)) if len(S) else np.zeros_like(cos)
        near = (np.hypot(half[..., 0], half[..., 1]) + reach + widest) ** 2
        told = [pose[..., 0], pose[..., 1], cos, sin, half[..., 0], half[..., 1], along, mixed, across]
        return np.ascontiguousarray(np.stack([*told, np.broadcast_to(z, cos.shape), near], 1))


def no_obstacles(num_steps: int) -> Obstacles:
    """None of them."""
    return Obstacles(np.zeros((0, num_steps, 3)), np.zeros((0, 2)), np.zeros((0, num_steps, 2, 2)), np.zeros(0))


def check_obstacles(obstacles: Obstacles, num_steps: int) -> None:
    """Raises InputError for wrong shapes, NaN, sizes that are not positive, covariances that are not symmetric or have
    negative eigenvalues, and probabilities outside [0, 1]."""
    for name, value in obstacles._asdict().items():
        if not isinstance(value, np.ndarray):
            raise InputError(f"obstacles: {name} is a {type(value).__name__}, but must be an array")
        if value.dtype.kind not in "biuf":
            raise InputError(f"obstacles: {name} is an array of {value.dtype}, but must be one of numbers")
    num = len(obstacles.pose)
    wanted = {
        "pose": (num, num_steps, 3),
        "size": (num, 2),
        "covariance": (num, num_steps, 2, 2),
        "probability": (num,),
    }
    for name, shape in wanted.items():
        found = getattr(obstacles, name)
        if found.shape != shape:
            raise InputError(f"obstacles: {name} has shape {found.shape}, but must be {shape}")
        if not np.isfinite(found).all():
            first = int(np.argwhere(~np.isfinite(found))[0, 0])
            raise InputError(f"obstacle {first}: {name} is not finite")
    for which in np.flatnonzero((obstacles.size <= 0).any(1)):
        raise InputError(f"obstacle {which}: its size is {obstacles.size[which].tolist()}, but must be positive [m]")
    S = obstacles.covariance
    crooked = np.abs(S[..., 0, 1] - S[..., 1, 0]) > 1e-9 * (1 + np.abs(S[..., 0, 1]))
    for which in np.flatnonzero(crooked.any(1)):
        raise InputError(f"obstacle {which}: its covariance is not symmetric")
    if num and (np.linalg.eigvalsh(S) < -1e-9).any():
        raise InputError("obstacles: a covariance has a negative eigenvalue")
    if ((obstacles.probability < 0) | (obstacles.probability > 1)).any():
        raise InputError(f"obstacles: probabilities are {obstacles.probability.tolist()}, but lie between 0 and 1")


class Boundary(NamedTuple):
    """Segments of boundary lines in the cells of a grid that a circle of radius `reach` in the cell may touch.

    segment  (N, 4) x, y of both ends
    origin   x, y of the grid's corner [m]
    shape    numbers of cells
    offset   (cells + 1,), member: segments of cell c are member[offset[c]:offset[c + 1]]
    cell     width of a cell [m]
    reach    [m]
    """

    segment: Floats
    origin: Floats
    shape: NDArray[np.int64]
    offset: NDArray[np.int64]
    member: NDArray[np.int64]
    cell: float
    reach: float


def boundary(lines: Sequence[ArrayLike], reach: float, *, within: tuple[float, float, float] | None = None) -> Boundary:
    """Of lines, each (N, 2) points [m]; `within` keeps what is nearer than r to (x, y): (x, y, r).

    Raises InputError for NaN, wrong shapes, a reach below 0, and lines that span more than MOST_CELLS cells."""
    from planning.boundary_kernel import bucket

    if not 0.0 <= reach < math.inf:
        raise InputError(f"boundary lines: reach is {reach}, but must be 0 or more and finite [m]")
    if within is not None and not (np.isfinite(within[:2]).all() and within[2] >= 0.0):
        raise InputError(f"boundary lines: within is {within}, but must be x, y and a radius of 0 or more [m]")
    parts = [np.zeros((0, 4))]
    for number, line in enumerate(lines):
        points = np.asarray(line, float)
        if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
            raise InputError(f"boundary line {number}: it must be (N, 2) finite points, but has shape {points.shape}")
        parts.append(np.hstack([points[:-1], points[1:]]))
    segment = np.concatenate(parts)
    if within is not None and len(segment):
        x, y, r = within
        length = np.hypot(*(segment[:, 2:] - segment[:, :2]).T)
        segment = segment[np.hypot(segment[:, 0] - x, segment[:, 1] - y) <= r + length]
    if not len(segment):
        none = np.zeros(0, np.int64)
        return Boundary(segment, np.zeros(2), np.zeros(2, np.int64), np.zeros(1, np.int64), none, CELL, reach)
    ends = segment.reshape(-1, 2)
    lower, upper = ends.min(0), ends.max(0)
    if within is not None:
        x, y, r = within
        lower, upper = np.maximum(lower, [x - r, y - r]), np.minimum(upper, [x + r, y + r])
        upper = np.maximum(lower, upper)  # a long segment may be kept that passes by
    origin = lower - reach - CELL
    cells = np.ceil((upper + reach + CELL - origin) / CELL)
    if cells.prod() > MOST_CELLS:
        span = " by ".join(f"{width:.0f}" for width in upper - lower)
        raise InputError(f"boundary lines span {span} m, too much for one grid; keep what is near by `within`")
    shape = cells.astype(np.int64)
    offset, member = bucket(segment, origin, shape, CELL, reach)
    return Boundary(np.ascontiguousarray(segment), origin, shape, offset, member, CELL, reach)
