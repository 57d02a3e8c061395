"""The model of traffic, as filters read it: how objects of several kinds move, and how sensors see them.

    object   kind k with probability share_k, state x = (position, the rest):  position is uniform (unseen objects have
             the density `unseen_density` [1/m^2]), the rest normal or, of headings, uniform
    motion   x' = f(x, dt) + L_k e;   an object of kind k lives for Exponential(lifetime_k) seconds
    sensors  models.objects.sensors

[K15] tracks with a labeled multi-Bernoulli filter; what is said here is the model under it. Objects that no scan has
shown yet are a Poisson process, as in Williams (2015), so that a first measurement begins a track with the probability
that it is an object rather than a false alarm, in its own scan.

In the program the density of the unseen is that of the first frame, and objects in view are soon seen: whoever comes
later comes as others go, or from places. So it is to filters where the model is `depleted`; else they and the program
differ in this one thing: to a filter the density is the same at every scan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from models.formula import Formula
from models.multi_object import Bernoullis, Components, Moved, View, joined, no_components, no_objects
from models.objects.depletion import left_over
from models.objects.ground import Ground, limited
from models.objects.motion import ANGLES, ConstantTurn, Motion, move_formula, noise_formula
from models.objects.newcomers import lay_out
from models.objects.perception import hidden_by_any
from models.objects.scans import Recording, Scan, check_scan
from models.objects.scene import ScanFrame, State, first, frames_of, in_order, see, step
from models.objects.sensors import Sensor, hidden_formula, mounted, sensor_formulas
from models.program import InputError
from models.unroll import unroll

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
FLAT = 100.0  # a prior this many times wider than a measurement is taken for uniform: it adds 1e-4 of its information
LONGEST_GAP = 3600.0  # between scans: longer ones are mistaken units [s]
CELLS = 64  # along each side of the region, of what a map says of it in the program
HEADINGS, HEADING_STD = 4, 0.5  # about which a heading that nobody measured is normal, for a uniform one [rad]


@dataclass(frozen=True)
class Kind:
    """What objects of one kind are like.

    noise         standard deviations by the motion's `noises`
    share         of unseen objects
    lifetime      mean [s]
    speed         mean and standard deviation [m/s] when first seen
    yaw_rate_std, acceleration_std  when first seen [rad/s], [m/s^2]
    extras        (mean, standard deviation) of the motion's extras when first seen
    visibility    factor to every sensor's probability to detect it
    radius        of the disc that hides what is behind it [m]
    """

    name: str = "object"
    noise: tuple[float, ...] = (0.6, 0.15, 0.01)
    share: float = 1.0
    lifetime: float = 100.0
    speed: tuple[float, float] = (8.0, 4.0)
    yaw_rate_std: float = 0.2
    acceleration_std: float = 0.5
    extras: tuple[tuple[float, float], ...] = ()
    visibility: float = 1.0
    radius: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "extras", tuple(tuple(pair) for pair in self.extras))  # configs have lists
        for what in ("share", "lifetime", "radius"):
            if not 0.0 < getattr(self, what) < math.inf:
                raise InputError(f"kind {self.name}: {what} is {getattr(self, what)}; give a positive number")
        spreads = {"noise": tuple(self.noise), "the second of speed": self.speed[1:]}
        spreads |= {"the second of extras": tuple(std for _, std in self.extras)}
        spreads |= {what: (getattr(self, what),) for what in ("yaw_rate_std", "acceleration_std")}
        for what, values in spreads.items():
            if wrong := [value for value in values if not 0.0 <= value < math.inf]:
                raise InputError(f"kind {self.name}: {what} is {wrong[0]}; give 0 or more")
        if not 0.0 <= self.visibility <= 1.0:
            raise InputError(f"kind {self.name}: visibility is {self.visibility}; give a number from 0 to 1")


@dataclass(frozen=True)
class Place:
    """Where objects come from, at a rate [1/s]: position and its standard deviation [m], and, where it is known, the
    heading [rad] and its standard deviation."""

    position: tuple[float, float]
    std: float
    rate: float
    heading: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.std < math.inf or not 0.0 <= self.rate < math.inf:
            raise InputError(
                f"the place at {tuple(self.position)} has std {self.std} and rate {self.rate}; "
                "give a positive standard deviation, and a rate of 0 or more"
            )


@dataclass(frozen=True)
class Traffic:
    """Settings: the motion, the kinds, the sensors, and where new objects come from."""

    sensors: tuple[Sensor, ...]
    motion: Motion = field(default_factory=ConstantTurn)
    kinds: tuple[Kind, ...] = (Kind(),)
    unseen_density: float = 1e-4  # [1/m^2]: where nobody has looked; if not depleted, what arrives between two scans
    depleted: bool = False  # whether fewer are left where a sensor has looked (models.objects.depletion)
    places: tuple[Place, ...] = ()
    ground: Ground | None = None  # where it is known, instead of unseen_density
    region: tuple[float, float, float, float] = (-100.0, -100.0, 100.0, 100.0)  # x, y to x, y [m]: of the program
    slots: int = 6  # for objects of the program

    def __post_init__(self) -> None:
        if not 0.0 <= self.unseen_density < math.inf:
            raise InputError(f"unseen_density is {self.unseen_density}; give the objects on a square metre, 0 or more")
        names = [sensor.name for sensor in self.sensors]
        if len(set(names)) < len(names):
            raise InputError(f"sensors are called {names}; give each a name of its own")
        for kind in self.kinds:
            if len(kind.noise) != len(self.motion.noises) or len(kind.extras) != len(self.motion.extras):
                raise InputError(
                    f"kind {kind.name} has {len(kind.noise)} noises and {len(kind.extras)} extras; "
                    f"give a number for each of {self.motion.noises} and a pair for each of {self.motion.extras}"
                )
        if abs(sum(kind.share for kind in self.kinds) - 1.0) > 1e-9:
            raise InputError(f"the shares of kinds are {[kind.share for kind in self.kinds]}; make them sum to one")
        for kind in self.kinds:
            if unknown := [name for name in self.names if name not in _known(self.motion, kind)]:
                raise InputError(
                    f"nothing says what {unknown[0]} of the motion's {self.names} is of an object first seen; "
                    "make it an extra, of which kinds give mean and standard deviation"
                )
        body = self.motion.body((0.0,) * len(self.names), math)
        for sensor in self.sensors:
            if missing := [name for name in sensor.reads if getattr(body, name) is None]:
                raise InputError(
                    f"sensor {sensor.name} measures {missing[0]}, which the state {self.names} does not have; "
                    "add it to the motion's extras, or choose another sensor"
                )
            if sensor.confusion is not None and len(sensor.confusion) != 1 + len(self.kinds):
                raise InputError(
                    f"sensor {sensor.name} has a confusion of {len(sensor.confusion)} rows; give one for each of "
                    f"{self.kind_names} and one for false alarms"
                )

    @property
    def names(self) -> tuple[str, ...]:
        return self.motion.names

    @property
    def kind_names(self) -> tuple[str, ...]:
        return tuple(kind.name for kind in self.kinds)

    @cached_property
    def period(self) -> Floats:
        return np.array([ANGLES.get(name, math.inf) for name in self.names])

    @cached_property
    def _sensors(self) -> dict[str, Sensor]:
        return {sensor.name: sensor for sensor in self.sensors}

    @cached_property
    def noises(self) -> Floats:
        """(C, .) standard deviations by the motion's `noises`, of each kind."""
        return np.array([kind.noise for kind in self.kinds])

    @cached_property
    def visibility(self) -> Floats:
        """(C,) of the kinds."""
        return np.array([kind.visibility for kind in self.kinds])

    @cached_property
    def _share(self) -> Floats:
        return np.array([kind.share for kind in self.kinds])

    @cached_property
    def _anywhere(self) -> tuple[Floats, Floats]:
        """(C, 1, n) mean and standard deviation of newcomers' states where speed has no limit."""
        states = [_state_prior(self.motion, kind) for kind in self.kinds]
        loc, std = (np.array(part)[:, None] for part in zip(*states, strict=True))
        return loc, std

    def _newcomer_states(self, position: Floats) -> tuple[Floats, Floats]:
        """The same at positions (B, 2), (C, 1 or B, n)."""
        if self.ground is None:
            return self._anywhere
        loc, std = (np.stack(part) for part in zip(*(self.newcomers(k, position) for k in self.kinds), strict=True))
        return loc, std

    @cached_property
    def _radius(self) -> Floats:
        return np.array([kind.radius for kind in self.kinds])

    @cached_property
    def lifetime(self) -> Floats:
        """(C,) of the kinds [s]."""
        return np.array([kind.lifetime for kind in self.kinds])

    def sensor(self, scan: Scan) -> Sensor:
        """The sensor of a scan. Raises InputError where the model has none of its name."""
        if scan.sensor not in self._sensors:
            raise InputError(
                f"a scan at {scan.time} s is of sensor '{scan.sensor}', but the model has "
                f"{sorted(self._sensors)}; add it to the model's sensors"
            )
        return self._sensors[scan.sensor]

    def density(self, position: Floats) -> Floats:
        """(N,) of unseen objects at positions (N, 2) [1/m^2], where nobody has looked."""
        return np.full(len(position), self.unseen_density) if self.ground is None else self.ground.density(position)

    @cached_property
    def cells(self) -> Floats:
        """(Y, X) objects expected in cells of the region, in each of which their density is that of its middle."""
        x0, y0, x1, y1 = self.region
        num = 1 if self.ground is None else CELLS
        middle = (np.arange(num) + 0.5) / num
        x, y = np.meshgrid(x0 + (x1 - x0) * middle, y0 + (y1 - y0) * middle)
        density = self.density(np.stack([x.ravel(), y.ravel()], -1)).reshape(num, num)
        return density * (x1 - x0) * (y1 - y0) / num**2

    @cached_property
    def unseen_numbers(self) -> Floats:
        """(O, C) objects expected at first, anywhere in the region and, none, from each place, by kind."""
        from_places = np.zeros((len(self.places), len(self.kinds)))
        return np.vstack([self.cells.sum() * np.array([kind.share for kind in self.kinds]), from_places])

    def arrived(self, seconds: float) -> Floats:
        """(O, C) newcomers expected to be there after a time, from anywhere in the region and from each place, by kind:
        int_0^t rate e^(-s / lifetime) ds, the rate of those from anywhere being what balances those that go."""
        share = np.array([kind.share for kind in self.kinds])
        staying = -np.expm1(-seconds / self.lifetime)
        places = [place.rate * share * self.lifetime * staying for place in self.places]
        return np.vstack([self.unseen_numbers[0] * staying, *places])

    def newcomers(self, kind: Kind, position: Floats) -> tuple[Floats, Floats]:
        """Mean and standard deviation (N, n) of the states of newcomers at positions (N, 2), where their speed may be
        limited; those of position and heading are zero."""
        loc, std = (np.tile(v, (len(position), 1)) for v in _state_prior(self.motion, kind))
        if self.ground is not None:
            limit = self.ground.speed_limit(position)
            if "speed" in self.names:
                entry = self.names.index("speed")
                loc[:, entry], std[:, entry] = limited(*kind.speed, limit)
            else:
                std[:, 2:4] = np.minimum(std[:, 2:4], limit[:, None])
        return loc, std

    def formulas(self, sensor: Sensor) -> tuple[Formula, Formula]:
        """h and p_D of a sensor: see sensor_formulas."""
        return sensor_formulas(self.motion, type(sensor), len(sensor.settings))  # type: ignore[arg-type]

    def prepare(self, recording: Recording) -> tuple[ScanFrame, ...]:
        """The frames of a recording, in its order. Raises InputError for a scan that cannot be used (`check`)."""
        return frames_of(self, self.check(recording.scans))

    def check(self, scans: Recording | Sequence[Scan | ScanFrame]) -> tuple[Scan, ...]:
        """The scans in the order given, those of frames for frames. Raises InputError for a sensor that the model has
        not, for numbers that no sensor gives (models.objects.scans), and for a gap of more than LONGEST_GAP."""
        found = list[Scan]()
        for scan in scans.scans if isinstance(scans, Recording) else scans:
            scan = scan.scan if isinstance(scan, ScanFrame) else scan
            sensor = self.sensor(scan)
            found.append(check_scan(scan, sensor.names, len(self.kinds)))
        times = np.sort([scan.time for scan in found])
        for late in np.flatnonzero(np.diff(times) > LONGEST_GAP):
            raise InputError(
                f"the scan at {times[late + 1]} s comes {times[late + 1] - times[late]:g} s after the one before, more "
                f"than {LONGEST_GAP:g}; give times in seconds, or the parts one by one"
            )
        return tuple(found)

    def __call__(self, frames: Sequence[ScanFrame]) -> None:
        unroll(self)(in_order(frames))

    def initial(self, frame: ScanFrame) -> State:
        return first(self, frame)

    def transition(self, state: State, frame: ScanFrame) -> State:
        return step(self, state, frame)

    def observe(self, state: State, frame: ScanFrame) -> None:
        see(self, state, frame)

    def move(self, kind: Ints, mean: Floats, seconds: float) -> Moved:
        size, num = len(self.names), len(kind)
        moved, slope = np.empty((num, size)), np.empty((num, size, size))
        noise = np.empty((num, noise_formula(self.motion).num_y))
        settings = np.empty((num, 1 + self.noises.shape[1]))
        settings[:, 0], settings[:, 1:] = seconds, self.noises[kind]
        move_formula(self.motion).compiled()(mean, settings, moved, slope)
        noise_formula(self.motion).compiled(jacobian=False)(mean, settings, noise)
        return Moved(moved, slope, noise.reshape(num, size, -1), np.exp(-seconds / self.lifetime[kind]))

    def view(self, scan: Scan, objects: Bernoullis, more: Components) -> View:
        sensor = self.sensor(scan)
        at = mounted(scan.pose, sensor.mount)
        states = np.concatenate([objects.components.mean, more.mean])
        num, size, d = len(states), len(self.names), len(sensor.names)
        measure, detect = self.formulas(sensor)
        predicted, slope, detection = np.empty((num, d)), np.empty((num, d, size)), np.empty((num, 1))
        measure.compiled()(states, at[None], predicted, slope)
        hidden = self._hidden(sensor, at, objects, more)
        settings = np.empty((len(hidden), 4 + len(sensor.settings)))
        settings[:, :3], settings[:, 3:-1], settings[:, -1] = at, sensor.settings, hidden
        detect.compiled(jacobian=False)(states, settings, detection)
        noise, values = sensor.covariance(scan), np.ascontiguousarray(scan.values, dtype=np.float64)
        one = len(noise) == 1
        sort = np.zeros(len(values), dtype=np.int64) if one else np.arange(len(values))
        clutter, feature = sensor.clutter_intensity(values), sensor.feature(scan, len(self.kinds))
        detection = detection[:, 0] * self.visibility[np.concatenate([objects.components.kind, more.kind])]
        return View(predicted, slope, detection, values, noise, sort, clutter, feature, sensor.period)

    def _hidden(self, sensor: Sensor, at: Floats, objects: Bernoullis, more: Components) -> Floats:
        """(N,) mass of being hidden, of the components of objects, behind others, and of more, behind any; (1,) where
        the sensor sees through. What hides is each object's heaviest component, as surely as it exists."""
        parts = objects.components
        if sensor.occlusion == 0.0 or not len(objects.label):
            return np.zeros(1)
        best = np.lexsort((parts.weight, parts.group))[parts.offset[1:] - 1]
        place = np.concatenate([parts.mean[:, :2], more.mean[:, :2]])
        kind = np.concatenate([parts.kind, more.kind])
        x = np.empty((len(place), len(best), 4))
        x[..., :2], x[..., 2:] = place[:, None], parts.mean[best, :2]
        p = np.empty((len(place), len(best), 5))
        p[..., :3], p[..., 3], p[..., 4] = at, self._radius[kind][:, None], self._radius[parts.kind[best]]
        share = hidden_formula()(x.reshape(-1, 4), p.reshape(-1, 5)).reshape(x.shape[:2])
        share[np.arange(len(parts.mean)), parts.group] = 0.0  # nobody hides itself
        return np.asarray(sensor.occlusion * hidden_by_any(share, objects.existence))

    def unseen(self, scan: Scan, past: Sequence[Scan] = ()) -> Components:
        sensor, size, num = self.sensor(scan), len(self.names), len(scan.values)
        if not sensor.births or not num:
            return no_components(size, num)
        covariance = sensor.covariance(scan)
        covariance = covariance if len(covariance) == num else covariance.repeat(num, 0)
        placed = sensor.place(scan.values, covariance, mounted(scan.pose, sensor.mount))
        flat = FLAT**2 * placed.covariance
        # a density of objects, as far as a normal one of this width is flat at its middle
        density = self.density(placed.position)
        number = density * 2 * math.pi * np.sqrt(flat[:, 0, 0] * flat[:, 1, 1] - flat[:, 0, 1] ** 2)
        heading, wide = placed.heading, placed.heading_std
        if heading is not None:
            shared = math.sqrt(2 * math.pi) / heading.shape[1]  # the width at which their weights sum to one
            wide = np.full(num, shared) if wide is None else FLAT * wide
            number = number * wide / shared  # the same for the density 1 / (2 pi) of each heading
        found = self._newcomers(number, placed.position, flat, heading, wide)
        if not self.depleted or not past:
            return found
        left = left_over(self, scan, past, placed.position)
        weight = found.weight.reshape(*left.shape, -1) * left[:, :, None]
        return found._replace(weight=weight.ravel())

    def arrivals(self, seconds: float) -> Bernoullis:
        if not self.places:
            return no_objects(len(self.names))
        position = np.array([place.position for place in self.places])
        covariance = np.array([place.std**2 * np.eye(2) for place in self.places])
        existence = -np.expm1(-self.arrived(seconds)[1:].sum(1))
        groups = list[Components]()
        for i, place in enumerate(self.places):
            known = () if place.heading is None else (np.array([[place.heading[0]]]), np.array([place.heading[1]]))
            groups.append(self._newcomers(np.ones(1), position[i : i + 1], covariance[i : i + 1], *known))
        return Bernoullis(np.zeros(len(self.places), dtype=np.int64), existence, joined(*groups))

    def _newcomers(
        self,
        number: Floats,
        position: Floats,
        covariance: Floats,
        heading: Floats | None = None,
        heading_std: Floats | None = None,
    ) -> Components:
        """B groups of components: every kind at every heading (B, H), with standard deviation (B,), or all around;
        weights summing to number (B,)."""
        num = len(number)
        if heading is None or heading_std is None:
            heading = self._headings[None].repeat(num, 0)
            heading_std = np.full(num, HEADING_STD)
        loc, std = self._newcomer_states(position)
        return Components(
            *lay_out(number, position, covariance, heading, heading_std, self._heading, loc, std, self._share)
        )

    @cached_property
    def _heading(self) -> int:
        """Which entry of the state is the heading, -1 for none."""
        return self.names.index("heading") if "heading" in self.names else -1

    @cached_property
    def _headings(self) -> Floats:
        """About which newcomers of unknown heading go."""
        num = HEADINGS if self._heading >= 0 else 1
        return 2 * math.pi * np.arange(num, dtype=np.float64) / num


@lru_cache
def _state_prior(motion: Motion, kind: Kind) -> tuple[Floats, Floats]:
    """Mean and standard deviation (n,) of a newcomer's state; those of position and heading are zero."""
    known = _known(motion, kind)
    loc, std = zip(*(known[name] for name in motion.names), strict=True)
    return np.array(loc), np.array(std)


def _known(motion: Motion, kind: Kind) -> dict[str, tuple[float, float]]:
    """The same of every entry that a motion may have, by name."""
    known = {"yaw_rate": (0.0, kind.yaw_rate_std), "acceleration": (0.0, kind.acceleration_std), "speed": kind.speed}
    drift = math.hypot(*kind.speed)  # of vx and vy where no heading tells which way
    known |= {"vx": (0.0, drift), "vy": (0.0, drift)} | dict(zip(motion.extras, kind.extras, strict=True))
    return known | dict.fromkeys(("x", "y", "heading"), (0.0, 0.0))
