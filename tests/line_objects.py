"""Objects on a line as filters read them, and their labelled posterior over a window by enumeration: dense algebra, no
filter."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from models.multi_object import Bernoullis, Components, Moved, View, no_components, no_objects

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
DEAD, MISSED = -2, -1  # what becomes of an object at a scan, else the measurement that it makes


class LineScan(NamedTuple):
    """Places (M, 1) of measurements, and what else each shows of the kinds (M, 2)."""

    time: float
    values: Floats
    feature: Floats
    sensor: str = "line"


@dataclass(frozen=True)
class Line:
    """Two kinds of objects with place and speed, white acceleration noise[k]; a sensor of places."""

    noise: tuple[float, float] = (0.6, 2.0)
    lifetime: tuple[float, float] = (20.0, 4.0)
    detection: tuple[float, float] = (0.8, 0.6)
    std: float = 0.5
    clutter: float = 0.05
    unseen_number: float = 0.0  # about each measurement, by kind alike
    wide: float = 8.0
    fast: float = 3.0
    period: Floats = None  # type: ignore[assignment]

    names = ("place", "speed")
    kind_names = ("calm", "wild")

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", np.full(2, math.inf) if self.period is None else self.period)

    def slope(self, seconds: float) -> Floats:
        return np.array([[1.0, seconds], [0.0, 1.0]])

    def spread(self, kind: int, seconds: float) -> Floats:
        t = seconds
        return self.noise[kind] ** 2 * np.array([[t**3 / 3, t**2 / 2], [t**2 / 2, t]])

    def survival(self, kind: int, seconds: float) -> float:
        return math.exp(-seconds / self.lifetime[kind])

    def move(self, kind: Ints, mean: Floats, seconds: float) -> Moved:
        F = self.slope(seconds)
        L = np.array([np.linalg.cholesky(self.spread(k, seconds)) for k in range(2)])
        s = np.array([self.survival(k, seconds) for k in range(2)])
        return Moved(mean @ F.T, np.tile(F, (len(kind), 1, 1)), L[kind], s[kind])

    def view(self, scan: LineScan, objects: Bernoullis, more: Components) -> View:
        mean = np.concatenate([objects.components.mean, more.mean])
        kind = np.concatenate([objects.components.kind, more.kind])
        M = len(scan.values)
        return View(
            np.ascontiguousarray(mean[:, :1]),
            np.tile(np.array([[1.0, 0.0]]), (len(mean), 1, 1)),
            np.array(self.detection)[kind],
            scan.values,
            np.array([[[self.std**2]]]),
            np.zeros(M, dtype=np.int64),
            np.full(M, self.clutter),
            scan.feature,
            self.period[:1],
        )

    def unseen(self, scan: LineScan, past: Sequence[LineScan] = ()) -> Components:
        M = len(scan.values)
        if self.unseen_number == 0.0 or not M:
            return no_components(2, M)
        mean = np.repeat(np.concatenate([scan.values, 0.0 * scan.values], 1), 2, 0)
        P = np.tile(np.diag([self.wide**2, self.fast**2]), (2 * M, 1, 1))
        return Components(2 * np.arange(M + 1), np.full(2 * M, self.unseen_number), np.tile([0, 1], M), mean, P)

    def arrivals(self, seconds: float) -> Bernoullis:
        return no_objects(2)

    def check(self, scans: Sequence[LineScan]) -> Sequence[LineScan]:
        return scans


def scan_at(time: float, places: Sequence[float], likeness: Sequence[float] = ()) -> LineScan:
    """A scan of places; measurement j looks likeness[j] times as much like the second kind as like the first."""
    feature = np.ones((len(places), 2))
    if likeness:
        feature[:, 1] = likeness
    return LineScan(time, np.array(places, dtype=np.float64).reshape(-1, 1), feature)


def prior_of(places: Sequence[float], existence: Sequence[float], label: Sequence[int] = ()) -> Bernoullis:
    """Objects about places, calm with probability .7."""
    T = len(places)
    mean = np.array([[place + k * 0.4, 0.5 - k] for place in places for k in range(2)]).reshape(-1, 2)
    P = np.tile(np.array([[1.2, 0.3], [0.3, 0.9]]), (2 * T, 1, 1))
    parts = Components(2 * np.arange(T + 1), np.tile([0.7, 0.3], T), np.tile([0, 1], T), mean, P)
    names = np.array(label or range(-T, 0), dtype=np.int64)
    return Bernoullis(names, np.array(existence, dtype=np.float64), parts)


class Gaussian(NamedTuple):
    """A component of an object's density, weights of all summing to its existence."""

    weight: float
    kind: int
    mean: Floats
    covariance: Floats


class Answer(NamedTuple):
    """The posterior after the last scan: {label: components}, and log of the sum over all histories."""

    objects: dict[int, list[Gaussian]]
    log_sum: float

    def existence(self, label: int) -> float:
        return sum(part.weight for part in self.objects[label])


def density(parts: Sequence[Gaussian], kind: int, points: Floats) -> Floats:
    """Of one kind, at points (N, 2)."""
    total = np.zeros(len(points))
    for part in parts:
        if part.kind == kind:
            total += part.weight * multivariate_normal.pdf(points, part.mean, part.covariance)
    return total


