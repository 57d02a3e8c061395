"""The bound of the lane error is that of the generator's own family, and answers to what is measured."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from benchmarks import lane_bound as bounds
from benchmarks.lane_bound import PRIOR_STD, displacements, lane_bound, true_courses
from experiments.scenarios import paths
from experiments.scenarios.interiors import bezier
from experiments.scenarios.protocol import ARM_LENGTH, _ends, _stub, protocol
from experiments.scenarios.scene import JunctionTruth
from models.intersection.course_lines import lane_nodes


@pytest.fixture(scope="module")
def truth() -> JunctionTruth:
    return protocol(3, tracks=1).truth


@pytest.fixture
def flat(monkeypatch: pytest.MonkeyPatch) -> None:
    """Priors that say nothing, but for a handle of a lane that hardly has an interior."""
    monkeypatch.setattr(bounds, "PRIOR_STD", dict.fromkeys(PRIOR_STD, 1e3))


def generated(truth: JunctionTruth, handles: np.ndarray) -> list[np.ndarray]:
    """Lines as the protocol draws them, with these handles (L, 2), before they are resampled."""
    lines = []
    for connection, handle in zip(truth.connections, handles, strict=True):
        a, entry, b, exit = connection
        start, end = _stub(truth, a, entry, +1, ARM_LENGTH), _stub(truth, b, exit, -1, ARM_LENGTH)
        lines.append(np.concatenate([start[None], bezier(_ends(truth, connection), handle), end[None]]))
    return lines


def moved(truth: JunctionTruth, share: float) -> Iterator[tuple[float, list[np.ndarray]]]:
    """(change, lines of the generator) with one unknown after another changed by a share of a natural step, in the
    order of PRIOR_STD."""
    ones = np.ones((len(truth.connections), 2))
    for field, step in (("centre", 1.0), ("angle", 0.02), ("gap", 1.0), ("radius", 1.0)):
        values = getattr(truth, field)
        for unit in np.eye(len(values)):
            yield share * step, generated(truth._replace(**{field: values + share * step * unit}), ones)
    for unit in np.eye(ones.size):
        yield share, generated(truth, ones + share * unit.reshape(ones.shape))


def aside(nodes: np.ndarray, line: np.ndarray) -> np.ndarray:
    """How far to the left of each node, (n,), the line crosses its normal."""
    out = []
    for x, y, ux, uy in nodes[:, :4]:
        apart = line - np.array([x, y])
        along, left = apart @ np.array([ux, uy]), apart @ np.array([-uy, ux])
        after = int(np.argmax((along[1:] >= 0) & (along[:-1] <= 0) & (np.abs(left[1:]) < 2.0))) + 1
        share = -along[after - 1] / (along[after] - along[after - 1])
        out.append(left[after - 1] + share * (left[after] - left[after - 1]))
    return np.array(out)


def test_displacements_are_those_of_the_generator(truth: JunctionTruth) -> None:
    evidence = true_courses(truth)
    lanes = [nodes[2:-2, :4] + np.array([*truth.centre, 0, 0]) for nodes in lane_nodes(evidence, {})]
    slopes = [slope[2:-2] for slope in displacements(evidence)]
    changes = list(zip(moved(truth, 0.01), moved(truth, -0.01), strict=True))
    assert {slope.shape[1] for slope in slopes} == {len(changes)}
    for column, ((step, more), (_, less)) in enumerate(changes):
        for lane, slope, one, other in zip(lanes, slopes, more, less, strict=True):
            numeric = (aside(lane, one) - aside(lane, other)) / (2 * step)
            tolerance = 0.003 * max(1.0, np.abs(numeric).max())  # polylines of 400 pieces
            np.testing.assert_allclose(slope[:, column], numeric, atol=tolerance)


def test_the_mean_variance_is_unknowns_over_points(truth: JunctionTruth, flat: None) -> None:
    """The leverages of n points sum up to the P unknowns, so that without priors the root of the mean variance is
    sqrt(P / n); the mean of roots is less, here by the difference of interiors and arms."""
    lengths = [paths.arc_length(line)[-1] for line in truth.lines]
    unknowns = 2 + 3 * len(truth.angle) + 2 * len(lengths)
    most = math.sqrt(2 / math.pi) * math.sqrt(unknowns / (4.0 * sum(lengths)))
    assert 0.8 * most < lane_bound(truth) < most


def test_four_times_the_tracks_halve_the_bound_where_priors_say_nothing(truth: JunctionTruth, flat: None) -> None:
    for heading_std in (None, 0.1):
        few, many = (lane_bound(truth, heading_std, tracks) for tracks in (4.0, 16.0))
        assert many == pytest.approx(few / 2, rel=1e-3)


def test_priors_and_headings_help_and_useless_headings_do_not(
    truth: JunctionTruth, monkeypatch: pytest.MonkeyPatch
) -> None:
    bound = lane_bound(truth)
    assert lane_bound(truth, 0.1) < 0.95 * bound
    assert lane_bound(truth, 100.0) == pytest.approx(bound, rel=1e-4)
    monkeypatch.setattr(bounds, "PRIOR_STD", PRIOR_STD | {"onset": 1e-6})
    assert lane_bound(truth) < 0.99 * bound


def test_without_a_point_only_what_priors_know_is_known(truth: JunctionTruth, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only a centre that is known within a centimetre on each axis: the whole junction moves with it."""
    monkeypatch.setattr(bounds, "PRIOR_STD", dict.fromkeys(PRIOR_STD, 1e-9) | {"centre": 0.01})
    assert lane_bound(truth, tracks_per_lane=0.0) == pytest.approx(0.01 * math.sqrt(2 / math.pi), rel=1e-3)


@pytest.mark.parametrize(("heading_std", "expected"), [(None, 0.041), (0.1, 0.035)])
def test_the_bound_of_the_protocol_is_that_of_another_program(heading_std: float | None, expected: float) -> None:
    """Numeric derivatives on 20 other scenes gave 4.1 and 3.5 cm; scenes differ by .3 cm, so means of 20 by .07."""
    found = [lane_bound(protocol(seed, tracks=1).truth, heading_std) for seed in range(20)]
    assert np.mean(found) == pytest.approx(expected, abs=3 * math.sqrt(2) * 0.0007)
