"""The behavioural layer ([K15], section IV-B): what the trajectory planner is asked for.

    goal      keep a speed, follow the lead, stop before a line, merge into a gap; kept until another is clearly better
    speed     within limits and curves ahead, and such that one can stand before whatever lies beyond the horizon
    lateral   offsets about the middle of the lane, or past what blocks it (planning.release), or into the lane of the
              route (planning.gaps)

No plan passes a stop point without permission, or the route's end: Scene.stop, and Scene.stand after the horizon.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from models.program import InputError
from planning.candidates import Goal, Keep, Reach, follow, stop
from planning.decision import PAST, Permissions
from planning.frenet import FrenetState, to_pose
from planning.gaps import ALIGNED, Gap, Gaps, merging, movers_of
from planning.leads import Lead, lead_of
from planning.planner import Planner
from planning.release import LEFT, RIGHT, Passing, Release, extent, passing
from planning.relief import eased, needed
from planning.road import EDGE, Floats, Route, StopPoint
from planning.scene import Scene
from planning.shapes import Boundary, Obstacles, boundary
from planning.situation import Along, Predictions, along
from planning.speeds import speed_ahead, speed_before

KEEP, FOLLOW, STOP, MERGE = "keep", "follow", "stop", "merge"
STANDS = 0.01  # ahead of the front: who stands beside a lead may stay there [m]
MOVED, HARD = 6.0, 5.0  # [s] in which a target must come to be ahead of where one can stand by such braking [m/s^2]
FASTER = 0.5  # a lead that is faster than this draws away: its speed is kept, no place behind it [m/s]


@dataclass(frozen=True)
class Manners:
    """Settings of the behavioural layer.

    braking, lag          of comfortable braking [m/s^2], after this time [s]
    lateral_acceleration  in curves [m/s^2]: less than the planner's limit
    ahead                 how far limits and curves are looked at [m]
    gap, headway          to the lead [m, s]; room before what shall be passed, so that one can turn out [m]
    near                  [m] before braking has to begin, the goal becomes to stop or to follow
    hysteresis            factor on that way until it is left again
    before                how far before a line one stops [m]
    sideways              how far from the offset wanted plans may end [m], num_offsets
    spare                 of speed, below the planner's limit [m/s]
    """

    braking: float = 2.0
    lag: float = 1.5
    lateral_acceleration: float = 1.6
    ahead: float = 120.0
    gap: float = 4.0
    headway: float = 1.2
    room: float = 8.0
    near: float = 3.0
    hysteresis: float = 1.5
    before: float = 0.05
    sideways: float = 0.4
    num_offsets: int = 5
    spare: float = 0.2
    release: Release = field(default_factory=Release)
    gaps: Gaps = field(default_factory=Gaps)

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if name not in ("release", "gaps") and not 0 < getattr(self, name) < math.inf:
                raise InputError(f"manners: {name} is {getattr(self, name)}, but must be positive and finite")


class Memory(NamedTuple):
    """What the behavioural layer remembers: the goal's word, the lead (a label, or -1), passing, the gap (labels of
    the vehicles ahead and behind, or -1), and whether one goes into it."""

    goal: str = KEEP
    lead: int = -1
    passing: Passing = Passing()
    gap: tuple[int, int] = (-1, -1)
    into: bool = False


def behave(
    planner: Planner,
    route: Route,
    state: FrenetState,
    predictions: Predictions,
    stop_points: Sequence[StopPoint],
    permissions: Permissions,
    memory: Memory = Memory(),
    manners: Manners = Manners(),
    *,
    places: Along | None = None,
    lines: Sequence[Floats] = (),
) -> tuple[Scene, Memory]:
    """The scene of a cycle (for planning.planner.plan), and what to remember for the next.

    state   on route.line; places  of the predictions along the route, where they are at hand
    lines   seen in the world, that must not be touched, besides the borders of what may be driven"""
    told = along(route, predictions) if places is None else places
    vehicle, front = planner.vehicle, state.s + planner.vehicle.front
    line = barrier(route, stop_points, permissions, front)
    beside, centre = lane_beside(route, state)
    around = Passing()
    if memory.passing.going or not beside:  # on its way into the route's lane it passes nobody there
        around = passing(planner, route, state, predictions, told, stop_points, memory.passing, manners.release)
    movers = [] if around.going else movers_of(planner, route, state, predictions, told, manners.gaps)
    merge = merging(planner, route, state, movers, (memory.gap, memory.into), manners.braking, manners.gaps)
    line, gap = min(line, merge.line), merge.gap
    wanted = around.offset if around.going else centre if gap is not None and not merge.into else 0.0
    waits_for = -1 if around.going else around.blocker
    lead = lead_of(planner, state, predictions, told, wanted, memory.lead, waits_for, merge.joining)
    if beside and not around.going:
        here = lead_of(planner, state, predictions, told, state.d, memory.lead)
        lead = min((one for one in (lead, here) if one is not None), key=lambda one: one.rear, default=None)
    if gap is not None and gap.missing(state.s + vehicle.middle, vehicle.length, manners.gaps) >= 0.0:
        lead = behind_gap(lead, gap)
    speed = wanted_speed(planner, route, state, line, lead, around.going, manners)
    goal, word = choose(planner, state, speed, line, lead, gap, memory, manners, waits_for)
    low, high = span(planner, route, state, around)
    wanted = min(max(wanted, low), high)
    scene = Scene(
        route.line,
        state,
        goal,
        offsets_about(wanted, low, high, manners),
        wanted,
        borders(planner, route, state, around, lines),
        ahead_or_beside(planner, state, predictions, told),
        max(line, front),
        line if lead is None else min(line, max(lead.stands(planner), front + STANDS)),
    )
    return scene, Memory(word, -1 if lead is None else lead.label, around, merge.labels, merge.into)


def ahead_or_beside(planner: Planner, state: FrenetState, predictions: Predictions, places: Along) -> Obstacles:
    """The obstacles without those who come along behind the vehicle on its own way: they keep their distance, and
    predicted at their speed they would drive through it whenever it brakes."""
    if not len(predictions.track):
        return predictions.obstacles
    across = extent(predictions, places).across[:, 0]
    behind = places.on[:, 0] & (places.s[:, 0] < state.s) & (places.ahead[:, 0] > ALIGNED)
    behind &= np.abs(places.d[:, 0] - state.d) < across + planner.vehicle.width / 2
    tracks = np.unique(predictions.track[behind])
    kept = ~np.isin(predictions.track, tracks)
    return Obstacles(*(part[kept] for part in predictions.obstacles))


def lane_beside(route: Route, state: FrenetState) -> tuple[bool, float]:
    """Whether the vehicle is on a lane beside the route's that runs the same way, and the offset of its middle [m]."""
    far_left, left, right, far_right = map(float, route.edges_at(np.array([state.s]))[0])
    opposite = route.opposite[min(int(state.s / EDGE), len(route.opposite) - 1)]
    if state.d > left and far_left > left and not opposite[LEFT]:
        return True, (far_left + left) / 2
    if state.d < right and far_right < right and not opposite[RIGHT]:
        return True, (far_right + right) / 2
    return False, 0.0


