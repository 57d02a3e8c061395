"""Scans of real sensors from a table, and, where somebody knows it, who was where from another.

One row a measurement, columns in any order and case:

    t, sensor    [s] since a start, and the sensor's name in the model
    what it measures, by the sensor's names, such as range [m], bearing [rad], range_rate [m/s]; cells of what other
                 sensors measure are not read. A row without any is a scan that saw nothing
    score        probability that it is no false alarm, empty where nobody says
    looks        kind that it looks like, for sensors with a confusion, empty where nobody says
    car_x, car_y, car_heading   pose of the car [m], [rad], the same in all rows of a scan; at rest at zero without

Rows of a scan, which has one sensor and one time, stand together, scans in the order in which they arrived. The truth
is a table `vehicle,t,x,y` (experiments.scenarios.csv_tracks) on the same clock and in the frame of the car's pose.
"""

from __future__ import annotations

import csv as table
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.scenarios.csv_table import number_of, rows_of
from experiments.scenarios.csv_tracks import REQUIRED as TRUTH
from experiments.scenarios.csv_tracks import Recorded, read
from experiments.scenarios.paths import wrap
from experiments.scenarios.scene import Floats, Scene, TrafficTruth
from models.objects.motion import Body
from models.objects.scans import Recording, Scan
from models.objects.sensors import Sensor, mounted
from models.objects.traffic import Traffic
from models.program import InputError

REQUIRED = ("t", "sensor")
POSE = ("car_x", "car_y", "car_heading")
ANGLE = 2 * np.pi + 1e-2  # the largest that is one in radians
GAP = 5.0  # of the usual step: a vehicle is away between rows that are farther apart
NO_OPINION = 0.5  # a score that speaks neither for nor against


class Row(NamedTuple):
    """One row of the table: where it stands, as messages say it, its scan, and what it measures, None for nothing."""

    where: str
    sensor: Sensor
    time: float
    pose: tuple[float, ...]
    values: list[float] | None
    score: float | None
    looks: str


def own_scans(path: str, traffic: Traffic, truth_path: str | None = None) -> Scene:
    """Any user's scans from a .csv or .csv.gz file.

    traffic     the model, whose sensors tell what columns mean
    truth_path  of a table of who was where; between two rows of a vehicle it moves evenly, unless they are more than
                five usual steps apart: then it is away. Who is in view of no sensor is no part of the truth

    Raises InputError with file, row, column, value and remedy for whatever cannot be read, for a sensor that the model
    does not have, a scan in two pieces, degrees instead of radians, and a truth of another time."""
    if not isinstance(traffic, Traffic):
        raise InputError(
            f"scenario own_scans: scans are of sensors, which {type(traffic).__name__} does not have; "
            "choose a model of traffic, such as model=traffic_urban"
        )
    rows = [_row(path, number, row, traffic) for number, row in rows_of(Path(path), REQUIRED)]
    if not rows:
        raise InputError(f"{path}: the table has no rows; give one row for each measurement")
    scans = tuple(
        _scan(list(group), traffic) for _, group in groupby(rows, key=lambda row: (row.sensor.name, row.time))
    )
    _check_whole(path, rows)
    scans = traffic.check(scans)
    truth = None if truth_path is None else _truth(truth_path, read(truth_path), scans, traffic)
    info = {"scenario": "own_scans", "path": str(path), "truth": truth_path or "none", "scans": len(scans)}
    info |= {"measurements": sum(len(scan.values) for scan in scans)}
    return Scene(Recording(scans), truth, Path(path).name, info)


