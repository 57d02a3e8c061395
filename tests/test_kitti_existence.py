"""Calibrated existence: made-up rows whose truth is known, histories by hand, and the real sequences where they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit

from benchmarks import kitti_tracking as benchmark
from experiments.kitti_existence import Past, _crowded, candidates, fit, past_of, told
from experiments.kitti_matching import TrackBoxes
from experiments.kitti_metrics import paths_of
from experiments.scenarios.kitti_scans import CAMERA, LASER, scans_of
from experiments.scenarios.kitti_tracking import CameraBoxes, Detections
from inference.tracks import Tracks
from models.objects.box_detector import BoxDetector, ImageBox
from models.objects.motion import ConstantTurn
from models.objects.scans import Scan
from models.objects.sensors import sensor_formulas
from models.program import InputError
from tests.drawn_cars import beside_a_hedge, car, scene


def tracks_of(rows: list[tuple[int, int, int]], sensor: tuple[str, ...], time: np.ndarray) -> Tracks:
    """Rows (scan, label, measurement)."""
    scan, label, measurement = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    num, d = len(rows), 4
    return Tracks(
        time=time,
        offset=np.searchsorted(scan, np.arange(len(time) + 1)),
        label=label,
        existence=np.full(num, 0.5),
        mean=np.zeros((num, d)),
        covariance=np.tile(np.eye(d), (num, 1, 1)),
        kind=np.ones((num, 1)),
        names=("x", "y", "vx", "vy"),
        kind_names=("car",),
        sensor=sensor,
        measurement=measurement,
    )


def test_weights_are_at_the_maximum_with_its_penalty() -> None:
    """The slope of sum log p(y | a) - |w|^2 / 2 is zero."""
    rng = np.random.default_rng(0)
    features = rng.standard_normal((60, 3)) * [1.0, 10.0, 0.1] + [0.0, 5.0, 1.0]
    y = rng.random(60) < expit(features[:, 0])
    found = fit(features, y)
    A = np.clip((features - features.mean(0)) / features.std(0), -3.0, 3.0)
    slope = np.concatenate([np.ones((60, 1)), A], 1).T @ (y - found.probability(features)) - found.weights
    np.testing.assert_allclose(slope, 0.0, atol=1e-9)


def test_who_is_near_a_surer_one_is_crowded() -> None:
    position = np.array([[0.0, 0.0], [1.0, 0.0], [9.0, 0.0], [1.0, 0.0]])  # the last is of another frame
    boxes = TrackBoxes(np.array([0, 3, 4]), np.arange(4), np.zeros((4, 7)), np.array([0.9, 0.8, 0.1, 0.1]))
    assert _crowded(boxes, position).tolist() == [0.0, 1.0, 0.0, 0.0]


def test_histories_are_those_of_each_object_and_each_sensor() -> None:
    sensor, time = (LASER, CAMERA, LASER, CAMERA, LASER), np.array([0.0, 0.0, 0.1, 0.1, 0.2])
    rows = [(0, 7, 1), (0, 9, -1), (1, 7, 0), (2, 7, -1), (2, 9, 0), (3, 7, -1), (4, 7, 0)]
    logits = np.array([[1.0, 3.0], [0.0, 0.0], [2.0, 0.0], [0.0, 0.0], [-1.0, 0.0]])
    scans = [
        Scan(name, t, np.zeros((2, 2)), np.zeros(3), score=expit(own) if name == LASER else None)
        for name, t, own in zip(sensor, time, logits, strict=True)
    ]
    laser = past_of(tracks_of(rows, sensor, time), scans, LASER)
    seven = [0, 2, 3, 5, 6]
    expected = Past(
        hits=np.array([1.0, 1, 1, 1, 2]),
        misses=np.array([0.0, 0, 1, 1, 0]),
        mean=np.array([3.0, 3, 3, 3, 1]),
        most=np.array([3.0, 3, 3, 3, 3]),
        last=np.array([3.0, 3, 0, 0, -1]),
        faded=np.array([1.5, 1.5, 1.5, 1.5, 0.85 * 1.5 - 0.5]),
    )
    for name, found, wanted in zip(Past._fields, laser, expected, strict=True):
        np.testing.assert_allclose(found[seven], wanted, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(laser.hits[[1, 4]], [0, 1])
    np.testing.assert_allclose(laser.misses[[1, 4]], [1, 0])
    camera = past_of(tracks_of(rows, sensor, time), scans, CAMERA)
    np.testing.assert_allclose(camera.hits[seven], [0, 1, 1, 1, 1])
    np.testing.assert_allclose(camera.misses[seven], [0, 0, 0, 1, 1])


def test_a_calibration_finds_the_weights_that_made_the_labels() -> None:
    rng = np.random.default_rng(3)
    a = rng.normal(2.0, 3.0, (20_000, 2))
    w = np.array([0.5, 1.0, -2.0])
    y = rng.random(len(a)) < expit(np.concatenate([np.ones((len(a), 1)), (a - 2.0) / 3.0], 1) @ w)
    found = fit(a, y)
    np.testing.assert_allclose(found.weights, w, atol=0.12)  # 4 standard errors of about 0.03
    p = found.probability(a)
    for low in (0.1, 0.4, 0.7):
        some = (p > low) & (p < low + 0.2)
        assert y[some].mean() == pytest.approx(p[some].mean(), abs=4 * 0.5 / np.sqrt(some.sum()))
    far = found.probability(np.array([[1e6, 2.0], [11.0, 2.0]]))
    assert far[0] == pytest.approx(far[1], abs=0.02)  # features are bounded at 3 standard deviations
    with pytest.raises(InputError, match="give more sequences"):
        fit(a, np.ones(len(a), dtype=bool))


@pytest.mark.parametrize(("on", "off"), [(0.7, 0.3), (0.5, 0.5), (0.6, 0.5)])
def test_reports_go_on_until_a_track_is_clearly_gone(on: float, off: float) -> None:
    rng = np.random.default_rng(4)
    track, p = rng.integers(0, 99, 600), rng.choice([0.1, off, 0.4, 0.55, on, 0.9], 600)
    telling, expected = dict[int, bool](), []
    for name, value in zip(track.tolist(), p, strict=True):
        telling[name] = value > (off if telling.get(name, False) else on)
        expected.append(telling[name])
    np.testing.assert_array_equal(told(track, p, on=on, off=off), expected)


def test_tracks_that_do_not_say_what_they_were_seen_by_are_refused() -> None:
    truth, _ = beside_a_hedge(0)
    tracks = tracks_of([(0, 0, 0)], (LASER,), np.array([0.0]))
    with pytest.raises(InputError, match="are not of sequence made up"):
        candidates(tracks, [], truth.sequence)
    silent = replace(tracks, measurement=None)
    with pytest.raises(InputError, match="choose engine=lmb"):
        past_of(silent, [Scan(LASER, 0.0, np.zeros((0, 2)), np.zeros(3))], LASER)


def test_scans_of_a_sequence_are_in_order_and_a_frame_without_boxes_has_one() -> None:
    sequence = scene([(0, 0, car())], 3).data
    scans = scans_of(sequence, camera=True)
    assert [scan.sensor for scan in scans] == [LASER, CAMERA] * 3
    assert [scan.values.shape for scan in scans[:2]] == [(0, 7), (0, 3)]
    assert [scan.time for scan in scans_of(sequence)] == list(sequence.time)


def test_the_benchmark_skips_with_a_reason_where_there_are_no_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "DATA", "nowhere")
    for measurement in benchmark.MEASUREMENTS:
        for key, value in measurement.measure(benchmark.Effort()).items():
            assert value.value is None and "data_root" in value.detail, key


def test_scans_are_what_the_sensors_measure_of_a_box() -> None:
    """Detections laid over labels: a car that is turned, one that the border cuts off."""
    label = scene([(0, 0, car(-3.0, 20.0, 0.4)), (0, 1, car(9.5, 10.0, 1.3))], 1)
    whole, pose = label.truth, label.data.pose.copy()
    image = np.clip(whole.image, 0.0, np.array([1241.0, 374.0, 1241.0, 374.0]))
    nothing = np.array([0, 2])
    seen = Detections(nothing, whole.position, whole.heading, whole.size, np.array([2.0, 7.0]), image, whole.camera)
    sequence = label.data._replace(pose=pose, detections=seen, camera_boxes=CameraBoxes(nothing, image, np.ones(2)))
    laser, camera = scans_of(sequence, camera=True)
    motion = ConstantTurn(("z", "height", "width", "length"), accelerates=False)
    x = np.zeros((2, 9))
    x[:, :2], x[:, 2], x[:, 5], x[:, 6:] = whole.position[:, :2], whole.heading, whole.position[:, 2], whole.size
    for scan, sensor, rows in ((laser, BoxDetector, [0, 1]), (camera, ImageBox, [0])):
        measure, _ = sensor_formulas(motion, sensor, 0)  # type: ignore[arg-type]
        found = measure(x, scan.pose[None])
        exact = found[rows] if sensor is BoxDetector else found[rows][:, :2]
        np.testing.assert_allclose(scan.values[rows][:, : exact.shape[1]], exact, atol=1e-6)
    assert camera.values[0, 2] == pytest.approx(1.5 / 18.0, rel=0.1)  # of the nearest corner
    np.testing.assert_allclose(laser.score, [0.5, expit(0.85 * 5.0)])
    std = np.sqrt(np.diagonal(laser.noise, 0, 1, 2))
    np.testing.assert_allclose(std[1] * [1, laser.values[1, 0], 1, 1, 1, 1, 1], [0.12, 0.07, 0.05, 0.08, 0.1, 0.1, 0.3])
    np.testing.assert_allclose(std[0, 2:] / std[1, 2:], np.exp(0.15 * 5.0))
    other = scans_of(sequence, slope=0.4, sharpening=0.1)[0]
    np.testing.assert_allclose(other.score, [0.5, expit(0.4 * 5.0)])
    np.testing.assert_allclose(np.sqrt(np.diagonal(other.noise, 0, 1, 2))[0, 2:] / std[1, 2:], np.exp(0.1 * 5.0))
    assert (np.diagonal(camera.noise, 0, 1, 2)[1] == 1.0).tolist() == [False, True, False]  # cut off at the right


def test_pictures_show_the_paths_of_cars_and_vans_only() -> None:
    truth, _ = beside_a_hedge(0)
    labels = truth.labels
    kind = labels.kind.copy()
    kind[0] = "Pedestrian"
    paths = paths_of(truth._replace(labels=labels._replace(kind=kind)))
    np.testing.assert_array_equal(paths.label, labels.track[1:])
    np.testing.assert_array_equal(paths.position, labels.position[1:, :2])
    assert paths.offset.tolist() == np.maximum(labels.offset - 1, 0).tolist()
    np.testing.assert_array_equal(paths.time, truth.sequence.time)
