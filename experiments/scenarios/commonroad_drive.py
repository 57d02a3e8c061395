"""A CommonRoad scenario to be driven in: the way to the goal, road users as they were recorded, the speed wanted.

The vehicle that was recorded in our place is left out of such files: others do not react to us.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.commonroad import Goal, Obstacle, Problem, Recording, read
from experiments.scenarios.commonroad_stops import stops_of
from experiments.scenarios.driving import Actor, DriveScene, Noise, Recorded
from experiments.scenarios.lane_search import backwards, lanes_at, neighbours, onwards, route_of, search
from models.program import InputError
from planning.frenet import Pose
from planning.road import Lane, Lanes, read_route
from planning.road import route as way_along
from planning.shapes import Vehicle

Floats = NDArray[np.float64]
NOT_FOR_CARS = {"sidewalk", "crosswalk", "bicycleLane", "busLane", "busStop", "border", "restricted"}
JOINT = 0.05  # gaps between lanes that are none [m]
ROOM = 0.5  # around where the vehicle starts [m]
NEARBY = 10.0  # of the route, where the edge of what may be driven on counts [m]
FEWEST = 3  # states that tell an acceleration
SLOWEST = 1.0  # speed wanted of who starts at rest and has nothing else to go by [m/s]
NAMED = 8  # lanes in a sentence about lanes, at most
BEHIND = 30.0  # of the route, behind where it begins [m]
LONGEST = 1e5  # that a way goes on behind the map [m]


def commonroad(
    file: str,
    *,
    problem: int | None = None,
    start: int | None = None,
    goal: int | None = None,
    route: str | None = None,
    speed: float | None = None,
    duration: float | None = None,
    beyond: float = 100.0,
    vehicle: Vehicle = Vehicle(),
    window: float = 0.3,
    noise: float = 0.0,
) -> DriveScene:
    """A scenario from an .xml or .xml.gz file (experiments.scenarios.commonroad).

    problem   id of the planning problem; the first one where none is told
    start     id of a lane on whose middle to begin instead, at rest; goal: id of a lane to reach instead
    route     text file of lane ids to drive along, each a successor or neighbour of the one before (planning.road's
              read_route), instead of the shortest way
    speed     wanted [m/s], within the limits of lanes; else the larger of the initial one and the middle of the goal's,
              or, where the goal has none, the limits, or, where there are none either, the initial one
    duration  [s]; else until the goal's last time or the last record of others
    beyond    the last lane goes on straight behind the end of the map by this [m]
    vehicle   whose rear axle is told from its middle
    window    in which places tell the speed and acceleration of others [s]
    noise     standard deviation of place and speed of others as they are seen [m, m/s]

    Raises InputError as read does, and for a start on no lane, a goal that cannot be reached and ids that are not
    there."""
    for name, value in {"speed": speed, "duration": duration, "beyond": beyond, "window": window}.items():
        if value is not None and not 0 < value < math.inf:
            raise InputError(f"scenario.{name} is {value}, but must be positive and finite")
    if beyond > LONGEST:
        raise InputError(f"scenario.beyond is {beyond:g} m, but a way goes on by {LONGEST:g} m at most; choose less")
    if not 0 <= noise < math.inf:
        raise InputError(f"scenario.noise is {noise}, but must be 0 or more [m, m/s]")
    told = read(file)
    drivable = [key for key in told.lanes if for_cars(told.kinds[key])]
    given = problem_of(told, drivable, problem, start, goal, file)
    path = path_of(told, drivable, given, start, file) if route is None else path_along(told, drivable, route, given)
    last = max((float(o.time[-1]) for o in told.obstacles), default=math.inf) - given.time
    until = min([g.time[1] - given.time for g in given.goals] or [math.inf])
    lasting = duration if duration is not None else min(until, last)
    if lasting == math.inf:
        raise InputError(f"{file}: no goal and no road user says when the drive ends; choose scenario.duration [s]")
    if not lasting > 0:
        raise InputError(f"{file}: the drive lasts {lasting:g} s; choose scenario.duration [s]")
    lanes, way = route_of(told.lanes, drivable, path)
    wanted = wanted_speed(lanes, way, given, speed)
    limits = [lanes[key].speed for key in way if math.isfinite(lanes[key].speed)]
    way = onwards(lanes, drivable, way, lasting * min(max([*limits, given.start[3]]), wanted) + beyond)
    way = backwards(lanes, drivable, way, BEHIND)
    if not lanes[way[-1]].successors:
        lanes, way = lengthened(lanes, way, beyond)
    most = max(limits, default=math.inf)  # of lanes on the way that tell none
    lanes |= {key: lanes[key]._replace(speed=most) for key in way if math.isinf(lanes[key].speed)}
    stops, lights = stops_of(told, lanes, drivable, way_along(lanes, way), given.time, lasting)
    actors = tuple(actor_of(o, given.time, lasting, window) for o in told.obstacles)
    x, y, heading, v, a = map(float, given.start)
    ego = Pose(x - vehicle.middle * math.cos(heading), y - vehicle.middle * math.sin(heading), heading, v, a)
    return DriveScene(
        told.name,
        lanes,
        tuple(way),
        stops,
        lights,
        actors,
        drivable_area(lanes, {*drivable, *way}, way, given.start, vehicle),
        ego,
        lasting,
        Noise(position=noise, speed=noise, heading=noise / 10),
        info_of(told, given, file),
        wanted,
    )


def path_of(told: Recording, drivable: Sequence[int], given: Problem, start: int | None, file: str) -> list[int]:
    """Lanes from the start to the goal, of which each follows the one before or lies beside it."""
    place = given.start[:2]
    begins = [start] if start is not None else lanes_at(told.lanes, drivable, place, float(given.start[2]))
    if not begins:
        raise InputError(f"{file}: the vehicle starts at {place.round(2).tolist()}, on no lane that a car may drive")
    ends = goal_lanes(told, drivable, given.goals)
    if not ends:
        return begins[:1]
    for begin in begins:
        if (path := search(told.lanes, drivable, begin, ends)) is not None:
            return path
    start_on, goal_on = (", ".join(map(str, keys)) for keys in (begins, ends))
    raise InputError(f"{file}: no way leads from lane {start_on} to the goal on lane {goal_on}")


def path_along(told: Recording, drivable: Sequence[int], route: str, given: Problem) -> list[int]:
    """Lanes of a route file, which must begin where the vehicle does."""
    path = list(read_route(route))
    for key in path:
        if key not in drivable:
            raise InputError(f"route file {route} names lane {key}, which is none that a car may drive on")
    for before, here in pairwise(path):
        if here not in (*told.lanes[before].successors, *neighbours(told.lanes, before, drivable)):
            raise InputError(f"route file {route}: lane {here} neither follows lane {before} nor lies beside it")
    if path[0] not in (begins := lanes_at(told.lanes, drivable, given.start[:2], float(given.start[2]))):
        known = ", ".join(map(str, begins)) or "none"
        raise InputError(f"route file {route} begins on lane {path[0]}, but the vehicle starts on lane {known}")
    return path


def for_cars(kinds: Collection[str]) -> bool:
    """Whether cars may drive on a lane of these types and users."""
    users = {kind for kind in kinds if kind.startswith("for ")}
    return not NOT_FOR_CARS & set(kinds) and (not users or bool(users & {"for car", "for vehicle"}))


def problem_of(
    told: Recording, drivable: Sequence[int], problem: int | None, start: int | None, goal: int | None, file: str
) -> Problem:
    """The planning problem that is asked for, or one made of a lane to start on and a lane to reach."""
    some = ", ".join(map(str, drivable[:NAMED])) + (", ..." if len(drivable) > NAMED else "")
    for name, key in (("start", start), ("goal", goal)):
        if key is not None and key not in told.lanes:
            raise InputError(f"{file}: scenario.{name} is {key}, but there is no such lane; cars may drive on {some}")
    if start is None:
        known = ", ".join(map(str, told.problems)) or "none"
        if not told.problems:
            raise InputError(
                f"{file}: it has no planning problem; choose a lane as scenario.start ({some}), and scenario.duration"
            )
        key = next(iter(told.problems)) if problem is None else problem
        if key not in told.problems:
            raise InputError(f"{file}: scenario.problem is {key}, but the planning problems are {known}")
        found = told.problems[key]
    else:
        lane = told.lanes[start]
        middle = lane.centre
        ahead = middle[1] - middle[0]
        pose = [*(middle[0] + ahead / 2), math.atan2(ahead[1], ahead[0])]
        found = Problem(np.r_[pose, 0.0, 0.0], 0.0, ())
    if goal is None:
        return found
    anyhow = (-math.inf, math.inf)
    return found._replace(goals=(Goal((), (goal,), anyhow, anyhow, anyhow),))


def goal_lanes(told: Recording, drivable: Collection[int], goals: Sequence[Goal]) -> list[int]:
    """The lanes on which goals are, none where they are anywhere."""
    found = []
    for goal in goals:
        found += [key for key in goal.lanes if key in drivable]
        heading = None if math.isinf(goal.heading[0]) else sum(goal.heading) / 2
        for place in goal.places:
            found += lanes_at(told.lanes, drivable, (place.min(0) + place.max(0)) / 2, heading)
    return found


def wanted_speed(lanes: Lanes, route: Sequence[int], given: Problem, speed: float | None) -> float:
    """[m/s], infinite where the limits of lanes are to be driven."""
    if speed is not None:
        return speed
    start = max(float(given.start[3]), SLOWEST)
    spans = [goal.speed for goal in given.goals if math.isfinite(sum(goal.speed))]
    if spans:
        return max(start, *(sum(span) / 2 for span in spans))
    return math.inf if any(math.isfinite(lanes[key].speed) for key in route) else start


def lengthened(lanes: Lanes, route: Sequence[int], way: float) -> tuple[dict[int, Lane], list[int]]:
    """With one more lane, straight on behind the last of the route, and beside it where there is one."""
    last, new = lanes[route[-1]], max(lanes) + 1
    ahead = last.centre[-1] - last.centre[-2]
    ahead = way * ahead / np.hypot(*ahead)
    shares = np.linspace(0.0, 1.0, 5)[:, None]
    left, right = (border[-1] + shares * ahead for border in (last.left, last.right))
    more = Lane(left, right, speed=last.speed)
    return {**lanes, route[-1]: last._replace(successors=(new,)), new: more}, [*route, new]


def actor_of(told: Obstacle, since: float, duration: float, window: float) -> Actor:
    """As recorded, with speed and acceleration as its places tell them; who stands is there all the time."""
    if told.static:
        pose = told.poses[:1].copy()
        pose[:, 3:] = 0.0
        return Recorded(np.array([0.0, duration]), np.repeat(pose, 2, 0), told.kind, told.size)
    return Recorded(told.time - since, moving(told.time, told.poses, window), told.kind, told.size)


def moving(time: Floats, poses: Floats, window: float) -> Floats:
    """Poses (K, 5) whose speed and acceleration are those of parabolas through the places nearby, weighted by
    exp(-(dt / window)^2 / 2): recorded ones jump by metres per second from one state to the next."""
    out = poses.copy()
    if len(time) < FEWEST:
        return out
    for k, now in enumerate(time):
        near = np.argsort(np.abs(time - now), kind="stable")[
            : max(FEWEST, int((np.abs(time - now) < 3 * window).sum()))
        ]
        t = time[near] - now
        weight = np.exp(-((t / window) ** 2) / 4)  # the root of it: least squares squares it
        basis = np.stack([np.ones_like(t), t, t**2 / 2], -1)
        (_, v, a), *_ = np.linalg.lstsq(basis * weight[:, None], poses[near, :2] * weight[:, None])
        ahead = np.array([math.cos(poses[k, 2]), math.sin(poses[k, 2])])
        out[k, 3:] = v @ ahead, a @ ahead
    return out


def drivable_area(
    lanes: Lanes, drivable: Collection[int], route: Sequence[int], start: Floats, vehicle: Vehicle
) -> tuple[Floats, ...]:
    """The lines around all lanes for cars that lie at the route, and around where the vehicle starts (x, y of its
    middle, heading; recorded ones do not mind kerbs), without those across the route's ends."""
    import shapely
    import shapely.affinity

    shapes = {k: shapely.Polygon(np.concatenate([lanes[k].left, lanes[k].right[::-1]])).buffer(JOINT) for k in drivable}
    way = shapely.unary_union([shapes[k] for k in route])
    stands = shapely.affinity.rotate(
        shapely.box(-vehicle.length / 2, -vehicle.width / 2, vehicle.length / 2, vehicle.width / 2),
        float(start[2]), origin=(0.0, 0.0), use_radians=True,
    )  # fmt: skip
    stands = shapely.affinity.translate(stands, *map(float, start[:2])).buffer(ROOM)
    area = shapely.unary_union([*(shape for shape in shapes.values() if shape.distance(way) < NEARBY), stands])
    ends = [
        shapely.LineString([lane.left[at], lane.right[at]]).buffer(1.0)
        for lane, at in ((lanes[route[0]], 0), (lanes[route[-1]], -1))
    ]
    edge = area.buffer(-JOINT).boundary.intersection(way.buffer(NEARBY)).difference(shapely.unary_union(ends))
    lines = shapely.line_merge(edge) if edge.geom_type == "MultiLineString" else edge
    return tuple(np.array(part.coords) for part in shapely.get_parts(lines) if part.geom_type == "LineString")


def info_of(told: Recording, given: Problem, file: str) -> dict[str, Any]:
    """Plain numbers for the manifest, the goal among them (experiments.goal_metrics)."""
    goals = [
        {
            "places": [
                *(place.tolist() for place in goal.places),
                *(np.concatenate([told.lanes[k].left, told.lanes[k].right[::-1]]).tolist() for k in goal.lanes),
            ],
            "time": [t - given.time for t in goal.time],
            "speed": list(goal.speed),
            "heading": list(goal.heading),
        }
        for goal in given.goals
    ]
    info = {"scenario": "commonroad", "file": file, "version": told.version}
    return {**info, "road_users": len(told.obstacles), "goals": goals}
