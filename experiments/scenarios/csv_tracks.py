"""Tracks of real vehicles from a table: read with care, then made even along their path.

One row a vehicle and time step, columns in any order and case: vehicle, t [s], x, y [m], and, where
measured, heading [rad]; `recording` where vehicle numbers repeat between recordings. Other columns are
ignored.
"""

from __future__ import annotations

import csv as table
import math
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from experiments.scenarios import paths
from experiments.scenarios.csv_table import number_of, rows_of
from experiments.scenarios.scene import Floats, Scene, join_tracks
from models.intersection.tracks import Tracks
from models.program import InputError

REQUIRED = ("vehicle", "t", "x", "y")
MIN_LENGTH = 30.0  # shorter tracks mislead more than they tell: findings on recorded traffic [m]
STEP = 1.0  # between points, [M20] section V [m]
STOPPED = 0.5  # steps shorter than this are standing and its jitter [m]
FASTEST = 100.0  # the middle one of the vehicles is slower, from its first to its last point [m/s]
SMOOTHING = 1.5  # standard deviation of the Gaussian window along the path [m]


class Recorded(NamedTuple):
    """One vehicle as recorded.

    vehicle  as messages name it
    row      of its first entry in the file
    t        (n,) [s]
    points   (n, 2) [m]
    heading  (n,) [rad], None where not measured
    """

    vehicle: str
    row: int
    t: Floats
    points: Floats
    heading: Floats | None


def csv(path: str, min_length: float = MIN_LENGTH) -> Scene:
    """Any user's tracks from a .csv or .csv.gz file.

    min_length  tracks shorter than this are left out [m]

    Coordinates stay as given. Raises InputError with file, row, column, value and remedy for
    whatever cannot be read, and where no vehicle crosses anything."""
    if not min_length >= 0:
        raise InputError(f"scenario csv: min_length is {min_length:g}; give 0 m or more")
    vehicles = read(path)
    pieces = [even(vehicle) for vehicle in vehicles]
    lengths = [paths.arc_length(points)[-1] for points, _ in pieces]
    long = [piece for piece, length in zip(pieces, lengths, strict=True) if length >= min_length]
    if not long:
        raise InputError(
            f"{path}: no vehicle crosses a junction, the longest of {len(vehicles)} tracks is {max(lengths):.1f} m and "
            f"min_length is {min_length:g} m; give longer tracks, in metres, or lower scenario.min_length"
        )
    if _on_one_road([points for points, _ in long]):
        raise InputError(
            f"{path}: no vehicle crosses another's way, all {len(long)} tracks of {min_length:g} m and more run along "
            "one road; give tracks that enter and leave the junction by different arms"
        )
    data = join(long)
    info = {
        "scenario": "csv",
        "path": str(path),
        "vehicles": len(vehicles),
        "tracks": len(long),
        "points": len(data.points),
        "heading": "none" if data.heading is None else "measured",
    }
    return Scene(data, None, Path(path).name, info)


def _on_one_road(tracks: list[Floats]) -> bool:
    """Whether the chords of all tracks lie within 5 degrees of one line, whichever way they are driven.

    Two arms 25 degrees apart, 60 m long and seen from a third one opposite differ by more."""
    chords = np.array([points[-1] - points[0] for points in tracks])
    twice = 2 * np.arctan2(chords[:, 1], chords[:, 0])  # opposite directions are one
    mean = np.arctan2(np.sin(twice).sum(), np.cos(twice).sum())
    return bool((np.abs(paths.wrap(twice - mean)) < 2 * math.radians(5.0)).all())


def write(path: str | Path, tracks: Tracks, step: float = 0.1) -> None:
    """Write tracks as the table that `read` reads, their points `step` seconds apart; makes the folder.

    Raises InputError where there are no tracks."""
    if len(tracks.offsets) < 2:
        raise InputError(f"{path}: there are no tracks to write")
    heading = [] if tracks.heading is None else [tracks.heading]
    columns = np.column_stack([tracks.points, *heading])
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        rows = table.writer(file)
        rows.writerow([*REQUIRED, *["heading" for _ in heading]])
        for vehicle, (begin, end) in enumerate(zip(tracks.offsets[:-1], tracks.offsets[1:], strict=True)):
            for i in range(begin, end):
                rows.writerow([vehicle, f"{(i - begin) * step:.6g}", *(f"{value:.6f}" for value in columns[i])])


def join(pieces: list[tuple[Floats, Floats | None]]) -> Tracks:
    """Single tracks with or without headings behind one another."""
    headings = [heading for _, heading in pieces if heading is not None]
    return join_tracks([points for points, _ in pieces], headings or None)


# Along the path


def even(vehicle: Recorded) -> tuple[Floats, Floats | None]:
    """A track with a point every metre: stops removed, jitter smoothed along the path.

    Points closer than half a metre to the last kept one are standing or its jitter and go. The rest
    is interpolated and averaged by a Gaussian window of 1.5 m over the arc length, headings as
    directions. Returns points (n, 2) and headings (n,); a single point where the vehicle never moved."""
    kept = [0]
    for i in range(1, len(vehicle.points)):
        if math.dist(vehicle.points[i], vehicle.points[kept[-1]]) >= STOPPED:
            kept.append(i)
    points = vehicle.points[kept]
    along = paths.arc_length(points)
    s = np.arange(0.0, along[-1] + 1e-9, STEP)
    smooth = _smooth(paths.at(points, s), mirror="odd")
    if vehicle.heading is None:
        return smooth, None
    direction = np.stack([np.cos(vehicle.heading[kept]), np.sin(vehicle.heading[kept])], axis=1)
    even_direction = np.stack([np.interp(s, along, column) for column in direction.T], axis=1)
    return smooth, np.arctan2(*_smooth(even_direction, mirror="even").T[::-1])


