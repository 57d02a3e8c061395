"""From the points of a laser scan to outlines: what a cluster says of a rectangle, and nothing that it does not say.

A rectangle turned by a shows the sensor a corner, (e1, e2) along a and across it, between two sides: the left one, at
e1 along a, and the right one, at e2 across. Beam i, psi_i = bearing - a, ends at

    r_i = e1 / cos psi_i  left of the corner,   e2 / sin psi_i  right of it,   + N(0, std^2)

    given a and between which two beams the corner is, e1 and e2 are linear least squares, with one more line: the
    corner is between those two beams, uniformly. A side without points is so where the other one ends
    far ends   where a side ends, the next beam misses: between the two, uniformly. An end next to something nearer, at
               the border of the view, or of a side that shows no points is unseen (models.objects.outline)
    measured   mean and covariance of middle and tensor over a and the corner's place, weighted by

                   exp(-sum of squares / 2) / sqrt(det information)

Of rectangles that leave different ends unseen those are taken that leave most, unless they weigh next to nothing:
whichever weighs most would show a side wherever noise looks like one. (But where the heading is all but open, those
that weigh most: a pedestrian seen across a corner is no wide side.) Usual sizes say nothing of a size that is
unseen, but of what the error e of a heading does to the middle behind it: a size s, put at m +- d, turns by e, so that
(m e)^2 + (d e)^2 along dj / da is in the noise."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.laser_beams import Laser, Sweep
from experiments.scenarios.laser_boxes import FEWEST, GAP, beams_of, points_of
from models.objects.outline import UNSEEN

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
GRAZING = 1e-3  # a side is seen by beams that meet it at a larger angle than this [rad]
POSSIBLE = 0.02  # weight from which on it is believed that more ends are unseen
TURNED = 0.25  # where headings are told worse than this, sides are not told apart, either [rad]
APART = 5.0  # to the next point, of clusters of fewer than three: a part of a side that beams graze is nearer [m]
OPEN = 5.0  # how wide a corner is where something hides it, to weigh it by [m]
NUM, WIDE, SHARP = 90, 5.0, 4.0  # headings at once, spread over so many deviations; steps that resolve one
USUAL = np.array([(1.2, 1.2), (3.0, 4.5), (np.inf, 1.8)])  # a side shorter than this; the other one's usual size [m]
# The d of an unseen size. A filter whose heading is another than that of the fit takes the difference of the two
# directions without information for information: of sixty scans of a rear, a length known to .5 m comes out at .31 m
# (at .28 m with d = 4, .27 m with 15, and .5 m would be right).
ASTRAY = 8.0
LEAST = 1e-3  # nothing is known better: keeps covariances invertible beside UNSEEN [m]
LONGEST = 20.0  # of a side, as it seems where beams graze it [m]
ODD = 6.0  # standard deviations of the sum of squares beyond which points are no rectangle


class Outlines(NamedTuple):
    """M measurements (M, 5) of models.objects.outline, and their covariances (M, 5, 5)."""

    values: Floats
    noise: Floats


class Corners(NamedTuple):
    """P rectangles: turned by a (P,), with the corner (P, 2) before point k (P,), of covariance (P, 2, 2), log weight
    (P,), and sum of squares (P,)."""

    a: Floats
    k: Ints
    corner: Floats
    covariance: Floats
    log_weight: Floats
    squares: Floats


def outlines(sweep: Sweep, laser: Laser) -> Outlines:
    """The outline of each cluster that shows an end at least and has the shape of a rectangle. Those of one or two
    points are used where nothing else is near: else small objects far away are seen when they seem large only."""
    padded = np.concatenate([[0.0], sweep.distance, [0.0]])
    found = list[tuple[Floats, Floats]]()
    for beams in beams_of(sweep):
        hidden = (padded[beams[0]] < sweep.distance[beams[0]], padded[beams[-1] + 2] < sweep.distance[beams[-1]])
        if all(hidden) or (len(beams) < FEWEST and not alone(sweep, beams)):
            continue
        fit = fit_outline(sweep.bearing[beams], sweep.distance[beams], laser, hidden)
        if fit is not None:
            found.append(fit)
    if not found:
        return Outlines(np.zeros((0, 5)), np.zeros((0, 5, 5)))
    values, noise = (np.array(part) for part in zip(*found, strict=True))
    return Outlines(values, noise)


def alone(sweep: Sweep, beams: Ints) -> bool:
    """Whether nothing else is near, of which the points of these beams may be a part."""
    others = np.setdiff1d(np.flatnonzero(np.isfinite(sweep.distance)), beams)
    gap = points_of(sweep, others)[:, None] - points_of(sweep, beams)
    return bool(np.hypot(gap[..., 0], gap[..., 1]).min(initial=np.inf) > APART)


def fit_outline(
    bearing: Floats, distance: Floats, laser: Laser, hidden: tuple[bool, bool] = (False, False)
) -> tuple[Floats, Floats] | None:
    """Measurement (5,) and covariance (5, 5) of points at rising bearings (n,); `hidden` right and left ends are none.
    None where the points are no rectangle."""
    middle, half = float(bearing.mean()), math.pi / 4
    a = middle - half
    while True:
        headings = a + half * (2 * np.arange(NUM) + 1 - NUM) / NUM
        found = corners(headings, bearing, distance, laser, hidden)
        if not len(found.a):
            return None
        weight = np.exp(found.log_weight - found.log_weight.max())
        weight /= weight.sum()
        best = float(found.a[weight.argmax()])
        spread = math.sqrt(weight @ np.square(found.a - best))
        step = 2 * half / NUM
        centred = abs(best - a) < 0.5 * half
        if centred and (spread > SHARP * step or half < 1e-7):
            break
        a = best
        half = max(WIDE * spread, 2 * step) if centred or half < math.pi / 4 else half
        half = min(half, math.pi / 4)
    num = len(bearing)
    if found.squares[weight.argmax()] > num + ODD * math.sqrt(2 * num):
        return None
    keep = weight > 1e-6
    return measured(Corners(*(part[keep] for part in found)), weight[keep], bearing, laser, hidden)


def corners(a: Floats, bearing: Floats, distance: Floats, laser: Laser, hidden: tuple[bool, bool]) -> Corners:
    """All rectangles at headings a (A,): with k = 0 ... n points right of the corner."""
    std = laser.range_std
    psi = bearing - a[:, None]
    left, right = np.cos(psi), np.sin(psi)  # (A, n)
    zero = np.zeros((len(a), 1))

    def summed(value: NDArray[Any]) -> Floats:
        return np.concatenate([zero, np.cumsum(value, 1)], 1)  # (A, n + 1)

    with np.errstate(divide="ignore", over="ignore"):
        sums = [summed(v) for v in (1 / np.square(right), distance / right)]
        rest = [summed(v[:, ::-1])[:, ::-1] for v in (1 / np.square(left), distance / left)]
    possible = (summed((right <= GRAZING) * 1.0) == 0.0) & (summed((left <= GRAZING)[:, ::-1] * 1.0)[:, ::-1] == 0.0)
    row, k = np.nonzero(possible)
    (info2, rhs2), (info1, rhs1) = ((v[possible] / std**2 for v in part) for part in (sums, rest))
    edge = np.concatenate([[bearing[0] - laser.step], bearing, [bearing[-1] + laser.step]])
    reach = np.concatenate([distance[:1], distance, distance[-1:]])
    wide = np.diff(edge) * np.minimum(reach[1:], reach[:-1]) / math.sqrt(12)
    wide[[0, -1]] = np.where(hidden, OPEN, wide[[0, -1]])
    at = (0.5 * (edge[1:] + edge[:-1]))[k] - a[row]
    p, cos, sin = 1 / np.square(wide[k]), np.cos(at), np.sin(at)
    info1, info2, cross = info1 + p * sin**2, info2 + p * cos**2, -p * sin * cos
    det = info1 * info2 - cross**2
    covariance = np.stack([np.stack([info2, -cross], -1), np.stack([-cross, info1], -1)], -2) / det[:, None, None]
    corner = (covariance @ np.stack([rhs1, rhs2], -1)[..., None])[..., 0]
    squares = np.square(distance / std).sum() - rhs1 * corner[:, 0] - rhs2 * corner[:, 1]
    return Corners(a[row], k, corner, covariance, -0.5 * squares - 0.5 * np.log(det), squares)


def measured(
    found: Corners, weight: Floats, bearing: Floats, laser: Laser, hidden: tuple[bool, bool]
) -> tuple[Floats, Floats]:
    """The measurement and its covariance of weighted rectangles (P,)."""
    num, a, k = len(bearing), found.a, found.k
    ends = np.stack([bearing[-1] + 0.5 * laser.step - a, math.pi / 2 - (bearing[0] - 0.5 * laser.step - a)], -1)
    near = found.corner  # (P, 2): left side, which ends across a, and right side, which ends along it
    with np.errstate(over="ignore", invalid="ignore"):
        slope = np.tan(ends)
        gap = np.abs(near) * laser.step / np.square(np.cos(ends))
    points = np.stack([num - k, k], -1)
    seen = (points >= min(num, 2)) & (np.cos(ends) > GRAZING) & (gap < 0.5 * GAP) & ~np.array(hidden[::-1])
    far_seen = (near * slope)[:, ::-1]  # (P, 2) along a, across it
    # what nobody sees: far ends along a and across it, and near sides without points that something hides
    unseen = np.concatenate([~seen[:, ::-1], (points == 0) & np.array([hidden[1], hidden[0]])], 1)
    code = unseen @ (1 << np.arange(4))
    share = np.bincount(code, weight, minlength=16)
    open_ends = np.array([i.bit_count() for i in range(16)])
    sure = math.sqrt(weight @ np.square(a - a[weight.argmax()])) < TURNED
    chosen = int(np.lexsort((share, np.where(share > POSSIBLE, open_ends, -1) * sure))[-1])
    own = code == chosen
    a, near, far_seen, slope, gap = a[own], near[own], far_seen[own], slope[own], gap[own]
    weight, open_end = weight[own] / weight[own].sum(), unseen[own][0]
    with np.errstate(invalid="ignore"):
        longest = np.where(points[own][:, ::-1] > 1, np.clip(far_seen - near, 0.0, LONGEST), 0.0)  # of sides, as seen
    usual = USUAL[np.searchsorted(USUAL[:, 0], weight @ longest)[::-1], 1]
    far = np.where(open_end[:2], near + np.maximum(usual, longest), far_seen)
    # faces (near along, near across, far along, far across) are linear in the corner
    faces = np.zeros((len(a), 4, 2))
    faces[:, 0, 0] = faces[:, 1, 1] = 1.0
    faces[:, 2, 1], faces[:, 3, 0] = (slope * ~open_end[1::-1]).T[::-1]
    faces[:, 2, 0], faces[:, 3, 1] = open_end[:2]
    noise = faces @ found.covariance[own] @ faces.swapaxes(1, 2)
    noise[:, [2, 3], [2, 3]] += np.where(open_end[:2], 0.0, np.square(gap[:, ::-1]) / 12)
    shape = shape_of(a)
    each = (shape @ np.concatenate([near, far], 1)[..., None])[..., 0]
    mean = weight @ each
    off = each - mean
    covariance = np.einsum("p,pij->ij", weight, shape @ noise @ shape.swapaxes(1, 2) + off[:, :, None] * off[:, None])
    best = weight.argmax()
    turned = weight @ np.square(a - a[best])
    for i in np.flatnonzero(open_end):
        j = shape[best][:, (2, 3, 0, 1)[i]]
        dj = (shape_of(a[best : best + 1] + 1e-4) - shape_of(a[best : best + 1] - 1e-4))[0, :, (2, 3, 0, 1)[i]] / 2e-4
        covariance += UNSEEN**2 * np.outer(j, j) + ASTRAY**2 * turned * np.outer(dj, dj)
    return mean, 0.5 * (covariance + covariance.T) + LEAST**2 * np.eye(5)


def shape_of(a: Floats) -> Floats:
    """(P, 5, 4) what faces (near along a, near across it, far along it, far across it) have to do with middle and
    tensor."""
    cos, sin, zero = np.cos(a), np.sin(a), np.zeros_like(a)
    u = np.stack([cos / 2, sin / 2, cos**2, cos * sin, sin**2], -1)
    v = np.stack([-sin / 2, cos / 2, sin**2, -cos * sin, cos**2], -1)
    sign = np.stack([zero + 1, zero + 1, zero - 1, zero - 1, zero - 1], -1)
    return np.stack([u * sign, v * sign, u, v], -1)
