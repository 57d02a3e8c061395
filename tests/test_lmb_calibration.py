"""Is what the labeled multi-Bernoulli filter says true as often as it says? Scenes are simulated by the model itself,
which knows which object made which measurement, so that every label has a truth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pyro
import pytest
import torch
from numpy.typing import NDArray

from inference.lmb import STRIDE, Belief, Knobs, step
from models.multi_object import Bernoullis, no_objects
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
    """A scan, the object that made each measurement (-1 none), and who is there, in which state."""

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


def followed(models: list[Traffic], moments: list[Moment]) -> Iterator[tuple[int, Moment, Bernoullis, dict[int, int]]]:
    """What is believed after each scan, by the model of its own, and of which object a label speaks: of that which its
    measurement is the first to show."""
    belief, owner, seen = Belief(None, no_objects(len(models[0].names))), dict[int, int](), {-1}
    for k, moment in enumerate(moments):
        owner |= {k * STRIDE + j: who for j, who in enumerate(moment.source.tolist()) if who not in seen}
        seen |= set(moment.source.tolist())
        belief, _ = step(models[k], belief, moment.scan, k, Knobs())
        yield k, moment, belief.objects, owner


def off_by(values: Floats, windows: Ints, num: int) -> float:
    """How many standard errors the mean of values is from zero; those of one window hang together."""
    sums = np.bincount(windows, values, num)
    return float(sums.mean() / (sums.std(ddof=1) / math.sqrt(num)))


DETECTION, LIFETIME, GAP = 0.9, 30.0, 0.5
SPOTS = Traffic(
    sensors=(Position(name="plots", noise_std=(1.0, 1.0), detection=DETECTION, clutter=20.0, extent=80.0),),
    motion=ConstantVelocity(),
    kinds=(Kind(noise=(1.0, 1.0), speed=(0.0, 5.0), lifetime=LIFETIME),),
    region=(-40.0, -40.0, 40.0, 40.0),
    slots=14,
)


def populated(density: float, clutter: float, num: int) -> list[Traffic]:
    """The model, and what it is at each scan. The model says that the density of unseen objects is constant; in its
    own scenes it is not, once all of them are in view: u <- u (1 - p_D) s + u_0 (1 - s)."""
    models, unseen = list[Traffic](), density
    for _ in range(num):
        ground = Grid((-40.0, -40.0), 80.0, ((unseen,),))
        models.append(replace(SPOTS, ground=ground, sensors=(replace(SPOTS.sensors[0], clutter=clutter),)))
        stay = math.exp(-GAP / LIFETIME)
        unseen = unseen * (1.0 - DETECTION) * stay + density * (1.0 - stay)
    return models


def test_existence_is_true_as_often_as_it_says() -> None:
    """Four objects that come and go among twenty false alarms. Errors of four standard errors, in each of seven bins
    and eight scans, are passed once in hundreds.

    Found: r of .427 is true of .425 in [.4, .6], .883 of .889 in [.8, .95]; 3.9 to 4.1 objects said, 4.0 to 4.2 there.
    With a constant density of unseen objects it is 5.8 to 7.0 that are said from the second scan on, and .42 of .18."""
    num, length, claims = 60, 8, list[Claim]()
    models = populated(6e-4, 20.0, length)
    for window in range(num):
        moments = simulated(models[0], ["plots"] * length, GAP * np.arange(length), window)
        for k, moment, objects, owner in followed(models, moments):
            there = set(moment.there.tolist())
            for label, r in zip(objects.label.tolist(), objects.existence.tolist(), strict=True):
                claims.append(Claim(window, k, r, owner.get(label, -1) in there))
    where, scan = (np.array([getattr(claim, name) for claim in claims]) for name in ("window", "k"))
    r, truth = np.array([claim.existence for claim in claims]), np.array([float(claim.truth) for claim in claims])
    for low, high in ((0.0, 0.1), (0.1, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 0.95), (0.95, 1.0)):
        some = (r >= low) & (r <= high)
        assert some.sum() > 100
        assert abs(off_by(truth[some] - r[some], where[some], num)) < 4.0, (low, r[some].mean(), truth[some].mean())
        assert truth[some].mean() == pytest.approx(r[some].mean(), abs=0.08)
    for k in range(length):
        some = scan == k
        assert abs(off_by(truth[some] - r[some], where[some], num)) < 4.0  # of the number of objects


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
    nearest: which of two that came one after the other is which, the filter forgets. (Where speed and heading of
    newcomers are known to 4 m/s and .2 rad only, range rates are not linear within their noise: 9.7 instead of 6.)"""
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


def test_states_are_as_wrong_as_covariances_say() -> None:
    num, length, found, where = 60, 6, list[tuple[float, float]](), list[int]()
    models = populated(2e-4, 1.0, length)
    for window in range(num):
        moments = simulated(models[0], ["plots"] * length, GAP * np.arange(length), window)
        for _, moment, objects, owner in followed(models, moments):
            there = moment.there.tolist()
            for label, (r, mean, P) in marginals(objects).items():
                if r > 0.5 and owner.get(label, -1) in there:
                    error = moment.state[there.index(owner[label])] - mean
                    found.append((nees(error, P, [0, 1]), nees(error, P, [0, 1, 2, 3])))
                    where.append(window)
    rows, windows = np.array(found), np.array(where)
    assert len(rows) > 300
    assert (rows.mean(0) > (1.6, 3.4)).all()  # of 2 and 4; found 1.83 and 3.56
    assert (rows.mean(0) < (2.4, 4.6)).all()
    assert abs(off_by(rows[:, 0] - 2.0, windows, num)) < 4.0
    assert abs(off_by(rows[:, 1] - 4.0, windows, num)) < 4.0
