"""The least-squares clothoid: exact on exact points, unbiased and calibrated on noisy ones."""

from __future__ import annotations

import math
from functools import cache

import pytest
import torch
from scipy.stats import f as ratio_of_variances
from torch import Tensor

from models.clothoid import Clothoid, evaluate, hermite, project
from models.clothoid_fit import ClothoidFit, _feet, _moved, _slopes, fit
from models.program import InputError

FITS, STD = 300, 0.3


def clothoid(*numbers: float) -> Clothoid:
    return Clothoid(*(torch.tensor(number, dtype=torch.float64) for number in numbers))


def points_on(line: Clothoid, num: int) -> Tensor:
    at = evaluate(line, torch.linspace(0, 1, num, dtype=torch.float64) * line.length[..., None])
    return torch.stack((at.x, at.y), -1)


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


SHAPES = {
    "straight": clothoid(5.0, 3.0, 1.0, 0.0, 0.0, 80.0),
    "circle": clothoid(0.0, 0.0, 3.1, 0.02, 0.0, 250.0),
    "s_bend": clothoid(0.0, 0.0, -2.0, -0.03, 6e-4, 100.0),
    "road_of_a_map": clothoid(4.5e5, 5.4e6, 0.3, 2e-3, 2e-5, 140.0),
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("num", [9, 200])
def test_exact_points_give_their_clothoid(name: str, num: int) -> None:
    true = SHAPES[name]
    points = points_on(true, num)
    found = fit(points)
    rounding = 1e-15 * float(points.abs().max())  # of the points themselves
    units = torch.tensor([1.0, 1.0, 1.0, 0.01, 1e-4, 1.0], dtype=torch.float64)
    error = torch.stack(found.clothoid) - torch.stack(true)
    error[2] = torch.remainder(error[2] + math.pi, 2 * math.pi) - math.pi
    assert (error.abs() < (1e-9 + 10 * rounding) * units).all()
    assert found.std < 1e-11 + 10 * rounding


def test_four_points_fix_a_clothoid() -> None:
    true = SHAPES["s_bend"]
    found = fit(points_on(true, 4), std=0.1)
    torch.testing.assert_close(torch.stack(found.clothoid), torch.stack(true), rtol=1e-9, atol=1e-9)


@cache
def simulated(std: float | None) -> tuple[ClothoidFit, Tensor]:
    """Fits of noisy points on one road and their errors (FITS, 4), each against the road beside its start."""
    true = clothoid(0.0, 0.0, 0.2, 0.004, 1e-4, 120.0)
    found = fit(points_on(true, 40) + STD * noise(FITS, 40), std)
    start = found.clothoid
    every = Clothoid(*(number.expand(FITS) for number in true))
    # a road from before its start: feet may lie there
    arc, offset = project(_from(every, -20.0), torch.stack((start.x, start.y), -1)[:, None])
    arc = arc - 20.0
    beside = evaluate(every, arc)
    error = (offset, start.heading[:, None] - beside.heading, start.curvature[:, None] - beside.curvature)
    return found, torch.cat((*error, (start.rate - true.rate)[:, None]), 1)


def _from(line: Clothoid, arc: float) -> Clothoid:
    at = evaluate(line, torch.full_like(line.x, arc)[:, None])
    return Clothoid(at.x[:, 0], at.y[:, 0], at.heading[:, 0], at.curvature[:, 0], line.rate, line.length - arc)


def squared_distance(found: ClothoidFit, error: Tensor) -> Tensor:
    return (error * torch.linalg.solve(found.covariance, error)).sum(1)


@pytest.mark.parametrize("std", [STD, None])
def test_errors_are_unbiased_and_as_wide_as_the_covariance_says(std: float | None) -> None:
    found, error = simulated(std)
    score = error / found.covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert (score.mean(0).abs() < 4 / math.sqrt(FITS)).all()
    freedom = 40 - 4  # an estimated std makes the scores Student's
    variance, kurtosis = (1.0, 3.0) if std else (freedom / (freedom - 2), 3.0 + 6 / (freedom - 4))
    assert ((score.var(0) / variance - 1).abs() < 4 * math.sqrt((kurtosis - 1) / FITS)).all()
    distance = squared_distance(found, error) / 4
    for level in (0.5, 0.9):
        limit = ratio_of_variances.ppf(level, 4, 1e9 if std else freedom)
        inside = (distance < limit).double().mean()
        assert abs(inside - level) < 3.5 * math.sqrt(level * (1 - level) / FITS)


def test_the_estimated_std_is_that_of_the_noise() -> None:
    found, _ = simulated(None)
    assert abs((found.std**2).mean() / STD**2 - 1) < 4 * math.sqrt(2 / 36 / FITS)
    torch.testing.assert_close(found.offset.norm(dim=1) / 6.0, found.std)


def test_slopes_are_derivatives_of_the_offsets() -> None:
    line = SHAPES["s_bend"]
    points = points_on(line, 12) + noise(12)
    arc, _ = _feet(line, points, torch.linspace(0, 1, 12, dtype=torch.float64) * line.length)
    for k, (step, slopes) in enumerate(zip((1e-4, 1e-5, 1e-7, 1e-9), _slopes(line, arc).T, strict=True)):
        z = torch.zeros(4, dtype=torch.float64)
        z[k] = step
        (_, high), (_, low) = (_feet(_moved(line, sign * z), points, arc) for sign in (1, -1))
        torch.testing.assert_close((high - low) / (2 * step), slopes, rtol=1e-5, atol=1e-6 * float(slopes.abs().max()))


def test_no_neighbour_is_nearer_to_the_points() -> None:
    points = points_on(SHAPES["circle"], 50) + noise(50)
    found = fit(points)
    best = found.offset.norm()
    for k, sd in enumerate(found.covariance.diagonal().sqrt()):
        for sign in (-0.01, 0.01):
            z = torch.zeros(4, dtype=torch.float64)
            z[k] = sign * sd
            assert _feet(_moved(found.clothoid, z), points, found.arc)[1].norm() > best


def test_feet_and_offsets_are_those_of_the_points() -> None:
    points = points_on(SHAPES["s_bend"], 30) + 0.2 * noise(30)
    found = fit(points)
    arc, offset = project(found.clothoid, points)
    torch.testing.assert_close(found.arc, arc, rtol=0.0, atol=1e-8)
    torch.testing.assert_close(found.offset, offset, rtol=0.0, atol=1e-8)
    assert found.arc.min() == pytest.approx(0.0, abs=1e-8)
    assert found.arc.max() == pytest.approx(float(found.clothoid.length), abs=1e-8)


def test_random_roads_are_followed_within_their_noise() -> None:
    generator = torch.Generator().manual_seed(1)
    ends = (torch.rand(FITS, 2, generator=generator, dtype=torch.float64) - 0.5) * 3.0
    start = torch.nn.functional.pad(ends[:, :1], (2, 0))
    end = torch.nn.functional.pad(ends[:, 1:], (2, 0)) + torch.tensor([100.0, 0.0, 0.0], dtype=torch.float64)
    true = hermite(start, end)
    found = fit(points_on(true, 40) + 0.5 * noise(FITS, 40, seed=2), 0.5)
    _, offset = project(true, points_on(found.clothoid, 20))
    assert offset.abs().amax() < 0.5 * 4.5  # the ends of the worst of many roads


def good(num: int = 20) -> Tensor:
    return points_on(SHAPES["circle"], num)


@pytest.mark.parametrize(
    ("points", "std", "says"),
    [
        (good(3), 0.1, "needs 4 points, but has 3"),
        (good(4), None, "needs 5 points, or four and their std, but has 4"),
        (good()[:, :1], None, r"shape \(\*B, N, 2\), but these are \(20, 1\)"),
        (good().index_fill(0, torch.tensor(7), math.nan), None, r"point \[7\] of a clothoid fit is \(nan, nan\)"),
        (good(), -1.0, "std of a clothoid fit is -1.0 m; give a positive number"),
        (good()[:1].expand(20, 2), None, "points that stand still or turn back; give points in the order of travel"),
        (torch.cat((good(), good().flip(0))), None, "stand still or turn back"),
        (
            torch.stack((good(), good()[torch.arange(20) * 7 % 20])),
            None,
            r"fit\[1\] has points that stand still or turn back",
        ),
    ],
)
def test_points_that_make_no_clothoid_are_refused(points: Tensor, std: float | None, says: str) -> None:
    with pytest.raises(InputError, match=says):
        fit(points, std)
