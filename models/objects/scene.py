"""Traffic as a program: objects in slots that come, move, go and are seen, frame after frame.

    first     N ~ Poisson(int unseen density over the region), in slots 1 ... N, each of kind k with share_k and a state
              of its newcomers' density
    step      an object of kind k is still there with exp(-dt / lifetime_k) and moves by x' = f(x, dt) + L_k e,
              e ~ N(0, I): the latent is e, since L may be singular. Then A newcomers take the first A free slots,
              A ~ Poisson: as many as come from places, and as balance those that go where there are none, and are
              still there
    scan      models.objects.scan_set

Numbers are truncated by the free slots. Slots are labels: an object keeps its slot; a relabelling that keeps the order
of free slots is the same scene. Slots where nobody is, and draws nobody uses (the state of newcomers where none comes),
keep their normalised densities. The region only says where newcomers may be: objects leave it, and live on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from models.objects.motion import move_formula, noise_formula
from models.objects.perception import hidden_by_any
from models.objects.scan_set import FalseAlarms, Looks, ScanSet, wrapped
from models.objects.scans import Scan
from models.objects.sensors import Sensor, hidden_formula, mounted, spread_formula
from models.program import InputError, quiet_doubles

if TYPE_CHECKING:
    from models.objects.traffic import Traffic

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
State = dict[str, Tensor]
NONE = -1e9  # log odds of each newcomer where none can come


class ScanFrame(NamedTuple):
    """One frame of the program.

    values   (R, 1 + d + C) rows (present, measured, features) as models.objects.scan_set has them; None simulates
    scan     whose they are; its sensor, time and pose are read
    seconds  since the frame before
    """

    values: Tensor | None
    scan: Scan
    seconds: float = 0.0

    @property
    def time(self) -> float:
        return self.scan.time

    @property
    def sensor(self) -> str:
        return self.scan.sensor


def frames_of(model: Traffic, scans: Sequence[Scan]) -> tuple[ScanFrame, ...]:
    """The frames of scans, in their order."""
    gaps = np.diff([scan.time for scan in scans], prepend=[scan.time for scan in scans[:1]]).tolist()
    return tuple(ScanFrame(rows_of(model, scan), scan, gap) for scan, gap in zip(scans, gaps, strict=True))


def in_order(frames: Sequence[ScanFrame]) -> tuple[ScanFrame, ...]:
    """The same by time."""
    ordered = sorted(frames, key=lambda frame: frame.scan.time)
    times = [frame.scan.time for frame in ordered]
    gaps = np.diff(times, prepend=times[:1]).tolist()
    return tuple(frame._replace(seconds=gap) for frame, gap in zip(ordered, gaps, strict=True))


def rows_of(model: Traffic, scan: Scan) -> Tensor:
    """(M, 1 + d + C), all present."""
    sensor = model.sensor(scan)
    values = np.asarray(scan.values, dtype=np.float64).reshape(-1, len(sensor.names))
    feature = sensor.feature(scan, len(model.kinds))
    return torch.from_numpy(np.concatenate([np.ones((len(values), 1)), values, feature], 1))


def scan_set(
    model: Traffic, scan: Scan, kind: Tensor, state: Tensor, exists: Tensor, rows: int | None = None
) -> ScanSet:
    """What a sensor reports of objects (*B, S) at the pose of a scan, of which the values are not read."""
    sensor = model.sensor(scan)
    at = torch.from_numpy(mounted(scan.pose, sensor.mount))
    measure, detect = model.formulas(sensor)
    predicted = measure.torch(state, at)
    settings = torch.cat([at, torch.tensor(sensor.settings)]).expand(*exists.shape, -1)
    hidden = _hidden(model, sensor, at, kind, state, exists)
    detection = detect.torch(state, torch.cat([settings, hidden[..., None]], -1))[..., 0] * exists
    detection = detection * torch.from_numpy(model.visibility)[kind]
    if scan.noise is None:
        spread = spread_formula(type(sensor), len(sensor.noise_settings))  # type: ignore[arg-type]
        std = spread.torch(predicted, torch.tensor(sensor.noise_settings))
        noise = torch.diag_embed(std.square())[..., None, :, :]
    else:
        noise = torch.from_numpy(scan.noise)[None]
    low, high = (torch.from_numpy(v.copy()) for v in sensor.span.T)
    table = None if sensor.confusion is None else torch.tensor(sensor.confusion)
    looks = None if table is None else Looks(table[:-1], table[-1])
    return ScanSet(
        predicted,
        noise,
        detection,
        kind,
        FalseAlarms(sensor.false_alarms, low, high, lambda u: torch.from_numpy(sensor.clutter_quantile(u.numpy()))),
        lambda z: torch.from_numpy(sensor.clutter_intensity(z.numpy())),
        torch.from_numpy(sensor.period),
        len(model.kinds),
        looks,
        rows,
    )


def _hidden(model: Traffic, sensor: Sensor, at: Tensor, kind: Tensor, state: Tensor, exists: Tensor) -> Tensor:
    """(*B, S) mass of being hidden behind others that exist."""
    if sensor.occlusion == 0.0:
        return torch.zeros_like(exists)
    num, place = exists.shape[-1], state[..., :2]
    pairs = (*state.shape[:-2], num, num)
    radius = torch.tensor([k.radius for k in model.kinds])[kind].expand(pairs[:-1])
    x = torch.cat([place[..., :, None, :].expand(*pairs, 2), place[..., None, :, :].expand(*pairs, 2)], -1)
    radii = torch.stack([radius[..., :, None].expand(pairs), radius[..., None, :].expand(pairs)], -1)
    share = hidden_formula().torch(x, torch.cat([at.expand(*pairs, 3), radii], -1))[..., 0]
    return sensor.occlusion * torch.as_tensor(hidden_by_any(share * (1.0 - torch.eye(num)), exists))


def simulate_scan(
    model: Traffic,
    sensor: str,
    time: float,
    pose: Floats,
    kind: Ints,
    state: Floats,
    seed: int | np.random.Generator,
) -> tuple[Scan, Ints]:
    """A scan of objects that are there, of kinds (S,) and states (S, n), and which of them each measurement is of (M,),
    -1 for a false alarm."""
    number = seed if isinstance(seed, int) else int(seed.integers(2**62))
    blank = Scan(sensor, time, np.zeros((0, 0)), np.asarray(pose, dtype=np.float64))
    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(number)
        objects = torch.as_tensor(np.asarray(state, dtype=np.float64)).reshape(-1, len(model.names))
        which = torch.as_tensor(np.asarray(kind, dtype=np.int64))
        found, source = scan_set(model, blank, which, objects, torch.ones(len(objects))).sample_sources()
    there = found[:, 0].numpy() > 0.5
    rows, d = found.numpy()[there], len(model.sensor(blank).names)
    likeness = None if model.sensor(blank).confusion is None else rows[:, 1 + d :]
    return blank._replace(values=rows[:, 1 : 1 + d], likeness=likeness), source.numpy()[there]


def first(model: Traffic, frame: ScanFrame) -> State:
    """Sample the objects that are there at the first frame."""
    num = (model.slots,)
    nobody = {"exists": torch.zeros(num), "kind": torch.zeros(num, dtype=torch.long)}
    nobody["state"] = torch.zeros(*num, len(model.names))
    return _enter(model, nobody, model.unseen_numbers)


def step(model: Traffic, state: State, frame: ScanFrame) -> State:
    """Sample what becomes of the objects until a frame, and who comes."""
    dt = frame.seconds
    if dt < 0.0:
        raise InputError(
            f"the scan of sensor '{frame.sensor}' at {frame.time} s is {-dt:g} s older than the one before; a program "
            "needs them by time: sort the scans, or choose an engine that takes late ones (engine=lmb)"
        )
    lifetime = torch.tensor([kind.lifetime for kind in model.kinds])
    stays = dist.Bernoulli(torch.exp(-dt / lifetime)[state["kind"]])
    staying = state["exists"] * pyro.sample("stays", stays.to_event(1))
    return _enter(model, {**state, "exists": staying, "state": _moved(model, state, dt)}, model.arrived(dt))


def see(model: Traffic, state: State, frame: ScanFrame) -> None:
    """Observe a scan: site `values`."""
    rows = None if frame.values is None else frame.values.shape[-2]
    seen = scan_set(model, frame.scan, state["kind"], state["state"], state["exists"], rows)
    pyro.sample("values", seen, obs=frame.values)


def _moved(model: Traffic, state: State, dt: float) -> Tensor:
    """f(x, dt) + L e, (*B, S, n)."""
    x, own = state["state"], torch.from_numpy(model.noises)[state["kind"]]  # (*B, S, .)
    settings = torch.cat([torch.full((*own.shape[:-1], 1), dt), own], -1)
    L = noise_formula(model.motion).torch(x, settings)
    L = L.unflatten(-1, (len(model.names), -1))
    e = pyro.sample("noise", dist.Normal(0.0, torch.ones(model.slots, L.shape[-1])).to_event(2))
    return move_formula(model.motion).torch(x, settings) + (L @ e[..., None])[..., 0]


def _enter(model: Traffic, state: State, numbers: Floats) -> State:
    """Let newcomers into free slots: expected `numbers` (O, C) by origin and kind."""
    exists = state["exists"]
    free = 1.0 - exists
    count = torch.arange(model.slots + 1.0)
    poisson = dist.Poisson(float(numbers.sum())).log_prob(count) if numbers.sum() > 0.0 else NONE * count
    room = count <= free.sum(-1, keepdim=True)
    born = pyro.sample("born", dist.Categorical(logits=torch.where(room, poisson, -torch.inf)))
    new = (free > 0.5) & (free.cumsum(-1) <= born[..., None])
    share = numbers if numbers.sum() > 0.0 else np.ones_like(numbers)  # of draws that nobody uses
    of_kind = torch.from_numpy(share.sum(0) / share.sum()).expand(model.slots, -1)
    kind = pyro.sample("new_kind", dist.Categorical(of_kind).to_event(1))
    fresh = pyro.sample("new_state", Newcomers(model, torch.from_numpy(share / share.sum(0)), kind))
    there = (exists + new) > 0.5
    stayed = exists > 0.5
    return {
        "exists": there.double(),
        "kind": torch.where(stayed, state["kind"], kind),
        "state": torch.where(stayed[..., None], state["state"], fresh),
    }


class Newcomers(TorchDistribution):
    """States (S, n) of newcomers of kinds (*B, S), that come from anywhere (origin 0: as their density has it over the
    region) or from a place (1, 2, ...: normal about it), origins having probability (O, C) given the kind.

    What is not position is normal by kind; a heading is uniform, and its density that of an angle modulo 2 pi, unless
    its place knows it."""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.real, 2)

    def __init__(self, model: Traffic, origin: Tensor, kind: Tensor) -> None:
        self.model, self.origin, self.kind = model, origin, kind
        super().__init__(kind.shape[:-1], torch.Size([kind.shape[-1], len(model.names)]))

    def expand(self, batch_shape: Any, _instance: Any = None) -> Newcomers:
        return Newcomers(self.model, self.origin, self.kind.expand(*batch_shape, self.kind.shape[-1]))

    def _rest(self, position: Tensor, kind: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (*, n) of what is not position, there (*, 2), and of a kind (*)."""
        flat = position.detach().reshape(-1, 2).numpy()
        by_kind = [self.model.newcomers(k, flat) for k in self.model.kinds]
        row, which = torch.arange(len(flat)), kind.expand(position.shape[:-1]).reshape(-1)
        parts = (torch.from_numpy(np.stack(part))[which, row] for part in zip(*by_kind, strict=True))
        loc, std = (part.reshape(*position.shape[:-1], -1) for part in parts)
        return loc, std

    @property
    def _anywhere(self) -> tuple[Tensor, Tensor, Tensor]:
        """The cells' probabilities (Y, X), the corner of the region (2,) and the sides of a cell (2,)."""
        x0, y0, x1, y1 = self.model.region
        cells = torch.from_numpy(self.model.cells)
        some = cells if bool(cells.sum() > 0.0) else torch.ones_like(cells)
        return some / some.sum(), torch.tensor([x0, y0]), torch.tensor([x1 - x0, y1 - y0]) / len(cells)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        shape = torch.Size(sample_shape) + self.kind.shape
        kind = self.kind.expand(shape)
        origin = dist.Categorical(self.origin.T[kind]).sample()
        cells, corner, side = self._anywhere
        cell = dist.Categorical(cells.flatten()).sample(shape)
        position = corner + side * (torch.stack([cell % len(cells), cell // len(cells)], -1) + torch.rand(*shape, 2))
        for number, place in enumerate(self.model.places, start=1):
            near = torch.tensor(place.position) + place.std * torch.randn(*shape, 2)
            position = torch.where((origin == number)[..., None], near, position)
        loc, std = self._rest(position, kind)
        state = loc + std * torch.randn(*shape, len(self.model.names))
        state[..., :2] = position
        heading = self.model.names.index("heading") if "heading" in self.model.names else None
        if heading is None:
            return state
        state[..., heading] = 2 * math.pi * torch.rand(shape) - math.pi
        for number, place in enumerate(self.model.places, start=1):
            if place.heading is not None:
                known = place.heading[0] + place.heading[1] * torch.randn(shape)
                state[..., heading] = torch.where(origin == number, known, state[..., heading])
        return state

    def log_prob(self, value: Tensor) -> Tensor:
        names, position = self.model.names, value[..., :2]
        loc, std = self._rest(position, self.kind)
        rest = [i for i in range(2, len(names)) if names[i] != "heading"]
        others = dist.Normal(loc[..., rest], std[..., rest]).log_prob(value[..., rest]).sum(-1)
        cells, corner, side = self._anywhere
        cell = torch.floor((position - corner) / side)
        inside = ((cell >= 0) & (cell < len(cells))).all(-1)
        column, row = cell.clamp(0, len(cells) - 1).long().unbind(-1)
        anywhere = torch.where(inside, cells[row, column], 0.0).log() - side.log().sum()
        heading = value[..., names.index("heading")] if "heading" in names else None
        turn = 0.0 if heading is None else -math.log(2 * math.pi)
        parts = [turn + anywhere]
        for place in self.model.places:
            near = dist.Normal(torch.tensor(place.position), place.std).log_prob(position).sum(-1)
            if heading is None or place.heading is None:
                parts.append(near + turn)
            else:
                off = wrapped(heading - place.heading[0], torch.tensor(2 * math.pi))
                parts.append(near + dist.Normal(0.0, place.heading[1]).log_prob(off))
        weights = self.origin.log().T[self.kind]  # (*B, S, O)
        return (others + (weights + torch.stack(parts, -1)).logsumexp(-1)).sum(-1)
