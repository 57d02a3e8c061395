"""How objects move: the integrals of their motion, and of the white noise that drives it."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm

from models.objects.motion import ConstantTurn, ConstantVelocity, Motion, move_formula, noise_formula
from models.program import InputError

Floats = NDArray[np.float64]
BOX = ("length", "width")
MOTIONS = {
    "constant velocity": ConstantVelocity(),
    "constant velocity with a heading": ConstantVelocity(extras=("heading", *BOX)),
    "constant turn": ConstantTurn(accelerates=False),
    "constant turn and acceleration": ConstantTurn(extras=BOX),
}


def states(motion: Motion, num: int = 20) -> Floats:
    rng = np.random.default_rng(3)
    spread = {"x": 30.0, "y": 30.0, "speed": 8.0, "vx": 8.0, "vy": 8.0, "heading": 3.0, "yaw_rate": 0.3}
    found = rng.normal(size=(num, len(motion.names))) * [spread.get(name, 1.0) for name in motion.names]
    if "yaw_rate" in motion.names:
        found[:3, motion.names.index("yaw_rate")] = [0.0, 1e-9, -1e-9]
    return found


def settings(motion: Motion, dt: float, std: Floats | None = None) -> Floats:
    """One row of what a step depends on."""
    return np.array([[dt, *(np.ones(len(motion.noises)) if std is None else std)]])


@pytest.mark.parametrize("name", MOTIONS)
def test_machine_code_casadi_and_torch_agree(name: str) -> None:
    motion = MOTIONS[name]
    x, std = states(motion), np.linspace(0.1, 0.7, len(motion.noises))
    there, p = torch.from_numpy(x), settings(motion, 0.3, std)[0].tolist()
    for formula in (move_formula(motion), noise_formula(motion)):
        y = formula(x, np.array([p]))
        np.testing.assert_allclose(y, formula.torch(there, torch.tensor(p, dtype=torch.float64)).numpy(), atol=1e-12)
        np.testing.assert_allclose(y[4], np.array(formula.casadi()(x[4], p)).ravel(), atol=1e-12)


@pytest.mark.parametrize("name", MOTIONS)
def test_slopes_are_those_of_torch(name: str) -> None:
    motion = MOTIONS[name]
    x, p, n = states(motion), settings(motion, 0.3), len(motion.names)
    y, J, q = np.empty((len(x), n)), np.empty((len(x), n, n)), torch.from_numpy(p[0])
    move_formula(motion).compiled()(x, p, y, J)
    slopes = torch.func.vmap(torch.func.jacrev(lambda v: move_formula(motion).torch(v, q)))(torch.from_numpy(x))
    np.testing.assert_allclose(J, slopes.numpy(), atol=1e-12)


def turning(state: Floats) -> Floats:
    """d/dt (x, y, heading, speed, yaw rate, acceleration)."""
    _, _, heading, speed, rate, a = state
    return np.array([speed * math.cos(heading), speed * math.sin(heading), rate, a, 0.0, 0.0])


@pytest.mark.parametrize("rate", [0.0, 1e-12, 0.05, -0.6])
def test_turn_equals_its_differential_equation(rate: float) -> None:
    start = np.array([3.0, -2.0, 0.7, 12.0, rate, -1.5])
    found = move_formula(ConstantTurn())(start[None], settings(ConstantTurn(), 0.4))[0]
    exact = solve_ivp(lambda t, s: turning(s), (0.0, 0.4), start, method="RK45", rtol=1e-11, atol=1e-11).y[:, -1]
    np.testing.assert_allclose(found, exact, atol=2e-8)  # Gauss's error: 12 m/s * (.6 / s)^6 * (.4 s)^7 / 2e6


def test_constant_turn_is_the_turn_without_acceleration() -> None:
    start = np.array([[3.0, -2.0, 0.7, 12.0, 0.3, 0.0]])
    p = settings(ConstantTurn(), 0.4)  # both have three noises, and no extras
    found = move_formula(ConstantTurn(accelerates=False))(start[:, :5], p)
    np.testing.assert_allclose(found, move_formula(ConstantTurn())(start, p)[:, :5], atol=1e-14)


def covariance(motion: Motion, x: Floats, dt: float, std: Floats) -> Floats:
    found = noise_formula(motion)(x[None], settings(motion, dt, std))[0].reshape(len(x), -1)
    return np.asarray(found @ found.T)


def integrated(A: Floats, B: Floats, dt: float) -> Floats:
    """int_0^dt e^(A s) B B' e^(A' s) ds, of dx = A x dt + B dW."""

    def rate(s: float) -> Floats:
        spread = expm(A * s) @ B
        return np.asarray(spread @ spread.T)

    return np.asarray(quad_vec(rate, 0.0, dt)[0])


def test_noise_of_constant_velocity_is_integrated_white_acceleration() -> None:
    motion, std = MOTIONS["constant velocity with a heading"], np.array([0.8, 0.3, 0.1, 0.2, 0.05])
    x, c, s = states(motion)[5], 0.0, 0.0
    c, s = math.cos(x[4]), math.sin(x[4])
    A, B = np.zeros((7, 7)), np.zeros((7, 5))
    A[0, 2] = A[1, 3] = 1.0
    B[2:4, :2] = np.array([[c, -s], [s, c]]) * std[:2]
    B[range(4, 7), range(2, 5)] = std[2:]
    np.testing.assert_allclose(covariance(motion, x, 0.7, std), integrated(A, B, 0.7), atol=1e-12)
    plain = covariance(MOTIONS["constant velocity"], x[:4], 0.7, np.array([0.5, 0.5]))
    B = np.vstack([np.zeros((2, 2)), 0.5 * np.eye(2)])
    np.testing.assert_allclose(plain, integrated(A[:4, :4], B, 0.7), atol=1e-12)


@pytest.mark.parametrize("accelerates", [False, True])
def test_noise_of_a_turn_is_integrated_white_noise_at_a_fixed_heading(accelerates: bool) -> None:
    motion, std = ConstantTurn(accelerates=accelerates), np.array([0.8, 0.3, 0.1])
    x, n = states(motion)[5], 5 + accelerates
    A, B = np.zeros((n, n)), np.zeros((n, 4))
    A[:2, 3], A[2, 4] = [math.cos(x[2]), math.sin(x[2])], 1.0  # the way that the noise of the heading has is left out
    if accelerates:
        A[3, 5] = 1.0
    B[5 if accelerates else 3, 0], B[4, 1], B[0, 2], B[1, 3] = std[0], std[1], std[2], std[2]
    np.testing.assert_allclose(covariance(motion, x, 0.7, std), integrated(A, B, 0.7), atol=1e-12)


def test_two_steps_make_the_noise_of_one() -> None:
    motion, std, x = ConstantVelocity(), np.array([0.8, 0.3]), states(ConstantVelocity())[2]
    F = np.eye(4)
    F[0, 2] = F[1, 3] = 0.3
    twice = F @ covariance(motion, x, 0.4, std) @ F.T + covariance(motion, x, 0.3, std)
    np.testing.assert_allclose(twice, covariance(motion, x, 0.7, std), atol=1e-12)


def test_nothing_moves_in_no_time() -> None:
    for motion in MOTIONS.values():
        x = states(motion)
        p = settings(motion, 0.0)
        np.testing.assert_array_equal(move_formula(motion)(x, p), x)
        assert not noise_formula(motion)(x, p).any()


def test_extras_are_random_walks() -> None:
    motion, std = ConstantTurn(extras=BOX), np.array([0.8, 0.3, 0.1, 0.2, 0.4])
    x = states(motion)[5]
    found = move_formula(motion)(x[None], settings(motion, 0.7, std))[0]
    np.testing.assert_array_equal(found[-2:], x[-2:])
    np.testing.assert_allclose(covariance(motion, x, 0.7, std)[-2:, -2:], 0.7 * np.diag(std[-2:] ** 2), rtol=1e-14)


def test_a_motion_that_forgets_an_entry_is_told() -> None:
    @dataclass(frozen=True)
    class Short(ConstantVelocity):
        def move(self, x: Any, dt: Any, ops: Any) -> Any:
            return super().move(x, dt, ops)[:3]

    @dataclass(frozen=True)
    class Long(ConstantVelocity):
        def noise(self, x: Any, dt: Any, std: Any, ops: Any) -> Any:
            return [(*column, 0.0) for column in super().noise(x, dt, std, ops)]

    x, step = np.zeros((1, 4)), np.full((1, 3), 0.1)
    with pytest.raises(InputError, match=re.escape("Short.move gives 3 values, but must give 4: (x, y, vx")):
        move_formula(Short())(x, step)
    with pytest.raises(InputError, match=r"a column of Long.noise gives 5 values, but must give 4"):
        noise_formula(Long())(x, step)
