"""Nonlinear least squares with a Laplace posterior.

In the whitened numbers x of a model (models.whitening.Bound) with residuals r(x) of its observations,

    cost(x) = |x|^2 / 2 + |r(x)|^2 / 2 = -log p(x, y) + const
    g = x + J^T r,   H = I + J^T J,   J = dr/dx                       Gauss-Newton
    (H + damping diag H) step = -g                                    Marquardt (1963)

The damping follows the gain ratio of each step (Madsen, Nielsen, Tingleff 2004, algorithm 3.16;
Nocedal & Wright 2006, section 10.3). Continuation divides r by falling inflations, as if the noise
were larger, and starts each problem where the last one ended. At the minimum x*

    p(x | y) ~ N(x*, H^-1),   log p(y) ~ log p(x*, y) + D/2 log 2 pi - log|H| / 2
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.func import jacfwd, jacrev

from inference import squares
from inference.posterior import Posterior, Snapshots
from inference.refusal import accept, answers_first
from models.capability import HasSquares
from models.program import InputError, Latents, Model, log_joint, terms
from models.whitening import Bound, bind

ROUNDING = float(np.finfo(np.float64).eps)
MAX_DAMPING = 1e12  # past it a step is lost in rounding


class State(NamedTuple):
    """The problem linearised at x.

    x         (D,) whitened latents
    residual  (M,) of the observations, over the inflation
    jacobian  (M, D)
    factor    (D, D) upper R of [I; J] = Q R: R^T R = H without squaring the condition number
    damping   of the next step
    growth    factor on the damping should the next step fail
    """

    x: Tensor
    residual: Tensor
    jacobian: Tensor
    factor: Tensor
    damping: float
    growth: float = 2.0

    @property
    def cost(self) -> float:
        return _cost(self.x, self.residual)

    @property
    def gradient(self) -> Tensor:
        return self.x + self.jacobian.T @ self.residual

    @property
    def newton(self) -> Tensor:
        """The undamped step."""
        return -torch.cholesky_solve(self.gradient[:, None], self.factor, upper=True)[:, 0]

    @property
    def promise(self) -> float:
        """Decrease of the cost [nats] that the undamped step would bring to a linear problem."""
        return -0.5 * float(self.gradient @ self.newton)


def linearise(bound: Bound, x: Tensor, *, damping: float = 1e-3, inflation: float = 1.0) -> State:
    """The state at x. Raises FloatingPointError where residuals or their derivatives are not
    finite, with the site's name."""
    residual = bound.residuals(x)[1] / inflation
    if not bool(torch.isfinite(residual).all()):
        raise FloatingPointError(_blame_value(bound, x))
    differentiate = jacfwd if len(x) <= len(residual) else jacrev
    jacobian = differentiate(lambda at: bound.residuals(at)[1])(x) / inflation
    if not bool(torch.isfinite(jacobian).all()):
        raise FloatingPointError(_blame_derivative(bound, jacobian))
    stacked = torch.cat([torch.eye(len(x), dtype=torch.float64), jacobian])
    return State(x, residual, jacobian, torch.linalg.qr(stacked, mode="r").R, damping)


def step(bound: Bound, state: State, *, inflation: float = 1.0) -> tuple[State, bool]:
    """One damped step, taken where it lowers the cost: (state, accepted)."""
    gradient, hessian = state.gradient, state.factor.T @ state.factor
    factor, failed = torch.linalg.cholesky_ex(hessian + state.damping * torch.diag(hessian.diagonal()))
    move = -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
    x = state.x + move
    gain = state.cost - _cost(x, bound.residuals(x)[1] / inflation)
    if bool(failed) or not gain > 0:  # a gain that is NaN is refused here too
        return state._replace(damping=state.damping * state.growth, growth=2.0 * state.growth), False
    ratio = gain / float(-gradient @ move - 0.5 * move @ hessian @ move)
    damping = state.damping * squares.relaxation(ratio)
    return linearise(bound, x, damping=damping, inflation=inflation), True


