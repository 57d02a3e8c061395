"""Data association by Markov chains: every proposal probability exact, posteriors equal enumeration, LMB agrees."""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from typing import Any

import numpy as np
import pytest
from scipy import stats

from experiments.scenarios.close_targets import close_targets
from inference import lmb, track_mcmc, track_moves
from inference.track_mcmc import Chain, Library, advance
from inference.track_moves import (
    CUT,
    LONGER,
    NAMES,
    Edit,
    Partners,
    Proposals,
    apply,
    attach,
    birth,
    exchange,
    extend,
    owner_of,
    proposals,
    relink,
    tracks_of,
)
from inference.track_weight import Track, Window, window_of
from models.multi_object import no_objects
from models.objects.traffic import Kind
from models.program import InputError
from tests.small_windows import existence, partitions, posterior, small_model, small_scans

ONE_KIND = (Kind(noise=(0.5, 0.5), lifetime=4.0, speed=(0.0, 2.0)),)
Step = tuple[tuple[Track, ...], tuple[Track, ...]]


def draws_of(window: Window, by: Proposals, move: str, owner: dict[int, Track]) -> list[tuple[float, Edit | None]]:
    """Everything that a move may draw, its probability and what it does."""
    num = len(window.scan)

    def chance(partners: Partners, g: int) -> list[tuple[int, float]]:
        return [(h, partners.probability(h, g)) for h in range(num)]

    if move == "attach":
        pairs = [(g, h, p) for g in range(num) for h, p in chance(by.near, g)]
        return [(p / num, attach(owner, window.scan, g, h)) for g, h, p in pairs]
    if move == "exchange":
        pairs = [(g, h, p) for g in range(num) for h, p in chance(by.same, g)]
        return [(p / num, exchange(owner, window.scan, g, h)) for g, h, p in pairs]
    if move == "relink":
        pairs = [(g, h, p) for g in range(num) for h, p in chance(by.later, g)]
        cuts = [(CUT / num, relink(owner, window.scan, g, None, by.later)) for g in range(num)]
        return cuts + [((1 - CUT) * p / num, relink(owner, window.scan, g, h, by.later)) for g, h, p in pairs]
    found, least = list[tuple[float, Edit | None]](), 1 if move == "birth" else 2
    for size in range(least, len(window.scans) + 1):
        for sequence in itertools.permutations(range(num), size):
            p = LONGER ** (size - least) * (1 - LONGER) / num
            for g, h in itertools.pairwise(sequence):
                p *= by.later.probability(h, g)
            found.append((p, (birth if least == 1 else extend)(owner, window.scan, sequence)))
    return found


def flows(window: Window, by: Proposals, move: str) -> tuple[dict[Step, float], dict[Step, set[float]]]:
    """q(x, y) of all pairs of partitions, and the log ratios that the move claims for them."""
    q, claimed = Counter[Step](), dict[Step, set[float]]()
    for tracks in partitions(window.scan.tolist()):
        for probability, edit in draws_of(window, by, move, owner_of(tracks)):
            if edit is None:
                continue
            after = owner_of(tracks)
            apply(after, edit)
            pair = (tracks, tracks_of(after))
            q[pair] += probability
            claimed.setdefault(pair, set()).add(round(edit.log_ratio, 10))
    return dict(q), claimed


def wrong_ratios(move: str, sizes: tuple[int, ...]) -> int:
    """Pairs of partitions whose claimed log q' / q is not that of all draws added up."""
    model = small_model(ONE_KIND)
    window = window_of(model, small_scans(sizes))
    q, claimed = flows(window, proposals(model, window, reach=2), move)
    assert q
    wrong = 0
    for (x, y), ratios in claimed.items():
        true = np.log(q[y, x] / q[x, y]) if (y, x) in q else -np.inf
        wrong += len(ratios) != 1 or abs(next(iter(ratios)) - true) > 1e-8
    return wrong


