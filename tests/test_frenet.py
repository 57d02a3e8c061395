"""Frenet coordinates and the formulas of motion in them, against the plane."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.program import InputError
from planning.frenet import FrenetState, Pose, to_frenet, to_pose
from planning.kinematics import GUARDED, KINEMATICS, LIMITS, MARGINS, Limits
from planning.polynomials import NOTHING, Polynomials, quartics, quintics, squared_jerk
from planning.reference import ReferenceLine, from_curvature


def winding(amplitude: float, period: float) -> ReferenceLine:
    s = np.arange(0.0, 150.01, 0.5)
    return from_curvature(s, amplitude * np.sin(s / period), (3.0, -2.0, 0.7))


LINE = winding(0.05, 9.0)


@settings(max_examples=60)
@given(
    amplitude=st.floats(0.0, 0.12),
    period=st.floats(6.0, 40.0),
    s=st.floats(5.0, 140.0),
    share=st.floats(-0.8, 0.8),
    turned=st.floats(-1.2, 1.2),
    speed=st.floats(0.0, 30.0),
    acceleration=st.floats(-8.0, 4.0),
    curvature=st.floats(-0.3, 0.3),
)
def test_a_pose_comes_back(
    amplitude: float, period: float, s: float, share: float, turned: float, speed: float, acceleration: float,
    curvature: float,
) -> None:  # fmt: skip
    line = winding(amplitude, period)
    kappa = float(line.at(s)[3])
    d = share / kappa if abs(kappa) > 0.2 * abs(share) else 5.0 * share
    x, y = map(float, line.place(s, d))
    pose = Pose(x, y, float(line.at(s)[2]) + turned, speed, acceleration, curvature)
    state = to_frenet(line, pose, s)
    assert (state.s, state.d) == (pytest.approx(s, abs=1e-6), pytest.approx(d, abs=1e-6))
    np.testing.assert_allclose(to_pose(line, state), pose, atol=2e-5, rtol=1e-6)


def moved(t: np.ndarray, longitudinal: Polynomials, lateral: Polynomials) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions and the seven inputs of the kinematics at times t."""
    (s, ds, dds), (d, dd, ddd) = longitudinal.at(t)[0].T, lateral.at(t)[0].T
    told = LINE.at(s)
    return LINE.place(s, d), np.stack([ds, dds, told[:, 3], told[:, 4], d, dd, ddd], -1), told


def test_finite_differences_in_the_plane_confirm_speed_acceleration_and_curvature() -> None:
    longitudinal = quintics((10.0, 9.0, 0.5), [(45.0, 7.0, 0.0)], [4.0])
    lateral = quintics((-0.5, 0.3, 0.0), [(2.0, 0.0, 0.0)], [4.0])
    t, h = np.linspace(0.1, 3.8, 60), 1e-3
    (ahead, _, _), (here, x, _), (behind, _, _) = (moved(t + k * h, longitudinal, lateral) for k in (1, 0, -1))
    velocity, acceleration = (ahead - behind) / (2 * h), (ahead - 2 * here + behind) / h**2
    v = np.hypot(*velocity.T)
    along = (velocity * acceleration).sum(1) / v
    cross = velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]
    told = KINEMATICS(x, NOTHING)
    np.testing.assert_allclose(told[:, 0], v, rtol=1e-5)
    np.testing.assert_allclose(told[:, 1], along, atol=2e-3)
    np.testing.assert_allclose(told[:, 2], cross / v**3, atol=1e-4)


