"""Labeled multi-Bernoulli filter with particles (Reuter, Vo, Vo and Dietmayer 2014, sequential Monte Carlo version).

What is believed is what inference.lmb believes, with the density of each object as N weighted particles (k_i, x_i) for
kinds and states instead of a mixture of Gaussians: nothing is linearised, and an object may be anywhere.

predict   r <- r sum w_i s(x_i),   w_i <- w_i s(x_i) / sum,   x_i <- f(x_i) + L(x_i) e
update    with eta_ti(z) = p_D(x_i) N(z; h(x_i), R) l(z | k_i) and the marginals beta of the associations, whose weights
          are prod_missed (1 - r sum_i w_i p_D(x_i)) prod_detected r sum_i w_i eta_ti(z) / kappa(z),
              r w_i <- beta_t0 r w_i (1 - p_D(x_i)) / (1 - r sum w p_D) + sum_j beta_tj w_i eta_ti(z_j) / sum_i w_i eta_ti
birth     z_j begins an object with r = (1 - sum_t beta_tj) rho_j / kappa_j; rho_j is that of inference.lmb, h linearised
          at the components of unseen objects. Particles are drawn from these components given z_j and weighted by what
          the linearisation got wrong (inference.object_particles): in its shape nothing of it is left but their number.
resample  an object whose 1 / sum w_i^2 is below `ess` N is resampled before the next scan, and its particles are spread
          by a kernel, each kind's about its own mean. Without it a few copies remain of a cloud that an accurate sensor
          hits, and the filter believes them too much.

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
from inference.object_particles import draw, log_corrections, moments, spread
from inference.tracking import Facts, require_objects, track
from inference.tracks import Objects, Tracks
from models.multi_object import Bernoullis, Components, HasObjects, Timed, View
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
NOTHING = (np.zeros((0, 0)), np.zeros((0, 0, 0)), np.zeros((0, 0)), np.zeros((0, 0, 0)), np.zeros(0, dtype=np.int64))


class Knobs(NamedTuple):
    """Settings of the approximations.

    num_particles  N of an object
    ess            share of N below which the weights make an object be resampled
    kernel         h, width of the kernel that spreads copies, in standard deviations of their cloud
    gate           squared distance from the mean of what particles predict, in variances by coordinate, beyond which a
                   measurement is not of the object
    faint          objects less probable than this are left out
    max_shared     measurements that objects of a group may share for exact association; belief propagation beyond
    """

    num_particles: int = 1000
    ess: float = 0.5
    kernel: float = 0.2
    gate: float = 25.0
    faint: float = 1e-4
    max_shared: int = 8


class Belief(NamedTuple):
    """T objects of N particles each at a time [s], None before the first scan.

    label (T,), existence (T,), weight (T, N) summing to one by object, kind (T, N), state (T, N, n), and family (T, N):
    in which component of the newcomers a particle began
    """

    time: float | None
    label: Ints
    existence: Floats
    weight: Floats
    kind: Ints
    state: Floats
    family: Ints

    @property
    def offset(self) -> Ints:
        """(T + 1,) where objects begin among all particles."""
        return self.weight.shape[1] * np.arange(len(self.label) + 1)

    def as_components(self) -> Bernoullis:
        """Particles as components without extent."""
        size = self.state.shape[2]
        flat = np.broadcast_to(np.zeros((size, size)), (self.weight.size, size, size))
        parts = Components(self.offset, self.weight.ravel(), self.kind.ravel(), self.state.reshape(-1, size), flat)
        return Bernoullis(self.label, self.existence, parts)

    def only(self, rows: Any) -> Belief:
        """Some of the objects."""
        return Belief(self.time, *(value[rows] for value in self[1:]))


def nobody(size: int, num_particles: int) -> Belief:
    """No objects, at no time."""
    none = np.zeros((0, num_particles))
    label, index = np.zeros(0, dtype=np.int64), none.astype(np.int64)
    return Belief(None, label, np.zeros(0), none, index, np.zeros((0, num_particles, size)), index)


def together(a: Belief, b: Belief) -> Belief:
    """The objects of both, at the time of the first."""
    return Belief(a.time, *(np.concatenate(pair) for pair in zip(a[1:], b[1:], strict=True)))


def predict(model: HasObjects, belief: Belief, seconds: float, number: int, rng: np.random.Generator) -> Belief:
    """The objects `seconds` later, with those that arrived at known places, labelled by the scan's `number`."""
    size, num = belief.state.shape[2], belief.weight.shape[1]
    steps = max(1, math.ceil(seconds / LONGEST - 1e-9))
    if len(belief.label):
        existence, weight, state = belief.existence.copy(), belief.weight.ravel(), belief.state.reshape(-1, size)
        weight = weight.copy()
        for _ in range(steps):
            moved = model.move(belief.kind.ravel(), state, seconds / steps)
            survive(belief.offset, existence, weight, moved.survival)
            state = moved.mean + np.einsum("inm,im->in", moved.noise, rng.standard_normal(moved.noise.shape[::2]))
        shape = belief.weight.shape
        belief = belief._replace(existence=existence, weight=weight.reshape(shape), state=state.reshape(*shape, size))
    arrived = model.arrivals(seconds)
    if not len(arrived.label):
        return belief
    label, parts = number * STRIDE + STRIDE // 2 + np.arange(len(arrived.label)), arrived.components
    component = components_of(parts.offset, parts.weight, range(len(label)), num, rng)
    missed = np.full(len(component), -1)
    normal = rng.standard_normal((len(component), size))
    state = draw(component, missed, parts.mean, parts.covariance, *NOTHING, np.zeros(0), normal)
    even = np.full((len(label), num), 1.0 / num)
    kind, state, component = (part.reshape(-1, num, *part.shape[1:]) for part in (parts.kind[component], state, component))
    family = component - parts.offset[:-1, None]
    return together(belief, Belief(belief.time, label, arrived.existence, even, kind, state, family))


