"""Smoothing along given measurements: dense Gaussian algebra, the minimum of the squares, truth, the engine."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.optimize import least_squares

from experiments.scenarios.close_targets import close_targets
from experiments.tracking_metrics import metrics
from inference import lmb, smoothing
from inference.lmb_association import associate
from inference.smoothing import smooth
from inference.track_weight import Track, Window, follow, window_of
from models.objects.motion import ConstantTurn, ConstantVelocity
from models.objects.scans import Scan
from models.objects.scene import simulate_scan
from models.objects.sensors import Position, RangeBearing
from models.objects.traffic import Kind, Traffic
from models.program import InputError
from tests.small_windows import small_model, small_scans

ONE_KIND = (Kind(noise=(0.5, 0.8), lifetime=40.0, speed=(0.0, 3.0)),)


def steps_of(window: Window, first: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """F and Q of a linear motion, scan after scan."""
    found = []
    for dt in window.seconds[first + 1 :]:
        block = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        found.append((np.eye(4) + dt * np.eye(4, k=2), np.kron(block, np.diag(np.square(ONE_KIND[0].noise)))))
    return found


@pytest.mark.parametrize("track", [(0, 2, 5, 7), (0, 7), (1, 3), (4, 6)])
def test_linear_models_are_smoothed_as_dense_algebra_does(track: Track) -> None:
    """All states and measurements in one Gaussian; the second gap is longer than a step of the filter."""
    model = small_model(ONE_KIND)
    scans = small_scans((2, 3, 0, 2, 1))
    scans = tuple(s._replace(time=s.time + 0.9 * (t > 1)) for t, s in enumerate(scans))
    window = window_of(model, scans)
    first, z = int(window.scan[track[0]]), np.concatenate([scan.values for scan in scans])
    at = int(window.prior[first].offset[track[0] - window.offset[first]])
    means, blocks = [window.prior[first].mean[at]], [[window.prior[first].covariance[at]]]
    for F, Q in steps_of(window, first):
        means.append(F @ means[-1])
        row = [F @ block for block in blocks[-1]]
        blocks.append([*row, row[-1] @ F.T + Q])
    num = len(means)
    joint = np.block([[blocks[a][b] if b <= a else blocks[b][a].T for b in range(num)] for a in range(num)])
    H = np.zeros((2 * len(track), 4 * num))
    for i, g in enumerate(track):
        H[2 * i : 2 * i + 2, 4 * (window.scan[g] - first) : 4 * (window.scan[g] - first) + 2] = np.eye(2)
    R = np.kron(np.eye(len(track)), np.diag([1.0, 1.5**2]))
    K = joint @ H.T @ np.linalg.inv(H @ joint @ H.T + R)
    mean = (np.concatenate(means) + K @ (z[list(track)].ravel() - H @ np.concatenate(means))).reshape(num, 4)
    covariance = joint - K @ H @ joint
    found = smooth(model, window, track)
    assert found.converged
    np.testing.assert_allclose(found.mean, mean, atol=1e-8)
    for s in range(num):
        np.testing.assert_allclose(found.covariance[s], covariance[4 * s : 4 * s + 4, 4 * s : 4 * s + 4], atol=1e-8)


def polar(seed: int = 0) -> tuple[Traffic, Window, Track]:
    """One object that passes a sensor closely, range and bearing of it; the motion is linear, the sensor is not."""
    sensor = RangeBearing(name="radar", noise_std=(0.5, 0.15), detection=0.9, clutter=1.0)
    model = Traffic((sensor,), ConstantVelocity(), (Kind(noise=(0.5, 0.5), lifetime=1e3, speed=(0.0, 8.0)),))
    rng = np.random.default_rng(seed)
    scans = []
    for t in np.arange(0.0, 4.01, 0.4):
        x, y = -8.0 + 4.0 * t, 4.0
        z = np.array([[math.hypot(x, y), math.atan2(y, x)]]) + rng.standard_normal((1, 2)) * [0.5, 0.15]
        scans.append(Scan("radar", float(t), z, np.zeros(3)))
    return model, window_of(model, scans), tuple(range(len(scans)))


def test_nonlinear_sensors_are_smoothed_to_the_minimum_of_the_squares() -> None:
    model, window, track = polar()
    prior, num = window.prior[0], len(track)
    steps = []
    for dt in window.seconds[1:]:
        block = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        steps.append((np.eye(4) + dt * np.eye(4, k=2), np.linalg.cholesky(np.kron(block, 0.25 * np.eye(2)))))
    root = np.linalg.cholesky(prior.covariance[0])

    def residuals(flat: np.ndarray) -> np.ndarray:
        x = flat.reshape(num, 4)
        parts = [np.linalg.solve(root, x[0] - prior.mean[0])]
        parts += [np.linalg.solve(L, x[s + 1] - F @ x[s]) for s, (F, L) in enumerate(steps)]
        z = np.concatenate([scan.values for scan in window.scans])
        parts += [(z[:, 0] - np.hypot(x[:, 0], x[:, 1])) / 0.5, (z[:, 1] - np.arctan2(x[:, 1], x[:, 0])) / 0.15]
        return np.concatenate(parts)

    found = smooth(model, window, track, max_iterations=50, tolerance=1e-10)
    assert found.converged
    best = least_squares(residuals, found.mean.ravel(), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(found.mean, best.x.reshape(num, 4), atol=1e-5)
    once = smooth(model, window, track, max_iterations=0)
    assert not once.converged
    assert np.abs(once.mean - found.mean).max() > 1e-2  # the filter's own linearisation is not the minimum
    information = np.linalg.inv(best.jac.T @ best.jac)
    for s in range(num):
        own = information[4 * s : 4 * s + 4, 4 * s : 4 * s + 4]
        np.testing.assert_allclose(found.covariance[s], own, rtol=1e-3, atol=1e-4 * np.abs(own).max())


def turning(seed: int) -> tuple[Traffic, np.ndarray, list[Scan]]:
    """A vehicle that turns, seen by range and bearing: its true states (T, n) and scans."""
    sensor = RangeBearing(name="radar", noise_std=(0.5, 0.02), detection=0.95, clutter=0.0)
    kind = Kind(noise=(0.6, 0.15, 0.01), lifetime=1e4, speed=(8.0, 2.0))
    model, rng = Traffic((sensor,), ConstantTurn(), (kind,)), np.random.default_rng(seed)
    state, none, states, scans = np.array([20.0, -15.0, 1.5, 8.0, 0.1, 0.0]), np.zeros(1, dtype=np.int64), [], []
    for t in range(40):
        if t:
            moved = model.move(none, state[None], 0.1)
            state = moved.mean[0] + moved.noise[0] @ rng.standard_normal(moved.noise.shape[2])
        states.append(state)
        scans.append(simulate_scan(model, "radar", 0.1 * t, np.zeros(3), none, state[None], rng)[0])
    return model, np.array(states), scans


def test_turns_are_smoothed_to_the_minimum_of_the_squares() -> None:
    """Of a heading that is not the first of those that it may have; noise as it is at the states found."""
    sensor = RangeBearing(name="radar", noise_std=(0.3, 0.02), detection=0.9, clutter=1.0)
    kind = Kind(noise=(1.0, 0.5, 0.05), lifetime=1e3, speed=(8.0, 2.0))
    model, angle = Traffic((sensor,), ConstantTurn(), (kind,)), np.pi + 0.5 * np.arange(0.0, 2.41, 0.4)
    place = np.array([5.0, 10.0]) + 10.0 * np.stack([np.sin(angle), -np.cos(angle)], -1)  # at 5 m/s, counterclockwise
    noise = np.random.default_rng(0).standard_normal(place.shape) * [0.3, 0.02]
    z = np.stack([np.hypot(*place.T), np.arctan2(*place.T[::-1])], -1) + noise
    window = window_of(model, [Scan("radar", 0.4 * t, z[t : t + 1], np.zeros(3)) for t in range(len(z))])
    track = tuple(range(len(z)))
    (trail,) = follow(model, window, [track], [None], gate=math.inf)
    best = int(trail.rows[-1].weight.argmax())
    assert best > 0
    found = smooth(model, window, track, max_iterations=100, tolerance=1e-9)
    assert found.converged
    prior, none = window.prior[0], np.zeros(len(z) - 1, dtype=np.int64)
    moved = model.move(none, found.mean[:-1], 0.4)
    factor = np.linalg.cholesky(moved.noise @ moved.noise.swapaxes(1, 2))
    root = np.linalg.cholesky(prior.covariance[best])

    def residuals(flat: np.ndarray) -> np.ndarray:
        x = flat.reshape(len(z), 6)
        off = x[1:] - model.move(none, np.ascontiguousarray(x[:-1]), 0.4).mean
        bearing = z[:, 1] - np.arctan2(x[:, 1], x[:, 0])
        return np.concatenate(
            [
                np.linalg.solve(root, x[0] - prior.mean[best]),
                np.linalg.solve(factor, off[..., None]).ravel(),
                (z[:, 0] - np.hypot(x[:, 0], x[:, 1])) / 0.3,
                (bearing - 2 * np.pi * np.round(bearing / (2 * np.pi))) / 0.02,
            ]
        )

    least = least_squares(residuals, found.mean.ravel(), xtol=1e-14, ftol=1e-14, gtol=1e-14).x.reshape(len(z), 6)
    std = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    assert (np.abs(found.mean - least) / std).max() < 1e-3


def test_smoothed_positions_are_nearer_to_the_truth_than_filtered_ones() -> None:
    filtered, smoothed, nees = [], [], []
    for seed in range(8):
        model, states, scans = turning(seed)
        window = window_of(model, scans)
        track = tuple(range(len(window.scan)))
        begin, last = window.scan[[0, -1]]
        (trail,) = follow(model, window, [track], [None], gate=math.inf)
        best = int(trail.rows[-1].weight.argmax())
        rough = np.array([row.mean[best, :2] for row in trail.rows])
        fine = smooth(model, window, track)
        filtered.append(np.square(rough - states[begin : last + 1, :2]).sum(1).mean())
        gap = fine.mean[: last - begin + 1, :2] - states[begin : last + 1, :2]
        smoothed.append(np.square(gap).sum(1).mean())
        nees.append((gap[:, None] @ np.linalg.inv(fine.covariance[: len(gap), :2, :2]) @ gap[..., None]).mean())
    print("rms", np.sqrt(np.mean(filtered)), np.sqrt(np.mean(smoothed)), "nees", np.mean(nees))
    assert np.mean(smoothed) < 0.5 * np.mean(filtered)
    # 8 paths of 40 states, of which some ten are as good as independent: 2 +- 3 * 2 / sqrt(80)
    assert 1.3 < np.mean(nees) < 2.7


def test_the_filter_tells_whose_each_measurement_is() -> None:
    model = small_model(ONE_KIND, unseen_density=1e-4)
    model = dataclasses.replace(model, sensors=(dataclasses.replace(model.sensors[0], detection=0.95),))
    rng, scans, whose = np.random.default_rng(0), [], []
    for t in range(8):
        place = np.array([[-20.0 + t, 0.0], [20.0, 0.5 * t], [0.0, 30.0]])
        order = rng.permutation(2 + (t == 4))  # the third is a false alarm
        scans.append(Scan("plots", 0.4 * t, place[order] + 0.5 * rng.standard_normal((len(order), 2)), np.zeros(3)))
        whose.append(order.tolist())
    found = associate(model, scans, lmb.Knobs(), threshold=0.5, report=0.01, progress=False).measurements
    names = [{whose[s][j] for s, j in own} for own in found.values()]
    assert sorted(map(tuple, names)) == [(0,), (1,)]
    assert [len(own) for own in found.values()] == [8, 8]


def test_the_engine_smooths_what_the_filter_confirms() -> None:
    scene = close_targets(seed=1, number=3, duration=6.0)
    sensor = Position(name="plots", noise_std=(1.0, 1.0), detection=0.95, clutter=5, extent=250)
    kind = Kind(noise=(1.0, 1.0), speed=(0.0, 10.0))
    model = Traffic((sensor,), ConstantVelocity(), (kind,), unseen_density=1e-6)
    frames = model.prepare(scene.data)
    before, after = lmb.run(model, frames), smoothing.run(model, frames)
    for name in ("label", "existence", "offset", "time"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    rough, fine = (metrics(tracks, scene)["position_error_m"] for tracks in (before, after))
    assert fine < 0.85 * rough  # .77: where neighbours are mistaken, smoothing mistakes them, too
    assert after.info["smoothed"] == 3
    window = window_of(model, frames)
    found = associate(model, window.scans, lmb.Knobs(), threshold=0.5, report=0.01, progress=False).measurements
    for label, own in found.items():  # from its first measurement on
        track = tuple(int(window.offset[s]) + j for s, j in own)
        rows = np.flatnonzero((after.label == label) & (after.scan >= own[0][0]))
        path = smooth(model, window, track)
        np.testing.assert_array_equal(after.mean[rows], path.mean[after.scan[rows] - own[0][0]])
        np.testing.assert_array_equal(after.covariance[rows], path.covariance[after.scan[rows] - own[0][0]])
    again = smoothing.run(model, frames[::-1])
    np.testing.assert_array_equal(again.mean, after.mean)


def test_another_model_is_refused_in_words() -> None:
    with pytest.raises(InputError, match="lmb_smoothed needs a model of many objects"):
        smoothing.run(object(), small_scans())  # type: ignore[arg-type]
