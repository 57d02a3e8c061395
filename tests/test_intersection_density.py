"""The likelihoods of the intersection against brute force: plain numpy, point by point, lane by lane,
with dense covariance matrices for what a half track has in common."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

from inference.calibration import predict
from models.intersection.evidence import JunctionEvidence
from models.intersection.halves import smooth
from models.intersection.moments import CHORD
from models.intersection.state import Junction
from models.intersection.tracks import Tracks
from models.program import Latents, log_joint, terms
from tests.small_junction import FULL, blank_evidence, one, states, with_points

Array = NDArray[np.float64]
MODEL = replace(FULL, clutter_std=50.0)
STRAIGHT = replace(MODEL, bend_std=0.0, shift_std=0.0, width_spread=0.0)


class Lane(NamedTuple):
    """A lane in plain numbers; index (arm, lane) names it."""

    index: tuple[int, int]
    angle: float
    offset: float
    bend: float


def lanes(model: Junction, z: Latents, side: int) -> Iterator[Lane]:
    """Every lane of a driving direction; side 1: entries, -1: exits."""
    known: dict[str, Any] = {n: [v] * 7 for n, v in model.constants.items()} | {n: v.tolist() for n, v in z.items()}
    for a in range(known["num_arms"]):
        for lane in range(known["entries" if side == 1 else "exits"][a]):
            offset = known["shift"][a] + side * (known["gap"][a] / 2 + (lane + 0.5) * known["width"][a])
            yield Lane((a, lane), known["angle"][a], offset, known["bend"][a])


@cache
def dense(size: int, std: float, common: float) -> tuple[Array, float]:
    """Inverse and log determinant of std^2 I + common^2 1 1^T."""
    covariance = std**2 * np.eye(size) + common**2 * np.ones((size, size))
    return np.linalg.inv(covariance), float(np.linalg.slogdet(covariance)[1])


def normal(residuals: Array, std: float, common: float) -> float:
    """log N(residuals; 0, std^2 I + common^2 1 1^T)."""
    inverse, log_determinant = dense(len(residuals), std, common)
    return -0.5 * float(residuals @ inverse @ residuals + log_determinant + len(residuals) * math.log(2 * math.pi))


def half_on_lane(
    model: Junction, points: Array, s: Array, centre: Array, lane: Lane, side: int, heading: bool
) -> float:
    """log density of a half track (3, n) on a lane."""
    d = np.array([math.cos(lane.angle), math.sin(lane.angle)])
    n = np.array([-d[1], d[0]])
    gap = points[:2].T - centre
    value = normal(gap @ n - lane.offset - lane.bend * s * (s - CHORD) / 2, model.position_std, model.offset_std)
    value += normal(gap @ d - s, model.along_std, model.phase_std)
    if heading:
        turn = points[2] - lane.angle - (math.pi if side == 1 else 0.0) - lane.bend * (s - CHORD / 2)
        turn = turn - 2 * math.pi * np.round(turn.mean() / (2 * math.pi))
        value += normal(turn, model.heading_std, 0.0)
    return value


def brute_exact(model: Junction, z: Latents, evidence: JunctionEvidence) -> float:
    """log p(points | z), the lane of every half track summed out."""
    assert evidence.points is not None
    points, centre = evidence.points.numpy(), z["centre"].numpy() - evidence.origin
    total = 0.0
    for h in range(evidence.num_halves):
        side = 1 if h < evidence.num_entries else -1
        rows = slice(evidence.starts[h], evidence.starts[h + 1])
        y, s = points[:, rows], evidence.s[rows]
        options = list(lanes(model, z, side))
        stray = -len(s) * math.log(2 * math.pi * model.clutter_std**2)
        stray -= 0.5 * float(np.square(y[:2]).sum()) / model.clutter_std**2
        stray -= len(s) * math.log(2 * math.pi) if evidence.heading else 0.0
        if not options:
            total += stray
            continue
        share = math.log((1 - model.clutter) / len(options))
        each = [share + half_on_lane(model, y, s, centre, lane, side, evidence.heading) for lane in options]
        if model.clutter > 0:
            each.append(math.log(model.clutter) + stray)
        total += float(logsumexp(each))
    return total


VARIANTS = {
    "default": MODEL,
    "no clutter": replace(MODEL, clutter=0.0, one_way=False),
    "much clutter, narrow": replace(MODEL, clutter=0.4, width=1.2, offset_std=0.0),
    "straight arms": STRAIGHT,
    "strong bends and shifts": replace(MODEL, bend_std=0.02, shift_std=3.0, width_spread=0.5),
    "many lanes": replace(MODEL, max_lanes=8, width=2.0),
}


@pytest.mark.parametrize("heading", [True, False], ids=["headings", "positions only"])
@pytest.mark.parametrize("name", VARIANTS)
def test_exact_likelihood_is_the_sum_over_lanes_of_dense_gaussians(name: str, heading: bool) -> None:
    """At the state that made the data, where lanes compete, and at others, where stray halves do."""
    model, blank = VARIANTS[name], blank_evidence(heading=heading)
    z = states(model, 12, seed=1)
    for row in range(12):
        evidence = with_points(model, one(z, row), blank, seed=row)
        for other in (row, (row + 1) % 12):
            found = float(terms(model, one(z, other), evidence).likelihood["points"])
            assert found == pytest.approx(brute_exact(model, one(z, other), evidence), rel=1e-9)


def test_exact_likelihood_of_states_that_lack_a_direction() -> None:
    """Where no arm has an exit, every exit half is stray."""
    z = states(MODEL, 1, seed=3) | {"exits": torch.zeros((1, 7), dtype=torch.long)}
    z["entries"] = z["entries"].clamp(min=1)
    evidence = with_points(MODEL, one(z, 0), blank_evidence(), seed=0)
    found = float(terms(MODEL, one(z, 0), evidence).likelihood["points"])
    assert found == pytest.approx(brute_exact(MODEL, one(z, 0), evidence), rel=1e-9)


def test_exact_likelihood_of_an_arm_along_the_axis() -> None:
    """Round numbers: the cache begins as zeros, and an arm at angle zero must not be taken for known."""
    z = states(STRAIGHT, 1, seed=3)
    z["angle"][0, :3] = torch.tensor([0.0, 2.0, -2.0])
    z["num_arms"][0], z["centre"][0] = 3, torch.tensor([3.0, -7.0])
    evidence = with_points(STRAIGHT, one(z, 0), blank_evidence(), seed=0)
    found = float(terms(STRAIGHT, one(z, 0), evidence).likelihood["points"])
    assert found == pytest.approx(brute_exact(STRAIGHT, one(z, 0), evidence), rel=1e-9)


def crossing_tracks(seed: int, heading: bool) -> Tracks:
    """Eight tracks of 90 points, bent at the crossing, and three that are seen nowhere else."""
    rng = np.random.default_rng(seed)
    parts, turns = [], []
    for _ in range(8):
        begin = rng.uniform(-math.pi, math.pi)
        end = begin + rng.uniform(0.5 * math.pi, 1.5 * math.pi)  # no U-turns: their closest point is not unique
        way = np.linspace(45.0, 0.0, 45)
        path = np.concatenate([way[:, None] * [math.cos(begin), math.sin(begin)],
                               way[::-1, None] * [math.cos(end), math.sin(end)]])  # fmt: skip
        parts.append(path + rng.uniform(-5, 5, 2) + rng.normal(0.0, 0.7, path.shape))
        turns.append(np.repeat([begin + math.pi, end], 45) + rng.normal(0.0, 0.2, 90))
    for _ in range(3):
        parts.append(np.linspace([-2.0, 1.0], [3.0, -2.0], 10) + rng.normal(0.0, 0.7, (10, 2)))
        turns.append(rng.normal(0.0, 0.2, 10))
    return Tracks(
        np.concatenate(parts), np.concatenate(turns) if heading else None, np.cumsum([0] + [90] * 8 + [10] * 3)
    )


def split(evidence: JunctionEvidence, centre: Array, margin: int) -> Iterator[tuple[int, Array]]:
    """[M20]'s halves: (side, points (3, n)) before and behind the point closest to the centre.

    The centre is rounded to a 2 m grid, closest is meant along the smoothed track."""
    assert evidence.whole is not None
    points, phi, offsets = evidence.whole.rows[:2].T, evidence.whole.rows[2], evidence.whole.offsets
    grid = np.clip(2.0 * np.rint(centre / 2.0), -16.0, 16.0)
    path = smooth(np.ascontiguousarray(points), offsets)
    for side in (1, -1):
        for t in range(len(offsets) - 1):
            rows = np.arange(offsets[t], offsets[t + 1])
            closest = int(np.square(path[rows] - grid).sum(1).argmin())
            rows = rows[: max(closest - margin, 0)] if side == 1 else rows[closest + margin :]
            yield side, np.vstack([points[rows].T, phi[rows]])


def brute_closest(model: Junction, z: Latents, evidence: JunctionEvidence) -> float:
    """[M20] III-B: closest lanes and multinomial counts; 'point' and 'half'."""
    centre = z["centre"].numpy() - evidence.origin
    total = 0.0
    votes: dict[int, list[tuple[int, int]]] = {1: [], -1: []}
    for side, y in split(evidence, centre, int(model.inner_radius)):
        options = list(lanes(model, z, side))
        if not options:
            return -math.inf
        if y.size == 0:
            continue
        costs = []
        for lane in options:
            n = np.array([-math.sin(lane.angle), math.cos(lane.angle)])
            r = ((y[:2].T - centre) @ n - lane.offset) / model.position_std
            p = y[2] - lane.angle - (math.pi if side == 1 else 0.0)
            shift = p.mean() if model.likelihood == "half" else p
            p = (p - 2 * math.pi * np.round(shift / (2 * math.pi))) / model.heading_std
            costs.append(0.5 * (r**2 + p**2))
        cost = np.array(costs)  # (lanes, n)
        if model.likelihood == "half":
            total -= float(cost.sum(1).min())
            votes[side].append(options[int(cost.sum(1).argmin())].index)
        else:
            total -= float(cost.min(0).sum())
            count = np.bincount(cost.argmin(0), minlength=len(options))
            votes[side].append(options[int(count.argmax())].index)
    for side, chosen in votes.items():
        counts = np.unique(np.array(chosen), axis=0, return_counts=True)[1]
        num = len(list(lanes(model, z, side)))
        total += float(gammaln(len(chosen) + 1) - gammaln(counts + 1).sum() - len(chosen) * math.log(num))
    return total


@pytest.mark.parametrize("heading", [True, False], ids=["headings", "positions only"])
@pytest.mark.parametrize("likelihood", ["half", "point"])
def test_closest_lane_likelihoods_follow_the_paper(likelihood: Any, heading: bool) -> None:
    model = replace(STRAIGHT, likelihood=likelihood, inner_radius=12.0, centre_std=4.0, width_spread=0.2, shift_std=0.4)
    evidence = model.prepare(crossing_tracks(seed=5, heading=heading))
    z = states(model, 40, seed=2, evidence=evidence)
    found = terms(model, z, evidence).likelihood["points"].numpy()
    exact = [brute_closest(model, one(z, row), evidence) for row in range(40)]
    assert np.isfinite(exact).sum() > 30
    np.testing.assert_allclose(found, exact, rtol=1e-9)


def kernel_values(model: Junction, evidence: JunctionEvidence, z: Latents, order: Array | None = None) -> Array:
    """(log prior, log likelihood) of states (B, *event); `order` evaluates them in one cache, committing at random."""
    kernel = model.kernel(evidence)
    rows = kernel.pack({n: v.numpy() for n, v in z.items()})
    found = np.full((len(rows), 2), np.nan)
    cache, rng = np.zeros(kernel.cache_size), np.random.default_rng(0)
    for row in range(len(rows)) if order is None else order:
        cache = np.zeros(kernel.cache_size) if order is None else cache
        kernel.evaluate(rows[row], kernel.floats, kernel.ints, cache, found[row])
        if rng.random() < 0.4:
            kernel.commit(cache)
    return found


def junctions() -> dict[str, tuple[Junction, JunctionEvidence]]:
    """Every likelihood with an evidence."""
    z = states(MODEL, 1, seed=9)
    exact = with_points(MODEL, one(z, 0), blank_evidence(), seed=1)
    cases: dict[str, tuple[Junction, JunctionEvidence]] = {"exact": (MODEL, exact)}
    for likelihood in ("half", "point"):
        model = replace(STRAIGHT, likelihood=likelihood, inner_radius=12.0, steps="m20")
        cases[likelihood] = model, model.prepare(crossing_tracks(seed=5, heading=True))
    return cases


@pytest.mark.parametrize("likelihood", ["exact", "half", "point"])
def test_compiled_density_is_the_program(likelihood: str) -> None:
    model, evidence = junctions()[likelihood]
    z = states(model, 200, seed=4, evidence=evidence)
    np.testing.assert_allclose(kernel_values(model, evidence, z).sum(1), log_joint(model, z, evidence), rtol=1e-9)


@pytest.mark.parametrize("likelihood", ["exact", "half", "point"])
def test_density_does_not_depend_on_what_was_evaluated_before(likelihood: str) -> None:
    """The cache is a pure memo: states that differ in one arm, in the centre or in all, committed at random."""
    model, evidence = junctions()[likelihood]
    z = states(model, 40, seed=5, evidence=evidence)
    near = [{n: v.clone() for n, v in z.items()} for _ in range(4)]
    near[1]["gap"][:, 0] = 0.5 * near[1]["gap"][:, 0]
    near[2]["entries"][:, 1] = 3
    near[3]["centre"] += 1.0
    family = {n: torch.cat([each[n] for each in near]) for n in z}  # (160, *event), state i and i + 40 are alike
    rng = np.random.default_rng(6)
    order = np.concatenate([base + 40 * rng.integers(0, 4, 12) for base in rng.permutation(40)])
    once, again = kernel_values(model, evidence, family), kernel_values(model, evidence, family, order)
    seen = np.unique(order)
    np.testing.assert_array_equal(again[seen], once[seen])


@pytest.mark.parametrize("num_points", [1, 4])
def test_exact_likelihood_is_normalised(num_points: int) -> None:
    """Over y ~ (p(y | z1) + p(y | z2)) / 2 the mean of (p(y | z1) - p(y | z2)) / (p(y | z1) + p(y | z2)) is zero.

    z2 has other numbers of lanes than z1 and its lanes lie close to those of z1: a density that rewards lanes,
    as closest lanes do, fails. Values lie in [-1, 1]; four standard errors."""
    model = replace(MODEL, clutter=0.2)
    blank = blank_evidence(1, 1, num_points=num_points)
    z1 = states(model, 1, seed=11)
    z2 = {n: v.clone() for n, v in z1.items()}
    z2["angle"][0, :2] += 0.02
    z2["gap"][0, 1] *= 0.8
    z2["bend"][0, 0] += 1e-3
    z2["width"][0, 1] *= 1.1
    z2["entries"], z2["exits"] = (z2["entries"] + 1) % 7, (z2["exits"] + 2) % 6 + 1
    num, total, variance = 1500, 0.0, 0.0
    for seed, source in enumerate((z1, z2)):
        wide = [{n: v.expand(num, *v.shape[1:]) for n, v in z.items()} for z in (source, z1, z2)]
        evidence = predict(model, wide[0], blank, seed=seed)
        first, second = (terms(model, z, evidence).likelihood["points"] for z in wide[1:])
        value = torch.tanh(0.5 * (first - second))
        total, variance = total + float(value.mean()), variance + float(value.var()) / num
        assert value.std() > 0.02, "the states are too alike, or too far apart, to tell anything"
    assert abs(total) < 4 * math.sqrt(variance), (total, math.sqrt(variance))
