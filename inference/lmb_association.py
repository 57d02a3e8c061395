"""Which measurements the tracks of the labeled multi-Bernoulli filter most probably have.

Of each scan, one association of all objects that the filter then believes in, the one of the largest weight

    prod_missed (1 - r_t p_D) prod_detected r_t eta_t(z_theta(t)) / kappa_theta(t)

(inference.lmb), found as an assignment. Of objects that are ever confirmed, r = 1: they are known to exist by what
came later. An object begins with the measurement that showed it first, unless another has it.
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

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
NEVER = -1e9  # log of nothing


class Associated(NamedTuple):
    """Tracks of the filter, and {label: its (scan, measurement) by time} of those that were ever confirmed."""

    tracks: Tracks
    measurements: dict[int, list[tuple[int, int]]]


class Pairs(NamedTuple):
    """T objects at a scan and its M measurements.

    label      (T,)
    existence  (T,) r
    seen       (T,) p_D
    ratio      (T, M) eta_t(z_j) / kappa_j
    """

    label: Ints
    existence: Floats
    seen: Floats
    ratio: Floats


def associate(
    model: HasObjects, scans: Sequence[Any], knobs: Knobs, *, threshold: float, report: float, progress: bool
) -> Associated:
    """Run the filter over scans that are in the order of time. An object is confirmed where it is more probable than
    the threshold; two never share a measurement."""
    told, pairs = list[Ints](), list[Pairs]()

    def step(belief: Belief, scan: Any, number: int) -> tuple[Belief, Facts]:
        pairs.append(pairs_of(model, belief, scan, number, knobs.gate))
        return lmb.step(model, belief, scan, number, knobs)

    def tell(belief: Belief) -> Objects:
        objects = lmb.tell(belief, report, len(model.kind_names))
        told.append(objects.label)
        return objects

    start = Belief(None, no_objects(len(model.names)))
    tracks = track(model, scans, start, step, tell, patience=0.0, progress=progress)
    raw = np.concatenate(told)
    sure = np.unique(raw[tracks.existence > threshold])
    name = dict(zip(raw.tolist(), tracks.label.tolist(), strict=True))
    found: dict[int, list[tuple[int, int]]] = {label: [] for label in sure.tolist()}
    for number, here in enumerate(pairs):
        free = np.ones(here.ratio.shape[1], dtype=bool)
        for label, j in zip(here.label.tolist(), best(here, sure).tolist(), strict=True):
            if j >= 0 and label in found:
                found[label].append((number, j))
                free[j] = False
        for j in np.flatnonzero(free).tolist():
            if number * STRIDE + j in found:
                found[number * STRIDE + j].append((number, j))
    return Associated(tracks, {name[label]: own for label, own in found.items() if own})


def pairs_of(model: HasObjects, belief: Belief, scan: Any, number: int, gate: float) -> Pairs:
    """What the objects of a belief and the measurements of a scan, taken next, have to do with each other."""
    seconds = 0.0 if belief.time is None else scan.time - belief.time
    objects = lmb.predict(model, belief, seconds, number) if seconds > 0.0 else belief.objects
    new = model.unseen(scan, belief.past)
    view = model.view(scan, objects, new)
    parts, count = objects.components, len(objects.components.weight)
    shared = (view.predicted, view.slope, view.detection, view.values, view.noise, view.sort)
    _, rho = unseen_mass(new.offset, new.weight, new.kind, new.covariance, count, *shared, view.feature, view.period)
    here = view._replace(
        predicted=view.predicted[:count], slope=view.slope[:count], detection=view.detection[:count]
    )  # of objects, not of what may be new
    table = weights_of(parts.offset, parts.weight, parts.kind, parts.covariance, *here, gate)
    seen = np.bincount(parts.group, parts.weight * here.detection, len(objects.label)).astype(np.float64)
    return Pairs(objects.label, objects.existence, seen, table / np.maximum(view.clutter + rho, 1e-100))


def best(pairs: Pairs, sure: Ints) -> Ints:
    """(T,) the measurement of each object in the most probable association, -1 missed; those that are `sure` exist."""
    from scipy.optimize import linear_sum_assignment

    num, num_measurements = pairs.ratio.shape
    r = np.where(np.isin(pairs.label, sure), 1.0, pairs.existence)
    with np.errstate(divide="ignore"):
        gain = np.log(r[:, None] * pairs.ratio) - np.log(np.maximum(1.0 - r * pairs.seen, 1e-12))[:, None]
    gain = np.concatenate([np.maximum(gain, NEVER), np.zeros((num, num))], 1)
    row, column = linear_sum_assignment(gain, maximize=True)
    found = np.full(num, -1)
    found[row] = np.where(column < num_measurements, column, -1)
    return found
