"""Knots of a road of pieces, told and drawn."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.road_figures import figures
from experiments.road_knots import knots_of
from experiments.scenarios.road import night_rural
from inference.posterior import Posterior


def roads(num_knots: list[int], knot: list[list[float]]) -> Posterior:
    """Straight roads with knots at these places, in any order; inactive slots last."""
    num, slots = len(num_knots), len(knot[0])
    draws = {"num_knots": np.array(num_knots), "knot": np.array(knot), "knot_curvature": np.zeros((num, slots))}
    draws |= {"start": np.tile([-10.0, 0.0, 0.0], (num, 1)), "curvature": np.zeros(num), "rate": np.zeros(num)}
    draws["offset"] = np.zeros((num, 1))
    return Posterior({name: values[None] for name, values in draws.items()}, model_index=draws["num_knots"][None])


TWO = roads([2, 1, 2, 2], [[90.0, 30.0, 1.0], [5.0, 2.0, 3.0], [40.0, 100.0, 2.0], [110.0, 50.0, 3.0]])


def test_places_are_told_in_order_given_the_most_probable_number() -> None:
    knots = knots_of(TWO)
    assert knots is not None
    assert knots.shares.tolist() == [0.0, 0.25, 0.75, 0.0] and knots.num == 2
    assert knots.middle == pytest.approx([40.0, 100.0])
    assert (knots.edges[0] < knots.middle).all() and (knots.edges[1] > knots.middle).all()
    assert str(knots) == "number of knots 1: 25 %, 2: 75 %"
    assert knots_of(Posterior({"course": np.zeros((1, 3, 6))})) is None


@pytest.mark.parametrize(("posterior", "num"), [(TWO, 2), (roads([0, 0, 1, 0], [[50.0]] * 4), 0)])
def test_knots_stand_on_the_road_with_their_stretches_below(posterior: Posterior, num: int) -> None:
    above = figures(posterior, night_rural(seed=0))["road"].axes[0]
    lines = {str(line.get_label()): line for line in above.get_lines()}
    assert ("knot: a clothoid ends" in lines) == ("90 % of its place" in lines) == (num > 0)
    assert "number of knots" in above.get_title(loc="left")
    if num:
        x, y = lines["knot: a clothoid ends"].get_data()
        assert x == pytest.approx(40.0 - 10.0, abs=1e-6) and y == pytest.approx(0.0, abs=1e-9)  # 10 m begin behind
