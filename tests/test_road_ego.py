"""Detections of the past land where they belong, with covariances as wide as drift makes them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from models.program import InputError
from models.road.cues import Cues
from models.road.ego import Drift, Motion, compensate, fuse, integrate

Floats = NDArray[np.float64]
NONE = Drift(0.0, 0.0, 0.0, 0.0, 0.0)
TIME = np.linspace(0.0, 2.0, 41)
BEND = Motion(TIME, np.full(41, 0.2), np.zeros(41), 15.0)  # a circle of 75 m to the left


def seen(position: Floats, flow: Floats | None = None, variance: float = 0.04) -> Cues:
    num = len(position)
    return Cues(
        kind=np.array(["pole" if flow is None else "car"] * num),
        left=np.zeros(num, dtype=bool),
        track=np.zeros(num, dtype=np.int64),
        position=position,
        covariance=np.tile(np.diag([variance, 2.0 * variance]), (num, 1, 1)),
        flow=np.full(num, np.nan) if flow is None else flow,
        flow_std=np.full(num, 0.05),
        confidence=np.linspace(0.5, 0.9, num),
    )


def test_constant_turn_is_a_circle() -> None:
    way = integrate(BEND, NONE)
    angle = 0.2 * (TIME - 2.0)
    circle = np.stack([75.0 * np.sin(angle), 75.0 * (1.0 - np.cos(angle)), angle], -1)
    np.testing.assert_allclose(way.pose, circle, atol=1e-3)
    assert np.all(way.drift == 0.0)


def test_braking_on_a_straight_road_is_a_parabola() -> None:
    way = integrate(BEND._replace(yaw_rate=np.zeros(41), acceleration=np.full(41, -3.0)), NONE)
    back = TIME - 2.0
    np.testing.assert_allclose(way.pose[:, 0], 15.0 * back - 1.5 * back**2, atol=1e-9)
    np.testing.assert_allclose(way.pose[:, 1:], 0.0, atol=1e-12)


def test_what_stands_stays_where_it_is_and_turns_with_the_car() -> None:
    """A pole and a direction seen from every pose of the way come back as they are now."""
    pole, heading = np.array([60.0, 7.0]), 0.3
    pose = integrate(BEND, NONE).pose
    gap = pole - pose[:, :2]
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    then = np.stack([cos * gap[:, 0] + sin * gap[:, 1], cos * gap[:, 1] - sin * gap[:, 0]], -1)
    now = compensate(seen(then, heading - pose[:, 2]), TIME, BEND, NONE)
    np.testing.assert_allclose(now.position, np.tile(pole, (41, 1)), atol=1e-9)
    np.testing.assert_allclose(now.flow, heading, atol=1e-12)
    np.testing.assert_allclose(now.flow_std, 0.05)
    turned = np.einsum("nij,j->ni", now.covariance, [1.0, 0.0])
    np.testing.assert_allclose(turned[:, 0], 0.04 * (cos**2 + 2.0 * sin**2), atol=1e-9)


def test_drift_is_as_wide_as_simulated_readings_wander() -> None:
    """Covariances of 600 ways from readings with errors, against the one that is propagated: within 5 standard errors
    of a variance, sqrt(2 / 600), for the pose two seconds ago, and of where that puts a detection."""
    drift, rng, num = Drift(0.01, 0.02, 0.2, 0.1, 0.3), np.random.default_rng(0), 600
    short = Motion(TIME[::2], BEND.yaw_rate[::2], BEND.acceleration[::2], BEND.speed)
    poses = np.empty((num, 3))
    for pose in poses:
        steps = rng.standard_normal((2, len(short.time) - 1)) / math.sqrt(0.1)  # white noise over a step of 0.1 s
        bias = rng.standard_normal(3)
        pose[:] = wander(short, drift, steps, bias)
    way = integrate(short, drift)
    found, expected = np.cov(poses.T), way.drift[0]
    scale = np.sqrt(np.diag(expected))
    assert np.all(np.abs(found - expected) < 5 * np.outer(scale, scale) * math.sqrt(2 / num))
    cue = compensate(seen(np.array([[40.0, 3.0]])), np.array([0.0]), short, drift)
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    places = np.stack([poses[:, 0] + 40.0 * cos - 3.0 * sin, poses[:, 1] + 40.0 * sin + 3.0 * cos], -1)
    cos, sin = math.cos(way.pose[0, 2]), math.sin(way.pose[0, 2])
    R = np.array([[cos, -sin], [sin, cos]])
    expected = cue.covariance[0] - R @ np.diag([0.04, 0.08]) @ R.T
    scale = np.sqrt(np.diag(expected))
    assert np.all(np.abs(np.cov(places.T) - expected) < 5 * np.outer(scale, scale) * math.sqrt(2 / num))


def wander(motion: Motion, drift: Drift, steps: Floats, bias: Floats) -> Floats:
    """The pose at the first reading with these errors (2, M - 1) of steps and constant ones."""
    x = y = heading = 0.0
    speed = motion.speed + drift.speed_std * bias[0]
    for i in range(len(motion.time) - 1, 0, -1):
        dt = motion.time[i] - motion.time[i - 1]
        w = motion.yaw_rate[i] + drift.yaw_bias * bias[1] + drift.yaw_noise * steps[0, i - 1]
        a = motion.acceleration[i] + drift.acceleration_bias * bias[2] + drift.acceleration_noise * steps[1, i - 1]
        way, middle = (speed - 0.5 * a * dt) * dt, heading - 0.5 * w * dt
        x, y = x - way * math.cos(middle), y - way * math.sin(middle)
        heading, speed = heading - w * dt, speed - a * dt
    return np.array([x, y, heading])


def test_only_the_last_seconds_count() -> None:
    cues = seen(np.arange(82.0).reshape(41, 2))
    assert len(compensate(cues, TIME, BEND, NONE, period=1.01).kind) == 21
    assert len(compensate(cues, TIME, BEND, NONE, period=9.0).kind) == 41


def test_detections_of_one_object_fuse_to_their_weighted_mean() -> None:
    cues = seen(np.array([[10.0, 1.0], [10.4, 1.2], [9.0, 0.0]]))
    cues.covariance[1] *= 3.0
    cues.track[2] = 7
    fused = fuse(cues)
    np.testing.assert_allclose(fused.position, [[10.1, 1.05], [9.0, 0.0]])
    np.testing.assert_allclose(fused.covariance[0], np.diag([0.03, 0.06]))
    np.testing.assert_allclose(fused.confidence, [0.7, 0.9])
    driving = seen(np.array([[10.0, 1.0], [12.0, 1.0]]), np.zeros(2))
    assert len(fuse(driving).kind) == 2


def test_readings_that_are_no_motion_are_refused() -> None:
    with pytest.raises(InputError, match="finite readings at rising times, but has 41 of them from"):
        integrate(BEND._replace(time=TIME[::-1]), NONE)
    with pytest.raises(InputError, match="finite readings"):
        integrate(BEND._replace(speed=math.nan), NONE)
    with pytest.raises(
        InputError, match=r"cue 1 was detected at 2.5 s, but the car's motion is known from 0.0 s to 2.0 s"
    ):
        compensate(seen(np.eye(2)), np.array([1.0, 2.5]), BEND, NONE)
    with pytest.raises(InputError, match=r"yaw_noise of the drift must be finite and not negative, but is -1\.0"):
        dataclasses.replace(NONE, yaw_noise=-1.0)
