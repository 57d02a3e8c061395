"""A sequential model written once: its window program is the exact joint density, and any engine runs on it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from inference import importance, least_squares
from models.program import InputError, check, log_joint, simulate
from models.toys.linear_walk import Fix, LinearWalk
from models.unroll import observe_frames, stack_frames, unroll

MODEL = LinearWalk()
BLANK = tuple(Fix(None, seconds) for seconds in (1.0, 1.0, 0.3, 2.0, 1.0))
FRAMES, TRUTH = observe_frames(BLANK, {n: v[0] for n, v in simulate(MODEL, BLANK, num=1, seed=4).items()})
EXACT = MODEL.exact(FRAMES)


def dense() -> tuple[np.ndarray, np.ndarray]:
    """Covariance (2 T, 2 T) of all states and the matrix (T, 2 T) that reads positions, by brute force."""
    num = len(BLANK)
    blocks = [[np.zeros((2, 2))] * num for _ in range(num)]
    blocks[0][0] = np.diag(MODEL.start_std) ** 2
    for t in range(1, num):
        dt = BLANK[t].seconds
        F, q = np.array([[1.0, dt], [0.0, 1.0]]), MODEL.jolt
        for s in range(t):
            blocks[t][s] = F @ blocks[t - 1][s]
            blocks[s][t] = blocks[t][s].T
        Q = q**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        blocks[t][t] = F @ blocks[t - 1][t - 1] @ F.T + Q
    return np.block(blocks), np.kron(np.eye(num), [1.0, 0.0])


def log_normal(x: np.ndarray, covariance: np.ndarray) -> float:
    _, log_volume = np.linalg.slogdet(2.0 * math.pi * covariance)
    return float(-0.5 * (x @ np.linalg.solve(covariance, x) + log_volume))


def test_log_joint_of_the_window_is_the_exact_joint() -> None:
    draws = simulate(unroll(MODEL), BLANK, num=3, seed=1)
    states = {name: value for name, value in draws.items() if name.startswith("walk")}
    covariance, read = dense()
    found = log_joint(unroll(MODEL), states, FRAMES)
    y = np.array([float(frame.position) for frame in FRAMES])
    for row, z in zip(found, stack_frames(states, 1)["walk"].reshape(3, -1), strict=True):
        expected = log_normal(z, covariance) + log_normal(y - read @ z, MODEL.noise_std**2 * np.eye(len(y)))
        assert float(row) == pytest.approx(expected, rel=1e-10)


def test_kalman_smoother_is_the_dense_posterior() -> None:
    """The oracle of the filters, held against plain algebra."""
    covariance, read = dense()
    y = np.array([float(frame.position) for frame in FRAMES])
    spread = read @ covariance @ read.T + MODEL.noise_std**2 * np.eye(len(y))
    gain = covariance @ read.T @ np.linalg.inv(spread)
    after = covariance - gain @ read @ covariance
    np.testing.assert_allclose(EXACT.smoothed_mean.reshape(-1), gain @ y, atol=1e-10)
    for t, found in enumerate(EXACT.smoothed_covariance):
        np.testing.assert_allclose(found, after[2 * t : 2 * t + 2, 2 * t : 2 * t + 2], atol=1e-10)
    assert EXACT.log_evidence == pytest.approx(log_normal(y, spread), rel=1e-10)
    np.testing.assert_array_equal(EXACT.filtered_mean[-1], EXACT.smoothed_mean[-1])


def test_least_squares_on_the_window_is_the_kalman_smoother() -> None:
    """The mode and the evidence to rounding, spreads within four standard errors of 4000 draws."""
    found = least_squares.run(MODEL, FRAMES, seed=1, num_draws=4000)
    assert found.log_evidence == pytest.approx(EXACT.log_evidence, abs=1e-6)
    np.testing.assert_allclose(stack_frames(found.estimate, 0)["walk"], EXACT.smoothed_mean, atol=1e-4)
    variance = np.diagonal(EXACT.smoothed_covariance, axis1=1, axis2=2)
    error = variance * math.sqrt(2.0 / 4000)
    assert np.all(np.abs(stack_frames(found.draws, 2)["walk"].var((0, 1)) - variance) < 4.0 * error)


def test_importance_sampling_on_the_window_is_the_kalman_smoother() -> None:
    found = importance.run(unroll(MODEL), FRAMES, seed=1, num_draws=500)
    assert found.log_evidence == pytest.approx(EXACT.log_evidence, abs=4 * found.info["log_evidence_error"])
    walk = np.einsum("cn,cnti->ti", found.weights, stack_frames(found.draws, 2)["walk"])
    sd = np.sqrt(np.diagonal(EXACT.smoothed_covariance, axis1=1, axis2=2))
    assert np.all(np.abs(walk - EXACT.smoothed_mean) < 4.5 * sd / math.sqrt(found.info["ess"]))  # ten numbers


def test_window_passes_the_check_of_the_seam_and_names_sites_by_frame() -> None:
    check(MODEL, FRAMES)
    assert sorted(TRUTH) == [f"walk_{t}" for t in range(5)]
    assert all(frame.position is not None for frame in FRAMES)


def test_observations_that_are_there_stay() -> None:
    given = (BLANK[0]._replace(position=torch.tensor(3.0)), *BLANK[1:])
    draws = {n: v[0] for n, v in simulate(MODEL, given, num=1, seed=2).items()}
    assert "position_0" not in draws
    frames, latents = observe_frames(given, draws)
    assert float(frames[0].position) == 3.0 and frames[1].position is draws["position_1"]
    assert set(latents) == {f"walk_{t}" for t in range(5)}


def test_no_frames_are_refused() -> None:
    with pytest.raises(InputError, match=r"^a sequential model needs at least one frame"):
        unroll(MODEL)(())
