"""The labeled multi-Bernoulli filter: by hand where one object makes it a Kalman filter, what must change nothing, and
what happens to scans that are empty, crowded, far apart or broken."""

from __future__ import annotations

import math
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from inference import lmb
from inference.lmb import STRIDE, Belief, Knobs, predict, step
from inference.lmb_kernel import heaviest, reduce
from models.multi_object import Bernoullis, Components, no_objects
from models.objects.motion import ConstantVelocity
from models.objects.scans import Recording, Scan
from models.objects.sensors import Position, Radar
from models.objects.traffic import Kind, Place, Traffic
from models.program import InputError
from tests.line_objects import Line, prior_of

Floats = NDArray[np.float64]
CAR = np.zeros(3)
PLOTS = Position(name="plots", noise_std=(1.0, 1.0), detection=0.9, clutter=4.0, extent=250.0)
STRAIGHT = Traffic(
    sensors=(PLOTS,),
    motion=ConstantVelocity(),
    kinds=(Kind(noise=(0.5, 0.5), speed=(0.0, 7.0), lifetime=30.0),),
    unseen_density=1e-6,
    region=(-250.0, -250.0, 250.0, 250.0),
)
RADAR = Radar(name="radar", noise_std=(0.4, 0.01, 0.2), detection=0.9, clutter=4.0, reach=(0.0, 300.0))
TURNING = Traffic(sensors=(RADAR,), kinds=(Kind(noise=(0.6, 0.15, 0.1), lifetime=30.0),), unseen_density=1e-5)


def objects_at(mean: Any, covariance: Any, existence: Any) -> Bernoullis:
    """One component each."""
    mean, P = np.array(mean, dtype=np.float64), np.array(covariance, dtype=np.float64)
    T = len(mean)
    parts = Components(
        np.arange(T + 1), np.ones(T), np.zeros(T, dtype=np.int64), mean, np.broadcast_to(P, (T, *P.shape[-2:])).copy()
    )
    return Bernoullis(np.arange(-T, 0), np.array(existence, dtype=np.float64), parts)


def plots(time: float, places: Any, sensor: str = "plots") -> Scan:
    return Scan(sensor, time, np.array(places, dtype=np.float64).reshape(-1, 2), CAR)


def mixture(objects: Bernoullis, t: int) -> list[tuple[float, Floats, Floats]]:
    rows = range(objects.components.offset[t], objects.components.offset[t + 1])
    return [(objects.components.weight[c], objects.components.mean[c], objects.components.covariance[c]) for c in rows]


# one object


def kalman(x: Floats, P: Floats, z: Floats, h: Floats, H: Floats, R: Floats, period: Floats) -> tuple[Floats, Floats]:
    """As textbooks have it, by inverses."""
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    residual = np.array(
        [z[i] - h[i] if math.isinf(p) else math.remainder(z[i] - h[i], p) for i, p in enumerate(period)]
    )
    return x + K @ residual, P - K @ S @ K.T


