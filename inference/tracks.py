"""What filters of many objects believe after each scan: labelled objects that may exist, and where they then are."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference.posterior import Posterior, fields_of, part_of, stored
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

COUNT = "count"  # the site: the number of objects at each scan
ARRAYS = ("time", "offset", "label", "existence", "mean", "covariance", "kind", "measurement")
NUM_DRAWS = 1000  # of the number of objects


class Objects(NamedTuple):
    """What is believed after one scan; n objects as in Tracks.

    label       (n,)
    existence   (n,)
    mean        (n, d)
    covariance  (n, d, d)
    kind        (n, C)
    measurement (n,), None from engines that do not say
    """

    label: Ints
    existence: Floats
    mean: Floats
    covariance: Floats
    kind: Floats
    measurement: Ints | None = None


class Trajectory(NamedTuple):
    """One object over the n scans that show it: time (n,), mean (n, d), covariance (n, d, d)."""

    time: Floats
    mean: Floats
    covariance: Floats


class Drawn(NamedTuple):
    """S draws of R rows, laid out as in Tracks.

    exists  (S, R) whether there is an object
    state   (S, R, d) of it, NaN where there is none
    kind    (S, R) of it, -1 where there is none
    """

    exists: NDArray[np.bool_]
    state: Floats
    kind: Ints


@dataclass(frozen=True, kw_only=True)
class Tracks(Posterior):
    """Bernoulli objects after each of T scans; R rows in all, those of scan t being offset[t] ... offset[t + 1] - 1.

        p(objects after scan t) = prod over rows i of scan t:  absent with 1 - r_i, else at x ~ N(mean_i, covariance_i)

    time        (T,) that the belief is about, never decreasing [s]
    offset      (T + 1,)
    label       (R,) who it is, the same over time; at most once in a scan
    existence   (R,) r
    mean        (R, d) of the state given that the object exists
    covariance  (R, d, d) the same
    kind        (R, C) probabilities of the kinds given that the object exists
    measurement (R,) of the scan, which most probably is of the object: -1 where it was more probably missed. Where a
                scan came late, of the last one by time. None from engines that do not say
    names       (d,) of the state's entries: x, y and others, such as vx, vy, heading, speed, length, width
    kind_names  (C,)
    sensor      (T,) whose scan it was
    info        `step_seconds` (T,) of each scan, flags, and what other engines say

    Objects are independent given the scans so far, and what is believed after a scan says nothing of paths: draws at
    different times are independent. Where an engine has none of its own, `draws` are 1000 exact ones of the number of
    objects, {"count": (1, 1000, T)}; model_index is then that after the last scan.

    The mean of a site, Posterior.mean(tracks, site), has no name here: `mean` is that of the states.

    Raises InputError for arrays that do not fit each other, for NaN, and for times that go back."""

    draws: dict[str, NDArray[Any]] = field(default_factory=dict)
    time: Floats
    offset: Ints
    label: Ints
    existence: Floats
    mean: Floats = field()  # type: ignore[assignment]
    covariance: Floats
    kind: Floats
    names: tuple[str, ...]
    kind_names: tuple[str, ...]
    sensor: tuple[str, ...]
    measurement: Ints | None = None

    def __post_init__(self) -> None:
        _check(self)
        if not self.draws:
            count = _draw_counts(self.count_probability(), NUM_DRAWS)
            object.__setattr__(self, "draws", {COUNT: count[None]})
            object.__setattr__(self, "model_index", count[None, :, -1])

    @property
    def scan(self) -> Ints:
        """(R,) the scan of each row."""
        return np.repeat(np.arange(len(self.time)), np.diff(self.offset))

    def at(self, t: int) -> Objects:
        """What is believed after scan t."""
        rows = slice(self.offset[t], self.offset[t + 1])
        return Objects(**{name: values[rows] for name, values in self._by_row().items()})

    def confirmed(self, threshold: float = 0.5) -> Tracks:
        """The rows whose existence is above the threshold."""
        return self.kept(self.existence > threshold)

    def kept(self, keep: NDArray[np.bool_]) -> Tracks:
        """The rows that are to be kept (R,)."""
        return replace(
            self,
            draws={},
            offset=np.concatenate([[0], np.cumsum(keep)])[self.offset],
            **{name: values[keep] for name, values in self._by_row().items()},
        )

    def trajectories(self, threshold: float = 0.5) -> dict[int, Trajectory]:
        """{label: where it is confirmed to be}, in the order of first appearance."""
        sure = self.confirmed(threshold)
        time = sure.time[sure.scan]
        return {
            label: Trajectory(time[rows], sure.mean[rows], sure.covariance[rows])
            for label, rows in rows_by_label(sure.label).items()
        }

    def entries(self, *names: str) -> list[int]:
        """Where entries stand in the state. Raises InputError by name for one that it has not."""
        for name in names:
            if name not in self.names:
                raise InputError(f"the states of the tracks have no '{name}', only {', '.join(self.names)}")
        return [self.names.index(name) for name in names]

    @property
    def position(self) -> Floats:
        """(R, 2) mean of x and y [m]."""
        return self.mean[:, self.entries("x", "y")]

    def count_mean(self) -> Floats:
        """(T,) expected number of objects after each scan, the sum of r."""
        return np.diff(np.concatenate([[0.0], np.cumsum(self.existence)])[self.offset])

    def count_probability(self) -> Floats:
        """(T, N + 1) probabilities of 0, 1, ..., N objects after each scan (Poisson-binomial), N the most there can be:

        p_j <- p_j (1 - r) + p_(j-1) r   for one object after the other"""
        size = np.diff(self.offset)
        existence = np.zeros((len(size), size.max(initial=0)))
        existence[self.scan, np.arange(len(self.label)) - self.offset[self.scan]] = self.existence
        p = np.zeros((len(size), existence.shape[1] + 1))
        p[:, 0] = 1.0
        for r in existence.T[..., None]:  # (T, 1)
            p[:, 1:] = p[:, 1:] * (1.0 - r) + p[:, :-1] * r
            p[:, :1] *= 1.0 - r
        return p

    def count_quantile(self, q: float) -> Ints:
        """(T,) the least number of objects that there are at most with probability q."""
        ladder = np.cumsum(self.count_probability(), 1)
        return np.minimum((ladder < q).sum(1), ladder.shape[1] - 1)

    def sample(self, num: int, seed: int) -> Drawn:
        """Draws of which objects exist, and of their states and kinds; arrays of num * R * d numbers."""
        rng = np.random.default_rng(np.random.SeedSequence(seed))
        shape = (num, len(self.label))
        exists = rng.random(shape) < self.existence
        value, vector = np.linalg.eigh(self.covariance)
        root = vector * np.sqrt(np.maximum(value, 0.0))[:, None, :]  # states may be known exactly
        state = self.mean + np.einsum("rij,srj->sri", root, rng.standard_normal((*shape, len(self.names))))
        kind = (np.cumsum(self.kind, 1)[None, :, :-1] < rng.random(shape)[..., None]).sum(-1)
        return Drawn(exists, np.where(exists[..., None], state, np.nan), np.where(exists, kind, -1))

    def table(self, threshold: float = 0.5) -> list[dict[str, Any]]:
        """A row for each object that is ever confirmed: from when to when, in how many scans, its mean existence in
        them, and its most probable kind."""
        sure = self.confirmed(threshold)
        time, rows = sure.time[sure.scan], list[dict[str, Any]]()
        for label, own in rows_by_label(sure.label).items():
            kind = sure.kind[own].mean(0)
            rows.append(
                {
                    "label": label,
                    "from_s": round(float(time[own[0]]), 3),
                    "until_s": round(float(time[own[-1]]), 3),
                    "scans": len(own),
                    "existence": round(float(sure.existence[own].mean()), 3),
                    "kind": self.kind_names[int(kind.argmax())],
                    "kind_probability": round(float(kind.max()), 3),
                }
            )
        return rows

    def _by_row(self) -> dict[str, Any]:
        """Those of them that have a row for each object."""
        return {name: values for name, values in self._arrays().items() if name in Objects._fields}

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """All that are there."""
        return {name: getattr(self, name) for name in ARRAYS if getattr(self, name) is not None}

    def _contents(self) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Those of a Posterior, which can be loaded as such, and the tracks."""
        arrays, rest = super()._contents()
        own = {"names": self.names, "kind_names": self.kind_names, "sensor": self.sensor}
        return arrays | {f"tracks/{name}": values for name, values in self._arrays().items()}, rest | {"tracks": own}

    @staticmethod
    def load(folder: Path) -> Tracks:
        """Read what `save` wrote; no pickle is ever opened. Raises InputError for a posterior without tracks."""
        arrays, rest = stored(folder)
        if "tracks" not in rest:
            raise InputError(f"'{folder}' holds a posterior without tracks; read it with Posterior.load")
        fields: dict[str, Any] = fields_of(arrays, rest) | part_of(arrays, "tracks/")
        return Tracks(**fields | {name: tuple(values) for name, values in rest["tracks"].items()})


