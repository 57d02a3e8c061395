"""Recorded vehicles at real junctions: drone and tower video, real behaviour, real noise.

The truth is the map's; recorded traffic agrees with it within 0.3 to 0.9 m only. Arms that nobody
drove are not scored, but a driven arm is scored with all its lanes, though not every lane is driven on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios import csv_tracks, junction, paths
from experiments.scenarios.csv_tracks import MIN_LENGTH
from experiments.scenarios.protocol import counts
from experiments.scenarios.scene import Floats, Scene
from models.program import InputError

RADIUS = 75.0  # from the centre: maps end 60 m beyond the crossing area, up to 15 m wide [m]
MOTOR = ("car", "truck", "bus", "van", "motorcycle")  # who keeps to the lanes


def traffic(
    name: str = "lankershim_2", data_root: str = junction.DATA_ROOT, headings: bool = True, radius: float = RADIUS
) -> Scene:
    """Recorded tracks of 30 m or more near the centre of a real junction.

    name      of a file in data_root/trajectories
    headings  hand over the measured headings
    radius    distance from the centre to which tracks are part of the junction [m]

    Stops are removed, a point every metre is left, and the origin is the centre of the junction.
    Raises InputError for a name or a data folder that is not there, and where no track is left."""
    files = junction.find(data_root, "trajectories", ".csv.gz")
    vehicles = csv_tracks.read(junction.pick(name, files, "recording"), MOTOR)
    truth, quality = junction.read(name, data_root)
    shift = junction.origin(name, data_root)
    pieces = []
    for vehicle in vehicles:
        points, heading = csv_tracks.even(vehicle._replace(points=vehicle.points - shift))
        near = _longest_run(np.linalg.norm(points, axis=1) <= radius)
        if len(near) > MIN_LENGTH:
            pieces.append((points[near], heading[near] if headings and heading is not None else None))
    if not pieces:
        raise InputError(
            f"{files[name]}: none of {len(vehicles)} vehicles drives {MIN_LENGTH:g} m within {radius:g} m "
            "of the centre; choose another recording"
        )
    data = csv_tracks.join(pieces)
    driven = driven_arms([points for points, _ in pieces], truth.angle)
    truth = truth._replace(track_lane=np.full(len(pieces), -1, dtype=np.int64), driven=driven)
    info = {
        "scenario": "traffic",
        "recording": name,
        "radius": radius,
        "quality": quality,
        "vehicles": len(vehicles),
        "heading": "none" if data.heading is None else "measured",
        "driven_arms": int(driven.sum()),
        **counts(truth, data),
    }
    return Scene(data, truth, f"{name} (recorded)", info)


def driven_arms(tracks: list[Floats], angle: Floats) -> NDArray[np.bool_]:
    """Arms (K,) towards which two or more tracks begin or end, 25 m or more from the centre and within 15 degrees."""
    ends = np.array([end for points in tracks for end in (points[0], points[-1])])
    bearing = np.arctan2(ends[:, 1], ends[:, 0])
    apart = np.abs(paths.wrap(bearing[:, None] - angle))  # (2T, K)
    on_arm = (apart <= np.radians(15.0)) & (apart == apart.min(1, keepdims=True))
    return (on_arm & (np.linalg.norm(ends, axis=1) >= 25.0)[:, None]).sum(0) >= 2


def names(data_root: str = junction.DATA_ROOT) -> list[str]:
    """Names of the recordings."""
    return list(junction.find(data_root, "trajectories", ".csv.gz"))


def _longest_run(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Indices of the longest run of True, (m,)."""
    kept = np.flatnonzero(flags)
    return max(np.split(kept, np.flatnonzero(np.diff(kept) > 1) + 1), key=len)
