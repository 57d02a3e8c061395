"""Interiors join their stubs smoothly, and other families leave the frozen junctions alone."""

from __future__ import annotations

import hashlib
import math

import numpy as np
import pytest

from experiments.scenarios import paths
from experiments.scenarios.interiors import BUMP_STD, GENTLEST, LEVEL, Ends, bezier, bumped, clothoid, draw, fits
from experiments.scenarios.protocol import ARM_LENGTH, LINE_STEP, protocol
from models.program import InputError

OTHERS = ("clothoid", "bumps")


def ends_of(turn: float, before: float, behind: float) -> Ends:
    """Stubs whose axes meet at the origin, `before` and `behind` metres from them, after driving along y = x."""
    first = math.pi / 4
    ahead = np.array([math.cos(first), math.sin(first)])
    away = np.array([math.cos(first + turn), math.sin(first + turn)])
    return Ends(-before * ahead, behind * away, ahead, away, turn)


TURNS = [ends_of(math.radians(t), 12.0, 20.0) for t in (-125.0, -90.0, -30.0, 25.0, 80.0, 130.0)]
TURNS += [ends_of(math.radians(70.0), 25.0, 6.0)]


def courses(ends: Ends) -> dict[str, np.ndarray]:
    smooth = {f"clothoids {share}": clothoid(ends, share) for share in (0.2, 0.9)}
    smooth["bezier"] = bezier(ends, np.array([0.85, 1.15]))
    return smooth | {f"bumps on {name}": bumped(course, np.array([0.6, -0.4])) for name, course in smooth.items()}


@pytest.mark.parametrize("ends", TURNS)
def test_courses_begin_and_end_on_their_stubs_and_along_them(ends: Ends) -> None:
    """The first and the last of 400 steps turn by less than a third of a degree."""
    for name, course in courses(ends).items():
        np.testing.assert_allclose(course[[0, -1]], [ends.start, ends.end], atol=1e-9, err_msg=name)
        for step, direction in ((course[1] - course[0], ends.ahead), (course[-1] - course[-2], ends.away)):
            aside = step @ np.array([-direction[1], direction[0]]) / np.linalg.norm(step)
            assert abs(aside) < 0.006 and step @ direction > 0, name


@pytest.mark.parametrize("ends", TURNS)
def test_courses_have_no_kink(ends: Ends) -> None:
    """130 degrees in 400 steps are .006 rad each; the tightest place may have three times that."""
    for name, course in courses(ends).items():
        heading = np.unwrap(np.arctan2(*np.diff(course, axis=0).T[::-1]))
        assert heading[-1] - heading[0] == pytest.approx(ends.turn, abs=0.01), name
        assert np.abs(np.diff(heading)).max() < 0.02, name


def test_a_bend_of_clothoids_is_straight_then_curves_linearly_then_evenly() -> None:
    """Half of the curve clothoids: an arc in the middle half, curvature 4/3 of the mean, half of that an eighth in."""
    ends = ends_of(math.radians(80.0), 12.0, 20.0)
    course = clothoid(ends, 0.5)
    length = paths.arc_length(course)
    straight = np.abs((course - ends.end) @ np.array([-ends.away[1], ends.away[0]])) < 1e-6
    assert length[-1] - length[straight][0] == pytest.approx(8.0, abs=length[1])  # what the longer stub has left
    bend = length[straight][0]
    heading = np.unwrap(np.arctan2(*np.diff(course, axis=0).T[::-1]))
    curvature = np.gradient(heading, length[1])
    middle = (length[1:] + length[:-1]) / 2 / bend
    for place, share in ((1 / 8, 0.5), (1 / 4, 1.0), (1 / 2, 1.0), (7 / 8, 0.5)):
        expected = share * 4 / 3 * ends.turn / bend
        assert np.interp(place, middle, curvature) == pytest.approx(expected, rel=0.05)


def test_every_lane_of_a_bend_has_its_own_onset() -> None:
    onsets = []
    for behind in (8.0, 11.0, 14.0):
        ends = ends_of(math.radians(90.0), 14.0, behind)
        course = clothoid(ends, 0.4)
        off = np.abs((course - ends.start) @ np.array([-ends.ahead[1], ends.ahead[0]]))
        onsets.append(paths.arc_length(course)[off < 1e-6][-1])
    assert onsets == pytest.approx([6.0, 3.0, 0.0], abs=0.3)


