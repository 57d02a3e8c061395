"""Courses of lanes between their straight stubs: the family of the model, and others that are not.

    bezier    cubic Bezier curves; the handles are those of a circular arc through both ends,
              h = |P3 - P0| (2/3) tan(th/4) / sin(th/2) for a turn of th, each stretched by U(0.85, 1.15)
    clothoid  straight, clothoid, circular arc, clothoid, straight; the clothoids are U(0.2, 0.9) of the curve
    bumps     the same, pushed to the left by sin^2(pi x) (a + 1.5 b cos(pi x)), a and b ~ N(0, 0.4 m),
              x from 0 to 1 along the interior; none where it is shorter than 5 m

Where one bend does not join two stubs (turns below 20 degrees and lane changes, a fifth of the lanes), a Bezier curve
takes the place of the clothoids. The papers do not publish their interiors: all three are ours. The last two are
deliberate misspecification.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from experiments.scenarios import paths
from experiments.scenarios.scene import Floats

Kind = Literal["bezier", "clothoid", "bumps"]

POINTS = 401  # of a course
STRETCH = (0.85, 1.15)  # of Bezier handles
SHARE = (0.2, 0.9)  # of clothoids in the length of a curve
GENTLEST = np.radians(20.0)  # turn that a clothoid is drawn for
SHORTEST = 3.0  # from an end of the interior to where the axes of its stubs meet [m]
BUMP_STD = 0.4  # [m]
LEVEL = 5.0  # length below which an interior has no bumps: they would be kinks [m]


class Ends(NamedTuple):
    """Where an interior begins and ends (2,) [m], unit directions of travel there (2,), and the turn between [rad]."""

    start: Floats
    end: Floats
    ahead: Floats
    away: Floats
    turn: float


def draw(kind: Kind, ends: list[Ends], rng: np.random.Generator) -> list[Floats]:
    """One course (401, 2) for each interior. Every kind draws what the ones before it draw, then its own."""
    stretches = rng.uniform(*STRETCH, (len(ends), 2))
    courses = [bezier(e, stretch) for e, stretch in zip(ends, stretches, strict=True)]
    if kind == "bezier":
        return courses
    shares = rng.uniform(*SHARE, len(ends))
    courses = [clothoid(e, s) if fits(e) else course for e, s, course in zip(ends, shares, courses, strict=True)]
    if kind == "clothoid":
        return courses
    heights = BUMP_STD * rng.standard_normal((len(ends), 2))
    return [bumped(course, height) for course, height in zip(courses, heights, strict=True)]


def bezier(ends: Ends, stretch: Floats) -> Floats:
    """The Bezier course with its two handles stretched by (2,)."""
    p0, p3 = ends.start, ends.end
    turn = max(abs(ends.turn), 1e-3)  # the limit of a straight crossing is 1/3
    handle = np.linalg.norm(p3 - p0) * (2 / 3) * np.tan(turn / 4) / np.sin(turn / 2)
    p1 = p0 + handle * stretch[0] * ends.ahead
    p2 = p3 - handle * stretch[1] * ends.away
    u = np.linspace(0.0, 1.0, POINTS)[:, None]
    return (1 - u) ** 3 * p0 + 3 * u * (1 - u) ** 2 * p1 + 3 * u**2 * (1 - u) * p2 + u**3 * p3


def fits(ends: Ends) -> bool:
    """Whether one bend of 20 degrees or more joins the stubs, their axes meeting 3 m or more inside of both."""
    return bool(abs(ends.turn) > GENTLEST and min(_to_corner(ends)) > SHORTEST)


def clothoid(ends: Ends, share: float) -> Floats:
    """The course of one symmetric bend, `share` of its length being clothoids.

    The bend uses up the shorter distance to the corner where the axes of the stubs meet; what is left of the other
    is straight, so that every lane has an onset of its own."""
    before, behind = _to_corner(ends)
    tangent = min(before, behind)
    unit, length = _unit_bend(ends.turn, share)
    left = np.array([-ends.ahead[1], ends.ahead[0]])
    bend = unit * (tangent / length) @ np.stack([ends.ahead, left])
    points = np.concatenate([ends.start[None], ends.start + (before - tangent) * ends.ahead + bend, ends.end[None]])
    return paths.at(points, np.linspace(0.0, paths.arc_length(points)[-1], POINTS))


def bumped(course: Floats, height: Floats) -> Floats:
    """The course pushed sideways by two waves of the given heights (2,) [m]; its ends and directions there stay."""
    along = paths.arc_length(course)
    if along[-1] < LEVEL:
        return course
    x = np.pi * along / along[-1]
    push = np.sin(x) ** 2 * (height[0] + 1.5 * height[1] * np.cos(x))
    heading = paths.headings(course)
    return course + push[:, None] * np.stack([-np.sin(heading), np.cos(heading)], axis=1)


def _to_corner(ends: Ends) -> Floats:
    """Distances from both ends forward, and backward, to where the axes of the stubs meet, (2,) [m]."""
    return np.asarray(np.linalg.solve(np.stack([ends.ahead, ends.away], axis=1), ends.end - ends.start))


def _unit_bend(turn: float, share: float) -> tuple[Floats, float]:
    """Bend of unit length out of the x-axis, (401, 2), and the distance from its ends to the corner.

    Its curvature rises from 0, stays and falls back to 0 linearly."""
    s = np.linspace(0.0, 1.0, POINTS)
    curvature = np.interp(s, [0.0, share / 2, 1 - share / 2, 1.0], [0.0, 1.0, 1.0, 0.0])
    heading = np.cumsum(np.concatenate([[0.0], curvature[1:] + curvature[:-1]]))
    heading *= turn / heading[-1]
    middle = (heading[1:] + heading[:-1]) / 2
    steps = np.stack([np.cos(middle), np.sin(middle)], axis=1) / (POINTS - 1)
    points = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return points, float(points[-1, 1] / np.sin(turn))
