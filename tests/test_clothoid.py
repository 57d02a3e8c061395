"""Clothoids against Fresnel integrals, brute force, finite differences and another library."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.special import fresnel
from torch import Tensor

from benchmarks import clothoid as benchmark
from benchmarks.timing import THREADS
from models.clothoid import FEET, Clothoid, _halley, evaluate, hermite, hermite_or_inf, project, sample
from models.clothoid_kernel import MAX_STRETCH, guess_bow
from models.program import InputError

RNG = np.random.default_rng(0)
EXTREME = [0.0, 1e-12, 1e-8, 1e-3, math.pi / 2, math.pi - 1e-3, math.pi - 1e-8]


def tensor(*values: object) -> Tensor:
    return torch.tensor(np.array(values, dtype=float))


def random_ends(num: int, turn: float = math.pi) -> tuple[Tensor, Tensor]:
    """Poses in a square of 200 m with headings up to `turn` off the chord."""
    start, end = (torch.from_numpy(RNG.uniform(-100, 100, (num, 3))) for _ in range(2))
    along = torch.atan2(*(end - start)[:, [1, 0]].unbind(1))
    for ends in (start, end):
        ends[:, 2] = along + torch.from_numpy(RNG.uniform(-turn, turn, num))
    return start, end


def extreme_ends() -> tuple[Tensor, Tensor]:
    """Every pair of extreme headings, of either sign, over a chord of 10 m along x."""
    p, q = np.meshgrid([s * h for h in EXTREME for s in (1, -1)], [s * h for h in EXTREME for s in (1, -1)])
    p, q = p.ravel(), q.ravel()
    nil = np.zeros_like(p)
    return torch.tensor(np.stack((nil, nil, p), 1)), torch.tensor(np.stack((nil + 10.0, nil, q), 1))


def joined(clothoids: Clothoid) -> Clothoid:
    return Clothoid(*(number[torch.isfinite(clothoids.length)] for number in clothoids))


ROADS = hermite(*random_ends(20, turn=1.0))
WILD = joined(hermite_or_inf(*(torch.cat(rows) for rows in zip(random_ends(300), extreme_ends(), strict=True))))


def test_a_fit_ends_where_it_should() -> None:
    start, end = (torch.cat(rows) for rows in zip(random_ends(2000), extreme_ends(), strict=True))
    found = hermite_or_inf(start, end)
    sane = torch.isfinite(found.length)
    assert 0.95 < sane.double().mean() < 1.0
    found, end = joined(found), end[sane]
    last = evaluate(found, found.length[:, None])
    for mine, true in ((last.x, end[:, 0]), (last.y, end[:, 1])):
        torch.testing.assert_close(mine[:, 0] / found.length, true / found.length, rtol=0.0, atol=1e-10)
    off = torch.remainder(last.heading[:, 0] - end[:, 2] + 1.0, 2 * math.pi) - 1.0  # or 0 would be 2 pi
    torch.testing.assert_close(off, torch.zeros_like(off), rtol=0.0, atol=1e-9)


def test_two_steps_bring_any_headings_to_the_root() -> None:
    grid = torch.linspace(-math.pi, math.pi, 101, dtype=torch.float64)
    p, q = (angle.flatten() for angle in torch.meshgrid(grid, grid, indexing="ij"))
    bows = [guess_bow.py_func(p, q)]
    for _ in range(5):
        bows.append(_halley(bows[-1], p, q)[0])
    assert (bows[0] - bows[5]).abs().max() < 0.6
    assert (bows[2] - bows[5]).abs().max() < 1e-10
    assert (bows[3] - bows[5]).abs().max() < 1e-14


def test_5000_fits_equal_those_of_pyclothoids() -> None:
    peer = pytest.importorskip("pyclothoids", reason="the extra 'peers' is not installed").Clothoid
    start, end = (torch.cat(rows) for rows in zip(random_ends(5000), extreme_ends(), strict=True))
    found = torch.stack(hermite_or_inf(start, end), 1).numpy()
    refused = 0
    for mine, a, b in zip(found, start.numpy(), end.numpy(), strict=True):
        theirs = peer.G1Hermite(*a, *b)
        chord = math.hypot(b[0] - a[0], b[1] - a[1])
        if math.isinf(mine[5]):
            refused += 1
            assert theirs.length > MAX_STRETCH * chord
            continue
        assert theirs.length <= MAX_STRETCH * chord * (1 + 1e-9)
        length = theirs.length
        assert mine[5] == pytest.approx(length, rel=1e-8)
        assert mine[3] * length == pytest.approx(theirs.KappaStart * length, rel=1e-8, abs=1e-8)
        assert mine[4] * length**2 == pytest.approx(theirs.dk * length**2, rel=1e-8, abs=1e-8)
    assert 0 < refused < 200


def test_a_straight_road_has_no_curvature() -> None:
    found = hermite(tensor(1.0, 2.0, 0.5), tensor(1.0 + 80 * math.cos(0.5), 2.0 + 80 * math.sin(0.5), 0.5))
    assert found.length == pytest.approx(80.0, rel=1e-14)
    assert abs(found.curvature) < 1e-15 and abs(found.rate) < 1e-16


@pytest.mark.parametrize("turn", [0.5, -2.0, 3.0, 5.0])
def test_a_circle_has_no_rate(turn: float) -> None:
    start, radius = 0.7, math.copysign(40.0, turn)
    x = radius * (math.sin(start + turn) - math.sin(start))
    y = radius * (math.cos(start) - math.cos(start + turn))
    found = hermite(tensor(0.0, 0.0, start), tensor(x, y, start + turn))
    assert found.length == pytest.approx(radius * turn, rel=1e-12)
    assert found.curvature == pytest.approx(1 / radius, rel=1e-11)
    assert abs(found.rate) * radius**2 < 1e-11


@pytest.mark.parametrize("heading", [0.3, -1.5, 2.5])
def test_equal_headings_make_an_s_bend(heading: float) -> None:
    found = hermite(tensor(0.0, 0.0, heading), tensor(50.0, 0.0, heading))
    assert found.curvature + found.rate * found.length == pytest.approx(-float(found.curvature), rel=1e-12)
    assert math.copysign(1.0, -heading) == torch.sign(found.curvature)


@pytest.mark.parametrize("turn", [1.0, math.pi - 1e-9, math.pi, -math.pi, 3.0, 200.0])
def test_turning_the_plane_turns_the_clothoid(turn: float) -> None:
    start, end = tensor(0.0, 0.0, 0.4), tensor(30.0, 0.0, -0.7)
    turned = tensor(30 * math.cos(turn), 30 * math.sin(turn), -0.7 + turn - 2 * math.pi)  # a whole turn says nothing
    one, other = hermite(start, end), hermite(start + tensor(0.0, 0.0, turn), turned)
    for a, b in zip(one[3:], other[3:], strict=True):
        assert b == pytest.approx(float(a), rel=1e-11)


def test_a_start_against_the_chord_is_one_whatever_its_sign() -> None:
    left, right = (hermite(tensor(0.0, 0.0, heading), tensor(9.0, 0.0, 0.3)) for heading in (math.pi, -math.pi))
    assert left[3:] == right[3:]


def test_points_are_those_of_fresnel_integrals() -> None:
    bent = WILD.rate.abs() * WILD.length**2 > 0.1  # else the closed form cancels
    assert bent.sum() > 300
    clothoids = Clothoid(*(number[bent] for number in WILD))
    arc = torch.linspace(-0.1, 1.1, 25, dtype=torch.float64) * clothoids.length[:, None]
    found = evaluate(clothoids, arc)
    x, y, heading, curvature, rate, size = (number.numpy()[:, None] for number in clothoids)
    unit, inflection = np.sqrt(math.pi / np.abs(rate)), -curvature / rate
    (s1, c1), (s0, c0) = fresnel((arc.numpy() - inflection) / unit), fresnel(-inflection / unit)
    ahead, aside = unit * (c1 - c0), np.sign(rate) * unit * (s1 - s0)  # of the heading at the inflection
    angle = heading - 0.5 * rate * inflection**2
    dx = found.x.numpy() - (x + ahead * np.cos(angle) - aside * np.sin(angle))
    dy = found.y.numpy() - (y + ahead * np.sin(angle) + aside * np.cos(angle))
    assert (np.hypot(dx, dy) / size).max() < 1e-9


def test_heading_and_curvature_are_derivatives() -> None:
    arc = torch.linspace(0.05, 0.95, 7, dtype=torch.float64) * ROADS.length[:, None]
    low, at, high = (evaluate(ROADS, arc + step) for step in (-1e-3, 0.0, 1e-3))
    torch.testing.assert_close((high.x - low.x) / 2e-3, torch.cos(at.heading), rtol=0.0, atol=1e-8)
    torch.testing.assert_close((high.y - low.y) / 2e-3, torch.sin(at.heading), rtol=0.0, atol=1e-8)
    torch.testing.assert_close((high.heading - low.heading) / 2e-3, at.curvature, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("num", [2, 20, 71])
def test_samples_are_as_near_as_simpson_promises(num: int) -> None:
    clothoids = ROADS if num < 71 else WILD
    at = evaluate(clothoids, torch.linspace(0, 1, num, dtype=torch.float64) * clothoids.length[:, None])
    found = sample(clothoids, num)
    torch.testing.assert_close(found.heading, at.heading, rtol=0.0, atol=1e-12)
    torch.testing.assert_close(found.curvature, at.curvature, rtol=1e-10, atol=1e-13)
    turn = at.curvature.abs().amax(1) * clothoids.length / (num - 1)
    error = torch.hypot(found.x - at.x, found.y - at.y).amax(1)
    # a rate adds terms to the fourth derivative, at most as many as the curvature itself where that is small
    twist = clothoids.rate.abs() * (clothoids.length / (num - 1)) ** 2
    assert (error <= clothoids.length * ((turn**4 + 6 * turn**2 * twist + 3 * twist**2) / 2880 + 1e-9)).all()


def test_two_metres_between_samples_of_a_road_are_enough() -> None:
    road = Clothoid(*tensor(0.0, 0.0, 0.0, 0.004, 4e-5, 140.0))
    at, found = evaluate(road, torch.linspace(0, 140, 71, dtype=torch.float64)), sample(road, 71)
    assert torch.hypot(found.x - at.x, found.y - at.y).max() < 3e-7


def test_feet_are_found_where_points_were_put() -> None:
    arc = torch.from_numpy(RNG.uniform(0, 1, (len(ROADS.x), 40))) * ROADS.length[:, None]
    at = evaluate(ROADS, arc)
    room = torch.clamp(0.9 / at.curvature.abs(), max=5.0)
    offset = torch.from_numpy(RNG.uniform(-1, 1, arc.shape)) * room
    points = torch.stack((at.x - offset * torch.sin(at.heading), at.y + offset * torch.cos(at.heading)), -1)
    found, left = project(ROADS, points)
    torch.testing.assert_close(found, arc, rtol=0.0, atol=1e-9)
    torch.testing.assert_close(left, offset, rtol=0.0, atol=1e-10)


def test_no_sample_is_nearer_than_the_foot() -> None:
    middle = torch.stack((WILD.x, WILD.y), -1)[:, None]
    points = middle + torch.from_numpy(RNG.normal(size=(len(WILD.x), 30, 2))) * 0.5 * WILD.length[:, None, None]
    _, offset = project(WILD, points)
    coarse = evaluate(WILD, torch.linspace(0, 1, FEET, dtype=torch.float64) * WILD.length[:, None])
    dx, dy = points[..., :1] - coarse.x[:, None], points[..., 1:] - coarse.y[:, None]  # (B, N, FEET)
    assert (offset.abs() <= torch.hypot(dx, dy).amin(-1) + 1e-9 * WILD.length[:, None]).all()


def test_beyond_its_ends_a_clothoid_goes_on_straight() -> None:
    bend = Clothoid(*tensor(1.0, 2.0, 0.3, 0.02, 1e-4, 50.0))
    last = evaluate(bend, tensor(50.0))
    for x, y, heading, along, arc in (
        (bend.x, bend.y, bend.heading, -7.0, -7.0),
        (last.x[0], last.y[0], last.heading[0], 9.0, 59.0),
    ):
        cos, sin = torch.cos(heading), torch.sin(heading)
        point = torch.stack((x + along * cos - 1.5 * sin, y + along * sin + 1.5 * cos))
        found, offset = project(bend, point[None])
        assert found[0] == pytest.approx(arc, abs=1e-9) and offset[0] == pytest.approx(1.5, abs=1e-9)


def fitted(ends: Tensor) -> Tensor:
    return torch.stack(hermite(ends[..., :3], ends[..., 3:])[3:], -1)


def sampled(ends: Tensor) -> Tensor:
    return torch.stack(sample(hermite(ends[..., :3], ends[..., 3:]), 5), -1)


def projected(ends: Tensor) -> Tensor:
    points = tensor([3.0, 1.0], [8.0, -0.5], [-2.0, 1.0], [13.0, 0.4])
    return torch.stack(project(hermite(ends[..., :3], ends[..., 3:]), points), -1)


@pytest.mark.parametrize("function", [fitted, sampled, projected])
@pytest.mark.parametrize("ends", [(0.0, 0.0, 0.2, 10.0, 1.0, -0.3), (0.0, 0.0, -2.0, 10.0, 1.0, -1.4)])
def test_derivatives_are_exact_to_second_order(function: Callable[[Tensor], Tensor], ends: tuple[float, ...]) -> None:
    at = tensor(*ends).requires_grad_()
    assert torch.autograd.gradcheck(function, at)
    assert torch.autograd.gradgradcheck(function, at)


def test_forward_derivatives_are_the_backward_ones() -> None:
    at = tensor(0.0, 0.0, 0.2, 10.0, 1.0, -0.3)
    torch.testing.assert_close(torch.func.jacfwd(fitted)(at), torch.func.jacrev(fitted)(at), rtol=1e-12, atol=1e-15)


BACK_TO_BACK = ((0.0, 0.0, math.pi), (9.0, 0.0, math.pi - 1e-9))


@pytest.mark.parametrize(
    ("start", "end", "says"),
    [
        ((1.0, 2.0, 0.3), (1.0, 2.0, 0.5), r"\[1\] from \(1, 2\) has its end 0 m away; more than 1e-06 m is needed"),
        ((0.0, math.nan, 0.0), (9.0, 0.0, 0.0), r"start\[1\] of a clothoid is \(0.0, nan, 0.0\); give finite x, y"),
        ((0.0, 0.0, 0.0), (9.0, 0.0, math.inf), r"end\[1\] of a clothoid is \(9.0, 0.0, inf\)"),
        (
            *BACK_TO_BACK,
            r"\[1\] from .* headings -?180.0 and 180.0 degrees off .* more than 8 chords long; turn a head",
        ),
    ],
)
def test_ends_without_a_sane_clothoid_are_refused_by_name(start: tuple, end: tuple, says: str) -> None:
    good = tensor((0.0, 0.0, 0.1)), tensor((5.0, 0.0, 0.2))
    starts, ends = torch.cat((good[0], tensor(start))), torch.cat((good[1], tensor(end)))
    with pytest.raises(InputError, match=says):
        hermite(starts, ends)


def test_refused_ends_leave_the_gradient_of_the_others_alone() -> None:
    starts = tensor((0.0, 0.0, 0.1), (1.0, 1.0, 0.0), (0.0, 0.0, math.nan), BACK_TO_BACK[0]).requires_grad_()
    ends = tensor((5.0, 0.0, 0.2), (1.0, 1.0, 0.0), (5.0, 0.0, 0.0), BACK_TO_BACK[1])
    found = hermite_or_inf(starts, ends)
    assert torch.isinf(found.length).tolist() == [False, True, True, True]
    sane = torch.isfinite(found.length)
    (gradient,) = torch.autograd.grad(torch.where(sane, found.length + found.curvature + found.rate, 0.0).sum(), starts)
    assert gradient.isfinite().all() and gradient[0].abs().sum() > 0 and (gradient[1:] == 0).all()


def test_batches_of_any_shape_are_what_their_members_are() -> None:
    start, end = random_ends(6, turn=1.0)
    found = hermite(start.reshape(2, 3, 3), end.reshape(2, 3, 3))
    points = torch.from_numpy(RNG.normal(size=(2, 3, 4, 2)))
    arc, offset = project(found, points)
    assert arc.shape == (2, 3, 4) and sample(found, 7).x.shape == (2, 3, 7)
    one = hermite(start[4], end[4])
    assert found.length[1, 1] == pytest.approx(float(one.length), rel=1e-14)
    torch.testing.assert_close(project(one, points[1, 1])[1], offset[1, 1], rtol=1e-12, atol=1e-12)


def test_the_benchmark_reports_its_figures(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pyclothoids", reason="the extra 'peers' is not installed")
    for name in THREADS:  # the command pins them: give the other tests theirs back
        monkeypatch.setenv(name, "1")
    monkeypatch.setattr(benchmark, "BATCH", 20)
    monkeypatch.setattr(benchmark, "REPEATS", 1)
    assert benchmark.main(["--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert all(found[key] > 0.0 for key in ("g1_us_batch", "pyclothoids_us", "g1_ratio", "sample_ratio"))
