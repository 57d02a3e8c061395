"""Perception capability by Dempster and Shafer, worked by hand."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest

from models.objects.perception import (
    Masses,
    capability,
    combined,
    hidden_by_any,
    hidden_share,
    hindrance,
    probability,
)

OPS = SimpleNamespace(
    **{name: getattr(math, name) for name in ("sqrt", "atan2", "tanh", "fabs")},
    fmin=min,
    fmax=max,
    where=lambda condition, a, b: a if condition else b,
)


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        # K = .6 * .5 = .3: detects (.6 * .5) / .7, does not (.1 * .5 + .3 * .5 + .1 * 0) / .7, either (.3 * .5) / .7
        (Masses(0.6, 0.1, 0.3), Masses(0.0, 0.5, 0.5), Masses(3 / 7, 2.5 / 7, 1.5 / 7)),
        # K = .9 * .6 + .1 * .3 = .57: .9 * .3 + .9 * .1 = .36, .1 * .6 + .1 * .1 = .07, nothing left to doubt
        (Masses(0.9, 0.1, 0.0), Masses(0.3, 0.6, 0.1), Masses(36 / 43, 7 / 43, 0.0)),
        # ignorance changes nothing
        (Masses(0.2, 0.5, 0.3), Masses(0.0, 0.0, 1.0), Masses(0.2, 0.5, 0.3)),
    ],
)
def test_dempsters_rule_by_hand(a: Masses, b: Masses, expected: Masses) -> None:
    assert combined(a, b, OPS) == pytest.approx(expected, abs=1e-15)
    assert combined(b, a, OPS) == pytest.approx(expected, abs=1e-15)


def test_order_of_conditions_does_not_matter() -> None:
    conditions = [Masses(*np.random.default_rng(i).dirichlet(np.ones(3)).tolist()) for i in range(3)]
    found = [combined(combined(a, b, OPS), c, OPS) for a, b, c in itertools.permutations(conditions)]
    a, b, c = conditions
    for other in [*found[1:], combined(a, combined(b, c, OPS), OPS)]:
        assert other == pytest.approx(found[0], abs=1e-14)
    assert sum(found[0]) == pytest.approx(1.0)


def test_doubt_counts_half() -> None:
    assert probability(Masses(0.5, 0.2, 0.3)) == pytest.approx(0.65)
    assert probability(capability(0.9, 0.2)) == pytest.approx(0.9)
    assert probability(combined(capability(0.9, 0.0), hindrance(0.5), OPS)) == pytest.approx(0.45 / 0.55)
    # what is in doubt gives way: (.8, 0, .2) and (0, .5, .5), K = .4: detects .4, does not .1, either .1 of .6
    assert probability(combined(capability(0.9, 0.2), hindrance(0.5), OPS)) == pytest.approx(0.45 / 0.6)


def test_total_conflict_detects_nothing() -> None:
    assert combined(Masses(1.0, 0.0, 0.0), Masses(0.0, 1.0, 0.0), OPS) == (0.0, 1.0, 0.0)
    assert probability(combined(capability(1.0, 0.0), hindrance(1.0), OPS)) == 0.0


def test_what_stands_behind_is_hidden() -> None:
    at = (0.0, 0.0)

    def share(
        x: tuple[float, float], other: tuple[float, float], radius: float = 1.0, other_radius: float = 1.0
    ) -> float:
        return float(hidden_share(x, at, radius, other, other_radius, OPS))

    assert share((40.0, 0.0), (20.0, 0.0)) == pytest.approx(1.0)
    assert share((20.0, 0.0), (40.0, 0.0)) < 1e-9  # the nearer one is not
    assert share((40.0, 0.0), (0.0, 20.0)) == 0.0
    assert share((0.0, -40.0), (0.1, 20.0)) == 0.0  # nor what is on the other side
    half = 40.0 * math.tan(math.atan(1.0 / 20.0))  # the edge of the nearer one goes through the middle of the other
    assert share((40.0, half), (20.0, 0.0)) == pytest.approx(0.5, abs=2e-3)
    behind = (20.0 + 1.5, 0.0)  # as far behind the other as that is wide: half of it is taken to be behind
    assert share(behind, (20.0, 0.0), other_radius=1.5) == pytest.approx(0.5, abs=1e-6)
    # a thin post hides the share of the angle that it takes
    thin = math.atan(0.1 / 20.0) / math.atan(1.0 / 40.0)
    assert share((40.0, 0.0), (20.0, 0.0), other_radius=0.1) == pytest.approx(thin)


def test_several_hide_independently_as_surely_as_they_exist() -> None:
    shares, existence = np.array([[0.5, 0.4]]), np.array([1.0, 0.5])
    assert hidden_by_any(shares, existence) == pytest.approx([1.0 - 0.5 * 0.8])