def behind_gap(lead: Lead | None, gap: Gap) -> Lead | None:
    """The nearer one of the lead and the vehicle ahead of a gap."""
    if gap.ahead is None:
        return lead
    one = Lead(gap.ahead.label, gap.ahead.s - gap.ahead.half, gap.ahead.speed, 0.0, 0.0)
    return one if lead is None or one.rear < lead.rear else lead


def barrier(route: Route, stop_points: Sequence[StopPoint], permissions: Permissions, front: float) -> float:
    """The nearest s that the front must not pass: a line without permission, or the route's end."""
    lines = [p.s for p in stop_points if p.name not in permissions.granted and p.s >= front - PAST]
    return min([*lines, route.line.length])


def wanted_speed(
    planner: Planner, route: Route, state: FrenetState, line: float, lead: Lead | None, passes: bool, manners: Manners
) -> float:
    """Now, so that everything ahead can be met comfortably [m/s]."""
    front = state.s + planner.vehicle.front
    told = {"braking": manners.braking, "lag": manners.lag}
    most = [
        planner.comfort.speed - manners.spare,
        speed_ahead(
            route, state.s, state.ds, lateral_acceleration=manners.lateral_acceleration, ahead=manners.ahead, **told
        ),
        speed_before(line - manners.before - front, state.ds, **told),
    ]
    if lead is not None:
        surplus = lead.rear - front - manners.gap - manners.headway * lead.speed
        most.append(lead.speed + speed_before(surplus, max(state.ds - lead.speed, 0.0), **told))
    if passes:
        most.append(manners.release.speed)
    return max(min(most), 0.0)


