"""More sensors and vehicles that change lanes: cues that the road course takes, and cues that it must not believe."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.configured import configured
from experiments.road_metrics import RANGES, check_course
from experiments.scenarios.road import night_road
from experiments.scenarios.scene import Scene
from inference import importance
from inference.posterior import Posterior
from models.program import InputError
from models.road.course import RoadCourse
from models.road.cues import Cues

Floats = NDArray[np.float64]
MODEL = RoadCourse()
SENSED: RoadCourse = configured("model", "road_course_radar_lidar")
SEEDS = range(3000, 3024)


def run(model: RoadCourse, cues: Cues, seed: int = 0) -> Posterior:
    return importance.run(model, model.prepare(cues), seed=seed)


def errors(posterior: Posterior, scene: Scene) -> Floats:
    """Distances [m] of the true course 40, 80 and 140 m ahead."""
    return np.abs(check_course(posterior, scene.truth["line"]).error[np.isin(RANGES, (40.0, 80.0, 140.0))])


@pytest.mark.parametrize(("kind", "told"), [("radar", 2), ("lidar", 0)])
def test_a_sensor_is_a_kind_of_cue_and_a_config(kind: str, told: int) -> None:
    """What a radar sees to 140 m narrows bands far ahead, what a lidar sees to 60 m those near by, and errors follow;
    MODEL refuses both."""
    alone, with_it = [], []
    for seed in SEEDS:
        scene, more = night_road(seed), night_road(seed, **{kind: True})
        num = len(scene.data.kind)
        np.testing.assert_array_equal(more.data.position[:num], scene.data.position)
        assert set(more.data.kind[num:]) == {kind}
        at = np.flatnonzero(np.isin(RANGES, (40.0, 80.0, 140.0)))[told]
        for model, cues, out in ((MODEL, scene.data, alone), (SENSED, more.data, with_it)):
            check = check_course(run(model, cues, seed), scene.truth["line"])
            out.append((check.spread[at], abs(check.error[at])))
    narrower = np.array(with_it) / np.array(alone)
    assert np.exp(np.log(narrower[:, 0]).mean()) < 0.9
    assert np.mean(with_it, 0)[1] < np.mean(alone, 0)[1]
    with pytest.raises(InputError, match=f"no kind of cue is called '{kind}'"):
        MODEL.prepare(more.data)


def test_a_vehicle_that_changes_lanes_is_recognised_and_counts_for_little() -> None:
    """Over 24 roads: found in most, no other vehicle accused, and the estimate hardly worse than without the car; a
    model that knows no change of lanes follows it."""
    naive = RoadCourse(clutter=0.0, lane_changes=0.0)
    found, accused, without, wary, misled = 0, 0, [], [], []
    for seed in SEEDS:
        plain, scene = night_road(seed), night_road(seed, lane_change=True)
        posterior, evidence = run(MODEL, scene.data, seed), MODEL.prepare(scene.data)
        remarks = MODEL.remarks(evidence, posterior.resample(100, 0))
        new = f"car {len(plain.data.kind)} "
        found += any(remark.startswith(new) for remark in remarks)
        accused += sum(not remark.startswith(new) for remark in remarks)
        without.append(errors(run(MODEL, plain.data, seed), scene))
        wary.append(errors(posterior, scene))
        misled.append(errors(run(naive, scene.data, seed), scene))
    assert found >= 16
    assert accused == 0
    near, wrong = (np.median(v, 0)[1] / np.median(without, 0)[1] for v in (wary, misled))  # 80 m ahead
    assert near < 1.25
    assert wrong > 1.5


def test_a_vehicle_is_remarked_where_it_rather_leaves_the_road(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = night_road(SEEDS[0], lane_change=True)
    evidence = MODEL.prepare(scene.data)
    first = int(evidence.group[evidence.moves][0])
    for share, told in ((0.45, 1), (0.55, 0)):
        follows = np.where(evidence.group == first, share, 0.9)
        monkeypatch.setattr(RoadCourse, "follows", lambda *_, found=follows: found)
        remarks = MODEL.remarks(evidence, {})
        assert len(remarks) == told
        assert all(remark.startswith(f"{evidence.names[first]} changes lanes") for remark in remarks)


@pytest.mark.parametrize(("num", "told"), [(4, False), (6, True)])
def test_more_clutter_than_there_can_be_is_remarked(num: int, told: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 24 cues with 5 % of clutter, P(4 or more) = .03 and P(6 or more) = .0009. A vehicle that changes lanes, all of
    its detections, is none of them."""
    evidence = MODEL.prepare(night_road(SEEDS[0]).data)
    group = np.r_[np.zeros(24, dtype=np.int64), np.ones(9, dtype=np.int64)]
    evidence = evidence._replace(group=group, moves=group == 1, names=("post left", "car 3"))
    follows = np.where(group == 1, 0.1, np.where(np.arange(33) < num, 0.0, 1.0))
    monkeypatch.setattr(RoadCourse, "follows", lambda *_: follows)
    remarks = MODEL.remarks(evidence, {})
    assert remarks[-1].startswith("car 3 changes lanes") and len(remarks) == 1 + told
    if told:
        assert remarks[0].startswith("6 of 24 cues are taken for clutter, where 5% are expected")


def test_a_road_that_misses_most_cues_is_remarked() -> None:
    """Draws 8 m beside the estimate, against the estimate."""
    scene = night_road(SEEDS[0])
    evidence, draws = MODEL.prepare(scene.data), run(MODEL, scene.data, 0).resample(100, 0)
    assert not any("clutter" in remark for remark in MODEL.remarks(evidence, draws))
    beside = draws | {"course": draws["course"] + np.array([0.0, 8.0, 0.0, 0.0, 8.0, 0.0])}
    assert any("are taken for clutter" in remark for remark in MODEL.remarks(evidence, beside))
