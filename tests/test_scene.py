"""Traffic as a program: what a scan is as a set, and what objects do from frame to frame."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pyro
import pytest
import torch
from numpy.typing import NDArray
from scipy.stats import poisson, truncnorm
from torch import Tensor

from models.multi_object import Components, no_objects
from models.objects.ground import Grid
from models.objects.motion import ConstantVelocity
from models.objects.scan_set import FalseAlarms, ScanSet, capacity, log_sum_associations
from models.objects.scans import Recording, Scan
from models.objects.scene import Newcomers, ScanFrame, rows_of, scan_set, simulate_scan
from models.objects.sensors import Position, Radar
from models.objects.traffic import Kind, Place, Traffic
from models.program import InputError, check, log_joint, quiet_doubles, simulate, terms
from models.unroll import observe_frames

Floats = NDArray[np.float64]


def brute(detected: Floats, missed: Floats, clutter: Floats) -> float:
    """The sum over associations, one after the other."""
    num, count = detected.shape
    total = 0.0
    for theta in itertools.product(range(-1, count), repeat=num):
        taken = [j for j in theta if j >= 0]
        if len(set(taken)) == len(taken):
            weight = math.prod(missed[i] if j < 0 else detected[i, j] for i, j in enumerate(theta))
            total += weight * math.prod(clutter[j] for j in range(count) if j not in taken)
    return total


@pytest.mark.parametrize(("num", "count"), [(0, 0), (0, 3), (3, 0), (1, 1), (2, 4), (4, 2), (3, 3)])
def test_sum_over_associations_equals_enumeration(num: int, count: int) -> None:
    rng = np.random.default_rng(10 * num + count)
    detected, missed, clutter = rng.gamma(1.0, size=(num, count)), rng.random(num), rng.gamma(1.0, size=count)
    if num and count:
        detected[0, 0] = 0.0
    with np.errstate(divide="ignore"):
        logs = [torch.from_numpy(np.maximum(np.log(w), -1e9)) for w in (detected, missed, clutter)]
    found = float(log_sum_associations(*logs))
    assert found == pytest.approx(math.log(brute(detected, missed, clutter)), abs=1e-12)


def test_too_many_associations_are_refused() -> None:
    with pytest.raises(InputError, match="13 objects and 14 measurements"):
        log_sum_associations(torch.zeros(13, 14), torch.zeros(13), torch.zeros(14))


def on_a_line(detection: list[float], expected: float = 0.7) -> ScanSet:
    """Objects at 2, 5, ... of [0, 10], and false alarms there."""
    num = len(detection)
    with quiet_doubles():
        return ScanSet(
            2.0 + 3.0 * torch.arange(num, dtype=torch.float64)[:, None],
            torch.full((1, 1, 1, 1), 0.04),
            torch.tensor(detection),
            torch.zeros(num, dtype=torch.long),
            FalseAlarms(expected, torch.zeros(1), torch.full((1,), 10.0)),
            lambda z: ((z[..., 0] > 0) & (z[..., 0] < 10)).double() * expected / 10.0,
            torch.full((1,), math.inf),
            1,
        )


def rows(z: Tensor) -> Tensor:
    """Scans (*, M) of one number each."""
    return torch.stack([torch.ones_like(z), z, torch.ones_like(z)], -1)


def test_set_density_is_normalised() -> None:
    seen = on_a_line([0.8, 0.6])
    grid = 0.05 + 0.1 * torch.arange(100, dtype=torch.float64)  # the middle of 100 cells of [0, 10]
    total = float(seen.log_prob(rows(torch.zeros(0, dtype=torch.float64))).exp())
    for count in (1, 2):
        z = torch.cartesian_prod(*[grid] * count).reshape(-1, count)
        total += float(seen.log_prob(rows(z)).exp().sum()) * 0.1**count / math.factorial(count)
    # three and more measurements: by the number alone, which is that of two detections and a Poisson variable
    poisson = [math.exp(-0.7) * 0.7**k / math.factorial(k) for k in range(40)]
    number = [0.2 * 0.4, 0.8 * 0.4 + 0.2 * 0.6, 0.8 * 0.6]
    rest = 1.0 - sum(number[a] * poisson[k] for a in range(3) for k in range(3 - a))
    assert total + rest == pytest.approx(1.0, abs=1e-6)  # of the middle rule on normals of two cells' width


def test_set_density_knows_no_order() -> None:
    seen, z = on_a_line([0.8, 0.6, 0.3]), torch.tensor([2.1, 4.7, 8.0], dtype=torch.float64)
    found = [float(seen.log_prob(rows(z[list(order)]))) for order in itertools.permutations(range(3))]
    assert found == pytest.approx([found[0]] * 6, abs=1e-12)
    turned = [2, 0, 1]
    other = ScanSet(
        seen.predicted[turned],
        *(seen.noise, seen.detection[turned], seen.kind, seen.false_alarms, seen.clutter, seen.period, 1),
    )
    assert float(other.log_prob(rows(z))) == pytest.approx(found[0], abs=1e-12)


def test_associations_sum_to_the_scan() -> None:
    seen, value = on_a_line([0.8, 0.6]), rows(torch.tensor([2.1, 4.7, 8.0], dtype=torch.float64))
    parts = [
        float(seen.log_prob_of(value, torch.tensor(theta)).exp()) for theta in itertools.product(range(-1, 3), repeat=2)
    ]
    assert parts.count(0.0) == 3  # both objects by one measurement
    assert sum(parts) == pytest.approx(float(seen.log_prob(value).exp()), rel=1e-12)
    # by hand: both seen, z_2 a false alarm
    normal = torch.distributions.Normal(torch.tensor([2.0, 5.0]).double(), 0.2).log_prob(value[:2, 1]).sum()
    expected = -0.7 + math.log(0.07) + math.log(0.8 * 0.6) + float(normal)
    assert float(seen.log_prob_of(value, torch.tensor([0, 1]))) == pytest.approx(expected, abs=1e-6)


def test_rows_that_are_not_there_count_nothing() -> None:
    seen, value = on_a_line([0.8, 0.6]), rows(torch.tensor([2.1, 8.0], dtype=torch.float64))
    padded = torch.cat([value, torch.zeros(3, 3, dtype=torch.float64)])
    between = torch.stack([value[0], torch.tensor([0.0, 5.0, 1.0]).double(), value[1]])
    for other in (padded, between):
        assert float(seen.log_prob(other)) == pytest.approx(float(seen.log_prob(value)), abs=1e-12)
    assert float(seen.log_prob_of(padded, torch.tensor([3, -1]))) == -math.inf


def test_rows_that_are_not_there_may_hold_anything() -> None:
    seen, value = on_a_line([0.8, 0.6]), rows(torch.tensor([2.1, 8.0], dtype=torch.float64))
    nan = torch.tensor([[0.0, math.nan, math.nan]]).double()
    slopes = []
    for given in (value, torch.cat([nan, value])):
        place = seen.predicted.clone().requires_grad_(True)
        rest = (seen.noise, seen.detection, seen.kind, seen.false_alarms, seen.clutter, seen.period, 1)
        found = ScanSet(place, *rest).log_prob(given)
        assert found.item() == pytest.approx(float(seen.log_prob(value)), abs=1e-12)
        slopes.append(torch.autograd.grad(found, place)[0])
    torch.testing.assert_close(slopes[1], slopes[0], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("expected", [0.0, 0.1, 1.0, 3.0, 10.0, 100.0, 1000.0])
def test_scans_have_room_for_all_false_alarms_but_once_in_a_million_million(expected: float) -> None:
    assert poisson.sf(capacity(0, expected), expected) < 1e-12
    assert capacity(7, expected) == 7 + capacity(0, expected)


def test_bearings_have_no_end() -> None:
    """Behind the sensor they jump, and a turn more is the same measurement."""
    state = torch.tensor([[-50.0, 0.2, 0.0, 5.0, 0.0, 0.0]]).double()
    scan = Scan("radar", 0.0, np.zeros((0, 3)), np.zeros(3))
    with quiet_doubles():
        seen = scan_set(MODEL, scan, torch.tensor([0]), state, torch.ones(1))
        bearings = [math.pi - 0.01, -math.pi - 0.01, 3 * math.pi - 0.01]
        found = [float(seen.log_prob_of(_radar(b), torch.tensor([0]))) for b in bearings]
    assert found == pytest.approx([found[0]] * 3, abs=1e-9)
    assert found[0] > -10.0  # and near: a residual of a turn weighs e^-49000


def _radar(bearing: float) -> Tensor:
    return torch.tensor([[1.0, 50.0, bearing, -5.0, 1.0, 1.0]]).double()


def test_kinds_that_sensors_hardly_see_are_seen_as_often_as_filters_think() -> None:
    kinds = (replace(KINDS[0], visibility=0.5), KINDS[1])
    plots = replace(SENSORS[1], confusion=None)
    model, faint = (Traffic((plots,), kinds=k) for k in (KINDS, kinds))
    state = np.tile([10.0, 10.0, 0.0, 5.0, 0.0, 0.0], (2, 1))
    scan, kind = Scan("plots", 0.0, np.zeros((0, 2)), np.zeros(3)), np.array([0, 1])
    parts = Components(np.array([0, 2]), np.full(2, 0.5), kind, state, np.tile(np.eye(6), (2, 1, 1)))
    with quiet_doubles():
        found = [
            scan_set(m, scan, torch.from_numpy(kind), torch.from_numpy(state), torch.ones(2)).detection.numpy()
            for m in (model, faint)
        ]
    np.testing.assert_allclose(found[1], found[0] * [0.5, 1.0], rtol=1e-12)
    np.testing.assert_allclose(faint.view(scan, no_objects(6), parts).detection, found[1], rtol=1e-9)


def test_what_is_certain_has_a_density() -> None:
    seen, z = on_a_line([1.0, 0.0]), rows(torch.tensor([2.1], dtype=torch.float64))
    seen.detection.requires_grad_(True)
    found = seen.log_prob(z)
    (slope,) = torch.autograd.grad(found, seen.detection)
    assert math.isfinite(found.item()) and bool(slope.isfinite().all())
    assert seen.log_prob(z[:0]).item() == -math.inf  # it would have been seen


def test_simulated_scans_have_the_moments_of_their_parts() -> None:
    seen, num = on_a_line([0.8, 0.6, 0.0]), 20000
    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        value, source = seen.sample_sources((num,))
    present = value[..., 0] > 0.5
    for i, p in enumerate([0.8, 0.6, 0.0]):
        share = float((source == i).any(-1).double().mean())
        assert abs(share - p) < 4 * math.sqrt(p * (1 - p) / num) + 1e-12
    false = (present & (source < 0)).sum(-1).double()
    assert abs(float(false.mean()) - 0.7) < 4 * math.sqrt(0.7 / num)
    assert abs(float(false.var()) - 0.7) < 4 * math.sqrt((0.7 + 2 * 0.7**2) / num)
    z = value[..., 1][source == 1]
    assert abs(float(z.mean()) - 5.0) < 4 * 0.2 / math.sqrt(len(z))
    assert abs(float(z.std()) - 0.2) < 4 * 0.2 / math.sqrt(2 * len(z))
    first = source[:, 0][(source >= 0).sum(-1).eq(2) & present.sum(-1).eq(2)]  # shuffled: either comes first
    assert abs(float((first == 0).double().mean()) - 0.5) < 4 * 0.5 / math.sqrt(len(first))
    # at the true parameters the mean of the score is zero: its log density has the slopes of what it simulates
    mean = seen.predicted.expand(num, 3, 1).clone().requires_grad_(True)
    rest = (seen.noise, seen.detection, seen.kind, seen.false_alarms, seen.clutter, seen.period, 1)
    (slope,) = torch.autograd.grad(ScanSet(mean, *rest).log_prob(value).sum(), mean)
    slope = slope[:, :2, 0]
    assert bool((slope.mean(0).abs() < 4 * slope.std(0) / math.sqrt(num)).all())


SENSORS = (
    Radar(name="radar", noise_std=(0.3, 0.02, 0.2), reach=(0.0, 150.0), clutter=2.0, occlusion=0.5),
    Position(name="plots", noise_std=(1.0, 1.0), extent=100.0, confusion=((0.9, 0.1), (0.2, 0.8), (0.5, 0.5))),
)
KINDS = (Kind("car", share=0.75), Kind("bike", share=0.25, lifetime=20.0, speed=(5.0, 1.0)))
PLACES = (Place((0.0, 0.0), 3.0, 0.1, (0.0, 0.1)), Place((50.0, 20.0), 5.0, 0.2))
MODEL = Traffic(SENSORS, kinds=KINDS, places=PLACES, unseen_density=5e-5, slots=5)
BLANK = tuple(
    ScanFrame(None, Scan(name, time, np.zeros((0, 0)), np.array([1.0, -2.0, 0.3])), gap)
    for name, time, gap in (("radar", 0.0, 0.0), ("plots", 0.1, 0.1), ("radar", 0.4, 0.3), ("plots", 20.4, 20.0))
)


def test_program_runs_for_a_batch_and_its_parts_sum_up() -> None:
    draws = simulate(MODEL, BLANK, num=4, seed=1)
    for n in range(4):
        frames, latents = observe_frames(BLANK, {name: v[n] for name, v in draws.items()})
        check(MODEL, frames)
        alone = float(log_joint(MODEL, latents, frames))
        assert math.isfinite(alone)
        if n:
            continue
        together = log_joint(MODEL, {name: v for name, v in draws.items() if "values" not in name}, frames)
        assert float(together[0]) == pytest.approx(alone, abs=1e-9)


def test_seeds_reproduce() -> None:
    one, two, other = (simulate(MODEL, BLANK, num=2, seed=seed) for seed in (3, 3, 4))
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert not torch.equal(one["new_state_0"], other["new_state_0"])
    kind, state = np.array([0, 1]), np.array([[10.0, 10.0, 0.0, 5.0, 0.0, 0.0], [-30.0, 5.0, 0.0, 5.0, 0.0, 0.0]])
    scans = [simulate_scan(MODEL, "plots", 1.0, np.zeros(3), kind, state, seed) for seed in (7, 7, 8)]
    np.testing.assert_array_equal(scans[0][0].values, scans[1][0].values)
    assert scans[0][0].values.shape != scans[2][0].values.shape or (scans[0][0].values != scans[2][0].values).any()
    scan, source = scans[0]
    for i in (0, 1):
        if (source == i).any():
            np.testing.assert_allclose(scan.values[source == i][0], state[i, :2], atol=6.0)
    looks = {(1.8, 0.4), (0.2, 1.6)}  # p(looks | kind) / p(looks | false alarm)
    assert scan.likeness is not None and {tuple(np.round(row, 12)) for row in scan.likeness} <= looks


def test_numbers_of_objects_are_in_balance_and_kinds_have_their_shares() -> None:
    model = Traffic(SENSORS, kinds=KINDS, unseen_density=5e-5, slots=12)  # 2 expected: 12 are not reached
    num = 4000
    late = BLANK[1]._replace(seconds=15.0)
    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(2)
        with pyro.plate("_batch", num, dim=-1):
            state = model.initial(BLANK[0])
            before = state["exists"].sum(-1)
            for _ in range(2):
                state = model.transition(state, late)
    after = state["exists"].sum(-1)
    for found in (before, after):
        assert abs(float(found.mean()) - 2.0) < 4 * math.sqrt(2.0 / num)
        assert abs(float(found.var()) - 2.0) < 4 * math.sqrt((2.0 + 8.0) / num)
    cars = (state["exists"] * (state["kind"] == 0)).sum(-1)
    assert abs(float(cars.mean()) - 1.5) < 4 * math.sqrt(1.5 / num)
    stayed = 0.75 * math.exp(-30 / 100) + 0.25 * math.exp(-30 / 20)  # the correlation of the numbers
    found = float(torch.corrcoef(torch.stack([before, after]))[0, 1])
    assert abs(found - stayed) < 4 / math.sqrt(num)


def test_newcomers_have_their_density() -> None:
    """The mean of a likelihood ratio of another density of newcomers is one."""
    origin = torch.tensor([[0.2, 0.5], [0.5, 0.25], [0.3, 0.25]]).double()
    other = torch.tensor([[0.5, 0.4], [0.2, 0.3], [0.3, 0.3]]).double()
    kind = torch.tensor([0, 1]).expand(20000, 2)
    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        draws = Newcomers(MODEL, origin, kind).sample()
        ratio = (Newcomers(MODEL, other, kind).log_prob(draws) - Newcomers(MODEL, origin, kind).log_prob(draws)).exp()
    assert abs(float(ratio.mean()) - 1.0) < 4 * float(ratio.std()) / math.sqrt(20000)
    near = (draws[:, 0, :2].norm(dim=-1) < 9.0).double().mean()  # three standard deviations of the first place
    assert abs(float(near) - 0.5 * (1 - math.exp(-4.5)) - 0.2 * math.pi * 81 / 4e4) < 4 * 0.5 / math.sqrt(20000)


def test_unused_draws_change_nothing_but_their_own_density() -> None:
    draws = {name: v[0] for name, v in simulate(MODEL, BLANK[:2], num=1, seed=6).items()}
    frames, latents = observe_frames(BLANK[:2], draws)
    free = int(latents["born_0"]) + int(latents["born_1"])
    assert free < MODEL.slots
    moved = latents["new_state_1"].clone()
    moved[-1, 0] = 33.0  # of the last slot, which stays empty
    found, other = (
        terms(MODEL, {**latents, "new_state_1": value}, frames).likelihood for value in (latents["new_state_1"], moved)
    )
    assert found == other


def test_objects_that_come_fill_free_slots_in_order() -> None:
    model = Traffic((SENSORS[1],), kinds=KINDS, places=(Place((0.0, 0.0), 1.0, 1e6),), slots=4)
    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        with pyro.plate("_batch", 50, dim=-1):
            state = model.initial(BLANK[1])
            trace = pyro.poutine.trace(lambda: model.transition(state, BLANK[1]._replace(seconds=1.0))).get_trace()
            later = trace.nodes["_RETURN"]["value"]
    born, stay = trace.nodes["born"], state["exists"] * trace.nodes["stays"]["value"]
    assert bool((born["value"] == 4 - stay.sum(-1)).all())  # as many as find room, whatever their number
    assert bool((born["fn"].log_prob(born["value"]).abs() < 1e-3).all())
    assert bool((later["exists"].sum(-1) == 4).all())  # more would have come: Poisson, truncated
    first = state["exists"]
    assert bool((first[:, :-1] >= first[:, 1:]).all())


def test_scans_out_of_order_are_put_in_order_or_refused() -> None:
    draws = simulate(MODEL, BLANK, num=1, seed=1)
    frames, latents = observe_frames(BLANK, {name: v[0] for name, v in draws.items()})
    mixed = (frames[0], frames[2], frames[1]._replace(seconds=-0.3), frames[3])
    assert float(log_joint(MODEL, latents, mixed)) == pytest.approx(float(log_joint(MODEL, latents, frames)), abs=1e-12)
    with quiet_doubles(), pytest.raises(InputError, match=r"0\.3 s older than the one before"):
        MODEL.transition({}, mixed[2])


def test_evidence_of_one_object_is_that_of_kalman() -> None:
    """Importance draws of the program against a sum over who was there and seen, on a single frame."""
    model = Traffic(
        (Position(name="plots", noise_std=(10.0, 10.0), extent=1000.0, detection=0.9, clutter=0.3),),
        ConstantVelocity(),
        (Kind(noise=(1.0, 1.0)),),
        unseen_density=2.5e-5,
        slots=1,
    )
    scan = Scan("plots", 0.0, np.array([[20.0, -10.0]]), np.zeros(3))
    frames = model.prepare(Recording((scan,)))
    draws = simulate(model, frames, num=40000, seed=1)
    seen = terms(model, draws, frames).likelihood["values_0"].exp()
    there = 1.0 / (1.0 + 1.0)  # Poisson of mean one, truncated at one
    lam = 0.3 / 4e6
    expected = math.exp(-0.3) * ((1 - there) * lam + there * (0.1 * lam + 0.9 / 4e4))
    assert abs(float(seen.mean()) - expected) < 4 * float(seen.std()) / math.sqrt(len(seen))


def test_first_objects_are_anywhere_in_the_region() -> None:
    draws = {name: v[0] for name, v in simulate(MODEL, BLANK[:1], num=1, seed=6).items()}
    frames, latents = observe_frames(BLANK[:1], draws)
    found = float(terms(MODEL, latents, frames).prior["new_state_0"])
    states, kinds = latents["new_state_0"].numpy(), latents["new_kind_0"].numpy()
    expected = MODEL.slots * (-math.log(200.0 * 200.0) - math.log(2 * math.pi))
    for state, kind in zip(states, kinds, strict=True):
        rest = (KINDS[kind].speed, (0.0, KINDS[kind].yaw_rate_std), (0.0, KINDS[kind].acceleration_std))
        expected += sum(
            -0.5 * ((x - m) / s) ** 2 - math.log(s * math.sqrt(2 * math.pi))
            for x, (m, s) in zip(state[3:], rest, strict=True)
        )
    assert found == pytest.approx(expected, abs=1e-9)


ROAD = Grid((-100.0, -100.0), 100.0, ((0.0, 1e-4), (3e-4, 0.0)), ((20.0, 5.0), (20.0, 20.0)), outside=1e-5)


def test_a_grid_says_where_objects_come_from_and_how_fast() -> None:
    plots = replace(SENSORS[1], confusion=None)
    model = Traffic((plots,), kinds=(Kind(speed=(12.0, 4.0)),), ground=ROAD, slots=10)
    assert model.unseen_numbers.sum() == pytest.approx(4.0)
    kind = torch.zeros(4000, 5, dtype=torch.long)
    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(8)
        newcomers = Newcomers(model, torch.ones(1, 1), kind)
        draws = newcomers.sample()
        log_prob = newcomers.log_prob(draws) / 5
    x, y, speed = draws[..., 0].flatten(), draws[..., 1].flatten(), draws[..., 3].flatten()
    slow = (x > 0) & (y < 0)
    assert bool((slow | ((x < 0) & (y > 0))).all())
    assert abs(float(slow.double().mean()) - 0.25) < 4 * math.sqrt(0.25 * 0.75 / len(x))
    cut = truncnorm(-np.inf, (5.0 - 12.0) / 4.0, 12.0, 4.0)
    assert abs(float(speed[slow].mean()) - cut.mean()) < 4 * cut.std() / math.sqrt(float(slow.sum()))
    assert float(speed[slow].std()) == pytest.approx(cut.std(), rel=0.1)
    assert bool(log_prob.isfinite().all())
    scan = Scan("plots", 0.0, np.array([[50.0, -50.0], [-50.0, 50.0], [50.0, 50.0], [500.0, 0.0]]), np.zeros(3))
    unseen, flat = model.unseen(scan), Traffic((plots,), kinds=model.kinds, unseen_density=1e-4).unseen(scan)
    ratio = unseen.weight.reshape(4, -1).sum(1) / flat.weight.reshape(4, -1).sum(1)
    np.testing.assert_allclose(ratio, [1.0, 3.0, 0.0, 0.1])
    means = unseen.mean.reshape(4, -1, 6)[:, 0, 3]
    free = truncnorm(-np.inf, 2.0, 12.0, 4.0).mean()
    np.testing.assert_allclose(means, [cut.mean(), free, free, 12.0], rtol=1e-9)
    deviation = np.sqrt(unseen.covariance.reshape(4, -1, 6, 6)[0, 0, 3, 3])
    assert deviation == pytest.approx(cut.std(), rel=1e-9)


def test_grids_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match="grid: limits is of shape"):
        Grid((0.0, 0.0), 10.0, ((1.0, 1.0),), ((1.0,),))
    with pytest.raises(InputError, match="cell is 0"):
        Grid((0.0, 0.0), 0.0, ((1.0, 1.0),))


def test_looks_tell_kinds_apart() -> None:
    """Of one object right where it was measured, kinds differ in p(looks | kind) / p(looks | false alarm) alone."""
    state = np.array([[10.0, 10.0, 0.0, 5.0, 0.0, 0.0]])
    scan = Scan("plots", 1.0, state[:, :2], np.zeros(3), likeness=np.array([[0.2, 1.6]]))
    value, found = rows_of(MODEL, scan), list[float]()
    with quiet_doubles():
        for kind in (0, 1):
            seen = scan_set(MODEL, scan, torch.tensor([kind]), torch.from_numpy(state), torch.ones(1))
            found.append(float(seen.log_prob_of(value, torch.zeros(1, dtype=torch.long))))
        seen = scan_set(MODEL, scan, torch.tensor([1]), torch.from_numpy(state), torch.ones(1))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(1)
            draws, source = seen.sample_sources((4000,))
    assert found[1] - found[0] == pytest.approx(math.log(1.6 / 0.2), abs=1e-12)
    for of, share in ((0, 0.8), (-1, 0.5)):  # looks like a bicycle: the object, and false alarms
        features = draws[(source == of) & (draws[..., 0] > 0.5)][:, -1]
        assert abs(float((features > 1.0).double().mean()) - share) < 4 * 0.5 / math.sqrt(len(features))
