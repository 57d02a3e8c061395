"""Levenberg-Marquardt on a compiled sum of squares (models.capability.Squares), for inference.least_squares.

The whitened problem is that of inference.least_squares; here the model hands over the cost with its gradient g and
Gauss-Newton Hessian H in natural units z = loc + scale x, so that

    gradient = x + scale g,   hessian = I + scale H scale

Prior scales may be learnt on the way (empirical Bayes; MacKay 1992, eq. 4.18, with four numbers' worth of trust in the
configured scale s_0): for the numbers of one site, with posterior variances v_i of their whitened values,

    scale^2 = (4 s_0^2 + sum (z_i - loc_i)^2) / (4 + gamma),   gamma = sum (1 - v_i)
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from inference.posterior import Posterior, Snapshots
from models.capability import HasSquares, Squares
from models.program import InputError

Array = NDArray[np.float64]
TRUST = 4.0  # numbers that the configured scale counts for
WIDEST = 20.0  # learnt scales stay within a fifth and this multiple of the configured ones
STALL = 1.0  # [nats] that a posterior would show
LEARNT_AFTER = (2, 4, 7, 11, 16, 22)  # steps: the inverse that learning needs costs as much as several of them


class State(NamedTuple):
    """The problem at x, linearised: total cost, gradient (D,) and hessian (D, D) in x."""

    x: Array
    cost: float
    gradient: Array
    hessian: Array


class Path(NamedTuple):
    """What a minimisation did: the last state, prior scales (D,), latents by step, whether nothing is left to gain."""

    state: State
    scale: Array
    visited: list[tuple[float, float, Array]]  # seconds, cost, z (D,)
    converged: bool


def linearise(squares: Squares, scale: Array, x: Array, hessian: Array) -> State:
    """The state at x, its Hessian in `hessian`: matrices made anew cost as much as what they are filled with.

    Raises FloatingPointError where the cost is not finite."""
    gradient = np.empty(len(x))
    cost = squares.evaluate(squares.loc + scale * x, hessian, gradient)
    if not np.isfinite(cost):
        raise FloatingPointError(f"the sum of squares is {cost} at {squares.unpack(squares.loc + scale * x)}")
    hessian *= scale
    hessian *= scale[:, None]
    hessian.ravel()[:: len(x) + 1] += 1.0
    return State(x, cost + 0.5 * float(x @ x), x + scale * gradient, hessian)


def minimise(
    squares: Squares, x: Array, *, num_steps: int, damping: float, tolerance: float, learn: tuple[str, ...] = ()
) -> Path:
    """From x (D,) on; at most num_steps; stop where a step promises less than `tolerance` [nats].

    Where steps are refused again and again, damping grows until none promises much: that is converged only if an
    undamped step does not promise more than STALL either."""
    unknown = [name for name in learn if name not in squares.sites]
    if unknown:
        raise InputError(f"learn names {', '.join(unknown)}, but the latents are {', '.join(squares.sites)}")
    began, scale, growth, converged = time.perf_counter(), squares.scale, 2.0, False
    own, spare, damped = (np.empty((len(x), len(x))) for _ in range(3))
    state = linearise(squares, scale, x, own)
    visited = [(time.perf_counter() - began, state.cost, squares.loc + scale * x)]
    for number in range(num_steps):
        damped[:] = state.hessian
        damped.ravel()[:: len(x) + 1] *= 1.0 + damping
        factor, failed = dpotrf(damped.T, lower=1, overwrite_a=1)  # LAPACK reads the transpose, which is the same
        if failed:
            raise FloatingPointError(f"the Hessian has no Cholesky factor (dpotrf says {failed}): it is not finite")
        move = -dpotrs(factor, state.gradient, lower=1)[0]
        promise = float(-state.gradient @ move - 0.5 * move @ state.hessian @ move)
        if promise <= tolerance and (not learn or number > LEARNT_AFTER[1]):
            converged = undamped_promise(state) <= max(tolerance, STALL)
            break
        new = linearise(squares, scale, state.x + move, spare)
        gain = state.cost - new.cost
        if gain > 0:
            damping *= relaxation(gain / max(promise, 1e-12))
            state, spare, growth = new, state.hessian, 2.0
        else:
            damping, growth = damping * growth, 2.0 * growth
        if learn and number in LEARNT_AFTER:
            variance = np.diag(dpotri(factor, lower=1, overwrite_c=1)[0])  # of the step's start: near enough
            state, scale = relearn(squares, state, scale, variance, learn)
        visited.append((time.perf_counter() - began, state.cost, squares.loc + scale * state.x))
    return Path(state, scale, visited, converged)


def relaxation(ratio: float) -> float:
    """Factor on the damping after a step that gained `ratio` of what it promised (Madsen et al. 2004, alg. 3.16)."""
    return max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)


def undamped_promise(state: State) -> float:
    """Decrease of the cost [nats] that an undamped step would bring to a linear problem."""
    factor, _ = dpotrf(state.hessian, lower=1)
    return 0.5 * float(state.gradient @ dpotrs(factor, state.gradient, lower=1)[0])


def relearn(
    squares: Squares, state: State, scale: Array, variance: Array, learn: tuple[str, ...]
) -> tuple[State, Array]:
    """The same latents under learnt prior scales: (state, scale (D,)); variance (D,) of x in the posterior.

    The Hessian is changed where it is."""
    new = scale.copy()
    for name in learn:
        part = squares.sites[name]
        configured = squares.scale[part]
        gamma = float(np.clip(1.0 - variance[part], 0.0, 1.0).sum())
        spread = float((((scale[part] * state.x[part]) / configured) ** 2).sum())
        ratio = np.sqrt((TRUST + spread) / (TRUST + gamma))
        new[part] = configured * np.clip(ratio, 1.0 / 5.0, WIDEST)
    factor = new / scale
    x = state.x / factor
    flat, hessian = state.gradient - state.x, state.hessian  # flat: of the data alone
    diagonal = hessian.ravel()[:: len(x) + 1]
    diagonal -= 1.0
    hessian *= factor
    hessian *= factor[:, None]
    diagonal += 1.0
    cost = state.cost - 0.5 * float(state.x @ state.x) + 0.5 * float(x @ x)
    return State(x, cost, x + factor * flat, hessian), new


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
    if init is None and hasattr(model, "start"):
        init = model.start(evidence)
    if init is not None and squares.sites.keys() - init.keys():
        missing = sorted(squares.sites.keys() - init.keys())
        raise InputError(f"init has no value for {missing}; it holds {sorted(init)}")
    x = np.zeros(len(squares.loc)) if init is None else (squares.pack(init) - squares.loc) / squares.scale
    path = minimise(squares, x, num_steps=num_steps, damping=damping, tolerance=tolerance, learn=learn)
    factor = np.linalg.cholesky(path.state.hessian)
    noise = np.random.default_rng(np.random.SeedSequence(seed)).standard_normal((len(x), num_draws))
    numbers = path.state.x[:, None] + solve_triangular(factor, noise, trans="T", lower=True)
    times, costs, states = zip(*path.visited, strict=True)
    scales = {name: float(path.scale[part][0]) for name, part in squares.sites.items() if name in learn}
    steps, volume = len(states) - 1, 0.5 * len(x) * np.log(2 * np.pi) + squares.log_volume
    flag = f"not converged after {num_steps} steps; raise num_steps or start closer (init)"
    if steps < num_steps:
        left = f"{undamped_promise(path.state):.2g}"
        flag = f"not converged: no step lowers the cost, though {left} nats are promised; start elsewhere (init)"
    return Posterior(
        draws={n: v[None] for n, v in squares.unpack(squares.loc + path.scale * numbers.T).items()},
        log_evidence=squares.log_const - path.state.cost - float(np.log(factor.diagonal()).sum()),
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
            squares.log_const - np.array(costs) - volume - np.log(path.scale).sum(),
            squares.unpack(np.stack(states)),
        ),
    )
