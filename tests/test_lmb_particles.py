"""The labeled multi-Bernoulli filter with particles: against Kalman, the Gaussian filter, and the truth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from inference import lmb, lmb_particles
from inference.object_particles import draw, log_corrections, moments, widen
from inference.tracks import Tracks
from models.multi_object import Bernoullis, Components, View, no_objects
from models.objects.motion import ConstantTurn, ConstantVelocity
from models.objects.scans import Recording, Scan
from models.objects.scene import simulate_scan
from models.objects.sensors import Position, Radar, RangeBearing
from models.objects.traffic import Kind, Place, Traffic
from models.program import InputError
from tests.line_objects import Line, LineScan, enumerate_posterior, scan_at

Floats = NDArray[np.float64]
POSE = np.zeros(3)
FRONT = (3.5, 0.0, 0.0)


def plots(detection: float = 0.9, clutter: float = 2.0) -> Traffic:
    """Linear: positions in a square of 80 m."""
    sensor = Position(name="plots", noise_std=(1.0, 1.0), detection=detection, clutter=clutter, extent=40.0)
    return Traffic((sensor,), ConstantVelocity(), (Kind(noise=(1.0, 1.0), speed=(0.0, 3.0)),), unseen_density=3e-4)


def certain(mean: Floats, std: Floats, num: int, seed: int, existence: float = 1.0) -> lmb_particles.Clouds:
    """One object at time 0, of N(mean, diag std^2)."""
    state = mean + std * np.random.default_rng(seed).standard_normal((1, num, len(mean)))
    none = np.zeros((1, num), dtype=np.int64)
    even = np.full((1, num), 1.0 / num)
    return lmb_particles.Clouds(0.0, np.zeros(1, dtype=np.int64), np.full(1, existence), even, none, state, none)


def test_one_object_that_is_always_detected_is_filtered_as_by_kalman() -> None:
    """Each scan draws N particles anew, which moves the mean by at most sd / sqrt(N); over K scans these add up in
    squares: 5 sd sqrt(K / N) is five standard errors and more."""
    model, num, count, dt = plots(detection=1.0, clutter=1e-9), 20_000, 8, 0.2
    model = Traffic(model.sensors, model.motion, model.kinds, unseen_density=1e-12)
    mean, std = np.array([5.0, -3.0, 2.0, 1.0]), np.array([2.0, 2.0, 3.0, 3.0])
    belief, P = certain(mean, std, num, 0), np.diag(std**2)
    F, H = np.eye(4) + dt * np.eye(4, k=2), np.eye(2, 4)
    Q = np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
    rng = np.random.default_rng(1)
    for number in range(count):
        z = np.array([5.0, -3.0]) + dt * (number + 1) * np.array([3.0, 0.0]) + rng.standard_normal(2)
        scan = Scan("plots", dt * (number + 1), z[None], POSE)
        belief, _ = lmb_particles.step(model, belief, scan, number, lmb_particles.Knobs(num_particles=num), 0)
        mean, P = F @ mean, F @ P @ F.T + Q
        gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(2))
        mean, P = mean + gain @ (z - H @ mean), P - gain @ H @ P
        found = lmb_particles.tell(belief, 0.0, model.period, 1)
        sd = np.sqrt(np.diag(P))
        assert np.all(np.abs(found.mean[0] - mean) < 5 * sd * math.sqrt(count / num))
        error = np.abs(found.covariance[0] - P) / np.outer(sd, sd)
        assert np.all(error < 5 * math.sqrt(2 * count / num))
    assert found.existence[0] > 0.999


def test_long_gaps_have_the_noise_of_all_their_steps() -> None:
    """All but that of the last step is drawn; together they are Q of the whole gap."""
    model, num, dt = plots(), 20_000, 1.5
    none, zero = np.zeros(num, dtype=np.int64), np.zeros((num, 4))
    state, survival, rest = lmb_particles.moved_on(model, none, zero, dt, np.random.default_rng(0))
    Q = np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
    std = np.sqrt(np.diag(Q))
    error = np.cov(state.T) + rest[0] - Q
    assert np.all(np.abs(error) < 5 * np.outer(std, std) * math.sqrt(2 / num))
    np.testing.assert_allclose(survival, math.exp(-dt / model.kinds[0].lifetime), rtol=1e-12)
    last = lmb.LONGEST
    np.testing.assert_allclose(rest[0, [0, 2], [0, 2]], [last**3 / 3, last], rtol=1e-12)


def test_kernels_are_those_of_families() -> None:
    """Two headings of one object, far apart: particles are drawn to the middle of their own, and keep its width."""
    rng, num = np.random.default_rng(0), 500
    state = rng.standard_normal((1, num, 2))
    family = (np.arange(num) % 2)[None]
    state[0, :, 0] += 1000.0 * family[0]
    none = np.zeros((1, num), dtype=np.int64)
    even = np.full((1, num), 1.0 / num)
    belief = lmb_particles.Clouds(0.0, none[:, 0], np.ones(1), even, none, state, family)
    found = lmb_particles.regularise(belief, np.zeros((num, 2, 2)), np.full(2, np.inf), 0.5).components
    for k in (0, 1):
        own, before = found.mean[family[0] == k], state[0, family[0] == k]
        V = np.cov(before.T, bias=True)
        np.testing.assert_allclose(own.mean(0), before.mean(0), atol=1e-9)
        np.testing.assert_allclose(np.cov(own.T, bias=True), 0.75 * V, atol=1e-9)
        np.testing.assert_allclose(found.covariance[family[0] == k], np.tile(0.25 * V, (num // 2, 1, 1)), atol=1e-9)


def test_further_states_are_hidden_by_the_heaviest_component_of_an_object() -> None:
    sensor = RangeBearing(name="radar", noise_std=(0.5, 0.02), occlusion=1.0)
    model = Traffic((sensor,), ConstantVelocity(), (Kind(noise=(1.0, 1.0)),))
    mean, none = np.array([[0.0, 40.0, 0.0, 0.0], [20.0, 0.0, 0.0, 0.0]]), np.zeros(2, dtype=np.int64)
    parts = Components(np.array([0, 2]), np.array([0.2, 0.8]), none, mean, np.tile(np.eye(4), (2, 1, 1)))
    objects, scan = Bernoullis(none[:1], np.array([0.9]), parts), Scan("radar", 0.0, np.zeros((0, 2)), POSE)
    behind = np.array([[60.0, 0.0, 0.0, 0.0], [0.0, 60.0, 0.0, 0.0]])
    _, found = lmb_particles.look(model, scan, objects, none, behind)
    more = Components(np.array([0, 2]), np.full(2, 0.5), none, behind, np.tile(np.eye(4), (2, 1, 1)))
    np.testing.assert_allclose(found, model.view(scan, objects, more).detection[2:], rtol=1e-12)
    assert found[0] < 0.75 * found[1]


def crossing(model: Traffic, count: int) -> list[Scan]:
    """Two objects that meet."""
    kind = np.zeros(2, dtype=np.int64)
    way = [np.array([[t - 3.0, 2.0, 2.0, 0.0], [t - 3.0, -2.0, 2.0, 0.0]]) for t in 0.5 * np.arange(count)]
    return [simulate_scan(model, "plots", 0.5 * t, POSE, kind, x, 10 + t)[0] for t, x in enumerate(way)]


def test_twenty_thousand_particles_agree_with_gaussian_mixtures_where_all_is_linear() -> None:
    """Ten runs of 2000 particles: their mean is within 4.5 of its standard errors, and what 1 / N leaves of bias.

    Without kernels, which blur objects of several modes; and within the view, on whose edge p_D is not constant."""
    model, runs, num = plots(), 10, 2000
    scans = crossing(model, 7)
    exact, belief = lmb.Knobs(least=1e-9, merge=1e-6, most=200), lmb.Belief(None, no_objects(4))
    for number, scan in enumerate(scans):
        belief, facts = lmb.step(model, belief, scan, number, exact)
    parts = belief.objects.components
    middle = {
        label: parts.weight[a:b] @ parts.mean[a:b]
        for label, a, b in zip(belief.objects.label, parts.offset[:-1], parts.offset[1:], strict=True)
    }
    expected = {
        label: r
        for label, r in zip(belief.objects.label, belief.objects.existence, strict=True)
        if r > 0.05 and np.abs(middle[label][:2]).max() < 30.0
    }
    assert len(expected) >= 4
    existence, mean, factor = [], [], []
    for seed in range(runs):
        found, knobs = lmb_particles.nobody(4, num), lmb_particles.Knobs(num_particles=num, kernel=0.0)
        for number, scan in enumerate(scans):
            found, said = lmb_particles.step(model, found, scan, number, knobs, seed)
        told, factor = lmb_particles.tell(found, 0.0, model.period, 1), [*factor, said.log_factor]
        row = {label: i for i, label in enumerate(told.label)}
        existence.append([told.existence[row[label]] for label in expected])
        mean.append([told.mean[row[label]] for label in expected])
    for values, target in (
        (np.array(existence), np.array(list(expected.values()))),
        (np.array(mean), np.array([middle[label] for label in expected])),
        (np.array(factor), facts.log_factor),
    ):
        error = values.std(0, ddof=1) / math.sqrt(runs)
        assert np.all(np.abs(values.mean(0) - target) < 4.5 * error + 0.01)
        assert np.all(error < 0.5)


def three_sensors(laser: float) -> Traffic:
    """A radar, a laser and a camera that look ahead."""
    radar = Radar(
        name="radar", mount=FRONT, angle=2.1, noise_std=(0.3, math.radians(1.0), 0.15), detection=0.9, clutter=3.0
    )
    ranged = RangeBearing(name="laser", mount=FRONT, angle=3.6, noise_std=(laser, math.radians(0.15)), clutter=3.0)
    camera = RangeBearing(
        name="camera", angle=1.7, reach=(0.0, 120.0), noise_std=(4.0, math.radians(0.15)), clutter=2.0, births=False
    )
    return Traffic((radar, ranged, camera), ConstantTurn(), (Kind(lifetime=1e4),), unseen_density=1e-4)


def drawn(model: Traffic, num: int, duration: float, seed: int) -> tuple[Recording, Floats]:
    """Objects that move as the model says, and where they are at each scan (T, num, n)."""
    rng = np.random.default_rng(seed)
    x, kind = np.zeros((num, 6)), np.zeros(num, dtype=np.int64)
    x[:, 0], x[:, 1] = 40.0 + 5.0 * rng.standard_normal(num), np.linspace(-20.0, 20.0, num)
    x[:, 2], x[:, 3] = rng.uniform(-math.pi, math.pi, num), 8.0 + 2.0 * rng.standard_normal(num)
    scans, truth, last = list[Scan](), list[Floats](), 0
    for tick in range(round(100 * duration)):
        for name, (first, period) in {"radar": (0, 7), "laser": (2, 8), "camera": (3, 7)}.items():
            if tick >= first and (tick - first) % period == 0:
                if tick > last:
                    moved = model.move(kind, x, (tick - last) / 100)
                    e = rng.standard_normal(moved.noise.shape[::2])
                    x, last = moved.mean + np.einsum("inm,im->in", moved.noise, e), tick
                scans.append(simulate_scan(model, name, tick / 100, POSE, kind, x, rng)[0])
                truth.append(x)
    return Recording(tuple(scans)), np.array(truth)


def nees(tracks: Tracks, truth: Floats, start: float) -> float:
    """Mean of e' P^-1 e over the positions of confirmed objects, the nearest true one being meant: two, if right."""
    found = list[float]()
    for t in np.flatnonzero(tracks.time >= start):
        told = tracks.at(int(t))
        for row in np.flatnonzero(told.existence > 0.5):
            off = truth[t, :, :2] - told.mean[row, :2]
            e = off[np.square(off).sum(1).argmin()]
            if e @ e < 25.0:
                found.append(float(e @ np.linalg.solve(told.covariance[row, :2, :2], e)))
    assert len(found) > 30
    return float(np.mean(found))


