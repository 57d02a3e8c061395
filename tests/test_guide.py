"""Guides of a frame: which modes count as two, which are left out, and what a number that stands still needs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from inference import guide
from models.capability import GaussianStep

Array = np.ndarray[Any, Any]
SHARP = 3.0  # information of each mode: with the unit prior a precision of 4, so half a unit is a standard deviation


def offered(heights: dict[float, float], monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Where the guides are that `fit` keeps of modes {place: height} found in turn by a search about N(0, 1)."""
    places = iter(list(heights.items()) * guide.NUM_STARTS)

    def climb(whole: GaussianStep, x: Array) -> guide.Guide:
        at, height = next(places)
        return guide.Guide(np.array([at]), height, np.zeros(1), np.array([[SHARP]]))

    monkeypatch.setattr(guide, "climb", climb)
    still = lambda z: np.zeros(len(z))  # noqa: E731
    step = GaussianStep(np.zeros((1, 1)), np.eye(1), still, lambda z: (0.0, z, np.eye(1)), lambda z: {})
    return [float(one.at[0]) for one in guide.fit(step, np.zeros(1), np.random.default_rng(0))]


def test_two_modes_are_a_standard_deviation_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    assert offered({0.0: 0.0, 0.45: 0.0}, monkeypatch) == [0.0]
    assert offered({0.0: 0.0, 0.55: 0.0}, monkeypatch) == [0.0, 0.55]


def test_a_mode_of_no_mass_is_left_to_the_unguided_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Modes at the same distance from the prior differ in mass as they do in height."""
    assert offered({-2.0: 0.0, 2.0: -9.0}, monkeypatch) == [-2.0, 2.0]
    assert offered({-2.0: 0.0, 2.0: -11.0}, monkeypatch) == [-2.0]


@pytest.mark.parametrize("tril", [np.zeros((2, 2)), np.array([[1.0, 0.0], [2.0, 0.0]])], ids=["all", "one of two"])
def test_numbers_that_stand_still_are_not_moved_by_the_guide(tril: Array) -> None:
    """A reading pulls with a slope of 100 both numbers of a cloud that cannot move, or only along (1, 2)."""
    mean, reading = np.array([1.0, 2.0]), np.array([2.0, 1.0])
    density = lambda z: -50.0 * np.square(z - reading).sum(-1)  # noqa: E731
    slopes = lambda z: (float(density(z)), -100.0 * (z - reading), 100.0 * np.eye(2))  # noqa: E731
    step = GaussianStep(mean[None], tril, density, slopes, lambda z: {})
    (found,) = guide.fit(step, np.zeros(1), np.random.default_rng(0))
    along, pull = tril[:, 0], 100.0 * (reading - mean)
    moved = found.at - mean
    step_left = 0.05 * np.linalg.norm(along) / np.sqrt(1.0 + 100.0 * along @ along)  # for TOLERANCE [nats] are left
    np.testing.assert_allclose(moved, along * (along @ pull) / (1.0 + 100.0 * along @ along), atol=step_left + 1e-6)
    assert abs(moved[1] - 2.0 * moved[0]) < 1e-6  # across (1, 2)
