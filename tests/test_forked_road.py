"""The experiment of a road that forks: its scenes, what is told of a posterior, its picture."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from experiments.fork_figures import figures, followers, in_words
from experiments.fork_metrics import at_distance, drawn_fork, errors, metrics, to_line
from experiments.scenarios.forked_road import CLEAR, distance, forked_road
from experiments.scenarios.road import Line, night_road
from inference import rjmcmc
from inference.posterior import Posterior
from models.clothoid import Points
from models.program import InputError
from models.road.fork import ForkedRoad

MODEL = ForkedRoad()
Array = NDArray[Any]


def found(seed: int) -> Posterior:
    evidence = MODEL.prepare(forked_road(seed).data)
    options: dict[str, Any] = {"start": "data", "start_temperature": 20, "resample": True, "thin": 10}
    return rjmcmc.run(MODEL, evidence, seed=1, num_chains=4, num_steps=12_000, warmup=6_000, **options)


@pytest.mark.parametrize(("second", "num"), [("none", 1), ("exit", 2), ("entry", 2)])
def test_a_scene_has_the_roads_it_says(second: Any, num: int) -> None:
    for seed in range(5):
        scene = forked_road(seed, second)
        assert scene.truth["num_courses"] == num
        assert ("branch" in scene.truth) == (num == 2)
        if num == 1:
            continue
        gap = np.hypot(*(scene.truth["line"] - scene.truth["branch"])[:, :2].T)
        arc = np.linspace(-10.0, 145.0, len(gap))
        joins, place = second == "entry", scene.truth["place"]
        assert scene.truth["joins"] == joins
        assert 40.0 <= place <= 100.0
        shared = arc > place if joins else arc < place
        assert np.all(gap[shared] == 0.0)
        assert gap[0 if joins else -1] > 2.0


def test_half_of_the_scenes_have_one_road_and_seeds_repeat() -> None:
    kinds = [forked_road(seed).info["second"] for seed in range(200)]
    assert abs(kinds.count("none") - 100) < 4 * 200**0.5 / 2
    assert {"exit", "entry"} < set(kinds)
    np.testing.assert_array_equal(forked_road(3).data.position, forked_road(3).data.position)
    assert forked_road(10).data.position.sum() == pytest.approx(1954.3781, abs=1e-3)


def test_posts_stand_beside_both_roads_and_on_neither() -> None:
    """But for what the camera and their own offsets make of it: a few metres far away."""
    for seed in range(8):
        scene = forked_road(seed, "exit")
        posts = scene.data.take(np.isnan(scene.data.flow))
        near = np.hypot(*posts.position.T) < 60.0
        for name in ("line", "branch"):
            points = Points(*(torch.from_numpy(v) for v in (*scene.truth[name].T, scene.truth[name][:, 0])))
            assert np.all(distance(posts.position[near], Line(np.zeros(1), points)) > CLEAR - 2.0)


def test_wrong_words_are_refused() -> None:
    with pytest.raises(InputError, match="seed is -1; choose 0 or more"):
        forked_road(-1)
    with pytest.raises(InputError, match="second is 'fork'; choose any, none, exit or entry"):
        forked_road(0, "fork")  # type: ignore[arg-type]


@pytest.mark.parametrize(("seed", "word"), [(10, "leaves"), (0, "joins")])
def test_a_fork_is_told_and_drawn_whatever_the_courses_are_called(seed: int, word: str) -> None:
    scene, posterior = forked_road(seed), found(seed)
    scores = metrics(posterior, scene)
    assert scores["count_right"] == scores["kind_right"] == 1.0
    assert scores["fork_probability"] > 0.95
    assert scores["place_error_m"] < 25.0
    assert scores["main_error_80_m"] < 1.5
    assert scores["second_error_80_m"] < 1.5
    drawn = drawn_fork(posterior, MODEL)
    assert f"a second course {word}" in in_words(drawn)
    second = followers(drawn, scene.data, MODEL)
    truth = [points_of(scene.truth[name]) for name in ("line", "branch")]
    to_first, to_second = (distance(scene.data.position, line) for line in truth)
    cars = ~np.isnan(scene.data.flow) & (np.abs(to_first - to_second) > 3.0)
    assert np.all((second[cars] > 0.5) == (to_second < to_first)[cars])
    assert figures(posterior, scene).keys() == {"fork"}


def points_of(track: Array) -> Line:
    return Line(np.zeros(1), Points(*(torch.from_numpy(v) for v in (*track.T, track[:, 0]))))


def test_draws_with_the_names_the_other_way_round_change_nothing() -> None:
    """A third of the draws are swapped by the model's own move: the mean courses stay, to the metre or two by which the
    move misses the other course at the end, where they are more than ten apart."""
    posterior = found(10)
    (move,) = (move for move in MODEL.moves() if move.name == "swap")
    sites = {n: torch.from_numpy(v[0]) for n, v in posterior.draws.items()}
    swapped = move.propose(sites, torch.full((len(sites["main"]), 6), 0.5, dtype=torch.float64)).latents
    both = Posterior({n: np.stack([v[0], v[0], swapped[n].numpy()]) for n, v in posterior.draws.items()})
    one, two = drawn_fork(posterior, MODEL), drawn_fork(both, MODEL)
    assert 0.25 < two.swapped.mean() < 0.42
    for before, after in zip(one.courses, two.courses, strict=True):
        assert np.abs(before.mean(0) - after.mean(0)).max() < 2.0
    assert np.hypot(*(one.courses[0] - one.courses[1]).mean(0)[-1]) > 10.0


def test_one_course_is_told_as_one() -> None:
    scene, posterior = forked_road(1), found(1)
    scores = metrics(posterior, scene)
    assert scores["count_right"] == 1.0
    assert scores["main_error_80_m"] < 1.5
    assert not {"second_error_80_m", "place_error_m", "kind_right"} & scores.keys()
    drawn = drawn_fork(posterior, MODEL)
    assert in_words(drawn).startswith("one course; a second has the probability 0.")
    assert np.all(followers(drawn, scene.data, MODEL) == 0.0)
    assert figures(posterior, scene).keys() == {"fork"}


def test_other_scenes_and_posteriors_have_no_scores_and_no_picture() -> None:
    nothing = Posterior({"course": np.zeros((1, 4, 6))})
    assert metrics(nothing, forked_road(0)) == {}
    assert figures(nothing, night_road(0)) == {}


def test_errors_are_distances_in_the_order_that_fits() -> None:
    x = np.linspace(-10.0, 145.0, 40)
    flat, bent = np.stack([x, 0.0 * x], -1), np.stack([x, np.maximum(x - 50.0, 0.0) ** 2 / 400.0], -1)
    assert errors([flat, bent], [bent, flat], 80.0) == pytest.approx([0.0, 0.0], abs=1e-2)
    assert errors([flat + np.array([0.0, 0.5])], [flat, bent], 80.0)[0] == pytest.approx(0.5)
    assert np.isnan(errors([flat], [flat, bent], 80.0)[1])
    np.testing.assert_allclose(at_distance(flat, 80.0), [80.0, 0.0], atol=4.0)
    assert to_line(np.array([3.0, 4.0]), np.array([[0.0, 0.0], [10.0, 0.0]])) == pytest.approx(4.0)
    assert to_line(np.array([-3.0, 4.0]), np.array([[0.0, 0.0], [10.0, 0.0]])) == pytest.approx(5.0)