def mean_nees(laser: float, seeds: tuple[int, ...], **settings: float) -> float:
    model = three_sensors(laser)
    cases = [drawn(model, 2, 2.5, seed) for seed in seeds]
    return float(
        np.mean([nees(lmb_particles.run(model, c.scans, seed=0, **settings), x, 1.0) for c, x in cases])  # type: ignore[arg-type]
    )


SEEDS = (0, 1, 2, 3, 4, 5)


def test_errors_are_as_large_as_the_particles_say() -> None:
    assert 1.6 < mean_nees(0.1, SEEDS) < 2.4


def test_without_kernels_an_accurate_laser_leaves_a_cloud_that_is_too_sure() -> None:
    assert mean_nees(0.02, SEEDS[:1], num_particles=500, kernel=0.0) > 5.0


def test_an_object_outside_every_view_keeps_its_existence() -> None:
    sensor = RangeBearing(name="front", noise_std=(0.1, 0.01), angle=1.0, reach=(0.0, 60.0), detection=0.99)
    model = Traffic((sensor,), ConstantVelocity(), (Kind(noise=(1.0, 1.0)),))
    belief = certain(np.array([0.0, 30.0, 0.0, 0.0]), np.full(4, 0.1), 100, 0, existence=0.7)
    for number in range(5):
        scan, knobs = Scan("front", 0.0, np.zeros((0, 2)), POSE), lmb_particles.Knobs(num_particles=100)
        belief, _ = lmb_particles.step(model, belief, scan, number, knobs, 0)
    np.testing.assert_allclose(belief.existence, 0.7, atol=1e-12)


