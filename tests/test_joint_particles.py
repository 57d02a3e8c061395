"""The joint particle filter: against all that can have happened in tiny windows, and against the LMB filter."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from experiments.scenarios.close_targets import close_targets
from inference import joint_particles, lmb
from inference.joint_particles_kernel import associations
from models.multi_object import Bernoullis, Components, no_objects
from models.objects.motion import ConstantTurn, ConstantVelocity
from models.objects.scans import Scan
from models.objects.sensors import Position, RangeBearing
from models.objects.traffic import Kind, Place, Traffic
from models.program import InputError
from tests.line_objects import Answer, Line, enumerate_posterior, scan_at

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


# place and speed of what each of four scenes has, by label: (kind, place, speed)
SCENES: tuple[tuple[float, dict[int, tuple[int, float, float]]], ...] = (
    (0.35, {}),
    (0.30, {-3: (0, 0.0, 0.5)}),
    (0.20, {-3: (1, 0.4, -0.5), -1: (0, 1.5, 0.5)}),
    (0.15, {-3: (0, -0.3, 0.2), -2: (1, 1.1, -0.5), -1: (1, 1.0, 0.0)}),
)
LINE = Line(unseen_number=0.4)
LOOK = scan_at(0.4, (0.3, 2.0), (0.3, 4.0))


def scenes(num: int, copies: int) -> joint_particles.Scenes:
    """The four, on the first 4 copies of num particles; the others weigh nothing."""
    with np.errstate(divide="ignore"):
        log_weight = np.log(np.append(np.tile([w for w, _ in SCENES], copies) / copies, np.zeros(num - 4 * copies)))
    rows = sorted(
        (label, 4 * i + s, *SCENES[s][1][label]) for i in range(copies) for s in range(4) for label in SCENES[s][1]
    )
    label, particle, kind = np.array([row[:3] for row in rows], dtype=np.int64).T.copy()
    state = np.array([row[3:] for row in rows])
    return joint_particles.Scenes(0.0, log_weight, label, particle, kind, state, np.zeros(len(rows), dtype=np.int64))


def answers() -> list[tuple[float, Answer]]:
    """Of each scene by itself W p(Z | scene), and what becomes of it."""
    found = list[tuple[float, Answer]]()
    for weight, objects in SCENES:
        mean = np.array([state for _, *state in objects.values()]).reshape(-1, 2)
        kind = np.array([k for k, *_ in objects.values()], dtype=np.int64)
        num = len(objects)
        parts = Components(np.arange(num + 1), np.ones(num), kind, mean, np.zeros((num, 2, 2)))
        prior = Bernoullis(np.array(list(objects), dtype=np.int64), np.ones(num), parts)
        answer = enumerate_posterior(LINE, 0.0, prior, [LOOK], lmb.STRIDE)
        found.append((weight * math.exp(answer.log_sum), answer))
    return found


@pytest.mark.parametrize(("ess", "copies"), [(1e-9, 5000), (1.0, 1)])
def test_a_step_from_known_scenes_is_that_of_all_histories(ess: float, copies: int) -> None:
    """Objects of two kinds and unlike features: the evidence and what the particles are worth exactly; existence, kinds
    and means within 4.5 standard errors, of draws that are independent but for systematic resampling, which takes the
    same few particles again and again."""
    num, found = 20_000, answers()
    knobs = joint_particles.Knobs(num_particles=num, ess=ess, kernel=0.0, gate=math.inf)
    belief, facts, worth = joint_particles.step(LINE, scenes(num, copies), LOOK, 0, knobs, 3)
    total = sum(weight for weight, _ in found)
    assert facts.log_factor == pytest.approx(math.log(total), abs=1e-9)
    assert worth == pytest.approx(copies / sum((weight / total) ** 2 for weight, _ in found), rel=1e-9)
    assert np.exp(belief.log_weight).sum() == pytest.approx(1.0, abs=1e-9)
    error = 4.5 / math.sqrt(1.0 / np.square(np.exp(belief.log_weight)).sum())
    told = joint_particles.tell(belief, 0.0, LINE.period, 2)
    row = {label: i for i, label in enumerate(told.label)}
    assert set(row) == {-3, -2, -1, 0, 1}
    for label, i in row.items():
        parts = [(weight / total, part) for weight, answer in found for part in answer.objects.get(label, [])]
        existence = sum(weight * part.weight for weight, part in parts)
        assert told.existence[i] == pytest.approx(existence, abs=0.5 * error)
        wild = sum(weight * part.weight for weight, part in parts if part.kind == 1) / existence
        mean = sum(weight * part.weight * part.mean for weight, part in parts) / existence
        assert told.kind[i].sum() == pytest.approx(1.0, abs=1e-12)
        assert told.kind[i, 1] == pytest.approx(wild, abs=0.5 * error / math.sqrt(existence))
        sd = np.sqrt(np.diag(told.covariance[i]))
        np.testing.assert_array_less(np.abs(told.mean[i] - mean), sd * error / math.sqrt(existence) + 1e-12)


def test_measurements_beyond_the_gate_are_of_nobody() -> None:
    """One object, and a measurement at 5.5 standard deviations: a false alarm, and the object was missed."""
    none, num, knobs = np.zeros(1, dtype=np.int64), 2, joint_particles.Knobs(num_particles=2, kernel=0.0)
    belief = joint_particles.Scenes(0.0, np.full(num, -math.log(2)), none, none, none, np.zeros((1, 2)), none)
    model = Line()
    sd = math.sqrt(model.spread(0, 0.4)[0, 0] + model.std**2)
    factors = [0.0, 0.0]
    for i, off in enumerate((5.5, 4.5)):
        scan = scan_at(0.4, (off * sd,))
        factors[i] = joint_particles.step(model, belief, scan, 0, knobs, 0)[1].log_factor - math.log(model.clutter)
    missed = 1.0 - model.survival(0, 0.4) * model.detection[0]
    assert factors[0] == pytest.approx(math.log(0.5 + 0.5 * missed), abs=1e-12)
    assert factors[1] > factors[0] + 1e-6


def test_large_groups_are_told_of() -> None:
    for max_shared, approximate in ((8, 0), (0, 1)):
        knobs = joint_particles.Knobs(num_particles=400, kernel=0.0, max_shared=max_shared)
        _, facts, _ = joint_particles.step(LINE, scenes(400, 100), LOOK, 0, knobs, 0)
        assert facts.loopy == approximate


def test_what_arrived_is_there_as_often_as_the_rate_says_whatever_the_number_of_a_particle() -> None:
    """Two places; headings about four ways, none of which keeps to the first particles (numbers of particles are even
    from 0 to N: mean N / 2, sd N / sqrt(12)). Within 4.5 standard errors."""
    places = (Place((10.0, 5.0), 2.0, 0.5), Place((-20.0, 0.0), 1.0, 1.5))
    model, num = replace(small(), motion=ConstantTurn(), kinds=(Kind(lifetime=5.0),), places=places), 5000
    none = np.zeros(num, dtype=np.int64)
    state = np.tile([0.0, 1.0, 2.0, 3.0, 0.0, 0.0], (num, 1))
    belief = joint_particles.Scenes(0.0, np.full(num, -math.log(num)), none + 9, np.arange(num), none, state, none)
    moved, survival, covariance = joint_particles.predict(model, belief, 0.4, 3, np.random.default_rng(0))
    np.testing.assert_allclose(survival[moved.label == 9], math.exp(-0.4 / 5.0), rtol=1e-12)
    assert np.all(covariance[moved.label == 9].trace(axis1=1, axis2=2) > 0.0)
    assert set(moved.label) == {9, 3 * lmb.STRIDE + lmb.STRIDE // 2, 3 * lmb.STRIDE + lmb.STRIDE // 2 + 1}
    for i, place in enumerate(places):
        rows = moved.label == 3 * lmb.STRIDE + lmb.STRIDE // 2 + i
        share, count = -math.expm1(-model.arrived(0.4)[1 + i].sum()), rows.sum()
        assert abs(count / num - share) < 4.5 * math.sqrt(share * (1 - share) / num)
        assert np.all(survival[rows] == 1.0)
        assert not covariance[rows].any()
        assert np.all(np.abs(moved.state[rows, :2].mean(0) - place.position) < 4.5 * place.std / math.sqrt(count))
        assert set(moved.family[rows]) == {0, 1, 2, 3}
        for family in range(4):
            own = moved.family[rows] == family
            error = 4.5 / math.sqrt(own.sum())
            turned = np.exp(1j * (moved.state[rows, 2][own] - 0.5 * math.pi * family))
            assert abs(np.angle(turned.mean())) < 0.5 * error
            assert abs(moved.particle[rows][own].mean() - num / 2) < error * num / math.sqrt(12)


def test_late_scans_and_places_go_together() -> None:
    """What a late scan began has higher labels than what arrived after it: rows are by label nonetheless."""
    place = Place((-5.0, -5.0), 1.0, 0.3)
    model = replace(small(), places=(place,))
    scans = [scans_of(*([[0.0, 0.0]],) * 4)[t] for t in (0, 2, 1, 3)]
    late = joint_particles.run(model, scans, num_particles=2000, seed=1)
    in_time = joint_particles.run(model, sorted(scans, key=lambda scan: scan.time), num_particles=2000, seed=1)
    assert late.info["late"] == 1
    assert late.log_evidence == pytest.approx(in_time.log_evidence, abs=0.3)
    assert late.count_mean()[-1] == pytest.approx(in_time.count_mean()[-1], abs=0.15)


def test_kernels_are_those_of_an_objects_families_and_weights() -> None:
    """Two objects, the first of two families far apart: weights of a label's components sum to one, existence is their
    sum before, and each family keeps its weighted moments while its particles are drawn in."""
    rng, num, h = np.random.default_rng(0), 300, 0.6
    weight = rng.random(num)
    weight /= weight.sum()
    label, particle = np.repeat([4, 8], [num, num // 2]), np.append(np.arange(num), np.arange(num // 2))
    family = np.append(np.arange(num) % 2, np.zeros(num // 2, dtype=np.int64))
    state = rng.standard_normal((len(label), 2)) + 1000.0 * family[:, None]
    belief = joint_particles.Scenes(0.0, np.log(weight), label, particle, 0 * label, state, family)
    before, noise = state.copy(), np.array([[0.3, 0.1], [0.1, 0.2]])
    found = joint_particles.by_label(belief, np.tile(noise, (len(label), 1, 1)), np.full(2, np.inf), h)
    parts, W = found.components, weight[particle]
    np.testing.assert_array_equal(belief.state, before)
    np.testing.assert_array_equal(found.label, [4, 8])
    np.testing.assert_array_equal(parts.offset, [0, num, len(label)])
    np.testing.assert_allclose(found.existence, [1.0, weight[: num // 2].sum()], rtol=1e-12)
    np.testing.assert_allclose(parts.weight, W / found.existence[parts.group], rtol=1e-12)
    for own in ((label == 4) & (family == 0), (label == 4) & (family == 1), label == 8):
        V, w = np.cov(before[own].T, aweights=W[own], bias=True), W[own] / W[own].sum()
        np.testing.assert_allclose(w @ parts.mean[own], w @ before[own], atol=1e-9)
        np.testing.assert_allclose(np.cov(parts.mean[own].T, aweights=w, bias=True), (1 - h**2) * V, atol=1e-9)
        np.testing.assert_allclose(parts.covariance[own] - noise, np.tile(h**2 * V, (own.sum(), 1, 1)), atol=1e-9)


def test_newborns_are_of_the_components_that_most_probably_made_their_measurement() -> None:
    """Nobody there, two measurements: each begins an object with its share, of components as their masses say. Counts
    are within 4.5 binomial standard errors."""
    num, none, mass, share = 20_000, np.zeros(0, dtype=np.int64), np.array([1.0, 2.0, 5.0, 0.3]), np.array([0.6, 1.0])
    table = (np.zeros(1, dtype=np.int64), none, np.zeros(0), np.zeros(0))
    start, offset, random = np.zeros(num + 1, dtype=np.int64), np.array([0, 3, 4]), np.array([7], dtype=np.uint64)
    *old, whose, made, part = associations(start, table, np.arange(num), offset, mass, share, 8, 50, random)
    assert all(len(column) == 0 for column in old)
    np.testing.assert_array_equal(made, part == 3)
    np.testing.assert_array_equal(whose[made == 1], np.arange(num))
    for u, expected in enumerate((0.075, 0.15, 0.375)):
        assert abs((part == u).mean() * len(part) / num - expected) < 4.5 * math.sqrt(expected / num)


def test_newborns_families_are_counted_within_their_measurement() -> None:
    knobs = joint_particles.Knobs(num_particles=500)
    belief, _, _ = joint_particles.step(LINE, scenes(500, 100), LOOK, 0, knobs, 0)
    for j in range(2):
        np.testing.assert_array_equal(belief.family[belief.label == j], belief.kind[belief.label == j])
        assert set(belief.kind[belief.label == j]) == {0, 1}


def test_each_scan_has_random_numbers_of_its_own_and_is_remembered() -> None:
    knobs = joint_particles.Knobs(num_particles=40)
    once, again, other = (joint_particles.step(LINE, scenes(40, 10), LOOK, k, knobs, 0)[0] for k in (0, 0, 1))
    np.testing.assert_array_equal(once.state, again.state)
    assert once.past == (LOOK,)
    assert len(once.state) != len(other.state) or np.all(once.state != other.state)
    then, _, _ = joint_particles.step(LINE, once, LOOK._replace(time=0.5), 1, knobs, 0)
    assert [scan.time for scan in then.past] == [0.4, 0.5]


def test_only_what_is_probable_is_told_of() -> None:
    all_of_them, few = (joint_particles.run(small(), WINDOW[:2], report=r, num_particles=500) for r in (0.0, 0.3))
    np.testing.assert_allclose(few.existence, all_of_them.existence[all_of_them.existence > 0.3], rtol=1e-12)
    assert 0 < len(few.existence) < len(all_of_them.existence)


def test_particles_that_are_worth_little_are_flagged() -> None:
    """One particle of forty has the object of a sensor without clutter."""
    eye = replace(small().sensors[0], clutter=1e-6, noise_std=(0.01, 0.01))
    far = replace(small(), sensors=(eye,), kinds=(Kind(noise=(0.0, 0.0), speed=(0.0, 20.0), lifetime=1e6),))
    few = joint_particles.run(far, scans_of([[0.0, 0.0]], [[3.0, 1.0]], [[6.0, 2.0]]), num_particles=40, kernel=0.0)
    many = joint_particles.run(small(), WINDOW, num_particles=2000)
    assert any("they may have lost the truth" in flag for flag in few.info["flags"])
    assert not many.info["flags"]


@pytest.mark.parametrize("wrong", [{"clutter": math.nan}, {"detection": (math.nan, 0.5)}])
def test_no_nan_of_a_model_passes(wrong: Any) -> None:
    """Though other particles, without such objects, explain the scan."""
    knobs = joint_particles.Knobs(num_particles=40)
    with pytest.raises(FloatingPointError, match=r"the update by sensor 'line' at 0.4 s made a NaN"):
        joint_particles.step(Line(**wrong), scenes(40, 10), LOOK, 0, knobs, 0)
