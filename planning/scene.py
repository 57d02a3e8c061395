"""What a planning cycle plans in."""

from __future__ import annotations

import math
from numbers import Real
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.program import InputError
from planning.candidates import Goal, Keep, Reach
from planning.frenet import FrenetState
from planning.reference import ReferenceLine
from planning.shapes import Boundary, Obstacles, check_obstacles

Floats = NDArray[np.float64]
LARGEST = 1e6  # of what a state or a goal tells: powers of more overflow
BACKWARDS = 0.05  # a speed back that noise may tell of who stands [m/s]


class Scene(NamedTuple):
    """What a cycle plans in.

    line      the reference line; state along it
    goal      along the line
    offsets   (N,) targets of the offset, and the one wanted [m]
    boundary  lines not to touch (planning.shapes.boundary, with the planner's radius)
    obstacles predicted at the horizon's steps
    stop      arc length that the vehicle's front must not pass, e.g. a line without permission [m]
    stand     arc length before which the front must be able to stand after the horizon [m]
    """

    line: ReferenceLine
    state: FrenetState
    goal: Goal
    offsets: Floats
    wanted: float
    boundary: Boundary
    obstacles: Obstacles
    stop: float = math.inf
    stand: float = math.inf


PARTS: dict[str, tuple[type, ...]] = {
    "line": (ReferenceLine,),
    "state": (FrenetState,),
    "goal": (Keep, Reach),
    "boundary": (Boundary,),
    "obstacles": (Obstacles,),
}


def check(scene: Scene, radius: float, num_steps: int) -> None:
    """Raises InputError, in words, for a scene that no plan can be made for.

    radius     of the planner's circles, that boundary lines must be known to [m]
    num_steps  of its horizon, that obstacles must be predicted at"""
    for name, kinds in PARTS.items():
        if not isinstance(part := getattr(scene, name), kinds):
            words = " or ".join(kind.__name__ for kind in kinds)
            raise InputError(f"scene: {name} is of type {type(part).__name__}, but must be {words}")
    table = scene.line.table
    if np.ndim(table) != 2 or table.shape[1] != 5 or len(table) < 2 or not np.isfinite(table).all():
        raise InputError(f"the line's table has shape {np.shape(table)}, but must be finite and (2 or more, 5)")
    for name, value in zip(scene.state._fields, scene.state, strict=True):
        if not (isinstance(value, Real) and abs(value) < LARGEST):
            raise InputError(f"the vehicle's state has {name} = {value!r}, but must have a number")
    if scene.state.ds < -BACKWARDS:
        raise InputError(f"the vehicle drives backwards, at {scene.state.ds} m/s; plans only go forwards")
    if not 0.0 <= scene.state.s <= scene.line.length:
        raise InputError(
            f"the vehicle is at s {scene.state.s:.1f} m of a line from 0 to {scene.line.length:.1f} m; "
            "choose a longer one"
        )
    for name, value in zip(scene.goal._fields, scene.goal, strict=True):
        if not (isinstance(value, Real) and (abs(value) < LARGEST or (name == "until" and value == math.inf))):
            raise InputError(f"the goal {scene.goal} is not of numbers, not finite, or out of this world")
    if scene.goal.speed < 0.0:
        raise InputError(f"the goal {scene.goal} has a negative speed; 0 stands still")
    if (
        np.ndim(scene.offsets) != 1
        or not len(scene.offsets)
        or not np.isfinite(scene.offsets).all()
        or not (isinstance(scene.wanted, Real) and math.isfinite(scene.wanted))
    ):
        raise InputError(
            f"offsets to drive to are {np.asarray(scene.offsets).tolist()} and {scene.wanted!r} is wanted, "
            "but they must be one or more numbers, and a number"
        )
    if scene.boundary.reach < radius:
        raise InputError(
            f"boundary lines are known to {scene.boundary.reach:.2f} m, but the vehicle's circles reach "
            f"{radius:.2f} m; build them with that reach"
        )
    for name in ("stop", "stand"):
        value = getattr(scene, name)
        if not isinstance(value, Real) or math.isnan(value):
            raise InputError(f"scene: {name} is {value!r}, but must be a number; infinity means none")
    check_obstacles(scene.obstacles, num_steps)
