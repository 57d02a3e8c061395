"""Distances between sets: cases by hand, brute force over assignments, and what makes them metrics."""

from __future__ import annotations

import itertools
import math
from datetime import datetime
from typing import Any

import numpy as np
import pytest

from experiments.set_distances import gospa, ospa, ospa2
from models.program import InputError

EMPTY = np.zeros((0, 2))
ORDERS = [1.0, 2.0, 3.5]


def points(rng: np.random.Generator, most: int = 4) -> np.ndarray[Any, Any]:
    return rng.uniform(0.0, 10.0, (rng.integers(0, most + 1), 2))


def tracks(rng: np.random.Generator, most: int = 3, num_scans: int = 4) -> np.ndarray[Any, Any]:
    """Paths with gaps, some of them nowhere."""
    out = rng.uniform(0.0, 10.0, (rng.integers(0, most + 1), num_scans, 2))
    out[rng.random(out.shape[:2]) < 0.4] = np.nan
    return out


def test_ospa_by_hand() -> None:
    first, second = np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([[10.0, 3.0], [0.0, 4.0], [50.0, 50.0]])
    assert ospa(first, second, cutoff=20.0) == pytest.approx((3 + 4 + 20) / 3)
    assert ospa(first, second, cutoff=20.0, order=2.0) == pytest.approx(math.sqrt((9 + 16 + 400) / 3))
    assert ospa(first, second, cutoff=3.5) == pytest.approx((3 + 3.5 + 3.5) / 3)


def test_gospa_by_hand() -> None:
    truth, estimate = np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([[10.0, 3.0], [0.0, 4.0], [50.0, 50.0]])
    found = gospa(truth, estimate, cutoff=20.0)
    assert found.distance == pytest.approx(math.sqrt(9 + 16 + 200))
    assert (found.localisation, found.missed, found.false) == (pytest.approx(5.0), 0, 1)
    assert found.pairs.tolist() == [[0, 1], [1, 0]]
    near = gospa(truth, estimate, cutoff=3.5)  # 4 m are too far: one missed, and with the third two false
    assert near.distance == pytest.approx(math.sqrt(9 + 0.5 * 3.5**2 * 3))
    assert (near.missed, near.false, near.pairs.tolist()) == (1, 2, [[1, 0]])


def test_empty_sets_are_as_far_as_all_that_is_missing() -> None:
    two = np.array([[0.0, 0.0], [1.0, 0.0]])
    assert ospa(EMPTY, EMPTY, cutoff=5.0) == 0.0
    assert ospa(two, EMPTY, cutoff=5.0) == ospa(EMPTY, two, cutoff=5.0) == 5.0
    assert gospa(EMPTY, EMPTY, cutoff=5.0).distance == 0.0
    found = gospa(two, EMPTY, cutoff=5.0)
    assert (found.distance, found.missed, found.false) == (pytest.approx(5.0), 2, 0)
    assert gospa(EMPTY, two, cutoff=5.0).false == 2


def test_ospa2_by_hand() -> None:
    nan = math.nan
    first = np.array([[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], [[9.0, 9.0], [nan, nan], [nan, nan]]])
    second = np.array([[[0.0, 3.0], [1.0, 1.0], [nan, nan]]])
    found = ospa2(first, second, cutoff=5.0, window=2)
    # scan 0: |0, 3| and one missing; scan 1: mean of 3 and 1, and one missing; scan 2: mean of 1 and 5
    np.testing.assert_allclose(found, [(3 + 5) / 2, (2 + 5) / 2, (1 + 5) / 2])
    whole = ospa2(first, second, cutoff=5.0, order=2.0, window=3)[-1]
    assert whole == pytest.approx(math.sqrt(((3 + 1 + 5) / 3) ** 2 / 2 + 25 / 2))


def test_times_when_neither_path_is_there_count_nothing_in_ospa2() -> None:
    nan = math.nan
    first = np.array([[[0.0, 0.0], [nan, nan], [0.0, 0.0]]])
    second = np.array([[[0.0, 1.0], [nan, nan], [0.0, 2.0]]])
    np.testing.assert_allclose(ospa2(first, second, cutoff=5.0, window=3), [1.0, 1.0, 1.5])


def test_pairs_are_chosen_by_the_power_of_the_distance() -> None:
    first = np.array([[0.0, 0.0], [2.0, 0.0]])
    second = np.array([[2.0, 0.0], [3.9925, math.sqrt(4.1**2 - 3.9925**2)]])  # 2, 4.1 m from the first; 0, 2.2 m
    assert ospa(first, second, cutoff=9.0) == pytest.approx(4.1 / 2)  # less than 2 + 2.2
    assert ospa(first, second, cutoff=9.0, order=2.0) == pytest.approx(math.sqrt((2**2 + 2.2**2) / 2))
    assert gospa(first, second, cutoff=9.0).distance == pytest.approx(math.sqrt(2**2 + 2.2**2))


def test_swapped_identities_show_in_ospa2_only() -> None:
    truth = np.stack([np.stack([np.arange(6.0), np.full(6, y)], -1) for y in (0.0, 4.0)])
    swapped = truth.copy()
    swapped[:, 3:] = truth[::-1, 3:]
    assert all(ospa(truth[:, t], swapped[:, t], cutoff=5.0) == 0.0 for t in range(6))
    np.testing.assert_allclose(ospa2(truth, swapped, cutoff=5.0, window=6), [0, 0, 0, 1, 8 / 5, 2])