@pytest.mark.parametrize("move", NAMES)
@pytest.mark.parametrize("sizes", [(2, 2, 1), (1, 2, 2), (2, 1, 1, 1)])
def test_moves_know_the_probabilities_of_all_draws_there_and_back(move: str, sizes: tuple[int, ...]) -> None:
    assert wrong_ratios(move, sizes) == 0


def test_the_probabilities_of_draws_sum_to_one_and_are_those_drawn() -> None:
    model = small_model(ONE_KIND)
    window = window_of(model, small_scans())
    for partners in proposals(model, window, reach=2):
        rng, num = np.random.default_rng(3), 4000
        for g in (0, 3, 6):  # 9 tests at a level of 1e-4 each
            p = np.array([partners.probability(h, g) for h in range(7)])
            assert p.sum() == pytest.approx(1.0)
            found = np.bincount([partners.draw(g, rng) for _ in range(num)], minlength=7)
            assert stats.chisquare(found, num * p).pvalue > 1e-4


def test_near_partners_are_later_and_earlier_ones() -> None:
    """B(h | g) ~ N(h | g) + N(g | h), of what is informed about both."""
    model = small_model()
    later, near, _ = proposals(model, window_of(model, small_scans()), reach=5)
    num = len(later.offset) - 1
    N, B = np.zeros((2, num, num))
    for table, by in ((N, later), (B, near)):
        table[np.repeat(np.arange(num), np.diff(by.offset)), by.choice] = by.share
    both = N + N.T
    np.testing.assert_allclose(B, both / both.sum(1, keepdims=True), atol=1e-12)


def test_a_ratio_left_out_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    true = track_moves.relink

    def forgetful(*given: Any) -> Edit | None:
        edit = true(*given)
        return edit and edit._replace(log_ratio=0.0)

    monkeypatch.setitem(globals(), "relink", forgetful)
    assert wrong_ratios("relink", (2, 2, 1)) > 0


def test_an_attachment_that_looks_only_forward_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def forward(owner: dict[int, Track], scan: Any, g: int, h: int) -> Edit | None:
        return track_moves.attach(owner, scan, g, h) if g in owner or scan[h] < scan[g] else None

    monkeypatch.setitem(globals(), "attach", forward)
    assert wrong_ratios("attach", (2, 2, 1)) > 0


def chi_square(sizes: tuple[int, ...], num_steps: int, thin: int) -> float:
    """p-value of the partitions that chains visit against the exact posterior, rare ones together."""
    model = small_model(ONE_KIND)
    window = window_of(model, small_scans(sizes))
    exact = posterior(model, window)
    library, by = Library(model, window, np.inf), proposals(model, window, reach=2)
    chains = [Chain((), 0.0, np.random.default_rng(seed)) for seed in np.random.SeedSequence(5).spawn(8)]
    counts, visits = np.zeros((len(NAMES), 3), dtype=np.int64), Counter[tuple[Track, ...]]()
    for until in range(200 + thin, num_steps + 1, thin):
        advance(chains, window, by, library, counts, until)
        visits.update(tracks_of(chain.owner) for chain in chains)
    assert set(visits) <= set(exact)
    num = visits.total()
    expected = {tracks: num * p for tracks, p in exact.items()}
    often = [tracks for tracks, count in expected.items() if count >= 10.0]
    found, wanted = ([table[tracks] for tracks in often] for table in (visits, expected))
    rest = num - sum(wanted)
    return float(stats.chisquare([*found, num - sum(found)], [*wanted, rest]).pvalue)


@pytest.mark.parametrize("sizes", [(1, 2, 2), (2, 3)])
def test_chains_visit_partitions_as_often_as_bayes_says(sizes: tuple[int, ...]) -> None:
    # draws 60 steps apart are as good as independent; the level is 1e-3
    assert chi_square(sizes, 12_200, 60) > 1e-3