def test_the_same_seed_gives_the_same_bits_and_late_scans_are_taken() -> None:
    model = plots()
    scans = crossing(model, 6)
    scans[3], scans[4] = scans[4], scans[3]
    first, again, other = (lmb_particles.run(model, scans, seed=s, num_particles=200) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.mean, again.mean)
    assert first.log_evidence == again.log_evidence != other.log_evidence
    assert first.info["late"] == 1


def test_weights_of_draws_are_those_of_importance_sampling() -> None:
    """log w = log p_D(x) N(z; h(x), R) N(x; m, P) / (p_D(m) N(z; h(m), S) q(x)), q the density that was drawn from."""
    from scipy.stats import multivariate_normal as normal

    rng = np.random.default_rng(0)
    m, H, R, z = rng.standard_normal(3), rng.standard_normal((2, 3)), np.diag([0.3, 0.5]), np.array([0.4, -0.3])
    P = 0.5 * np.eye(3) + 0.2
    view = (m[None, :2], H[None], z[None], R[None], np.zeros(1, dtype=np.int64), np.full(2, np.inf))
    component, measured = np.zeros(20_000, dtype=np.int64), np.zeros(20_000, dtype=np.int64)
    x = draw(component, measured, m[None], P[None], *view, rng.standard_normal((20_000, 3)))
    S = H @ P @ H.T + R
    gain = P @ H.T @ np.linalg.inv(S)
    centre, V = m + gain @ (z - m[:2]), P - gain @ H @ P
    np.testing.assert_allclose(x.mean(0), centre, atol=5 * np.sqrt(np.diag(V).max() / len(x)))
    np.testing.assert_allclose(np.cov(x.T), V, atol=5 * np.diag(V).max() * math.sqrt(2 / len(x)))
    seen, detected = np.sin(x[:, :2]), 0.5 + 0.1 * np.tanh(x[:, 0])
    found = log_corrections(x, seen, detected, component, measured, m[None], *view[:2], np.full(1, 0.7), *view[2:])
    log_q = normal(centre, V).logpdf(x)
    likelihood = normal(np.zeros(2), R).logpdf(z - seen) + np.log(detected)
    expected = likelihood + normal(m, P).logpdf(x) - log_q - math.log(0.7) - normal(m[:2], S).logpdf(z)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_angles_are_averaged_as_angles() -> None:
    period, rng = np.array([np.inf, math.tau]), np.random.default_rng(0)
    x, weight, one = rng.normal([3.0, math.pi], [1.0, 0.3], (500, 2)), rng.random(500), np.zeros(500, dtype=np.int64)
    turned = x + np.outer(rng.integers(-2, 3, 500), [0.0, math.tau])
    mean, V = moments(one, 1, weight, x, period)
    found, spread = moments(one, 1, weight, turned, period)
    assert abs(math.remainder(found[0, 1] - mean[0, 1], math.tau)) < 1e-9
    np.testing.assert_allclose(spread, V, atol=1e-9)
    np.testing.assert_allclose(V[0], np.cov(x.T, aweights=weight, bias=True), atol=1e-9)


