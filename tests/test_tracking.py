"""Scans in the order of their arrival: late ones are put where they belong, and what was believed is as if all had
come in time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest

from inference import lmb
from inference.tracking import Facts, track
from inference.tracks import ARRAYS, Objects, Tracks
from models.program import InputError
from tests.line_objects import Line, LineScan, scan_at


class Memory(NamedTuple):
    """A belief that is all that it was told."""

    time: float | None
    told: tuple[tuple[float, int], ...] = ()


def remember(belief: Memory, scan: LineScan, number: int) -> tuple[Memory, Facts]:
    assert belief.time is None or belief.time <= scan.time
    told = (*belief.told, (scan.time, number))
    gap = 0.0 if belief.time is None else scan.time - belief.time
    return Memory(scan.time, told), Facts(gap**2 + 1.0, number + 1, 0.01 * gap)


def nothing(belief: Memory) -> Objects:
    return Objects(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2)))


def remembered(times: Sequence[float], patience: float = 1.0) -> tuple[list[Memory], Tracks]:
    beliefs = list[Memory]()

    def tell(belief: Memory) -> Objects:
        beliefs.append(belief)
        return nothing(belief)

    scans = [scan_at(time, ()) for time in times]
    return beliefs, track(Line(), scans, Memory(None), remember, tell, patience=patience, progress=False)


@pytest.mark.parametrize("order", list(itertools.permutations((0.0, 0.4, 0.5, 0.9))))
def test_any_order_of_arrival_ends_in_the_order_of_time(order: tuple[float, ...]) -> None:
    beliefs, tracks = remembered(order)
    for number, belief in enumerate(beliefs):
        assert belief.told == tuple(sorted((time, i) for i, time in enumerate(order[: number + 1])))
        assert tracks.time[number] == belief.time == max(order[: number + 1])
    gaps = np.diff(sorted(order))
    assert tracks.log_evidence == pytest.approx(4.0 + np.square(gaps).sum(), abs=1e-12)
    late = sum(order[i] < max(order[:i]) for i in range(1, 4))
    assert tracks.info["late"] == late
    assert tracks.info["too_late"] == 0
    assert tracks.info["flags"] == []


def test_all_that_may_be_done_again_is_remembered() -> None:
    times = (0.0, 0.3, 0.6, 0.9, 0.05)
    beliefs, _ = remembered(times)
    assert beliefs[-1].told == tuple(sorted((time, number) for number, time in enumerate(times)))


def test_what_is_counted_of_steps_is_not_counted_twice_where_they_are_done_again() -> None:
    _, tracks = remembered((0.0, 0.9, 0.5, 0.4))
    assert tracks.info["left_out"] == pytest.approx(0.009, abs=1e-15)
    assert tracks.info["groups_by_belief_propagation"] == 1 + 2 + 3 + 4


def test_scans_at_the_same_time_stay_in_the_order_of_arrival() -> None:
    beliefs, tracks = remembered((0.0, 0.5, 0.5, 0.0))
    assert beliefs[-1].told == ((0.0, 0), (0.0, 3), (0.5, 1), (0.5, 2))
    assert tracks.info["late"] == 1


@pytest.mark.parametrize("patience", [0.0, 0.25, 2.0])
def test_scan_that_is_too_late_is_left_out_and_told_of(patience: float) -> None:
    """Patience counts from the latest time, however the scans before came."""
    times = (0.0, 5.0, 4.75, 3.0, 5.5, 2.99, 5.25)
    kept, latest = list[tuple[float, int]](), 0.0
    for number, time in enumerate(times):
        latest = max(latest, time)
        if time >= latest - patience:
            kept.append((time, number))
    beliefs, tracks = remembered(times, patience)
    assert beliefs[-1].told == tuple(sorted(kept))
    left = len(times) - len(kept)
    assert tracks.info["too_late"] == left > 0
    assert tracks.info["flags"] == [f"{left} of 7 scans came more than {patience} s late and were left out"]
    assert len(tracks.time) == 7  # something is told after each arrival


def lost(each: float, expected: float) -> Tracks:
    """Ten scans, in each of which so much is left out; so many objects are expected."""

    def tell(belief: Memory) -> Objects:
        state = np.zeros((1, 2)), np.eye(2)[None], np.array([[1.0, 0.0]])
        return Objects(np.zeros(1, dtype=np.int64), np.array([expected]), *state)

    def step(belief: Memory, scan: LineScan, number: int) -> tuple[Memory, Facts]:
        return Memory(scan.time), Facts(0.0, 0, each)

    scans = [scan_at(0.1 * k, ()) for k in range(10)]
    return track(Line(), scans, Memory(None), step, tell, patience=1.0, progress=False)


def test_what_is_left_out_is_flagged_where_it_is_more_than_a_percent() -> None:
    assert lost(0.009, 0.9).info["flags"] == []
    found = lost(0.011, 0.9)
    assert found.info["flags"] == ["objects that were too improbable to keep add up to 0.1; lower `faint`"]
    assert found.info["left_out"] == pytest.approx(0.11, abs=1e-12)


def drive(seed: int = 3) -> list[LineScan]:
    """Two objects and clutter, 30 scans at uneven times, two of them at the same."""
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0.0, 6.0, 30))
    times[8] = times[7]
    scans = []
    for t in times:
        places = [z + rng.normal(0.0, 0.5) for z in (-10.0 + 2 * t, 10.0 - t) if rng.random() < 0.8]
        places += rng.uniform(-20.0, 20.0, rng.poisson(2.0)).tolist()
        scans.append(scan_at(float(t), rng.permutation(places).tolist()))
    return scans


MODEL = Line(unseen_number=0.05, clutter=0.05)


def of_time(tracks: Tracks, t: int) -> list[Any]:
    """What is believed after arrival t but for labels."""
    rows = slice(tracks.offset[t], tracks.offset[t + 1])
    return [tracks.time[t], *(getattr(tracks, name)[rows] for name in ARRAYS[3:])]


def test_late_scans_change_nothing_of_what_is_believed_in_the_end() -> None:
    scans = drive()
    rng = np.random.default_rng(0)
    arrival = np.argsort([scan.time + rng.uniform(0.0, 0.8) for scan in scans], kind="stable")
    late = [scans[i] for i in arrival]
    late.append(scan_at(late[-1].time + 1.0, (0.0,)))
    in_time = sorted(late, key=lambda scan: scan.time)  # stable: those at the same time stay in order of arrival
    one, other = lmb.run(MODEL, in_time), lmb.run(MODEL, late)
    assert other.info["late"] > 5
    assert one.info["late"] == 0
    for a, b in zip(of_time(one, -2), of_time(other, -2), strict=True):
        np.testing.assert_array_equal(a, b)
    assert one.log_evidence == pytest.approx(other.log_evidence, abs=1e-9)
    assert one.info["left_out"] == pytest.approx(other.info["left_out"], abs=1e-9)


def test_late_scans_do_not_change_labels() -> None:
    """All that is told of before a scan comes late, however improbable, is called the same after it, and has the state
    that it would have had in time; only what the late scan may have shown first is new. Labels are told as numbers
    counted up by arrival, so those of the last five scans are other ones in time."""
    scans = drive()
    late = [*scans[:20], *scans[21:25], scans[20]]
    found = lmb.run(MODEL, late, report=0.0, faint=1e-12)
    before, after, kept = found.at(23), found.at(24), found.at(19).label
    assert found.time[23] == found.time[24]
    assert found.info["late"] == 1
    assert len(kept) > 20 and set(kept) <= set(before.label) <= set(after.label)
    new = np.setdiff1d(after.label, before.label)
    assert new.tolist() == [before.label.max() + 1 + j for j in range(len(scans[20].values))] != []
    in_time = lmb.run(MODEL, scans[:25], report=0.0, faint=1e-12).at(24)
    np.testing.assert_allclose(after.mean, in_time.mean, rtol=1e-12)
    old = np.isin(after.label, kept)
    np.testing.assert_array_equal(after.label[old], in_time.label[old])


def test_labels_are_unique_and_never_given_again() -> None:
    tracks = lmb.run(MODEL, drive())
    alive: dict[int, int] = {}
    for t in range(len(tracks.time)):
        labels = tracks.at(t).label.tolist()
        assert len(set(labels)) == len(labels)
        for label in labels:
            alive[label] = t
    assert sorted(alive) == list(range(len(alive)))


def test_no_scans_are_refused() -> None:
    with pytest.raises(InputError, match="a filter needs at least one scan, but got none"):
        lmb.run(MODEL, [])


def test_model_of_something_else_is_refused() -> None:
    with pytest.raises(InputError, match=r"lmb needs a model of many objects, .*; dict is none"):
        lmb.run({}, drive())  # type: ignore[arg-type]


@pytest.mark.parametrize("patience", [math.nan, -0.1])
def test_patience_that_is_no_time_is_refused(patience: float) -> None:
    with pytest.raises(InputError, match=f"patience is {patience}"):
        remembered((0.0, 1.0), patience)
