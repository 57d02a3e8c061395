"""Particle filter: a sequential model frame by frame (Gordon, Salmond and Smith 1993; Doucet and Johansen 2009).

N particles with weights W (summing to one) stand for p(z_(t-1) | y_0, ..., y_(t-1)). A frame y_t moves them on:

bootstrap   resample where 1 / sum W^2 < ess N, move by the model, and weigh:
                z ~ p(z_t | z_(t-1)),   w = p(y_t | z),   p(y_t | past) ~ sum W w,   W <- W w / sum W w

guided      in many dimensions only particles survive that were led to where the frame is. With L(z) = sum_k L_k(z),
            Gaussian guides about the modes of the frame (inference.guide), m_kn = int p(z | particle n) L_k(z) dz and
            m = sum W_n m_kn, draw particle and move together from
                q(n, z) = W_n p(z | particle n) r(z),   r(z) = (1 - d) L(z) / m + d
            by systematic resampling of the parts, guides and none by particles, and weigh with what L got wrong:
                w = p(y_t | z) / r(z),   p(y_t | past) ~ mean w,   W <- w / sum w
            It is the auxiliary particle filter (Pitt and Shephard 1999), fully adapted to L. The share d of unguided
            moves bounds the weights: p(y_t | z) / d, whatever the guides missed.

Both estimates of p(y), the product over frames, are unbiased. Their error is read from families, the shares s_i of the
last particles' weight that descend from each first particle: log p(y) has the standard error sqrt(sum s_i^2 - 1 / N),
as in inference.smc. Long after families have merged into one it says no more than that the error is not known.

Draws are of the filtering marginals, each frame given the frames up to it: draw n of one frame and draw n of the next
are no path. `estimate` is one: the most probable path among the last particles.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from inference import weights
from inference.guide import fit, look_ahead
from inference.posterior import Posterior, Snapshots
from inference.progress import Progress
from inference.refusal import accept, answers_first
from models.capability import HasGaussianSteps, HasSteps, State
from models.program import (
    InputError,
    Site,
    num_plate_dims,
    quiet_doubles,
    sample_sites,
    site_log_prob,
    sum_plates,
)

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
FEW = 20.0  # particles that a frame may hang on before it is flagged


class Cloud(NamedTuple):
    """N particles after a frame.

    state          {name: (N, *event)}
    log_weights    (N,) log W
    parent         (N,) of the frame before; 0 at the first
    height         (N,) log joint density of the path that ends here
    log_factor     estimate of log p(y_t | past)
    num_parents    how many particles of the frame before they descend from in effect
    """

    state: State
    log_weights: Array
    parent: Ints
    height: Array
    log_factor: float
    num_parents: float

    @property
    def ess(self) -> float:
        """What the weights are worth, in particles."""
        return weights.effective_size(self.log_weights)

    @property
    def best(self) -> int:
        """The end of the most probable path."""
        return int(self.height.argmax())


def bootstrap_step(
    model: HasSteps, cloud: Cloud | None, frame: Any, *, num: int, ess: float, rng: np.random.Generator
) -> Cloud:
    """One frame by the model's own moves; of N = num particles where there is no cloud yet."""
    log_weights, parent, before = np.full(num, -math.log(num)), np.zeros(num, dtype=np.int64), np.zeros(num)
    if cloud is not None:
        parent, log_weights = np.arange(num), cloud.log_weights
        if cloud.ess < ess * num:
            parent = weights.systematic(log_weights, num, rng.random())
            log_weights = np.full(num, -math.log(num))
        before = cloud.height[parent]
        past = _choose(cloud.state, parent)
        move: Callable[[Any], State] = lambda frame: model.transition(past, frame)  # noqa: E731
    else:
        move = model.initial
    state, log_move = _draw(move, frame, num, rng)
    log_seen = _seen(model, state, frame, num)
    joint = log_weights + log_seen
    log_factor = weights.log_mean(joint) + math.log(num)
    found = joint - log_factor
    return Cloud(state, found, parent, before + log_move + log_seen, log_factor, _effective(parent, cloud, num))