def components_of(offset: Ints, weight: Floats, groups: Any, num: int, rng: np.random.Generator) -> Ints:
    """Components for `num` particles of each of some groups, one group after the other, as often as their weight says."""
    with np.errstate(divide="ignore"):
        log_weight = np.log(weight)
    parts = [
        offset[g] + weights.systematic(log_weight[offset[g] : offset[g + 1]], num, rng.random()) for g in groups
    ]
    return np.concatenate(parts)


def refresh(belief: Belief, period: Floats, knobs: Knobs, rng: np.random.Generator) -> Belief:
    """Resample the objects whose particles are worth too few, and spread the copies, each family about its own mean."""
    num, size = belief.state.shape[1:]
    rows = np.flatnonzero(np.square(belief.weight).sum(1) * knobs.ess * num > 1.0)
    if not len(rows):
        return belief
    poor, num_families = belief.only(rows), int(belief.family.max()) + 1
    weight, state = poor.weight.ravel(), poor.state.reshape(-1, size)
    group = (num_families * np.arange(len(rows))[:, None] + poor.family).ravel()
    mean, covariance = moments(group, num_families * len(rows), weight, state, period)
    index = components_of(poor.offset, weight, range(len(rows)), num, rng)
    state = state[index]
    spread(group[index], mean, covariance, state, period, knobs.kernel, rng.standard_normal(state.shape))
    whole = Belief(belief.time, *(value.copy() for value in belief[1:]))
    whole.weight[rows], whole.state[rows] = 1.0 / num, state.reshape(-1, num, size)
    whole.kind[rows] = poor.kind.ravel()[index].reshape(-1, num)
    whole.family[rows] = poor.family.ravel()[index].reshape(-1, num)
    return whole


def begin(
    model: HasObjects,
    scan: Timed,
    objects: Bernoullis,
    unseen: Components,
    view: View,
    mass: Floats,
    born: Ints,
    num: int,
    rng: np.random.Generator,
) -> tuple[Floats, Ints, Floats, Ints]:
    """Weights and kinds (B, N), states (B, N, n) and families (B, N) of what measurements born (B,) show first, by the masses of the
    components of unseen objects. `view` is of the particles of the objects and of these components."""
    size, first = unseen.mean.shape[1], len(objects.components.weight)
    component = components_of(unseen.offset, mass, born, num, rng)
    measurement, of_unseen = np.repeat(born, num), (part[first:] for part in view[:3])
    predicted, slope, detection = of_unseen
    rest = (view.values, view.noise, view.sort, view.period)
    normal = rng.standard_normal((len(component), size))
    state = draw(component, measurement, unseen.mean, unseen.covariance, predicted, slope, *rest, normal)
    kind = unseen.kind[component]
    seen, detected = look(model, scan, objects, kind, state)
    log_weight = log_corrections(
        state, seen, detected, component, measurement, unseen.mean, predicted, slope, detection, *rest
    ).reshape(-1, num)
    weight = np.exp(log_weight - log_weight.max(1, keepdims=True))
    family = component.reshape(-1, num) - unseen.offset[born, None]
    return weight / weight.sum(1, keepdims=True), kind.reshape(-1, num), state.reshape(-1, num, size), family


