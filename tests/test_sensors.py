"""What sensors say of a state, and where a measurement says that something is."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from inference import lmb
from models.multi_object import Bernoullis, Components, no_components, no_objects
from models.objects import traffic as traffic_module
from models.objects.motion import Body, ConstantTurn, ConstantVelocity, Motion
from models.objects.scans import Recording, Scan
from models.objects.scene import simulate_scan
from models.objects.sensors import (
    Camera,
    LaserBox,
    Placed,
    Position,
    Radar,
    RangeBearing,
    Sensor,
    hidden_formula,
    mounted,
    sensor_formulas,
    spread_formula,
)
from models.objects.traffic import Kind, Place, Traffic
from models.program import InputError

Floats = NDArray[np.float64]
POSE = np.array([3.0, -2.0, 0.4])
EXTRAS = ("length", "width")
SENSORS: list[Sensor] = [
    Position(name="plots", noise_std=(10.0, 8.0)),
    RangeBearing(name="laser", noise_std=(0.1, 0.005), mount=(3.0, 0.5, 0.2), angle=3.5),
    Radar(name="radar", noise_std=(0.3, 0.02, 0.15), mount=(3.5, 0.0, 0.0), angle=1.0, reach=(0.25, 60.0)),
    Camera(name="camera", noise_std=(0.002, 0.004), angle=0.98, doubt=0.05, weather=0.3),
    LaserBox(name="boxes", noise_std=(0.1, 0.005, 0.05, 0.2, 0.1)),
]
TURN = ConstantTurn(extras=EXTRAS)
VELOCITY = ConstantVelocity(extras=("heading", *EXTRAS))


def near(motion: Motion, num: int = 30) -> Floats:
    """States about the car, some to the front."""
    rng = np.random.default_rng(4)
    scale = {"x": 25.0, "y": 25.0, "vx": 8.0, "vy": 8.0, "speed": 8.0, "heading": 2.0}
    found = rng.normal(size=(num, len(motion.names))) * [scale.get(name, 0.5) for name in motion.names]
    found[: num // 2, 0] = np.abs(found[: num // 2, 0]) + 10.0
    return found


@pytest.mark.parametrize("motion", [TURN, VELOCITY], ids=["turn", "velocity"])
@pytest.mark.parametrize("sensor", SENSORS, ids=lambda sensor: sensor.name)
def test_machine_code_casadi_and_torch_agree(sensor: Sensor, motion: Motion) -> None:
    x, at = near(motion), mounted(POSE, sensor.mount)
    measure, detect = sensor_formulas(motion, type(sensor), len(sensor.settings))  # type: ignore[arg-type]
    there, p = torch.from_numpy(x), torch.from_numpy(at)
    y, J = np.empty((len(x), len(sensor.names))), np.empty((len(x), len(sensor.names), x.shape[1]))
    measure.compiled()(x, at[None], y, J)
    np.testing.assert_allclose(y, measure.torch(there, p).numpy(), atol=1e-12)
    np.testing.assert_allclose(y[3], np.array(measure.casadi()(x[3], at)).ravel(), atol=1e-12)
    slopes = torch.func.vmap(torch.func.jacrev(lambda v: measure.torch(v, p)))(there)
    np.testing.assert_allclose(J, slopes.numpy(), atol=1e-12)
    settings = np.array([*at, *sensor.settings, 0.2])
    found = detect(x, settings[None])
    np.testing.assert_allclose(found, detect.torch(there, torch.from_numpy(settings)).numpy(), atol=1e-14)
    assert ((found >= 0.0) & (found <= 1.0)).all()


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda sensor: sensor.name)
def test_place_inverts_measure(sensor: Sensor) -> None:
    x, at = near(TURN), mounted(POSE, sensor.mount)
    measure, _ = sensor_formulas(TURN, type(sensor), len(sensor.settings))  # type: ignore[arg-type]
    z, J = np.empty((len(x), len(sensor.names))), np.empty((len(x), len(sensor.names), x.shape[1]))
    measure.compiled()(x, at[None], z, J)
    noise = sensor.covariance(Scan(sensor.name, 0.0, z, POSE))
    noise = np.broadcast_to(noise, (len(z), *noise.shape[1:]))
    placed = sensor.place(z, noise, at)
    np.testing.assert_allclose(placed.position, x[:, :2], atol=1e-6)  # of the 1e-9 under the root of a range
    # the covariance is what the noise of the first two numbers means for a position
    inverse = np.linalg.inv(J[:, :2, :2])
    np.testing.assert_allclose(placed.covariance, inverse @ noise[:, :2, :2] @ inverse.swapaxes(1, 2), rtol=1e-6)
    if placed.heading is not None:
        apart = np.cos(placed.heading - x[:, 2:3])
        np.testing.assert_allclose(apart, [[1.0, -1.0]] * len(x), atol=1e-12)


def test_range_of_a_camera_grows_less_certain_with_its_square() -> None:
    camera = SENSORS[3]
    std = np.sqrt(camera.covariance(Scan("camera", 0.0, np.array([[10.0, 0.1], [40.0, 0.1]]), POSE)))
    assert std[0, 0, 0] == pytest.approx(100.0 / 1.3 * 0.002)
    assert std[1, 0, 0] == pytest.approx(16 * std[0, 0, 0])
    assert std[1, 1, 1] == std[0, 1, 1] == 0.004
    formula = spread_formula(Camera, 3)  # type: ignore[arg-type]
    found = formula.torch(torch.tensor([40.0, 0.1]).double(), torch.tensor(camera.noise_settings).double())
    assert float(found[0]) == pytest.approx(std[1, 0, 0])


def detection(sensor: Sensor, position: tuple[float, float], hidden: float = 0.0) -> float:
    _, detect = sensor_formulas(ConstantVelocity(), type(sensor), len(sensor.settings))  # type: ignore[arg-type]
    at = mounted(np.zeros(3), sensor.mount)
    return float(detect(np.array([[*position, 0.0, 0.0]]), np.array([[*at, *sensor.settings, hidden]]))[0, 0])


def test_detection_is_the_capability_within_the_view_and_zero_outside() -> None:
    sensor = RangeBearing(name="front", noise_std=(0.1, 0.01), angle=1.0, reach=(2.0, 60.0), detection=0.9)
    assert detection(sensor, (30.0, 0.0)) == pytest.approx(0.9, abs=1e-9)
    assert detection(sensor, (60.0, 0.0)) == pytest.approx(0.45, abs=1e-9)  # at the border
    for outside in ((100.0, 0.0), (-30.0, 0.1), (0.0, 30.0), (-1.0, -30.0)):
        assert detection(sensor, outside) < 1e-15
    around = replace(sensor, angle=2 * math.pi, reach=(0.0, 60.0))
    assert detection(around, (-30.0, 0.0)) == detection(around, (30.0, 0.0)) == pytest.approx(0.9, abs=1e-9)
    assert detection(around, (0.01, 0.0)) == pytest.approx(0.9, abs=1e-9)
    sure = replace(sensor, detection=1.0)
    assert detection(sure, (30.0, 0.0)) == pytest.approx(1.0, abs=1e-9)
    assert detection(sure, (-30.0, 0.0)) < 1e-15


def test_weather_and_what_hides_take_detection() -> None:
    sensor = RangeBearing(name="front", noise_std=(0.1, 0.01), detection=0.9)
    assert detection(replace(sensor, weather=0.5), (30.0, 0.0)) == pytest.approx(0.45 / 0.55)
    assert detection(replace(sensor, weather=0.5), (30.0, 0.0), 0.5) == pytest.approx(0.225 / 0.325)
    assert detection(sensor, (30.0, 0.0), 1.0) == 0.0
    assert detection(replace(sensor, detection=1.0), (30.0, 0.0), 1.0) == 0.0  # total conflict


def certain(states: Floats, existence: list[float], kind: list[int] | None = None) -> Bernoullis:
    num = len(states)
    kinds = np.zeros(num, dtype=np.int64) if kind is None else np.array(kind)
    shape = np.broadcast_to(np.eye(states.shape[1]), (num, states.shape[1], states.shape[1])).copy()
    return Bernoullis(
        np.arange(num), np.array(existence), Components(np.arange(num + 1), np.ones(num), kinds, states, shape)
    )


def test_nearer_objects_hide_farther_ones_in_filter_and_program_alike() -> None:
    sensor = RangeBearing(name="front", noise_std=(0.1, 0.01), detection=0.9, occlusion=0.8)
    model = Traffic((sensor,), ConstantVelocity(), (Kind(noise=(1.0, 1.0)),))
    states = np.array([[40.0, 0.0, 0.0, 0.0], [20.0, 0.4, 0.0, 0.0], [0.0, 20.0, 0.0, 0.0]])
    scan = Scan("front", 0.0, np.zeros((0, 2)), np.zeros(3))
    found = model.view(scan, certain(states, [1.0, 1.0, 1.0]), no_components(4)).detection
    share = float(hidden_formula()(np.array([[40.0, 0.0, 20.0, 0.4]]), np.array([[0.0, 0.0, 0.0, 1.0, 1.0]]))[0, 0])
    assert 0.5 < share <= 1.0
    mass = 0.8 * share
    assert found == pytest.approx([0.9 * (1 - mass) / (1 - 0.9 * mass), 0.9, 0.9], abs=1e-9)
    half = model.view(scan, certain(states, [1.0, 0.5, 1.0]), no_components(4)).detection
    assert found[0] < half[0] < 0.9
    from models.objects.scene import scan_set
    from models.program import quiet_doubles

    with quiet_doubles():
        program = scan_set(model, scan, torch.zeros(3, dtype=torch.long), torch.from_numpy(states), torch.ones(3))
    np.testing.assert_allclose(program.detection.numpy(), found, atol=1e-12)


@pytest.mark.parametrize("flat", [30.0, 100.0, 1000.0])
def test_first_measurements_have_the_intensity_of_unseen_objects(flat: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """rho_j = int p_D g(z_j | x) lambda_unseen dx = lambda_unseen p_D |dx / dz|, which is the range for (range,
    bearing); each heading that an axis may have is one of density 1 / (2 pi)."""
    monkeypatch.setattr(traffic_module, "FLAT", flat)
    z = np.array([[30.0, 0.3], [80.0, -0.2]])
    boxes = np.hstack([z, [[0.2, 4.5, 1.8], [-1.0, 4.6, 1.7]]])
    for sensor, values in ((SENSORS[1], z), (replace(SENSORS[3], angle=1.5), z), (SENSORS[4], boxes)):
        kind = Kind(extras=((4.5, 0.5), (1.8, 0.2)), noise=(0.6, 0.15, 0.01, 0.01, 0.01))
        model = Traffic((sensor,), TURN, (kind,), unseen_density=2e-4)
        scan = Scan(sensor.name, 0.0, values, POSE)
        unseen = model.unseen(scan)
        view = model.view(scan, no_objects(len(TURN.names)), unseen)
        rho = np.zeros(2)
        for c, j in enumerate(unseen.group):
            H, d = view.slope[c], len(sensor.names)
            S = H @ unseen.covariance[c] @ H.T + view.noise[view.sort[j]]
            gap = view.values[j] - view.predicted[c]
            turn = np.where(np.isinf(view.period), 1e9, view.period)
            gap -= turn * np.round(gap / turn)
            height = math.exp(-0.5 * gap @ np.linalg.solve(S, gap)) / math.sqrt(np.linalg.det(2 * math.pi * S))
            rho[j] += unseen.weight[c] * view.detection[c] * height
            assert d == len(gap)
        expected = 2e-4 * view.detection[unseen.offset[:-1]] * values[:, 0]
        if isinstance(sensor, LaserBox):  # an axis has two headings, each of density 1 / (2 pi)
            sizes = [(4.5, math.hypot(0.5, 0.2)), (1.8, math.hypot(0.2, 0.1))]
            expected = expected / math.pi
            for column, (mean, std) in zip((3, 4), sizes, strict=True):
                expected *= np.exp(-0.5 * ((values[:, column] - mean) / std) ** 2) / (std * math.sqrt(2 * math.pi))
        np.testing.assert_allclose(rho, expected, rtol=3.0 / flat**2)


@dataclass(frozen=True, kw_only=True)
class Sonar(Sensor):
    """A sensor that nothing but this test knows: the logarithm of the range [m], and the bearing [rad]."""

    names: ClassVar[tuple[str, ...]] = ("log_range", "bearing")

    @staticmethod
    def measure(body: Body, at: Any, ops: Any) -> Any:
        dx, dy = body.x - at[0], body.y - at[1]
        return (0.5 * ops.log(dx * dx + dy * dy), ops.atan2(dy, dx) - at[2])

    def place(self, values: Floats, noise: Floats, at: Floats) -> Placed:
        distance, angle = np.exp(values[:, 0]), values[:, 1] + at[2]
        away = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        slope = np.stack([away, np.stack([-away[:, 1], away[:, 0]], -1)], -1)
        return Placed(at[:2] + away, slope @ noise @ slope.swapaxes(-1, -2))

    @property
    def span(self) -> Floats:
        return np.array([np.log(self.reach), (-self.angle / 2, self.angle / 2)])


def test_a_new_sensor_is_one_class() -> None:
    sensor = Sonar(name="sonar", noise_std=(0.01, 0.005), angle=1.5, reach=(5.0, 80.0), clutter=2.0)
    kind = Kind(noise=(1.0, 1.0), speed=(5.0, 4.0))
    model = Traffic((sensor,), ConstantVelocity(), (kind,), unseen_density=1e-4)
    way = [np.array([[20.0 + 0.5 * t, 3.0, 5.0, 0.0], [40.0 - 0.5 * t, -4.0, -5.0, 0.0]]) for t in range(30)]
    scans = [
        simulate_scan(model, "sonar", 0.1 * t, np.zeros(3), np.zeros(2, dtype=np.int64), x, t)[0]
        for t, x in enumerate(way)
    ]
    frames = model.prepare(Recording(tuple(scans)))
    tracks = lmb.run(model, frames)
    last = slice(tracks.offset[-2], tracks.offset[-1])
    found = tracks.mean[last][tracks.existence[last] > 0.5]
    assert len(found) == 2
    np.testing.assert_allclose(found[found[:, 1].argsort()[::-1], :2], way[-1][:, :2], atol=1.0)


def test_a_sensor_that_forgets_a_value_is_told() -> None:
    class Deaf(Sonar):
        @staticmethod
        def measure(body: Body, at: Any, ops: Any) -> Any:
            return ops.log(body.x)

    formula, _ = sensor_formulas(ConstantVelocity(), Deaf, 4)
    with pytest.raises(InputError, match=r"Deaf.measure gives SX, but must give a tuple of \(log_range"):
        formula.casadi()


def test_an_object_outside_every_view_keeps_its_existence() -> None:
    sensors = (
        RangeBearing(name="front", noise_std=(0.1, 0.01), angle=1.0, reach=(0.0, 60.0), detection=0.99),
        RangeBearing(name="rear", noise_std=(0.1, 0.01), mount=(0.0, 0.0, math.pi), angle=1.0, reach=(0.0, 60.0)),
    )
    model = Traffic(sensors, ConstantVelocity(), (Kind(noise=(1.0, 1.0)),))
    objects = certain(np.array([[0.0, 30.0, 0.0, 0.0], [100.0, 0.0, 0.0, 0.0]]), [0.7, 0.4])
    belief = lmb.Belief(0.0, objects)
    for number, sensor in enumerate(itertools.islice(itertools.cycle(("front", "rear")), 10)):
        scan = Scan(sensor, 0.0, np.zeros((0, 2)), np.zeros(3))
        belief, _ = lmb.step(model, belief, scan, number, lmb.Knobs())
    np.testing.assert_allclose(belief.objects.existence, [0.7, 0.4], atol=1e-12)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"detection": 1.2}, "detection is 1.2"),
        ({"weather": -0.1}, "weather is -0.1"),
        ({"doubt": 0.5}, r"doubt is 0.5, but a detection of 0.95 leaves at most 0.1"),
        ({"noise_std": (1.0,)}, "noise_std is"),
        ({"clutter": math.nan}, "clutter is nan"),
        ({"reach": (5.0, 2.0)}, "reach"),
        ({"confusion": ((0.5, 0.5), (1.0, 0.0))}, "without zeros, for false alarms"),
    ],
)
def test_settings_that_no_sensor_has_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        RangeBearing(**({"name": "laser", "noise_std": (0.1, 0.01)} | settings))


def test_a_sensor_that_reads_what_no_state_has_is_refused() -> None:
    with pytest.raises(InputError, match=r"sensor boxes measures length, which the state"):
        Traffic((SENSORS[4],), ConstantTurn(), (Kind(),))


SCAN = Scan("laser", 1.5, np.array([[30.0, 0.1], [20.0, 0.2]]), POSE)
EYE = np.broadcast_to(np.eye(2), (2, 2, 2))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sensor": "lidar"}, r"'lidar', but the model has \['laser'\]"),
        ({"time": math.nan}, "'laser' has time nan"),
        ({"time": -1.0}, "time -1"),
        ({"values": np.array([[30.0, math.nan], [20.0, 0.2]])}, r"'laser' at 1.5 s has nan in its values.*\[0, 1\]"),
        ({"values": np.zeros((2, 3))}, r"values of \(range, bearing\) of shape \(2, 3\); give \(2, 2\)"),
        ({"pose": np.array([0.0, math.inf, 0.0])}, r"inf in its pose.*give where the car was"),
        ({"noise": EYE[:1]}, r"covariances of shape \(1, 2, 2\)"),
        ({"noise": EYE * [[[1.0]], [[-1.0]]]}, "not symmetric and positive definite, of measurement 1"),
        ({"noise": EYE + np.array([[0.0, 0.3], [0.0, 0.0]])}, "not symmetric and positive definite, of measurement 0"),
        ({"score": np.array([0.5, 7.0])}, "score 7, but scores are probabilities"),
        ({"score": np.array([0.5, math.nan])}, "nan in its scores"),
        ({"likeness": np.array([[0.5], [-0.1]])}, "likeness"),
        ({"likeness": np.array([[0.5, 0.5], [0.1, 0.1]])}, r"likeness by kind of shape \(2, 2\)"),
    ],
)
def test_scans_that_cannot_be_used_are_refused(changes: dict[str, Any], words: str) -> None:
    model = Traffic((SENSORS[1],))
    model.check([SCAN])
    with pytest.raises(InputError, match=words):
        model.check([SCAN._replace(**changes)])


def test_empty_and_huge_scans_are_scans() -> None:
    model = Traffic((SENSORS[1],))
    empty = SCAN._replace(values=np.zeros((0, 2)), noise=np.zeros((0, 2, 2)), score=np.zeros(0))
    many = np.random.default_rng(0).uniform([1.0, -1.5], [190.0, 1.5], (5000, 2))
    huge = SCAN._replace(values=many, noise=np.broadcast_to(np.eye(2), (5000, 2, 2)), score=np.full(5000, 1.0))
    assert [len(scan.values) for scan in model.check([empty, huge])] == [0, 5000]
    frames = model.prepare(Recording((SCAN, empty)))
    assert [scan.time for scan in model.check(frames)] == [1.5, 1.5]


def test_gaps_of_more_than_an_hour_are_mistaken_units() -> None:
    model = Traffic((SENSORS[1],))
    hour, more = (SCAN._replace(time=SCAN.time + seconds) for seconds in (3600.0, 3601.0))
    assert len(model.check([hour, SCAN])) == 2
    with pytest.raises(InputError, match=r"comes 3601 s after the one before, .* give times in seconds"):
        model.check([more, SCAN])


def test_a_mount_turns_with_the_car() -> None:
    """One metre ahead and two to the left, on a car that looks along (.6, .8)."""
    pose = np.array([10.0, 20.0, math.atan2(0.8, 0.6)])
    np.testing.assert_allclose(mounted(pose, (1.0, 2.0, 0.3)), [9.0, 22.0, pose[2] + 0.3], atol=1e-12)


def test_range_rates_are_the_slope_of_the_range() -> None:
    radar = Radar(name="radar", noise_std=(0.3, 0.02, 0.2))
    model = Traffic((radar,), ConstantVelocity(), (Kind(noise=(1.0, 1.0)),))
    measure, _ = model.formulas(radar)
    x, at = np.array([[30.0, 20.0, -3.0, 5.0]]), np.array([[1.0, 2.0, 0.4]])
    step = 1e-4 * np.array([[-3.0, 5.0, 0.0, 0.0]])
    slope = (measure(x + step, at)[0, 0] - measure(x - step, at)[0, 0]) / 2e-4
    assert measure(x, at)[0, 2] == pytest.approx(slope, abs=1e-7)


def test_what_is_too_near_is_not_seen() -> None:
    radar = RangeBearing(name="radar", noise_std=(0.3, 0.02), reach=(10.0, 100.0), detection=0.9)
    _, detect = Traffic((radar,), ConstantVelocity(), (Kind(noise=(1.0, 1.0)),)).formulas(radar)
    x = np.array([[5.0, 0.0, 0.0, 0.0], [10.0, 0.0, 0.0, 0.0], [20.0, 0.0, 0.0, 0.0]])
    found = detect(x, np.array([[0.0, 0.0, 0.0, *radar.settings, 0.0]]))[:, 0]
    np.testing.assert_allclose(found, [0.0, 0.45, 0.9], atol=1e-4)


def test_scores_are_odds() -> None:
    plots = Position(name="plots", noise_std=(1.0, 1.0))
    scan = Scan("plots", 0.0, np.zeros((3, 2)), np.zeros(3), score=np.array([0.0, 0.5, 0.75]))
    np.testing.assert_allclose(plots.feature(scan, 2), np.array([[0.0], [1.0], [3.0]]) * np.ones(2), rtol=1e-12)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"noise": (0.6, -0.1, 0.0)}, "kind object: noise is -0.1; give 0 or more"),
        ({"noise": (0.6, math.nan, 0.0)}, "kind object: noise is nan"),
        ({"speed": (8.0, -4.0)}, "kind object: the second of speed is -4.0"),
        ({"acceleration_std": math.inf}, "acceleration_std is inf"),
        ({"visibility": 1.5}, "visibility is 1.5; give a number from 0 to 1"),
    ],
)
def test_kinds_that_cannot_be_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Kind(**settings)


class Bend(ConstantTurn):
    """A motion of somebody's own, with an entry of which nothing is known."""

    @property
    def names(self) -> tuple[str, ...]:
        return ("x", "y", "heading", "speed", "curvature", "acceleration")


def test_traffic_that_cannot_be_is_refused() -> None:
    for density in (-1.0, math.nan, math.inf):
        with pytest.raises(InputError, match=f"unseen_density is {density}"):
            Traffic((SENSORS[1],), unseen_density=density)
    with pytest.raises(InputError, match=r"nothing says what curvature of the motion's .* make it an extra"):
        Traffic((SENSORS[1],), Bend())
    with pytest.raises(InputError, match=r"the place at \(0.0, 0.0\) has std 0.0 and rate 0.1"):
        Place((0.0, 0.0), 0.0, 0.1)