def test_chains_without_the_ratio_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(track_mcmc, "LADDER", np.cumsum([0.1, 0.0, 0.1, 0.1]))
    assert chi_square((1, 2, 2), 12_200, 60) > 1e-3
    monkeypatch.setattr(Edit, "log_ratio", property(lambda self: 0.0), raising=False)
    assert chi_square((1, 2, 2), 12_200, 60) < 1e-6


def test_the_engine_finds_existence_and_numbers_of_objects() -> None:
    model, scans = small_model(), small_scans((2, 2, 3))
    window = window_of(model, scans)
    exact = existence(model, window)
    found = track_mcmc.run(
        model, scans, seed=2, start="nothing", num_steps=6000, warmup=200, thin=40, gate=1e9, reach=2, report=0.0
    )
    num = 8 * 145
    told = [g for g in range(7) if exact[g].max() > 0.0]
    assert found.label.max() + 1 == len(told)
    for rank, g in enumerate(told):
        for t in range(3):
            r = found.existence[(found.label == rank) & (found.scan == t)].sum()
            error = np.sqrt(exact[g, t] * (1.0 - exact[g, t]) / num)
            assert abs(r - exact[g, t]) < 5.0 * error + 1e-9  # each draw has at most the variance of a yes or no
    count = found.draws["count"][..., 2]
    error = count.std() / np.sqrt(num)
    assert abs(count.mean() - exact[:, 2].sum()) < 5.0 * error


def test_the_filter_is_exact_for_two_scans() -> None:
    """After one scan objects are independent, and the marginals of the second update are exact."""
    model, scans = small_model(ONE_KIND), small_scans((2, 3))
    exact = existence(model, window_of(model, scans))[:, 1]
    found = believed(model, scans)
    for label, r in found.items():
        number, j = divmod(label, lmb.STRIDE)
        assert r == pytest.approx(exact[2 * number + j], abs=1e-10)
    assert len(found) == 5


def believed(model: Any, scans: Any) -> dict[int, float]:
    """Existence after the last scan by the label of the filter, nothing pruned."""
    belief, knobs = lmb.Belief(None, no_objects(4)), lmb.Knobs(gate=1e9, least=0.0, merge=0.0, most=50, faint=0.0)
    for number, scan in enumerate(scans):
        belief, _ = lmb.step(model, belief, scan, number, knobs)
    return dict(zip(belief.objects.label.tolist(), belief.objects.existence.tolist(), strict=True))


@pytest.mark.parametrize(
    ("apart", "detection", "clutter", "bound"),
    [(30.0, 0.98, 1.0, 0.02), (30.0, 0.7, 20.0, 0.06), (3.0, 0.7, 20.0, 0.1)],
)
def test_filter_and_chains_agree_on_two_objects(apart: float, detection: float, clutter: float, bound: float) -> None:
    """Where little is to be mistaken the filter is nearly exact, else wrong by its approximation, up to `bound`."""
    model = small_model(ONE_KIND)
    sensor = dataclasses.replace(model.sensors[0], detection=detection, clutter=clutter)
    model = dataclasses.replace(model, sensors=(sensor,))
    rng = np.random.default_rng(4)
    places = [[(0.0, 0.0), (apart, 0.0)], [(0.5, 0.0), (apart, 0.4)], [(0.9, 0.0), (apart + 0.2, 0.8)]]
    blank = small_scans((2, 2, 2))
    scans = [b._replace(values=np.array(p) + rng.standard_normal((2, 2))) for b, p in zip(blank, places, strict=True)]
    exact = existence(model, window_of(model, scans))[:, -1]
    chains = track_mcmc.run(model, scans, seed=3, num_steps=6000, warmup=200, thin=40, gate=1e9, reach=2, report=0.0)
    sampled = np.array([chains.existence[(chains.label == g) & (chains.scan == 2)].sum() for g in range(6)])
    num = 8 * 145
    assert (np.abs(sampled - exact) < 5.0 * np.sqrt(exact * (1.0 - exact) / num) + 1e-9).all()
    found = np.zeros(6)
    for label, r in believed(model, scans).items():
        number, j = divmod(label, lmb.STRIDE)
        found[2 * number + j] = r
    print("largest error of the filter", np.abs(found - exact).max(), "of the number", found.sum() - exact.sum())
    assert np.abs(found - exact).max() < bound
    assert abs(found.sum() - exact.sum()) < bound