def guided_step(
    model: HasGaussianSteps, cloud: Cloud | None, frame: Any, *, num: int, defence: float, rng: np.random.Generator
) -> Cloud:
    """One frame by moves that the frame guides; of `num` particles where there is no cloud yet."""
    old = np.zeros(1) if cloud is None else cloud.log_weights
    before = np.zeros(1) if cloud is None else cloud.height
    step = model.gaussian_step(None if cloud is None else cloud.state, frame)
    guides = fit(step, old, rng)
    aheads = [look_ahead(guide, step) for guide in guides]
    mass = np.stack([old + ahead.log_mass for ahead in aheads])  # (K, N)
    with np.errstate(divide="ignore"):
        log_guided, log_free = math.log1p(-defence) - weights.log_sum(mass), np.log(defence)
    part = weights.systematic(np.concatenate([*(mass + log_guided), old + log_free]), num, rng.random())
    kind, parent = np.divmod(part, len(old))
    noise = rng.standard_normal((num, len(step.tril)))
    u = noise.copy()
    for k, ahead in enumerate(aheads):
        u[kind == k] = ahead.centre[parent[kind == k]] + noise[kind == k] @ ahead.tril.T
    z = step.mean[parent] + u @ step.tril.T
    log_seen = step.density(z)
    log_guides = np.logaddexp.reduce([guide.log_density(z) for guide in guides])
    log_weights = log_seen - np.logaddexp(log_guided + log_guides, log_free)
    log_factor = weights.log_mean(log_weights)
    moving = step.tril.diagonal()[step.tril.diagonal() > 0.0]
    const = 0.5 * len(moving) * math.log(2.0 * math.pi) + np.log(moving).sum()
    log_move = -0.5 * np.square(u).sum(1) - const
    height = before[parent] + log_move + log_seen
    found = log_weights - log_factor - math.log(num)
    return Cloud(step.state(z), found, parent, height, log_factor, _effective(parent, cloud, num))


@answers_first
def run(
    model: Any,
    evidence: Sequence[Any],
    *,
    seed: int,
    num_particles: int = 1000,
    proposal: Literal["auto", "guided", "bootstrap"] = "auto",
    ess: float = 0.5,
    defence: float = 0.1,
    progress: bool = False,
) -> Posterior:
    """Draws {site: (1, num_particles, frame, *event)} of equal weight from p(z_t | y_0, ..., y_t) for every frame t of
    the evidence, and the log evidence of all frames.

    proposal  "bootstrap", or "guided" for a model with gaussian_step(); "auto" is guided where it can be
    ess       share of the particles below which the weights of bootstrap particles make them be resampled
    defence   share d of unguided moves among the guided ones

    info holds, by frame, `ess` and `parents` (particles that the weights, and the frame before, are worth). Snapshots
    are the ends of the most probable paths so far, with the log joint of these paths.

    Raises InputError by name for a model without the parts of a sequential one, and for evidence without frames."""
    began = time.perf_counter()
    guided = _is_guided(model, proposal)
    _check(evidence, num_particles, ess, defence)
    accept()
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    clouds, times = list[Cloud](), list[float]()
    families = np.arange(num_particles)
    with Progress("filtering", len(evidence), progress) as bar:
        for frame in evidence:
            last = clouds[-1] if clouds else None
            if guided:
                cloud = guided_step(model, last, frame, num=num_particles, defence=defence, rng=rng)
            else:
                cloud = bootstrap_step(model, last, frame, num=num_particles, ess=ess, rng=rng)
            families = families[cloud.parent] if clouds else families
            clouds.append(cloud)
            times.append(time.perf_counter() - began)
            bar.advance(1)
    log_evidence = sum(cloud.log_factor for cloud in clouds)
    shares = np.bincount(families, np.exp(clouds[-1].log_weights))
    worth = [cloud.ess for cloud in clouds]
    parents = [cloud.num_parents for cloud in clouds]
    draws = [_even(cloud, rng) for cloud in clouds]
    tops = [{n: v[cloud.best].numpy() for n, v in cloud.state.items()} for cloud in clouds]
    return Posterior(
        draws={n: np.stack([d[n].numpy() for d in draws], 1)[None] for n in draws[0]},
        log_evidence=log_evidence,
        estimate=_path(clouds),
        info={
            "engine": "particle_filter",
            "proposal": "guided" if guided else "bootstrap",
            "seconds": times[-1],
            "evaluations": num_particles * len(clouds),
            "ess": worth,
            "parents": parents,
            "families": float(1.0 / np.square(shares).sum()),
            "log_evidence_error": math.sqrt(max(float(np.square(shares).sum()) - 1.0 / num_particles, 0.0)),
            "flags": _flags(worth, parents, num_particles),
        },
        snapshots=Snapshots(
            np.arange(1, len(clouds) + 1),
            np.array(times),
            np.array([cloud.height.max() for cloud in clouds]),
            {n: np.stack([top[n] for top in tops]) for n in tops[0]},
        ),
    )


