"""Outlines: what laser points show of a rectangle, and what a filter makes of sides seen at different times."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module
from numpy.typing import NDArray

from experiments.command import plain
from experiments.scenarios.laser_beams import Laser, sweep
from experiments.scenarios.laser_outlines import Outlines, outlines
from experiments.scenarios.urban_sensors import urban_sensors
from experiments.schema import build
from experiments.tracking_metrics import metrics
from inference import lmb
from inference.tracks import Tracks
from models.multi_object import no_objects
from models.objects.motion import ConstantTurn
from models.objects.outline import UNSEEN, LaserOutline
from models.objects.scans import Scan
from models.objects.sensors import mounted, sensor_formulas
from models.objects.traffic import Kind, Traffic

Floats = NDArray[np.float64]
LASER = Laser()
TURN = ConstantTurn(extras=("length", "width"))
SENSOR = LaserOutline(name="laser", noise_std=(0.05, 0.05, 0.1, 0.1, 0.1), angle=math.radians(210.0), clutter=0.5)
CAR = Kind(name="car", noise=(0.6, 0.15, 0.01, 0.005, 0.005), extras=((4.5, 0.5), (1.8, 0.2)))
WALKER = Kind(name="pedestrian", noise=(0.2, 0.3, 0.01, 0.005, 0.005), extras=((0.5, 0.1), (0.5, 0.1)))
PLACES = ((10.0, 0.4), (25.0, -1.0), (50.0, 0.0))


def look(rectangle: tuple[float, ...], *others: tuple[float, ...], laser: Laser = LASER, seed: int = 0) -> Outlines:
    rng = np.random.default_rng(seed)
    return outlines(sweep(laser, np.zeros(3), SENSOR.angle, 200.0, np.array([rectangle, *others]), rng), laser)


def true_values(x: float, y: float, heading: float, length: float, width: float) -> Floats:
    u, v = np.array([math.cos(heading), math.sin(heading)]), np.array([-math.sin(heading), math.cos(heading)])
    size = length * np.outer(u, u) + width * np.outer(v, v)
    return np.array([x, y, size[0, 0], size[0, 1], size[1, 1]])


def square_of(seen: Outlines, true: Floats) -> float:
    return float((seen.values[0] - true) @ np.linalg.solve(seen.noise[0], seen.values[0] - true))


def unseen_in(noise: Floats) -> int:
    return round((noise[2, 2] + 2 * noise[2, 4] + noise[4, 4]) / UNSEEN**2)


def measured(x: Floats, at: Floats) -> tuple[Floats, Floats]:
    formula, _ = sensor_formulas(TURN, LaserOutline, len(SENSOR.settings))  # type: ignore[arg-type]
    z, J = np.empty((len(x), 5)), np.empty((len(x), 5, x.shape[1]))
    formula.compiled()(x, at[None], z, J)
    slopes = torch.func.vmap(torch.func.jacrev(lambda v: formula.torch(v, torch.from_numpy(at))))(torch.from_numpy(x))
    np.testing.assert_allclose(J, slopes.numpy(), atol=1e-12)
    return z, J


def test_what_is_measured_is_the_rectangle_and_its_slope_that_of_torch() -> None:
    """By products of matrices in the frame of the sensor; and a rectangle is the same one turned by a right angle with
    its sides swapped, or by a half turn."""
    rng = np.random.default_rng(0)
    at = mounted(np.array([3.0, -2.0, 0.4]), (3.5, 0.2, 0.3))
    x = np.hstack([rng.normal(0.0, 20.0, (20, 2)), rng.normal(0.0, 2.0, (20, 4)), rng.uniform(0.5, 6.0, (20, 2))])
    z, _ = measured(x, at)
    cos, sin = math.cos(at[2]), math.sin(at[2])
    for state, found in zip(x, z, strict=True):
        ahead, aside = np.array([[cos, sin], [-sin, cos]]) @ (state[:2] - at[:2])
        np.testing.assert_allclose(found, true_values(ahead, aside, state[2] - at[2], *state[6:]), atol=1e-12)
    turned = x + np.array([0, 0, math.pi / 2, 0, 0, 0, 0, 0])
    turned[:, 6:] = x[:, :5:-1]
    np.testing.assert_allclose(measured(turned, at)[0], z, atol=1e-12)
    placed = SENSOR.place(z, np.tile(np.eye(5), (20, 1, 1)), at)
    np.testing.assert_allclose(placed.position, x[:, :2], atol=1e-12)
    assert placed.heading is not None
    np.testing.assert_allclose(np.cos(placed.heading - x[:, 2:3]).max(1), 1.0, atol=1e-12)


@pytest.mark.parametrize(("distance", "bearing"), PLACES)
def test_outlines_of_exact_points_are_exact_from_all_sides(distance: float, bearing: float) -> None:
    """With hardly any noise and beams a hundredth of a degree apart, what is seen is right to that: to the millimetres
    between two beams where sides end, and within the covariance; what is unseen lies in its direction alone."""
    laser, counts = Laser(math.radians(0.01), 1e-4), set[int]()
    for aspect in np.radians(np.arange(0.0, 180.0, 7.5)):
        own = (distance * math.cos(bearing), distance * math.sin(bearing), bearing + float(aspect), 4.5, 1.8)
        seen, true = look(own, laser=laser), true_values(*own)
        assert len(seen.values) == 1
        unseen = unseen_in(seen.noise[0])
        counts.add(unseen)
        spread = np.sqrt(np.diag(seen.noise[0]))
        if unseen == 0:
            assert np.abs(seen.values[0] - true).max() < 0.05
        known = spread < 0.5
        assert np.all(np.abs(seen.values[0] - true)[known] < 0.01 + 4.0 * spread[known])
        assert square_of(seen, true) < 30.0, "1e-5 of a square with 5 degrees of freedom"
    assert counts <= {0, 1} and 0 in counts


@pytest.mark.parametrize(("size", "far"), [((4.5, 1.8), 90.0), ((1.8, 0.6), 45.0), ((0.5, 0.5), 30.0)])
def test_outlines_are_as_good_as_their_covariances_say(size: tuple[float, float], far: float) -> None:
    """Squares of errors have as many degrees of freedom as are seen, 5 less those unseen; 120 random rectangles: from
    .6 of it (headings of what is seen on one side are told too wide) to four standard errors above it."""
    rng, total, freedom = np.random.default_rng(2), 0.0, 0
    for seed in range(120):
        distance, bearing = rng.uniform(8.0, far), rng.uniform(-1.4, 1.4)
        own = (distance * math.cos(bearing), distance * math.sin(bearing), rng.uniform(-3.0, 3.0), *size)
        seen = look(own, seed=seed)
        assert len(seen.values) == 1
        total += square_of(seen, true_values(*own))
        freedom += 5 - unseen_in(seen.noise[0])
    assert 0.6 * freedom < total < freedom + 4.0 * math.sqrt(2 * freedom)


def test_a_car_half_hidden_is_measured_on_the_side_that_shows() -> None:
    hidden, front = (40.0, 2.0, 0.5, 4.5, 1.8), (20.0, 0.0, 0.0, 4.5, 1.8)
    seen = look(hidden, front)
    assert len(seen.values) == 2
    behind = int(seen.values[:, 0].argmax())
    assert unseen_in(seen.noise[behind]) >= 1
    true = true_values(*hidden)
    assert square_of(Outlines(seen.values[[behind]], seen.noise[[behind]]), true) < 25.0


def follow(way: Floats, size: tuple[float, float], seed: int, kinds: tuple[Kind, ...] = (CAR,)) -> Tracks:
    """Of one rectangle at x, y, heading (T, 3) [m], [rad], ten times a second."""
    kinds = tuple(replace(kind, share=1 / len(kinds)) for kind in kinds)
    model = Traffic((SENSOR,), TURN, kinds, unseen_density=1e-4)
    scans = list[Scan]()
    for t, place in enumerate(way):
        seen = look((*place.tolist(), *size), seed=1000 * seed + t)
        scans.append(Scan("laser", 0.1 * t, seen.values, np.zeros(3), noise=seen.noise))
    return lmb.run(model, scans)


def surest(tracks: Tracks) -> tuple[Floats, Floats, Floats]:
    now = tracks.at(len(tracks.time) - 1)
    best = int(now.existence.argmax())
    assert now.existence[best] > 0.99
    return now.mean[best], now.covariance[best], now.kind[best]


@lru_cache
def round_a_corner(seed: int) -> tuple[Floats, Floats, Floats]:
    """Of a car that comes from the left and turns away: mean, covariance, and its true sizes, drawn from the prior."""
    rng = np.random.default_rng(seed)
    length, width = 4.5 + 0.5 * rng.standard_normal(), 1.8 + 0.2 * rng.standard_normal()
    heading = -math.pi / 2 + np.clip(0.06 * (np.arange(50) - 15), 0.0, math.pi / 2)
    path = np.cumsum(0.6 * np.stack([np.cos(heading), np.sin(heading)], -1), 0)
    way = np.column_stack([path + np.array([18.0, 9.0]), heading])
    mean, covariance, _ = surest(follow(way, (length, width), seed))
    return mean[6:], covariance[6:, 6:], np.array([length, width])


def test_sizes_of_a_car_that_turns_are_found_as_well_as_they_say() -> None:
    """12 cars: to centimetres, and squares by covariance with the mean 2 within four standard errors (2 / sqrt(12))."""
    found = [round_a_corner(seed) for seed in range(12)]
    off = np.array([mean - true for mean, _, true in found])
    squares = [o @ np.linalg.solve(covariance, o) for o, (_, covariance, _) in zip(off, found, strict=True)]
    assert np.sqrt(np.mean(np.square(off), 0)).max() < 0.03
    assert max(np.sqrt(np.diag(covariance)).max() for _, covariance, _ in found) < 0.03
    assert 0.0 < np.mean(squares) < 2.0 + 8.0 / math.sqrt(12)


def test_a_car_seen_from_behind_keeps_the_length_it_was_thought_to_have() -> None:
    """After 60 scans of its rear: the width is known, and the length what it was before, though it is another. It is
    thought to be known better than before, by linearisation (experiments.scenarios.laser_outlines), but not well."""
    way = np.column_stack([15.0 + 0.8 * np.arange(60), np.zeros((60, 2))])
    mean, covariance, _ = surest(follow(way, (5.3, 1.7), 0))
    assert mean[7] == pytest.approx(1.7, abs=0.03)
    assert mean[6] == pytest.approx(4.5, abs=0.15)
    assert 0.28 < math.sqrt(covariance[6, 6]) <= 0.51
    rear = mean[0] - 0.5 * mean[6]
    assert rear == pytest.approx(way[-1, 0] - 0.5 * 5.3, abs=0.05)


@pytest.mark.parametrize(("size", "kind"), [((4.5, 1.8), 0), ((0.5, 0.5), 1)])
def test_how_large_it_is_tells_a_car_from_a_pedestrian(size: tuple[float, float], kind: int) -> None:
    """By the first scan, before it has moved; and from behind, by the width alone."""
    for heading in (0.0, 0.6):
        _, _, share = surest(follow(np.tile([20.0, 0.0, heading], (2, 1)), size, 0, (CAR, WALKER)))
        assert share[kind] > 0.99


@pytest.mark.parametrize("angle", [0.5, 2.0, 3.6652, 5.0, 2 * math.pi])
def test_false_alarms_are_in_the_smallest_rectangle_about_the_view(angle: float) -> None:
    sensor, bearing = replace(SENSOR, angle=angle), np.linspace(-angle / 2, angle / 2, 100_001)
    far = sensor.reach[1] * np.array([np.cos(bearing), np.sin(bearing)])
    view = np.stack([np.minimum(far.min(1), 0.0), np.maximum(far.max(1), 0.0)], 1)
    np.testing.assert_allclose(sensor.span[:2], view, atol=1e-6 * sensor.reach[1])


def test_showing_less_makes_no_false_alarm_of_an_object() -> None:
    """The intensity of first measurements where a size is unseen is that of the other sizes, UNSEEN whatever it is."""
    seen = look((30.0, 0.0, 0.0, 4.5, 1.8))
    scan = Scan("laser", 0.0, seen.values, np.zeros(3), noise=seen.noise)
    assert unseen_in(seen.noise[0]) == 1
    model = Traffic((SENSOR,), TURN, (CAR,), unseen_density=1e-4)
    belief, _ = lmb.step(model, lmb.Belief(None, no_objects(8)), scan, 0, lmb.Knobs())
    assert belief.objects.existence.sum() > 0.9
    plain_feature = super(LaserOutline, SENSOR).feature(scan, 1)
    ratio = SENSOR.feature(scan, 1) / plain_feature
    assert ratio[0, 0] == pytest.approx(math.sqrt(2 * math.pi) * UNSEEN / SENSOR.largest)
    neither = scan._replace(noise=np.eye(5)[None] + UNSEEN**2 * np.diag([0.0, 0.0, 1.0, 0.0, 1.0]))  # a lone point
    assert SENSOR.feature(neither, 1)[0, 0] == pytest.approx(ratio[0, 0] ** 2)
    assert SENSOR.feature(scan._replace(noise=np.eye(5)[None]), 1)[0, 0] == 1.0


def test_outlines_beat_the_middles_of_boxes_on_the_same_scans() -> None:
    """Root mean square position error in a city, by the same beams: less than half of it."""
    found = dict[str, dict[str, float]]()
    for name, option in (("traffic_urban", {"raw_laser": True}), ("traffic_extended", {"outlines": True})):
        with initialize_config_module("configs", version_base="1.3"):
            model = build(plain(compose("run", [f"model={name}"]))["model"], "model")
        scene = urban_sensors(0, number=8, duration=3.0, sensors=("radar", "laser"), **option)  # type: ignore[arg-type]
        found[name] = metrics(lmb.run(model, scene.data.scans), scene)
    boxes, rectangles = found["traffic_urban"], found["traffic_extended"]
    assert rectangles["position_error_m"] < 0.5 * boxes["position_error_m"]
    assert rectangles["missed"] <= boxes["missed"] + 0.1