def test_kernels_leave_the_moments_of_a_cloud_as_they_are() -> None:
    period, rng = np.array([np.inf, math.tau]), np.random.default_rng(0)
    x, weight, one = rng.normal([3.0, math.pi], [1.0, 0.3], (500, 2)), rng.random(500), np.zeros(500, dtype=np.int64)
    mean, V = moments(one, 1, weight, x, period)
    P = np.zeros((500, 2, 2))
    widen(one, mean, V, period, 0.4, x, P)
    after, inner = moments(one, 1, weight, x, period)
    np.testing.assert_allclose(after, mean, atol=1e-9)
    np.testing.assert_allclose(inner + P[0], V, atol=1e-9)


def test_objects_come_from_known_places() -> None:
    model = plots()
    place = Place((10.0, 5.0), 2.0, 0.5)
    model = Traffic(model.sensors, model.motion, model.kinds, 3e-4, places=(place,))
    belief = lmb_particles.nobody(4, 5000)
    moved, _ = lmb_particles.predict(model, belief, 0.4, 3, np.random.default_rng(0))
    assert moved.existence[0] == pytest.approx(-math.expm1(-model.arrived(0.4)[1].sum()))
    told = lmb_particles.tell(moved, 0.0, model.period, 1)
    np.testing.assert_allclose(told.mean[0, :2], place.position, atol=5 * place.std / math.sqrt(5000))


