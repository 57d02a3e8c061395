"""Is what the labeled multi-Bernoulli filter says true as often as it says? Scenes are simulated by the model itself,
which knows which object made which measurement, so that every label has a truth."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pyro
import pytest
import torch
from numpy.typing import NDArray

from inference.lmb import STRIDE, Belief, Knobs, step
from models.multi_object import no_objects
from models.objects.ground import Grid
from models.objects.motion import ConstantVelocity
from models.objects.scans import Scan
from models.objects.scene import ScanFrame, simulate_scan
from models.objects.sensors import Position, Radar
from models.objects.traffic import Kind, Place, Traffic
from models.program import quiet_doubles
from tests.test_lmb import marginals

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
CAR = np.zeros(3)


class Moment(NamedTuple):
    """A scan, the object that made each measurement (-1 none), and the objects that are there: who, and their states."""

    scan: Scan
    source: Ints
    there: Ints
    state: Floats


class Claim(NamedTuple):
    """What the filter said of a label after scan k of a window, and whether it was so."""

    window: int
    k: int
    existence: float
    truth: bool


def simulated(model: Traffic, sensors: list[str], times: Floats, seed: int) -> list[Moment]:
    """Objects are numbered by the scan before which they came, times 100, and their slot."""
    found, rng = list[Moment](), np.random.default_rng(seed)
    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(2**62)))
        state, who = None, np.arange(model.slots)
        for k, time in enumerate(times.tolist()):
            frame = ScanFrame(None, Scan(sensors[k], time, np.zeros((0, 0)), CAR), time - times[k - 1] if k else 0.0)
            if state is None:
                state = model.initial(frame)
            else:
                trace = pyro.poutine.trace(model.transition).get_trace(state, frame)
                stayed = (state["exists"] * trace.nodes["stays"]["value"]).numpy() > 0.5
                state, who = trace.nodes["_RETURN"]["value"], np.where(stayed, who, 100 * k + np.arange(model.slots))
            exists = state["exists"].numpy() > 0.5
            x, kind, there = state["state"].numpy()[exists], state["kind"].numpy()[exists], who[exists]
            scan, source = simulate_scan(model, sensors[k], time, CAR, kind, x, rng)
            found.append(Moment(scan, np.array([there[s] if s >= 0 else -1 for s in source], dtype=np.int64), there, x))
    return found


def claims_of(model: Traffic, moments: list[Moment], window: int) -> list[Claim]:
    """All that is said in a window. A measurement's label stands for the object that it is the first to show."""
    belief, found = Belief(None, no_objects(len(model.names))), list[Claim]()
    owner, seen = dict[int, int](), {-1}
    for k, moment in enumerate(moments):
        owner |= {k * STRIDE + j: who for j, who in enumerate(moment.source.tolist()) if who not in seen}
        seen |= set(moment.source.tolist())
        belief, _ = step(model, belief, moment.scan, k, Knobs())
        there = set(moment.there.tolist())
        for label, r in zip(belief.objects.label.tolist(), belief.objects.existence.tolist(), strict=True):
            found.append(Claim(window, k, r, owner.get(label) in there))
    return found


def off_by(values: Floats, windows: Ints, num: int) -> float:
    """How many standard errors the mean of values is from zero; those of one window hang together."""
    sums = np.bincount(windows, values, num)
    return float(sums.mean() / (sums.std(ddof=1) / math.sqrt(num)))


FIRST = Position(name="first", noise_std=(1.0, 1.0), detection=0.999, clutter=20.0, extent=80.0)
SPOTS = Traffic(
    sensors=(FIRST, replace(FIRST, name="later", detection=0.75, births=False)),
    motion=ConstantVelocity(),
    kinds=(Kind(noise=(1.0, 1.0), speed=(0.0, 5.0), lifetime=2000.0),),
    ground=Grid((-40.0, -40.0), 80.0, ((6e-4,),)),
    region=(-40.0, -40.0, 40.0, 40.0),
    slots=14,
)


def test_existence_is_true_as_often_as_it_says() -> None:
    """Four objects that one scan shows among twenty false alarms; five scans follow, that miss a quarter. Four standard
    errors in each of seven bins are passed once in thousands. (With 300 windows: .45 said and .44 true of r in
    [.4, .6], .89 and .87 in [.8, .95], .992 and .984 beyond.)"""
    num = 120
    claims = list[Claim]()
    for window in range(num):
        moments = simulated(SPOTS, ["first", *["later"] * 5], 0.5 * np.arange(6), window)
        claims += claims_of(SPOTS, moments, window)
    where, k = (np.array([getattr(claim, name) for claim in claims]) for name in ("window", "k"))
    r, truth = np.array([claim.existence for claim in claims]), np.array([float(claim.truth) for claim in claims])
    for low, high in ((0.0, 0.1), (0.1, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 0.95), (0.95, 1.0)):
        some = (r >= low) & (r <= high)
        assert some.sum() > 200
        assert abs(off_by(truth[some] - r[some], where[some], num)) < 4.0, (
            low,
            high,
            r[some].mean(),
            truth[some].mean(),
        )
        assert truth[some].mean() == pytest.approx(r[some].mean(), abs=0.07)
    for scan in range(6):
        some = k == scan
        assert abs(off_by(truth[some] - r[some], where[some], num)) < 4.0  # of the number of objects
    assert truth[(r > 0.4) & (r < 0.6)].mean() == pytest.approx(0.45, abs=0.08)


