"""Clothoids, batched and differentiable twice: a G1 Hermite fit, evaluation, samples, projection.

    heading(l) = heading + curvature l + rate l^2 / 2
    (x, y)(l)  = (x, y) + integral over [0, l] of (cos, sin)(heading(u)) du

Hermite fit, Bertolazzi and Frego (2013), "G1 fitting with clothoids": with p and q the headings of start and end
against the chord, both in [-pi, pi), and t = l / length, the one unknown is the bow A of

    angle(t) = A (t^2 - t) + (q - p) t + p,       integral over [0, 1] of sin(angle) dt = 0
    length   = chord / integral of cos(angle) dt,  curvature = (q - p - A) / length,  rate = 2 A / length^2

With g the first integral, h the second, both of A, and their derivatives from the same sines and cosines, Halley's step
-2 g g' / (2 g'^2 - g g'') cubes the error: from their guess two bring every p and q within 1e-10 of the root. These are
run on detached numbers; one more on attached ones has the root's own first and second derivatives, and h is carried
along it by its Taylor polynomial.

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
ANGLES = torch.stack((BOW, 1.0 - T, T))  # of bow, p and q
MOMENTS = W[:, None] * BOW[:, None] ** torch.arange(3)
FEET = 64  # samples that a projection starts from
FOOT_STEPS = 4
ATTACHED_STEPS = 2  # of Newton: one makes first derivatives exact, two the second
NEAR_CENTRE = 0.05  # of the radius: nearer to the centre of the circle Newton's step would run away


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
    p = wrap_angle(torch.where(usable, ends[..., 2], 0.0) - along)
    q = wrap_angle(torch.where(usable, ends[..., 5], 0.0) - along)
    bow = guess_bow.py_func(p, q).detach()
    for _ in range(2):
        bow, _ = _halley(bow, p.detach(), q.detach())
    bow, shrink = _halley(bow, p, q)
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

    Gauss-Legendre integration from the start: good to 1e-9 of the length on whatever `hermite` joins and a tenth of the
    length beyond its ends; many turns farther it is not."""
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
    u = torch.linspace(0.0, 1.0, 2 * num - 1, dtype=torch.float64)
    bend, twist = clothoid.curvature * clothoid.length, clothoid.rate * clothoid.length**2
    # products of small matrices: their one large result is the cheapest way to the headings
    heading = torch.stack((clothoid.heading, bend, twist), -1) @ torch.stack((u**0, u, u * u / 2.0))
    curvature = torch.stack((clothoid.curvature, clothoid.rate * clothoid.length), -1) @ torch.stack((u**0, u))[:, ::2]
    sixth = clothoid.length[..., None] / (6 * (num - 1))
    x = _simpson(clothoid.x, torch.cos(heading), sixth)
    return Points(x, _simpson(clothoid.y, torch.sin(heading), sixth), heading[..., ::2], curvature)


def project(clothoid: Clothoid, points: Tensor) -> tuple[Tensor, Tensor]:
    """Arc length of the foot of points (*B, N, 2), and their offset to the left of it: (*B, N) each [m].

    (point - foot) . tangent = 0, by Newton's steps from the nearest of FEET samples. Beyond its ends the clothoid goes
    on straight: such points get an arc length below 0 or above `length`, and the offset from the tangent there. A point
    as far off as the radius of the curve has no single foot, and near it one of several is found."""
    coarse = sample(Clothoid(*(number.detach() for number in clothoid)), FEET)
    px, py = points.detach().unbind(-1)
    gap = (px[..., None] - coarse.x[..., None, :]) ** 2 + (py[..., None] - coarse.y[..., None, :]) ** 2
    spacing = clothoid.length.detach()[..., None] / (FEET - 1)
    arc = gap.argmin(-1) * spacing
    with torch.no_grad():
        for _ in range(FOOT_STEPS):
            step, _ = foot_step(points, _continued(clothoid, arc))
            arc = arc + step.clamp(-spacing, spacing)
    arc = arc.detach()
    for _ in range(ATTACHED_STEPS):
        step, _ = foot_step(points, _continued(clothoid, arc))
        arc = arc + step
    return arc, foot_step(points, _continued(clothoid, arc))[1]


def foot_step(points: Tensor, at: Points) -> tuple[Tensor, Tensor]:
    """Newton's step along the line from `at` towards the feet of points (*B, N, 2), and their offset to the left of
    the tangents there: (*B, N) each."""
    dx, dy = points[..., 0] - at.x, points[..., 1] - at.y
    cos, sin = torch.cos(at.heading), torch.sin(at.heading)
    offset = dy * cos - dx * sin
    return (dx * cos + dy * sin) / (1.0 - at.curvature * offset).clamp(min=NEAR_CENTRE), offset


def _continued(clothoid: Clothoid, arc: Tensor) -> Points:
    """Points at arc (*B, N) of the clothoid with straight lines at its ends."""
    inside = arc.clamp(min=0.0).minimum(clothoid.length[..., None])
    at, beyond = evaluate(clothoid, inside), arc - inside
    x, y = at.x + beyond * torch.cos(at.heading), at.y + beyond * torch.sin(at.heading)
    return Points(x, y, at.heading, torch.where(beyond == 0.0, at.curvature, 0.0))


def _direction(clothoid: Clothoid, arc: Tensor) -> tuple[Tensor, Tensor]:
    """Heading and curvature at arc (*B, N)."""
    curvature, turn = clothoid.curvature[..., None], clothoid.rate[..., None] * arc
    return clothoid.heading[..., None] + arc * (curvature + 0.5 * turn), curvature + turn


def _simpson(first: Tensor, slopes: Tensor, sixth: Tensor) -> Tensor:
    """What grows from `first` (*B) with slopes (*B, 2 n + 1), at every other of them: (*B, n + 1).

    sixth  a sixth of the distance from one to the next but one, (*B, 1)"""
    steps = (torch.add(slopes[..., :-1:2], slopes[..., 1::2], alpha=4.0) + slopes[..., 2::2]) * sixth
    return torch.cat((first[..., None], steps), -1).cumsum(-1)


def wrap_angle(angle: Tensor) -> Tensor:
    """An angle in [-pi, pi)."""
    return angle - 2.0 * math.pi * torch.floor(angle / (2.0 * math.pi) + 0.5)


def _halley(bow: Tensor, p: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
    """A nearer bow and the chord over the length there."""
    angle = torch.stack((bow, p, q), -1) @ ANGLES  # (*B, nodes)
    g, minus_h1, minus_g2 = (torch.sin(angle) @ MOMENTS).unbind(-1)
    h, g1, minus_h2 = (torch.cos(angle) @ MOMENTS).unbind(-1)
    step = -2.0 * g * g1 / (2.0 * g1 * g1 + g * minus_g2)
    return bow + step, h - step * (minus_h1 + 0.5 * step * minus_h2)


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
