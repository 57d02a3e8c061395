"""Empirical Bayes: settings h of a model from many scenes, by Monte Carlo maximum likelihood (Geyer and Thompson 1992).

    h^ = argmax log p(h) + sum_s log p(y_s | h),     p(y | h) = integral of p(z, y | h) over the latents z

Any engine draws z_1 .. z_n from every scene's posterior under the present h_0. With them

    log p(y | h) - log p(y | h_0) = log E[r] ~ log 1/n sum_i r_i,   r_i = p(z_i, y | h) / p(z_i, y | h_0)

which is a smooth function of h. Its slope at h_0 is Fisher's identity, E[d log p(z, y | h) / dh | y, h_0], and its
curvature is that of the evidence, so that a few rounds suffice. EM maximises the lower bound E[log r] instead, whose
steps are short wherever draws know more of h than the data do. Far from h_0 few draws bear the mean: a step is at most
`TRUST` widths of the prior long, and is halved until the draws of a scene keep half of their effective number. Then
draws are taken anew, until a step promises less than its Monte Carlo error.

Standard errors come from the curvature at h^ by Louis' identity (1982), c = log p(z, y | h) of the draws,

    information = -sum_s (E[c''] + Var[c']) + diag(1 / width^2),   errors = roots of the diagonal of its inverse

They take scenes as independent. The outer product of the scenes' scores estimates the same and needs no second
derivative, but with tens of scenes it was off by half where a scene has many cues; it stands in where the curvature is
not positive definite. The noise of the draws in h^ is reported beside the errors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import logsumexp

from inference import weights
from inference.posterior import Posterior
from inference.progress import Progress
from models.capability import Hyper
from models.program import InputError

Array = NDArray[np.float64]
Engine = Callable[..., Posterior]  # (model, evidence, *, seed)
TRUST = 0.5  # longest step in one number, in widths of the prior
ENOUGH = 0.5  # of the draws must stay effective, on average over the scenes
LEFT = 1e-6  # of the promise of a step, that the search for it may leave
SURE = 2.0  # Monte Carlo errors that a step must promise
DIFFERENCE = 1e-4  # step of first differences, in widths of the prior
BEND = 1e-3  # of second ones
UNTAUGHT = 0.8  # of the prior's width: a standard error past this says that the scenes said little


class Drawn(NamedTuple):
    """n draws of each of S scenes under settings h (H,).

    complete      S functions h -> log p(z, y | h) (n,)
    base          (S, n) their values at h
    size          (S,) how many independent draws they are worth
    log_evidence  (S,) the engine's
    flags         S lists, the engine's
    """

    h: Array
    complete: list[Callable[[Array], Array]]
    base: Array
    size: Array
    log_evidence: Array
    flags: list[list[str]]


class Step(NamedTuple):
    """Where a step leads, what it promises in all [nats], and the Monte Carlo error of that."""

    h: Array
    gain: float
    error: float


class Learnt(NamedTuple):
    """Settings that scenes taught.

    h             (H,) unconstrained
    error         (H,) standard errors
    noise         (H,) standard errors of the Monte Carlo alone
    information   (H, H)
    path          (R + 1, H) from the start on; the last one is h
    log_evidence  (R + 1, S) of the scenes along the path, as the engine estimates it
    flags         what speaks against the numbers, in words
    """

    h: Array
    error: Array
    noise: Array
    information: Array
    path: Array
    log_evidence: Array
    flags: list[str]


def learn(
    hyper: Hyper,
    scenes: Sequence[Any],
    engine: Engine,
    *,
    seed: int,
    num_draws: int = 200,
    num_rounds: int = 15,
    progress: bool = True,
) -> Learnt:
    """The settings under which these scenes are most probable.

    scenes      data, as the model's prepare() reads them; evidence for a model without one
    engine      gives draws and log evidence
    num_draws   of every scene in a round, drawn from those of the engine

    Raises InputError for fewer than two scenes, and for an engine without log evidence."""
    if len(scenes) < 2:
        raise InputError(f"{len(scenes)} scene cannot tell settings from chance; give two scenes or more")
    for name, value, low in (("num_draws", num_draws, 20), ("num_rounds", num_rounds, 1)):
        if value < low:
            raise InputError(f"{name} is {value}; learning needs {low} or more")
    seeds = iter(np.random.SeedSequence(seed).spawn(num_rounds + 1))
    h, settled = hyper.start, False
    path, evidence = [h], []
    with Progress("learning settings", (num_rounds + 1) * len(scenes), progress) as bar:
        for _ in range(num_rounds):
            drawn = draw(hyper, scenes, engine, h, next(seeds), num_draws, bar)
            step = ascend(hyper, drawn)
            h, settled = step.h, step.gain < SURE * step.error
            path.append(h)
            evidence.append(drawn.log_evidence)
            if settled:
                break
        drawn = draw(hyper, scenes, engine, h, next(seeds), num_draws, bar)
    evidence.append(drawn.log_evidence)
    information, scatter, flags = informations(hyper, drawn)
    covariance = np.linalg.inv(information)
    noise = np.sqrt((covariance @ scatter @ covariance).diagonal())
    error = np.sqrt(covariance.diagonal())
    found = Learnt(h, error, noise, information, np.array(path), np.array(evidence), flags)
    return found._replace(flags=flags + _flags(hyper, found, drawn, settled))


def draw(
    hyper: Hyper,
    scenes: Sequence[Any],
    engine: Engine,
    h: Array,
    seeds: np.random.SeedSequence,
    num: int,
    bar: Progress | None = None,
) -> Drawn:
    """`num` draws from the posterior of every scene under h, with a seed of its own."""
    complete, size, log_evidence, flags = [], [], [], []
    for data, child in zip(scenes, seeds.spawn(len(scenes)), strict=True):
        own, again = (int(v) for v in child.generate_state(2))
        posterior = posterior_of(hyper.model(h), data, engine, own)
        complete.append(hyper.complete(data, posterior.resample(num, again)))
        worth = np.inf if posterior.log_weights is None else weights.effective_size(posterior.log_weights)
        size.append(min(worth, float(num)))
        log_evidence.append(posterior.log_evidence)
        flags.append(list(posterior.info.get("flags", [])))
        if bar is not None:
            bar.advance(1)
    base = np.array([f(h) for f in complete])
    if not np.isfinite(base).all():
        scene = int(np.flatnonzero(~np.isfinite(base).all(1))[0])
        raise FloatingPointError(f"the density of the draws of scene {scene} is not finite")
    return Drawn(h, complete, base, np.array(size), np.array(log_evidence, dtype=float), flags)


def posterior_of(model: Any, data: Any, engine: Engine, seed: int) -> Posterior:
    """The engine's posterior of one scene. Raises InputError where it has no log evidence."""
    posterior = engine(model, model.prepare(data) if hasattr(model, "prepare") else data, seed=seed)
    if posterior.log_evidence is None:
        name = posterior.info.get("engine", "this engine")
        raise InputError(f"{name} gives no log evidence, which tells whether learning helps; choose importance or smc")
    return posterior