def _is_guided(model: Any, proposal: str) -> bool:
    """Whether the moves are guided; raises InputError where the model cannot be run at all."""
    name = type(model).__name__
    if proposal not in ("auto", "guided", "bootstrap"):
        raise InputError(f"proposal must be one of auto, guided, bootstrap, but is '{proposal}'")
    if missing := [part for part in ("initial", "transition", "observe") if not hasattr(model, part)]:
        raise InputError(
            f"the particle filter needs a sequential model, but {name} has no {', '.join(missing)}; "
            "use engine=smc for a model of one frame"
        )
    if proposal == "guided" and not isinstance(model, HasGaussianSteps):
        raise InputError(f"proposal=guided needs gaussian_step(), but {name} has none; use proposal=bootstrap")
    return proposal == "guided" or (proposal == "auto" and isinstance(model, HasGaussianSteps))


def _check(evidence: Sequence[Any], num_particles: int, ess: float, defence: float) -> None:
    if len(evidence) == 0:
        raise InputError("the particle filter needs at least one frame, but the evidence has none")
    if num_particles < 2:
        raise InputError(f"num_particles is {num_particles}; the particle filter needs 2 or more")
    if not 0.0 < ess <= 1.0:
        raise InputError(f"ess is {ess}; choose a share in (0, 1]")
    if not 0.0 <= defence < 1.0:
        raise InputError(f"defence is {defence}; choose a share in [0, 1)")


def _choose(state: State, index: Ints) -> State:
    """Particles index (N,) of a state."""
    rows = torch.from_numpy(index)
    return {name: value[rows] for name, value in state.items()}


def _even(cloud: Cloud, rng: np.random.Generator) -> State:
    """As many draws of equal weight, in no order: that of resampling puts the children of a particle side by side."""
    index = weights.systematic(cloud.log_weights, len(cloud.log_weights), rng.random())
    return _choose(cloud.state, rng.permutation(index))


def _draw(move: Callable[[Any], State], frame: Any, num: int, rng: np.random.Generator) -> tuple[State, Array]:
    """States {name: (N, *event)} drawn by a program fragment, and the log density of what it drew (N,)."""
    import pyro

    found = list[State]()

    def keep(frame: Any) -> None:
        found.append(move(frame))

    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(2**63)))
        plates = num_plate_dims(sample_sites(keep, frame))
        with pyro.plate("_particles", num, dim=-1 - plates):
            sites = sample_sites(keep, frame)
    return found[-1], _log_density(sites, plates, num)


def _seen(model: HasSteps, state: State, frame: Any, num: int) -> Array:
    """log p(frame | state), (N,)."""
    with quiet_doubles():
        sites = sample_sites(lambda frame: model.observe(state, frame), frame)
    if hidden := [name for name, site in sites.items() if not site["is_observed"]]:
        raise InputError(f"frame has no value for {hidden}, which observe() of the model reads; give one")
    return _log_density(sites, num_plate_dims(sites), num)


def _log_density(sites: dict[str, Site], plates: int, num: int) -> Array:
    parts = [sum_plates(site_log_prob(name, site), plates) for name, site in sites.items()]
    return np.asarray(sum(parts, start=torch.zeros(num, dtype=torch.float64)).numpy())


def _effective(parent: Ints, cloud: Cloud | None, num: int) -> float:
    """Parents of N particles in effect; as many as there are at the first frame."""
    return float(num if cloud is None else num**2 / np.square(np.bincount(parent)).sum())


def _path(clouds: list[Cloud]) -> dict[str, NDArray[Any]]:
    """The most probable path among those of the last particles, {site: (frame, *event)}."""
    index, states = clouds[-1].best, list[dict[str, NDArray[Any]]]()
    for cloud in reversed(clouds):
        states.insert(0, {n: v[index].numpy() for n, v in cloud.state.items()})
        index = int(cloud.parent[index])
    return {n: np.stack([state[n] for state in states]) for n in states[0]}


def _flags(worth: list[float], parents: list[float], num: int) -> list[str]:
    """The frame where the particles thinned out most, if it is too much."""
    limit, found = min(FEW, 0.5 * num), list[str]()
    for what, sizes in (("are worth", worth), ("descend from", parents)):
        if min(sizes) < limit:
            frame = int(np.argmin(sizes))
            found.append(
                f"the {num} particles of frame {frame} {what} {sizes[frame]:.1f} in effect: the filter may have lost "
                "the truth there; raise num_particles, or use a model with gaussian_step()"
            )
    return found
