"""The compiled clothoid equals the torch one."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from models.clothoid import Clothoid, hermite_or_inf, sample
from models.clothoid_kernel import COLUMNS, LENGTH, hermite_one, sample_one

NUM = 40
RNG = np.random.default_rng(0)
SCALE = np.array([100.0, 100.0, math.pi])
STARTS, ENDS = RNG.uniform(-1, 1, (300, 3)) * SCALE, RNG.uniform(-1, 1, (300, 3)) * SCALE
FOUND = hermite_or_inf(torch.from_numpy(STARTS), torch.from_numpy(ENDS))


def compiled(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    out = np.full(6, np.nan)
    hermite_one(*start, *end, out)
    return out


def test_the_fit_equals_the_torch_one() -> None:
    mine = np.array([compiled(start, end) for start, end in zip(STARTS, ENDS, strict=True)])
    assert 0 < np.isinf(mine[:, LENGTH]).sum() < 20, "some pairs must be refused for the comparison to be whole"
    np.testing.assert_allclose(mine, torch.stack(FOUND, -1).numpy(), rtol=1e-10, atol=1e-12)


def test_samples_equal_the_torch_ones() -> None:
    joined = torch.isfinite(FOUND.length)
    clothoids = Clothoid(*(number[joined] for number in FOUND))
    points = sample(clothoids, NUM)
    arc = torch.linspace(0.0, 1.0, NUM, dtype=torch.float64) * clothoids.length[:, None]
    direction = (points.heading, torch.cos(points.heading), torch.sin(points.heading))
    expected = torch.stack([points.x, points.y, *direction, points.curvature, arc], -1)
    for i, numbers in enumerate(torch.stack(clothoids, -1).numpy()):
        table = np.empty((NUM, COLUMNS))
        assert sample_one(numbers, table) == pytest.approx(numbers[LENGTH] / (NUM - 1), rel=1e-12)
        np.testing.assert_allclose(table, expected[i].numpy(), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ((1.0, 2.0, 0.3), (1.0, 2.0, 0.5)),
        ((0.0, 0.0, math.nan), (9.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (math.inf, 0.0, 0.0)),
        ((0.0, 0.0, math.pi), (9.0, 0.0, math.pi - 1e-9)),
    ],
)
def test_ends_that_no_sane_clothoid_joins_get_length_inf_and_no_error(start: tuple, end: tuple) -> None:
    found = hermite_or_inf(torch.tensor(start, dtype=torch.float64), torch.tensor(end, dtype=torch.float64))
    for length, curvature, rate in ((found.length, found.curvature, found.rate), compiled(start, end)[[5, 3, 4]]):
        assert math.isinf(length) and curvature == 0.0 and rate == 0.0