def choose(
    planner: Planner,
    state: FrenetState,
    speed: float,
    line: float,
    lead: Lead | None,
    gap: Gap | None,
    memory: Memory,
    manners: Manners,
    waits_for: int,
) -> tuple[Goal, str]:
    """The goal and its word; the one of the cycle before is left later than it was taken."""
    vehicle, front = planner.vehicle, state.s + planner.vehicle.front
    found: list[tuple[float, Goal, str]] = []
    slack = manners.hysteresis if memory.goal == STOP else 1.0
    if line - front <= slack * braking_way(state.ds, manners):
        found.append((line, _reachable(stop(line - manners.before, vehicle.front), state), STOP))
    # in a gap one follows neither of its vehicles: the one behind comes up meanwhile
    if lead is not None and (gap is None or gap.behind is None or gap.labels[0] != lead.label):
        room = manners.room if lead.label == waits_for else manners.gap
        target = follow(lead.rear, lead.speed, lead.acceleration, vehicle.front, gap=room, headway=manners.headway)
        slack = manners.hysteresis if (memory.goal, memory.lead) == (FOLLOW, lead.label) else 1.0
        slower = lead.speed <= min(speed - 0.5, state.ds + FASTER) + slack
        if slower and target.place - state.s <= slack * braking_way(max(state.ds - lead.speed, 0.0), manners):
            found.append((target.place + vehicle.front, _reachable(target, state), FOLLOW))
    if found:
        _, goal, word = min(found, key=lambda told: told[0])
        return goal, word
    between = None if gap is None else gap.goal(state, vehicle.middle, vehicle.length, speed, manners.gaps)
    return (Keep(speed), KEEP) if between is None else (between, MERGE)


def braking_way(speed: float, manners: Manners) -> float:
    """Before which the goal is to lose a speed, comfortably [m]."""
    return speed**2 / (2 * manners.braking) + speed * manners.lag + manners.near


def _reachable(goal: Reach, state: FrenetState) -> Reach:
    """Not behind where one can stand, when the target has moved on for some time: no motion goes backwards."""
    moves = float(goal.target(MOVED)[0]) - goal.place
    return goal._replace(place=max(goal.place, state.s + state.ds**2 / (2 * HARD) - moves))


def span(planner: Planner, route: Route, state: FrenetState, around: Passing) -> tuple[float, float]:
    """Least and largest offset at which the vehicle's circles keep clear of the borders nearby."""
    ahead = route.edges_at(np.arange(state.s, state.s + 5.0 + 1.5 * state.ds, 1.0))
    sides = left_lanes(planner, route, state, around)
    high = float(ahead[:, 0 if LEFT in sides else 1].min()) - planner.radius
    low = float(ahead[:, 3 if RIGHT in sides else 2].max()) + planner.radius
    return (low, high) if low <= high else ((low + high) / 2, (low + high) / 2)


def offsets_about(wanted: float, low: float, high: float, manners: Manners) -> Floats:
    """Targets of the offset, with the wanted one."""
    fan = wanted + np.linspace(-manners.sideways, manners.sideways, manners.num_offsets)
    told: Floats = np.unique(np.r_[wanted, fan[(fan >= low) & (fan <= high)]])
    return told


def left_lanes(planner: Planner, route: Route, state: FrenetState, around: Passing) -> set[int]:
    """The sides at which the border of the own lane may be crossed: for passing, and until one is back."""
    _, left, right, _ = route.edges_at(np.array([state.s]))[0]
    sides = {around.side} if around.going and around.side >= 0 else set()
    if state.d + planner.radius > left:
        sides.add(LEFT)
    if state.d - planner.radius < right:
        sides.add(RIGHT)
    return sides


def borders(
    planner: Planner, route: Route, state: FrenetState, around: Passing, seen: Sequence[Floats] = ()
) -> Boundary:
    """Near the vehicle, `seen` and borders; where a lane is left, the far one of the lane beside it; farther out where
    the vehicle is across it already (planning.relief)."""
    sides, lines = left_lanes(planner, route, state, around), list(seen)
    reach = 20.0 + planner.horizon * (state.ds + planner.comfort.acceleration * planner.horizon / 2)
    for side, column in ((LEFT, 0 if LEFT in sides else 1), (RIGHT, 3 if RIGHT in sides else 2)):
        if (relief := needed(planner, route, state, side, column)) > 0.0:
            lines.append(eased(route, state, side, column, relief, reach))
            continue
        for n in range(len(route.lanes)):
            far = route.outer[n][side]
            lines.append(route.borders[2 * n + side] if far is None or side not in sides else far)
    pose = to_pose(route.line, state)
    return boundary(lines, planner.radius, within=(pose.x, pose.y, reach))