def write(path: str | Path, recording: Recording, traffic: Traffic) -> None:
    """Write scans as the table that `own_scans` reads, but for covariances; makes the folder.

    Raises InputError for a sensor that the model does not have."""
    scans = traffic.check(recording)
    names = list(dict.fromkeys(name for scan in scans for name in traffic.sensor(scan).names))
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        rows = table.DictWriter(file, [*REQUIRED, *names, "score", "looks", *POSE])
        rows.writeheader()
        for scan in scans:
            sensor = traffic.sensor(scan)
            shared = dict(zip((*REQUIRED, *POSE), (scan.time, scan.sensor, *scan.pose.tolist()), strict=True))
            if not len(scan.values):
                rows.writerow(shared)
            for i, values in enumerate(scan.values.tolist()):
                own = shared | dict(zip(sensor.names, values, strict=True))
                if scan.score is not None:
                    own["score"] = float(scan.score[i])
                if scan.likeness is not None:
                    gap = np.abs(_likeness(sensor) - scan.likeness[i]).sum(1)
                    own["looks"] = traffic.kind_names[int(gap.argmin())]
                rows.writerow(own)


def write_truth(path: str | Path, truth: TrafficTruth) -> None:
    """Write who was where as the table that `truth_path` names; makes the folder."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    time = np.repeat(truth.time, np.diff(truth.offset))
    first = np.repeat(np.diff(truth.time, prepend=-np.inf) > 0.0, np.diff(truth.offset))  # two sensors may scan at once
    told = [values[first].tolist() for values in (truth.label, time, truth.x, truth.y)]
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        rows = table.writer(file)
        rows.writerow(TRUTH)
        rows.writerows(zip(*told, strict=True))


# Scans


def _row(path: str, number: int, row: dict[str, str], traffic: Traffic) -> Row:
    where = f"{path}, row {number}"
    time, name = number_of(where, "t", row["t"]), (row["sensor"] or "").strip()
    known = {sensor.name: sensor for sensor in traffic.sensors}
    if name not in known:
        raise InputError(
            f"{where}: sensor is '{name}', but the model has {sorted(known)}; add it to the model's sensors, "
            "or correct the name"
        )
    sensor, where = known[name], f"{where}, sensor {name}"
    if missing := [column for column in sensor.names if column not in row]:
        raise InputError(
            f"{where}: it measures {', '.join(sensor.names)}, but there is no column {missing[0]}; "
            "name the columns as the model's sensor does"
        )
    given, pose = [(row[column] or "").strip() for column in sensor.names], [column in row for column in POSE]
    values = [number_of(where, column, row[column]) for column in sensor.names] if any(given) else None
    for column, value in zip(sensor.names, values or (), strict=False):
        if np.isfinite(sensor.period[sensor.names.index(column)]) and abs(value) > ANGLE:
            raise InputError(f"{where}: {column} is {value:g}, beyond 2 pi; give radians (degrees times pi / 180)")
    if any(pose) and not all(pose):
        raise InputError(
            f"{where}: there is no column {POSE[pose.index(False)]}; give all of {', '.join(POSE)}, or none"
        )
    at = tuple(number_of(where, column, row[column]) for column in POSE) if all(pose) else (0.0, 0.0, 0.0)
    score = (row.get("score") or "").strip()
    looks = (row.get("looks") or "").strip()
    if looks:
        _check_looks(where, looks, sensor, traffic)
    return Row(where, sensor, time, at, values, number_of(where, "score", score) if score else None, looks)


def _check_looks(where: str, looks: str, sensor: Sensor, traffic: Traffic) -> None:
    if looks not in traffic.kind_names:
        raise InputError(f"{where}: looks is '{looks}'; give one of the model's kinds, {list(traffic.kind_names)}")
    if sensor.confusion is None or len(sensor.confusion[0]) != len(traffic.kinds):
        raise InputError(
            f"{where}: it looks like a {looks}, but the model does not say how often the sensor errs in that; "
            "give the sensor a confusion with a column for each kind, or empty the cell"
        )


def _scan(rows: list[Row], traffic: Traffic) -> Scan:
    """The scan that rows of one sensor and time make."""
    head, seen = rows[0], [row for row in rows if row.values is not None]
    for row in rows:
        if row.pose != head.pose:
            raise InputError(
                f"{row.where}: the car is at {list(row.pose)}, but at {list(head.pose)} in another row of this scan; "
                "a scan has one time and one pose"
            )
    values = np.array([row.values for row in seen], dtype=np.float64).reshape(-1, len(head.sensor.names))
    scan = Scan(head.sensor.name, head.time, values, np.array(head.pose))
    if any(row.score is not None for row in seen):
        scan = scan._replace(score=np.array([NO_OPINION if row.score is None else row.score for row in seen]))
    if any(row.looks for row in seen):
        of_kind = dict(zip(traffic.kind_names, _likeness(head.sensor), strict=True))
        scan = scan._replace(likeness=np.array([of_kind.get(row.looks, np.ones(len(traffic.kinds))) for row in seen]))
    return scan


def _likeness(sensor: Sensor) -> Floats:
    """(L, C) p(looks l | kind) / p(looks l | false alarm)."""
    confusion = np.array(sensor.confusion, dtype=np.float64)
    return (confusion[:-1] / confusion[-1]).T


def _check_whole(path: str, rows: list[Row]) -> None:
    """A scan's rows stand together."""
    known, before = set[tuple[str, float]](), None
    for row in rows:
        scan = (row.sensor.name, row.time)
        if scan != before and scan in known:
            raise InputError(
                f"{row.where}: its scan at {row.time:g} s began in an earlier row, with other scans between; "
                "put the rows of a scan one below the other"
            )
        known.add(scan)
        before = scan


