"""Filters of many objects over the scans of many sensors, each in its time: what all of them share.

A filter is a step from one belief to the next. Scans come in the order of their arrival, which need not be that of
their times: one that comes late, but not by more than `patience` seconds, is put where it belongs, and the steps of the
scans after it are done again from the belief of then. So the belief is what it would have been had all come in time. A
scan that comes later still is left out, and told of.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from inference.progress import Progress, announce
from inference.refusal import accept
from inference.tracks import Objects, Tracks
from models.multi_object import HasObjects, Timed
from models.program import InputError

MEMORY = 32  # scans that a model is told of, to know where sensors have looked
LOST = 0.01  # of the objects expected: more than that left out is flagged


class Dated(Protocol):
    """A belief, as far as time is concerned: None before the first scan [s]."""

    @property
    def time(self) -> float | None: ...


AnyBelief = TypeVar("AnyBelief", bound=Dated)


class Facts(NamedTuple):
    """Of one step: log p(Z | past) but for the expected number of detections, groups of objects that were associated by
    belief propagation, expected number of objects left out because each was too improbable."""

    log_factor: float
    loopy: int = 0
    left_out: float = 0.0


class Past(NamedTuple):
    """A scan that has been used, its number, and what was believed before it."""

    before: Any
    scan: Timed
    number: int
    facts: Facts


def require_objects(model: Any, engine: str) -> None:
    """Raise InputError for a model that tells nothing of many objects."""
    if not isinstance(model, HasObjects):
        raise InputError(
            f"{engine} needs a model of many objects, with move, view, unseen and arrivals; {type(model).__name__} is "
            "none: choose one whose name begins with traffic_, such as model=traffic_plots"
        )


def track(
    model: HasObjects,
    scans: Sequence[Any],
    belief: AnyBelief,
    step: Callable[[AnyBelief, Any, int], tuple[AnyBelief, Facts]],
    tell: Callable[[AnyBelief], Objects],
    *,
    patience: float,
    progress: bool,
) -> Tracks:
    """What `tell` says of the belief after each arrival. Raises InputError for no scans, and for one that the model
    cannot use."""
    if not patience >= 0.0:
        raise InputError(f"patience is {patience}; give the seconds that a scan may come late, 0 or more")
    scans = model.check(scans)
    if not len(scans):
        raise InputError("a filter needs at least one scan, but got none; wait for the first")
    accept()
    past, told, seconds, now = list[Past](), list[Objects](), list[float](), list[float]()
    total, late, too_late = np.zeros(3), 0, 0  # facts of the steps that the belief is made of
    with Progress("tracking", len(scans), progress) as bar, announce("compiling the filter", after=4.0):
        for number, scan in enumerate(scans):
            begin = time.perf_counter()
            if belief.time is not None and scan.time < belief.time - patience:
                too_late += 1
            else:
                after = [entry for entry in past if entry.scan.time > scan.time]
                past = [entry for entry in past if entry.scan.time <= scan.time]
                late += bool(after)
                belief = after[0].before if after else belief
                for entry in after:
                    total -= entry.facts
                for then, at in [(number, scan), *((entry.number, entry.scan) for entry in after)]:
                    before = belief
                    belief, facts = step(before, at, then)
                    past.append(Past(before, at, then, facts))
                    total += facts
                past = [entry for entry in past if entry.scan.time >= past[-1].scan.time - patience]
            seconds.append(time.perf_counter() - begin)
            now.append(float(belief.time or 0.0))
            told.append(tell(belief))
            bar.advance(1)
    log_factor, loopy, left_out = total.tolist()
    info = {"step_seconds": seconds, "scans": len(scans), "late": late, "too_late": too_late}
    info |= {"groups_by_belief_propagation": int(loopy), "left_out": left_out}
    flags = list[str]()
    if too_late:
        flags.append(f"{too_late} of {len(scans)} scans came more than {patience} s late and were left out")
    expected = sum(float(objects.existence.sum()) for objects in told) / len(told)
    if left_out > LOST * max(expected, 1.0) * len(scans):
        flags.append(f"objects that were too improbable to keep add up to {left_out:.1f}; lower `faint`")
    return _tracks(model, scans, now, told, info | {"flags": flags}, log_factor)


def _tracks(
    model: HasObjects,
    scans: Sequence[Any],
    now: list[float],
    told: list[Objects],
    info: dict[str, Any],
    log_sum: float,
) -> Tracks:
    """All that was told, labels counted from 0 in the order of their first appearance."""
    size = [len(objects.label) for objects in told]
    *parts, shown = zip(*told, strict=True)
    rows = [np.concatenate(part) for part in parts]
    _, first, which = np.unique(rows[0], return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return Tracks(
        time=np.array(now),
        offset=np.cumsum([0, *size]),
        label=rank[which],
        existence=np.minimum(rows[1], 1.0),
        mean=rows[2],
        covariance=rows[3],
        kind=rows[4],
        measurement=None if shown[0] is None else np.concatenate(shown),
        names=model.names,
        kind_names=model.kind_names,
        sensor=tuple(scan.sensor for scan in scans),
        log_evidence=log_sum,
        info=info,
    )