def test_objects_survive_as_long_as_their_kind_lives() -> None:
    model = plots()
    belief = certain(np.zeros(4), np.ones(4), 100, 0, existence=0.8)
    moved, _ = lmb_particles.predict(model, belief, 1.3, 0, np.random.default_rng(0))
    assert moved.existence[0] == pytest.approx(0.8 * math.exp(-1.3 / model.kinds[0].lifetime), abs=1e-12)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="num_particles is 1"):
        lmb_particles.run(plots(), crossing(plots(), 1), num_particles=1)
    with pytest.raises(InputError, match=r"kernel is 1.5"):
        lmb_particles.run(plots(), crossing(plots(), 1), kernel=1.5)
    with pytest.raises(InputError, match="lmb_particles needs a model of many objects"):
        lmb_particles.run(object(), [])  # type: ignore[arg-type]


def test_empty_scans_of_nobody_are_scans() -> None:
    scans = [Scan("plots", 0.1 * t, np.zeros((0, 2)), POSE) for t in range(3)]
    scans.append(Scan("plots", 0.3, np.array([[1.0, 2.0]]), POSE))
    found = lmb_particles.run(plots(), scans, num_particles=50)
    assert np.diff(found.offset).tolist() == [0, 0, 0, 1]
    assert found.existence == pytest.approx(lmb.run(plots(), scans).existence, rel=1e-9)


LINE = Line(unseen_number=0.4)
LOOK = scan_at(0.4, (0.3, 2.0), (0.3, 4.0))
EVERYTHING = lmb_particles.Knobs(num_particles=400, kernel=0.0, gate=math.inf, faint=0.0)


def two_clouds(num: int = 400) -> lmb_particles.Clouds:
    """Two objects of uneven particles, calm ones first."""
    rng, none = np.random.default_rng(4), np.zeros((2, num), dtype=np.int64)
    weight, kind = rng.uniform(0.2, 1.0, (2, num)), none + (np.arange(num) >= 0.6 * num)
    state = rng.normal([0.2, 0.0], [1.0, 0.7], (2, num, 2)) + np.array([[[0.0, 0.4]], [[1.5, -0.3]]])
    weight /= weight.sum(1, keepdims=True)
    return lmb_particles.Clouds(0.0, np.array([-2, -1]), np.array([0.7, 0.45]), weight, kind, state, none)


