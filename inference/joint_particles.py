"""Joint particle filter of few objects: each of N particles is a whole scene, who is there, of which kind and where.

It says what filters of independent objects leave out, such as that either of two is there, but not both. Its model
is inference.lmb's (HasObjects): a measurement may be of an object of the particle, a false alarm (lambda_c), or of an
object that no scan has shown yet (rho). One scan, with particles n of weights W, is an auxiliary particle filter
(Pitt and Shephard 1999) whose look ahead is exact where h is linear and p_D does not depend on the state:

    weigh      with components of the objects as in inference.lmb_particles, and s survival,
               p(Z | n) = prod_j kappa_j sum_theta prod_missed (1 - s p_D) prod_detected s eta(z_theta) / kappa_theta
               over all associations theta, exactly; kappa = lambda_c + rho.   p(Z | past) ~ sum W p(Z | n)
    resample   systematically, where 1 / sum W^2 < ess N with W <- W p(Z | n) / sum
    draw       theta from its exact posterior; of what it leaves over, measurement j begins an object with probability
               rho_j / kappa_j; a missed object is gone with probability (1 - s) / (1 - s p_D); states as in
               inference.lmb_particles, and W <- W w with what the linearisation got wrong

So the estimate of the evidence is unbiased with kernel = 0; kernels trade a little bias for particles that do not die
out. An object's existence is the share of the particles that have it. What hides objects from a sensor is where the
others are by all particles, as in inference.lmb. The number of particles that are needed grows exponentially with that
of objects: it is flagged where there are more than `most`.

The bootstrap filter inference.particle_filter on the program of models.objects.scene is no base for this: it draws
newcomers from all over the region, of which almost none meets a measurement, and its slots are no labels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference import weights
from inference.joint_particles_kernel import associations, weigh
from inference.lmb import STRIDE
from inference.lmb_particles import check_particles, components_of, meet, moved_on
from inference.object_particles import LEAST_MISS, draw_prior, moments, widen
from inference.refusal import answers_first
from inference.tracking import MEMORY, Facts, require_objects, track
from inference.tracks import Objects, Tracks
from models.multi_object import Bernoullis, Components, HasObjects, Timed, joined
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
NUM_SWEEPS = 50  # of the Gibbs sampler, in groups of objects too large for exact draws
FEW = 20.0  # particles that a scan may hang on before it is flagged


class Knobs(NamedTuple):
    """Settings of the approximations.

    num_particles  N
    ess            share of N below which the weights make particles be resampled
    kernel         h, width of the kernels, in standard deviations of an object's particles; 0 for an unbiased evidence
    gate           squared Mahalanobis distance beyond which a measurement is not of an object
    max_shared     measurements that objects of a group may share for exact association; belief propagation beyond
    """

    num_particles: int = 2000
    ess: float = 0.5
    kernel: float = 0.2
    gate: float = 25.0
    max_shared: int = 8


class Scenes(NamedTuple):
    """N particles at a time [s], None before the first scan, with R objects in all.

    log_weight  (N,) log W, summing to one
    label       (R,) rising: who it is
    particle    (R,) whose it is
    kind        (R,)
    state       (R, n)
    family      (R,) in which component of the newcomers it began
    past        the latest scans, by time
    """

    time: float | None
    log_weight: Floats
    label: Ints
    particle: Ints
    kind: Ints
    state: Floats
    family: Ints
    past: tuple[Timed, ...] = ()

    @property
    def weight(self) -> Floats:
        """(R,) W of the particle of each object."""
        return np.asarray(np.exp(self.log_weight)[self.particle])


def predict(
    model: HasObjects, belief: Scenes, seconds: float, number: int, rng: np.random.Generator
) -> tuple[Scenes, Floats, Floats]:
    """The objects `seconds` later, with those that arrived at known places, drawn particle by particle; survival (R,)
    and the covariance (R, n, n) of the motion's noise."""
    state, survival, covariance = moved_on(model, belief.kind, belief.state, seconds, rng)
    belief = belief._replace(state=state)
    if seconds == 0.0 or not len((arrived := model.arrivals(seconds)).label):
        return belief, survival, covariance
    parts, num, size = arrived.components, len(belief.log_weight), state.shape[1]
    which, particle = np.nonzero(rng.random((len(arrived.label), num)) < arrived.existence[:, None])
    component = components_of(parts.offset, parts.weight, range(len(arrived.label)), num, rng).reshape(-1, num)
    component = rng.permuted(component, axis=1)[which, particle]
    fresh = (
        number * STRIDE + STRIDE // 2 + which,
        particle,
        parts.kind[component],
        draw_prior(component, parts.mean, parts.covariance, rng.standard_normal((len(component), size))),
        component - parts.offset[which],
    )
    survival = np.concatenate([survival, np.ones(len(component))])
    covariance = np.concatenate([covariance, np.zeros((len(component), size, size))])
    rows = [*map(np.concatenate, zip(belief[2:-1], fresh, strict=True)), survival, covariance]
    by = np.lexsort((rows[1], rows[0]))  # what a late scan began has higher labels
    label, particle, kind, state, family, survival, covariance = (row[by] for row in rows)
    belief = belief._replace(label=label, particle=particle, kind=kind, state=state, family=family)
    return belief, survival, covariance


