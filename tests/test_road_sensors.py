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
