"""What labels teach, and that a sequence is judged without its own: made-up rows, and choices by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks import kitti_folds as benchmark
from benchmarks.configured import made
from benchmarks.kitti_folds import GRID, Settings, Trial, attempt, choose, described
from experiments import kitti_folds, kitti_metrics
from experiments.kitti_boxes import image_boxes
from experiments.kitti_evaluation import count_all
from experiments.kitti_folds import OFF, ON, Labelled, Lesson, label, learn, leave_one_out, report
from experiments.kitti_matching import compare
from experiments.scenarios.kitti_scans import SHARPENING, SLOPE, KittiTruth
from tests.drawn_cars import IMAGE, PROJECTION, beside_a_hedge, car

START = Settings(2.7e-4, 0.9, SLOPE, SHARPENING)


def taught(seeds: range) -> list[Labelled]:
    return [label(*beside_a_hedge(seed)) for seed in seeds]


def test_labels_confirm_what_they_overlap_and_leave_out_what_is_small() -> None:
    truth, found = beside_a_hedge(0)
    some = label(truth, found)
    np.testing.assert_array_equal(some.confirmed, np.tile([True, False], 40))
    assert some.teaches.all()
    far = found.boxes._replace(box=np.array([car(-3.0), car(3.0, 60.0)] * 40))
    assert (image_boxes(far.box[1:2], PROJECTION, IMAGE)[0] @ [0, -1, 0, 1]) < 25.0
    np.testing.assert_array_equal(label(truth, found._replace(boxes=far)).teaches, np.tile([True, False], 40))
    vans = KittiTruth(truth.sequence, truth.labels._replace(kind=np.full(40, "Van")))
    assert not label(vans, found).teaches[::2].any()
    assert not label(truth, found._replace(shown=np.zeros(80, dtype=bool))).teaches.any()


def test_thresholds_are_those_with_which_least_goes_wrong() -> None:
    pairs = [beside_a_hedge(seed) for seed in range(3)]
    lesson = learn([label(*pair) for pair in pairs])
    wrong = {}
    for on in ON:
        for off in OFF:
            reported = [report(found, lesson._replace(on=on, off=off)) for _, found in pairs]
            counts = count_all(
                compare(truth.sequence, truth.labels, boxes) for (truth, _), boxes in zip(pairs, reported, strict=True)
            )
            wrong[on, off] = counts.missed + counts.false + counts.switches + counts.fragmentations
    assert len(set(wrong.values())) > 1
    assert lesson.errors == min(wrong.values()) == wrong[lesson.on, lesson.off]


def test_what_is_beside_the_image_is_not_reported() -> None:
    _, found = beside_a_hedge(0)
    lesson = learn(taught(range(1, 3)))
    shown = np.arange(80) >= 40
    told = report(found._replace(shown=shown), lesson)
    assert told.offset[20] == 0 and told.offset[-1] == len(told.track) > 0
    some = label(*beside_a_hedge(1))
    assert learn([some, some]).errors < learn([some, some._replace(found=some.found._replace(shown=~shown))]).errors


def test_a_sequence_is_judged_by_what_the_others_taught() -> None:
    whole = taught(range(3))
    lessons = leave_one_out(whole)
    by_hand = learn(whole[1:])
    np.testing.assert_array_equal(lessons[0].calibration.weights, by_hand.calibration.weights)
    assert lessons[0][1:] == by_hand[1:]
    # its own labels change nothing of what is told of it
    truth, found = beside_a_hedge(0)
    hidden = truth.labels._replace(position=truth.labels.position + 99.0, camera=truth.labels.camera + 99.0)
    again = leave_one_out([label(truth._replace(labels=hidden), found), *whole[1:]])
    assert again[0][1:] == lessons[0][1:]
    np.testing.assert_array_equal(report(found, again[0]).score, report(found, lessons[0]).score)
    assert again[1].errors > lessons[1].errors
    assert (report(found, lessons[0]).track == 5).mean() > 0.8


def losses(settings: Settings) -> Trial:
    """Sequence 0 is judged best with few false alarms and a flat slope, 1 with many; nothing else matters."""
    density, slope = settings.clutter_density, settings.slope
    errors = [10 * (density > 1e-4) + 3 * (slope > 0.7), 10 * (density < 5e-4)]
    return Trial([Lesson(None, 0.5, 0.5, e) for e in errors], [])  # type: ignore[arg-type]


def test_each_sequence_has_the_settings_that_serve_the_others_best() -> None:
    assert choose(losses, 0, START) == START._replace(clutter_density=9e-5, slope=0.6)
    assert choose(losses, 1, START) == START._replace(clutter_density=8e-4)  # what makes no difference stays
    assert described([START, START._replace(slope=0.6)]).split("; ")[2] == "slope 0.6 (1), 0.85 (1)"


@pytest.mark.parametrize("camera", [False, True])
def test_the_filter_runs_with_the_settings_that_are_tried(camera: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    (model,) = made([f"experiment={'kitti_tracking_camera' if camera else 'kitti_tracking'}"], "model")
    assert all(getattr(START, name) in values for name, values in GRID.items())
    assert (model.sensors[0].clutter_density, model.sensors[0].occlusion) == START[:2]
    runs = []

    def followed(traffic: Any, engine: Any, name: str, **others: Any) -> tuple[None, Any, None]:
        runs.append((traffic, name, others))
        return None, label(*beside_a_hedge(int(name))), None

    monkeypatch.setattr(kitti_metrics, "followed", followed)
    tried = attempt(model, None, ["1", "2"], camera, Settings(1e-3, 0.5, 0.4, 0.3))  # type: ignore[arg-type]
    assert [name for _, name, _ in runs] == ["1", "2"]
    traffic, _, others = runs[0]
    assert others == {"data_root": benchmark.DATA, "camera": camera, "slope": 0.4, "sharpening": 0.3}
    assert [sensor.occlusion for sensor in traffic.sensors] == [0.5] * len(model.sensors)
    assert traffic.sensors[0].clutter_density == 1e-3
    assert replace(traffic, sensors=model.sensors) == model
    by_hand = report(label(*beside_a_hedge(1)).found, learn([label(*beside_a_hedge(2))]))
    np.testing.assert_array_equal(tried.told[0].score, by_hand.score)
    assert kitti_folds.leave_one_out(taught(range(1, 3)))[1].errors == tried.lessons[1].errors


def test_the_benchmark_skips_with_a_reason_where_there_are_no_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "DATA", "nowhere")
    for measurement in benchmark.MEASUREMENTS:
        for key, value in measurement.measure(benchmark.Effort()).items():
            assert value.value is None and "data_root" in value.detail, key