@answers_first
def run(
    model: Model,
    evidence: Any,
    *,
    seed: int,
    init: Latents | None = None,
    num_steps: int = 50,
    damping: float = 1e-3,
    tolerance: float = 1e-10,
    continuation: Sequence[float] = (1.0,),
    learn: Sequence[str] = (),
    num_draws: int = 1000,
) -> Posterior:
    """Minimise, then draw from the Laplace posterior: one chain of independent draws.

    A model with squares() is minimised in machine code (inference.squares), any other through its program.

    init          {site: (*event)} natural latents; None takes model.start(evidence) where the model
                  has it, else the prior median x = 0
    num_steps     at most, for each inflation
    damping       first damping, relative to diag H
    tolerance     stop where an undamped step promises a smaller decrease of the cost [nats]
    continuation  falling inflations of the observation noise, the last one 1; of programs only
    learn         sites whose prior scale is learnt from the data (empirical Bayes); of models with squares() only

    Raises InputError by name for observations that are not Gaussian or whose scale depends on
    latents, for an init outside the prior's support, and for knobs that this model's way has not."""
    begin = time.perf_counter()
    _check_continuation(continuation)
    if num_draws < 1:
        raise InputError(f"num_draws is {num_draws}; least squares needs 1 or more")
    if init is not None and not isinstance(init, Mapping):
        raise InputError(f"init is {init!r}; give a value for each site, {{site: value}}")
    if isinstance(model, HasSquares):
        if len(continuation) > 1:
            raise InputError("continuation is not for models with squares(); leave it at [1.0]")
        knobs: dict[str, Any] = {"num_steps": num_steps, "damping": damping, "tolerance": tolerance}
        return squares.run(model, evidence, seed=seed, init=init, learn=tuple(learn), num_draws=num_draws, **knobs)
    if learn:
        raise InputError(f"learn needs a model with squares(), but {type(model).__name__} has none; leave it empty")
    bound = bind(model, evidence)
    bound.check_residuals()
    accept()
    path = [(0, 0.0, _first(bound, init))]
    tried = 0
    for inflation in continuation:
        state = linearise(bound, path[-1][-1], damping=damping, inflation=inflation)
        last = tried + num_steps
        while tried < last and not _is_minimum(state, tolerance) and state.damping < MAX_DAMPING:
            state, accepted = step(bound, state, inflation=inflation)
            tried += 1
            if accepted:
                path.append((tried, time.perf_counter() - begin, state.x))
    converged = _is_minimum(state, tolerance)
    if converged:  # the undamped step is known by now, and exact where the model is linear
        state = linearise(bound, state.x + state.newton)
        path.append((tried, time.perf_counter() - begin, state.x))
    draws = _laplace_draws(bound, state, num_draws, seed)
    return Posterior(
        draws={name: value[None] for name, value in _arrays(bound, draws).items()},
        log_evidence=_laplace_evidence(bound, state),
        estimate={name: value.numpy() for name, value in bound.latents(state.x).items()},
        info={
            "evaluations": tried + len(continuation) + converged,
            "seconds": time.perf_counter() - begin,
            "cost": state.cost,
            "steps": tried,
            "converged": converged,
            "flags": _flags(state, converged, num_steps),
        },
        snapshots=_snapshots(bound, path),
    )


def _cost(x: Tensor, residual: Tensor) -> float:
    return 0.5 * float(x @ x + residual @ residual)


def _is_minimum(state: State, tolerance: float) -> bool:
    """Nothing left to gain, or nothing that rounding would show."""
    return state.promise <= max(tolerance, ROUNDING * state.cost)


def _check_continuation(continuation: Sequence[float]) -> None:
    falling = all(a > b for a, b in pairwise(continuation))
    if not continuation or not falling or continuation[-1] != 1.0:
        raise InputError(
            f"continuation must hold falling inflations of the noise that end in 1, but it is {list(continuation)}"
        )


