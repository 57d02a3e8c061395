"""Labeled multi-Bernoulli filter with particles (Reuter, Vo, Vo and Dietmayer 2014, sequential Monte Carlo version).

What is believed is what inference.lmb believes, with the density of each object as N weighted particles (k_i, x_i) for
kinds and states instead of few Gaussians: it may have any shape. Particles by themselves die out where an accurate
sensor hits between them. So they are regularised, and led to where the scan is (inference.object_particles):

predict   r <- r sum w_i s(x_i),   w_i <- w_i s(x_i) / sum.   Component i is N(m_i, P_i), the kernel about f(x_i) and
          the noise of the motion, P_i = L L' + h^2 V with V the covariance of its family: particles that began alike
update    eta_ij = p_D(m_i) N(z_j; h(m_i), H P_i H' + R) l(z_j | k_i), with the slope H at m_i. The associations have
          weights prod_missed (1 - r sum_i w_i p_D(m_i)) prod_detected r sum_i w_i eta_ij / kappa_j and marginals beta:
              r <- beta_t0 r (1 - sum_i w_i p_D(m_i)) / (1 - r sum_i w_i p_D(m_i)) + sum_j beta_tj
          N pairs (i, j) of a component and its measurement, or none, are drawn by systematic resampling with weights
          beta_t0 w_i (1 - p_D(m_i)) r / (1 - r sum_i w_i p_D(m_i)) and beta_tj w_i eta_ij / sum_i w_i eta_ij, then
          x ~ p(x | i, z_j) of the linearised h, and w what the linearisation got wrong: an auxiliary particle filter
birth     z_j begins an object with r = (1 - sum_t beta_tj) rho_j / kappa_j; rho_j is that of inference.lmb, with h
          linearised at the components of unseen objects; particles are drawn from these and weighted in the same way.

Each scan has random numbers of its own, from the seed and its number: a step is a function of belief and scan.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference import weights
from inference.lmb import LONGEST, STRIDE
from inference.lmb_kernel import survive
from inference.lmb_particles_kernel import update
from inference.object_particles import draw, draw_prior, log_corrections, moments, widen
from inference.refusal import answers_first
from inference.tracking import MEMORY, Facts, require_objects, track
from inference.tracks import Objects, Tracks
from models.multi_object import Bernoullis, Components, HasObjects, Timed, View, joined
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Knobs(NamedTuple):
    """Settings of the approximations.

    num_particles  N of an object
    kernel         h, width of the kernels, in standard deviations of their family
    gate           squared distance from the mean of what particles predict, in variances by coordinate, beyond which a
                   measurement is not of the object
    faint          objects less probable than this are left out
    max_shared     measurements that objects of a group may share for exact association; belief propagation beyond
    """

    num_particles: int = 1000
    kernel: float = 0.4
    gate: float = 25.0
    faint: float = 1e-4
    max_shared: int = 8


class Clouds(NamedTuple):
    """T objects of N particles each at a time [s], None before the first scan.

    label (T,), existence (T,), weight (T, N) summing to one by object, kind (T, N), state (T, N, n), and family (T, N):
    in which component of the newcomers a particle began. past: the latest scans, by time
    """

    time: float | None
    label: Ints
    existence: Floats
    weight: Floats
    kind: Ints
    state: Floats
    family: Ints
    past: tuple[Timed, ...] = ()

    @property
    def offset(self) -> Ints:
        """(T + 1,) where objects begin among all particles."""
        return self.weight.shape[1] * np.arange(len(self.label) + 1)

    def as_components(self, covariance: Floats) -> Bernoullis:
        """Particles as components of covariances (T N, n, n)."""
        size = self.state.shape[2]
        parts = Components(
            self.offset, self.weight.ravel(), self.kind.ravel(), self.state.reshape(-1, size), covariance
        )
        return Bernoullis(self.label, self.existence, parts)

    def only(self, rows: Any) -> Clouds:
        """Some of the objects."""
        return Clouds(self.time, *(value[rows] for value in self[1:-1]))._replace(past=self.past)


def nobody(size: int, num_particles: int) -> Clouds:
    """No objects, at no time."""
    none = np.zeros((0, num_particles))
    label, index = np.zeros(0, dtype=np.int64), none.astype(np.int64)
    return Clouds(None, label, np.zeros(0), none, index, np.zeros((0, num_particles, size)), index)


def predict(
    model: HasObjects, belief: Clouds, seconds: float, number: int, rng: np.random.Generator
) -> tuple[Clouds, Floats]:
    """The objects `seconds` later, with those that arrived at known places, labelled by the scan's `number`, and the
    covariance (T N, n, n) of the motion's noise about them."""
    size, num = belief.state.shape[2], belief.weight.shape[1]
    state, survival, covariance = moved_on(model, belief.kind.ravel(), belief.state.reshape(-1, size), seconds, rng)
    if seconds == 0.0:
        return belief, covariance
    existence, weight = belief.existence.copy(), belief.weight.flatten()
    survive(belief.offset, existence, weight, survival)
    shape = belief.weight.shape
    belief = belief._replace(existence=existence, weight=weight.reshape(shape), state=state.reshape(*shape, size))
    arrived = model.arrivals(seconds)
    if not len(arrived.label):
        return belief, covariance
    label, parts = number * STRIDE + STRIDE // 2 + np.arange(len(arrived.label)), arrived.components
    component = components_of(parts.offset, parts.weight, range(len(label)), num, rng)
    state = draw_prior(component, parts.mean, parts.covariance, rng.standard_normal((len(component), size)))
    fresh = (
        label,
        arrived.existence,
        np.full((len(label), num), 1.0 / num),
        parts.kind[component].reshape(-1, num),
        state.reshape(-1, num, size),
        component.reshape(-1, num) - parts.offset[:-1, None],
    )
    covariance = np.concatenate([covariance, np.zeros((len(component), size, size))])
    label, existence, weight, kind, state, family = map(np.concatenate, zip(belief[1:-1], fresh, strict=True))
    return Clouds(belief.time, label, existence, weight, kind, state, family, belief.past), covariance


