"""Clothoids, batched and differentiable twice: a G1 Hermite fit, evaluation, samples, projection.

    heading(l) = heading + curvature l + rate l^2 / 2
    (x, y)(l)  = (x, y) + integral over [0, l] of (cos, sin)(heading(u)) du

Hermite fit, Bertolazzi and Frego (2013), "G1 fitting with clothoids": with p and q the headings of start and end
against the chord, both in [-pi, pi), and t = l / length, the one unknown is the bow A of

    angle(t) = A (t^2 - t) + (q - p) t + p,       integral over [0, 1] of sin(angle) dt = 0
    length   = chord / integral of cos(angle) dt,  curvature = (q - p - A) / length,  rate = 2 A / length^2

Newton's steps from their guess settle for every p and q. Derivatives are those of the root: the steps are run on
detached numbers, then twice more on attached ones; one attached step makes first derivatives exact, two the second.

Everything is torch, float64, in metres and radians; a clothoid has any batch shape B.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from models.clothoid_kernel import MAX_STRETCH, MIN_CHORD, NODES, WEIGHTS, guess_bow
from models.program import InputError

T, W = torch.from_numpy(NODES), torch.from_numpy(WEIGHTS)
BOW = T * T - T
DETACHED_STEPS = 3  # bring the bow within 3e-11 of the root, for any headings
ATTACHED_STEPS = 2


class Clothoid(NamedTuple):
    """Start x, y [m] and heading [rad], curvature there [1/m], its rate along the line [1/m^2], length [m]; (*B) each.

    A length of inf marks ends that no sane clothoid joins, see `hermite_or_inf`."""

    x: Tensor
    y: Tensor
    heading: Tensor
    curvature: Tensor
    rate: Tensor
    length: Tensor


class Points(NamedTuple):
    """Points of a clothoid: x, y [m], heading [rad], not wrapped, curvature [1/m]; (*B, N) each."""

    x: Tensor
    y: Tensor
    heading: Tensor
    curvature: Tensor


def hermite(start: Tensor, end: Tensor) -> Clothoid:
    """The clothoid from start (*B, 3) to end (*B, 3), rows (x, y, heading).

    Raises InputError for the first pair that is not finite, has no distance, or that only a clothoid longer than
    MAX_STRETCH chords would join. A density calls `hermite_or_inf`, which raises for no value."""
    found = hermite_or_inf(start, end)
    refused = torch.isinf(found.length)
    if refused.any():
        raise InputError(_refusal(start, end, refused))
    return found


def hermite_or_inf(start: Tensor, end: Tensor) -> Clothoid:
    """As `hermite`, but pairs that it refuses get length inf, curvature and rate 0, and no gradient: mask by the
    length before use."""
    ends = torch.cat(torch.broadcast_tensors(start, end), -1)
    dx, dy = ends[..., 3] - ends[..., 0], ends[..., 4] - ends[..., 1]
    chord = torch.hypot(dx, dy).detach()
    usable = ends.isfinite().all(-1) & chord.isfinite() & (chord > MIN_CHORD)
    dx, dy = torch.where(usable, dx, 1.0), torch.where(usable, dy, 0.0)  # a gradient of nan would spread
    along = torch.atan2(dy, dx)
    p = _wrap(torch.where(usable, ends[..., 2], 0.0) - along)
    q = _wrap(torch.where(usable, ends[..., 5], 0.0) - along)
    bow = _newton(guess_bow.py_func(p, q).detach(), p.detach(), q.detach(), DETACHED_STEPS)
    bow = _newton(bow, p, q, ATTACHED_STEPS)
    shrink = torch.cos(_angles(bow, p, q)) @ W
    usable = usable & (shrink.detach() * MAX_STRETCH >= 1.0)
    length = torch.hypot(dx, dy) / torch.where(usable, shrink, 1.0)
    curvature, rate = (q - p - bow) / length, 2.0 * bow / length**2
    return Clothoid(
        ends[..., 0],
        ends[..., 1],
        ends[..., 2],
        torch.where(usable, curvature, 0.0),
        torch.where(usable, rate, 0.0),
        torch.where(usable, length, torch.inf),
    )


def evaluate(clothoid: Clothoid, arc: Tensor) -> Points:
    """Points at arc lengths `arc` (*B, N) [m], which may lie before the start and beyond the end: the clothoid goes on.

    Gauss-Legendre integration from the start, good to 1e-9 of the arc length while it turns by less than 4 pi."""
    heading, curvature = _direction(clothoid, arc)
    dx, dy = integrals(clothoid, arc)
    return Points(clothoid.x[..., None] + dx[..., 0], clothoid.y[..., None] + dy[..., 0], heading, curvature)


def integrals(clothoid: Clothoid, arc: Tensor, num: int = 1) -> tuple[Tensor, Tensor]:
    """Integrals over [0, l] of u^k / k! (cos, sin)(heading(u)) du for k < num: two tensors (*B, N, num).

    k = 0 is the way from the start; (-sin, cos) of k = 0, 1, 2 are the slopes of (x, y)(l) in heading, curvature and
    rate."""
    angle, _ = _direction(clothoid, (arc[..., None] * T).flatten(-2))
    angle = angle.unflatten(-1, (-1, len(T)))  # (*B, N, nodes)
    k = torch.arange(num)
    weights = W[:, None] * T[:, None] ** k / torch.tensor([math.factorial(j) for j in range(num)])
    scale = arc[..., None] ** (k + 1)
    return torch.cos(angle) @ weights * scale, torch.sin(angle) @ weights * scale


def sample(clothoid: Clothoid, num: int) -> Points:
    """`num` >= 2 points at equal steps of arc length, both ends included: (*B, num).

    Cumulative Simpson integration: quicker than `evaluate` and off by (turn per step)^4 / 2880 of the length at most,
    3e-7 m on roads at steps of 2 m."""
    fine = clothoid.length[..., None] * torch.linspace(0.0, 1.0, 2 * num - 1, dtype=torch.float64)
    heading, curvature = _direction(clothoid, fine)
    sixth = clothoid.length[..., None] / (6 * (num - 1))
    x = clothoid.x[..., None] + _simpson(torch.cos(heading)) * sixth
    y = clothoid.y[..., None] + _simpson(torch.sin(heading)) * sixth
    return Points(x, y, heading[..., ::2], curvature[..., ::2])


def _direction(clothoid: Clothoid, arc: Tensor) -> tuple[Tensor, Tensor]:
    """Heading and curvature at arc (*B, N)."""
    curvature, turn = clothoid.curvature[..., None], clothoid.rate[..., None] * arc
    return clothoid.heading[..., None] + arc * (curvature + 0.5 * turn), curvature + turn


def _simpson(values: Tensor) -> Tensor:
    """Integrals from the first of (..., 2 n + 1) values to every other one, in sixths of their step: (..., n + 1)."""
    steps = values[..., :-1:2] + 4.0 * values[..., 1::2] + values[..., 2::2]
    return torch.nn.functional.pad(steps.cumsum(-1), (1, 0))


def _wrap(angle: Tensor) -> Tensor:
    """An angle in [-pi, pi)."""
    return angle - 2.0 * math.pi * torch.floor(angle / (2.0 * math.pi) + 0.5)


def _angles(bow: Tensor, p: Tensor, q: Tensor) -> Tensor:
    """angle(t) at the nodes, (*B, nodes)."""
    return bow[..., None] * BOW + (q - p)[..., None] * T + p[..., None]


def _newton(bow: Tensor, p: Tensor, q: Tensor, steps: int) -> Tensor:
    for _ in range(steps):
        angle = _angles(bow, p, q)
        bow = bow - (torch.sin(angle) @ W) / (torch.cos(angle) @ (W * BOW))
    return bow


def _refusal(start: Tensor, end: Tensor, refused: Tensor) -> str:
    """What is wrong with the first of the refused pairs."""
    which = tuple(refused.nonzero()[0].tolist())
    rows = [ends.detach().expand(*refused.shape, 3)[which].tolist() for ends in (start, end)]
    where = "".join(f"[{i}]" for i in which)
    for name, row in zip(("start", "end"), rows, strict=True):
        if not all(map(math.isfinite, row)):
            return f"{name}{where} of a clothoid is {tuple(row)}; give finite x, y [m] and heading [rad]"
    (x0, y0, heading0), (x1, y1, heading1) = rows
    chord = math.hypot(x1 - x0, y1 - y0)
    if not MIN_CHORD < chord < math.inf:
        return (
            f"clothoid{where} from ({x0:g}, {y0:g}) has its end {chord:g} m away; more than {MIN_CHORD:g} m is needed"
        )
    along = math.atan2(y1 - y0, x1 - x0)
    p, q = (math.degrees(math.remainder(h - along, 2 * math.pi)) for h in (heading0, heading1))
    return (
        f"clothoid{where} from ({x0:g}, {y0:g}) to ({x1:g}, {y1:g}) with headings {p:.1f} and {q:.1f} degrees off its "
        f"chord would be more than {MAX_STRETCH:g} chords long; turn a heading, or join the ends by two clothoids"
    )
