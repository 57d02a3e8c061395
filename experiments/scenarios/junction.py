"""Vehicles simulated on the lanes of real junctions.

[M20] section V evaluates on real geometries in the same way: vehicles as in the protocol, driving
along surveyed centre lines. The maps of the data folder name 24 junctions, 15 of them `clean`.
"""

from __future__ import annotations

import difflib
import json
from pathlib import Path
from typing import Any

import numpy as np

from experiments.scenarios import paths
from experiments.scenarios.protocol import LINE_STEP, counts, drive
from experiments.scenarios.scene import Floats, JunctionTruth, Scene
from models.program import InputError

DATA_ROOT = "../shared/data"  # beside the checkout; its README names sources and licences


def junction(
    name: str = "karlsruhe_1",
    seed: int = 0,
    data_root: str = DATA_ROOT,
    position_std: float = 1.0,
    heading_std: float | None = None,
    tracks: int | None = None,
) -> Scene:
    """Simulated vehicles on the centre lines of a real junction.

    name          of a file in data_root/intersections
    seed          of vehicles and noise
    position_std  noise on each axis [m]
    heading_std   noise of measured headings [rad]; None measures no headings
    tracks        vehicles on each lane, None draws 3 to 5

    Raises InputError for a junction or a data folder that is not there."""
    if seed < 0:
        raise InputError(f"scenario junction: seed is {seed}; choose 0 or more")
    truth, quality = read(name, data_root)
    data, track_lane = drive(truth.lines, np.random.SeedSequence(seed), position_std, heading_std, tracks)
    truth = truth._replace(track_lane=track_lane)
    info = {
        "scenario": "junction",
        "junction": name,
        "quality": quality,
        "seed": seed,
        "position_std": position_std,
        "heading_std": heading_std,
        **counts(truth, data),
    }
    return Scene(data, truth, name, info)


def names(quality: str | None = None, data_root: str = DATA_ROOT) -> list[str]:
    """Names of the real junctions, of one quality (clean, t-junction, compound, partial) or of all."""
    files = find(data_root, "intersections", ".json")
    return [name for name, file in files.items() if quality in (None, json.loads(file.read_text())["quality"])]


def find(data_root: str, kind: str, ending: str, instead: str = "protocol") -> dict[str, Path]:
    """Files of one kind below the data folder by their name, sorted; `instead` is a scenario without files.

    Raises InputError that says where it looked and what to do."""
    folder = Path(data_root) / kind
    files = {path.name.removesuffix(ending): path for path in sorted(folder.glob(f"*{ending}"))}
    if not files:
        raise InputError(
            f"no {kind} in '{Path(data_root).resolve()}'; set scenario.data_root to the folder that holds "
            f"'{kind}', or run scenario={instead}, which needs no files"
        )
    return files


def pick(name: str, files: dict[str, Path], what: str) -> Path:
    """The file of a name. Raises InputError with the names that come close, and all there are."""
    if name not in files:
        close = difflib.get_close_matches(name, files, n=3, cutoff=0.4)
        hint = f"did you mean {' or '.join(close)}? " if close else ""
        raise InputError(f"no {what} is named '{name}'; {hint}there are {', '.join(files)}")
    return files[name]


def read(name: str, data_root: str = DATA_ROOT) -> tuple[JunctionTruth, str]:
    """Geometry of a real junction in metres around its centre, no vehicle yet, and its quality.

    The files list the lanes of an arm by their lateral position, left being positive, so that
    exits begin at the kerb; here both directions count from the middle. The gap is measured
    `arm_lane_count_at_m` from the centre, its borders half a lane from the innermost centre lines."""
    file = json.loads(pick(name, find(data_root, "intersections", ".json"), "junction").read_text())
    arms, lanes = file["arms"], file["lanes"]
    row = {arm["id"]: index for index, arm in enumerate(arms)}
    exits = np.array([arm["n_exits"] for arm in arms], dtype=np.int64)
    connections = []
    for lane in lanes:
        a, b = row[lane["entry"]["arm"]], row[lane["exit"]["arm"]]
        connections.append((a, lane["entry"]["lane"], b, exits[b] - 1 - lane["exit"]["lane"]))
    width = np.array([_width(arm, lanes) for arm in arms])
    truth = JunctionTruth(
        centre=np.zeros(2),
        angle=np.array([arm["angle"] for arm in arms]),
        gap=np.array([_inner_distance(arm) for arm in arms]) - width,
        entries=np.array([arm["n_entries"] for arm in arms], dtype=np.int64),
        exits=exits,
        width=width,
        radius=np.full(len(arms), float(file["core_radius"])),
        lines=[_line(lane["centerline"]) for lane in lanes],
        connections=np.array(connections, dtype=np.int64),
        track_lane=np.zeros(0, dtype=np.int64),
    )
    return truth, file["quality"]


def origin(name: str, data_root: str = DATA_ROOT) -> Floats:
    """Where the centre of a junction lies in the frame of its data set, (2,) [m]."""
    file = pick(name, find(data_root, "intersections", ".json"), "junction")
    return np.array(json.loads(file.read_text())["origin_offset"])


def _width(arm: dict[str, Any], lanes: list[dict[str, Any]]) -> float:
    """Distance between neighbouring lanes of an arm; where there are none, the width of the map's lanes."""
    sides = (arm["entry_lateral_m"], arm["exit_lateral_m"])
    spacing = np.concatenate([np.diff(np.sort(side)) for side in sides])
    if len(spacing):
        return float(np.median(spacing))
    on_it = [lane["width_m"] for lane in lanes if arm["id"] in (lane["entry"]["arm"], lane["exit"]["arm"])]
    return float(np.median(on_it)) if on_it else np.nan


def _inner_distance(arm: dict[str, Any]) -> float:
    """From the innermost exit to the innermost entry; nan on one-way arms."""
    entries, exits = arm["entry_lateral_m"], arm["exit_lateral_m"]
    return min(entries) - max(exits) if entries and exits else np.nan


def _line(points: list[list[float]]) -> Floats:
    """A centre line of the file with a point every 0.25 m."""
    return paths.resample(np.array(points), LINE_STEP)
