"""Simulated traffic: its truth moves as it says, and its sensors see what their numbers say."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hydra import compose, initialize_config_module
from scipy.optimize import linear_sum_assignment

from experiments.command import plain
from experiments.lead_metrics import metrics as lead_metrics
from experiments.placed_readings import PlacedReadings
from experiments.scenarios.close_targets import APART, SWAY, close_targets
from experiments.scenarios.crossing_targets import crossing_targets
from experiments.scenarios.lead_vehicle import LASER_STD, LEAD, POSE_STD, lead_vehicle
from experiments.scenarios.scene import Scene, TrafficTruth
from experiments.scenarios.urban_sensors import BAD_WEATHER, CONFUSED, SUITE, suite, urban_sensors
from experiments.schema import build
from experiments.signatures import ConfigError
from experiments.view_metrics import in_view
from inference.tracks import Tracks
from models.objects.sensors import Sensor, mounted
from models.program import InputError

CROSSING, URBAN = crossing_targets(3), urban_sensors(1)
LEADING, CLOSE = lead_vehicle(2, duration=20.0), close_targets(4)


def of(scene: Scene, sensor: str) -> list[Any]:
    return [scan for scan in scene.data.scans if scan.sensor == sensor]


def rows_at(truth: TrafficTruth, time: float) -> slice:
    t = int(np.abs(truth.time - time).argmin())
    assert abs(truth.time[t] - time) < 1e-9
    return slice(truth.offset[t], truth.offset[t + 1])


@pytest.mark.parametrize(
    ("scene", "limit"),
    [(CROSSING, 1e-9), (CLOSE, 0.1), (URBAN, 1e-3), (LEADING, 1e-3)],
    ids=["crossing", "close", "urban", "lead"],
)
def test_the_truth_moves_by_its_velocities(scene: Scene, limit: float) -> None:
    """Between two rows of a label at successive times, by the trapezoid rule: off by dt^3 / 12 of the jerk."""
    truth = scene.truth
    when = np.repeat(np.arange(len(truth.time)), np.diff(truth.offset))
    assert len(np.unique(when * 1000 + truth.label)) == len(when)
    followed = 0
    for label in np.unique(truth.label):
        own = np.flatnonzero(truth.label == label)
        a, b = own[:-1][np.diff(when[own]) == 1], own[1:][np.diff(when[own]) == 1]
        dt = (truth.time[when[b]] - truth.time[when[a]])[:, None]
        velocity = np.stack([truth.vx, truth.vy], -1)
        gap = truth.position[b] - truth.position[a] - 0.5 * dt * (velocity[a] + velocity[b])
        assert np.abs(gap).max(initial=0.0) < limit
        followed += len(a)
    assert followed > 0.9 * len(when)


def test_plots_have_the_noise_the_share_and_the_false_alarms_they_say() -> None:
    """Each within four standard errors: noise of positions without false alarms; counts, binomial and Poisson."""
    clean = crossing_targets(5, clutter=0.0, detection=1.0, noise=2.0)
    gaps = list[np.ndarray]()
    for scan in clean.data.scans:
        true = clean.truth.position[rows_at(clean.truth, scan.time)]
        assert len(true) == len(scan.values)
        pairs = linear_sum_assignment(np.linalg.norm(true[:, None] - scan.values, axis=-1))
        gaps.append(scan.values[pairs[1]] - true[pairs[0]])
    off = np.concatenate(gaps)
    # where targets begin at one place, the assignment swaps them to what fits better: 5 scans of 100
    assert np.all(np.abs(off.std(0) / 2.0 - 1.0) < 4.0 / math.sqrt(2 * len(off)) + 0.02)
    num, there = len(CROSSING.data.scans), len(CROSSING.truth.x)
    seen = crossing_targets(5, clutter=0.0)
    count = sum(len(scan.values) for scan in seen.data.scans)
    assert abs(count - 0.98 * there) < 4.0 * math.sqrt(there * 0.98 * 0.02)
    alarms = sum(len(scan.values) for scan in crossing_targets(5, detection=0.0, clutter=66.0).data.scans)
    assert abs(alarms - 66 * num) < 4.0 * math.sqrt(66 * num)


def test_the_benchmark_is_that_of_vo() -> None:
    """Twelve targets, ten at most at a time, the first three at once and two of them gone after 69 scans."""
    truth = CROSSING.truth
    count = np.diff(truth.offset)
    assert [count[0], count[18], count[19], count.max()] == [3, 3, 6, 10]
    assert len(np.unique(truth.label)) == 12 and count.sum() == 727
    assert set(truth.label[rows_at(truth, 69.0)]) & {0, 2} == set()
    assert np.abs(truth.position).max() < 1000.0


@pytest.mark.parametrize("pattern", ["abreast", "column", "meeting"])
def test_vehicles_are_as_close_as_asked_for(pattern: Any) -> None:
    """Gaps to the next one, but for the sway, of which the way since the start has a variance of 2 SWAY^2 KEEPING t."""
    truth = close_targets(1, pattern=pattern, number=3, spacing=4.0).truth
    place = truth.position.reshape(-1, 3, 2)
    gap = np.linalg.norm(np.diff(place, axis=1), axis=-1)
    slack = 4.0 * SWAY * math.sqrt(2.0 * 2.0 * 4.0 * truth.time[-1])
    middle = len(gap) // 2
    assert np.abs(gap[middle] - 4.0).max() < slack
    assert np.abs(gap[0] - (APART * 4.0 if pattern == "meeting" else 4.0)).max() < 1e-9
    along = np.diff(place[middle], axis=0)[:, 0 if pattern == "column" else 1]
    assert np.all(np.abs(np.abs(along) - 4.0) < slack)


@pytest.mark.parametrize(
    "scenario",
    [
        crossing_targets,
        close_targets,
        lambda seed: urban_sensors(seed, duration=1.0),
        lambda seed: lead_vehicle(seed, 1.0),
    ],
    ids=["crossing", "close", "urban", "lead"],
)
def test_seeds_reproduce(scenario: Callable[[int], Scene]) -> None:
    first, again, other = scenario(7), scenario(7), scenario(8)
    for a, b in zip(first.data.scans, again.data.scans, strict=True):
        assert (a.sensor, a.time) == (b.sensor, b.time)
        np.testing.assert_array_equal(a.values, b.values)
    assert any(
        a.values.shape != b.values.shape or (a.values != b.values).any()
        for a, b in zip(first.data.scans, other.data.scans, strict=True)
    )


def in_sight(scene: Scene, sensor: Sensor) -> int:
    """How many objects the scans of a sensor could have detected, for certain within its view."""
    total = 0
    for scan in of(scene, sensor.name):
        rows = rows_at(scene.truth, scan.time)
        at = mounted(scan.pose, sensor.mount)
        gap = scene.truth.position[rows] - at[:2]
        bearing = np.arctan2(gap[:, 1], gap[:, 0]) - at[2]
        bearing = (bearing + math.pi) % (2 * math.pi) - math.pi
        total += int(((np.abs(bearing) < sensor.angle / 2) & (np.hypot(*gap.T) < sensor.reach[1])).sum())
    return total


@pytest.mark.parametrize("sensor", SUITE, ids=[s.name for s in SUITE])
def test_sensors_detect_and_err_as_often_as_they_say(sensor: Sensor) -> None:
    """Measurements in all: within four standard errors, and 3 % of what is in sight, of which borders are soft."""
    scene = urban_sensors(1, number=40)
    scans = of(scene, sensor.name)
    count, there = sum(len(scan.values) for scan in scans), in_sight(scene, sensor)
    expected = sensor.detection * there + sensor.clutter * len(scans)
    error = math.sqrt(there * sensor.detection * (1 - sensor.detection) + sensor.clutter * len(scans))
    assert abs(count - expected) < 4.0 * error + 0.03 * sensor.detection * there


def test_each_sensor_has_its_own_clock_and_scans_arrive_in_order_of_time() -> None:
    times = {name: np.array([scan.time for scan in of(URBAN, name)]) for name in ("radar", "laser", "camera")}
    assert {name: round(float(np.diff(t).max()), 6) for name, t in times.items()} == {
        "radar": 0.07, "laser": 0.08, "camera": 0.07,
    }  # fmt: skip
    assert np.all(np.diff([scan.time for scan in URBAN.data.scans]) >= 0.0)
    assert {scan.time for scan in URBAN.data.scans} == set(URBAN.truth.time.tolist())


def test_late_scans_are_the_same_scans_later() -> None:
    plain, late = urban_sensors(2, duration=2.0), urban_sensors(2, duration=2.0, latency=0.1)
    order = sorted(range(len(plain.data.scans)), key=lambda i: plain.data.scans[i].time)
    assert order == list(range(len(order)))
    by_time = sorted(late.data.scans, key=lambda scan: (scan.time, scan.sensor))
    for a, b in zip(sorted(plain.data.scans, key=lambda scan: (scan.time, scan.sensor)), by_time, strict=True):
        np.testing.assert_array_equal(a.values, b.values)
    arrival = [scan.time + 0.1 * (scan.sensor == "camera") for scan in late.data.scans]
    assert np.all(np.diff(arrival) >= -1e-12)
    assert np.any(np.diff([scan.time for scan in late.data.scans]) < 0.0)


def test_a_sensor_that_drops_out_says_nothing_and_changes_nothing_else() -> None:
    plain, without = (
        urban_sensors(3, duration=2.0),
        urban_sensors(3, duration=2.0, dropout="laser", dropout_from=0.5, dropout_to=1.5),
    )
    left = [s for s in plain.data.scans if s.sensor != "laser" or not 0.5 <= s.time < 1.5]
    assert len(left) < len(plain.data.scans)
    for a, b in zip(left, without.data.scans, strict=True):
        assert (a.sensor, a.time) == (b.sensor, b.time)
        np.testing.assert_array_equal(a.values, b.values)


def test_in_bad_weather_the_camera_misses_more() -> None:
    """The share of what it detects, without the false alarms expected: within four standard errors and the borders."""
    camera = SUITE[2]
    scene = urban_sensors(1, number=40, bad_weather=True)
    scans, there = of(scene, "camera"), in_sight(scene, camera)
    count = sum(len(scan.values) for scan in scans) - camera.clutter * len(scans)
    share = camera.detection * (1 - BAD_WEATHER) / (1 - BAD_WEATHER * camera.detection)  # by Dempster's rule
    error = math.sqrt(there * share * (1 - share) + camera.clutter * len(scans))
    assert abs(count - share * there) < 4.0 * error + 0.03 * share * there


def test_the_camera_tells_kinds_apart_and_one_kind_needs_no_telling() -> None:
    likeness = np.concatenate([scan.likeness for scan in of(URBAN, "camera")])
    assert likeness.shape[1] == 3
    right = (1.0 - 2.0 * CONFUSED) * 3.0
    np.testing.assert_allclose(np.sort(likeness, 1), np.tile([3 * CONFUSED, 3 * CONFUSED, right], (len(likeness), 1)))
    assert all(scan.likeness is None for scan in of(urban_sensors(0, duration=0.5, kinds=("car",)), "camera"))


def test_the_car_ahead_is_30_to_100_m_away_and_others_come_the_other_way() -> None:
    scene = lead_vehicle(0, duration=60.0, sensors="radar")
    truth = scene.truth
    lead = truth.label == LEAD
    pose = np.array([scan.pose for scan in scene.data.scans])
    here = np.array([truth.position[rows_at(truth, scan.time)][0] for scan in scene.data.scans])
    assert np.all(truth.label[truth.offset[:-1]] == LEAD)  # in view all the time
    distance = np.hypot(*(here - pose[:, :2]).T)
    assert 28.0 < distance.min() < 31.0 and 97.0 < distance.max() < 100.5
    assert np.all(np.cos(truth.heading[lead]) > 0.9) and np.all(np.cos(truth.heading[~lead]) < -0.9)
    assert {scan.sensor for scan in scene.data.scans} == {"radar"}
    assert set(np.unique(lead_vehicle(0, 5.0, oncoming=False).truth.label)) == {LEAD}


def test_poses_are_as_wrong_as_they_say() -> None:
    """Standard deviations of about 800 poses within four standard errors; what sensors see is of the true ones."""
    true, wrong = lead_vehicle(1, 20.0), lead_vehicle(1, 20.0, pose_noise=2.0)
    off = np.array([b.pose - a.pose for a, b in zip(true.data.scans, wrong.data.scans, strict=True)])
    np.testing.assert_allclose(off.std(0), 2.0 * np.array(POSE_STD), rtol=4.0 / math.sqrt(2 * len(off)))
    for a, b in zip(true.data.scans, wrong.data.scans, strict=True):
        np.testing.assert_array_equal(a.values, b.values)


@pytest.mark.parametrize(
    ("scenario", "options", "words"),
    [
        (crossing_targets, {"clutter": -1.0}, "clutter -1.0"),
        (crossing_targets, {"noise": 0.0}, "noise 0.0"),
        (crossing_targets, {"detection": 1.5}, "detection is 1.5"),
        (crossing_targets, {"clutter": math.nan}, "clutter nan"),
        (crossing_targets, {"clutter": 1e9}, "0 to 100000 false alarms a scan"),
        (close_targets, {"number": 1}, "two vehicles or more"),
        (close_targets, {"spacing": math.nan}, "spacing is nan"),
        (close_targets, {"duration": 100.0}, "duration 100.0"),
        (urban_sensors, {"number": 0}, "number 0"),
        (urban_sensors, {"kinds": ("car", "tram")}, r"kinds are \['car', 'tram'\]"),
        (urban_sensors, {"sensors": ()}, r"sensors are \[\]"),
        (urban_sensors, {"sensors": ("radar",), "dropout": "laser"}, "laser drops out"),
        (urban_sensors, {"dropout": "laser", "dropout_from": 5.0, "dropout_to": 5.0}, "ends after it begins"),
        (urban_sensors, {"latency": -0.1}, "latency is -0.1"),
        (urban_sensors, {"seed": -1}, "seed is -1"),
        (lead_vehicle, {"duration": math.inf}, "duration inf"),
        (lead_vehicle, {"pose_noise": -1.0}, "pose_noise -1.0"),
    ],
)
def test_nonsense_is_refused_in_words(scenario: Callable[..., Scene], options: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        scenario(**options)


def composed(*words: str) -> Any:
    with initialize_config_module("configs", version_base="1.3"):
        return plain(compose("run", list(words)))


def test_models_of_configs_have_the_sensors_of_the_scenarios() -> None:
    """But for rounding. The laser on the rural road is another."""
    urban, rural = (build(composed(f"model={name}")["model"], "model") for name in ("traffic_urban", "traffic_rural"))
    small = build(composed("model=traffic_vulnerable")["model"], "model")
    city = suite(urban.kind_names, ("radar", "laser", "camera"))
    for model, known in ((urban, city), (rural, SUITE), (small, suite(small.kind_names, ("laser", "camera")))):
        for own, true in zip(model.sensors, known, strict=True):
            noise = LASER_STD if model is rural and own.name == "laser" else true.noise_std
            assert (type(own), own.name, own.mount, own.births) == (type(true), true.name, true.mount, true.births)
            for a, b in ((own.noise_std, noise), (own.reach, true.reach), (own.confusion or (), true.confusion or ())):
                np.testing.assert_allclose(a, b, rtol=1e-3)
            assert (own.detection, own.clutter) == (true.detection, true.clutter)
            assert own.angle == pytest.approx(true.angle, rel=1e-4)


@pytest.mark.parametrize("name", ["crossing_targets", "crossing_targets_places", "close_targets"])
def test_the_filter_knows_the_sensor_of_an_experiment(name: str) -> None:
    scene = name.removesuffix("_places")
    config = composed(f"experiment={name}", "scenario.clutter=7", "scenario.noise=3")
    (sensor,) = build(config["model"], "model").sensors
    assert (sensor.clutter, sensor.noise_std) == (7.0, (3.0, 3.0))
    assert config["scenario"]["_target_"].endswith(scene)
    assert sensor.births == (not name.endswith("places"))


def test_a_misspelt_key_of_a_sensor_is_named() -> None:
    from omegaconf import OmegaConf

    from experiments.schema import expand

    sensor = {"_target_": "models.objects.sensors.Radar", "name": "radar", "noise_std": [1, 1, 1], "detektion": 1}
    config = OmegaConf.create({"model": {"_target_": "models.objects.traffic.Traffic", "sensors": [sensor]}})
    with pytest.raises(ConfigError, match=r"sensors\.?\[?0\]? has no knob 'detektion'; did you mean 'detection'\?"):
        expand(config)


def test_settings_in_settings_are_tuples_and_can_be_hashed() -> None:
    model = build(composed("model=traffic_urban")["model"], "model")
    assert isinstance(model.sensors[2].confusion[0], tuple)
    assert hash(model.kinds) and hash(model.sensors)


def test_measurements_are_drawn_where_they_were_made() -> None:
    """The laser's, in the world, are within 5 standard deviations of a vehicle or false alarms."""
    model = build(composed("model=traffic_rural")["model"], "model")
    near, total = 0, 0
    for time, position in PlacedReadings(model)(LEADING.data):
        true = LEADING.truth.position[rows_at(LEADING.truth, time)]
        gap = np.linalg.norm(position[:, None] - true, axis=-1)
        near, total = near + int((gap.min(0) < 6.0).sum()), total + len(true)
    assert near > 0.7 * total
    assert not {scan.time for scan in of(LEADING, "camera")} <= {t for t, _ in PlacedReadings(model)(LEADING.data)}


