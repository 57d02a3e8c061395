"""The papers' simulated protocol: random junctions with vehicles on every lane.

    3 to 5 vehicles on each lane, a point every metre, white noise N(0, 1 m) on each axis
    ([M20] section V)

The papers do not publish their junctions. Ours: 3 to 6 arms of 60 m at least 25 degrees apart, gap
U(0, 4) m, 1 to 4 entries and exits of 2.7 m, turns up to 130 degrees, interiors that are cubic
Bezier curves (or others, see `interiors`). Seeds 0 to 999 are the frozen 1000 scenes; geometry,
vehicles and noise have their own streams, so that an option changes nothing but itself.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np

from experiments.scenarios import interiors, paths
from experiments.scenarios.border_marks import border_marks
from experiments.scenarios.occlusion import occlude
from experiments.scenarios.scene import Floats, Ints, JunctionTruth, Scene, join_tracks
from models.intersection.borders import interior_radius
from models.intersection.tracks import Tracks
from models.program import InputError

LANE_WIDTH = 2.7  # [M20] section III-B [m]
ARM_LENGTH = 60.0  # from the centre [m]
SEPARATION = math.radians(25.0)  # between neighbouring arms, [M20] section III-B
SHARPEST_TURN = math.radians(130.0)  # sharper ones fold back in the splines' frame, [M20] section IV-C
LINE_STEP = 0.25  # of the true centre lines [m]


def protocol(
    seed: int = 0,
    position_std: float = 1.0,
    heading_std: float | None = None,
    occlusion: bool = False,
    tracks: int | None = None,
    max_lanes: int = 4,
    interior: Literal["bezier", "clothoid", "bumps"] = "bezier",
    borders: float | None = None,
) -> Scene:
    """A simulated junction of the protocol.

    seed          0 to 999 are the frozen scenes; larger ones are further draws
    position_std  noise on each axis [m]
    heading_std   noise of measured headings [rad], 0.1 is customary; None measures no headings
    occlusion     see the junction from one standing vehicle (`occlusion.occlude`)
    tracks        vehicles on each lane, None draws 3 to 5
    max_lanes     entries and exits of an arm are uniform on 1 to max_lanes
    interior      family of the courses between the arms, see `interiors`
    borders       noise of points on the borders of lanes [m], see `border_marks`; None sees no borders. No occlusion
                  hides them

    Raises InputError for a negative seed, for max_lanes or tracks below one, for an unknown interior and for borders
    that are not a positive number.
    """
    if seed < 0:
        raise InputError(f"scenario protocol: seed is {seed}; choose 0 or more (0 to 999 are the frozen scenes)")
    if max_lanes < 1:
        raise InputError(f"scenario protocol: max_lanes is {max_lanes}, but every arm has lanes; choose 1 or more")
    if interior not in get_args(interiors.Kind):
        known = ", ".join(get_args(interiors.Kind))
        raise InputError(f"scenario protocol: interior is '{interior}'; choose one of {known}")
    if borders is not None and not 0.0 < borders < math.inf:
        raise InputError(f"scenario protocol: borders is {borders}; give a positive standard deviation, or null")
    geometry, vehicles, view, marks = np.random.SeedSequence(seed).spawn(4)
    truth = random_junction(np.random.default_rng(geometry), max_lanes, interior)
    data, track_lane = drive(truth.lines, vehicles, position_std, heading_std, tracks)
    if occlusion:
        data, track_lane = occlude(data, track_lane, truth, np.random.default_rng(view))
    if borders is not None:
        data = data._replace(borders=border_marks(truth, ARM_LENGTH, borders, np.random.default_rng(marks)))
    truth = truth._replace(track_lane=track_lane)
    info = {
        "scenario": "protocol",
        "seed": seed,
        "position_std": position_std,
        "heading_std": heading_std,
        "occlusion": occlusion,
        "interior": interior,
        "borders": borders,
        **counts(truth, data),
    }
    return Scene(data, truth, f"protocol {seed}", info)


def counts(truth: JunctionTruth, data: Tracks) -> dict[str, int]:
    """How much there is in a scene, for the manifest."""
    return {
        "arms": len(truth.angle),
        "connections": len(truth.lines),
        "tracks": len(data.offsets) - 1,
        "points": len(data.points),
    }


# Vehicles on known lanes


def drive(
    lines: list[Floats],
    seed: np.random.SeedSequence,
    position_std: float,
    heading_std: float | None,
    tracks: int | None,
) -> tuple[Tracks, Ints]:
    """Vehicles that follow every centre line, measured every metre with white noise.

    The first point of a track lies U(0, 1) m behind the beginning of its line. Returns the tracks
    and the line of each, (T,). Raises InputError for negative noise or fewer than one vehicle."""
    for name, std in (("position_std", position_std), ("heading_std", heading_std)):
        if std is not None and not (std >= 0.0 and math.isfinite(std)):
            raise InputError(f"simulated vehicles: {name} is {std}; give a standard deviation of 0 or more")
    if tracks is not None and tracks < 1:
        raise InputError(f"simulated vehicles: tracks is {tracks}; give 1 or more vehicles on each lane")
    number, place, position, direction = (np.random.default_rng(s) for s in seed.spawn(4))
    points, headings, track_lane = [], [], []
    for index, line in enumerate(lines):
        length, course = paths.arc_length(line), paths.headings(line)
        for _ in range(number.integers(3, 6) if tracks is None else tracks):
            s = np.arange(place.uniform(), length[-1], 1.0)
            points.append(paths.at(line, s) + position_std * position.standard_normal((len(s), 2)))
            noise = (heading_std or 0.0) * direction.standard_normal(len(s))
            headings.append(paths.wrap(np.interp(s, length, course) + noise))
            track_lane.append(index)
    data = join_tracks(points, None if heading_std is None else headings)
    return data, np.array(track_lane, dtype=np.int64)


# A random junction


def random_junction(rng: np.random.Generator, max_lanes: int, interior: interiors.Kind) -> JunctionTruth:
    """Draw arms, lanes, the connections between them and, at last, their centre lines; no vehicle yet."""
    angle = _draw_angles(rng)
    arms = len(angle)
    entries, exits = rng.integers(1, max_lanes + 1, (2, arms))
    gap, centre = rng.uniform(0.0, 4.0, arms), rng.uniform(-5.0, 5.0, 2)
    width = np.full(arms, LANE_WIDTH)
    radius = interior_radius(angle, gap / 2 + entries * width, gap / 2 + exits * width)
    connections = connect(angle, entries, exits)
    truth = JunctionTruth(
        centre, angle, gap, entries, exits, width, radius, [], connections, np.zeros(0, dtype=np.int64)
    )
    courses = interiors.draw(interior, [_ends(truth, connection) for connection in connections], rng)
    lines = [_line(truth, connection, course) for connection, course in zip(connections, courses, strict=True)]
    return truth._replace(lines=lines)


def _draw_angles(rng: np.random.Generator) -> Floats:
    """Arms uniform on the circle, drawn anew until they keep their distance and each can be both
    entered from and left for another one."""
    while True:
        angle = np.sort(rng.uniform(0.0, 2 * np.pi, rng.integers(3, 7)))
        between = np.diff(angle, append=angle[0] + 2 * np.pi)
        drivable = np.abs(turns(angle)) < SHARPEST_TURN
        if between.min() >= SEPARATION and drivable.any(0).all() and drivable.any(1).all():
            return angle


def turns(angle: Floats) -> Floats:
    """Change of heading from entering by arm a to leaving by arm b, positive to the left, (K, K) [rad]."""
    return paths.wrap(angle[None, :] - angle[:, None] - np.pi)


def connect(angle: Floats, entries: Ints, exits: Ints) -> Ints:
    """Which entry lane leads to which exit lane, (L, 4) as in JunctionTruth.

    The entries of an arm are spread over its destinations from left to right; left turns fill the
    exits from the middle, right turns from the outside. An exit nobody uses gets one more
    connection from the arm that reaches it most directly."""
    turn = turns(angle)
    connections, spans = set(), {}
    for a in range(len(angle)):
        drivable = np.flatnonzero(np.abs(turn[a]) < SHARPEST_TURN)
        destinations = drivable[np.argsort(-turn[a, drivable])]
        for j, b in enumerate(destinations.tolist()):
            first = j * entries[a] // len(destinations)
            last = math.ceil((j + 1) * entries[a] / len(destinations)) - 1
            spans[a, b] = (first, last)
            for lane in range(first, last + 1):
                if turn[a, b] > math.radians(30.0):
                    target = lane - first
                elif turn[a, b] < -math.radians(30.0):
                    target = exits[b] - 1 - (last - lane)
                else:
                    target = lane
                connections.add((a, lane, b, int(np.clip(target, 0, exits[b] - 1))))
    for b in range(len(angle)):
        used = {lane for *_, arm, lane in connections if arm == b}
        a = min((a for a, arm in spans if arm == b), key=lambda a: abs(turn[a, b]))
        for lane in set(range(exits[b])) - used:
            connections.add((a, int(np.clip(lane, *spans[a, b])), b, lane))
    return np.array(sorted(connections), dtype=np.int64)


def _ends(truth: JunctionTruth, connection: Ints) -> interiors.Ends:
    """Where the interior of one connection meets its arms."""
    a, entry, b, exit = connection
    return interiors.Ends(
        start=_stub(truth, a, entry, +1, truth.radius[a]),
        end=_stub(truth, b, exit, -1, truth.radius[b]),
        ahead=-_outward(truth.angle[a]),
        away=_outward(truth.angle[b]),
        turn=float(turns(truth.angle)[a, b]),
    )


def _line(truth: JunctionTruth, connection: Ints, course: Floats) -> Floats:
    """Centre line of one connection: straight on the arms, its course between them."""
    a, entry, b, exit = connection
    start, end = _stub(truth, a, entry, +1, ARM_LENGTH), _stub(truth, b, exit, -1, ARM_LENGTH)
    return paths.resample(np.concatenate([start[None], course, end[None]]), LINE_STEP)


def _outward(angle: float) -> Floats:
    return np.array([np.cos(angle), np.sin(angle)])


def _stub(truth: JunctionTruth, arm: int, lane: int, side: int, r: float) -> Floats:
    """The point of a lane r metres out on its arm; side +1 is an entry, -1 an exit."""
    axis = _outward(truth.angle[arm])
    offset = side * (truth.gap[arm] / 2 + (lane + 0.5) * truth.width[arm])
    return truth.centre + r * axis + offset * np.array([-axis[1], axis[0]])