def test_a_step_from_known_particles_is_that_of_all_histories() -> None:
    """Two kinds, unlike features: existence and evidence exactly. Shares of kinds within what systematic resampling
    leaves, one particle at each end of each of three measured runs; means within 5 standard errors."""
    belief = two_clouds()
    answer = enumerate_posterior(LINE, 0.0, belief.as_components(np.zeros((800, 2, 2))), [LOOK], lmb.STRIDE)
    after, facts = lmb_particles.step(LINE, belief, LOOK, 0, EVERYTHING, 2)
    assert facts.log_factor == pytest.approx(answer.log_sum, abs=1e-9)
    assert facts.left_out == facts.loopy == 0.0
    np.testing.assert_array_equal(after.label, [-2, -1, 0, 1])
    told = lmb_particles.tell(after, 0.0, LINE.period, 2)
    for i, label in enumerate(after.label):
        exact, parts = answer.existence(label), answer.objects[label]
        assert after.existence[i] == pytest.approx(exact, abs=1e-9)
        assert told.kind[i, 1] == pytest.approx(sum(part.weight for part in parts if part.kind) / exact, abs=6 / 400)
        mean = sum(part.weight * part.mean for part in parts) / exact
        sd = np.sqrt(np.diag(told.covariance[i]))
        np.testing.assert_array_less(np.abs(told.mean[i] - mean), 5 * sd / math.sqrt(400))


def test_existence_falls_where_nothing_is_seen() -> None:
    belief, empty = two_clouds(), scan_at(0.4, ())
    answer = enumerate_posterior(LINE, 0.0, belief.as_components(np.zeros((800, 2, 2))), [empty], lmb.STRIDE)
    after, _ = lmb_particles.step(LINE, belief, empty, 0, EVERYTHING, 2)
    np.testing.assert_allclose(after.existence, [answer.existence(-2), answer.existence(-1)], atol=1e-9)
    assert np.all(after.existence < 0.7 * belief.existence)


def test_particles_are_resampled_as_often_as_they_weigh_on_average() -> None:
    """Of ten particles the light one is drawn with the probability of its weight times 1 - p_D, never or else once."""
    none = np.zeros((1, 10), dtype=np.int64)
    weight, kind = np.full((1, 10), 0.98 / 9), none + (np.arange(10) == 9)
    weight[0, 9] = 0.02
    belief = lmb_particles.Clouds(0.0, none[:, 0], np.ones(1), weight, kind, np.zeros((1, 10, 2)), none)
    knobs, empty, runs = EVERYTHING._replace(num_particles=10), scan_at(0.0, ()), 2000
    light = [lmb_particles.step(LINE, belief, empty, k, knobs, 0)[0].kind.sum() for k in range(runs)]
    calm, wild = 1.0 - np.array(LINE.detection)
    expected = 10 * 0.02 * wild / (0.02 * wild + 0.98 * calm)
    assert set(light) == {0, 1}
    assert np.mean(light) == pytest.approx(expected, abs=4.5 * math.sqrt(expected / runs))


def test_faint_objects_are_left_out_and_told_of() -> None:
    everything, _ = lmb_particles.step(LINE, two_clouds(), LOOK, 3, EVERYTHING, 2)
    for faint in np.sort(everything.existence)[:-1] + 1e-6:
        some, facts = lmb_particles.step(LINE, two_clouds(), LOOK, 3, EVERYTHING._replace(faint=float(faint)), 2)
        kept = everything.existence > faint
        np.testing.assert_array_equal(some.label, everything.label[kept])
        np.testing.assert_allclose(some.existence, everything.existence[kept], rtol=1e-12)
        assert facts.left_out == pytest.approx(everything.existence[~kept].sum(), rel=1e-9)