def look(model: HasObjects, scan: Timed, objects: Bernoullis, kind: Ints, state: Floats) -> tuple[Floats, Floats]:
    """h (D, d) and p_D (D,) of further states (D, n), which objects may hide, each by its heaviest component."""
    parts, num = objects.components, len(state)
    best = np.array([a + parts.weight[a:b].argmax() for a, b in itertools.pairwise(parts.offset)], dtype=np.int64)
    few = Components(np.arange(len(best) + 1), np.ones(len(best)), *(part[best] for part in parts[2:]))
    flat = np.broadcast_to(np.zeros((state.shape[1], state.shape[1])), (num, state.shape[1], state.shape[1]))
    more = Components(np.array([0, num]), np.full(num, 1.0 / num), kind, state, flat)
    view = model.view(scan, objects._replace(components=few), more)
    return view.predicted[len(best) :], view.detection[len(best) :]


def step(
    model: HasObjects, belief: Belief, scan: Timed, number: int, knobs: Knobs, seed: int
) -> tuple[Belief, Facts]:
    """Resample, predict to the scan, and update by it. `number` of the scan, for labels and random numbers. The scan
    must not be older than the belief."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
    seconds = 0.0 if belief.time is None else scan.time - belief.time
    belief = refresh(belief, model.period, knobs, rng)._replace(time=scan.time)
    if seconds > 0.0:
        belief = predict(model, belief, seconds, number, rng)
    objects, unseen = belief.as_components(), model.unseen(scan)
    view = model.view(scan, objects, unseen)
    existence, weight = belief.existence.copy(), belief.weight.copy()
    first, mass, (log_factor, loopy) = update(
        existence, weight, belief.kind, *unseen, *view, knobs.gate, knobs.max_shared
    )
    if not np.isfinite(existence).all() or not np.isfinite(weight).all() or not math.isfinite(log_factor):
        raise FloatingPointError(f"the update by sensor '{scan.sensor}' at {scan.time} s made a NaN")
    born, kept = np.flatnonzero(first > knobs.faint), existence > knobs.faint
    left_out = existence[~kept].sum() + first[first <= knobs.faint].sum()
    posterior = belief._replace(existence=existence, weight=weight).only(kept)
    if len(born):
        parts = begin(model, scan, objects, unseen, view, mass, born, knobs.num_particles, rng)
        posterior = together(posterior, Belief(scan.time, number * STRIDE + born, first[born], *parts))
    return posterior, Facts(log_factor, int(loopy), float(left_out))


def tell(belief: Belief, report: float, period: Floats, num_kinds: int) -> Objects:
    """The objects more probable than `report`, by the moments of their particles; angles are circular."""
    told = belief.only(belief.existence > report)
    num, size = len(told.label), told.state.shape[2]
    group = np.repeat(np.arange(num), told.weight.shape[1])
    mean, covariance = moments(group, num, told.weight.ravel(), told.state.reshape(-1, size), period)
    kind = np.bincount(group * num_kinds + told.kind.ravel(), told.weight.ravel(), num * num_kinds)
    return Objects(told.label, told.existence, mean, covariance, kind.reshape(num, num_kinds))


def run(
    model: HasObjects,
    scans: Sequence[Any],
    *,
    seed: int = 0,
    num_particles: int = Knobs().num_particles,
    ess: float = Knobs().ess,
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
    check_particles(num_particles, ess, kernel)
    knobs, num_kinds = Knobs(num_particles, ess, kernel, gate, faint, max_shared), len(model.kind_names)
    return track(
        model,
        scans,
        nobody(len(model.names), num_particles),
        lambda belief, scan, number: step(model, belief, scan, number, knobs, seed),
        lambda belief: tell(belief, report, model.period, num_kinds),
        patience=patience,
        progress=progress,
    )


def check_particles(num_particles: int, ess: float, kernel: float) -> None:
    """Raise InputError for settings of particles that are out of range."""
    if num_particles < 2:
        raise InputError(f"num_particles is {num_particles}; give 2 or more")
    if not 0.0 < ess <= 1.0:
        raise InputError(f"ess is {ess}; choose a share in (0, 1]")
    if not 0.0 <= kernel < 1.0:
        raise InputError(f"kernel is {kernel}; choose a width in [0, 1), in standard deviations of a cloud")
