"""Traffic as a program: what a scan is as a set, and what objects do from frame to frame."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.objects.scan_set import FalseAlarms, ScanSet, log_sum_associations
from models.program import InputError, quiet_doubles

Floats = NDArray[np.float64]


def brute(detected: Floats, missed: Floats, clutter: Floats) -> float:
    """The sum over associations, one after the other."""
    num, count = detected.shape
    total = 0.0
    for theta in itertools.product(range(-1, count), repeat=num):
        taken = [j for j in theta if j >= 0]
        if len(set(taken)) == len(taken):
            weight = math.prod(missed[i] if j < 0 else detected[i, j] for i, j in enumerate(theta))
            total += weight * math.prod(clutter[j] for j in range(count) if j not in taken)
    return total


@pytest.mark.parametrize(("num", "count"), [(0, 0), (0, 3), (3, 0), (1, 1), (2, 4), (4, 2), (3, 3)])
def test_sum_over_associations_equals_enumeration(num: int, count: int) -> None:
    rng = np.random.default_rng(10 * num + count)
    detected, missed, clutter = rng.gamma(1.0, size=(num, count)), rng.random(num), rng.gamma(1.0, size=count)
    if num and count:
        detected[0, 0] = 0.0
    with np.errstate(divide="ignore"):
        logs = [torch.from_numpy(np.maximum(np.log(w), -1e9)) for w in (detected, missed, clutter)]
    found = float(log_sum_associations(*logs))
    assert found == pytest.approx(math.log(brute(detected, missed, clutter)), abs=1e-12)


def test_too_many_associations_are_refused() -> None:
    with pytest.raises(InputError, match="13 objects and 14 measurements"):
        log_sum_associations(torch.zeros(13, 14), torch.zeros(13), torch.zeros(14))


def on_a_line(detection: list[float], expected: float = 0.7) -> ScanSet:
    """Objects at 2, 5, ... of [0, 10], and false alarms there."""
    num = len(detection)
    with quiet_doubles():
        return ScanSet(
            2.0 + 3.0 * torch.arange(num, dtype=torch.float64)[:, None],
            torch.full((1, 1, 1), 0.04),
            torch.tensor(detection),
            torch.zeros(num, dtype=torch.long),
            FalseAlarms(expected, torch.zeros(1), torch.full((1,), 10.0)),
            lambda z: torch.where((z[..., 0] > 0) & (z[..., 0] < 10), expected / 10.0, 0.0),
            torch.full((1,), math.inf),
            1,
        )


def rows(z: Tensor) -> Tensor:
    """Scans (*, M) of one number each."""
    return torch.stack([torch.ones_like(z), z, torch.ones_like(z)], -1)


def test_set_density_is_normalised() -> None:
    seen = on_a_line([0.8, 0.6])
    grid = 0.05 + 0.1 * torch.arange(100, dtype=torch.float64)  # the middle of 100 cells of [0, 10]
    total = float(seen.log_prob(rows(torch.zeros(0, dtype=torch.float64))).exp())
    for count in (1, 2):
        z = torch.cartesian_prod(*[grid] * count).reshape(-1, count)
        total += float(seen.log_prob(rows(z)).exp().sum()) * 0.1**count / math.factorial(count)
    # three and more measurements: by the number alone, which is that of two detections and a Poisson variable
    poisson = [math.exp(-0.7) * 0.7**k / math.factorial(k) for k in range(40)]
    number = [0.2 * 0.4, 0.8 * 0.4 + 0.2 * 0.6, 0.8 * 0.6]
    rest = 1.0 - sum(number[a] * poisson[k] for a in range(3) for k in range(3 - a))
    assert total + rest == pytest.approx(1.0, abs=1e-6)  # of the middle rule on normals of two cells' width