def test_what_one_bend_cannot_join_stays_a_bezier_curve() -> None:
    gentle, behind = ends_of(0.9 * GENTLEST, 12.0, 12.0), ends_of(math.radians(60.0), 12.0, -1.0)
    sharp = ends_of(math.radians(60.0), 12.0, 12.0)
    assert [fits(e) for e in (gentle, behind, sharp)] == [False, False, True]
    ends = [gentle, behind, sharp]
    plain, other = (draw(kind, ends, np.random.default_rng(0)) for kind in ("bezier", "clothoid"))
    assert [np.array_equal(a, b) for a, b in zip(plain, other, strict=True)] == [True, True, False]


def test_bumps_have_the_stated_standard_deviation() -> None:
    """On a straight crossing: a in the middle, (a + 1.5 b / sqrt 2) / 2 after a quarter of the way.

    Standard error of a standard deviation from n draws: 1 / sqrt(2 n)."""
    ends = [Ends(np.zeros(2), np.array([30.0, 0.0]), np.array([1.0, 0.0]), np.array([1.0, 0.0]), 0.0)] * 4000
    drawn = draw("bumps", ends, np.random.default_rng(0))
    push = np.array([np.interp([7.5, 15.0], *course.T) for course in drawn])
    expected = [BUMP_STD * math.sqrt(1 + 1.5**2 / 2) / 2, BUMP_STD]
    assert BUMP_STD == 0.4
    assert push.std(0) == pytest.approx(expected, rel=4 / math.sqrt(2 * len(push)))
    assert np.abs(push.mean(0)).max() < 4 * BUMP_STD / math.sqrt(len(push))


def test_short_interiors_have_no_bumps() -> None:
    for length, flat in ((0.99 * LEVEL, True), (1.01 * LEVEL, False)):
        course = np.column_stack([np.linspace(0.0, length, 50), np.zeros(50)])
        assert np.array_equal(bumped(course, np.array([1.0, 0.0])), course) == flat


# In the protocol


@pytest.mark.parametrize(
    ("seed", "digest"),
    [(0, "b89deb4f14866ec9"), (42, "648f2b1cc61a1e91")],
)
def test_the_default_scenes_are_those_from_before_there_were_others(seed: int, digest: str) -> None:
    micrometres = np.round(1e6 * protocol(seed).data.points).astype(np.int64)
    assert hashlib.sha256(micrometres.tobytes()).hexdigest()[:16] == digest


@pytest.mark.parametrize("interior", OTHERS)
def test_another_interior_changes_nothing_but_itself(interior: str) -> None:
    plain, other = protocol(11).truth, protocol(11, interior=interior).truth
    for name in ("centre", "angle", "gap", "entries", "exits", "width", "radius", "connections", "track_lane"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(other, name))
    changed = []
    for before, after, entry in zip(plain.lines, other.lines, plain.connections[:, 0], strict=True):
        straight = int((ARM_LENGTH - plain.radius[entry]) / LINE_STEP)
        np.testing.assert_array_equal(before[:straight], after[:straight])
        assert np.linalg.norm(before[-1] - after[-1]) < LINE_STEP  # both stop within a step of the same end
        inside = slice(straight, straight + 40)
        changed.append(np.abs(before[inside] - after[inside]).max() > 1e-3)
    assert np.mean(changed) > 0.5


def test_bumps_are_those_of_the_same_clothoids() -> None:
    smooth, bumpy = (protocol(11, interior=interior).truth.lines for interior in OTHERS)
    apart = [np.abs(paths.at(bumpy[i], paths.arc_length(smooth[i])) - smooth[i]).max() for i in range(len(smooth))]
    assert 0.05 < np.median(apart) < 1.5


def test_an_unknown_interior_is_refused_with_the_known_ones() -> None:
    with pytest.raises(InputError, match="interior is 'bezir'; choose one of bezier, clothoid, bumps"):
        protocol(interior="bezir")  # type: ignore[arg-type]