def test_the_car_ahead_is_scored_by_the_nearest_estimate() -> None:
    """A track a metre to the left of it, which is lost for the second half, but for one 5 m away."""
    truth = LEADING.truth
    place = np.array([truth.position[o] for o in truth.offset[:-1]])
    half, num = len(place) // 2, len(place)
    mean = place + np.where(np.arange(num)[:, None] < half, [0.0, 1.0], [3.0, 4.0])
    tracks = Tracks(
        time=truth.time, offset=np.arange(num + 1), label=(np.arange(num) >= half).astype(np.int64),
        existence=np.full(num, 0.9), mean=mean, covariance=np.tile(0.5 * np.eye(2), (num, 1, 1)),
        kind=np.ones((num, 1)), names=("x", "y"), kind_names=("car",), sensor=("radar",) * num,
    )  # fmt: skip
    scored = truth.time >= 2.0
    early = (np.arange(num) < half) & scored
    found = lead_metrics(tracks, LEADING)
    assert found["lead_m"] == pytest.approx((early.sum() + 5.0 * (scored & ~early).sum()) / scored.sum())
    assert found["lead_miss"] == pytest.approx((scored & ~early).sum() / scored.sum())
    assert found["lead_nees"] == pytest.approx(2.0)
    assert (found["lead_labels"], found["lead_95_m"]) == (1.0, pytest.approx(5.0))
    assert lead_metrics(tracks, CROSSING) == {}


