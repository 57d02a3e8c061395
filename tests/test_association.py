"""Data association: marginals, log Z, draws and the best association against enumeration."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from typing import Any

import numba as nb
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from inference.association import MISSED, Marginals, Table, associate, best, draw, marginals
from models.program import InputError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


def table_of(weights: Any, missed: Any, keep: Any = None) -> Table:
    """Sparse table of weights (T, M): the entries that keep (T, M) marks, or those above zero."""
    weights, missed = np.asarray(weights, float), np.asarray(missed, float)
    keep = weights > 0.0 if keep is None else keep
    offset = np.concatenate([[0], np.cumsum(keep.sum(1))])
    return Table(offset, np.nonzero(keep)[1].copy(), weights[keep], missed)


def random_table(rng: np.random.Generator, tracks: int, measurements: int, share: float = 0.6) -> Table:
    """Ratios over three orders of magnitude; a few are zero but stay in the table."""
    ratio = np.exp(rng.normal(0.0, 2.0, (tracks, measurements))) * (rng.random((tracks, measurements)) < 0.95)
    return table_of(ratio, rng.uniform(0.02, 1.0, tracks), rng.random((tracks, measurements)) < share)


def dense(table: Table, values: Any) -> Any:
    """Values (E,) of entries as (T, M)."""
    track = np.repeat(np.arange(len(table.missed)), np.diff(table.offset))
    out = np.zeros((len(table.missed), table.measurement.max(initial=-1) + 1), np.asarray(values).dtype)
    out[track, table.measurement] = values
    return out


def associations(table: Table) -> dict[tuple[int, ...], Fraction]:
    """{theta: weight} of all associations of positive weight, in whole numbers."""
    ratio, missed = dense(table, table.ratio), table.missed
    found = {(): Fraction(1)}
    for t in range(len(missed)):
        options = [(MISSED, Fraction(missed[t]))] + [(j, Fraction(r)) for j, r in enumerate(ratio[t])]
        found = {
            (*theta, j): weight * w
            for (theta, weight), (j, w) in itertools.product(found.items(), options)
            if w > 0 and (j == MISSED or j not in theta)
        }
    return found


def log_of(number: Fraction) -> float:
    """log of a number that no float may hold."""
    shift = number.numerator.bit_length() - number.denominator.bit_length()
    return math.log(number / Fraction(2) ** shift) + shift * math.log(2.0)


def enumerated(table: Table) -> Marginals:
    every = associations(table)
    total = sum(every.values(), Fraction(0))
    track = np.repeat(np.arange(len(table.missed)), np.diff(table.offset))

    def share(t: int, j: int) -> float:
        return float(sum((w for theta, w in every.items() if theta[t] == j), Fraction(0)) / total)

    taken = np.array([share(t, j) for t, j in zip(track, table.measurement, strict=True)])
    free = np.array([share(t, MISSED) for t in range(len(table.missed))])
    return Marginals(taken, free, log_of(total), 0, 0)


def error(found: Marginals, truth: Marginals) -> float:
    """Of the worst probability."""
    return float(np.abs(np.concatenate([found.taken - truth.taken, found.free - truth.free])).max(initial=0.0))


def assert_equal(found: Marginals, truth: Marginals, tolerance: float = 1e-12) -> None:
    assert error(found, truth) < tolerance
    assert found.log_partition == pytest.approx(truth.log_partition, rel=tolerance, abs=tolerance)


def test_exact_sums_equal_enumeration() -> None:
    rng = np.random.default_rng(1)
    for _ in range(400):
        table = random_table(rng, *rng.integers(1, 5, 2), share=rng.choice([0.4, 0.7, 1.0]))
        assert_equal(marginals(table), enumerated(table))
    for tracks, measurements in ((5, 5), (5, 4), (4, 5), (5, 3), (2, 9), (3, 7), (7, 2)):
        table = random_table(rng, tracks, measurements, share=1.0)
        assert_equal(marginals(table), enumerated(table))


def test_exact_sums_hold_where_tracks_cannot_be_missed() -> None:
    """Some tables have no association; then the tracks at fault are named."""
    rng, refused = np.random.default_rng(2), 0
    for _ in range(200):
        table = random_table(rng, *rng.integers(1, 5, 2))
        table = table._replace(missed=table.missed * (rng.random(len(table.missed)) < 0.4))
        if associations(table):
            assert_equal(marginals(table), enumerated(table))
            assert tuple(best(table)) in associations(table)
        else:
            refused += 1
            for call in (marginals, best, lambda t: draw(t, rng)):
                with pytest.raises(InputError, match="track"):
                    call(table)
    assert 20 < refused < 180


def test_ratios_of_any_size_are_summed() -> None:
    """Rows and columns hundreds of orders apart; single associations that nothing but tiny weights make possible."""
    rng = np.random.default_rng(3)
    for _ in range(150):
        tracks, measurements = rng.integers(2, 5, 2)
        ratio = 10.0 ** rng.uniform(-300, 300, (tracks, measurements))
        missed = 10.0 ** rng.uniform(-300, 0, tracks) * (rng.random(tracks) < 0.6)
        table = table_of(ratio, missed, rng.random((tracks, measurements)) < 0.8)
        if not (every := associations(table)):
            continue
        truth = enumerated(table)
        for method in ("auto", "loopy", "gibbs"):
            found = marginals(table, method=method)  # type: ignore[arg-type]
            assert error(found, truth) < {"auto": 1e-12, "loopy": 0.3, "gibbs": 0.05}[method]
            assert found.log_partition == pytest.approx(truth.log_partition, abs=1e-9 if method == "auto" else 0.5)
        assert log_of(every[tuple(best(table))]) == pytest.approx(log_of(max(every.values())), abs=1e-9)
        assert all(tuple(theta) in every for theta in draw(table, rng, 5))
    two = table_of([[1e300, 0.0], [1e-300, 1e300]], [1e-300, 0.0])
    assert_equal(marginals(two), enumerated(two))


def test_a_long_chain_is_exact_with_two_bits() -> None:
    """Track t can take measurements t and t + 1: a product of 2 x 2 matrices, by whether t + 1 is taken."""
    rng, n = np.random.default_rng(4), 60
    ratio, missed = np.exp(rng.normal(0.0, 2.0, (n, 2))), rng.uniform(0.02, 1.0, n)
    order, names = rng.permutation(n), rng.permutation(n + 1)
    table = Table(
        np.arange(0, 2 * n + 1, 2),
        names[order[:, None] + np.arange(2)].ravel(),
        ratio[order].ravel(),
        missed[order],
    )
    steps = [np.array([[q + a, b], [q, b]]) for q, (a, b) in zip(missed, ratio, strict=True)]
    before, after = [np.array([1.0, 0.0])], [np.ones(2)]
    for step, back in zip(steps, steps[::-1], strict=True):
        before.append(before[-1] @ step)
        after.append(back @ after[-1])
    after.reverse()
    total = before[n].sum()
    free = np.array([q * (f @ np.array([a[0], a[0]])) for q, f, a in zip(missed, before, after[1:], strict=False)])
    found = marginals(table, max_shared=2)
    assert found.num_approximate == 0
    np.testing.assert_allclose(found.free, (free / total)[order], atol=1e-12)
    assert found.log_partition == pytest.approx(math.log(total), rel=1e-12)


def test_belief_propagation_is_exact_without_cycles() -> None:
    rng = np.random.default_rng(5)
    for _ in range(100):
        tracks = int(rng.integers(2, 6))
        keep, num = np.zeros((tracks, 8), bool), 1
        for t in range(tracks):  # hang every track onto one measurement of those before, and give it new ones
            new = int(rng.integers(0, 3)) if num < 6 else 0
            keep[t, [int(rng.integers(num)), *range(num, num + new)]] = True
            num += new
        table = table_of(np.exp(rng.normal(0.0, 2.0, keep.shape)), rng.uniform(0.0, 1.0, tracks), keep)
        found, truth = marginals(table, method="loopy", tolerance=1e-13, max_iterations=2000), marginals(table)
        assert truth.num_approximate == found.num_unconverged == 0
        assert_equal(found, truth, 1e-9)


def test_belief_propagation_is_close_with_cycles() -> None:
    """Seen on these 200 tables: error .005 at the median and .12 at worst, log Z .005 and .22."""
    rng, errors, logs = np.random.default_rng(6), [], []
    for _ in range(200):
        table = random_table(rng, *rng.integers(2, 6, 2), share=0.8)
        found, truth = marginals(table, method="loopy"), marginals(table)
        assert found.num_unconverged == 0
        errors.append(error(found, truth))
        logs.append(abs(found.log_partition - truth.log_partition))
    assert np.median(errors) < 0.01 and max(errors) < 0.15
    assert np.median(logs) < 0.01 and max(logs) < 0.3


def test_belief_propagation_counts_what_it_gave_up_on() -> None:
    rng = np.random.default_rng(7)
    table = random_table(rng, 12, 12, share=1.0)
    found = marginals(table, max_shared=8)
    assert (found.num_approximate, found.num_unconverged) == (1, 0)
    assert marginals(table, max_iterations=1).num_unconverged == 1
    assert marginals(table, max_shared=12).num_approximate == 0


def test_gibbs_nears_the_exact_sums_as_sweeps_grow() -> None:
    rng = np.random.default_rng(8)
    for never_missed in (False, True):
        table = random_table(rng, 6, 7, share=1.0)
        if never_missed:
            table = table._replace(missed=np.zeros(6))
        truth = marginals(table)
        found = [marginals(table, method="gibbs", num_sweeps=n) for n in (10, 300, 10_000, 300_000)]
        logs = [f.log_partition for f in found]
        errors = [error(f, truth) for f in found]
        assert logs == sorted(logs) and logs[-1] < truth.log_partition + 1e-9, "a lower bound"
        assert errors[0] > errors[1] > errors[2] > errors[3] and errors[3] < 5e-3
    small = random_table(rng, 3, 3, share=1.0)
    assert_equal(marginals(small, method="gibbs", num_sweeps=20_000), enumerated(small))  # met all of 34


def test_gibbs_is_reproduced_by_its_seed() -> None:
    table = random_table(np.random.default_rng(9), 8, 8, share=1.0)
    first, again, other = (marginals(table, method="gibbs", num_sweeps=50, seed=s) for s in (3, 3, 4))
    np.testing.assert_array_equal(first.taken, again.taken)
    assert error(first, other) > 0.0


@pytest.mark.parametrize(
    ("shape", "knobs"),
    [
        ((3, 3), {}),
        ((4, 4), {}),
        ((4, 5), {}),  # transposed
        ((3, 3), {"max_shared": 0, "num_sweeps": 60}),  # Gibbs
    ],
)
def test_draws_follow_the_distribution(shape: tuple[int, int], knobs: dict[str, int]) -> None:
    """Chi-square over associations expected five times or more, the others in one class, at the level 1e-3 with a fixed
    seed. Gibbs draws are nearly independent 60 sweeps apart."""
    rng, num = np.random.default_rng(10), 20_000
    table = random_table(rng, *shape, share=1.0)
    table.missed[0] = 0.0
    every = associations(table)
    total = sum(every.values(), Fraction(0))
    found = draw(table, np.random.default_rng(11), num, **knobs)
    names, counts = np.unique(found, axis=0, return_counts=True)
    seen = {tuple(theta): int(count) for theta, count in zip(names, counts, strict=True)}
    assert set(seen) <= set(every)
    expected = {theta: float(w / total) * num for theta, w in every.items()}
    common = [theta for theta, n in expected.items() if n >= 5.0]
    cells = [(seen.get(theta, 0), expected[theta]) for theta in common]
    cells.append((num - sum(n for n, _ in cells), num - sum(n for _, n in cells)))
    statistic = sum((n - m) ** 2 / m for n, m in cells if m >= 5.0)
    assert len(common) > 5 and statistic < chi2.isf(1e-3, len(common))
    np.testing.assert_array_equal(found[:100], draw(table, np.random.default_rng(11), num, **knobs)[:100])


def test_the_best_association_is_the_most_probable() -> None:
    rng = np.random.default_rng(12)
    for _ in range(200):
        table = random_table(rng, *rng.integers(1, 5, 2))
        every = associations(table)
        assert every[tuple(best(table))] >= max(every.values()) * (1 - Fraction(1, 10**12))
    for tracks, measurements in ((40, 60), (60, 30)):
        table = random_table(rng, tracks, measurements, share=0.2)
        theta = best(table)
        with np.errstate(divide="ignore"):
            reward = np.log(np.hstack([dense(table, table.ratio), np.diag(table.missed)]))
        rows, columns = linear_sum_assignment(np.where(np.isfinite(reward), reward, -1e9), maximize=True)
        chosen = reward[np.arange(tracks), np.where(theta == MISSED, measurements + np.arange(tracks), theta)]
        assert chosen.sum() == pytest.approx(reward[rows, columns].sum(), rel=1e-12)
        assert len(set(theta[theta != MISSED])) == (theta != MISSED).sum()


@pytest.mark.parametrize("method", ["auto", "loopy"])
def test_the_order_of_tracks_and_measurements_is_of_no_matter(method: Any) -> None:
    rng = np.random.default_rng(13)
    for _ in range(30):
        tracks, measurements = rng.integers(2, 9, 2)
        keep = rng.random((tracks, measurements)) < 0.5
        weights, missed = np.exp(rng.normal(0.0, 2.0, keep.shape)), rng.uniform(0.02, 1.0, tracks)
        rows, columns = rng.permutation(tracks), rng.permutation(measurements)
        one = table_of(weights, missed, keep)
        two = table_of(weights[rows][:, columns], missed[rows], keep[rows][:, columns])
        a, b = (marginals(table, method=method, tolerance=1e-13, max_iterations=2000) for table in (one, two))
        full = np.zeros((2, tracks, measurements))
        full[0][keep], full[1][keep[rows][:, columns]] = a.taken, b.taken
        np.testing.assert_allclose(full[1], full[0][rows][:, columns], atol=1e-10)
        np.testing.assert_allclose(b.free, a.free[rows], atol=1e-10)
        assert b.log_partition == pytest.approx(a.log_partition, rel=1e-10)


@pytest.mark.parametrize("method", ["auto", "loopy", "gibbs"])
def test_tracks_sum_to_one_and_measurements_to_one_at_most(method: Any) -> None:
    rng = np.random.default_rng(14)
    for shape in ((5, 5), (30, 40), (12, 12), (3, 50)):
        table = random_table(rng, *shape, share=rng.uniform(0.05, 1.0))
        found = marginals(table, method=method)
        taken = dense(table, found.taken)
        np.testing.assert_allclose(taken.sum(1) + found.free, 1.0, atol=1e-12)
        assert taken.sum(0).max() < 1.0 + (1e-4 if method != "gibbs" else 1e-12)  # loopy stops at 1e-6
        assert min(found.taken.min(), found.free.min()) >= 0.0


@pytest.mark.parametrize("method", ["auto", "loopy"])
def test_groups_do_not_touch_each_other(method: Any) -> None:
    rng = np.random.default_rng(15)
    parts = [random_table(rng, *rng.integers(1, 5, 2)) for _ in range(12)]
    first = np.cumsum([0] + [part.measurement.max(initial=-1) + 1 for part in parts])
    ends = np.cumsum([0] + [len(part.ratio) for part in parts])
    whole = Table(
        np.concatenate([[0], *(part.offset[1:] + end for part, end in zip(parts, ends, strict=False))]),
        np.concatenate([part.measurement + j for part, j in zip(parts, first, strict=False)]),
        np.concatenate([part.ratio for part in parts]),
        np.concatenate([part.missed for part in parts]),
    )
    found, single = marginals(whole, method=method), [marginals(part, method=method) for part in parts]
    np.testing.assert_allclose(found.taken, np.concatenate([m.taken for m in single]), atol=1e-14)
    np.testing.assert_allclose(found.free, np.concatenate([m.free for m in single]), atol=1e-14)
    assert found.log_partition == pytest.approx(sum(m.log_partition for m in single), rel=1e-13)


def test_empty_scans_and_tracks_out_of_view() -> None:
    rng, none = np.random.default_rng(16), np.zeros(0, np.int64)
    empty = Table(np.zeros(1, np.int64), none, np.zeros(0), np.zeros(0))
    assert_equal(marginals(empty), Marginals(np.zeros(0), np.zeros(0), 0.0, 0, 0))
    assert best(empty).shape == (0,) and draw(empty, rng, 3).shape == (3, 0)
    blind = Table(np.zeros(4, np.int64), none, np.zeros(0), np.array([0.5, 1.0, 0.1]))
    assert_equal(marginals(blind), Marginals(np.zeros(0), np.ones(3), math.log(0.05), 0, 0))
    assert (best(blind) == MISSED).all() and (draw(blind, rng, 3) == MISSED).all()
    alone = table_of([[0.0, 0.0], [1.0, 3.0]], [0.5, 0.0])
    assert_equal(marginals(alone), Marginals(np.array([0.25, 0.75]), np.array([1.0, 0.0]), math.log(2.0), 0, 0))


def test_five_thousand_measurements_leave_masks_small() -> None:
    """Own measurements need no bits, and shared ones none where few tracks share them all."""
    rng = np.random.default_rng(17)
    keep = rng.random((60, 5000)) < 0.004
    table = table_of(np.exp(rng.normal(0.0, 2.0, keep.shape)), rng.uniform(0.02, 1.0, 60), keep)
    assert np.isfinite(marginals(table, max_shared=4).log_partition)
    pair = table_of(np.exp(rng.normal(0.0, 2.0, (2, 5000))), [0.1, 0.2])
    found = marginals(pair, max_shared=2)
    one, two = dense(pair, pair.ratio)
    total = (0.1 + one.sum()) * (0.2 + two.sum()) - one @ two
    assert found.num_approximate == 0
    assert found.log_partition == pytest.approx(math.log(total), rel=1e-12)
    np.testing.assert_allclose(found.taken[:5000], one * (0.2 + two.sum() - two) / total, atol=1e-14)


@nb.njit
def from_machine_code(table, num, knobs, taken, free):  # type: ignore[no-untyped-def]
    offset, measurement, ratio, missed = table
    method, bits, tolerance, cap, sweeps = knobs
    random = np.zeros(1, np.uint64)
    return associate(offset, measurement, ratio, missed, num, method, bits, tolerance, cap, sweeps, random, taken, free)


def test_the_kernel_gives_zeros_not_nan_where_nothing_is_possible() -> None:
    """Tracks 0 and 1 both need measurement 0; weights of track 3 are not numbers; 2, 4 and 5 do not suffer."""
    table = table_of(
        [[1, 0, 0, 0], [2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 5, 0], [0, 0, 0, 1], [0, 0, 0, 1]], [0, 0, 1, 1, 1, 1]
    )
    table.ratio[3] = np.nan
    taken, free = np.full(6, 7.0), np.full(6, 7.0)
    found = from_machine_code(table, 4, (0, 8, 1e-6, 200, 100), taken, free)
    assert found == (-np.inf, 0, 0)
    np.testing.assert_allclose(free, [0, 0, 1 / 2, 0, 2 / 3, 2 / 3])
    np.testing.assert_allclose(taken, [0, 0, 1 / 2, 0, 1 / 3, 1 / 3])
    with pytest.raises(InputError, match=r"tracks 0, 1: they cannot all"):
        marginals(table_of([[1.0], [2.0]], [0.0, 0.0]))


GOOD = table_of([[1.0, 2.0], [3.0, 4.0]], [0.5, 0.5])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ratio": np.array([1.0, 2.0, np.nan, 4.0])}, "ratio of track 1 is nan"),
        ({"ratio": np.array([1.0, -2.0, 3.0, 4.0])}, "ratio of track 0 is -2"),
        ({"missed": np.array([0.5, np.inf])}, "missed of track 1 is inf"),
        ({"missed": np.array([0.5, -0.1])}, "missed of track 1 is -0.1"),
        ({"missed": np.zeros(2), "ratio": np.array([1.0, 1.0, 0.0, 0.0])}, "track 1 can neither be missed nor take"),
        ({"ratio": np.full(4, 1.7e308)}, "track 0 sum to infinity"),
        ({"measurement": np.array([0, -1, 0, 1])}, "track 0 has measurement -1"),
        ({"measurement": np.array([0, 1, 1, 1])}, "track 1 has measurement 1 twice"),
        ({"measurement": np.array([0, 1, 0])}, "4 ratios, but 3 measurements"),
        ({"offset": np.array([0, 3, 2])}, "offset must rise from 0 to its 4 entries"),
        ({"offset": np.array([0, 4])}, "in 3 steps"),
    ],
)
def test_a_broken_table_is_refused_by_name(change: dict[str, Any], words: str) -> None:
    for call in (marginals, best, lambda table: draw(table, np.random.default_rng(0))):
        with pytest.raises(InputError, match=words):
            call(GOOD._replace(**change))


@pytest.mark.parametrize(
    ("knobs", "words"),
    [({"method": "exact"}, "auto, loopy, gibbs"), ({"max_shared": 40}, "0 to 20"), ({"num_sweeps": 0}, "1 or more")],
)
def test_knobs_out_of_range_are_refused(knobs: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        marginals(GOOD, **knobs)
