"""Levenberg-Marquardt on a compiled sum of squares (models.capability.Squares), for inference.least_squares.

The whitened problem is that of inference.least_squares; here the model hands over the cost with its gradient g and
Gauss-Newton Hessian H in natural units z = loc + scale x, so that

    gradient = x + scale g,   hessian = I + scale H scale

H may be a sum of small blocks: its factor then has their shape, see inference.arrow.

Prior scales may be learnt on the way (empirical Bayes; MacKay 1992, eq. 4.18, with four numbers' worth of trust in the
configured scale s_0): for the numbers of one site, with posterior variances v_i of their whitened values,

    scale^2 = (4 s_0^2 + sum (z_i - loc_i)^2) / (4 + gamma),   gamma = sum (1 - v_i)
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference.arrow import Factor, arrow, colour, factorise, half_log_determinant, solve, squared_norm, variances
from inference.posterior import Posterior, Snapshots
from inference.refusal import accept
from models.capability import HasSquares, Squares
from models.program import InputError

Array = NDArray[np.float64]
TRUST = 4.0  # numbers that the configured scale counts for
WIDEST = 20.0  # learnt scales stay within a fifth and this multiple of the configured ones
STALL = 1.0  # [nats] that a posterior would show
NEAR = 0.1  # [nats] left that are as good as none, where steps run out: models with kinks stall so
LEARNT_AFTER = (2, 4, 7, 11, 16, 22)  # steps: the inverse that learning needs costs as much as several of them


class State(NamedTuple):
    """The problem at x, linearised: total cost, gradient (D,) in x, and Hessian (L, P, P) of the observations alone in
    natural units, block by block."""

    x: Array
    cost: float
    gradient: Array
    hessian: Array

    @property
    def misfit(self) -> float:
        """Cost of the observations alone."""
        return self.cost - 0.5 * float(self.x @ self.x)


class Path(NamedTuple):
    """What a minimisation did: the last state, prior scales (D,), latents by step, whether nothing is left to gain, and
    the factor of the undamped Hessian."""

    state: State
    scale: Array
    visited: list[tuple[float, float, Array]]  # seconds, cost of the observations, z (D,)
    converged: bool
    factor: Factor


def linearise(squares: Squares, scale: Array, x: Array, hessian: Array) -> State:
    """The state at x, its Hessian in `hessian`: matrices made anew cost as much as what they are filled with.

    Raises FloatingPointError where the cost is not finite."""
    gradient = np.empty(len(x))
    z = squares.loc + scale * x
    cost = squares.evaluate(z, hessian[0] if squares.blocks is None else hessian, gradient)
    if not np.isfinite(cost):
        raise FloatingPointError(f"the sum of squares is {cost} at {squares.unpack(z)}")
    return State(x, cost + 0.5 * float(x @ x), x + scale * gradient, hessian)


def minimise(
    squares: Squares,
    x: Array,
    *,
    num_steps: int,
    damping: float,
    tolerance: float,
    learn: tuple[str, ...] = (),
    began: float | None = None,
) -> Path:
    """From x (D,) on; at most num_steps; stop where a step promises less than `tolerance` [nats]. Seconds count from
    `began` on, a reading of time.perf_counter.

    Where steps are refused again and again, damping grows until none promises much: that is converged only if an
    undamped step does not promise more than STALL either. Where steps run out, it must not promise more than NEAR."""
    if charted := [name for name in learn if name in squares.charts]:
        raise InputError(
            f"learn names {', '.join(charted)}, whose numbers have no prior scale of their own; leave it out"
        )
    unknown = [name for name in learn if name not in squares.sites]
    if unknown:
        raise InputError(f"learn names {', '.join(unknown)}, but the latents are {', '.join(squares.sites)}")
    began = time.perf_counter() if began is None else began
    scale, growth, stopped = squares.scale, 2.0, False
    shape = arrow(squares.blocks, len(x))
    own, spare = (np.empty((*shape.slots.shape, shape.slots.shape[1])) for _ in range(2))
    state = linearise(squares, scale, x, own)
    visited = [(time.perf_counter() - began, state.misfit, squares.loc + scale * x)]
    for number in range(num_steps):
        factor = factorise(shape, state.hessian, scale, damping)
        move = -solve(factor, state.gradient)
        # a model's decrease -g.m - m.H m / 2, where (H + damping diag H) m = -g
        promise = 0.5 * float(damping * (factor.diagonal * move) @ move - state.gradient @ move)
        if promise <= tolerance and (not learn or number > LEARNT_AFTER[1]):
            stopped = True
            break
        new = linearise(squares, scale, state.x + move, spare)
        gain = state.cost - new.cost
        if gain > 0:
            damping *= relaxation(gain / max(promise, 1e-12))
            state, spare, growth = new, state.hessian, 2.0
        else:
            damping, growth = damping * growth, 2.0 * growth
        if learn and number in LEARNT_AFTER:  # variances of the step's start: near enough
            state, scale = relearn(squares, state, scale, variances(factor), learn)
        visited.append((time.perf_counter() - began, state.misfit, squares.loc + scale * state.x))
    factor = factorise(shape, state.hessian, scale)
    left = 0.5 * squared_norm(factor, state.gradient)
    converged = left <= max(tolerance, STALL if stopped else NEAR)
    return Path(state, scale, visited, converged, factor)


def relaxation(ratio: float) -> float:
    """Factor on the damping after a step that gained `ratio` of what it promised (Madsen et al. 2004, alg. 3.16)."""
    return max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)


def relearn(
    squares: Squares, state: State, scale: Array, variance: Array, learn: tuple[str, ...]
) -> tuple[State, Array]:
    """The same latents under learnt prior scales: (state, scale (D,)); variance (D,) of x in the posterior."""
    new = scale.copy()
    for name in learn:
        part = squares.sites[name]
        configured = squares.scale[part]
        gamma = float(np.clip(1.0 - variance[part], 0.0, 1.0).sum())
        far = float((((scale[part] * state.x[part]) / configured) ** 2).sum())
        ratio = np.sqrt((TRUST + far) / (TRUST + gamma))
        new[part] = configured * np.clip(ratio, 1.0 / 5.0, WIDEST)
    factor = new / scale
    x = state.x / factor
    flat = state.gradient - state.x  # of the data alone
    cost = state.cost - 0.5 * float(state.x @ state.x) + 0.5 * float(x @ x)
    return State(x, cost, x + factor * flat, state.hessian), new


def run(
    model: HasSquares,
    evidence: Any,
    *,
    seed: int,
    init: dict[str, Any] | None,
    num_steps: int,
    damping: float,
    tolerance: float,
    learn: tuple[str, ...],
    num_draws: int,
) -> Posterior:
    """Minimise, then draw from the Laplace posterior, as inference.least_squares.run does and says."""
    began = time.perf_counter()
    squares = model.squares(evidence)
    accept()
    if init is None and hasattr(model, "start"):
        init = model.start(evidence)
    if init is not None and squares.sites.keys() - init.keys():
        missing = sorted(squares.sites.keys() - init.keys())
        raise InputError(f"init has no value for {missing}; it holds {sorted(init)}")
    x = np.zeros(len(squares.loc)) if init is None else (squares.pack(init) - squares.loc) / squares.scale
    if not np.isfinite(x).all():
        raise InputError(f"init is {init}, which is not finite; give a state that the prior reaches")
    knobs: dict[str, Any] = {"num_steps": num_steps, "damping": damping, "tolerance": tolerance, "learn": learn}
    path = minimise(squares, x, **knobs, began=began)
    noise = np.random.default_rng(np.random.SeedSequence(seed)).standard_normal((num_draws, len(x)))
    numbers = path.state.x + colour(path.factor, noise)
    times, misfits, visited = zip(*path.visited, strict=True)
    states = np.stack(visited)
    priors = 0.5 * np.square((states - squares.loc) / path.scale).sum(1)  # of the last scales: one density for all
    scales = {name: float(path.scale[part][0]) for name, part in squares.sites.items() if name in learn}
    steps, volume = len(states) - 1, 0.5 * len(x) * np.log(2 * np.pi) + squares.log_volume(states)
    flag = f"not converged after {num_steps} steps; raise num_steps or start closer (init)"
    if steps < num_steps:
        left = f"{0.5 * squared_norm(path.factor, path.state.gradient):.2g}"
        flag = f"not converged: no step lowers the cost, though {left} nats are promised; start elsewhere (init)"
    return Posterior(
        draws={n: v[None] for n, v in squares.unpack(squares.loc + path.scale * numbers).items()},
        log_evidence=squares.log_const - path.state.cost - half_log_determinant(path.factor),
        estimate=squares.unpack(states[-1]),
        info={
            "evaluations": len(states),
            "seconds": time.perf_counter() - began,
            "cost": path.state.cost,
            "steps": steps,
            "converged": path.converged,
            "learnt_scales": scales,
            "flags": [] if path.converged else [flag],
        },
        snapshots=Snapshots(
            np.arange(len(states)),
            np.array(times),
            squares.log_const - np.array(misfits) - priors - volume - np.log(path.scale).sum(),
            squares.unpack(states),
        ),
    )
