"""Labeled multi-Bernoulli filter with Gaussian mixtures (Reuter, Vo, Vo and Dietmayer 2014), the tracker of [K15].

What is believed is T independent objects, each of which exists with probability r_t and then has a density p_t, a
mixture over kinds and Gaussian states; and a Poisson process of objects that no scan has shown yet (Williams 2015).

predict   r <- r int s p,   p <- int f(x' | x) s(x) p(x) dx / int s p      f linearised (extended Kalman filter)
update    by one scan Z of one sensor. With eta_t(z) = int p_D g(z | x) p_t dx and what else may have made z_j,
          kappa_j = lambda_c(z_j) + rho_j,   rho_j = int p_D g(z_j | x) lambda_unseen(x) dx,
          an association theta of objects to measurements, no two to one, has the weight
              prod_missed (1 - r_t int p_D p_t) prod_detected r_t eta_t(z_theta(t)) / kappa_theta(t)
          of which only the marginals beta are kept: this is the LMB approximation, the closest multi-Bernoulli in its
          first moment. Then
              r_t <- beta_t0 r_t (1 - int p_D p_t) / (1 - r_t int p_D p_t) + sum_j beta_tj
          and p_t is the mixture of the posteriors of each event, reduced to few components.
birth     z_j begins a new object, in the same scan, with r = (1 - sum_t beta_tj) rho_j / kappa_j.

Labels are (scan, measurement) of the birth, so that late scans change none. A scan that comes late, but not later than
`patience` seconds, is put where it belongs and what followed is computed again; later ones are left out, and flagged.
Existence below `faint` is left out, and what was lost so is told: nothing vanishes silently.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from inference.association import MAX_BITS
from inference.lmb_kernel import heaviest, propagate, update
from inference.refusal import answers_first
from inference.tracking import MEMORY, Facts, require_objects, track
from inference.tracks import Objects, Tracks
from models.multi_object import Bernoullis, Components, HasObjects, Ints, Timed, no_objects, together
from models.program import InputError

STRIDE = 1 << 20  # labels: number of the scan times this, plus the measurement
LONGEST = 0.5  # a longer time is gone in several steps: motion is linearised at each [s]


class Knobs(NamedTuple):
    """Settings of the approximations.

    gate        squared Mahalanobis distance beyond which a measurement is not of a component
    least       components lighter than this share of their object are left out, but for the heaviest of each kind
    merge       squared Mahalanobis distance within which components are one
    most        components of each kind of an object
    faint       objects less probable than this are left out, newcomers at a tenth of it
    max_shared  measurements that objects of a group may share for exact association; belief propagation beyond
    """

    gate: float = 25.0
    least: float = 1e-3
    merge: float = 2.0
    most: int = 4
    faint: float = 1e-4
    max_shared: int = 8


def check(knobs: Knobs, report: float) -> None:
    """Raise InputError for settings that no filter can have."""
    wanted = {
        "gate": (knobs.gate > 0.0, "a positive number"),
        "least": (0.0 <= knobs.least < 1.0, "a share from 0 to below 1"),
        "merge": (knobs.merge >= 0.0, "a number of 0 or more"),
        "most": (knobs.most >= 1, "1 or more"),
        "faint": (0.0 <= knobs.faint < 1.0, "a probability below 1"),
        "max_shared": (0 <= knobs.max_shared <= MAX_BITS, f"0 to {MAX_BITS} bits"),
    }
    for name, (right, what) in wanted.items():
        if not right:
            raise InputError(f"{name} is {getattr(knobs, name)}; give {what}")
    if not 0.0 <= report < 1.0:
        raise InputError(f"report is {report}; give a probability below 1")


class Belief(NamedTuple):
    """What is believed at a time [s], None before the first scan; which measurement of the scan of then most probably
    is of each object (T,), -1 where it was more probably missed; and the latest scans, by time."""

    time: float | None
    objects: Bernoullis
    measurement: Ints = np.zeros(0, dtype=np.int64)
    past: tuple[Timed, ...] = ()


def moved(model: HasObjects, objects: Bernoullis, seconds: float) -> Bernoullis:
    """What time makes of objects: where they are `seconds` later, and whether they still are."""
    if not len(objects.label):
        return objects
    steps = max(1, math.ceil(seconds / LONGEST - 1e-9))
    offset, weight, kind, mean, covariance = objects.components
    existence, weight, covariance = objects.existence.copy(), weight.copy(), covariance.copy()
    for _ in range(steps):
        found = model.move(kind, mean, seconds / steps)
        propagate(offset, existence, weight, covariance, found.slope, found.noise, found.survival)
        mean = found.mean
    return Bernoullis(objects.label, existence, Components(offset, weight, kind, mean, covariance))


def predict(model: HasObjects, belief: Belief, seconds: float, number: int) -> Bernoullis:
    """The objects `seconds` later, with those that arrived at known places, labelled by the scan's `number`."""
    objects, arrived = moved(model, belief.objects, seconds), model.arrivals(seconds)
    if len(arrived.label):
        label = number * STRIDE + STRIDE // 2 + np.arange(len(arrived.label))
        objects = together(objects, arrived._replace(label=label))
    return objects


