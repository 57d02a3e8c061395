"""What one standing vehicle sees of a junction: neither far nor through other vehicles.

The papers claim robustness to occlusion without a protocol for it ([M20] section VI); this one is ours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.scene import Floats, Ints, JunctionTruth, join_tracks
from models.intersection.tracks import Tracks

RANGE = 60.0  # of the sensor [m]
OBSTACLES = 3  # standing vehicles
OBSTACLE_RADIUS = 2.0  # a van, from any side [m]
BRIDGED = 5  # points that a tracker coasts over, for the edge of a shadow is crossed to and fro in noise
SHORTEST = 10  # points of a piece that still counts as a track


def occlude(data: Tracks, track_lane: Ints, truth: JunctionTruth, rng: np.random.Generator) -> tuple[Tracks, Ints]:
    """Keep what an ego vehicle sees that waits on an entry of a random arm, 5 m before the interior.

    It sees 60 m far. Three vans stand 8 to 25 m away within 60 degrees of the centre's direction and
    hide what lies behind them. A track that disappears for more than 5 points and comes back becomes
    two; pieces seen in fewer than 10 points are lost. Whole lanes may stay unseen: the truth still
    holds them."""
    arm = rng.integers(len(truth.angle))
    ego = _waiting_place(truth, int(arm), int(rng.integers(truth.entries[arm])))
    ahead = np.arctan2(*(truth.centre - ego)[::-1])
    bearing = ahead + np.radians(60.0) * rng.uniform(-1.0, 1.0, OBSTACLES)
    distance = rng.uniform(8.0, 25.0, OBSTACLES)
    vans = ego + distance[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    seen = visible(data.points, ego, vans)
    points, headings, lanes = [], [], []
    for lane, begin, end in zip(track_lane, data.offsets[:-1], data.offsets[1:], strict=True):
        kept = begin + np.flatnonzero(seen[begin:end])
        for run in np.split(kept, np.flatnonzero(np.diff(kept) > BRIDGED + 1) + 1):
            if len(run) >= SHORTEST:
                piece = np.arange(run[0], run[-1] + 1)
                points.append(data.points[piece])
                headings.append(piece if data.heading is None else data.heading[piece])
                lanes.append(lane)
    return join_tracks(points, None if data.heading is None else headings), np.array(lanes, dtype=np.int64)


def visible(points: Floats, ego: Floats, vans: Floats) -> NDArray[np.bool_]:
    """Which points (N, 2) lie in range of the ego vehicle and behind none of the vans (M, 2), (N,)."""
    ray, van = points - ego, vans - ego
    far = np.linalg.norm(ray, axis=1)
    distance = np.linalg.norm(van, axis=1)
    half = np.arcsin(OBSTACLE_RADIUS / distance)  # half the sector a van covers, (M,)
    aside = ray @ van.T / (far[:, None] * distance).clip(min=1e-9)  # cosine, (N, M)
    hidden = (aside > np.cos(half)) & (far[:, None] > distance)
    return (far < RANGE) & ~hidden.any(1)


def _waiting_place(truth: JunctionTruth, arm: int, lane: int) -> Floats:
    """The point of an entry lane 5 m before the interior, taken from a line that starts on it."""
    line = truth.lines[int(np.flatnonzero((truth.connections[:, :2] == (arm, lane)).all(1))[0])]
    out = np.linalg.norm(line - truth.centre, axis=1)
    inside = int(np.argmax(out < truth.radius[arm] + 5.0))
    return line[inside]