def test_large_groups_are_told_of() -> None:
    _, facts = lmb_particles.step(LINE, two_clouds(), LOOK, 0, EVERYTHING._replace(max_shared=0), 0)
    assert facts.loopy == 1


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_gate_is_about_all_that_particles_predict(side: float) -> None:
    """On a circle of ten, across its seam: off^2 <= gate (var + H P H' + R) of the weighted particles, with the noise P
    of the heaviest; measurements beyond are of nobody."""
    model, gate, none = Line(period=np.array([10.0, math.inf])), 2.0, np.zeros((1, 3), dtype=np.int64)
    place, kind, weight = np.array([4.9, 5.2, 5.9]), np.array([1, 0, 0]), np.array([0.3, 0.5, 0.2])
    state = np.stack([np.remainder(place + 5.0, 10.0) - 5.0, np.zeros(3)], 1)
    belief = lmb_particles.Clouds(0.0, none[:, 0], np.ones(1), weight[None], kind[None], state[None], none)
    weight = weight * [model.survival(k, 0.4) for k in kind]
    alive = weight.sum()
    weight /= alive
    mean = weight @ place
    variance = weight @ (place - mean) ** 2 + model.spread(0, 0.4)[0, 0] + model.std**2
    missed = 1.0 - alive * weight @ np.array(model.detection)[kind]
    knobs = EVERYTHING._replace(num_particles=3, gate=gate)
    for scale, within in ((0.999, True), (1.001, False)):
        z = mean + side * scale * math.sqrt(gate * variance)
        for turns in (-1, 0):
            _, facts = lmb_particles.step(model, belief, scan_at(0.4, (z + 10.0 * turns,)), 0, knobs, 0)
            alone = math.log(model.clutter * missed)
            assert (facts.log_factor > alone + 0.1) if within else facts.log_factor == pytest.approx(alone, abs=1e-12)


def test_missed_particles_weigh_as_much_as_they_could_be_missed() -> None:
    """At the edge of a view, all from one state and the noise about it: w ~ 1 - p_D(x)."""
    sensor = Position(name="plots", noise_std=(1.0, 1.0), detection=0.8, clutter=1.0, extent=20.0)
    model = Traffic((sensor,), ConstantVelocity(), (Kind(noise=(10.0, 10.0), speed=(0.0, 2.0)),), unseen_density=1e-3)
    belief = certain(np.array([19.0, 0.0, 0.0, 0.0]), np.zeros(4), 200, 0)
    knobs = lmb_particles.Knobs(num_particles=200, kernel=0.0)
    after, _ = lmb_particles.step(model, belief, Scan("plots", 0.5, np.zeros((0, 2)), POSE), 0, knobs, 0)
    expected = 1.0 - 0.8 / (1.0 + np.exp((np.abs(after.state[0, :, 0]) - 20.0) / 0.5))
    assert expected.std() > 0.1
    np.testing.assert_allclose(after.weight[0], expected / expected.sum(), atol=1e-5)  # the sides of the view


def test_components_are_taken_as_often_as_their_weight_says() -> None:
    offset, weight = np.array([0, 3, 3, 5]), np.array([1.0, 0.0, 3.0, 0.2, 0.6])
    found = lmb_particles.components_of(offset, weight, (0, 2), 1000, np.random.default_rng(0))
    count = np.bincount(found[:1000], minlength=5)
    assert np.all(np.abs(count - [250, 0, 750, 0, 0]) <= 1)
    assert np.all(np.abs(np.bincount(found[1000:], minlength=5) - [0, 0, 0, 250, 750]) <= 1)


def test_kernels_keep_the_moments_of_uneven_particles() -> None:
    belief = two_clouds()
    found = lmb_particles.regularise(belief, np.zeros((800, 2, 2)), LINE.period, 0.6).components
    for t in range(2):
        own, w = slice(400 * t, 400 * (t + 1)), belief.weight[t]
        V = np.cov(belief.state[t].T, aweights=w, bias=True)
        np.testing.assert_allclose(w @ found.mean[own], w @ belief.state[t], atol=1e-9)
        np.testing.assert_allclose(np.cov(found.mean[own].T, aweights=w, bias=True), 0.64 * V, atol=1e-9)
        np.testing.assert_allclose(found.covariance[own], np.tile(0.36 * V, (400, 1, 1)), atol=1e-9)


