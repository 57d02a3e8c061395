"""Road courses of several engines beside one another."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.road_bands import figures
from experiments.road_metrics import RANGES
from experiments.scenarios.road import night_road
from inference.posterior import Posterior

SCENE = night_road(0)


def moved(aside: float) -> Posterior:
    """The true course moved to the left, and draws within a metre of it."""
    course = np.repeat(SCENE.truth["course"][None], 101, 0)
    course[:, [1, 4]] += aside + np.linspace(-1.0, 1.0, 101)[:, None]
    return Posterior({"course": course[None]})


def test_each_engine_has_a_panel_with_its_estimate_to_the_left_of_the_truth() -> None:
    panels = figures({"one": moved(0.0), "two": moved(2.0)}, SCENE)["courses"].axes
    assert [axes.get_title(loc="left") for axes in panels] == ["one, on night_road 0", "two, on night_road 0"]
    for axes, aside in zip(panels, (0.0, 2.0), strict=True):
        (line,) = [line for line in axes.lines if line.get_label() == "estimate"]
        assert line.get_xdata() == pytest.approx(RANGES)
        left = np.asarray(line.get_ydata())
        tilt = np.cos(SCENE.truth["line"][:, 2])  # moved along y, measured across the road
        assert np.all(left >= aside * tilt.min() - 0.02) and np.all(left <= aside + 0.02)
        band = axes.collections[0].get_paths()[0].vertices
        assert band[:, 1].max() == pytest.approx(aside + 0.9, abs=0.1)


def test_without_a_truth_the_first_estimate_is_zero_and_without_a_course_there_is_nothing() -> None:
    unknown = SCENE._replace(truth=None)
    first = figures({"one": moved(1.0)}, unknown)["courses"].axes[0]
    (line,) = [line for line in first.lines if line.get_label() == "estimate"]
    assert np.abs(np.asarray(line.get_ydata())).max() < 0.02  # drawn between points five metres apart
    assert figures({"none": Posterior({"z": np.zeros((1, 2))})}, SCENE) == {}
