"""More sensors and vehicles that change lanes: cues that the road course takes, and cues that it must not believe."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from benchmarks.configured import configured
from experiments.road_metrics import RANGES, check_course
from experiments.scenarios.road import along, night_road
from experiments.scenarios.scene import Scene
from inference import importance
from inference.posterior import Posterior
from models.clothoid import hermite
from models.program import InputError
from models.road.along_road import scatter
from models.road.course import RoadCourse
from models.road.cues import Cues, line_of_sight

Floats = NDArray[np.float64]
MODEL = RoadCourse()
SENSED: RoadCourse = configured("model", "road_course_radar_lidar")
SEEDS = range(3000, 3024)


def run(model: RoadCourse, cues: Cues, seed: int = 0) -> Posterior:
    return importance.run(model, model.prepare(cues), seed=seed)


def errors(posterior: Posterior, scene: Scene) -> Floats:
    """Distances [m] of the true course 40, 80 and 140 m ahead."""
    return np.abs(check_course(posterior, scene.truth["line"]).error[np.isin(RANGES, (40.0, 80.0, 140.0))])


def sensed(scene: Scene, kind: str, arc: Floats, noise: tuple[float, float], seed: int) -> Cues:
    """Cues of a kind right of the road of a scene; noise is that of the range [m] and across, a share of the range."""
    course = torch.from_numpy(scene.truth["course"])
    points = along(hermite(course[:3], course[3:])).at(arc)
    place = np.stack([points.x.numpy(), points.y.numpy()], -1)
    num = len(arc)
    covariance = line_of_sight(place, np.full(num, noise[0]), 0.02 + noise[1] * np.hypot(*place.T))
    cues = Cues(
        np.full(num, kind), np.zeros(num, bool), np.arange(num), place, covariance,
        np.full(num, np.nan), np.ones(num), np.ones(num),
    )  # fmt: skip
    torch.manual_seed(seed)
    aside = torch.full((num,), SENSED.prepare(cues).offset_loc[0], dtype=torch.float64)
    seen = scatter(points, aside, SENSED.prepare(cues), RoadCourse(clutter=0.0))
    return cues._replace(position=seen[:, :2].numpy())


@pytest.mark.parametrize(
    ("kind", "reach", "noise", "range_told"),
    [("radar", 150.0, (0.3, 0.01), 2), ("lidar", 70.0, (0.05, 0.001), 0)],
)
def test_a_sensor_is_a_kind_of_cue_and_a_config(
    kind: str, reach: float, noise: tuple[float, float], range_told: int
) -> None:
    """What a radar reflects to 150 m helps far ahead, what a lidar sees to 70 m helps near by; MODEL refuses both."""
    alone, with_it = [], []
    for seed in SEEDS:
        scene = night_road(seed)
        more = sensed(scene, kind, np.arange(12.0, reach, 7.0), noise, seed)
        joined = Cues(*(np.concatenate(pair) for pair in zip(scene.data, more, strict=True)))
        alone.append(errors(run(MODEL, scene.data, seed), scene)[range_told])
        with_it.append(errors(run(SENSED, joined, seed), scene)[range_told])
    assert np.mean(np.array(with_it) < alone) > 0.6
    assert np.mean(with_it) < 0.8 * np.mean(alone)
    with pytest.raises(InputError, match=f"no kind of cue is called '{kind}'"):
        MODEL.prepare(joined)


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
