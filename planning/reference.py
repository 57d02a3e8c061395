"""Reference lines: a smooth curve with curvature from the points of lanes, and Frenet coordinates along it.

    c(s) = (x, y)(s),   c' = (cos theta, sin theta),   theta' = kappa

The points are smoothed by a quintic spline in chord length, then told by arc length in a table. Offsets d count to the
left.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.program import InputError

Floats = NDArray[np.float64]
STEP = 0.25  # of the table [m]: cubic interpolation then errs by less than 1e-6 m up to curvatures of .2 / m
FEWEST = 3  # points that make a line
LONGEST = 2e5  # that a line is [m]
FINE = 0.05  # of the points at which arc length is told from chord length [m]


class ReferenceLine(NamedTuple):
    """table (M, 5): x, y, theta, kappa, kappa' at arc lengths 0, step, 2 step, ..."""

    table: Floats
    step: float

    @property
    def length(self) -> float:
        """[m]"""
        return (len(self.table) - 1) * self.step

    def at(self, s: ArrayLike) -> Floats:
        """x, y, theta, kappa, kappa' (*, 5) at arc lengths s (*,)."""
        from planning.reference_kernel import lines_at

        given = np.asarray(s, float)
        out = np.empty((given.size, 5))
        lines_at(self.table, self.step, given.ravel(), out)
        return out.reshape(*given.shape, 5)

    def place(self, s: ArrayLike, d: ArrayLike) -> Floats:
        """x, y (*, 2) of the points at arc lengths s, offsets d."""
        told = self.at(s)
        d = np.asarray(d, float)
        return np.stack([told[..., 0] - d * np.sin(told[..., 2]), told[..., 1] + d * np.cos(told[..., 2])], -1)

    def project(self, points: ArrayLike, start: ArrayLike | None = None) -> tuple[Floats, NDArray[np.int64]]:
        """s, d (N, 2) of points (N, 2), and how each search ended (planning.reference_kernel: FOUND = 0).

        start  (N,) warm starts [m]; without them the nearest row of the table"""
        from planning.reference_kernel import feet, nearest

        given = np.ascontiguousarray(points, float).reshape(-1, 2)
        warm = np.empty(len(given))
        if start is None:
            nearest(self.table, given, warm)
            warm *= self.step
        else:
            warm[:] = start
        out, ended = np.empty((len(given), 2)), np.empty(len(given), np.int64)
        feet(self.table, self.step, given, warm, out, ended)
        return out, ended


def from_curvature(
    s: ArrayLike, kappa: ArrayLike, start: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> ReferenceLine:
    """From (x, y, theta) = start, with curvature through kappa (N,) at s (N,) as a cubic spline, up to the last
    multiple of STEP. Raises InputError for NaN, and arc lengths that do not rise from 0."""
    from scipy.interpolate import CubicSpline

    s, kappa = np.asarray(s, float), np.asarray(kappa, float)
    if s.ndim != 1 or s.shape != kappa.shape or len(s) < 2 or s[0] != 0.0 or not (np.diff(s) > 0.0).all():
        raise InputError("a line from curvature needs arc lengths that rise from 0, and as many curvatures")
    if not (np.isfinite(kappa).all() and s[-1] < math.inf):
        raise InputError("a line from curvature: curvatures and arc lengths must be finite")
    curve = CubicSpline(s, kappa)
    turned = curve.antiderivative()
    rows = STEP * np.arange(math.floor(s[-1] / STEP + 1e-9) + 1)
    if len(rows) < 2:
        raise InputError(f"a line from curvature is {s[-1]} m long, shorter than {STEP} m")
    nodes, weights = np.polynomial.legendre.leggauss(6)
    theta = start[2] + turned(rows[:-1, None] + (nodes + 1) * STEP / 2)
    x, y = (np.r_[0.0, np.cumsum(f(theta) @ weights * STEP / 2)] for f in (np.cos, np.sin))
    table = np.stack([start[0] + x, start[1] + y, start[2] + turned(rows), curve(rows), curve(rows, 1)], -1)
    return ReferenceLine(np.ascontiguousarray(table), STEP)


def from_points(points: ArrayLike, *, std: float = 0.05, name: str = "reference line") -> ReferenceLine:
    """A smooth line along points (N, 2) whose errors have standard deviation `std` [m].

    A quintic smoothing spline in chord length: curvature and its slope are continuous; x'' jumps nowhere.
    Raises InputError, with `name`: fewer than three points, NaN, points that repeat, a line that is too long or crosses
    itself."""
    from scipy.integrate import cumulative_simpson
    from scipy.interpolate import CubicHermiteSpline, make_splprep

    given = np.asarray(points, float)
    _check(given, std, name)
    chord = np.r_[0.0, np.cumsum(np.hypot(*np.diff(given, axis=0).T))]
    if chord[-1] > LONGEST:
        raise InputError(f"{name}: it is {chord[-1]:g} m long, more than {LONGEST:g} m; take what is near")
    degree = min(5, len(given) - 1)
    curve, _ = make_splprep(given.T, u=chord, k=degree, s=len(given) * std**2)
    first, second = curve.derivative(1), curve.derivative(2)
    fine = np.linspace(0.0, chord[-1], max(int(chord[-1] / FINE), 100) + 1)
    pace = np.hypot(*first(fine))
    arc = cumulative_simpson(pace, x=fine, initial=0.0)
    num = max(round(arc[-1] / STEP), 1)
    step = float(arc[-1] / num)
    u = CubicHermiteSpline(arc, fine, 1.0 / pace)(np.linspace(0.0, arc[-1], num + 1))
    (x, y), (x1, y1), (x2, y2) = curve(u), first(u), second(u)
    x3, y3 = curve.derivative(3)(u) if degree > 2 else np.zeros((2, num + 1))  # three points make a parabola
    v = np.hypot(x1, y1)
    cross = x1 * y2 - y1 * x2
    kappa = cross / v**3
    slope = ((x1 * y3 - y1 * x3) / v**3 - 3 * cross * (x1 * x2 + y1 * y2) / v**5) / v
    table = np.stack([x, y, np.unwrap(np.arctan2(y1, x1)), kappa, slope], -1)
    _uncrossed(table, name)
    return ReferenceLine(np.ascontiguousarray(table), step)


def _check(points: Floats, std: float, name: str) -> None:
    if points.ndim != 2 or points.shape[1:] != (2,):
        raise InputError(f"{name}: points have shape {points.shape}, but must be (N, 2) of x and y [m]")
    if len(points) < FEWEST:
        raise InputError(f"{name}: {len(points)} points make no line; give {FEWEST} or more")
    if not np.isfinite(points).all():
        row = int(np.flatnonzero(~np.isfinite(points).all(1))[0])
        raise InputError(f"{name}: point {row} is {tuple(points[row].tolist())}; leave it out or mend it")
    repeated = np.flatnonzero((np.diff(points, axis=0) == 0).all(1))
    if len(repeated):
        raise InputError(f"{name}: points {repeated[0]} and {repeated[0] + 1} are the same; leave one out")
    if not std >= 0:
        raise InputError(f"{name}: std is {std}, but must be 0 or more [m]")


def _uncrossed(table: Floats, name: str) -> None:
    from shapely import LineString

    if not LineString(table[:, :2]).is_simple:
        raise InputError(f"{name}: it crosses itself, so that offsets from it are no coordinates; cut it in two")
