"""Relations of road users to lanes and where they will be: exact on small maps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from models.program import InputError
from planning.road import Lane, even, no_tracks, route
from planning.situation import NO_LANE, Situation, along, network, predict, relations
from tests.small_streets import WIDTH, User, arc, crossing, straight, tracks, two_way

TIMES = 0.05 * np.arange(1, 61)
ROADS = network(two_way())
# a lane that forks into one ahead and one that turns left
FORK = network(
    {
        1: straight(0.0, 0.0, 50.0, 0.0, successors=(2, 3)),
        2: straight(50.0, 0.0, 150.0, 0.0),
        3: arc(50.0, 20.0, 20.0, -math.pi / 2, math.pi / 2),
    }
)


def chances(user: User, std: float = 0.1) -> list[float]:
    """Of lane 1, lane 2 and none."""
    return relations(ROADS, tracks([user], std=std)).probability[0].tolist()


def test_in_the_middle_of_a_lane_a_track_is_on_it() -> None:
    assert chances(User(100.0, 0.0)) == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    assert chances(User(100.0, WIDTH, math.pi)) == pytest.approx([0.0, 1.0, 0.0], abs=1e-9)
    assert chances(User(100.0, 20.0)) == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)


def test_on_the_border_it_is_on_either_side_by_the_mass_of_its_place() -> None:
    """Beyond the border there is no lane of its direction."""
    on = norm.cdf((WIDTH / 2 - 1.6) / 0.4) - norm.cdf((-WIDTH / 2 - 1.6) / 0.4)
    assert chances(User(100.0, -1.6), 0.4) == pytest.approx([on, 0.0, 1 - on], abs=1e-6)
    lanes = network({1: straight(0.0, 0.0, 100.0, 0.0), 2: straight(0.0, WIDTH, 100.0, WIDTH)})
    both = relations(lanes, tracks([User(50.0, WIDTH / 2)], std=0.2)).probability[0]
    np.testing.assert_allclose(both, [0.5, 0.5, 0.0], atol=1e-6)


def test_a_heading_off_by_one_deviation_weighs_exp_of_minus_a_half() -> None:
    off = Situation().heading_std
    assert chances(User(100.0, 0.0, off))[0] == pytest.approx(math.exp(-0.5), abs=1e-6)
    assert chances(User(100.0, 0.0, math.pi))[2] == pytest.approx(1.0, abs=1e-9)


def test_pedestrians_and_who_drives_backwards_are_on_no_lane() -> None:
    assert chances(User(100.0, 0.0, kind="pedestrian"))[2] == 1.0
    assert chances(User(100.0, 0.0, speed=-1.0))[2] == 1.0


@settings(max_examples=50)
@given(
    x=st.floats(-20, 270), y=st.floats(-130, 130), heading=st.floats(-7, 7), speed=st.floats(-2, 20),
    std=st.floats(0.01, 3.0), existence=st.floats(0.0, 1.0),
)  # fmt: skip
def test_probabilities_sum_to_one_and_hypotheses_to_existence(
    x: float, y: float, heading: float, speed: float, std: float, existence: float
) -> None:
    told = tracks([User(x, y, heading, speed)], std=std, existence=existence)
    roads = network(crossing())
    assert relations(roads, told).probability.sum() == pytest.approx(1.0)
    found = predict(roads, told, TIMES)
    assert found.probability.sum() == pytest.approx(existence)
    np.testing.assert_allclose(found.pose[:, 0, :2], [[x, y]] * len(found.pose), atol=1e-6)
    assert np.linalg.eigvalsh(found.obstacles.covariance).min() > -1e-9


@pytest.mark.parametrize("x", [-0.25, 90.2, 250.25])
def test_before_and_after_a_lane_tracks_are_where_they_are(x: float) -> None:
    """Lane 1 begins at 0 and leads to lane 2 at 90, which ends at 250."""
    found = predict(network(crossing()), tracks([User(x, 0.4, 0.0, 8.0)]), TIMES)
    assert (found.lane != NO_LANE).any()
    expected = np.broadcast_to(x + 8.0 * found.times, found.pose.shape[:2])
    np.testing.assert_allclose(found.pose[..., 0], expected, atol=1e-6)
    np.testing.assert_allclose(found.pose[:, 0, 1], 0.4, atol=1e-6)


def test_a_track_keeps_its_lane_and_its_speed() -> None:
    found = predict(ROADS, tracks([User(100.0, 0.0, 0.0, 8.0)]), TIMES)
    assert found.lane.tolist() == [1] and found.probability.tolist() == pytest.approx([1.0])
    np.testing.assert_allclose(found.obstacles.pose[0, :, 0], 100.0 + 8.0 * TIMES, atol=1e-6)
    np.testing.assert_allclose(found.obstacles.pose[0, :, 1:], 0.0, atol=1e-6)
    np.testing.assert_allclose(found.way[0], 8.0 * found.times)


def test_beside_the_middle_it_comes_back_to_it() -> None:
    """d(w) = (d0 + d0 w / xi) e^(-w / xi), from where it is and as it heads."""
    found = predict(ROADS, tracks([User(100.0, 0.6, 0.1, 8.0)]), TIMES)
    w, xi = 8.0 * TIMES, Situation().back
    expected = (0.6 + (math.tan(0.1) + 0.6 / xi) * w) * np.exp(-w / xi)
    np.testing.assert_allclose(found.obstacles.pose[0, :, 1], expected, atol=1e-6)
    assert found.pose[0, 0, 2] == pytest.approx(0.1, abs=1e-9)
    assert abs(found.pose[0, -1, 1]) < 0.02


def test_who_stands_stays_where_and_as_it_stands() -> None:
    found = predict(ROADS, tracks([User(100.0, -1.0, 0.2)]), TIMES)
    np.testing.assert_allclose(found.obstacles.pose[0], [[100.0, -1.0, 0.2]] * 60, atol=1e-9)
    grown = found.obstacles.covariance[0, -1, 0, 0] - 0.01
    assert grown < 1.1 * (0.2 * Situation().fading) ** 2


def test_who_brakes_to_a_stand_grows_as_far_as_it_moves() -> None:
    """1.2 m/s, braking by 1.5: it stands after tau ln 5 and .69 m, a mean of .23 m/s over 3 s."""
    told, settings = tracks([User(100.0, 0.0, 0.0, 1.2, acceleration=-1.5)], speed_std=0.5), Situation()
    found = predict(ROADS, told, TIMES)
    way = 1.2 * math.log(5.0) - 1.5 * (math.log(5.0) - 0.8)
    assert found.way[0, -1] == pytest.approx(way)
    g, faded = way / 3.0, 0.5 * (1.0 - math.exp(-3.0))
    grown = g * (0.25 * 9.0 + settings.diffusion * 27.0 / 3) + (1.0 - g) * faded**2
    assert found.obstacles.covariance[0, -1, 0, 0] == pytest.approx(0.01 + grown)


def test_covariances_grow_by_the_formula() -> None:
    settings = Situation()
    found = predict(ROADS, tracks([User(100.0, 0.0, 0.0, 8.0)], std=0.3, speed_std=0.5), TIMES)
    S, t = found.obstacles.covariance[0], TIMES
    np.testing.assert_allclose(S[:, 0, 0], 0.09 + 0.25 * t**2 + settings.diffusion * t**3 / 3, rtol=1e-6)
    back = np.exp(-2 * 8.0 * t / settings.back)
    np.testing.assert_allclose(S[:, 1, 1], 0.09 * back + settings.lane_std**2 * (1 - back), rtol=1e-6)
    np.testing.assert_allclose(S[:, 0, 1], 0.0, atol=1e-9)


@pytest.mark.parametrize("user", [User(100.0, 0.3, 0.3, 8.0), User(100.0, 30.0, 0.3, 8.0, "pedestrian")])
def test_what_is_uncertain_now_is_what_the_tracker_says(user: User) -> None:
    S = np.array([[0.4, 0.1], [0.1, 0.2]])
    found = predict(ROADS, tracks([user])._replace(covariance=S[None]), [1e-6])
    np.testing.assert_allclose(
        found.obstacles.covariance, np.broadcast_to(S, found.obstacles.covariance.shape), atol=1e-5
    )


def test_covariances_turn_with_the_lane() -> None:
    """A quarter turn: what was uncertain ahead is uncertain to the north."""
    lanes = network({1: arc(0.0, 20.0, 20.0, -math.pi / 2, math.pi / 2, successors=(2,)), 2: straight(20, 20, 20, 120)})
    quarter = 20.0 * math.pi / 2
    told = tracks([User(0.01, 0.0, 0.0, quarter / 2.5)])._replace(covariance=np.array([np.diag([0.5, 0.01])]))
    found = predict(lanes, told, [2.5])
    np.testing.assert_allclose(found.obstacles.pose[0, 0], [20.0, 20.0, math.pi / 2], atol=0.05)
    S = found.obstacles.covariance[0, 0]
    ahead = 0.5 + 0.04 * 2.5**2 + Situation().diffusion * 2.5**3 / 3
    assert S[1, 1] == pytest.approx(ahead, rel=0.01) and S[0, 0] < 0.1


def test_speed_fades_from_its_acceleration_and_braking_ends_at_rest() -> None:
    up, down = (tracks([User(50.0, 0.0, 0.0, 6.0, acceleration=a)]) for a in (1.5, -4.0))
    found = predict(ROADS, up, TIMES)
    tau, t = Situation().fading, found.times
    np.testing.assert_allclose(found.speed[0], 6.0 + 1.5 * tau * (1 - np.exp(-t / tau)))
    np.testing.assert_allclose(np.gradient(found.way[0], t)[2:-2], found.speed[0, 2:-2], atol=0.02)
    hard = predict(ROADS, down._replace(speed=np.array([2.0])), TIMES)
    rest = -tau * math.log1p(2.0 / (-4.0 * tau))
    assert (hard.speed[0, t > rest] == 0).all() and (np.diff(hard.way[0]) >= 0).all()
    assert np.ptp(hard.way[0, t > rest]) == 0.0


def test_a_fork_is_predicted_into_both_branches() -> None:
    found = predict(FORK, tracks([User(30.0, 0.0, 0.0, 10.0)]), TIMES)
    assert found.lane.tolist() == [1, 1] and found.probability.tolist() == pytest.approx([0.5, 0.5])
    ahead, left = found.obstacles.pose[:, -1]
    np.testing.assert_allclose(ahead, [60.0, 0.0, 0.0], atol=0.01)
    turned = 10.0 / 20.0
    np.testing.assert_allclose(left, [50 + 20 * math.sin(turned), 20 - 20 * math.cos(turned), turned], atol=0.05)
    jumps = np.hypot(*np.diff(found.obstacles.pose[..., :2], axis=1).transpose(2, 0, 1))
    assert jumps.max() < 0.55 and jumps.min() > 0.45, "no jump where lanes join"


def test_beyond_the_last_lane_it_goes_straight_on() -> None:
    found = predict(FORK, tracks([User(140.0, 0.0, 0.0, 10.0)]), TIMES)
    np.testing.assert_allclose(found.pose[0, 40], [240.0, 0.0, 0.0], atol=0.02)


def test_off_the_lanes_all_go_straight_and_pedestrians_may_turn() -> None:
    found = predict(ROADS, tracks([User(100.0, 30.0, 1.0, 1.4, "pedestrian"), User(100.0, 30.0, 1.0, 1.4)]), TIMES)
    assert found.lane.tolist() == [NO_LANE, NO_LANE]
    way = 1.4 * TIMES[:, None] * [math.cos(1.0), math.sin(1.0)]
    np.testing.assert_allclose(found.obstacles.pose[:, :, :2] - [100.0, 30.0], [way, way], atol=1e-9)
    walks, drives = np.linalg.eigvalsh(found.obstacles.covariance[:, -1])
    assert walks[0] > 5 * drives[0]
    walk = (Situation().walk_std * 3.0) ** 2
    assert walks[0] == pytest.approx(0.01 + (Situation().turn_std * 4.2) ** 2 + walk, rel=1e-6)


def test_predictions_are_told_along_the_route() -> None:
    way = route(two_way(), [1])
    told = along(way, predict(ROADS, tracks([User(100.0, 0.0, 0.0, 8.0), User(200.0, WIDTH, math.pi, 5.0)]), TIMES))
    t = np.arange(told.s.shape[1]) * Situation().step
    np.testing.assert_allclose(told.s, [100 + 8 * t, 200 - 5 * t], atol=1e-4)
    np.testing.assert_allclose(told.d, [0 * t, 0 * t + WIDTH], atol=1e-6)
    np.testing.assert_allclose(told.ahead[:, 0], [1.0, -1.0])
    assert told.on.all()


def test_nobody_is_nowhere() -> None:
    found = predict(ROADS, no_tracks(), TIMES)
    assert found.obstacles.pose.shape == (0, 60, 3) and found.pose.shape[0] == 0
    assert along(route(two_way(), [1]), found).s.shape[0] == 0


def test_a_route_knows_the_borders_beside_it() -> None:
    way = route(two_way(), [1])
    np.testing.assert_allclose(way.edges_at(100.0), [1.5 * WIDTH, WIDTH / 2, -WIDTH / 2, -WIDTH / 2], atol=1e-6)
    assert way.opposite[50].tolist() == [True, False]
    np.testing.assert_allclose(way.limit_at(np.array([0.0, 300.0])), 10.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"position": np.array([[math.nan, 0.0]])}, "track 0: its position is not finite"),
        ({"size": np.array([[4.0, 0.0]])}, "track 0: its size"),
        ({"existence": np.array([1.2])}, "track 0: its existence is 1.2"),
        ({"heading": np.zeros(2)}, "heading has shape"),
    ],
)
def test_tracks_that_are_none_are_refused(change: dict[str, np.ndarray], words: str) -> None:
    with pytest.raises(InputError, match=words):
        predict(ROADS, tracks([User(100.0, 0.0)])._replace(**change), TIMES)


def test_maps_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match="lane 1 leads to lane 9"):
        network({1: straight(0.0, 0.0, 10.0, 0.0, successors=(9,))})
    with pytest.raises(InputError, match="lane 1 has lane 7 beside it"):
        route({1: straight(0.0, 0.0, 10.0, 0.0, beside=(7, None))}, [1])
    with pytest.raises(InputError, match="situation: back is 0"):
        replace(Situation(), back=0.0)


def test_a_narrowing_lane_is_as_wide_as_it_is_there() -> None:
    left = np.array([[0.0, 3.0], [100.0, 1.0]])
    lanes = network({1: Lane(left, left * [1, -1])})
    told = relations(lanes, tracks([User(10.0, 2.0), User(90.0, 2.0)], std=0.05)).probability[:, 0]
    assert told[0] > 0.999 and told[1] < 0.001
    assert len(even(left, 5)) == 5
