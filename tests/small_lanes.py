"""Small scenes for tests of lane courses: junctions of the protocol whose structure and routes are given."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.protocol import protocol
from experiments.scenarios.scene import Scene
from models.intersection.routes import RoutedTracks, Routes

STRUCTURE = ("centre", "angle", "gap", "entries", "exits", "width")


def true_routes(scene: Scene) -> RoutedTracks:
    """The tracks of a scene with its true structure and routes."""
    truth = scene.truth
    structure = {name: getattr(truth, name) for name in STRUCTURE} | {"num_arms": np.asarray(len(truth.angle))}
    return RoutedTracks(scene.data, structure, Routes(truth.connections, truth.track_lane))


def small_scene(seed: int = 1, position_std: float = 1.0) -> Scene:
    """A junction with few lanes."""
    return protocol(seed, position_std=position_std, tracks=2, max_lanes=2)


def error(line: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    """Mean distance of the points of a true line, 5 m from its ends, from the polyline `line` [m]."""
    steps = np.diff(line, axis=0)
    apart = true[20:-20, None] - line[:-1]
    share = np.clip((apart * steps).sum(-1) / (steps**2).sum(-1), 0.0, 1.0)
    return float(np.linalg.norm(apart - share[..., None] * steps, axis=-1).min(1).mean())
