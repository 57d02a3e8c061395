"""Which measurements the tracks of the labeled multi-Bernoulli filter most probably have.

Of each scan, one association of all objects that the filter then believes in, the one of the largest weight

    prod_missed (1 - r_t p_D) prod_detected r_t eta_t(z_theta(t)) / kappa_theta(t)

(inference.lmb), found as an assignment. An object begins with the measurement that showed it first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference import lmb
from inference.lmb import STRIDE, Belief, Knobs
from inference.lmb_kernel import unseen_mass
from inference.track_kernel import weights_of
from inference.tracking import Facts, track
from inference.tracks import Objects, Tracks
from models.multi_object import HasObjects, no_objects

Ints = NDArray[np.int64]
NEVER = -1e9  # log of nothing


class Associated(NamedTuple):
    """Tracks of the filter, and {label: its (scan, measurement) by time} of those that were ever confirmed."""

    tracks: Tracks
    measurements: dict[int, list[tuple[int, int]]]


def associate(
    model: HasObjects, scans: Sequence[Any], knobs: Knobs, *, threshold: float, report: float, progress: bool
) -> Associated:
    """Run the filter over scans that are in the order of time. An object is confirmed where it is more probable than
    the threshold; two never share a measurement."""
    told, chosen = list[Ints](), dict[tuple[int, int], int]()

    def step(belief: Belief, scan: Any, number: int) -> tuple[Belief, Facts]:
        objects, choice = best(model, belief, scan, number, knobs.gate)
        chosen.update({(number, int(j)): int(label) for label, j in zip(objects, choice, strict=True) if j >= 0})
        return lmb.step(model, belief, scan, number, knobs)

    def tell(belief: Belief) -> Objects:
        objects = lmb.tell(belief, report, len(model.kind_names))
        told.append(objects.label)
        return objects

    start = Belief(None, no_objects(len(model.names)))
    tracks = track(model, scans, start, step, tell, patience=0.0, progress=progress)
    raw = np.concatenate(told)
    sure = np.unique(raw[tracks.existence > threshold])
    for label in sure.tolist():
        number, j = divmod(label, STRIDE)
        if j < STRIDE // 2:  # else it came at a known place
            before = chosen.get((number, j))
            if before is None or not (sure == before).any():
                chosen[number, j] = label
    name = dict(zip(raw.tolist(), tracks.label.tolist(), strict=True))
    found: dict[int, list[tuple[int, int]]] = {name[label]: [] for label in sure.tolist()}
    for place, label in sorted(chosen.items()):
        if name.get(label) in found:
            found[name[label]].append(place)
    return Associated(tracks, {label: own for label, own in found.items() if own})


def best(model: HasObjects, belief: Belief, scan: Any, number: int, gate: float) -> tuple[Ints, Ints]:
    """Labels (T,) of the objects at a scan, and the measurement of each in the most probable association, -1 missed."""
    from scipy.optimize import linear_sum_assignment

    seconds = 0.0 if belief.time is None else scan.time - belief.time
    objects = lmb.predict(model, belief, seconds, number) if seconds > 0.0 else belief.objects
    new = model.unseen(scan)
    view = model.view(scan, objects, new)
    parts, count = objects.components, len(objects.components.weight)
    num, none = len(objects.label), np.full(len(objects.label), -1)
    if not num or not len(view.values):
        return objects.label, none
    shared = (view.predicted, view.slope, view.detection, view.values, view.noise, view.sort)
    _, rho = unseen_mass(new.offset, new.weight, new.kind, new.covariance, count, *shared, view.feature, view.period)
    intensity = np.maximum(view.clutter + rho, 1e-100)
    first = (part[:count] for part in view[:3])
    table = weights_of(parts.offset, parts.weight, parts.kind, parts.covariance, *first, *view[3:], gate)
    missed = 1.0 - objects.existence * np.bincount(parts.group, parts.weight * view.detection[:count], num)
    with np.errstate(divide="ignore"):
        gain = np.log(objects.existence[:, None] * table / intensity) - np.log(np.maximum(missed, 1e-12))[:, None]
    gain = np.concatenate([np.maximum(gain, NEVER), np.zeros((num, num))], 1)
    row, column = linear_sum_assignment(gain, maximize=True)
    none[row] = np.where(column < len(view.values), column, -1)
    return objects.label, none