def log_ratios(drawn: Drawn, h: Array) -> Array:
    """log r (S, n) of every draw."""
    return np.array([f(h) for f in drawn.complete]) - drawn.base


def gains(ratios: Array) -> Array:
    """log p(y_s | h) - log p(y_s | h_0) (S,) of log ratios (S, n)."""
    return np.asarray(logsumexp(ratios, axis=1) - np.log(ratios.shape[1]))


def log_prior(hyper: Hyper, h: Array) -> float:
    """log p(h), but for a constant."""
    return float(-0.5 * np.square((h - hyper.start) / hyper.width).sum())


def ascend(hyper: Hyper, drawn: Drawn) -> Step:
    """One step: the maximum of the ratios within TRUST, then halved until enough draws stay effective."""
    before = log_prior(hyper, drawn.h)

    def promise(step: Array) -> tuple[float, Array]:
        h = drawn.h + step * hyper.width
        ratios = log_ratios(drawn, h)
        return float(gains(ratios).sum()) + log_prior(hyper, h) - before, ratios

    size = len(drawn.h)
    found = minimize(
        lambda step: -promise(step)[0], np.zeros(size), method="L-BFGS-B", bounds=[(-TRUST, TRUST)] * size,
        options={"eps": 1e-6, "ftol": LEFT},
    )  # fmt: skip
    step = found.x
    while True:
        gain, ratios = promise(step)
        spread = np.array([weights.relative_error(row) for row in ratios])
        shares = 1.0 / (1.0 + spread**2 * ratios.shape[1])  # effective size over n
        if shares.mean() >= ENOUGH:
            break
        step = 0.5 * step
    error = float(np.sqrt((spread**2 * ratios.shape[1] / drawn.size).sum()))
    return Step(drawn.h + step * hyper.width, gain, error)