GATES = Traffic(
    sensors=(Radar(name="radar", noise_std=(0.4, 0.01, 0.3), detection=0.8, clutter=4.0, reach=(0.0, 120.0)),),
    kinds=(Kind(noise=(0.6, 0.15, 0.1), lifetime=8.0, speed=(8.0, 2.0)),),
    unseen_density=0.0,
    places=(Place((30.0, 20.0), 2.0, 0.2, (-2.0, 0.1)), Place((-40.0, 10.0), 2.0, 0.3, (0.3, 0.1))),
    slots=16,
)


def nees(error: Floats, covariance: Floats, entries: list[int]) -> float:
    return float(error[entries] @ np.linalg.solve(covariance[np.ix_(entries, entries)], error[entries]))


def test_numbers_and_states_of_objects_that_come_and_go_are_calibrated() -> None:
    """CTRA and radar. The number of objects is right in each scan. States of sure objects, by whichever label is
    nearest: which of two that came one after the other is which, the filter forgets. (Where newcomers' speed and heading
    are known to 4 m/s and .2 rad only, range rates are not linear within their noise: 9.7 instead of 6.)"""
    num, length = 60, 14
    told, true, found, where = (
        np.zeros((num, length)),
        np.zeros((num, length)),
        list[tuple[float, float]](),
        list[int](),
    )
    for window in range(num):
        belief = Belief(None, no_objects(6))
        for k, moment in enumerate(simulated(GATES, ["radar"] * length, 0.25 * np.arange(length), 1000 + window)):
            belief, _ = step(GATES, belief, moment.scan, k, Knobs())
            told[window, k], true[window, k] = belief.objects.existence.sum(), len(moment.there)
            for r, mean, P in marginals(belief.objects).values():
                if r > 0.9 and len(moment.there):
                    error = moment.state[np.hypot(*(moment.state - mean)[:, :2].T).argmin()] - mean
                    error[2] = math.remainder(error[2], 2 * math.pi)
                    if math.hypot(*error[:2]) < 10.0:  # else nobody is there: one in a hundred
                        found.append((nees(error, P, [0, 1]), nees(error, P, list(range(6)))))
                        where.append(window)
    rows, windows = np.array(found), np.array(where)
    for k in range(2, length):
        assert abs(off_by(told[:, k] - true[:, k], np.arange(num), num)) < 4.0
    assert len(rows) > 400
    assert (rows.mean(0) > (1.6, 5.1)).all()  # of 2 and 6; found 1.79 and 6.21
    assert (rows.mean(0) < (2.4, 6.9)).all()
    assert abs(off_by(rows[:, 0] - 2.0, windows, num)) < 4.0
    assert abs(off_by(rows[:, 1] - 6.0, windows, num)) < 4.0


CALM = replace(
    SPOTS, sensors=tuple(replace(s, clutter=1.0) for s in SPOTS.sensors), ground=Grid((-40.0, -40.0), 80.0, ((2e-4,),))
)


def test_states_are_as_wrong_as_covariances_say() -> None:
    num, found, where = 60, list[tuple[float, float]](), list[int]()
    for window in range(num):
        belief = Belief(None, no_objects(4))
        owner = dict[int, int]()
        for k, moment in enumerate(simulated(CALM, ["first", *["later"] * 5], 0.5 * np.arange(6), window)):
            if k == 0:
                owner = dict(enumerate(moment.source.tolist()))
            belief, _ = step(CALM, belief, moment.scan, k, Knobs())
            there = moment.there.tolist()
            for label, (_, mean, P) in marginals(belief.objects).items():
                if owner[label] in there:
                    error = moment.state[there.index(owner[label])] - mean
                    found.append((nees(error, P, [0, 1]), nees(error, P, [0, 1, 2, 3])))
                    where.append(window)
    rows, windows = np.array(found), np.array(where)
    assert len(rows) > 300
    assert (rows.mean(0) > (1.6, 3.4)).all()  # of 2 and 4; found 1.93 and 3.82
    assert (rows.mean(0) < (2.4, 4.6)).all()
    assert abs(off_by(rows[:, 0] - 2.0, windows, num)) < 4.0
    assert abs(off_by(rows[:, 1] - 4.0, windows, num)) < 4.0
