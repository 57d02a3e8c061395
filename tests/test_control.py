"""Control: the poles asked for, in the model and in the vehicle; circles, standstill, numbers that are none."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from models.program import InputError
from planning.control import Command, Control, Lags, command, errors, lagged_drive, moved
from planning.frenet import Pose
from planning.kinematics import Limits

CONTROL = Control()
WIDE = Limits(speed=60.0, acceleration=50.0, power=5000.0, braking=50.0, lateral_acceleration=500.0, curvature=5.0)


def uniform(t: float, speed: float, curvature: float = 0.0) -> Pose:
    """Along a straight line or a circle from the origin."""
    if curvature == 0.0:
        return Pose(speed * t, 0.0, 0.0, speed)
    turned = curvature * speed * t
    return Pose(math.sin(turned) / curvature, (1 - math.cos(turned)) / curvature, turned, speed, 0.0, curvature)


def drive(start: Pose, speed: float, seconds: float, curvature: float = 0.0, limits: Limits = WIDE) -> list[Pose]:
    poses, step = [start], CONTROL.step
    for k in range(round(seconds / step)):
        now, following = (uniform(t, speed, curvature) for t in (k * step, (k + 1) * step))
        told = command(CONTROL, limits, poses[-1], now, following)
        poses.append(moved(CONTROL.lags, poses[-1], told, step))
    return poses


def test_the_lagged_drive_is_its_differential_equation() -> None:
    lag, step = 0.15, 0.2
    whole = np.zeros((4, 4))
    whole[:3] = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, -1 / lag, 1 / lag]]
    A, B = lagged_drive(lag, step)
    np.testing.assert_allclose(np.column_stack([A, B]), expm(whole * step)[:3], atol=1e-15)


@pytest.mark.parametrize("poles", [(-1.5, -2.0, -6.0), (-1.0, -1.0, -1.0), (-0.3, -4.0, -20.0)])
def test_the_longitudinal_loop_has_the_poles_asked_for(poles: tuple[float, float, float]) -> None:
    control = Control(along=poles)
    A, B = lagged_drive(control.lags.drive, control.step)
    found = np.poly(A - np.outer(B, control.along_gains))  # of triple poles only the polynomial is well-conditioned
    np.testing.assert_allclose(found, np.poly(np.exp(np.array(poles) * control.step)), atol=1e-12)


def step_matrix(control: Control, speed: float) -> Any:
    """How small errors (x, y, heading, speed, acceleration, curvature) of the driven vehicle change in a step."""
    now, following = uniform(0.0, speed), uniform(control.step, speed)
    out = np.empty((6, 6))
    for k in range(6):
        told = []
        for change in (-1e-4, 1e-4):
            pose = Pose(*(np.array(now) + change * np.eye(6)[k]))
            told.append(np.array(moved(control.lags, pose, command(control, WIDE, pose, now, following), control.step)))
        out[:, k] = (told[1] - told[0]) / 2e-4
    return out


def test_the_driven_vehicle_has_the_poles_asked_for() -> None:
    """Across, in way: with a steering that lags by little way, (e, psi) decay as exp(p way)."""
    control, speed = Control(lags=Lags(drive=0.15, steer=1e-4)), 2.0
    both = step_matrix(control, speed)
    along = np.linalg.eigvals(both[np.ix_([0, 3, 4], [0, 3, 4])])
    np.testing.assert_allclose(np.sort(along.real), np.sort(np.exp(np.array(control.along) * 0.01)), atol=1e-6)
    across = np.log(np.linalg.eigvals(both[np.ix_([1, 2, 5], [1, 2, 5])]).astype(complex)) / (speed * control.step)
    slow = across[np.argsort(np.abs(across))[:2]]
    found = np.poly(slow)  # s^2 + k2 s + k1 with k1 = p1 p2, k2 = -(p1 + p2)
    np.testing.assert_allclose(found.real, np.poly(control.across), rtol=0.03)  # command held for a step: O(k2 v dt)
    assert np.abs(found.imag).max() < 1e-6


@pytest.mark.parametrize("speed", [0.5, 3.0, 10.0, 20.0])
def test_every_speed_is_stable_with_the_lag_of_the_steering(speed: float) -> None:
    assert np.abs(np.linalg.eigvals(step_matrix(CONTROL, speed))).max() < 1.0


def test_an_offset_decays_by_way_whatever_the_speed() -> None:
    """e(w) = e0 (1 + p w) exp(-p w) for two equal poles p; the lag of .08 s is .2 and .6 m of way here."""
    p = -CONTROL.across[0]
    for speed, allowed in ((2.5, 0.004), (7.5, 0.012)):
        poses = drive(Pose(0.0, 0.2, 0.0, speed), speed, 30.0 / speed)
        way, offset = np.array(poses)[:, :2].T
        assert np.abs(offset - 0.2 * (1 + p * way) * np.exp(-p * way)).max() < allowed


def test_a_place_is_caught_up_with_as_the_poles_say() -> None:
    poses = drive(Pose(-1.0, 0.0, 0.0, 10.0), 10.0, 4.0)
    t = CONTROL.step * np.arange(len(poses))
    behind = np.array(poses)[:, 0] - 10.0 * t
    P = np.array(CONTROL.along)
    modes = np.exp(P * t[:, None])
    c = np.linalg.solve(modes[[0, 100, 200]], behind[[0, 100, 200]])
    np.testing.assert_allclose(behind, modes @ c, atol=1e-9)  # at all times a sum of c exp(p t)
    smooth = np.linalg.solve(np.stack([np.ones(3), P, P**2]), [-1.0, 0.0, 0.0])  # from rest, with commands not held
    np.testing.assert_allclose(behind, modes @ smooth, atol=1e-4)


def test_a_circle_is_held() -> None:
    poses = drive(uniform(0.0, 8.0, 0.05), 8.0, 12.0, 0.05)
    off = [errors(pose, uniform(k * CONTROL.step, 8.0, 0.05)) for k, pose in enumerate(poses)]
    assert np.abs(off).max() < 1e-6
    entered = drive(Pose(0.0, 0.3, 0.1, 7.0), 8.0, 12.0, 0.05)
    assert np.abs(errors(entered[-1], uniform(12.0, 8.0, 0.05))).max() < 1e-3


def test_a_plan_that_varies_is_followed_in_spite_of_the_lags() -> None:
    """Speed 8 + sin(t), curvature .05 sin(t); 6 cm from it without the lags fed forward."""
    step, told = (
        CONTROL.step,
        Lags(drive=1e-4, steer=1e-4),
    )  # a vehicle that does at once what it is told draws the plan
    plan = [Pose(0.0, 0.0, 0.0, 8.0, 1.0, 0.0)]
    for k in range(1000):
        t = (k + 1) * step
        after = moved(told, plan[-1], Command((math.sin(t) - math.sin(t - step)) / step, 0.05 * math.sin(t)), step)
        plan.append(after._replace(speed=8.0 + math.sin(t), acceleration=math.cos(t), curvature=0.05 * math.sin(t)))
    pose, worst = plan[0], 0.0
    for now, following in pairwise(plan):
        pose = moved(CONTROL.lags, pose, command(CONTROL, WIDE, pose, now, following), step)
        worst = max(worst, math.hypot(pose.x - following.x, pose.y - following.y))
    assert worst < 5e-3


def test_a_path_ahead_of_the_vehicle_is_no_error_across_it() -> None:
    ahead, left, angle = errors(uniform(0.05, 10.0, 0.05), uniform(0.0, 10.0, 0.05))
    assert ahead == pytest.approx(0.5, abs=1e-4)
    assert abs(left) < 1e-5 and abs(angle) < 1e-5


def test_the_vehicle_follows_its_equations() -> None:
    """Against RK4 in a thousand parts."""
    lags, told = Lags(), Command(2.0, 0.08)
    pose = Pose(1.0, 2.0, 0.4, 6.0, -1.0, -0.02)

    def rate(z: Any) -> Any:
        _, _, heading, v, a, kappa = z
        bend = (told.curvature - kappa) / lags.steer
        return np.array(
            [v * math.cos(heading), v * math.sin(heading), v * kappa, a, (told.acceleration - a) / lags.drive, bend]
        )

    z, h = np.array(pose), 0.2 / 1000
    for _ in range(1000):
        k1 = rate(z)
        k2 = rate(z + h / 2 * k1)
        k3 = rate(z + h / 2 * k2)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(z + h * k3))
    found = pose
    for _ in range(20):
        found = moved(lags, found, told, 0.01)
    np.testing.assert_allclose(found, z, atol=1e-8)


def test_at_rest_it_stays_and_starts() -> None:
    here = Pose(5.0, 1.0, 0.3, 0.0, 0.0, 0.02)
    stayed = here
    for _ in range(300):
        told = command(CONTROL, Limits(), stayed, here, here)
        stayed = moved(CONTROL.lags, stayed, told, CONTROL.step)
    np.testing.assert_allclose(stayed, here, atol=1e-12)
    too_far = Pose(5.05, 1.0, 0.0, 0.0)
    for _ in range(300):
        too_far = moved(CONTROL.lags, too_far, Command(-2.0, 0.0), CONTROL.step)
    assert (too_far.x, too_far.speed, too_far.acceleration) == (5.05, 0.0, 0.0)
    rolling = moved(CONTROL.lags, Pose(0.0, 0.0, 0.0, 0.01, -3.0), Command(-3.0, 0.0), CONTROL.step)
    assert rolling.speed == 0.0 and 0.0 <= rolling.x < 1e-4
    assert drive(Pose(0.0, 0.0, 0.0, 0.0), 4.0, 6.0)[-1].speed == pytest.approx(4.0, abs=1e-2)


def test_commands_stay_within_what_the_vehicle_can() -> None:
    limits = Limits(acceleration=3.0, power=25.0, braking=5.0, lateral_acceleration=2.0, curvature=0.2)
    far = command(CONTROL, limits, Pose(-50.0, 9.0, 0.0, 10.0), uniform(0, 10.0), uniform(0.01, 10.0))
    assert far == Command(2.5, -0.02)
    beyond = command(CONTROL, limits, Pose(50.0, -9.0, 0.0, 1.0), uniform(0, 1.0), uniform(0.01, 1.0))
    assert beyond == Command(-5.0, 0.2)


@pytest.mark.parametrize("field", Pose._fields)
def test_numbers_that_are_none_are_refused(field: str) -> None:
    good, bad = uniform(0.0, 5.0), uniform(0.0, 5.0)._replace(**{field: math.nan})
    for given, who in (((bad, good, good), "vehicle"), ((good, bad, good), "plan"), ((good, good, bad), "later")):
        with pytest.raises(InputError, match=rf"{who}.* has {field} = nan"):
            command(CONTROL, Limits(), *given)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"along": (-1.0, -2.0)}, "poles along"),
        ({"across": (-0.2, 0.1)}, "negative numbers"),
        ({"across": (-0.2, math.nan)}, "negative numbers"),
        ({"step": 0.0}, "step is 0.0"),
    ],
)
def test_settings_that_are_none_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Control(**settings)
    with pytest.raises(InputError, match="steer is -1"):
        Lags(steer=-1.0)