def rows_by_label(label: Ints) -> dict[int, Ints]:
    """{label: its rows}, in the order of first appearance."""
    order = np.argsort(label, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if len(label) else []
    return {int(label[rows[0]]): rows for rows in sorted(parts, key=lambda rows: int(rows[0]))}


def _draw_counts(probability: Floats, num: int) -> Ints:
    """Numbers of objects (num, T), independent over scans."""
    rng = np.random.default_rng(np.random.SeedSequence(0))
    ladders = np.cumsum(probability, 1)[:, :-1]
    return np.stack([np.searchsorted(ladder, rng.random(num), side="right") for ladder in ladders], 1).astype(np.int64)


def _check(tracks: Tracks) -> None:
    num_scans, rows, d, kinds = len(tracks.time), len(tracks.label), len(tracks.names), len(tracks.kind_names)
    if num_scans == 0:
        raise InputError("tracks need at least one scan, but their time is empty")
    shapes = {
        "offset": (num_scans + 1,),
        "existence": (rows,),
        "mean": (rows, d),
        "covariance": (rows, d, d),
        "kind": (rows, kinds),
    }
    if tracks.measurement is not None:
        shapes["measurement"] = (rows,)
    for name, shape in shapes.items():
        if np.shape(getattr(tracks, name)) != shape:
            raise InputError(f"tracks of {num_scans} scans need {name} {shape}, not {np.shape(getattr(tracks, name))}")
    if len(tracks.sensor) != num_scans:
        raise InputError(f"tracks of {num_scans} scans name {len(tracks.sensor)} sensors; give one for each scan")
    if tracks.offset[0] != 0 or tracks.offset[-1] != rows or (np.diff(tracks.offset) < 0).any():
        raise InputError(f"offset of tracks must rise from 0 to the number of rows, {rows}, but is {tracks.offset}")
    for name in ("time", "existence", "mean", "covariance", "kind"):
        bad = ~np.isfinite(getattr(tracks, name))
        if bad.any():
            where = int(np.argwhere(bad)[0][0])
            raise InputError(f"{name} of tracks is {getattr(tracks, name)[where]} in row {where}; it must be finite")
    if len(back := np.flatnonzero(np.diff(tracks.time) < 0.0)):
        t = int(back[0])
        raise InputError(
            f"time of tracks goes back from {tracks.time[t]} to {tracks.time[t + 1]} s after scan {t}; "
            "put the scans in order of time"
        )
    if len(wrong := np.flatnonzero((tracks.existence < 0.0) | (tracks.existence > 1.0))):
        raise InputError(f"existence of tracks is {tracks.existence[wrong[0]]} in row {wrong[0]}, no probability")
    order = np.lexsort((tracks.label, tracks.scan))
    twice = (np.diff(tracks.label[order]) == 0) & (np.diff(tracks.scan[order]) == 0)
    if twice.any():
        row = int(order[:-1][twice][0])
        raise InputError(
            f"label {tracks.label[row]} stands twice in scan {tracks.scan[row]} of tracks; label is a name"
        )
