"""Detectors of boxes: machine code against torch, views, false alarms, and what an image says of a box."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from models.multi_object import Bernoullis, Components, no_components
from models.objects.box_detector import BoxDetector, ImageBox
from models.objects.motion import ConstantTurn, ConstantVelocity, Motion
from models.objects.scans import Recording, Scan
from models.objects.scene import rows_of, scan_set, simulate_scan
from models.objects.sensors import Sensor, sensor_formulas, spread_formula
from models.objects.traffic import Kind, Traffic
from models.program import quiet_doubles

BOX = ("z", "height", "width", "length")
TURN, VELOCITY = ConstantTurn(BOX, accelerates=False), ConstantVelocity(("heading", *BOX))
LASER = BoxDetector(name="laser", noise_std=(0.25, 0.01, 0.1, 0.16, 0.2, 0.2, 0.6), angle=1.4, reach=(0.0, 70.0))
IMAGE = ImageBox(name="image", noise_std=(0.003, 0.003, 0.002), angle=1.4, reach=(0.0, 70.0), occlusion=0.9)
POSE = np.array([3.0, -2.0, 0.7])
KIND = Kind(
    noise=(2.5, 0.3, 0.06, 0.1, 0.02, 0.02, 0.02),
    extras=((0.0, 30.0), (1.53, 0.14), (1.63, 0.12), (3.9, 0.45)),
)


def near(motion: Motion, num: int = 6) -> np.ndarray:
    """States of cars before the sensor."""
    rng = np.random.default_rng(0)
    angle, distance = POSE[2] + rng.uniform(-0.6, 0.6, num), rng.uniform(8.0, 60.0, num)
    x = rng.normal(0.0, 1.0, (num, len(motion.names)))
    x[:, 0], x[:, 1] = POSE[0] + distance * np.cos(angle), POSE[1] + distance * np.sin(angle)
    x[:, -4:] = [-1.5, 1.5, 1.6, 4.0] + 0.1 * rng.normal(size=(num, 4))
    return x


@pytest.mark.parametrize("motion", [TURN, VELOCITY], ids=["turn", "velocity"])
@pytest.mark.parametrize("sensor", [LASER, IMAGE], ids=lambda sensor: sensor.name)
def test_machine_code_and_torch_agree_with_their_jacobians(sensor: Sensor, motion: Motion) -> None:
    x = near(motion)
    measure, detect = sensor_formulas(motion, type(sensor), len(sensor.settings))  # type: ignore[arg-type]
    there, p = torch.from_numpy(x), torch.from_numpy(POSE)
    y, J = np.empty((len(x), len(sensor.names))), np.empty((len(x), len(sensor.names), x.shape[1]))
    measure.compiled()(x, POSE[None], y, J)
    np.testing.assert_allclose(y, measure.torch(there, p).numpy(), atol=1e-12)
    slopes = torch.func.vmap(torch.func.jacrev(lambda v: measure.torch(v, p)))(there)
    np.testing.assert_allclose(J, slopes.numpy(), atol=1e-12)
    settings = np.array([*POSE, *sensor.settings, 0.2])
    found = detect(x, settings[None])
    np.testing.assert_allclose(found, detect.torch(there, torch.from_numpy(settings)).numpy(), atol=1e-14)
    assert ((found >= 0.0) & (found <= 1.0)).all()
    spread = spread_formula(type(sensor), len(sensor.noise_settings))  # type: ignore[arg-type]
    std = spread.torch(torch.from_numpy(y), torch.tensor(sensor.noise_settings, dtype=torch.float64)).numpy()
    covariance = sensor.covariance(Scan(sensor.name, 0.0, y, POSE))
    np.testing.assert_allclose(np.broadcast_to(np.sqrt(np.diagonal(covariance, 0, 1, 2)), std.shape), std, rtol=1e-12)


@pytest.mark.parametrize("sensor", [LASER, IMAGE], ids=lambda sensor: sensor.name)
def test_filters_and_the_program_are_told_the_same(sensor: Sensor) -> None:
    model, x = Traffic((sensor,), TURN, (KIND,)), near(TURN)
    num = len(x)
    objects = Bernoullis(
        np.arange(num),
        np.ones(num),
        Components(
            np.arange(num + 1), np.ones(num), np.zeros(num, np.int64), x, np.tile(np.eye(x.shape[1]), (num, 1, 1))
        ),
    )
    scan = Scan(sensor.name, 0.0, np.tile(0.1, (2, len(sensor.names))), POSE)
    view = model.view(scan, objects, no_components(x.shape[1], 2))
    program = scan_set(model, scan, torch.zeros(num, dtype=torch.long), torch.from_numpy(x), torch.ones(num))
    np.testing.assert_allclose(view.predicted, program.predicted.numpy(), atol=1e-12)
    np.testing.assert_allclose(view.detection, program.detection.numpy(), atol=1e-12)
    np.testing.assert_allclose(view.clutter, program.clutter(torch.from_numpy(view.values)).numpy(), rtol=1e-12)


def test_false_alarms_of_boxes_add_up_to_their_density_times_the_area_in_view() -> None:
    loc, std = np.array(LASER.clutter_shape).T
    rng, num = np.random.default_rng(1), 200_000
    low, high = np.array([(0.0, 70.0), (-0.7, 0.7), (-math.pi / 2, math.pi / 2)]).T
    z = np.concatenate([rng.uniform(low, high, (num, 3)), rng.normal(loc, std, (num, 4))], 1)
    shape = np.exp(-0.5 * np.square((z[:, 3:] - loc) / std).sum(1)) / np.prod(std * math.sqrt(2 * math.pi))
    weight = LASER.clutter_intensity(z) / shape * np.prod(high - low)
    area = 0.5 * 70.0**2 * 1.4
    assert weight.mean() == pytest.approx(LASER.clutter_density * area, abs=4 * weight.std() / math.sqrt(num))
    assert LASER.false_alarms == pytest.approx(LASER.clutter_density * area, rel=1e-12)


def test_simulated_false_alarms_of_boxes_are_uniform_on_the_ground() -> None:
    """As many as the density expects, which then is that of the set: log p of an empty scan of nobody is minus it."""
    model, nobody = Traffic((replace(LASER, clutter_density=0.05),), TURN, (KIND,)), np.zeros((0, len(TURN.names)))
    scan, source = simulate_scan(model, "laser", 0.0, POSE, np.zeros(0, np.int64), nobody, 1)
    expected = 0.05 * 0.7 * 70.0**2
    num, z = len(source), scan.values
    assert abs(num - expected) < 4 * math.sqrt(expected)
    assert abs(np.square(z[:, 0]).mean() - 70.0**2 / 2) < 4 * 70.0**2 / math.sqrt(12 * num)
    loc, std = np.array(LASER.clutter_shape).T
    assert (np.abs(z[:, 3:].mean(0) - loc) < 4 * std / math.sqrt(num)).all()
    assert (np.abs(z[:, 3:].std(0) / std - 1.0) < 4 / math.sqrt(2 * num)).all()
    none = torch.zeros(0, dtype=torch.long), torch.from_numpy(nobody), torch.zeros(0)
    empty = scan._replace(values=z[:0])
    with quiet_doubles():
        found = scan_set(model, empty, *none).log_prob(rows_of(model, empty))
    assert float(found) == pytest.approx(-expected, rel=1e-12)


def test_an_image_box_is_the_hull_of_the_four_corners() -> None:
    """A car straight ahead, and one across, whose nearest side is wider."""
    measure, _ = sensor_formulas(TURN, ImageBox, len(IMAGE.settings))
    x = np.array(
        [[20.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.5, 1.6, 4.0], [20.0, 3.0, math.pi / 2, 0.0, 0.0, 0.0, 1.5, 1.6, 4.0]]
    )
    found = measure(x, np.zeros((1, 3)))
    np.testing.assert_allclose(found[0], [math.atan2(0.8, 18.0), -math.atan2(0.8, 18.0), 1.5 / 18.0], rtol=1e-12)
    np.testing.assert_allclose(found[1], [math.atan2(5.0, 19.2), math.atan2(1.0, 20.8), 1.5 / 19.2], rtol=1e-12)


def test_corners_behind_the_camera_are_at_its_plane() -> None:
    """A car beside the camera, half of it passed: it reaches the border of what can be seen, and errors stay finite."""
    measure, _ = sensor_formulas(TURN, ImageBox, len(IMAGE.settings))
    x = np.array([[1.0, 3.0, 0.0, 0.0, 0.0, 0.0, 1.5, 1.6, 4.0]])
    found = measure(x, np.zeros((1, 3)))[0]
    np.testing.assert_allclose(found, [math.atan2(3.8, 0.3), math.atan2(2.2, 3.0), 1.5 / 0.3], rtol=1e-12)


def test_detection_ends_softly_at_the_border_of_the_image_and_far_away() -> None:
    _, detect = sensor_formulas(TURN, BoxDetector, len(LASER.settings))

    def seen(distance: float, bearing: float) -> float:
        x = np.array([[distance * math.cos(bearing), distance * math.sin(bearing), 0, 0, 0, 0, 1.5, 1.6, 4.0]])
        return float(detect(x, np.array([[0.0, 0.0, 0.0, *LASER.settings, 0.0]]))[0, 0])

    assert seen(20.0, 0.0) == pytest.approx(LASER.detection, abs=1e-4)
    assert seen(70.0, 0.0) == pytest.approx(LASER.detection / 2, abs=1e-12)
    assert seen(20.0, 0.7) == pytest.approx(0.75 * LASER.detection, abs=1e-4)  # half of it is in view
    assert seen(20.0, 0.7 + 0.061) == seen(20.0, math.pi) == 0.0


def test_boxes_begin_tracks_and_image_boxes_do_not() -> None:
    model, x = Traffic((LASER, IMAGE), TURN, (KIND,)), near(TURN, 3)
    scan, source = simulate_scan(model, "laser", 0.0, POSE, np.zeros(3, np.int64), x, 0)
    assert len(source) >= 2
    found = model.unseen(model.prepare(Recording((scan,)))[0].scan)
    own = source >= 0
    np.testing.assert_allclose(found.mean[own, :2], x[source[own], :2], atol=1.5)  # 5 sigma of range
    image, _ = simulate_scan(model, "image", 0.0, POSE, np.zeros(3, np.int64), x, 0)
    assert len(model.unseen(image).weight) == 0