def test_emitted_formulas_are_casadis_and_torchs() -> None:
    rng = np.random.default_rng(0)
    x = np.column_stack([rng.uniform(-1, 20, 50), rng.normal(0, 3, 50), rng.normal(0, 0.05, 50),
                         rng.normal(0, 0.02, 50), rng.normal(0, 2, (50, 3))])  # fmt: skip
    p = np.array([[getattr(Limits(), name) for name in LIMITS]])
    emitted = MARGINS(x, p)
    traced = np.stack([np.array(MARGINS.casadi()(row, p[0])).ravel() for row in x])
    np.testing.assert_allclose(emitted, traced, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(emitted, MARGINS.torch(torch.tensor(x), torch.tensor(p)).numpy(), rtol=1e-13, atol=1e-13)
    assert emitted.shape[1] == len(GUARDED) + 2
    np.testing.assert_allclose(emitted[:, -2:], KINEMATICS(x, NOTHING)[:, [0, 2]], rtol=1e-13)


def test_each_margin_changes_sign_where_its_limit_is() -> None:
    limits = Limits(speed=15, acceleration=2, power=20, braking=5, lateral_acceleration=2, curvature=0.1)
    p = np.array([[getattr(limits, name) for name in LIMITS]])

    def broken(ds: float, dds: float, kappa: float = 0.0, d: float = 0.0) -> list[str]:
        margins = MARGINS(np.array([[ds, dds, kappa, 0.0, d, 0.0, 0.0]]), p)[0, : len(GUARDED)]
        return [name for name, margin in zip(GUARDED, margins, strict=True) if margin < 0]

    assert broken(14.9, 0.0) == [] and broken(15.1, 0.0) == ["speed"]
    assert broken(5.0, 1.9) == [] and broken(5.0, 2.1) == ["acceleration"]
    assert broken(12.0, 1.6) == [] and broken(12.0, 1.7) == ["power"]
    assert broken(5.0, -4.9) == [] and broken(5.0, -5.1) == ["braking"]
    assert broken(10.0, 0.0, 0.0199) == [] and broken(10.0, 0.0, 0.0201) == ["lateral acceleration"]
    assert broken(10.0, 0.0, -0.0201) == ["lateral acceleration"]
    assert broken(2.0, 0.0, 0.099) == [] and broken(2.0, 0.0, 0.101) == ["curvature"]
    assert broken(2.0, 0.0, -0.101) == ["curvature"]
    assert "leaves the reference line's normals" in broken(2.0, 0.0, 0.2, 4.6)
    assert "drives backwards" in broken(-0.1, 0.0)
    assert broken(0.0, 0.0, 0.2) == [], "at rest nothing is broken"


def test_an_offset_told_by_arc_length_is_the_same_motion() -> None:
    state = FrenetState(20.0, 8.0, -1.0, 0.7, 0.2, -0.03)
    kappa, rate = LINE.at(20.0)[3:]
    v, along, curvature, _ = KINEMATICS(np.array([[8.0, -1.0, kappa, rate, *state.lateral]]), NOTHING)[0]
    pose = to_pose(LINE, state)
    np.testing.assert_allclose((pose.speed, pose.acceleration, pose.curvature), (v, along, curvature), rtol=1e-9)


def test_a_standing_vehicle_keeps_its_direction() -> None:
    pose = Pose(*map(float, LINE.place(30.0, 1.0)), float(LINE.at(30.0)[2]) + 0.3, 0.0, 0.0, 0.05)
    np.testing.assert_allclose(to_pose(LINE, to_frenet(LINE, pose, 30.0)), pose, atol=1e-7)


def test_headings_come_back_whatever_their_turns() -> None:
    pose = Pose(*map(float, LINE.place(30.0, 1.0)), float(LINE.at(30.0)[2]) + 0.3, 3.0, 0.2, 0.05)
    turned = to_frenet(LINE, pose._replace(heading=pose.heading - 4 * math.pi), 30.0)
    np.testing.assert_allclose(turned, to_frenet(LINE, pose, 30.0), atol=1e-12)


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (Pose(math.nan, 0.0, 0.0, 1.0), "not finite"),
        (Pose(-20.0, -20.0, 0.7, 1.0), "before or after the line"),
        (Pose(*map(float, LINE.place(30.0, 0.0)), float(LINE.at(30.0)[2]) - 1.5, 1.0), "heads -86 degrees away"),
        (Pose(*map(float, LINE.place(30.0, 0.0)), float(LINE.at(30.0)[2]) + 2.0, 1.0), "heads 115 degrees away"),
    ],
)
def test_vehicles_off_the_line_are_refused_in_words(pose: Pose, words: str) -> None:
    with pytest.raises(InputError, match=words):
        to_frenet(LINE, pose)


