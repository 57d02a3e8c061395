"""How a point that moves along and across a reference line moves in the plane: the one home of these formulas.

The line has curvature kappa(s) and slope of curvature kappa'(s); the point is at arc length s, offset d to the left.
In the frame that moves along with the foot point (x ahead, y left; w = 1 - kappa d):

    v_x = s' w                                           v_y = d'
    a_x = s'' w - s' (kappa' s' d + kappa d') - kappa s' d'     a_y = d'' + kappa s'^2 w

so that the path has speed v = |(v_x, v_y)|, acceleration a_t = (v . a) / v along it, and v x a = kappa_path v^3.
The same numbers as Werling et al. (2010), appendix I, without his division by s' and cos of the heading.

An offset can also be told by arc length, d(s): slope p = dd/ds and bend q = d^2 d/ds^2, which a standing vehicle has
too. Then d' = p s' and d'' = q s'^2 + p s''.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any

from models.formula import Formula
from models.program import InputError

STILL = 1e-12  # under roots and in divisors: at rest, curvature counts as 0 and acceleration as along the line


def moving_frame(x: Sequence[Any]) -> tuple[Any, Any, Any, Any, Any]:
    """v_x, v_y, a_x, a_y, w of (s', s'', kappa, kappa', d, d', d'')."""
    ds, dds, kappa, slope, d, dd, ddd = x
    w = 1.0 - kappa * d
    turn = kappa * ds
    ahead = dds * w - ds * (slope * ds * d + kappa * dd) - turn * dd
    return ds * w, dd, ahead, ddd + turn * ds * w, w


def path(x: Sequence[Any], ops: Any) -> tuple[Any, Any, Any, Any]:
    """Speed v, acceleration along the path, v x a (that is kappa_path v^3), and w, of the same seven."""
    vx, vy, ax, ay, w = moving_frame(x)
    v = ops.sqrt(vx * vx + vy * vy + STILL)
    return v, (vx * ax + vy * ay) / v, vx * ay - vy * ax, w


def _told(x: Sequence[Any], p: Sequence[Any], ops: Any) -> tuple[Any, ...]:
    v, along, cross, w = path(x, ops)
    return v, along, cross / (v * v * v), w


KINEMATICS = Formula("kinematics", _told, 7)  # -> speed, acceleration along, curvature of the path, w


def _placed(x: Sequence[Any], p: Sequence[Any], ops: Any) -> tuple[Any, ...]:
    ds, kappa, d, dd, line_x, line_y, line_cos, line_sin = x
    vx = ds * (1.0 - kappa * d)
    squared = vx * vx + dd * dd
    moves = squared > STILL
    v = ops.sqrt(ops.where(moves, squared, 1.0))
    ahead, left = ops.where(moves, vx / v, 1.0), ops.where(moves, dd / v, 0.0)
    cos, sin = line_cos * ahead - line_sin * left, line_sin * ahead + line_cos * left
    return line_x - d * line_sin, line_y + d * line_cos, cos, sin


# (s', kappa, d, d'; x, y, cos theta, sin theta of the line) -> x, y, cos and sin of the heading; at rest the line's
PLACED = Formula("placed", _placed, 8)


@dataclass(frozen=True)
class Limits:
    """What a vehicle may do.

    speed                [m/s]
    acceleration         [m/s^2] at low speed; at higher speed
    power                [W/kg] per mass leaves power / v of it ([K15], section V: higher at low velocities)
    braking              [m/s^2]
    lateral_acceleration [m/s^2] ([K15]: 2)
    curvature            [1/m] of the path
    curvature_rate       [1/(m s)]
    """

    speed: float = 20.0
    acceleration: float = 3.0
    power: float = 25.0
    braking: float = 5.0
    lateral_acceleration: float = 2.0
    curvature: float = 0.2
    curvature_rate: float = 0.2

    def __post_init__(self) -> None:
        for name, value in zip(self.__dataclass_fields__, astuple(self), strict=True):
            if not 0.0 < value < float("inf"):
                raise InputError(f"limits: {name} is {value}, but must be positive and finite")


LIMITS = ("speed", "acceleration", "power", "braking", "lateral_acceleration", "curvature")  # p of MARGINS, in order
SLACK = 1e-6  # of each margin: rounding, and a vehicle at rest, break no limit

# what each margin guards, in the order of MARGINS
GUARDED = (
    "drives backwards",
    "leaves the reference line's normals",
    "speed",
    "acceleration",
    "power",
    "braking",
    "lateral acceleration",
    "lateral acceleration",
    "curvature",
    "curvature",
)
NARROWEST = 0.1  # of w: at 0 the centre of curvature of the line is reached, where normals meet


def _margins(x: Sequence[Any], p: Sequence[Any], ops: Any) -> tuple[Any, ...]:
    v, along, cross, w = path(x, ops)
    speed, acceleration, power, braking, lateral, curvature = p
    cube = v * v * v
    told = (
        x[0],
        w - NARROWEST,
        speed - v,
        acceleration - along,
        power - along * v,
        braking + along,
        lateral * v - cross,
        lateral * v + cross,
        curvature * cube - cross,
        curvature * cube + cross,
    )
    return (*(margin + SLACK for margin in told), v, cross / cube)


MARGINS = Formula("margins", _margins, 7, len(LIMITS))  # -> ten margins, then speed and curvature of the path