def enumerate_posterior(model: Line, time: float, prior: Bernoullis, scans: Sequence[LineScan], stride: int) -> Answer:
    """Sum over all histories of all objects: of each whether and until when it is, and what it makes at each scan, no
    measurement being made twice; what none makes is a false alarm. Objects not seen before stand for the measurement
    that shows them first, scan number times stride plus measurement."""
    first = np.cumsum([0, *(len(scan.values) for scan in scans)])
    histories = dict[int, list[tuple[int, float, Gaussian | None]]]()  # (claimed, weight, last state) of a label
    for t, label in enumerate(prior.label.tolist()):
        own = [(0, 1.0 - float(prior.existence[t]), None)]
        for c in range(prior.components.offset[t], prior.components.offset[t + 1]):
            weight, kind, mean, P = (part[c] for part in prior.components[1:])
            own += _lives(model, time, scans, 0, None, float(prior.existence[t] * weight), int(kind), mean, P, first)
        histories[label] = own
    for k, scan in enumerate(scans):
        unseen = model.unseen(scan)
        for j in range(len(scan.values)):
            own = [(0, 1.0, None)]
            for c in range(unseen.offset[j], unseen.offset[j + 1]):
                weight, kind, mean, P = (part[c] for part in unseen[1:])
                own += _lives(model, scan.time, scans, k, j, float(weight), int(kind), mean, P, first)
            histories[k * stride + j] = own
    size = 1 << int(first[-1])
    sums = {label: _by_claims(own, size) for label, own in histories.items()}
    false = np.array([model.clutter ** (int(first[-1]) - mask.bit_count()) for mask in range(size)])
    everything = _joined(list(sums.values()), size) @ false
    objects = dict[int, list[Gaussian]]()
    for label, own in histories.items():
        others = _joined([sums[other] for other in sums if other != label], size)
        objects[label] = []
        for claimed, weight, state in own:
            if state is not None:
                rest = sum(others[mask] * false[mask | claimed] for mask in range(size) if not mask & claimed)
                objects[label].append(state._replace(weight=weight * rest / everything))
    return Answer(objects, math.log(everything))


def _lives(
    model: Line,
    time: float,
    scans: Sequence[LineScan],
    begin: int,
    shown: int | None,
    weight: float,
    kind: int,
    mean: Floats,
    P: Floats,
    first: Ints,
) -> Iterator[tuple[int, float, Gaussian | None]]:
    """All histories of an object that is so at a time; it is shown first by a measurement of scan `begin`, or old."""
    options = [range(DEAD, len(scan.values)) for scan in scans[begin:]]
    if shown is not None:
        options[0] = range(shown, shown + 1)
    gaps = np.diff([time, *(scan.time for scan in scans[begin:])])
    for events in itertools.product(*options):
        until = events.index(DEAD) if DEAD in events else len(events)
        if any(event != DEAD for event in events[until:]):
            continue
        factor, claimed = weight, 0
        for i, event in enumerate(events[: until + 1]):
            s, p = model.survival(kind, float(gaps[i])), model.detection[kind]
            factor *= 1.0 - s if event == DEAD else s * (1.0 - p if event == MISSED else p)
            if event >= 0:
                factor *= scans[begin + i].feature[event, kind]
                claimed |= 1 << int(first[begin + i] + event)
        # states at the scans lived through = A (first state, what each step adds)
        blocks, A = [P], np.zeros((2 * until, 2 * (until + 1)))
        centre, row = mean, np.hstack([np.eye(2), np.zeros((2, 2 * until))])
        centres = list[Floats]()
        for i in range(until):
            F = model.slope(float(gaps[i]))
            blocks.append(model.spread(kind, float(gaps[i])))
            row = F @ row
            row[:, 2 * (i + 1) : 2 * (i + 2)] += np.eye(2)
            A[2 * i : 2 * i + 2] = row
            centre = F @ centre
            centres.append(centre)
        C = A @ block_diag(*blocks) @ A.T
        seen = [i for i in range(until) if events[i] >= 0]
        rows = [2 * i for i in seen]
        loc = np.concatenate([*centres, np.zeros(0)])
        if seen:
            z = np.array([scans[begin + i].values[events[i], 0] for i in seen])
            S = C[np.ix_(rows, rows)] + model.std**2 * np.eye(len(rows))
            factor *= float(multivariate_normal.pdf(z, loc[rows], S))
            K = C[:, rows] @ np.linalg.inv(S)
            loc, C = loc + K @ (z - loc[rows]), C - K @ C[rows]
        alive = until == len(events)
        yield claimed, factor, Gaussian(0.0, kind, loc[-2:], C[-2:, -2:]) if alive else None


def _by_claims(own: Sequence[tuple[int, float, Gaussian | None]], size: int) -> Floats:
    """Sum of the weights of histories by the set of measurements that they claim."""
    found = np.zeros(size)
    for claimed, weight, _ in own:
        found[claimed] += weight
    return found


def _joined(sums: Sequence[Floats], size: int) -> Floats:
    """Of several objects, by the set of all that they claim, nothing twice."""
    found = np.zeros(size)
    found[0] = 1.0
    for own in sums:
        some = np.flatnonzero(own)
        more = np.zeros(size)
        for mask in np.flatnonzero(found):
            for claimed in some:
                if not mask & claimed:
                    more[mask | claimed] += found[mask] * own[claimed]
        found = more
    return found