def _smooth(values: Floats, mirror: Literal["odd", "even"]) -> Floats:
    """Gaussian window along (n, 2); mirrored at the ends, through the end point (odd) or not (even)."""
    reach = math.ceil(3 * SMOOTHING / STEP)
    window = np.exp(-0.5 * (np.arange(-reach, reach + 1) * STEP / SMOOTHING) ** 2)
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="reflect", reflect_type=mirror)
    return np.stack([np.convolve(column, window / window.sum(), "valid") for column in padded.T], axis=1)


# The table


def read(path: str | Path, types: tuple[str, ...] | None = None) -> list[Recorded]:
    """Vehicles of a table in the order they appear; `types` keeps rows whose column `type` is one of these.

    Raises InputError for a file that is missing, empty or no table, for missing columns, for values
    that are no numbers, for times that do not increase within a vehicle, for degrees instead of metres
    or radians, for milliseconds or centimetres, and where every vehicle has a single point."""
    rows: dict[tuple[str, str], list[tuple[float, ...]]] = {}
    first: dict[tuple[str, str], int] = {}
    has_heading = False
    for number, row in rows_of(Path(path), REQUIRED, " and, where measured, heading"):
        has_heading = "heading" in row
        if types is not None and row["type"] not in types:
            continue
        if not row["vehicle"]:
            raise InputError(f"{path}, row {number}: vehicle is empty; give every row the number of its vehicle")
        key = (row.get("recording", ""), row["vehicle"])
        where = f"{path}, row {number}, vehicle {row['vehicle']}"
        columns = ("t", "x", "y", "heading") if has_heading else ("t", "x", "y")
        values = tuple(number_of(where, column, row[column]) for column in columns)
        before = rows.setdefault(key, [])
        _check_row(where, values, before)
        before.append(values)
        first.setdefault(key, number)
    if not rows:
        raise InputError(f"{path}: the table has no rows; give one row for each vehicle and time step")
    vehicles = []
    for key, entries in rows.items():
        array = np.array(entries)
        heading = array[:, 3] if has_heading else None
        vehicles.append(Recorded(key[1], first[key], array[:, 0], array[:, 1:3], heading))
    _check_all(path, vehicles)
    return vehicles


def _check_row(where: str, values: tuple[float, ...], before: list[tuple[float, ...]]) -> None:
    """Times increase within a vehicle, headings are radians."""
    t = values[0]
    if before and t == before[-1][0]:
        raise InputError(
            f"{where}: t = {t:g} comes twice; keep one row for each vehicle and time, "
            "or tell recordings apart by a column 'recording'"
        )
    if before and t < before[-1][0]:
        raise InputError(f"{where}: t = {t:g} comes after t = {before[-1][0]:g}; sort the rows of each vehicle by time")
    if len(values) == 4 and abs(values[3]) > 2 * math.pi + 1e-2:
        raise InputError(
            f"{where}: heading is {values[3]:g}, beyond 2 pi; "
            "give radians (degrees times pi / 180) or remove the column"
        )


def _check_all(path: str | Path, vehicles: list[Recorded]) -> None:
    """Vehicles move, in metres and seconds."""
    if all(len(vehicle.points) == 1 for vehicle in vehicles):
        raise InputError(
            f"{path}: each of the {len(vehicles)} vehicles has a single point, the first is vehicle "
            f"{vehicles[0].vehicle} in row {vehicles[0].row}; give the same number to all rows of a vehicle"
        )
    points = np.concatenate([vehicle.points for vehicle in vehicles])
    extent = np.ptp(points, axis=0)
    if (np.abs(points) <= (180.0, 90.0)).all() and (extent < 0.1).all():
        x, y = points[0]
        raise InputError(
            f"{path}, row {vehicles[0].row}: x = {x:g} and y = {y:g} span only {extent[0]:.2g} and {extent[1]:.2g}, "
            "which looks like degrees of longitude and latitude; project them to metres, for example to UTM"
        )
    moving = [vehicle for vehicle in vehicles if len(vehicle.points) > 1]
    pause = np.median(np.concatenate([np.diff(v.t) for v in moving]))
    step = np.median(np.concatenate([np.hypot(*np.diff(v.points, axis=0).T) for v in moving]))
    if pause > 10.0 and step < 5.0:
        raise InputError(
            f"{path}: rows of a vehicle are {pause:g} s apart, but its points only {step:.2g} m, "
            "which looks like milliseconds; give t in seconds"
        )
    speed = np.median([math.dist(v.points[0], v.points[-1]) / (v.t[-1] - v.t[0]) for v in moving])
    if speed > FASTEST:
        raise InputError(
            f"{path}: vehicles cover {speed:.0f} m a second, which looks like centimetres or other units; "
            "give x and y in metres and t in seconds"
        )