# The truth


def _truth(path: str, vehicles: list[Recorded], scans: tuple[Scan, ...], traffic: Traffic) -> TrafficTruth:
    """Who is in view at the times of the scans."""
    time, first = np.unique([scan.time for scan in scans], return_index=True)
    span = min(v.t[0] for v in vehicles), max(v.t[-1] for v in vehicles)
    if span[0] > time[-1] or span[1] < time[0]:
        raise InputError(
            f"{path}: the truth is of {span[0]:g} to {span[1]:g} s, the scans are of {time[0]:g} to {time[-1]:g} s; "
            "give both on the same clock"
        )
    steps = np.concatenate([np.diff(v.t) for v in vehicles])
    longest = GAP * float(np.median(steps)) if len(steps) else 0.0
    place = np.full((len(time), len(vehicles), 2), np.nan)
    heading = np.full((len(time), len(vehicles)), np.nan)
    for i, v in enumerate(vehicles):
        there = (time >= v.t[0]) & (time <= v.t[-1])
        after = np.clip(np.searchsorted(v.t, time), 1, max(len(v.t) - 1, 1))
        if len(v.t) > 1:
            there &= (v.t[after] - v.t[after - 1] <= longest) | np.isin(time, v.t)
        for axis in (0, 1):
            place[there, i, axis] = np.interp(time[there], v.t, v.points[:, axis])
        if v.heading is not None:
            heading[there, i] = wrap(np.interp(time[there], v.t, np.unwrap(v.heading)))
    used = {scan.sensor for scan in scans}
    seen = np.zeros(place.shape[:2], dtype=bool)
    for t, pose in enumerate(scans[k].pose for k in first):
        body = Body(place[t, :, 0], place[t, :, 1], 0.0, 0.0)
        for sensor in traffic.sensors:
            if sensor.name in used:
                seen[t] |= sensor.view(body, tuple(mounted(pose, sensor.mount)), sensor.view_settings, np) > 0.5
    when, who = np.nonzero(seen)
    unknown = np.full(len(when), np.nan)
    x, y = place[when, who].T
    offset = np.concatenate([[0], np.cumsum(seen.sum(1))]).astype(np.int64)
    kind = np.full(len(when), -1, dtype=np.int64)
    label = who.astype(np.int64)
    return TrafficTruth(time, offset, label, x, y, unknown, unknown, heading[when, who], unknown, unknown, kind)