def slope(hyper: Hyper, complete: Callable[[Array], Array], h: Array) -> Array:
    """d log p(z, y | h) / dh (n, H) of one scene's draws, by central differences."""
    steps = DIFFERENCE * np.diag(hyper.width)
    return np.stack([(complete(h + d) - complete(h - d)) / (2.0 * d.sum()) for d in steps], -1)


def bend(hyper: Hyper, complete: Callable[[Array], Array], h: Array, slopes: Array) -> Array:
    """Mean over one scene's draws of d^2 log p(z, y | h) / dh^2 (H, H), by central differences.

    slopes  (n, H) of the draws: numbers without any are skipped"""
    out, steps = np.zeros((len(h), len(h))), BEND * np.diag(hyper.width)
    read = np.flatnonzero(slopes.any(0))
    for i in read:
        for j in read[read <= i]:
            a, b = steps[i], steps[j]
            twice = complete(h + a + b) - complete(h + a - b) - complete(h - a + b) + complete(h - a - b)
            out[i, j] = out[j, i] = twice.mean() / (4.0 * a.sum() * b.sum())
    return out


def informations(hyper: Hyper, drawn: Drawn) -> tuple[Array, Array, list[str]]:
    """At drawn.h the information of scenes and prior (H, H), the covariance of the Monte Carlo noise of the sum of
    scores (H, H), and what speaks against them."""
    prior, size = np.diag(hyper.width**-2.0), len(drawn.h)
    curved, outer, noise = prior.copy(), prior.copy(), np.zeros((size, size))
    for complete, worth in zip(drawn.complete, drawn.size, strict=True):
        slopes = slope(hyper, complete, drawn.h)
        score, spread = slopes.mean(0), np.cov(slopes, rowvar=False, bias=True).reshape(size, size)
        curved -= bend(hyper, complete, drawn.h, slopes) + spread
        outer += np.outer(score, score)
        noise += spread / worth
    if np.linalg.eigvalsh(curved * np.outer(hyper.width, hyper.width))[0] > 0:
        return curved, noise, []
    flag = "the evidence is not curved like a maximum where the search ended: standard errors are those of the scores"
    return outer, noise, [flag]


def _flags(hyper: Hyper, learnt: Learnt, drawn: Drawn, settled: bool) -> list[str]:
    found = []
    if not settled:
        found.append(
            f"the settings still moved after {len(learnt.path) - 1} rounds; raise num_rounds, or begin from these"
        )
    for name, error, noise, width in zip(hyper.names, learnt.error, learnt.noise, hyper.width, strict=True):
        if error > UNTAUGHT * width:
            found.append(f"the scenes say little of '{name}': it stays where its hyper-prior puts it, as configured")
        elif noise > 0.5 * error:
            found.append(f"the draws blur '{name}' by {noise / error:.1f} standard errors; raise num_draws")
    told = [flags for flags in drawn.flags if flags]
    if told:
        found.append(f"the engine warns in {len(told)} of {len(drawn.flags)} scenes, first: {told[0][0]}")
    return found