def test_the_same_seed_gives_the_same_bits() -> None:
    model, scans = small_model(), small_scans((2, 0, 3, 2))
    first, again, other = (track_mcmc.run(model, scans, seed=seed, num_steps=600, warmup=100) for seed in (1, 1, 2))
    for name in ("label", "existence", "mean", "covariance", "kind"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    np.testing.assert_array_equal(first.draws["count"], again.draws["count"])
    assert not np.array_equal(first.draws["count"], other.draws["count"])


def test_close_vehicles_are_told_apart() -> None:
    scene = close_targets(seed=3, number=3, duration=4.0)
    sensor = dataclasses.replace(small_model().sensors[0], noise_std=(1.0, 1.0), detection=0.95, clutter=5, extent=250)
    model = dataclasses.replace(
        small_model((Kind(noise=(1.0, 1.0), speed=(0.0, 10.0)),)), sensors=(sensor,), unseen_density=1e-6
    )
    found = track_mcmc.run(model, model.prepare(scene.data), seed=0, num_steps=1000, warmup=200, thin=20)
    assert found.shape == (8, 40)
    assert round(float(found.count_mean()[-1])) == 3
    assert (found.count_mean() < 4.1).all()
    assert (found.estimate["track"] >= 0).sum() > 50


def test_empty_scans_have_no_objects() -> None:
    found = track_mcmc.run(small_model(), small_scans((0, 0)), seed=0, num_steps=10, warmup=0, thin=5)
    assert len(found.label) == 0
    assert (found.draws["count"] == 0).all()


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"start": "anywhere"}, "start is 'anywhere'; choose lmb or nothing"),
        ({"num_chains": 0}, "num_chains is 0; track_mcmc needs 1 or more"),
        ({"num_steps": 0}, "num_steps is 0, but every 10. step is kept"),
        ({"warmup": 2995}, "warmup is 2995; choose 0 to 2990"),
    ],
)
def test_numbers_out_of_range_are_refused_in_words(knobs: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        track_mcmc.run(small_model(), small_scans(), seed=0, **knobs)


def test_another_model_is_refused_in_words() -> None:
    with pytest.raises(InputError, match="track_mcmc needs a model of many objects"):
        track_mcmc.run(object(), small_scans(), seed=0)  # type: ignore[arg-type]


def test_the_best_partition_is_told() -> None:
    model = small_model(ONE_KIND)
    scans = small_scans()
    window = window_of(model, scans)
    exact = posterior(model, window)
    best = max(exact, key=lambda tracks: exact[tracks])
    found = track_mcmc.run(model, scans, seed=0, start="nothing", num_chains=2, num_steps=1000, warmup=100)
    track = np.full(len(window.scan), -1)
    for rank, own in enumerate(best):
        track[list(own)] = rank
    assert found.estimate["track"].tolist() == track.tolist()


def test_objects_are_counted_as_probably_as_they_are_there() -> None:
    model, rng = small_model(ONE_KIND), np.random.default_rng(0)
    window = window_of(model, small_scans())
    library = Library(model, window, np.inf)
    library.learn([((0,), ()), ((1,), ())])
    found = np.mean([track_mcmc._count(window, library, ((0,), (1,)), rng) for _ in range(4000)], 0)
    alive = sum(np.pad(library.weights[g,].alive, (0, 3))[:3] for g in (0, 1))
    np.testing.assert_allclose(found, alive, atol=4 * np.sqrt(2 * 0.25 / 4000))