@pytest.mark.parametrize("order", ORDERS)
def test_distances_are_the_best_over_all_assignments(order: float) -> None:
    rng, c = np.random.default_rng(0), 4.0
    for _ in range(60):
        few, many = sorted((points(rng), points(rng)), key=len)
        d = np.linalg.norm(few[:, None] - many, axis=-1)
        n, m = d.shape
        choices = list(itertools.permutations(range(m), n))
        whole = min(sum(min(d[i, j], c) ** order for i, j in enumerate(choice)) for choice in choices)
        expected = ((whole + c**order * (m - n)) / m) ** (1 / order) if m else 0.0
        assert ospa(few, many, cutoff=c, order=order) == pytest.approx(expected)
        partial = [
            sum(d[i, j] ** order for i, j in enumerate(choice) if keep[i]) + c**order * (n + m - 2 * sum(keep)) / 2
            for choice in choices
            for keep in itertools.product([False, True], repeat=n)
        ]
        found = gospa(few, many, cutoff=c, order=order)
        assert found.distance == pytest.approx(min(partial) ** (1 / order))
        parts = found.localisation**order + 0.5 * c**order * (found.missed + found.false)
        assert found.distance**order == pytest.approx(parts)


@pytest.mark.parametrize("order", ORDERS)
def test_distances_are_metrics(order: float) -> None:
    rng = np.random.default_rng(1)
    between = {
        "ospa": lambda a, b: ospa(a, b, cutoff=4.0, order=order),
        "gospa": lambda a, b: gospa(a, b, cutoff=4.0, order=order).distance,
        "ospa2": lambda a, b: ospa2(a, b, cutoff=4.0, order=order, window=4)[-1],
    }
    for name, distance in between.items():
        draw = tracks if name == "ospa2" else points
        for _ in range(150):
            a, b, c = draw(rng), draw(rng), draw(rng)
            assert distance(a, a) == 0.0
            assert distance(a, b) == pytest.approx(distance(b, a))
            assert distance(a, c) <= distance(a, b) + distance(b, c) + 1e-9
            if distance(a, b) == 0.0:
                alive = lambda x: x[~np.isnan(x[..., 0]).all(-1)] if x.ndim == 3 else x  # noqa: E731
                np.testing.assert_allclose(np.sort(alive(a), 0), np.sort(alive(b), 0))


def test_order_of_members_and_place_of_the_origin_change_nothing() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        a, b = points(rng), points(rng)
        moved = np.array([3.0, -7.0])
        shuffled = (rng.permutation(a) + moved, rng.permutation(b) + moved)
        assert ospa(*shuffled, cutoff=4.0) == pytest.approx(ospa(a, b, cutoff=4.0))
        assert gospa(*shuffled, cutoff=4.0).distance == pytest.approx(gospa(a, b, cutoff=4.0).distance)
        first, second = tracks(rng), tracks(rng)
        again = ospa2(rng.permutation(first), rng.permutation(second), cutoff=4.0, window=2)
        np.testing.assert_allclose(again, ospa2(first, second, cutoff=4.0, window=2))


def test_over_one_scan_ospa2_is_ospa() -> None:
    rng = np.random.default_rng(3)
    for order in ORDERS:
        a, b = points(rng), points(rng)
        found = ospa2(a[:, None], b[:, None], cutoff=4.0, order=order, window=1)
        assert found[0] == pytest.approx(ospa(a, b, cutoff=4.0, order=order))


@pytest.mark.parametrize(
    ("knobs", "message"),
    [({"cutoff": 0.0}, "cutoff is 0.0 m"), ({"cutoff": 1.0, "order": 0.5}, "order is 0.5")],
)
def test_what_is_no_metric_is_refused(knobs: dict[str, float], message: str) -> None:
    for distance in (ospa, gospa):
        with pytest.raises(InputError, match=message):
            distance(EMPTY, EMPTY, **knobs)
    with pytest.raises(InputError, match="window of OSPA"):
        ospa2(np.zeros((0, 3, 2)), np.zeros((0, 3, 2)), cutoff=1.0, window=0)


def test_stone_soup_agrees() -> None:
    ospametric = pytest.importorskip("stonesoup.metricgenerator.ospametric")
    state = pytest.importorskip("stonesoup.types.state").State
    now, rng, c = datetime(2020, 1, 1), np.random.default_rng(4), 4.0
    single, general = ospametric.OSPAMetric(p=1, c=c), ospametric.GOSPAMetric(p=2, c=c)
    for _ in range(40):
        a, b = points(rng), points(rng)
        if not len(a) + len(b):
            continue  # it needs a time
        theirs, truth = ([state(p[:, None], timestamp=now) for p in x] for x in (b, a))
        found = single.compute_OSPA_distance(theirs, truth).value
        assert ospa(a, b, cutoff=c) == pytest.approx(float(found))
        auction = general.compute_gospa_metric(theirs, truth)[0].value["distance"] ** 2
        ours = gospa(a, b, cutoff=c, order=2.0).distance ** 2
        assert ours <= auction + 1e-9 <= ours + 1.0 + 2e-9  # bids rise by 1 / max(n, m): the sum is that near the best
