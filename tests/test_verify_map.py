"""Stored maps against tracks: odds point the right way, and files that are no maps are refused in one sentence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from experiments.map_figures import figures
from experiments.scenarios.protocol import protocol
from experiments.scenarios.scene import Scene
from experiments.scenarios.stored_map import (
    StoredMap,
    as_plain,
    from_plain,
    map_of,
    mapped,
    outdated,
    read_map,
    write_map,
)
from experiments.verify_map import SIDES, Verdict, align, lanes_seen, metrics, odds, verify
from inference import rjmcmc
from inference.posterior import Posterior
from models.intersection.state import Junction
from models.program import InputError


@pytest.fixture(scope="module")
def scene() -> Scene:
    return protocol(5)


@pytest.fixture(scope="module")
def truth(scene: Scene) -> StoredMap:
    return map_of(scene.truth)


@pytest.fixture(scope="module")
def posterior(scene: Scene) -> Posterior:
    model = Junction()
    annealed: dict[str, Any] = {"start": "data", "start_temperature": 10.0, "polish": True}
    return rjmcmc.run(model, model.prepare(scene.data), seed=0, num_steps=22000, warmup=12000, thin=20, **annealed)


def lane_odds(verdict: Verdict) -> np.ndarray:
    """Odds of all lanes and sides."""
    return np.concatenate([v for side in SIDES for v in (*verdict.lane_gone[side], verdict.more[side])])


def changed(values: np.ndarray, arm: int, by: int) -> np.ndarray:
    out = values.copy()
    out[arm] += by
    return out


def test_a_right_map_has_all_odds_below_one(posterior: Posterior, truth: StoredMap, scene: Scene) -> None:
    verdict = verify(posterior, truth, scene.data)
    assert (lane_odds(verdict) < 0.1).all() and (verdict.arm_gone < 0.1).all()
    assert verdict.new_arm < 0.1 and verdict.outdated < 1


@pytest.mark.parametrize("arm", range(4))
@pytest.mark.parametrize(("side", "name"), [(1, "entries"), (-1, "exits")])
def test_only_a_mapped_lane_that_is_not_there_is_gone(
    posterior: Posterior, truth: StoredMap, scene: Scene, arm: int, side: Any, name: str
) -> None:
    verdict = verify(posterior, truth._replace(**{name: changed(getattr(truth, name), arm, 1)}), scene.data)
    assert verdict.lane_gone[side][arm][-1] > 10 and verdict.tracks[side][arm][-1] == 0
    assert (lane_odds(verdict) > 1).sum() == 1 and verdict.outdated > 10


@pytest.mark.parametrize(("side", "name"), [(1, "entries"), (-1, "exits")])
def test_a_side_that_lacks_a_lane_has_another(
    posterior: Posterior, truth: StoredMap, scene: Scene, side: Any, name: str
) -> None:
    arm = int(getattr(truth, name).argmax())
    verdict = verify(posterior, truth._replace(**{name: changed(getattr(truth, name), arm, -1)}), scene.data)
    assert verdict.more[side][arm] > 10
    assert (lane_odds(verdict) > 1).sum() == 1 and verdict.outdated > 10


def test_an_innermost_lane_too_many_is_named_as_the_one_gone(
    posterior: Posterior, truth: StoredMap, scene: Scene
) -> None:
    arm = int(truth.entries.argmin())  # one lane more within its gap: the others lie outside of it
    wrong = truth._replace(
        entries=changed(truth.entries, arm, 1), gap=truth.gap - 2 * truth.width * (np.arange(4) == arm)
    )
    gone = verify(posterior, wrong, scene.data).lane_gone[1][arm]
    assert gone[0] > 10 and (gone[1:] < 0.1).all()


def test_an_arm_that_the_map_lacks_is_new(posterior: Posterior, truth: StoredMap, scene: Scene) -> None:
    rest = StoredMap(truth.centre, *(values[1:] for values in truth[1:]))
    verdict = verify(posterior, rest, scene.data)
    assert verdict.new_arm > 10 and verdict.outdated > 10
    assert (lane_odds(verdict) < 1).all() and (verdict.arm_gone < 1).all()


def test_a_mapped_arm_that_is_not_there_is_gone_with_its_lanes(
    posterior: Posterior, truth: StoredMap, scene: Scene
) -> None:
    order = np.sort(truth.angle)
    between = np.diff(order, append=order[0] + 2 * np.pi)
    angle = order[between.argmax()] + between.max() / 2
    extra = StoredMap(truth.centre, *(np.append(v, w) for v, w in zip(truth[1:], (angle, 1, 2.7, 2, 1), strict=True)))
    verdict = verify(posterior, extra, scene.data)
    assert verdict.arm_gone[-1] > 10 and (verdict.arm_gone[:-1] < 1).all()
    assert (verdict.lane_gone[1][-1] > 10).all() and verdict.more[1][-1] < 1


def test_lanes_align_where_they_lie_closest() -> None:
    stored = StoredMap(np.zeros(2), *(np.array([v]) for v in (0.3, 2.0, 3.0, 3, 3)))
    slot = np.zeros(4, dtype=np.int64)
    draws = {
        "centre": np.zeros((4, 2)),
        "angle": np.full((4, 1), 0.3),
        "gap": np.array([[2.0], [8.0], [14.0], [-4.0]]),  # inner borders 0, 1, 2 lanes farther out, 1 farther in
        "width": np.full((4, 1), 3.0),
        "entries": np.array([[2], [2], [1], [5]]),
        "exits": np.array([[2], [2], [1], [5]]),
    }
    for side in SIDES:
        count, first = align(draws, slot, stored, 0, side)
        assert count.tolist() == [2, 2, 1, 5] and first.tolist() == [0, 1, 2, -1]
    shifted = draws | {"centre": 3.0 * np.tile([-np.sin(0.3), np.cos(0.3)], (4, 1))}  # a lane to the left
    assert align(shifted, slot, stored, 0, 1)[1].tolist() == [1, 1, 2, 0]
    assert align(shifted, slot, stored, 0, -1)[1].tolist() == [0, 0, 1, -2]


def test_odds_are_finite_and_reverse_with_the_question() -> None:
    assert odds(0.0, 1000) == pytest.approx(0.5 / 1000.5) and odds(1.0, 1000) == pytest.approx(2001.0)
    assert odds(0.3, 1000) * odds(0.7, 1000) == pytest.approx(1.0)


def test_tracks_are_counted_on_the_lanes_that_they_drove(scene: Scene, truth: StoredMap) -> None:
    for side, first in ((1, 0), (-1, 2)):
        seen = lanes_seen(truth, scene.data, side)  # type: ignore[arg-type]
        ends = scene.truth.connections[scene.truth.track_lane][:, first : first + 2]
        for arm, lanes in enumerate(seen):
            true = np.bincount(ends[ends[:, 0] == arm, 1], minlength=len(lanes))
            assert np.abs(lanes - true).max() <= 1  # noise puts few means over a border: 1.35 m against .3 m


def test_a_map_made_wrong_has_one_entry_more_and_one_exit_less(truth: StoredMap) -> None:
    for seed in range(20):
        wrong, words = outdated(truth, seed)
        more, less = wrong.entries - truth.entries, wrong.exits - truth.exits
        assert sorted(more) == [0, 0, 0, 1] and sorted(less) == [-1, 0, 0, 0]
        assert more.argmax() != less.argmin() and (wrong.entries + wrong.exits > 0).all()
        assert f"arm {more.argmax() + 1}" in words and f"arm {less.argmin() + 1}" in words
    one_way = truth._replace(exits=np.array([0, 0, 0, 0]))
    with pytest.raises(InputError, match="no exit"):
        outdated(one_way, 0)


def test_metrics_and_picture_name_the_changes(posterior: Posterior, scene: Scene) -> None:
    beside = mapped(scene)
    scores = metrics(posterior, beside)
    assert scores["lanes_gone"] == scores["lanes_unseen"] == scores["sides_with_more"] == 1
    assert scores["odds_map_outdated"] > 10
    json.dumps(beside.info)  # the manifest holds the map
    for figure in figures(posterior, beside).values():
        FigureCanvasAgg(figure).draw()
    assert metrics(posterior, scene) == figures(posterior, scene) == {}


def test_a_map_is_read_as_it_was_written(truth: StoredMap, scene: Scene, tmp_path: Path) -> None:
    write_map(tmp_path / "map.json", truth)
    for written, read in zip(truth, read_map(tmp_path / "map.json"), strict=True):
        np.testing.assert_array_equal(written, read)
    beside = mapped(scene._replace(truth=None), str(tmp_path / "map.json"))
    assert beside.info["map"] == as_plain(truth)
    with pytest.raises(InputError, match="map_path"):
        mapped(scene._replace(truth=None))


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("arms",), [], "has no list 'arms'"),
        (("centre_m",), [0.0, float("nan")], "centre_m is"),
        (("centre_m",), None, "centre_m is missing"),
        (("arms", 1), 7, "arm 2 is 7"),
        (("arms", 1, "entries"), 1.5, "arm 2: entries is 1.5"),
        (("arms", 1, "entries"), True, "arm 2: entries is True"),
        (("arms", 1, "exits"), -1, "arm 2: exits is -1"),
        (("arms", 0, "gap_m"), "wide", "arm 1: gap_m is 'wide'"),
        (("arms", 0, "width_m"), 0, "arm 1: width_m is 0"),
        (("arms", 0, "angle_rad"), 10**400, "arm 1: angle_rad is"),
    ],
)
def test_a_broken_map_is_refused_by_arm_field_and_value(
    truth: StoredMap, path: tuple[Any, ...], value: Any, words: str
) -> None:
    content: Any = as_plain(truth)
    inner = content
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    with pytest.raises(InputError, match=words) as caught:
        from_plain(content)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_map_is_refused(tmp_path: Path) -> None:
    contents = {
        "binary": b"\xff\xfe\x00",
        "half": b'{"arms": [',
        "list": b"[1, 2]",
        "deep": b"[" * 100_000,
        "empty": b"",
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name):
            read_map(tmp_path / name)
    for missing in (tmp_path / "nowhere.json", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            read_map(missing)
    arm = {"angle_rad": 0.0, "gap_m": 1.0, "width_m": 2.7, "entries": 0, "exits": 0}
    with pytest.raises(InputError, match="no lanes"):
        from_plain({"centre_m": [0, 0], "arms": [arm]})