def test_sure_object_without_clutter_is_kalmans() -> None:
    sensor = Position(name="plots", noise_std=(1.0, 2.0), detection=1.0, clutter=0.0, births=False, extent=1e4)
    model = Traffic(sensors=(sensor,), motion=ConstantVelocity(), kinds=(Kind(noise=(0.5, 0.9), lifetime=1e12),))
    rng = np.random.default_rng(1)
    x, P = np.array([1.0, 2.0, 3.0, -1.0]), np.diag([4.0, 9.0, 1.0, 2.0]) + 0.5
    belief, H, R = Belief(0.0, objects_at([x], P, [1.0])), np.eye(2, 4), np.diag([1.0, 4.0])
    now = 0.0
    for number in range(30):
        dt = float(rng.uniform(0.0, 0.5))
        now += dt
        F = np.eye(4) + dt * np.eye(4, k=2)
        Q = np.zeros((4, 4))
        for i, q in enumerate((0.5, 0.9)):
            Q[np.ix_([i, i + 2], [i, i + 2])] = q**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        x, P = F @ x, F @ P @ F.T + Q
        z = x[:2] + rng.normal(0.0, 2.0, 2)
        x, P = kalman(x, P, z, H @ x, H, R, np.full(2, math.inf))
        belief, _ = step(model, belief, plots(now, [z]), number, Knobs())
        assert belief.objects.existence[0] == pytest.approx(1.0, abs=1e-9)
        np.testing.assert_allclose(belief.objects.components.mean[0], x, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(belief.objects.components.covariance[0], P, rtol=1e-12, atol=1e-12)
    assert len(belief.objects.label) == 1


def test_sure_object_of_a_radar_is_an_extended_kalman_filter() -> None:
    """CTRA and a radar that turns with the car; Jacobians by torch; the object passes behind, where bearings jump."""
    sensor = Radar(
        name="radar", noise_std=(0.4, 0.01, 0.2), mount=(1.0, 0.5, 0.2), detection=1.0, clutter=0.0, births=False
    )
    model = Traffic(sensors=(sensor,), kinds=(Kind(noise=(0.6, 0.15, 0.1), lifetime=1e12),))
    nodes, weights = np.polynomial.legendre.leggauss(3)

    def f(x: torch.Tensor, dt: float) -> torch.Tensor:
        px, py, psi, v, w, a = x
        for node, weight in zip(0.5 + 0.5 * nodes, 0.5 * weights, strict=True):
            s = node * dt
            px, py = (
                px + weight * dt * (v + a * s) * torch.cos(psi + w * s),
                py + weight * dt * (v + a * s) * torch.sin(psi + w * s),
            )
        return torch.stack([px, py, psi + w * dt, v + a * dt, w, a])

    def h(x: torch.Tensor, at: Floats) -> torch.Tensor:
        dx, dy = x[0] - at[0], x[1] - at[1]
        r = torch.sqrt(dx**2 + dy**2 + 1e-9)
        rate = x[3] * (dx * torch.cos(x[2]) + dy * torch.sin(x[2])) / r
        return torch.stack([r, torch.atan2(dy, dx) - at[2], rate])

    rng = np.random.default_rng(2)
    x, P = np.array([-30.0, 6.0, -1.2, 8.0, 0.2, -0.1]), np.diag([1.0, 1.0, 0.1, 1.0, 0.01, 0.1])
    belief, R, dt = Belief(0.0, objects_at([x], P, [1.0])), np.diag(np.square(sensor.noise_std)), 0.1
    period = np.array([math.inf, 2 * math.pi, math.inf])
    jumps = 0
    for number in range(40):
        pose = np.array([0.1 * number, 0.02 * number, 0.03 * number - 0.2])
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        at = pose + np.array([cos * 1.0 - sin * 0.5, sin * 1.0 + cos * 0.5, 0.2])
        state = torch.from_numpy(x)
        F = torch.func.jacrev(f)(state, dt).numpy()
        c, s = math.cos(x[2]), math.sin(x[2])
        g = np.array([[c, 0, 0], [s, 0, 0], [0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 1]])
        white = np.array(
            [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
        )
        Q = 0.36 * g @ white @ g.T
        Q[np.ix_([2, 4], [2, 4])] += 0.15**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        Q[:2, :2] += 0.01 * dt * np.eye(2)
        x, P = f(state, dt).numpy(), F @ P @ F.T + Q
        state = torch.from_numpy(x)
        predicted, H = h(state, at).numpy(), torch.func.jacrev(h)(state, at).numpy()
        z = predicted + rng.normal(0.0, sensor.noise_std)
        z[1] = math.remainder(z[1], 2 * math.pi)
        jumps += abs(z[1] - predicted[1]) > 3.0
        x, P = kalman(x, P, z, predicted, H, R, period)
        scan = Scan("radar", dt * (number + 1), z[None], pose)
        belief, _ = step(model, belief, scan, number, Knobs())
        np.testing.assert_allclose(belief.objects.components.mean[0], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(belief.objects.components.covariance[0], P, rtol=1e-8, atol=1e-10)
    assert 3 < jumps < 37
    assert belief.objects.existence[0] == pytest.approx(1.0, abs=1e-9)


# births


def test_first_measurement_begins_an_object_with_the_odds_of_unseen_to_clutter() -> None:
    belief, facts = step(STRAIGHT, Belief(None, no_objects(4)), plots(3.0, [(20.0, 30.0)]), 7, Knobs())
    clutter, unseen = 4.0 / 500.0**2, 0.9 * 1e-6 / (1 + 1e-4)  # the prior is a normal 100 times wider than noise
    assert belief.time == 3.0
    assert belief.objects.existence[0] == pytest.approx(unseen / (clutter + unseen), rel=1e-9)
    assert belief.objects.label.tolist() == [7 * STRIDE]
    assert facts.log_factor == pytest.approx(math.log(clutter + unseen), rel=1e-9)
    np.testing.assert_allclose(belief.objects.components.mean[0], [20.0, 30.0, 0.0, 0.0], atol=1e-12)
    expected = np.diag([1 / 1.0001, 1 / 1.0001, 49.0, 49.0])
    np.testing.assert_allclose(belief.objects.components.covariance[0], 1e4 * expected / 1e4, rtol=1e-6, atol=1e-9)


def test_what_known_objects_explain_begins_no_new_ones() -> None:
    P = np.diag([2.0, 2.0, 1.0, 1.0])
    prior = objects_at([[20.0, 30.0, 0.0, 0.0]], P, [0.3])
    belief, facts = step(STRAIGHT, Belief(1.0, prior), plots(1.0, [(21.0, 30.5), (90.0, 0.0)]), 4, Knobs(faint=0.0))
    clutter, unseen = 4.0 / 500.0**2, 0.9 * 1e-6 / (1 + 1e-4)
    kappa = clutter + unseen
    taken = 0.3 * 0.9 * math.exp(-(1.0 + 0.25) / 2 / 3.0) / (2 * math.pi * 3.0) / kappa
    missed = 1.0 - 0.3 * 0.9
    share = taken / (taken + missed)
    assert belief.objects.label.tolist() == [-1, 4 * STRIDE, 4 * STRIDE + 1]
    assert belief.objects.existence[0] == pytest.approx(share + (1 - share) * 0.3 * 0.1 / missed, rel=1e-9)
    assert belief.objects.existence[1] == pytest.approx((1 - share) * unseen / kappa, rel=1e-9)
    assert belief.objects.existence[2] == pytest.approx(unseen / kappa, rel=1e-9)
    assert facts.log_factor == pytest.approx(math.log(taken + missed) + 2 * math.log(kappa), rel=1e-9)


@pytest.mark.parametrize("off", [(2.5, 2.5), (3.2, 0.0), (0.0, 3.2)])
def test_measurements_beyond_the_gate_are_of_others(off: tuple[float, float]) -> None:
    """By the squared Mahalanobis distance, which is 12.5 and 10.24 here; 8.8 would be within 9."""
    prior = objects_at([[0.0, 0.0, 0.0, 0.0]], np.eye(4), [0.3])
    for factor, within in ((1.0, False), (math.sqrt(8.8) / math.hypot(*off), True)):
        scan = plots(1.0, [factor * math.sqrt(2.0) * np.array(off)])
        belief, _ = step(STRAIGHT, Belief(1.0, prior), scan, 0, Knobs(gate=9.0))
        missed = 0.3 * 0.1 / (1 - 0.3 * 0.9)
        assert (abs(belief.objects.existence[0] - missed) > 1e-6) == within


def test_every_measurement_may_have_noise_of_its_own() -> None:
    R = np.array([np.diag([1.0, 4.0]), [[9.0, 2.0], [2.0, 3.0]]])
    x, P = np.array([20.0, 30.0, 1.0, -1.0]), np.diag([2.0, 3.0, 1.0, 1.0]) + 0.4
    scan = plots(1.0, [(21.0, 30.5), (19.0, 32.0)])._replace(noise=R)
    knobs = Knobs(least=0.0, merge=0.0, faint=0.0)
    belief, _ = step(STRAIGHT, Belief(1.0, objects_at([x], P, [0.3])), scan, 0, knobs)
    clutter, unseen = 4.0 / 500.0**2, 0.9 * 1e-6 / (1 + 1e-4)
    H, none = np.eye(2, 4), np.full(2, math.inf)
    taken, means = [], [x]
    for z, own in zip(scan.values, R, strict=True):
        S, off = P[:2, :2] + own, z - x[:2]
        normal = math.exp(-0.5 * off @ np.linalg.solve(S, off)) / (2 * math.pi * math.sqrt(np.linalg.det(S)))
        taken.append(0.3 * 0.9 * normal / (clutter + unseen))
        means.append(kalman(x, P, z, x[:2], H, own, none)[0])
    shares = np.array([0.3 * 0.1, *taken]) / (1 - 0.3 * 0.9 + sum(taken))
    assert belief.objects.existence[0] == pytest.approx(shares.sum(), rel=1e-9)
    found = sorted(mixture(belief.objects, 0), key=lambda part: -part[0])
    for (weight, mean, _), i in zip(found, np.argsort(-shares), strict=True):
        assert weight == pytest.approx(shares[i] / shares.sum(), rel=1e-9)
        np.testing.assert_allclose(mean, means[i], rtol=1e-12)
    for t, own in ((1, R[0]), (2, R[1])):
        np.testing.assert_allclose(mixture(belief.objects, t)[0][2][:2, :2], own / 1.0001, rtol=1e-6)


def test_radar_that_looks_back_begins_objects_where_they_are() -> None:
    """Its bearings are a turn away from those that the world's angles predict."""
    pose = np.array([5.0, 3.0, 3.0])
    belief, _ = step(
        TURNING, Belief(None, no_objects(6)), Scan("radar", 0.0, np.array([[20.0, 1.0, 0.0]]), pose), 0, Knobs()
    )
    for _, mean, P in mixture(belief.objects, 0):
        np.testing.assert_allclose(mean[:2], [5.0 + 20.0 * math.cos(4.0), 3.0 + 20.0 * math.sin(4.0)], atol=0.01)
        across = np.array([-math.sin(4.0), math.cos(4.0)])
        assert across @ P[:2, :2] @ across == pytest.approx(0.2**2, rel=0.05)
    assert belief.objects.existence[0] > 0.1


def test_components_that_are_one_around_the_circle_become_one() -> None:
    prior = objects_at([[10.0, 0.0, 3.1, 5.0, 0.0, 0.0], [10.0, 0.0, -3.1, 5.0, 0.0, 0.0]], np.eye(6), [0.5, 0.5])
    one = Bernoullis(
        prior.label[:1],
        prior.existence[:1],
        prior.components._replace(offset=np.array([0, 2]), weight=np.array([0.6, 0.4])),
    )
    belief, _ = step(TURNING, Belief(0.0, one), Scan("radar", 0.0, np.zeros((0, 3)), CAR), 0, Knobs())
    ((weight, mean, _),) = mixture(belief.objects, 0)
    assert weight == 1.0
    assert mean[2] == pytest.approx(3.1 + 0.4 * (2 * math.pi - 6.2), rel=1e-12)


def test_objects_arrive_at_places_as_often_as_the_rate_says() -> None:
    model = replace(STRAIGHT, places=(Place((1.0, 2.0), 3.0, 0.02), Place((-1.0, 2.0), 3.0, 0.5)), unseen_density=0.0)
    belief = Belief(1.0, objects_at([[20.0, 30.0, 0.0, 0.0]], np.eye(4), [0.3]))
    objects = predict(model, belief, 2.0, 6)
    expected = [30.0 * rate * (1 - math.exp(-2.0 / 30.0)) for rate in (0.02, 0.5)]
    assert objects.label.tolist() == [-1, 6 * STRIDE + STRIDE // 2, 6 * STRIDE + STRIDE // 2 + 1]
    assert objects.existence == pytest.approx(
        [0.3 * math.exp(-2.0 / 30.0), *(1 - math.exp(-e) for e in expected)], rel=1e-12
    )
    assert objects.components.offset.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(objects.components.mean[1:, :2], [[1.0, 2.0], [-1.0, 2.0]])


def test_tracks_tell_of_what_is_probable_and_count_labels_as_they_appear() -> None:
    model = replace(STRAIGHT, places=(Place((1.0, 2.0), 3.0, 0.02),))
    scans = [plots(0.5 * k, [(60.0, 0.0), (0.0, 60.0)]) for k in range(4)]
    every, some = lmb.run(model, scans, report=0.0), lmb.run(model, scans, report=0.2)
    _, first = np.unique(every.label, return_index=True)
    assert (np.diff(first) > 0).all()
    assert len(first) > 3
    np.testing.assert_array_equal(some.existence, every.existence[every.existence > 0.2])
    assert 0 < len(some.label) < len(every.label)


# what must change nothing


def crowd(seed: int = 0) -> tuple[Bernoullis, Scan]:
    """Eight objects, some close to each other, and twelve measurements."""
    rng = np.random.default_rng(seed)
    mean = np.concatenate([rng.uniform(-8.0, 8.0, (8, 2)), rng.normal(0.0, 3.0, (8, 2))], 1)
    root = rng.normal(0.0, 0.7, (8, 4, 4))
    prior = objects_at(mean, root @ root.swapaxes(1, 2) + np.eye(4), rng.uniform(0.1, 0.95, 8))
    return prior, plots(0.3, rng.uniform(-10.0, 10.0, (12, 2)))


def marginals(objects: Bernoullis, names: Any = None) -> dict[Any, tuple[float, Floats, Floats]]:
    """{label: existence, mean and covariance}."""
    found = {}
    for t, label in enumerate(objects.label.tolist()):
        weight, mean, P = (np.array(part) for part in zip(*mixture(objects, t), strict=True))
        assert weight.sum() == pytest.approx(1.0, abs=1e-12)
        centre = weight @ mean
        apart = mean - centre
        V = np.einsum("c,cij->ij", weight, P + apart[:, :, None] * apart[:, None, :])
        found[label if names is None else names(label)] = float(objects.existence[t]), centre, V
    return found


def assert_equal(found: Any, expected: Any, tolerance: float = 1e-9) -> None:
    assert set(found) == set(expected)
    for label, parts in expected.items():
        for a, b in zip(found[label], parts, strict=True):
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("seed", range(3))
def test_order_of_measurements_and_objects_changes_nothing(seed: int) -> None:
    prior, scan = crowd(seed)
    rng = np.random.default_rng(seed)
    expected = marginals(step(STRAIGHT, Belief(0.0, prior), scan, 2, Knobs())[0].objects)
    order = rng.permutation(12)
    turned = scan._replace(values=scan.values[order])
    found = step(STRAIGHT, Belief(0.0, prior), turned, 2, Knobs())[0].objects
    assert_equal(
        marginals(found, lambda label: label if label < 0 else 2 * STRIDE + order[label - 2 * STRIDE]), expected
    )
    turn = rng.permutation(8)
    offset, *parts = prior.components
    other = Bernoullis(prior.label[turn], prior.existence[turn], Components(offset, *(p[turn] for p in parts)))
    assert_equal(marginals(step(STRAIGHT, Belief(0.0, other), scan, 2, Knobs())[0].objects), expected)


def test_order_of_two_sensors_at_a_time_hardly_matters() -> None:
    """An update forgets who goes with whom, so that two do not commute, but for one object. Found, over 20 crowds of
    eight within 16 m: the existence that differs most differs by .026 in the mean (.19 at worst)."""
    model = replace(STRAIGHT, sensors=(PLOTS, replace(PLOTS, name="more", detection=0.6)), unseen_density=0.0)
    knobs, worst = Knobs(gate=50.0, most=400, least=0.0, merge=0.0), []
    for seed in range(21):
        prior, one = crowd(seed)
        rng = np.random.default_rng(100 + seed)
        near = prior.components.mean[:4, :2] + rng.normal(size=(4, 2))
        two = plots(0.3, np.concatenate([near, rng.uniform(-10, 10, (6, 2))]), "more")
        if seed == 20:
            prior = objects_at(prior.components.mean[:1], prior.components.covariance[:1], [0.4])
        found = []
        for scans in ((one, two), (two, one)):
            belief = Belief(0.0, prior)
            for number, scan in enumerate(scans):
                belief, _ = step(model, belief, scan, number, knobs)
            found.append(marginals(belief.objects))
        worst.append(max(abs(found[0][label][0] - found[1][label][0]) for label in found[0]))
    assert np.mean(worst[:20]) < 0.03
    assert max(worst) < 0.2
    assert worst[20] < 1e-9


def test_translation_and_rotation_of_the_world_change_nothing() -> None:
    """Without births, which look for headings in four directions of the world; a quarter turn is theirs, too."""
    rng = np.random.default_rng(4)
    mean = np.column_stack(
        [
            rng.uniform(10.0, 40.0, 5),
            rng.uniform(-20.0, 20.0, 5),
            rng.uniform(-3, 3, 5),
            rng.uniform(2, 9, 5),
            rng.normal(0, 0.2, 5),
            rng.normal(0, 0.5, 5),
        ]
    )
    root = rng.normal(0.0, 0.3, (5, 6, 6))
    P = root @ root.swapaxes(1, 2) + 0.05 * np.eye(6)
    pose = np.array([1.0, 2.0, 0.3])
    values = np.column_stack([rng.uniform(10, 40, 9), rng.uniform(-1, 1, 9), rng.uniform(-9, 9, 9)])
    for angle, births in ((0.7, False), (math.pi / 2, True)):
        model = Traffic(sensors=(RADAR,), kinds=TURNING.kinds, unseen_density=1e-5 * births)
        turn = np.eye(6)
        turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        shift = np.array([300.0, -70.0, angle, 0.0, 0.0, 0.0])
        results = []
        for moved in (False, True):
            x, V, at = (
                (mean @ turn.T + shift, turn @ P @ turn.T, turn[:3, :3] @ pose + shift[:3])
                if moved
                else (mean, P, pose)
            )
            belief = Belief(0.0, objects_at(x, V, np.full(5, 0.6)))
            belief, _ = step(model, belief, Scan("radar", 0.1, values, at), 0, Knobs(gate=60.0, faint=0.0))
            found = marginals(belief.objects)
            back = {k: (r, turn.T @ (m - shift), turn.T @ W @ turn) for k, (r, m, W) in found.items()}
            results.append(back if moved else found)
        assert len(results[0]) == 5 + 9 * births
        for label, (r, m, W) in results[0].items():
            other = results[1][label]
            assert other[0] == pytest.approx(r, rel=1e-6)
            entries = [0, 1, 3, 4, 5] if label >= 0 else range(6)  # headings of births are the same four, but wound on
            np.testing.assert_allclose(other[1][entries], m[entries], rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(np.diag(other[2])[entries], np.diag(W)[entries], rtol=1e-5, atol=1e-6)


def test_object_out_of_view_only_gets_older() -> None:
    sensor = Radar(name="radar", noise_std=(0.4, 0.01, 0.2), angle=1.0, reach=(0.0, 50.0), clutter=4.0)
    model = Traffic(sensors=(sensor,), kinds=(Kind(noise=(0.6, 0.15, 0.1), lifetime=30.0),), unseen_density=1e-5)
    prior = objects_at([[-40.0, 3.0, 1.0, 5.0, 0.1, 0.2]], 0.1 * np.eye(6), [0.37])
    alone = predict(model, Belief(0.0, prior), 0.4, 0)
    scan = Scan("radar", 0.4, np.array([[20.0, 0.1, 3.0], [40.0, math.pi - 0.075, 2.0]]), CAR)
    belief, _ = step(model, Belief(0.0, prior), scan, 0, Knobs())
    assert alone.existence[0] == pytest.approx(0.37 * math.exp(-0.4 / 30.0), rel=1e-14)
    assert belief.objects.label[0] == -1
    assert belief.objects.existence[0] == pytest.approx(alone.existence[0], rel=1e-12)
    np.testing.assert_array_equal(belief.objects.components.mean[0], alone.components.mean[0])
    np.testing.assert_allclose(belief.objects.components.covariance[0], alone.components.covariance[0], rtol=1e-15)


def test_prediction_keeps_what_survival_leaves() -> None:
    model, prior = Line(), prior_of((0.0, 5.0, 9.0), (0.2, 0.5, 1.0))
    objects = predict(model, Belief(0.0, prior), 3.0, 0)
    left = [math.exp(-3.0 / lifetime) for lifetime in model.lifetime]
    expected = 0.7 * left[0] + 0.3 * left[1]
    assert objects.existence == pytest.approx(np.array([0.2, 0.5, 1.0]) * expected, rel=1e-13)
    assert objects.components.weight == pytest.approx(np.tile([0.7 * left[0], 0.3 * left[1]], 3) / expected, rel=1e-13)
    assert prior.existence.tolist() == [0.2, 0.5, 1.0]  # what was believed stays as it was
    assert prior.components.weight.tolist() == [0.7, 0.3] * 3
    np.testing.assert_array_equal(prior.components.covariance[0], [[1.2, 0.3], [0.3, 0.9]])


# scans of all sorts


def test_long_gap_is_taken_in_steps_of_half_a_second() -> None:
    prior = objects_at([[0.0, 0.0, 0.3, 8.0, 0.4, 0.1]], 0.01 * np.eye(6), [0.8])
    once = predict(TURNING, Belief(0.0, prior), 10.0, 0)
    belief = Belief(0.0, prior)
    for k in range(20):
        belief = Belief(0.5 * (k + 1), predict(TURNING, belief, 0.5, 0))
    assert once.existence == pytest.approx(0.8 * math.exp(-10.0 / 30.0), rel=1e-12)
    np.testing.assert_allclose(once.components.mean, belief.objects.components.mean, rtol=1e-12)
    np.testing.assert_allclose(once.components.covariance, belief.objects.components.covariance, rtol=1e-12)


def test_gap_of_ten_seconds_keeps_the_object() -> None:
    scans = [plots(0.1 * k, [(0.2 * k, 5.0)]) for k in range(20)]
    scans += [plots(12.0 + 0.1 * k, [(24.0 + 0.2 * k, 5.0)]) for k in range(10)]
    tracks = lmb.run(STRAIGHT, scans)
    assert tracks.at(19).label[tracks.at(19).existence > 0.9].tolist() == [0]
    assert tracks.at(29).label[tracks.at(29).existence > 0.9].tolist() == [0]


def test_scans_at_the_same_time_are_used_one_after_the_other() -> None:
    one, two = plots(1.0, [(0.0, 0.0)]), plots(1.0, [(0.5, 0.5)])
    tracks = lmb.run(STRAIGHT, [one, two])
    assert tracks.time.tolist() == [1.0, 1.0]
    assert tracks.at(1).existence[0] > 0.9 > 0.2 > tracks.at(0).existence[0]
    np.testing.assert_allclose(tracks.at(1).mean[0, :2], [0.25, 0.25], rtol=1e-3)


def test_empty_scans_make_objects_less_probable() -> None:
    scans = [plots(0.1 * k, [(0.0, 0.0)]) for k in range(10)] + [plots(1.0 + 0.1 * k, []) for k in range(12)]
    tracks = lmb.run(STRAIGHT, scans)
    r = float(tracks.at(9).existence[0])
    for t in range(10, 14):
        predicted = r * math.exp(-0.1 / 30.0)
        r = predicted * 0.1 / (1.0 - 0.9 * predicted)
        assert tracks.at(t).existence[0] == pytest.approx(r, rel=1e-9)
    assert len(tracks.at(21).label) == 0
    assert len(lmb.run(STRAIGHT, [plots(0.1 * k, []) for k in range(3)]).label) == 0


def test_sure_object_that_a_sure_sensor_misses_is_gone() -> None:
    """What cannot be is not a NaN, but told of by the log factor."""
    model = replace(STRAIGHT, sensors=(replace(PLOTS, detection=1.0, extent=1e4),))
    belief, facts = step(
        model, Belief(1.0, objects_at([[0.0, 0.0, 0.0, 0.0]], np.eye(4), [1.0])), plots(1.0, []), 0, Knobs()
    )
    assert len(belief.objects.label) == 0
    assert facts.log_factor == pytest.approx(math.log(1e-12), rel=1e-6)


def test_sensor_that_begins_no_tracks() -> None:
    quiet = replace(PLOTS, name="quiet", births=False)
    model = replace(STRAIGHT, sensors=(PLOTS, quiet))
    scans = [plots(0.1 * k, [(0.0, 0.0), (50.0, 0.0)], "quiet") for k in range(5)]
    assert len(lmb.run(model, scans).label) == 0
    follow = lmb.run(model, [plots(0.0, [(0.0, 0.0)]), *(scan._replace(time=scan.time + 0.1) for scan in scans)])
    assert follow.at(5).existence.tolist() == [pytest.approx(1.0, abs=1e-3)]


def test_births_among_clutter_are_all_there() -> None:
    """66 false alarms on 2 x 2 km: each may be an object with probability .0057; with a cut-off above this none is
    begun, and that is told."""
    sensor = Position(name="plots", noise_std=(10.0, 10.0), detection=0.98, clutter=66.0, extent=1000.0)
    model = Traffic(
        sensors=(sensor,), motion=ConstantVelocity(), kinds=(Kind(noise=(5.0, 5.0), speed=(0.0, 15.0)),),
        unseen_density=1e-7, region=(-1000.0, -1000.0, 1000.0, 1000.0),
    )  # fmt: skip
    scan = plots(0.0, np.random.default_rng(0).uniform(-1000.0, 1000.0, (66, 2)))
    each = 0.98e-7 / (1 + 1e-4) / (66 / 4e6 + 0.98e-7 / (1 + 1e-4))
    tracks = lmb.run(model, [scan], report=0.0)
    assert tracks.existence == pytest.approx(np.full(66, each), rel=1e-4)  # the view is soft at its edge
    assert tracks.info["left_out"] == 0.0
    assert tracks.info["flags"] == []
    dropped = lmb.run(model, [scan], faint=0.1)  # of newcomers, a tenth
    assert len(dropped.label) == 0
    assert dropped.info["left_out"] == pytest.approx(66 * each, rel=1e-4)
    assert dropped.info["flags"] == ["objects that were too improbable to keep add up to 0.4; lower `faint`"]


def test_what_is_left_out_accounts_for_what_is_missing() -> None:
    """Of one step, with and without a cut-off, a tenth for newcomers: the rest is the same, and the sum agrees."""
    prior, scan = crowd()
    every, _ = step(STRAIGHT, Belief(0.0, prior), scan, 0, Knobs(faint=0.0))
    some, facts = step(STRAIGHT, Belief(0.0, prior), scan, 0, Knobs(faint=0.05))
    newcomer = every.objects.label >= 0
    kept = every.objects.existence > np.where(newcomer, 0.005, 0.05)
    assert 0 < kept.sum() < len(kept)
    np.testing.assert_array_equal(some.objects.label, every.objects.label[kept])
    np.testing.assert_array_equal(some.objects.existence, every.objects.existence[kept])
    assert facts.left_out == pytest.approx(every.objects.existence[~kept].sum(), rel=1e-12)


@pytest.mark.parametrize(("existence", "faint"), [(0.01, 0.05), (1e-13, 0.0)])
def test_known_objects_that_are_left_out_are_accounted_for(existence: float, faint: float) -> None:
    """Also where the cut-off is none, but all components are lighter than any is kept."""
    prior = objects_at([[0.0, 0.0, 0.0, 0.0], [50.0, 0.0, 0.0, 0.0]], np.eye(4), [existence, 0.6])
    belief, facts = step(STRAIGHT, Belief(1.0, prior), plots(1.0, []), 0, Knobs(faint=faint))
    assert belief.objects.label.tolist() == [-1]
    assert belief.objects.components.offset.tolist() == [0, 1]
    assert facts.left_out == pytest.approx(existence * 0.1 / (1 - 0.9 * existence), rel=1e-9)


def test_five_thousand_false_alarms() -> None:
    """Each may be an object. Every object is compared with every measurement, but memory only grows with their sum
    (found 36 MB), and what is far away changes nothing: where the outer ones are left out, the inner ones are believed
    to be just as probable, just there."""
    rng = np.random.default_rng(0)
    places = [rng.uniform(-250.0, 250.0, (5000, 2)) for _ in range(2)]
    model = replace(STRAIGHT, sensors=(replace(PLOTS, clutter=5000.0),))
    lmb.run(model, [plots(0.0, []), plots(0.1, [(0.0, 0.0)])])  # compiles
    tracemalloc.start()
    tracks = lmb.run(model, [plots(0.1 * k, z) for k, z in enumerate(places)], report=0.0, faint=1e-6)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert np.diff(tracks.offset).tolist() == [5000, 10000]
    assert peak < 3e8
    inner = [plots(0.1 * k, z[(np.abs(z) < 150.0).all(1)]) for k, z in enumerate(places)]
    found = []
    for objects in (tracks.at(1), lmb.run(model, inner, report=0.0, faint=1e-6).at(1)):
        rows = np.flatnonzero((np.abs(objects.mean[:, :2]) < 100.0).all(1))
        rows = rows[np.lexsort(objects.mean[rows].T)]
        found.append((objects.existence[rows], objects.mean[rows], objects.covariance[rows]))
    assert len(found[0][0]) > 1000
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)


def test_existence_is_a_probability_and_labels_are_unique_whatever_comes() -> None:
    rng = np.random.default_rng(7)
    belief = Belief(0.0, crowd()[0])
    for number in range(60):
        scale = 10.0 ** rng.uniform(-1, 2)
        later = (belief.time or 0.0) + float(rng.choice([0.0, 0.01, 0.1, 1.0, 4.0]))
        scan = plots(later, rng.normal(0.0, scale, (int(rng.integers(0, 15)), 2)))
        belief, _ = step(STRAIGHT, belief, scan, number, Knobs())
        r = belief.objects.existence
        assert ((r > 0.0) & (r <= 1.0)).all()
        assert len(set(belief.objects.label.tolist())) == len(r)
        assert (np.linalg.eigvalsh(belief.objects.components.covariance) > 0.0).all()
        assert np.bincount(belief.objects.components.group, belief.objects.components.weight) == pytest.approx(
            np.ones(len(r))
        )


# what is broken


def broken(**parts: Any) -> Scan:
    return plots(0.5, [(1.0, 2.0), (3.0, 4.0)])._replace(**parts)


@pytest.mark.parametrize(
    ("scan", "message"),
    [
        (broken(values=np.array([[1.0, 2.0], [3.0, math.nan]])), r"'plots' at 0.5 s has nan in its values .*\[1, 1\]"),
        (broken(values=np.array([[1.0, math.inf]])), r"'plots' at 0.5 s has inf in its values"),
        (broken(values=np.zeros((2, 3))), r"'plots' at 0.5 s has values of \(x, y\) of shape \(2, 3\); give \(2, 2\)"),
        (broken(values=np.zeros(2)), r"has values of \(x, y\) of shape \(2,\); give \(2, 2\)"),
        (broken(time=math.nan), "'plots' has time nan s"),
        (broken(time=-1.0), "'plots' has time -1.0 s"),
        (broken(time=math.inf), "'plots' has time inf s"),
        (broken(sensor="sonar"), r"at 0.5 s is of sensor 'sonar', but the model has \['plots'\]"),
        (broken(pose=np.array([0.0, math.nan, 0.0])), r"'plots' at 0.5 s has nan in its pose \(x, y, heading\)"),
        (broken(pose=np.zeros(2)), r"has pose \(x, y, heading\) of shape \(2,\); give \(3,\)"),
        (broken(noise=np.eye(2)), r"has covariances of shape \(2, 2\); give \(2, 2, 2\)"),
        (broken(noise=np.array([np.eye(2), [[1.0, 2.0], [2.0, 1.0]]])), r"definite, of measurement 1: \[\[1.0, 2"),
        (broken(noise=np.array([np.eye(2), [[1.0, 0.5], [0.2, 1.0]]])), "not symmetric and positive definite"),
        (broken(noise=np.array([np.eye(2), np.zeros((2, 2))])), "positive definite, of measurement 1"),
        (broken(noise=np.full((2, 2, 2), math.inf)), "has inf in its covariances"),
        (broken(score=np.array([0.5, 1.2])), "has the score 1.2, but scores are probabilities"),
        (broken(score=np.array([0.5, math.nan])), "has nan in its scores"),
        (broken(likeness=np.array([[1.0], [0.0]])), r"has the likeness \[0.0\]"),
        (broken(likeness=np.ones((2, 2))), r"has likeness by kind of shape \(2, 2\); give \(2, 1\)"),
    ],
)  # fmt: skip
def test_broken_scan_is_refused_before_any_step(scan: Scan, message: str) -> None:
    with pytest.raises(InputError, match=message) as refusal:
        lmb.run(STRAIGHT, [plots(0.0, [(0.0, 0.0)]), scan])
    sentence = str(refusal.value)
    assert "\n" not in sentence
    assert "; " in sentence  # and what to do


def test_recording_without_scans_is_refused() -> None:
    with pytest.raises(InputError, match="a filter needs at least one scan, but got none"):
        lmb.run(STRAIGHT, STRAIGHT.prepare(Recording(())))


@pytest.mark.parametrize(
    ("knob", "message"),
    [
        ({"gate": 0.0}, "gate is 0.0; give a positive number"),
        ({"gate": math.nan}, "gate is nan"),
        ({"least": 1.0}, "least is 1.0; give a share"),
        ({"merge": -1.0}, "merge is -1.0"),
        ({"most": 0}, "most is 0; give 1 or more"),
        ({"faint": 1.0}, "faint is 1.0; give a probability below 1"),
        ({"faint": math.nan}, "faint is nan"),
        ({"max_shared": 21}, "max_shared is 21; give 0 to 20 bits"),
        ({"report": -0.1}, "report is -0.1; give a probability below 1"),
        ({"patience": -1.0}, "patience is -1.0; give the seconds"),
    ],
)  # fmt: skip
def test_settings_out_of_their_range_are_refused(knob: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        lmb.run(STRAIGHT, [plots(0.0, [(0.0, 0.0)])], **knob)


STATE, P4 = [1.0, 2.0, 0.5, 0.5], np.eye(4)


@pytest.mark.parametrize("places", [[], [(1.0, 2.0)], [(90.0, 0.0)]])
@pytest.mark.parametrize(
    "prior",
    [
        objects_at([[math.nan, *STATE[1:]]], P4, [0.5]),
        objects_at([[*STATE[:3], math.nan]], P4, [0.5]),
        objects_at([STATE], math.nan * P4, [0.5]),
        objects_at([STATE], np.diag([math.inf, 1.0, 1.0, 1.0]), [0.5]),
        objects_at([STATE], np.diag([1.0, 1.0, 1.0, math.inf]), [0.5]),
        objects_at([STATE], np.diag([-3.0, 1.0, 1.0, 1.0]), [0.5]),
        objects_at([STATE], P4, [math.nan]),
    ],
)  # fmt: skip
def test_no_nan_passes(prior: Bernoullis, places: Any) -> None:
    with pytest.raises(
        FloatingPointError, match=r"the update by sensor 'plots' at 0.1 s made a number that is not finite"
    ):
        step(STRAIGHT, Belief(0.0, prior), plots(0.1, places), 0, Knobs())


def test_no_nan_of_what_a_sensor_detects_passes() -> None:
    """A yaw rate that is NaN makes position and p_D NaN, too."""
    prior = objects_at([[10.0, 0.0, 0.0, 1.0, math.nan, 0.0]], np.eye(6), [0.5])
    for values in (np.zeros((0, 3)), np.array([[10.0, 0.1, 1.0]])):
        with pytest.raises(FloatingPointError, match="the update by sensor 'radar'"):
            step(TURNING, Belief(0.0, prior), Scan("radar", 0.1, values, CAR), 0, Knobs())


# pieces of the kernel


def reduced(w: Any, kind: Any, mean: Any, P: Any, period: Any, least: float, merge: float, most: int) -> Any:
    count, n = np.shape(mean)
    num_kinds = int(np.max(kind)) + 1
    room = num_kinds * most + 1
    out = np.zeros(room), np.zeros(room, dtype=np.int64), np.zeros((room, n)), np.zeros((room, n, n))
    args = (
        np.array(w, dtype=np.float64),
        np.array(kind),
        num_kinds,
        np.array(mean, dtype=np.float64),
        np.array(P, dtype=np.float64),
    )
    made = reduce(count, *args, np.array(period), least, merge, most, 1, *out)
    return [part[1 : 1 + made] for part in out]


def test_merging_keeps_moments() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 3, 3))
    w, mean, P = rng.random(5), rng.normal(size=(5, 3)), root @ root.swapaxes(1, 2) + np.eye(3)
    weight, kind, m, V = reduced(w, np.ones(5, dtype=np.int64), mean, P, [math.inf] * 3, 0.0, 1e9, 4)
    share = w / w.sum()
    centre = share @ mean
    expected = np.einsum("c,cij->ij", share, P + (mean - centre)[:, :, None] * (mean - centre)[:, None])
    assert weight.tolist() == [1.0]
    assert kind.tolist() == [1]
    np.testing.assert_allclose(m[0], centre, rtol=1e-12)
    np.testing.assert_allclose(V[0], expected, rtol=1e-12)


def test_merging_goes_around_the_circle() -> None:
    period, P = [math.inf, 2 * math.pi], np.tile(np.eye(2), (2, 1, 1))
    _, _, m, V = reduced([0.75, 0.25], [0, 0], [[0.0, 3.1], [0.0, -3.1]], P, period, 0.0, 2.0, 4)
    apart = 2 * math.pi - 6.2
    assert m[0].tolist() == pytest.approx([0.0, 3.1 + 0.25 * apart], rel=1e-12)
    assert V[0, 1, 1] == pytest.approx(1.0 + 0.75 * 0.25 * apart**2, rel=1e-12)


def test_reduction_takes_the_heaviest_first_and_what_is_near_it() -> None:
    mean, P = [[0.0], [1.4], [5.0], [1.0], [9.0]], np.array([1.0, 1.0, 4.0, 1.0, 1.0]).reshape(5, 1, 1)
    w, kind = [0.5, 0.2, 0.15, 0.1, 0.05], [0, 0, 0, 1, 0]
    weight, kinds, m, _ = reduced(w, kind, mean, P, [math.inf], 0.0, 2.0, 9)
    assert weight.tolist() == pytest.approx([0.7, 0.15, 0.05, 0.1], rel=1e-12)  # of the other kind is not merged
    assert kinds.tolist() == [0, 0, 0, 1]
    assert m[:, 0].tolist() == pytest.approx([0.4, 5.0, 9.0, 1.0], rel=1e-12)
    far, _, _, _ = reduced(w, kind, mean, P, [math.inf], 0.0, 1.9, 9)
    assert far.tolist() == pytest.approx([0.5, 0.2, 0.15, 0.05, 0.1], rel=1e-12)
    light, kinds, _, _ = reduced(w, kind, mean, P, [math.inf], 0.1, 2.0, 9)
    assert light.tolist() == pytest.approx(np.array([0.7, 0.15, 0.1]) / 0.95, rel=1e-12)
    assert kinds.tolist() == [0, 0, 1]  # the only one of its kind, though .1 is not more than a tenth
    two, _, _, _ = reduced(w, kind, mean, P, [math.inf], 0.0, 2.0, 2)
    assert two.tolist() == pytest.approx(np.array([0.7, 0.15, 0.1]) / 0.95, rel=1e-12)


def test_a_kind_without_weight_is_left_out() -> None:
    mean, P = np.zeros((3, 1)), np.ones((3, 1, 1))
    weight, kinds, _, _ = reduced([1.0, 1e-8, 1e-10], [0, 1, 2], mean, P, [math.inf], 0.1, 2.0, 9)
    assert kinds.tolist() == [0, 1]
    assert weight.tolist() == pytest.approx([1.0, 1e-8], rel=1e-7)


def test_heaviest_component_is_always_kept() -> None:
    weight, _, m, _ = reduced(
        [0.3, 0.31, 0.3], [0, 0, 0], [[0.0], [9.0], [18.0]], np.ones((3, 1, 1)), [math.inf], 0.5, 1.0, 4
    )
    assert weight.tolist() == [1.0]
    assert m.tolist() == [[9.0]]


def test_objects_are_told_of_by_their_heaviest_component() -> None:
    offset, weight, kind = np.array([0, 2, 5]), np.array([0.4, 0.6, 0.5, 0.3, 0.2]), np.array([0, 1, 2, 0, 0])
    mean, P = np.arange(5.0)[:, None], np.arange(5.0)[:, None, None]
    m, V, p = heaviest(offset, weight, kind, mean, P, 3)
    assert m.tolist() == [[1.0], [2.0]]
    assert V.tolist() == [[[1.0]], [[2.0]]]
    np.testing.assert_allclose(p, [[0.4, 0.6, 0.0], [0.5, 0.0, 0.5]], atol=1e-15)


def test_recordings_are_as_good_as_their_scans() -> None:
    scans = tuple(plots(0.1 * k, [(3.0, 0.5 * k)]) for k in range(4))
    one, other = lmb.run(STRAIGHT, scans), lmb.run(STRAIGHT, Recording(scans))
    np.testing.assert_array_equal(one.existence, other.existence)
    with pytest.raises(InputError, match="at least one scan"):
        lmb.run(STRAIGHT, Recording(()))
