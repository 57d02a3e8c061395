"""Uniform cubic B-splines against scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from models.spline import ORDER, basis, evaluate, spline_bows

FIRST, SPACING, NUM = -3.0, 0.7, 9
LAST = FIRST + SPACING * (NUM - ORDER + 1)
KNOTS = FIRST + SPACING * np.arange(-3, NUM + 1)
CONTROLS = np.random.default_rng(0).normal(size=NUM)
X = np.linspace(FIRST, LAST, 101)


def test_values_are_those_of_scipy() -> None:
    np.testing.assert_allclose(evaluate(CONTROLS, FIRST, SPACING, X), BSpline(KNOTS, CONTROLS, 3)(X), atol=1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_derivatives_are_those_of_scipy(order: int) -> None:
    pieces, _, rows = basis(X, FIRST, SPACING, NUM)
    if order == 2:
        for x, row in zip(X, rows, strict=True):
            spline_bows(x, FIRST, SPACING, NUM, row)
    mine = (CONTROLS[pieces[:, None] + np.arange(ORDER)] * rows).sum(1)
    inside = np.arange(1, len(X) - 1)  # scipy takes the last knot from the outside
    np.testing.assert_allclose(mine[inside], BSpline(KNOTS, CONTROLS, 3).derivative(order)(X)[inside], atol=1e-11)


def test_controls_on_a_straight_line_give_that_line_beyond_the_knots_too() -> None:
    middles = FIRST + SPACING * np.arange(-1, NUM - 1)
    x = np.linspace(FIRST - 2.0, LAST + 2.0, 50)
    np.testing.assert_allclose(evaluate(0.3 - 1.7 * middles, FIRST, SPACING, x), 0.3 - 1.7 * x, atol=1e-12)