def by_label(belief: Scenes, covariance: Floats, period: Floats, kernel: float) -> Bernoullis:
    """The objects as components, by labels, each with its kernel about it and `covariance` more."""
    label, first, group = np.unique(belief.label, return_index=True, return_inverse=True)
    weight, state = belief.weight, belief.state.copy()
    existence = np.asarray(np.bincount(group, weight, len(label)), dtype=np.float64)
    if len(label) and kernel > 0.0:
        num = int(belief.family.max()) + 1
        cloud = num * group + belief.family
        mean, V = moments(cloud, num * len(label), weight, state, period)
        widen(cloud, mean, V, period, kernel, state, covariance)
    offset = np.append(first, len(group))
    share = weight / np.maximum(existence, 1e-300)[group]
    return Bernoullis(label, existence, Components(offset, share, belief.kind, state, covariance))


def step(
    model: HasObjects, belief: Scenes, scan: Timed, number: int, knobs: Knobs, seed: int
) -> tuple[Scenes, Facts, float]:
    """Predict to the scan, and update by it; and what the particles were worth. `number` of the scan, for labels and
    random numbers. The scan must not be older than the belief."""
    rng, num = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,))), knobs.num_particles
    seconds = 0.0 if belief.time is None else scan.time - belief.time
    belief, survival, covariance = predict(model, belief, seconds, number, rng)
    objects, unseen = by_label(belief, covariance, model.period, knobs.kernel), model.unseen(scan, belief.past)
    view, rows = model.view(scan, objects, unseen), len(belief.label)
    order = np.argsort(belief.particle, kind="stable")
    start = np.searchsorted(belief.particle[order], np.arange(num + 1))
    table, log_seen, mass, share, loopy = weigh(
        start, order, belief.kind, survival, covariance, *unseen, *view, knobs.gate, knobs.max_shared
    )
    if not np.isfinite(log_seen).all():
        raise FloatingPointError(f"the update by sensor '{scan.sensor}' at {scan.time} s made a NaN")
    joint = belief.log_weight + log_seen
    log_factor = weights.log_sum(joint)
    log_weight, parent, worth = joint - log_factor, np.arange(num), weights.effective_size(joint)
    if worth < knobs.ess * num:
        parent, log_weight = weights.systematic(joint, num, rng.random()), np.full(num, -math.log(num))
    random = rng.integers(0, 2**64, 1, dtype=np.uint64)
    whose, place, made, new_whose, new_made, new_part = associations(
        start, table, parent, unseen.offset, mass, share, knobs.max_shared, NUM_SWEEPS, random
    )
    old = order[place]
    there, detection = survival[old], view.detection[old]
    stays = there * np.maximum(1.0 - detection, LEAST_MISS) / np.maximum(1.0 - there * detection, LEAST_MISS)
    kept = (made >= 0) | (rng.random(len(old)) < stays)
    parts = joined(objects.components, unseen)
    component = np.concatenate([old[kept], rows + new_part])
    particle, measured = np.concatenate([whose[kept], new_whose]), np.concatenate([made[kept], new_made])
    state, log_corrections = meet(model, scan, objects, parts, view, component, measured, rng)
    log_weight = log_weight + np.bincount(particle, log_corrections, num)
    log_more = weights.log_sum(log_weight)
    label = np.concatenate([belief.label[old[kept]], number * STRIDE + new_made])
    family = np.concatenate([belief.family[old[kept]], new_part - unseen.offset[new_made]])
    by = np.lexsort((particle, label))
    kind = parts.kind[component]
    rows_of = (label[by], particle[by], kind[by], state[by], family[by])
    posterior = Scenes(scan.time, log_weight - log_more, *rows_of, (*belief.past[1 - MEMORY :], scan))
    return posterior, Facts(log_factor + log_more, int(loopy > 0)), worth


