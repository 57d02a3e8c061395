"""The clothoid of least squares through noisy points, batched.

    minimise sum_i d_i^2,   d_i the offset of point i to the left of the clothoid, at its foot l_i

Across itself a clothoid has four degrees of freedom; where on the line it starts is convention. So the unknowns are
z = (offset, heading, curvature, rate) at the start, which moves to its left only. The feet minimise every d_i, so with
n the normal at the foot and n_0 that at the start

    dd_i/dz = -n . (n_0, integral over [0, l_i] of (1, u, u^2 / 2) (-sin, cos)(heading(u)) du)

From a coarse line through means of consecutive points, Gauss-Newton steps, shortened while they do not help.
Covariance of z: std^2 (J^T J)^-1, with std given, or estimated as sqrt(sum d^2 / (N - 4)).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from models.clothoid import Clothoid, Points, evaluate, foot_step, integrals, wrap_angle
from models.program import InputError

UNKNOWNS = 4
MEANS = 8  # of consecutive points, corners of the coarse line
MAX_STEPS, FOOT_STEPS = 60, 2
SETTLED = 1e-9  # of z in units of the coarse line
ROUNDING = 1e-5  # smaller steps that do not help are stopped by rounding
MAX_LENGTH = 2.0  # of what is found, in coarse lines


class ClothoidFit(NamedTuple):
    """Clothoids through points, from the first foot to the last.

    covariance  (*B, 4, 4) of the line at its start: offset to the left [m], heading [rad], curvature [1/m],
                rate [1/m^2]
    std         (*B) of the points across the line [m], given or estimated
    arc         (*B, N) arc lengths of the feet [m]
    offset      (*B, N) of the points to the left of the line [m]
    """

    clothoid: Clothoid
    covariance: Tensor
    std: Tensor
    arc: Tensor
    offset: Tensor


def fit(points: Tensor, std: float | None = None) -> ClothoidFit:
    """The clothoids nearest to points (*B, N, 2) [m] in the order of travel, whose errors across the line are
    independent, N(0, std^2) [m]. Four points are enough; without `std` it is estimated, from five.

    Raises InputError for fewer points, values that are not finite, points that stand still or turn back, and where no
    clothoid of a sane length settles."""
    _check(points, std)
    origin = points[..., 0, :].double()  # near zero, far places round no worse
    points = points.double() - origin[..., None, :]
    line, arc = _coarse(points)
    size = line.length
    scale = size[..., None] ** (1.0 - torch.arange(UNKNOWNS, dtype=torch.float64))  # z / scale are plain numbers
    line, arc = _descend(line, points, arc, scale)
    line, arc = _cut(line, arc)
    _refuse(
        ~(line.length < MAX_LENGTH * size), "is followed only by a clothoid that winds", "fit fewer points at a time"
    )
    arc, offset = _feet(line, points, arc)
    if std is None:
        found = offset.norm(dim=-1) / math.sqrt(points.shape[-2] - UNKNOWNS)
    else:
        found = torch.full(size.shape, std, dtype=torch.float64)
    slopes = _slopes(line, arc) * scale[..., None, :]
    factor, failed = torch.linalg.cholesky_ex(slopes.mT @ slopes)
    _refuse(failed > 0, "has points at fewer than four places along its line", "give more of them")
    covariance = torch.cholesky_inverse(factor) * scale[..., None] * scale[..., None, :]
    line = line._replace(x=line.x + origin[..., 0], y=line.y + origin[..., 1])
    return ClothoidFit(line, covariance * found[..., None, None] ** 2, found, arc, offset)


def _descend(line: Clothoid, points: Tensor, arc: Tensor, scale: Tensor) -> tuple[Clothoid, Tensor]:
    """The lines of least squares and the feet on them."""
    arc, offset = _feet(line, points, arc)
    share, settled = torch.ones_like(line.length), torch.zeros_like(line.length, dtype=torch.bool)
    for _ in range(MAX_STEPS):
        slopes = _slopes(line, arc) * scale[..., None, :]
        step = torch.linalg.lstsq(slopes, -offset[..., None]).solution[..., 0]
        width = step.abs().amax(-1)
        settled = settled | (width * share < SETTLED)
        trial = _moved(line, step * scale * share[..., None])
        trial_arc, trial_offset = _feet(trial, points, arc)
        better = trial_offset.norm(dim=-1) < offset.norm(dim=-1)
        line = Clothoid(*(torch.where(better, new, old) for new, old in zip(trial, line, strict=True)))
        arc = torch.where(better[..., None], trial_arc, arc)
        offset = torch.where(better[..., None], trial_offset, offset)
        if settled.all():
            break
        share = torch.where(better, 1.0, share / 2.0)
    _refuse(
        ~(width < ROUNDING), "settles at no clothoid", "check that its points follow one bend in the order of travel"
    )
    return line, arc


def _feet(line: Clothoid, points: Tensor, arc: Tensor) -> tuple[Tensor, Tensor]:
    """Feet found from `arc` and the offsets of the points there, (*B, N) each; the clothoid goes on beyond its ends."""
    most = line.length[..., None] / MEANS
    for _ in range(FOOT_STEPS):
        step, _ = foot_step(points, evaluate(line, arc))
        arc = arc + step.clamp(-most, most)
    return arc, foot_step(points, evaluate(line, arc))[1]


def _slopes(line: Clothoid, arc: Tensor) -> Tensor:
    """dd/dz at feet `arc`, (*B, N, 4)."""
    turn = line.curvature[..., None] * arc + 0.5 * line.rate[..., None] * arc**2
    heading = (line.heading[..., None] + turn)[..., None]
    x, y = integrals(line, arc, UNKNOWNS - 1)
    return -torch.cat((torch.cos(turn)[..., None], torch.sin(heading) * y + torch.cos(heading) * x), -1)


def _moved(line: Clothoid, z: Tensor) -> Clothoid:
    """The lines changed by z (*B, 4)."""
    offset, heading, curvature, rate = z.unbind(-1)
    return Clothoid(
        line.x - offset * torch.sin(line.heading),
        line.y + offset * torch.cos(line.heading),
        line.heading + heading,
        line.curvature + curvature,
        line.rate + rate,
        line.length,
    )


def _cut(line: Clothoid, arc: Tensor) -> tuple[Clothoid, Tensor]:
    """The lines from their first foot to their last, and the feet on them."""
    first = arc.amin(-1)
    at = Points(*(number[..., 0] for number in evaluate(line, first[..., None])))
    cut = Clothoid(at.x, at.y, wrap_angle(at.heading), at.curvature, line.rate, arc.amax(-1) - first)
    return cut, arc - first[..., None]


def _coarse(points: Tensor) -> tuple[Clothoid, Tensor]:
    """Clothoids along the lines through means of consecutive points, and the arc lengths of all points on them.

    The headings of the legs are regressed on 1, l and l^2 / 2."""
    parts = torch.tensor_split(points, min(MEANS, points.shape[-2]), -2)
    corners = torch.stack([part.mean(-2) for part in parts], -2)
    legs = corners.diff(dim=-2)
    back = ((legs[..., 1:, :] * legs[..., :-1, :]).sum(-1) <= 0.0).any(-1)
    advice = "give points in the order of travel, and more of them where they bend or lie within their noise"
    _refuse(back, "has points that stand still or turn back", advice)
    lengths, headings = legs.norm(dim=-1), torch.atan2(legs[..., 1], legs[..., 0])
    turns = torch.nn.functional.pad(wrap_angle(headings.diff()).cumsum(-1), (1, 0))
    arc = torch.nn.functional.pad(lengths.cumsum(-1), (1, 0))
    middle = (arc[..., 1:] + arc[..., :-1]) / 2.0
    powers = torch.stack((middle**0, middle, middle**2 / 2.0), -1)
    heading, curvature, rate = torch.linalg.lstsq(powers, turns[..., None]).solution[..., 0].unbind(-1)
    start = corners[..., 0, :]
    line = Clothoid(start[..., 0], start[..., 1], headings[..., 0] + heading, curvature, rate, arc[..., -1])
    on = evaluate(line, arc)
    left = (corners[..., 0] - on.x).mean(-1), (corners[..., 1] - on.y).mean(-1)
    line = line._replace(x=line.x + left[0], y=line.y + left[1])
    arcs = []
    for i, part in enumerate(parts):
        way = part - corners[..., i : i + 1, :]
        angle = on.heading[..., i : i + 1]
        arcs.append(arc[..., i : i + 1] + way[..., 0] * torch.cos(angle) + way[..., 1] * torch.sin(angle))
    return line, torch.cat(arcs, -1)


def _refuse(failed: Tensor, what: str, advice: str) -> None:
    if failed.any():
        where = "".join(f"[{i}]" for i in failed.nonzero()[0].tolist())
        raise InputError(f"the clothoid fit{where} {what}; {advice}")


def _check(points: Tensor, std: float | None) -> None:
    if points.ndim < 2 or points.shape[-1] != 2:
        raise InputError(f"a clothoid is fitted to points of shape (*B, N, 2), but these are {tuple(points.shape)}")
    needed = UNKNOWNS + (std is None)
    if points.shape[-2] < needed:
        more = ", or four and their std" if std is None else ""
        raise InputError(f"a clothoid fit needs {needed} points{more}, but has {points.shape[-2]}")
    if std is not None and not 0.0 < std < math.inf:
        raise InputError(f"std of a clothoid fit is {std} m; give a positive number, or none to estimate it")
    broken = ~points.isfinite().all(-1)
    if broken.any():
        which = broken.nonzero()[0].tolist()
        raise InputError(f"point {which} of a clothoid fit is {tuple(points[tuple(which)].tolist())}; leave it out")