def test_tracks_outside_every_view_are_not_scored() -> None:
    """The car drives on: 50 m ahead of it and 50 m behind, each at every scan; and what no sensor in use can see."""
    pose = np.array([scan.pose for scan in LEADING.data.scans])
    num, way = len(pose), np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], -1)
    mean = np.stack([pose[:, :2] + 50.0 * way, pose[:, :2] - 50.0 * way], 1).reshape(-1, 2)
    tracks = Tracks(
        time=np.array([scan.time for scan in LEADING.data.scans]), offset=2 * np.arange(num + 1),
        label=np.tile([0, 1], num), existence=np.full(2 * num, 0.9), mean=mean,
        covariance=np.tile(np.eye(2), (2 * num, 1, 1)), kind=np.ones((2 * num, 1)), names=("x", "y"),
        kind_names=("car",), sensor=("radar",) * num,
    )  # fmt: skip
    model = build(composed("model=traffic_rural")["model"], "model")
    kept = in_view(tracks, LEADING.data, model)
    assert kept.label.tolist() == [0] * num and kept.offset.tolist() == list(range(num + 1))
    np.testing.assert_array_equal(kept.mean, mean[::2])
    aside = pose[:, :2] + 50.0 * np.stack([-way[:, 1], way[:, 0]], -1)
    beside = replace(kept, mean=aside, draws={})
    assert len(in_view(beside, LEADING.data, model).label) == num  # the laser sees it
    only = LEADING.data._replace(scans=tuple(of(LEADING, "radar")))
    assert len(in_view(beside, only, model).label) == 0
