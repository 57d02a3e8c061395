"""What an object is comes from the camera's looks and from how it moves ([K15], III-C and V-B)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from hydra import compose, initialize_config_module
from scipy.optimize import linear_sum_assignment

from experiments.command import plain
from experiments.scenarios.scene import Scene, TrafficTruth
from experiments.scenarios.urban_sensors import urban_sensors
from experiments.schema import build
from inference.lmb import run
from inference.tracks import Tracks

ALL = ("radar", "laser", "camera")
SETTLED = 2.0  # from when on tracks are judged [s]
CLOSE = 3.0  # of a track to what it follows [m]
SEEDS = (0, 1, 2)
CAMERA = np.array([1.5, 0.0])  # where the camera is [m]
HALF, REACH = 0.9774 / 2, 110.0  # of its view [rad], [m]


@lru_cache
def followed(sensors: tuple[str, ...]) -> dict[str, float]:
    """Probability of the true kind, error across the camera's line of sight [m], and missed share, in the camera's
    view, of all seeds together."""
    with initialize_config_module("configs", version_base="1.3"):
        model = build(plain(compose("run", ["model=traffic_urban"]))["model"], "model")
    kind, across, missed, total = list[float](), list[float](), 0, 0
    for seed in SEEDS:
        scene = urban_sensors(seed=seed, number=20, duration=6.0, sensors=sensors)
        k, a, m, n = _judged(scene, run(model, scene.data.scans))
        kind, across, missed, total = kind + k, across + a, missed + m, total + n
    return {"kind": float(np.mean(kind)), "across": float(np.median(across)), "missed": missed / total}


def _judged(scene: Scene, tracks: Tracks) -> tuple[list[float], list[float], int, int]:
    truth: TrafficTruth = scene.truth
    kind, across, missed, total = list[float](), list[float](), 0, 0
    for t in np.flatnonzero(tracks.time > SETTLED)[::10]:
        true = slice(*truth.offset[np.abs(truth.time - tracks.time[t]).argmin() + np.arange(2)])
        place = np.stack([truth.x[true], truth.y[true]], 1)
        x, y = (place - CAMERA).T
        seen = np.flatnonzero((np.abs(np.arctan2(y, x)) < HALF - 0.05) & (np.hypot(x, y) < REACH))
        now = tracks.at(int(t))
        sure = np.flatnonzero(now.existence > 0.5)
        gap = place[seen][:, None] - now.mean[sure, :2]
        distance = np.hypot(gap[..., 0], gap[..., 1])
        pairs = [
            p for p in zip(*linear_sum_assignment(np.minimum(distance, CLOSE)), strict=True) if distance[p] < CLOSE
        ]
        missed, total = missed + len(seen) - len(pairs), total + len(seen)
        for i, j in pairs:
            line = place[seen[i]] - CAMERA
            across.append(abs(gap[i, j] @ np.array([-line[1], line[0]])) / np.hypot(*line))
            kind.append(float(now.kind[sure[j], truth.kind[true][seen[i]]]))
    return kind, across, missed, total


def test_camera_tells_what_objects_are() -> None:
    assert followed(ALL)["kind"] > 0.9


def test_without_camera_kinds_are_less_sure_but_objects_are_not_lost() -> None:
    with_camera, without = followed(ALL), followed(("radar", "laser"))
    assert without["kind"] < with_camera["kind"] - 0.1
    assert without["kind"] > 0.5, "how they move tells something, too: a third would be none"
    assert without["missed"] == pytest.approx(with_camera["missed"], abs=0.02)


def test_without_camera_and_laser_the_lateral_error_grows() -> None:
    radar, both = followed(("radar",)), followed(("radar", "camera"))
    assert radar["across"] > 1.5 * both["across"]
    assert both["kind"] > radar["kind"] + 0.1