def test_arrivals_have_labels_places_and_families_of_their_own() -> None:
    """Headings about four ways, of which each is a family."""
    places = (Place((10.0, 5.0), 2.0, 0.5), Place((-20.0, 0.0), 1.0, 1.5))
    model = Traffic(plots().sensors, ConstantTurn(), (Kind(),), places=places)
    moved, covariance = lmb_particles.predict(model, lmb_particles.nobody(6, 800), 0.4, 3, np.random.default_rng(0))
    np.testing.assert_array_equal(moved.label, 3 * lmb.STRIDE + lmb.STRIDE // 2 + np.arange(2))
    np.testing.assert_allclose(moved.existence, -np.expm1(-model.arrived(0.4)[1:].sum(1)), rtol=1e-12)
    assert not covariance.any()
    for t, place in enumerate(places):
        np.testing.assert_allclose(moved.state[t, :, :2].mean(0), place.position, atol=5 * place.std / math.sqrt(800))
        np.testing.assert_array_equal(np.bincount(moved.family[t]), [200] * 4)
        for family in range(4):
            turned = np.exp(1j * (moved.state[t, moved.family[t] == family, 2] - 0.5 * math.pi * family))
            assert abs(np.angle(turned.mean())) < 5 * 0.5 / math.sqrt(200)


def test_families_go_with_their_particles() -> None:
    """Newborns' are their kind's here; that of an old particle is told by where it stands."""
    belief = two_clouds()
    far = np.arange(400) % 3
    belief = belief._replace(state=belief.state + 50.0 * far[:, None], family=np.tile(far, (2, 1)))
    scan = scan_at(0.4, (0.3, 52.0), (1.0, 2.0))
    after, _ = lmb_particles.step(LINE, belief, scan, 0, EVERYTHING._replace(faint=1e-6), 0)
    np.testing.assert_array_equal(after.label, [-2, -1, 0, 1])
    np.testing.assert_array_equal(after.family[:2], np.rint((after.state[:2, :, 1]) / 50.0))
    np.testing.assert_array_equal(after.family[2:], after.kind[2:])
    assert set(after.family[:2].ravel()) == {0, 1, 2}


def test_moments_that_are_told_are_weighted() -> None:
    belief = two_clouds()
    told = lmb_particles.tell(belief, 0.5, LINE.period, 2)
    np.testing.assert_array_equal(told.label, [-2])
    np.testing.assert_allclose(told.mean[0], belief.weight[0] @ belief.state[0], atol=1e-12)
    np.testing.assert_allclose(told.covariance[0], np.cov(belief.state[0].T, aweights=belief.weight[0], bias=True))
    np.testing.assert_allclose(told.kind[0, 1], belief.weight[0] @ belief.kind[0], atol=1e-12)


def test_each_scan_has_random_numbers_of_its_own_and_is_remembered() -> None:
    once, again, other = (lmb_particles.step(LINE, two_clouds(), LOOK, k, EVERYTHING, 0)[0] for k in (0, 0, 1))
    np.testing.assert_array_equal(once.state, again.state)
    assert np.all(once.state != other.state)
    assert once.past == (LOOK,)
    then, _ = lmb_particles.step(LINE, once, LOOK._replace(time=0.5), 1, EVERYTHING, 0)
    assert [scan.time for scan in then.past] == [0.4, 0.5]


@pytest.mark.parametrize("wrong", [{"clutter": math.nan}, {"detection": (math.nan, 0.5)}])
def test_no_nan_of_a_model_passes(wrong: Any) -> None:
    belief = lmb_particles.nobody(2, 400) if "clutter" in wrong else two_clouds()
    with pytest.raises(FloatingPointError, match=r"the update by sensor 'line' at 0.4 s made a NaN"):
        lmb_particles.step(Line(**wrong), belief, LOOK, 0, EVERYTHING, 0)


class HoleAhead(Line):
    """Detection is NaN a little off where an object is expected."""

    def view(self, scan: LineScan, objects: Bernoullis, more: Components) -> View:
        found = super().view(scan, objects, more)
        return found._replace(detection=np.where(found.predicted[:, 0] > 1.0, math.nan, found.detection))


def test_no_nan_of_what_is_drawn_passes() -> None:
    belief = certain(np.zeros(2), np.zeros(2), 100, 0)
    with pytest.raises(FloatingPointError, match=r"the update by sensor 'line' at 0.4 s made a NaN"):
        lmb_particles.step(HoleAhead(noise=(10.0, 10.0)), belief, scan_at(0.4, ()), 0, lmb_particles.Knobs(100), 0)