def step(model: HasObjects, belief: Belief, scan: Timed, number: int, knobs: Knobs) -> tuple[Belief, Facts]:
    """Predict to the scan, and update by it. `number` of the scan, for labels. The scan must not be older than the
    belief."""
    objects, seconds = belief.objects, 0.0 if belief.time is None else scan.time - belief.time
    if seconds > 0.0:
        objects = predict(model, belief, seconds, number)
    unseen = model.unseen(scan, belief.past)
    view = model.view(scan, objects, unseen)
    source, measurement, existence, *parts, (log_factor, loopy, left_out) = update(
        objects.existence, *objects.components, *unseen, *view,
        model.period, knobs.gate, knobs.least, knobs.merge, knobs.most, knobs.faint, knobs.max_shared,
    )  # fmt: skip
    born = source < 0
    label = np.empty(len(source), dtype=np.int64)
    label[~born] = objects.label[source[~born]]
    label[born] = number * STRIDE - 1 - source[born]
    finite = all(math.isfinite(part.sum()) for part in (existence, *parts)) and math.isfinite(log_factor + left_out)
    if not finite or parts[-1].diagonal(0, 1, 2).min(initial=0.0) < 0.0:
        raise FloatingPointError(
            f"the update by sensor '{scan.sensor}' at {scan.time} s made a number that is not finite, or a negative "
            "variance; look for noises, speeds or gaps between scans that are far too large"
        )
    posterior = Bernoullis(label, existence, Components(*parts))
    past = (*belief.past[1 - MEMORY :], scan)
    return Belief(scan.time, posterior, measurement, past), Facts(log_factor, int(loopy), float(left_out))


def tell(belief: Belief, report: float, num_kinds: int) -> Objects:
    """The objects more probable than `report`, each as its heaviest component."""
    objects = belief.objects
    mean, covariance, kind = heaviest(*objects.components, num_kinds)
    rows = np.flatnonzero(objects.existence > report)
    return Objects(
        objects.label[rows], objects.existence[rows], mean[rows], covariance[rows], kind[rows], belief.measurement[rows]
    )


@answers_first
def run(
    model: HasObjects,
    scans: Sequence[Any],
    *,
    seed: int = 0,
    gate: float = Knobs().gate,
    least: float = Knobs().least,
    merge: float = Knobs().merge,
    most: int = Knobs().most,
    faint: float = Knobs().faint,
    max_shared: int = Knobs().max_shared,
    patience: float = 1.0,
    report: float = 0.01,
    progress: bool = False,
) -> Tracks:
    """What is believed after each scan, in the order in which scans arrive. Nothing is random: `seed` is not read.

    gate ... max_shared  see Knobs
    patience             how old a late scan may be [s]
    report               objects less probable than this are not told of

    State and covariance of an object are those of its heaviest component. Raises InputError for a model of something
    else than many objects, for settings out of their range, and for a scan that it cannot use."""
    require_objects(model, "lmb")
    knobs = Knobs(gate, least, merge, most, faint, max_shared)
    check(knobs, report)
    return track(
        model,
        scans,
        Belief(None, no_objects(len(model.names))),
        lambda belief, scan, number: step(model, belief, scan, number, knobs),
        lambda belief: tell(belief, report, len(model.kind_names)),
        patience=patience,
        progress=progress,
    )