def _first(bound: Bound, init: Latents | None) -> Tensor:
    """Whitened start."""
    if init is None and hasattr(bound.model, "start"):
        init = bound.model.start(bound.evidence)
    if init is None:
        return torch.zeros(bound.size, dtype=torch.float64)
    missing = bound.shapes.keys() - init.keys()
    if missing:
        raise InputError(f"init has no value for {sorted(missing)}; it holds {sorted(init)}")
    x = bound.whiten({name: torch.as_tensor(init[name], dtype=torch.float64) for name in bound.shapes})
    for name, numbers in _by_site(bound, x):
        if not bool(torch.isfinite(numbers).all()):
            raise InputError(f"init of '{name}' is {init[name]}, which its prior does not reach; move it inside")
    return x


def _laplace_draws(bound: Bound, state: State, num_draws: int, seed: int) -> Latents:
    """T(x* + R^-1 e) with e standard normal, {site: (num_draws, *event)}."""
    generator = np.random.default_rng(np.random.SeedSequence(seed))
    noise = torch.from_numpy(generator.standard_normal((bound.size, num_draws)))
    return bound.latents(state.x + torch.linalg.solve_triangular(state.factor, noise, upper=True).T)


def _laplace_evidence(bound: Bound, state: State) -> float:
    log_det = 2.0 * float(state.factor.diagonal().abs().log().sum())
    return float(bound.log_density(state.x)) + 0.5 * bound.size * math.log(2.0 * math.pi) - 0.5 * log_det


def _flags(state: State, converged: bool, num_steps: int) -> list[str]:
    flags = []
    if not converged and state.damping >= MAX_DAMPING:
        flags.append(
            f"not converged: no step lowers the cost of {state.cost:.6g}, though {state.promise:.2g} nats are "
            "promised; the residuals are not smooth there: start elsewhere (init) or use continuation"
        )
    elif not converged:
        flags.append(
            f"not converged: {state.promise:.2g} nats are still to be gained after {num_steps} steps; "
            "raise num_steps or start closer (init)"
        )
    sharpest = float(state.factor.diagonal().abs().max())
    if sharpest * ROUNDING > 1e-4:
        flags.append(
            f"the Hessian is singular to rounding: the data fix one direction {sharpest:.1g} times better than the "
            "prior does, which leaves no digits for the others; raise the noise or tighten the prior"
        )
    return flags


def _snapshots(bound: Bound, path: list[tuple[int, float, Tensor]]) -> Snapshots:
    steps, seconds, xs = zip(*path, strict=True)
    states = bound.latents(torch.stack(xs))
    heights = log_joint(bound.model, states, bound.evidence)
    return Snapshots(np.array(steps), np.array(seconds), heights.numpy(), _arrays(bound, states))


def _arrays(bound: Bound, batch: Latents) -> dict[str, np.ndarray]:
    """{site: (N, *event)} without the dimensions that plates put between."""
    return {name: value.reshape(-1, *bound.shapes[name]).numpy() for name, value in batch.items()}


def _by_site(bound: Bound, x: Tensor) -> list[tuple[str, Tensor]]:
    """Split the last dimension, D, by site."""
    sizes = [shape.numel() for shape in bound.shapes.values()]
    return list(zip(bound.shapes, x.split(sizes, -1), strict=True))


def _blame_value(bound: Bound, x: Tensor) -> str:
    latents = bound.latents(x)
    split = terms(bound.model, latents, bound.evidence)  # names a site that is NaN itself
    fixed = {name: height for name, height in split.prior.items() if name not in bound.shapes}
    heights = split.likelihood | fixed
    sites = [name for name, height in heights.items() if not bool(torch.isfinite(height).all())]
    values = {name: value.tolist() for name, value in latents.items()}
    return f"the residuals of {sites} are not finite at {values}"


def _blame_derivative(bound: Bound, jacobian: Tensor) -> str:
    sites = [name for name, columns in _by_site(bound, jacobian) if not bool(torch.isfinite(columns).all())]
    return f"the residuals have no finite derivative with respect to {sites}"
