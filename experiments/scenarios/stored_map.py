"""Stored maps of junctions: arms and their lane counts, as a file that anybody can write.

    {"centre_m": [0.0, 0.0],
     "arms": [{"angle_rad": 0.1, "gap_m": 2.0, "width_m": 2.7, "entries": 2, "exits": 1}, ...]}

Arms are straight; lanes are counted from the middle of the arm outwards; the frame is that of the tracks.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from experiments.scenarios.scene import Floats, Ints, JunctionTruth, Scene
from models.program import InputError

MEASURES = ("angle_rad", "gap_m", "width_m")
COUNTS = ("entries", "exits")
MOST_LANES = 20  # on a side: more is a slip of the pen


class StoredMap(NamedTuple):
    """A map of K arms.

    centre   (2,) [m]
    angle    (K,) direction from the centre to the arm [rad]
    gap      (K,) between the inner borders of the two driving directions [m]
    width    (K,) lane width [m]
    entries  (K,) lanes that lead into the junction
    exits    (K,) lanes that lead out of it
    """

    centre: Floats
    angle: Floats
    gap: Floats
    width: Floats
    entries: Ints
    exits: Ints

    def lanes(self, side: Literal[1, -1]) -> Ints:
        """Lanes of each arm on one side, (K,): 1 entries, -1 exits."""
        return self.entries if side == 1 else self.exits


def mapped(scene: Scene, map_path: str | None = None, wrong: bool = True, seed: int = 0) -> Scene:
    """A scene with a stored map beside it, in `info["map"]`.

    map_path  of a map to verify; without one it is made from the truth of the scene
    wrong     the map made from the truth shows an entry too many and an exit too few (`outdated`) ...
    seed      ... on arms drawn by this seed

    Raises InputError for a map that cannot be read, and where there is neither a path nor a truth to make one from."""
    changes = ""
    if map_path is not None:
        stored = read_map(map_path)
    elif not isinstance(scene.truth, JunctionTruth):
        raise InputError(f"{scene.name} has no true junction to make a map from; give one with scenario.map_path=...")
    else:
        stored = map_of(scene.truth)
        if wrong:
            stored, changes = outdated(stored, seed)
    return scene._replace(info=scene.info | {"map": as_plain(stored), "map_changes": changes})


def map_of(truth: JunctionTruth) -> StoredMap:
    """The map that shows the truth. Raises InputError where a gap or a width is unknown."""
    stored = StoredMap(*(getattr(truth, name) for name in StoredMap._fields))
    if not (np.isfinite(stored.gap).all() and np.isfinite(stored.width).all()):
        raise InputError(
            "the truth of this scene lacks the gap or the width of an arm; give a map with scenario.map_path"
        )
    return stored


def outdated(stored: StoredMap, seed: int) -> tuple[StoredMap, str]:
    """The map with one entry more on an arm and one exit less on another, both outermost, and that in words.

    The exit is taken from an arm that has several, if there is one besides the first. Raises InputError for a negative
    seed and where no other arm has a lane to spare."""
    if seed < 0:
        raise InputError(f"scenario: seed of the wrong map is {seed}; choose 0 or more")
    rng = np.random.default_rng(seed)
    more = int(rng.integers(len(stored.angle)))
    others = np.arange(len(stored.angle)) != more
    several = others & (stored.exits > 1)
    spare = np.flatnonzero(several if several.any() else others & (stored.exits > 0) & (stored.entries > 0))
    if len(spare) == 0:
        raise InputError("this junction has no exit that a wrong map could lack; set scenario.wrong=false")
    less = int(rng.choice(spare))
    entries, exits = stored.entries.copy(), stored.exits.copy()
    entries[more] += 1
    exits[less] -= 1
    words = f"one entry too many on arm {more + 1}, one exit too few on arm {less + 1}"
    return stored._replace(entries=entries, exits=exits), words


def as_plain(stored: StoredMap) -> dict[str, Any]:
    """The map as its file holds it."""
    columns = (stored.angle, stored.gap, stored.width, stored.entries, stored.exits)
    arms = [dict(zip(MEASURES + COUNTS, (v.item() for v in row), strict=True)) for row in zip(*columns, strict=True)]
    return {"centre_m": stored.centre.tolist(), "arms": arms}


def write_map(path: Path | str, stored: StoredMap) -> None:
    """Write a map as JSON."""
    Path(path).write_text(json.dumps(as_plain(stored), indent=2))


def read_map(path: Path | str) -> StoredMap:
    """Read a map. Raises InputError in one sentence for a file that is none."""
    try:
        content = json.loads(Path(path).expanduser().read_text())
    except OSError as error:
        raise InputError(f"map '{path}' cannot be read: {error.strerror}; give the path of a JSON file") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"map '{path}' is no JSON: {error}; write_map shows the format") from error
    return from_plain(content, f"map '{path}'")


def from_plain(content: Any, name: str = "map") -> StoredMap:
    """The map in the content of its file. Raises InputError that names the map, the arm, the field and its value."""
    if not isinstance(content, dict) or not isinstance(content.get("arms"), list) or len(content["arms"]) == 0:
        raise InputError(f"{name} has no list 'arms'; give centre_m and arms, each with {', '.join(MEASURES + COUNTS)}")
    centre = content.get("centre_m")
    if not isinstance(centre, list) or len(centre) != 2 or not all(map(_is_number, centre)):
        raise InputError(f"{name}: centre_m is {_short(centre)}; give two finite numbers")
    for number, arm in enumerate(content["arms"], start=1):
        _check_arm(arm, f"{name}, arm {number}")
    column = lambda key, kind: np.array([arm[key] for arm in content["arms"]], dtype=kind)  # noqa: E731
    measures = [column(key, np.float64) for key in MEASURES]
    return StoredMap(np.array(centre, dtype=np.float64), *measures, *(column(key, np.int64) for key in COUNTS))


def _check_arm(arm: Any, name: str) -> None:
    if not isinstance(arm, dict):
        raise InputError(f"{name} is {_short(arm)}; give {', '.join(MEASURES + COUNTS)}")
    for key in MEASURES:
        if not _is_number(arm.get(key)) or (key == "width_m" and arm[key] <= 0):
            kind = "positive" if key == "width_m" else "finite"
            raise InputError(f"{name}: {key} is {_short(arm.get(key))}; give a {kind} number")
    for key in COUNTS:
        value = arm.get(key)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= MOST_LANES:
            raise InputError(f"{name}: {key} is {_short(value)}; give a whole number of lanes, 0 to {MOST_LANES}")
    if arm["entries"] + arm["exits"] == 0:
        raise InputError(f"{name} has no lanes; leave the arm out")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9 and math.isfinite(value)


def _short(value: Any) -> str:
    return "missing" if value is None else repr(value)[:40]
