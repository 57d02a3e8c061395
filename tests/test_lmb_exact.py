"""The labeled multi-Bernoulli filter against its labelled posterior by enumeration: exact where it is exact, and by how
much it is wrong where it approximates."""

from __future__ import annotations

import math

import numpy as np
import pytest

from inference.lmb import STRIDE, Belief, Knobs, step
from models.multi_object import Bernoullis, no_objects
from tests.line_objects import Answer, Gaussian, Line, LineScan, density, enumerate_posterior, prior_of, scan_at

ALL = Knobs(gate=math.inf, least=0.0, merge=0.0, most=100_000, faint=1e-300)  # nothing is left out
NUMBERS = np.random.default_rng(5)
POINTS = NUMBERS.normal((1.0, 0.0), (3.0, 2.0), (40, 2))


def filtered(
    model: Line, prior: Bernoullis, scans: list[LineScan], knobs: Knobs = ALL
) -> tuple[list[Bernoullis], float]:
    """What is believed after each scan, and the sum of the log factors."""
    belief, total, found = Belief(0.0, prior), 0.0, list[Bernoullis]()
    for number, scan in enumerate(scans):
        belief, facts = step(model, belief, scan, number, knobs)
        total += facts.log_factor
        found.append(belief.objects)
    return found, total


def parts_of(objects: Bernoullis, label: int) -> list[Gaussian]:
    t = objects.label.tolist().index(label)
    offset, *parts = objects.components
    rows = zip(*(part[offset[t] : offset[t + 1]] for part in parts), strict=True)
    return [Gaussian(float(objects.existence[t] * w), int(k), m, P) for w, k, m, P in rows]


def assert_same(objects: Bernoullis, answer: Answer) -> None:
    """Existence, and the density of each kind: all that a label's marginal is."""
    for label in answer.objects:
        exact = answer.existence(label)
        if label not in objects.label:
            assert exact == pytest.approx(0.0, abs=1e-15)
            continue
        found = parts_of(objects, label)
        assert sum(part.weight for part in found) == pytest.approx(exact, abs=1e-11)
        for kind in range(2):
            expected = density(answer.objects[label], kind, POINTS)
            np.testing.assert_allclose(density(found, kind, POINTS), expected, rtol=1e-7, atol=1e-11)
    assert set(objects.label.tolist()) <= set(answer.objects)


@pytest.mark.parametrize("places", [(), (0.3,), (0.3, 2.0), (-0.5, 1.1, 2.0), (1.0, 1.0, 9.0)])
@pytest.mark.parametrize("unseen", [0.0, 0.4])
def test_first_update_from_independent_objects_is_exact(places: tuple[float, ...], unseen: float) -> None:
    model, prior = Line(unseen_number=unseen), prior_of((0.0, 1.5), (0.7, 0.45))
    scans = [scan_at(0.4, places, (0.5, 3.0, 1.0)[: len(places)])]
    (objects,), log_sum = filtered(model, prior, scans)
    answer = enumerate_posterior(model, 0.0, prior, scans, STRIDE)
    assert_same(objects, answer)
    assert log_sum == pytest.approx(answer.log_sum, abs=1e-11)
    assert len(objects.label) == 2 + len(places) * (unseen > 0.0)


def test_one_object_in_clutter_is_exact_over_scans() -> None:
    model, prior = Line(), prior_of((0.0,), (0.6,))
    scans = [scan_at(0.3, (0.2, 1.5), (1.0, 2.0)), scan_at(0.8, (0.9,)), scan_at(1.0, (-1.0, 0.8), (0.3, 1.0))]
    steps, log_sum = filtered(model, prior, scans)
    for number, objects in enumerate(steps):
        answer = enumerate_posterior(model, 0.0, prior, scans[: number + 1], STRIDE)
        assert_same(objects, answer)
    assert log_sum == pytest.approx(answer.log_sum, abs=1e-11)


def test_one_object_is_exact_over_a_long_gap() -> None:
    """Motion is linear, so that ten steps of a second are one of ten."""
    model, prior = Line(), prior_of((0.0,), (0.6,))
    scans = [scan_at(0.3, (0.2, 1.5)), scan_at(10.3, (4.0,))]
    (_, objects), _ = filtered(model, prior, scans)
    assert_same(objects, enumerate_posterior(model, 0.0, prior, scans, STRIDE))


def test_objects_far_from_each_other_are_exact_over_scans() -> None:
    model, prior = Line(clutter=0.01), prior_of((-500.0, 0.0), (0.5, 0.8))
    scans = [scan_at(t, (-500.0 + t, 0.3 - t, 0.9)) for t in (0.3, 0.7)]
    steps, log_sum = filtered(model, prior, scans)
    answer = enumerate_posterior(model, 0.0, prior, scans, STRIDE)
    assert_same(steps[-1], answer)
    assert log_sum == pytest.approx(answer.log_sum, abs=1e-9)


def test_new_object_alone_is_exact_over_scans() -> None:
    """One measurement in each scan: the second is of the object that the first showed, or shows another."""
    model = Line(unseen_number=0.4)
    scans = [scan_at(0.0, (0.2,), (2.0,)), scan_at(0.3, (0.4,))]
    steps, _ = filtered(model, no_objects(2), scans)
    assert_same(steps[-1], enumerate_posterior(model, 0.0, no_objects(2), scans, STRIDE))


def errors(model: Line, prior: Bernoullis, scans: list[LineScan]) -> tuple[float, float]:
    """Largest errors of existence, and of the mean place of what is probable in standard deviations."""
    steps, _ = filtered(model, prior, scans)
    answer, objects = enumerate_posterior(model, 0.0, prior, scans, STRIDE), steps[-1]
    existence, place = 0.0, 0.0
    for label, parts in answer.objects.items():
        exact = answer.existence(label)
        found = parts_of(objects, label) if label in objects.label else []
        total = sum(part.weight for part in found)
        existence = max(existence, abs(total - exact))
        if exact > 0.1:
            (m, v), (n, _) = moments(parts), moments(found)
            place = max(place, abs(n - m) / math.sqrt(v))
    return existence, place


def moments(parts: list[Gaussian]) -> tuple[float, float]:
    w = np.array([part.weight for part in parts])
    m, P = np.array([part.mean[0] for part in parts]), np.array([part.covariance[0, 0] for part in parts])
    mean = float(w @ m / w.sum())
    return mean, float(w @ (P + np.square(m - mean)) / w.sum())


def test_error_of_the_approximation_in_later_scans() -> None:
    """Two objects two metres apart, two measurements a scan, 12 windows: what forgetting who goes with whom does.

    Found: existence is wrong by .026 after two scans and .033 after three, in the mean over windows of the worst label
    (.071 and .096 at worst); means of places by .16 and .19 standard deviations (.44 and .30)."""
    found = np.empty((12, 3, 2))
    for seed in range(len(found)):
        rng = np.random.default_rng(seed)
        model, prior = Line(unseen_number=0.2 * (seed % 2)), prior_of((0.0, 2.0), (0.8, 0.6))
        scans = [scan_at(t, rng.normal((0.3, 2.0), 0.8).tolist()) for t in (0.4, 0.8, 1.2)]
        found[seed] = [errors(model, prior, scans[: 1 + k]) for k in range(3)]
    assert found[:, 0].max() < 1e-12
    assert (found[:, 1:].max((0, 1)) < (0.1, 0.45)).all()
    assert (found[:, 1:].mean((0, 1)) < (0.032, 0.18)).all()
    assert (found[:, 1:].mean((0, 1)) > (0.02, 0.1)).all()  # it is an approximation
