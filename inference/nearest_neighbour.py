"""A Kalman filter for each object, fed with global nearest neighbours: what multi-object filters are compared with.

    association  the most probable one, theta, is taken for true:
                     theta = argmax  prod_missed (1 - p_D) prod_detected p_D g(z_theta(t) | t) / kappa_theta(t)
                 kappa_j being what else makes z_j, false alarms and unseen objects, as in inference.lmb
    instances    x_t | z_theta(t) by Kalman's equations, h and f linearised
    begin        every measurement left over, from what the model says of unseen objects there
    confirm      `hits` measurements in the first `looks` scans that look at it; else it ends
    end          after `misses` scans in a row that look at it in vain, or `gone` seconds without a measurement

An instance of which kind or heading is not known is a bank of Kalman filters, weighted by how well each foretells, and
those lighter than `least` end; it is one where the model has one way to begin. No doubt is kept of who made what, nor
of existence: confirmed objects are told of with existence 1, others not at all (Bar-Shalom, Willett and Tian 2011).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference import lmb
from inference.association import MISSED, Table, best
from inference.lmb_kernel import heaviest
from inference.refusal import answers_first
from inference.track_kernel import see, weights_of
from inference.tracking import MEMORY, Facts, require_objects, track
from inference.tracks import Objects, Tracks
from models.multi_object import Bernoullis, Components, HasObjects, Timed, View, no_objects, together
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
LOOKED = 0.5  # a scan looks at an object where it detects it with this probability or more
RARE = 1e-12  # no object is missed less probably, and nothing is left out that is heavier than this share


class Knobs(NamedTuple):
    """Settings.

    gate    squared Mahalanobis distance beyond which a measurement is not of an object
    hits, looks  measurements that confirm an object, in so many scans that look at it first
    misses  scans in a row that look at an object in vain and end it
    gone    how long an object may be out of all views [s]
    least   filters of a bank lighter than this end
    """

    gate: float = 16.0
    hits: int = 3
    looks: int = 4
    misses: int = 3
    gone: float = 2.0
    least: float = 1e-3


class Instances(NamedTuple):
    """T instances at a time [s], None before the first scan.

    objects  of which existence is one, but for those that just came to known places
    hits     (T,) measurements so far
    looks    (T,) scans that looked, those with a measurement included
    vain     (T,) of these, those since the last measurement
    last     (T,) time of the last measurement [s]
    sure     (T,) whether it is confirmed
    past     the latest scans, by time
    """

    time: float | None
    objects: Bernoullis
    hits: Ints
    looks: Ints
    vain: Ints
    last: Floats
    sure: NDArray[np.bool_]
    past: tuple[Timed, ...] = ()


def nobody(size: int) -> Instances:
    """Before the first scan."""
    none = np.zeros(0, dtype=np.int64)
    return Instances(None, no_objects(size), none, none, none, np.zeros(0), none.astype(bool))


def step(model: HasObjects, belief: Instances, scan: Timed, number: int, knobs: Knobs) -> tuple[Instances, Facts]:
    """Predict to the scan, associate, update, begin and end. The scan must not be older than the belief."""
    belief = predict(model, belief, scan.time, number)
    objects, (label, existence, components) = belief.objects, belief.objects
    unseen = model.unseen(scan, belief.past)
    view = model.view(scan, objects, unseen)
    num, count = len(view.values), len(components.weight)
    known, new = part_of(view, slice(count)), part_of(view, slice(count, None))
    fresh, rho = given(unseen, new, np.arange(num), np.inf)
    kappa = np.maximum(view.clutter + rho, 1e-100)
    seen = existence * summed(components, components.weight * known.detection)
    share = weights_of(components.offset, components.weight, components.kind, components.covariance, *known, knobs.gate)
    ratio = existence[:, None] * share / kappa
    missed = np.maximum(1.0 - seen, RARE)
    rows, columns = np.nonzero(ratio)
    offset = np.searchsorted(rows, np.arange(len(label) + 1))
    theta = best(Table(offset, columns, ratio[rows, columns], missed))
    found = theta != MISSED
    chosen = np.where(found, ratio[np.arange(len(label)), theta] if num else missed, missed)
    log_factor = float(np.log(kappa).sum() + np.log(chosen).sum())

    looked = (seen >= LOOKED) | found
    hits, looks = belief.hits + found, belief.looks + looked
    vain, last = np.where(found, 0, belief.vain + looked), np.where(found, scan.time, belief.last)
    sure = belief.sure | ((hits >= knobs.hits) & (looks <= knobs.looks))
    hopeless = ~sure & ((looks - hits > knobs.looks - knobs.hits) | (hits == 0))
    keep = ~hopeless & (vain < knobs.misses) & (scan.time - last <= knobs.gone)
    old, _ = given(components, known, theta, knobs.gate)
    free = np.setdiff1d(np.flatnonzero(rho > 0.0), theta)

    ones = np.ones(len(free), dtype=np.int64)
    after = together(
        Bernoullis(label[keep], np.ones(keep.sum()), lighter(old, keep, knobs.least)),
        Bernoullis(
            number * lmb.STRIDE + free, np.ones(len(free)), lighter(fresh, np.isin(np.arange(num), free), knobs.least)
        ),
    )
    hits, looks, vain = (np.append(a[keep], b) for a, b in ((hits, ones), (looks, ones), (vain, 0 * ones)))
    last, sure = np.append(last[keep], scan.time * ones), np.append(sure[keep], ones * knobs.hits <= 1)
    past = (*belief.past[1 - MEMORY :], scan)
    return Instances(scan.time, after, hits, looks, vain, last, sure, past), Facts(log_factor)


def predict(model: HasObjects, belief: Instances, now: float, number: int) -> Instances:
    """At time `now`, with what came to known places; an instance lives on for sure."""
    if belief.time is None or now <= belief.time:
        return belief
    moved = lmb.predict(model, lmb.Belief(belief.time, belief.objects), now - belief.time, number)
    num = len(belief.hits)
    existence = np.where(np.arange(len(moved.label)) < num, 1.0, moved.existence)
    more = len(moved.label) - num
    hits, looks, vain = (np.append(values, np.zeros(more, dtype=np.int64)) for values in belief[2:5])
    last, sure = np.append(belief.last, np.full(more, now)), np.append(belief.sure, np.zeros(more, dtype=bool))
    return Instances(now, moved._replace(existence=existence), hits, looks, vain, last, sure, belief.past)


def summed(components: Components, values: Floats) -> Floats:
    """Sums over the components of each group."""
    out = np.zeros((len(components.offset) - 1, *values.shape[1:]))
    np.add.at(out, components.group, values)
    return out


def part_of(view: View, rows: slice) -> View:
    """The view of some components."""
    return view._replace(predicted=view.predicted[rows], slope=view.slope[rows], detection=view.detection[rows])


def given(components: Components, view: View, chosen: Ints, gate: float) -> tuple[Components, Floats]:
    """The groups (T,), each given its measurement or that it has none, and what that weighs (T,)."""
    offset, weight, kind, mean, covariance = components
    own = Components(offset, weight.copy(), kind, mean.copy(), covariance.copy())
    factor = see(*own, chosen, *view, gate)
    never = (factor <= RARE * RARE)[own.group]  # missed in spite of p_D = 1: nothing is learnt of which it is
    return own._replace(weight=np.where(never, weight, own.weight)), factor


def lighter(components: Components, keep: Any, least: float) -> Components:
    """The groups to keep, without filters that are too light."""
    group = components.group
    stay = keep[group] & (components.weight >= least)
    weight = np.where(stay, components.weight, 0.0)
    weight = (weight / np.where(keep, summed(components, weight), 1.0)[group])[stay]
    offset = np.append(0, np.cumsum(np.bincount(group[stay], minlength=len(keep))[keep])).astype(np.int64)
    return Components(offset, weight, *(values[stay] for values in components[2:]))


def tell(belief: Instances, num_kinds: int) -> Objects:
    """The confirmed ones, each as the heaviest of its filters."""
    mean, covariance, kind = heaviest(*belief.objects.components, num_kinds)
    rows = np.flatnonzero(belief.sure)
    return Objects(belief.objects.label[rows], np.ones(len(rows)), mean[rows], covariance[rows], kind[rows])


@answers_first
def run(
    model: HasObjects,
    scans: Sequence[Any],
    *,
    seed: int = 0,
    gate: float = Knobs().gate,
    hits: int = Knobs().hits,
    looks: int = Knobs().looks,
    misses: int = Knobs().misses,
    gone: float = Knobs().gone,
    least: float = Knobs().least,
    patience: float = 1.0,
    progress: bool = False,
) -> Tracks:
    """The confirmed objects after each scan, in the order in which scans arrive. Nothing is random: `seed` is not read.

    gate ... least  see Knobs
    patience        how old a late scan may be [s]

    log_evidence is log p(scans, associations), less than that of the scans. Raises InputError for a model of something
    else than many objects, for a scan that it cannot use, and for more hits than looks."""
    require_objects(model, "nearest_neighbour")
    if not 1 <= hits <= looks:
        raise InputError(f"hits is {hits} and looks {looks}; give 1 or more hits in at least as many looks")
    knobs = Knobs(gate, hits, looks, misses, gone, least)
    return track(
        model,
        scans,
        nobody(len(model.names)),
        lambda belief, scan, number: step(model, belief, scan, number, knobs),
        lambda belief: tell(belief, len(model.kind_names)),
        patience=patience,
        progress=progress,
    )