def test_polynomials_reach_their_ends_and_go_on_uniformly() -> None:
    motion = quintics((1.0, 2.0, 0.5), [(9.0, 1.0, -0.3), (3.0, 0.0, 0.0)], [2.0, 3.0])
    told = motion.at([0.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(told[:, 0], [(1.0, 2.0, 0.5)] * 2, atol=1e-12)
    np.testing.assert_allclose(told[0, 1], (9.0, 1.0, -0.3), atol=1e-12)
    np.testing.assert_allclose(told[1, 2], (3.0, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(told[0, 3], (11.0, 1.0, 0.0), atol=1e-12)


def test_what_is_left_of_a_polynomial_is_the_same_motion() -> None:
    motion = quintics((1.0, 2.0, 0.5), [(9.0, 1.0, 0.0), (3.0, 0.5, 0.0)], [2.0, 0.5])
    t = np.array([0.0, 0.3, 1.2, 2.0])
    np.testing.assert_allclose(motion.later(0.6).at(t)[:, 1:], motion.at(t + 0.6)[:, 1:], atol=1e-12)
    np.testing.assert_allclose(motion.later(0.6).duration, [1.4, 0.0], atol=1e-12)
    np.testing.assert_allclose(motion.later(0.6).at(t)[:, 0, :2], motion.at(t + 0.6)[:, 0, :2], atol=1e-12)


def test_squared_jerk_is_its_integral() -> None:
    motion = quintics((1.0, 2.0, 0.5), [(9.0, 1.0, 0.0)], [2.3])
    t, weights = np.polynomial.legendre.leggauss(5)
    t = (t + 1) * 2.3 / 2
    jerk = (motion.coefficients[0, 3:] * [6.0, 24.0, 60.0] * t[:, None] ** np.arange(3)).sum(1)
    assert squared_jerk(motion)[0] == pytest.approx((jerk**2 * weights).sum() * 2.3 / 2, rel=1e-12)


def test_quintics_and_quartics_are_the_optimal_control_exactly() -> None:
    """Piecewise-quadratic jerk with exact integrals contains them, so its quadratic programme's optimum is theirs."""
    h, num = 0.6, 5
    A = np.array([[1, h, h * h / 2], [0, 1, h], [0, 0, 1]])
    B = np.array([[h**3 / 6, h**4 / 24, h**5 / 60], [h * h / 2, h**3 / 6, h**4 / 12], [h, h * h / 2, h**3 / 3]])
    G = np.array([[h, h**2 / 2, h**3 / 3], [h**2 / 2, h**3 / 3, h**4 / 4], [h**3 / 3, h**4 / 4, h**5 / 5]])
    start = np.array([0.3, 0.2, -0.1])
    reach = np.hstack([np.linalg.matrix_power(A, num - 1 - i) @ B for i in range(num)])  # (3, 3 num)
    free = np.linalg.matrix_power(A, num) @ start
    cost = np.kron(np.eye(num), G)
    for ends, entries in (((2.0, 0.5, 0.1), [0, 1, 2]), ((np.nan, 0.5, 0.0), [1, 2])):
        C, gap = reach[entries], np.array(ends)[entries] - free[entries]
        best = gap @ np.linalg.solve(C @ np.linalg.solve(cost, C.T), gap)
        motion = quintics(start, [ends], [3.0]) if len(entries) == 3 else quartics(start, [0.5], [3.0])
        assert squared_jerk(motion)[0] == pytest.approx(best, rel=1e-10)