def tell(belief: Scenes, report: float, period: Floats, num_kinds: int) -> Objects:
    """The objects more probable than `report`, by the moments of their particles; angles are circular."""
    label, group = np.unique(belief.label, return_inverse=True)
    num, weight = len(label), belief.weight
    existence = np.bincount(group, weight, num)
    mean, covariance = moments(group, num, weight, belief.state, period)
    kind = np.bincount(group * num_kinds + belief.kind, weight, num * num_kinds).reshape(num, num_kinds)
    rows = existence > report
    share = kind[rows] / existence[rows, None]
    return Objects(label[rows], np.minimum(existence[rows], 1.0), mean[rows], covariance[rows], share)


@answers_first
def run(
    model: HasObjects,
    scans: Sequence[Any],
    *,
    seed: int = 0,
    num_particles: int = Knobs().num_particles,
    ess: float = Knobs().ess,
    kernel: float = Knobs().kernel,
    gate: float = Knobs().gate,
    max_shared: int = Knobs().max_shared,
    most: float = 6.0,
    patience: float = 1.0,
    report: float = 0.01,
    progress: bool = False,
) -> Tracks:
    """What is believed after each scan, in the order in which scans arrive.

    num_particles ... max_shared  see Knobs
    most                          objects expected at once, from which on the result is flagged
    patience                      how old a late scan may be [s]
    report                        objects less probable than this are not told of

    State and covariance of an object are the mean and covariance of its particles. info["ess"] is what the particles
    were worth at each update. Raises InputError for a model of something else than many objects, for a scan that it
    cannot use, and for settings out of range."""
    require_objects(model, "joint_particles")
    check_particles(num_particles, kernel)
    if not 0.0 < ess <= 1.0:
        raise InputError(f"ess is {ess}; choose a share in (0, 1]")
    knobs, size = Knobs(num_particles, ess, kernel, gate, max_shared), len(model.names)
    worth, none = list[float](), np.zeros(0, dtype=np.int64)

    def advance(belief: Scenes, scan: Any, number: int) -> tuple[Scenes, Facts]:
        belief, facts, ess = step(model, belief, scan, number, knobs, seed)
        worth.append(ess)
        return belief, facts

    even = np.full(num_particles, -math.log(num_particles))
    tracks = track(
        model,
        scans,
        Scenes(None, even, none, none, none, np.zeros((0, size)), none),
        advance,
        lambda belief: tell(belief, report, model.period, len(model.kind_names)),
        patience=patience,
        progress=progress,
    )
    tracks.info["ess"] = worth
    crowd = tracks.count_mean()
    if crowd.max() > most:
        tracks.info["flags"].append(
            f"{crowd.max():.1f} objects at {tracks.time[crowd.argmax()]:g} s are too many for joint particles, which "
            f"follow {most:g}: choose engine=lmb, or raise num_particles and most"
        )
    if min(worth) < min(FEW, 0.5 * num_particles):
        tracks.info["flags"].append(
            f"the {num_particles} particles were worth {min(worth):.1f} at update {int(np.argmin(worth))}: they may "
            "have lost the truth there; raise num_particles"
        )
    return tracks