def moved_on(
    model: HasObjects, kind: Ints, state: Floats, seconds: float, rng: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    """States (R, n) `seconds` later but for the noise of the last step, of covariance (R, n, n); survival (R,). The
    noise of the steps before it is drawn."""
    num, size = state.shape
    survival, covariance = np.ones(num), np.zeros((num, size, size))
    if seconds == 0.0 or not num:
        return state, survival, covariance
    steps = max(1, math.ceil(seconds / LONGEST - 1e-9))
    for left in range(steps - 1, -1, -1):
        moved = model.move(kind, state, seconds / steps)
        survival, state = survival * moved.survival, moved.mean
        if left:
            state = state + np.einsum("inm,im->in", moved.noise, rng.standard_normal(moved.noise.shape[::2]))
    return state, survival, moved.noise @ moved.noise.swapaxes(1, 2)


def components_of(offset: Ints, weight: Floats, groups: Any, num: int, rng: np.random.Generator) -> Ints:
    """Components for `num` particles of each of some groups, one after the other, as often as their weight says."""
    with np.errstate(divide="ignore"):
        log_weight = np.log(weight)
    parts = [offset[g] + weights.systematic(log_weight[offset[g] : offset[g + 1]], num, rng.random()) for g in groups]
    return np.concatenate([np.zeros(0, dtype=np.int64), *parts])


def regularise(belief: Clouds, covariance: Floats, period: Floats, kernel: float) -> Bernoullis:
    """The particles as components, each the kernel of its family about it and `covariance` (T N, n, n) more."""
    num, size = len(belief.label), belief.state.shape[2]
    if num and kernel > 0.0:
        num_families, weight, state = (
            int(belief.family.max()) + 1,
            belief.weight.ravel(),
            belief.state.reshape(-1, size),
        )
        group = (num_families * np.arange(num)[:, None] + belief.family).ravel()
        mean, V = moments(group, num_families * num, weight, state, period)
        state = state.copy()
        widen(group, mean, V, period, kernel, state, covariance)
        belief = belief._replace(state=state.reshape(belief.state.shape))
    return belief.as_components(covariance)


def meet(
    model: HasObjects,
    scan: Timed,
    objects: Bernoullis,
    parts: Components,
    view: View,
    component: Ints,
    measurement: Ints,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """States (D, n) drawn from components (D,) of `parts` given measurements (D,), and the logs of their weights (D,).
    `view` is of these components; the objects may hide others. Raises FloatingPointError where that makes a NaN."""
    rest = (view.values, view.noise, view.sort, view.period)
    normal = rng.standard_normal((len(component), parts.mean.shape[1]))
    state = draw(component, measurement, parts.mean, parts.covariance, view.predicted, view.slope, *rest, normal)
    seen, detected = look(model, scan, objects, parts.kind[component], state)
    about = (parts.mean, view.predicted, view.slope, view.detection)
    log_weight = log_corrections(state, seen, detected, component, measurement, *about, *rest)
    if np.isnan(state).any() or np.isnan(detected).any() or np.isnan(log_weight).any():
        raise FloatingPointError(f"the update by sensor '{scan.sensor}' at {scan.time} s made a NaN")
    return state, log_weight


def look(model: HasObjects, scan: Timed, objects: Bernoullis, kind: Ints, state: Floats) -> tuple[Floats, Floats]:
    """h (D, d) and p_D (D,) of further states (D, n), which objects may hide, each by its heaviest component."""
    parts, num = objects.components, len(state)
    best = np.array([a + parts.weight[a:b].argmax() for a, b in itertools.pairwise(parts.offset)], dtype=np.int64)
    one = np.arange(len(best) + 1)
    few = Components(one, np.ones(len(best)), parts.kind[best], parts.mean[best], parts.covariance[best])
    flat = np.broadcast_to(np.zeros((state.shape[1], state.shape[1])), (num, state.shape[1], state.shape[1]))
    more = Components(np.array([0, num]), np.full(num, 1.0 / max(num, 1)), kind, state, flat)
    view = model.view(scan, objects._replace(components=few), more)
    return view.predicted[len(best) :], view.detection[len(best) :]


def step(model: HasObjects, belief: Clouds, scan: Timed, number: int, knobs: Knobs, seed: int) -> tuple[Clouds, Facts]:
    """Predict to the scan, and update by it. `number` of the scan, for labels and random numbers. The scan must not be
    older than the belief."""
    rng, num = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,))), knobs.num_particles
    seconds = 0.0 if belief.time is None else scan.time - belief.time
    belief, covariance = predict(model, belief, seconds, number, rng)
    objects, unseen = regularise(belief, covariance, model.period, knobs.kernel), model.unseen(scan, belief.past)
    view, old = model.view(scan, objects, unseen), belief.weight.size
    existence, uniform = objects.existence.copy(), rng.random(len(belief.label))
    component, chosen, first, mass, (log_factor, loopy) = update(
        existence, belief.weight, belief.kind, covariance, uniform, *unseen, *view, knobs.gate, knobs.max_shared
    )
    if not np.isfinite(existence).all() or not math.isfinite(log_factor):
        raise FloatingPointError(f"the update by sensor '{scan.sensor}' at {scan.time} s made a NaN")
    born, kept = np.flatnonzero(first > knobs.faint), existence > knobs.faint
    left_out = existence[~kept].sum() + first[first <= knobs.faint].sum()
    parts = joined(objects.components, unseen)
    fresh = components_of(unseen.offset, mass, born, num, rng)
    whose = np.concatenate([component[kept].ravel(), old + fresh])
    measured = np.concatenate([chosen[kept].ravel(), np.repeat(born, num)])
    state, log_weight = meet(model, scan, objects, parts, view, whose, measured, rng)
    first_of = np.repeat(unseen.offset[:-1], np.diff(unseen.offset))
    family = np.concatenate([belief.family.ravel(), np.arange(len(first_of)) - first_of])
    log_weight = log_weight.reshape(-1, num)
    weight = np.exp(log_weight - log_weight.max(1, keepdims=True))
    posterior = Clouds(
        scan.time,
        np.concatenate([belief.label[kept], number * STRIDE + born]),
        np.concatenate([existence[kept], first[born]]),
        weight / weight.sum(1, keepdims=True),
        parts.kind[whose].reshape(-1, num),
        state.reshape(-1, num, state.shape[1]),
        family[whose].reshape(-1, num),
        (*belief.past[1 - MEMORY :], scan),
    )
    return posterior, Facts(log_factor, int(loopy), float(left_out))


