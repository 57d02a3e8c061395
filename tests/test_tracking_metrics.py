"""Scores of tracks on scenes where every error is known."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from experiments.scenarios.scene import Scene, TrafficTruth
from experiments.tracking_metrics import counts, judge, metrics, position_errors, times_of, timing
from inference.posterior import Posterior
from inference.tracks import Tracks
from models.program import InputError
from tests.drawn_tracks import STD, believed, traffic


def scored(tracks: Tracks, truth: TrafficTruth, **knobs: Any) -> dict[str, float]:
    return metrics(tracks, Scene(None, truth, "drawn", {}), **knobs)


def exact(truth: TrafficTruth, **changes: Any) -> Tracks:
    """Tracks that know where everybody is."""
    tracks = believed(truth)
    mean = tracks.mean.copy()
    mean[:, :2] = truth.position
    return replace(tracks, **({"mean": mean, "existence": np.ones(len(truth.label)), "draws": {}} | changes))


def two(places: Any, gap: float = 20.0) -> TrafficTruth:
    """Two objects side by side at x = places."""
    num = len(places)
    x, y = np.repeat(places, 2), np.tile([0.0, gap], num)
    zero = np.zeros(2 * num)
    offset = 2 * np.arange(num + 1)
    label = np.tile([1, 2], num)
    return TrafficTruth(np.arange(float(num)), offset, label, x, y, zero, zero, zero, zero + 4.0, zero + 2.0, label * 0)


def test_exact_tracks_have_no_error() -> None:
    truth = traffic()
    found = scored(exact(truth), truth)
    nothing = {name: value for name, value in found.items() if name != "count_covered"}
    assert set(nothing.values()) == {0.0}
    assert found["count_covered"] == 1.0


def test_scores_of_a_missed_and_a_false_object_by_hand() -> None:
    truth = two(np.arange(4.0))
    mean = exact(truth).mean.copy()
    mean[:, 1] += np.tile([7.0, 50.0], 4)  # the first is 7 m off, the second far away
    found = scored(exact(truth, mean=mean), truth, cutoff=10.0)
    assert found["ospa_m"] == found["ospa2_m"] == pytest.approx((7 + 10) / 2)
    assert found["gospa_m"] == pytest.approx(math.sqrt(49 + 100))
    assert found["gospa_localisation_m"] == found["position_error_m"] == pytest.approx(7.0)
    assert (found["missed"], found["false"], found["lost"]) == (1.0, 1.0, 0.5)
    assert found["label_switches"] == found["fragmentations"] == found["count_error"] == 0.0


def test_exchanged_labels_are_switches_though_no_position_is_wrong() -> None:
    truth = two(np.arange(6.0))
    label = truth.label.copy()
    label[6:] = 3 - label[6:]
    found = scored(exact(truth, label=label), truth)
    assert found["label_switches"] == 2.0
    assert found["ospa_m"] == 0.0
    assert found["ospa2_m"] == pytest.approx(np.mean([0, 0, 0, 10 / 4, 10 * 2 / 5, 10 * 3 / 6]))  # 20 m away: cut off


def test_an_object_lost_and_found_again_is_a_fragmentation() -> None:
    truth = two(np.arange(6.0))
    existence = np.ones(12)
    existence[4] = 0.3
    found = scored(exact(truth, existence=existence), truth)
    assert (found["fragmentations"], found["label_switches"], found["missed"]) == (1.0, 0.0, pytest.approx(1 / 6))
    assert found["count_error"] == pytest.approx(0.7 / 6)  # of the expected number, not of the confirmed one
    assert scored(exact(truth, existence=existence), truth, threshold=0.2)["fragmentations"] == 0.0


def test_nees_of_exact_gaussians_is_their_dimension() -> None:
    truth = traffic(num=40, num_scans=50)
    spread = traffic(num=40, num_scans=50)._replace(
        x=truth.x + 100.0 * (truth.label % 8), y=truth.y + 100.0 * (truth.label // 8)
    )
    found = scored(believed(spread, seed=5), spread, cutoff=30.0)
    pairs = len(spread.label)
    assert found["nees"] == pytest.approx(2.0, abs=4.0 * math.sqrt(4.0 / pairs))  # chi2 of 2 has variance 4
    variance = STD[0] ** 2 + STD[1] ** 2 + 0.3**2
    assert found["position_error_m"] == pytest.approx(math.sqrt(variance), rel=4.0 / math.sqrt(pairs))
    overconfident = believed(spread, seed=5)
    overconfident = replace(overconfident, covariance=overconfident.covariance / 4.0)
    assert scored(overconfident, spread, cutoff=30.0)["nees"] == pytest.approx(4.0 * found["nees"])


def test_order_of_rows_and_names_of_objects_change_nothing() -> None:
    truth, rng = traffic(num=6), np.random.default_rng(0)
    tracks = believed(truth)
    order = np.concatenate(
        [o + rng.permutation(n) for o, n in zip(tracks.offset, np.diff(tracks.offset), strict=False)]
    )
    name = rng.permutation(100)
    rows = {key: getattr(tracks, key)[order] for key in ("existence", "mean", "covariance", "kind")}
    shuffled = replace(tracks, label=name[tracks.label[order]], **rows)
    for key, value in scored(tracks, truth).items():
        assert scored(shuffled, truth)[key] == pytest.approx(value), key


def test_scans_find_their_times_in_the_truth() -> None:
    truth = traffic()
    assert times_of(truth, truth.time[[0, 3, 3, 19]]).tolist() == [0, 3, 3, 19]
    for slightly in (-5e-7, 5e-7):
        assert times_of(truth, truth.time[[0, 3, 19]] + slightly).tolist() == [0, 3, 19]
    tracks = believed(truth)
    with pytest.raises(InputError, match=r"the truth knows no traffic at 0\.25 s, when scan 0 was taken"):
        judge(replace(tracks, time=tracks.time + 0.25), truth, cutoff=10.0)


def test_scans_at_one_time_are_judged_each() -> None:
    truth = two(np.arange(3.0))
    twice = exact(truth, time=np.array([0.0, 2.0, 2.0]))
    mean = twice.mean.copy()
    mean[2:4, 0] = 2.0
    found = judge(replace(twice, mean=mean), truth, cutoff=10.0)
    np.testing.assert_array_equal(found.ospa, 0.0)
    np.testing.assert_array_equal(found.ospa2, 0.0)


def test_a_truth_that_knows_more_times_is_read_at_those_of_the_scans() -> None:
    truth = traffic()
    tracks = exact(truth)
    rows = np.isin(tracks.scan, [2, 10, 19])
    parts = {name: getattr(tracks, name)[rows] for name in ("label", "existence", "mean", "covariance", "kind")}
    some = replace(
        tracks,
        time=truth.time[[2, 10, 19]],
        offset=np.array([0, 2, 5, 7]),
        sensor=("radar",) * 3,
        draws={},
        **parts,
    )
    found = judge(some, truth, cutoff=10.0)
    assert found.true_count.tolist() == [2, 3, 2]
    np.testing.assert_array_equal(found.ospa2, 0.0)
    np.testing.assert_array_equal(truth.label[found.pairs[:, 0]], some.label[found.pairs[:, 1]])


def test_errors_are_weighed_by_the_whole_covariance() -> None:
    truth = two(np.arange(2.0))
    tracks = exact(truth)
    mean, covariance = tracks.mean.copy(), tracks.covariance.copy()
    mean[0, :2] += [1.0, 1.0]
    covariance[:, :2, :2] = [[2.0, 1.0], [1.0, 1.0]]  # inverse [[1, -1], [-1, 2]]
    found = replace(tracks, mean=mean, covariance=covariance)
    error, nees = position_errors(found, truth, np.array([[0, 0], [1, 1]]))
    np.testing.assert_allclose(error, [math.sqrt(2.0), 0.0])
    np.testing.assert_allclose(nees, [1.0, 0.0], atol=1e-12)


def test_nobody_there_is_no_error_and_nobody_seen_is_all() -> None:
    truth = traffic()
    empty = {
        "offset": np.zeros(21, dtype=np.int64),
        **{name: getattr(believed(truth), name)[:0] for name in ("label", "existence", "mean", "covariance", "kind")},
    }
    found = scored(exact(truth, **empty), truth)
    assert found["ospa_m"] == 10.0
    assert found["missed"] == pytest.approx(len(truth.label) / 20)
    assert math.isnan(found["nees"])
    assert found["lost"] == 1.0
    nobody = TrafficTruth(truth.time, np.zeros(21, dtype=np.int64), *(values[:0] for values in truth[2:]))
    found = scored(exact(truth), nobody)
    assert (found["ospa_m"], found["missed"], found["lost"]) == (10.0, 0.0, 0.0)
    assert found["false"] == pytest.approx(len(truth.label) / 20)
    assert scored(exact(truth, **empty), nobody)["gospa_m"] == 0.0


def test_scores_need_tracks_and_a_truth() -> None:
    truth = traffic()
    assert metrics(Posterior({"a": np.zeros((1, 3))}), Scene(None, truth, "", {})) == {}
    assert metrics(believed(truth), Scene(None, None, "", {})) == {}


def test_counts_are_told_at_scans_evenly_over_time() -> None:
    found = counts(believed(traffic()), scans=3)
    assert list(found) == ["count[0]", "count[10]", "count[19]"]
    assert list(counts(believed(traffic()), scans=1000)) == [f"count[{t}]" for t in range(20)]


def test_seconds_of_scans_are_told_in_milliseconds() -> None:
    tracks, scene = believed(traffic()), Scene(None, None, "", {})
    slow = replace(tracks, info={"step_seconds": [0.001] * 99 + [0.5]})
    assert timing(slow, scene)["step_ms"] == pytest.approx(1.0)
    assert timing(slow, scene)["step_p99_ms"] == pytest.approx(1.0 + 0.01 * 499.0)  # between the two longest
    assert timing(replace(tracks, info={}), scene) == {}
