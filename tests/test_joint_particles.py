"""The joint particle filter: against all that can have happened in tiny windows, and against the LMB filter."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from experiments.scenarios.close_targets import close_targets
from inference import joint_particles, lmb
from models.multi_object import no_objects
from models.objects.motion import ConstantVelocity
from models.objects.scans import Scan
from models.objects.sensors import Position, RangeBearing
from models.objects.traffic import Kind, Traffic
from models.program import InputError

Floats = NDArray[np.float64]
POSE = np.zeros(3)
STEP = 0.5  # [s]
EXACT = lmb.Knobs(least=0.0, merge=0.0, most=500, faint=0.0)


def small() -> Traffic:
    """Linear: positions in a square of 40 m, objects that soon go, false alarms as likely as new objects."""
    sensor = Position(name="plots", noise_std=(1.0, 1.0), detection=0.8, clutter=1.0, extent=20.0)
    kind = Kind(noise=(1.0, 1.0), speed=(0.0, 2.0), lifetime=5.0)
    return Traffic((sensor,), ConstantVelocity(), (kind,), unseen_density=1e-3)


def scans_of(*values: list[list[float]]) -> list[Scan]:
    return [Scan("plots", STEP * t, np.array(v).reshape(-1, 2), POSE) for t, v in enumerate(values)]


WINDOW = scans_of(
    [[0.0, 0.0], [2.5, 1.0]],
    [[0.5, 0.2], [2.0, 1.5]],
    [[1.2, 0.3]],
)


def enumerated(model: Traffic, scans: list[Scan]) -> tuple[float, dict[int, float], dict[int, Floats]]:
    """Log p(scans) but for the expected numbers of detections, and of each label the existence and mean after the last
    scan: Kalman filters in all histories of death, detection and birth, one after the other."""
    H, R, p_D, F = np.eye(2, 4), np.eye(2), 0.8, np.eye(4) + STEP * np.eye(4, k=2)
    Q = np.kron([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]], np.eye(2))
    survival = math.exp(-STEP / model.kinds[0].lifetime)
    histories: list[tuple[float, dict[int, tuple[Floats, Floats]]]] = [(1.0, {})]
    for number, scan in enumerate(scans):
        unseen, clutter = model.unseen(scan), float(model.sensors[0].clutter_intensity(scan.values[:1])[0])
        after = list[tuple[float, dict[int, tuple[Floats, Floats]]]]()
        for weight, objects in histories:
            moved = {label: (F @ m, F @ P @ F.T + Q) for label, (m, P) in objects.items()} if number else objects
            stay = survival if number else 1.0
            for choice in itertools.product(range(-2, len(scan.values)), repeat=len(moved)):  # -2 gone, -1 missed
                taken = [j for j in choice if j >= 0]
                if len(set(taken)) < len(taken):
                    continue
                left = [j for j in range(len(scan.values)) if j not in taken]
                for born in itertools.product((False, True), repeat=len(left)):
                    w, found = weight, dict[int, tuple[Floats, Floats]]()
                    pairs = [(label, *moved[label], j, stay) for label, j in zip(moved, choice, strict=True)]
                    for j, new in zip(left, born, strict=True):
                        if new:
                            label = number * lmb.STRIDE + j
                            pairs.append((label, unseen.mean[j], unseen.covariance[j], j, float(unseen.weight[j])))
                        else:
                            w *= clutter
                    for label, m, P, j, factor in pairs:
                        if j == -2:
                            w *= 1.0 - factor
                        elif j == -1:
                            w *= factor * (1.0 - p_D)
                            found[label] = (m, P)
                        else:
                            S = H @ P @ H.T + R
                            e, gain = scan.values[j] - H @ m, P @ H.T @ np.linalg.inv(S)
                            density = math.exp(-0.5 * e @ np.linalg.solve(S, e)) / (
                                math.tau * math.sqrt(np.linalg.det(S))
                            )
                            w *= factor * p_D * density
                            found[label] = (m + gain @ e, P - gain @ H @ P)
                    after.append((w, found))
        histories = after
    total = sum(w for w, _ in histories)
    existence, mean = dict[int, float](), dict[int, Floats]()
    for w, objects in histories:
        for label, (m, _) in objects.items():
            existence[label] = existence.get(label, 0.0) + w / total
            mean[label] = mean.get(label, np.zeros(4)) + w / total * m
    return math.log(total), existence, {label: mean[label] / existence[label] for label in mean}


def test_the_enumeration_and_the_lmb_filter_agree_where_that_is_exact() -> None:
    """The evidence of two scans: what is believed after the first is a multi-Bernoulli."""
    belief, total = lmb.Belief(None, no_objects(4)), 0.0
    for number, scan in enumerate(WINDOW[:2]):
        belief, facts = lmb.step(small(), belief, scan, number, EXACT)
        total += facts.log_factor
    expected, existence, _ = enumerated(small(), WINDOW[:2])
    assert total == pytest.approx(expected, abs=2e-3)  # edges of the view, the gate
    found = dict(zip(belief.objects.label, belief.objects.existence, strict=True))
    for label, value in existence.items():
        assert found[label] == pytest.approx(value, abs=2e-3)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_evidence_existence_and_means_are_those_of_all_histories(count: int) -> None:
    """Twenty runs: their mean is within 4.5 standard errors. After three scans the LMB filter is not exact; this is."""
    model, scans, num, runs = small(), WINDOW[:count], 2000, 20
    log_total, existence, mean = enumerated(model, scans)
    labels = [label for label, value in existence.items() if value > 0.02]
    ratio, share, middle = [], [], []
    for seed in range(runs):
        belief, knobs, total = nobody(num), joint_particles.Knobs(num_particles=num, kernel=0.0), 0.0
        for number, scan in enumerate(scans):
            belief, facts, _ = joint_particles.step(model, belief, scan, number, knobs, seed)
            total += facts.log_factor
        told = joint_particles.tell(belief, 0.0, model.period, 1)
        row = {label: i for i, label in enumerate(told.label)}
        ratio.append(math.exp(total - log_total))
        share.append([told.existence[row[label]] for label in labels])
        middle.append([told.mean[row[label]] for label in labels])
    for values, target in (
        (np.array(ratio), np.ones(())),
        (np.array(share), np.array([existence[label] for label in labels])),
        (np.array(middle), np.array([mean[label] for label in labels])),
    ):
        error = values.std(0, ddof=1) / math.sqrt(runs)
        assert np.all(np.abs(values.mean(0) - target) < 4.5 * error + 3e-3)  # edges of the view, the gate
        assert np.all(error < 0.12)


def nobody(num: int) -> joint_particles.Scenes:
    none = np.zeros(0, dtype=np.int64)
    return joint_particles.Scenes(None, np.full(num, -math.log(num)), none, none, none, np.zeros((0, 4)), none)


def test_two_close_objects_are_tracked_as_by_the_lmb_filter() -> None:
    sensor = Position(name="plots", noise_std=(1.0, 1.0), detection=0.95, clutter=5.0, extent=250.0)
    kind = Kind(noise=(1.0, 1.0), speed=(0.0, 10.0))
    model = Traffic((sensor,), ConstantVelocity(), (kind,), unseen_density=1e-6)
    scene = close_targets(duration=4.0, number=2)
    frames = model.prepare(scene.data)
    expected, found = lmb.run(model, frames), joint_particles.run(model, frames, num_particles=2000)
    last = len(expected.time) - 1
    np.testing.assert_allclose(found.count_mean()[last], expected.count_mean()[last], atol=0.1)
    for tracks in (expected, found):
        told = tracks.at(last)
        sure = told.existence > 0.5
        assert sure.sum() == 2
        truth = scene.truth
        at = slice(truth.offset[-2], truth.offset[-1])
        order = told.mean[sure, 1].argsort()
        off = told.mean[sure][order, :2] - np.stack([truth.x[at], truth.y[at]], -1)[truth.y[at].argsort()]
        assert np.all(np.abs(off) < 4.0 * np.sqrt(told.covariance[sure][order][:, [0, 1], [0, 1]]))


def test_the_same_seed_gives_the_same_bits_and_late_scans_are_taken() -> None:
    scans = [WINDOW[0], WINDOW[2], WINDOW[1]]
    first, again, other = (joint_particles.run(small(), scans, seed=s, num_particles=200) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.mean, again.mean)
    assert first.log_evidence == again.log_evidence != other.log_evidence
    assert first.info["late"] == 1


def test_an_object_outside_every_view_keeps_its_existence() -> None:
    sensor = RangeBearing(name="front", noise_std=(0.1, 0.01), angle=1.0, reach=(0.0, 60.0), detection=0.99)
    model, num = Traffic((sensor,), ConstantVelocity(), (Kind(noise=(1.0, 1.0)),)), 100
    own = np.arange(70)  # of a hundred particles
    state, none = np.tile([0.0, 30.0, 0.0, 0.0], (70, 1)), np.zeros(70, dtype=np.int64)
    belief = joint_particles.Scenes(0.0, np.full(num, -math.log(num)), none, own, none, state, none)
    for number in range(5):
        scan, knobs = Scan("front", 0.0, np.zeros((0, 2)), POSE), joint_particles.Knobs(num_particles=num)
        belief, _, _ = joint_particles.step(model, belief, scan, number, knobs, 0)
    assert joint_particles.tell(belief, 0.0, model.period, 1).existence[0] == pytest.approx(0.7, abs=1e-12)


def test_too_many_objects_are_flagged() -> None:
    values = [[6.0 * i - 15.0, 6.0 * j - 15.0] for i in range(4) for j in range(4)]
    tracks = joint_particles.run(replace(small(), unseen_density=1e-2), scans_of(values, values), num_particles=100)
    assert any("too many for joint particles" in flag and "engine=lmb" in flag for flag in tracks.info["flags"])


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="ess is 0"):
        joint_particles.run(small(), WINDOW, ess=0.0)
    with pytest.raises(InputError, match="joint_particles needs a model of many objects"):
        joint_particles.run(object(), [])  # type: ignore[arg-type]


def test_detection_that_changes_over_the_noise_of_a_step_is_weighed_state_by_state() -> None:
    """At the edge of the view: p(no measurement) = E[1 - s p_D(x)], the expectation over x ~ N(19, sd^2) by quadrature.
    Factors lie within 0 and 1 and average to about a half: four standard errors of their mean are below 4 / sqrt(N)."""
    kind, num = Kind(noise=(10.0, 10.0), speed=(0.0, 2.0), lifetime=5.0), 20_000
    model = replace(small(), kinds=(kind,))
    state, none = np.tile([19.0, 0.0, 0.0, 0.0], (num, 1)), np.zeros(num, dtype=np.int64)
    belief = joint_particles.Scenes(0.0, np.full(num, -math.log(num)), none, np.arange(num), none, state, none)
    scan, knobs = Scan("plots", STEP, np.zeros((0, 2)), POSE), joint_particles.Knobs(num_particles=num, kernel=0.0)
    belief, facts, _ = joint_particles.step(model, belief, scan, 1, knobs, 0)
    node, weight = np.polynomial.hermite_e.hermegauss(100)
    x = 19.0 + 10.0 * math.sqrt(STEP**3 / 3) * node
    survival, detection = math.exp(-STEP / kind.lifetime), 0.8 / (1.0 + np.exp((np.abs(x) - 20.0) / 0.5))
    expected = weight @ (1.0 - survival * detection) / weight.sum()
    assert math.exp(facts.log_factor) == pytest.approx(expected, rel=4 / math.sqrt(num))
    there = weight @ (survival * (1.0 - detection)) / weight.sum() / expected
    assert joint_particles.tell(belief, 0.0, model.period, 1).existence[0] == pytest.approx(there, abs=0.02)


def test_empty_scans_of_nobody_are_scans() -> None:
    found = joint_particles.run(small(), scans_of([], [], [[1.0, 2.0]]), num_particles=1000)
    alone = lmb.run(small(), scans_of([], [], [[1.0, 2.0]])).existence
    assert np.diff(found.offset).tolist() == [0, 0, 1]
    assert found.existence == pytest.approx(alone, abs=4 * 0.5 / math.sqrt(1000))