def tell(belief: Clouds, report: float, period: Floats, num_kinds: int) -> Objects:
    """The objects more probable than `report`, by the moments of their particles; angles are circular."""
    told = belief.only(belief.existence > report)
    num, size = len(told.label), told.state.shape[2]
    group = np.repeat(np.arange(num), told.weight.shape[1])
    mean, covariance = moments(group, num, told.weight.ravel(), told.state.reshape(-1, size), period)
    kind = np.bincount(group * num_kinds + told.kind.ravel(), told.weight.ravel(), num * num_kinds)
    share = np.asarray(kind, dtype=np.float64).reshape(num, num_kinds)
    return Objects(told.label, told.existence, mean, covariance, share)


@answers_first
def run(
    model: HasObjects,
    scans: Sequence[Any],
    *,
    seed: int = 0,
    num_particles: int = Knobs().num_particles,
    kernel: float = Knobs().kernel,
    gate: float = Knobs().gate,
    faint: float = Knobs().faint,
    max_shared: int = Knobs().max_shared,
    patience: float = 1.0,
    report: float = 0.01,
    progress: bool = False,
) -> Tracks:
    """What is believed after each scan, in the order in which scans arrive.

    num_particles ... max_shared  see Knobs
    patience                      how old a late scan may be [s]
    report                        objects less probable than this are not told of

    State and covariance of an object are the mean and covariance of its particles. Raises InputError for a model of
    something else than many objects, for a scan that it cannot use, and for settings out of range."""
    require_objects(model, "lmb_particles")
    check_particles(num_particles, kernel)
    knobs, num_kinds = Knobs(num_particles, kernel, gate, faint, max_shared), len(model.kind_names)
    return track(
        model,
        scans,
        nobody(len(model.names), num_particles),
        lambda belief, scan, number: step(model, belief, scan, number, knobs, seed),
        lambda belief: tell(belief, report, model.period, num_kinds),
        patience=patience,
        progress=progress,
    )


def check_particles(num_particles: int, kernel: float) -> None:
    """Raise InputError for settings of particles that are out of range."""
    if num_particles < 2:
        raise InputError(f"num_particles is {num_particles}; give 2 or more")
    if not 0.0 <= kernel < 1.0:
        raise InputError(f"kernel is {kernel}; choose a width in [0, 1), in standard deviations of a cloud")
