"""Coordinates that engines share: a whitened model (models.capability.Factors) as a density of u.

    x = loc + tril u,   log p(u, y) = sum_d [log N(x_d; 0, 1) + log tril_dd] + sum_k f_k(x)

With loc = 0 and tril = I, u are the prior's own standard normal numbers. With the mode x* as loc and
tril tril^T = H^-1, H = I - sum_k f_k''(x*) (Laplace), the posterior of u is close to N(0, I).

H couples two numbers only where a factor reads both. Taken as H = U U^T, U upper triangular, tril = U^-T: numbers that
come late are eliminated first. Where the global latents come first and local ones never meet, U has no fill-in and tril
keeps the local ones apart, so that Rao-Blackwellisation by `depends` stays as sharp in u as it was in x.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import minimize

from inference import squares
from inference.arrow import colour, squared_norm
from models.capability import Factors, HasSquares
from models.program import InputError

Array = NDArray[np.float64]
NUM_STEPS = 200  # of the search for the mode, at most
TOLERANCE = 1e-6  # [nats] that the search may leave
DIFFERENCE = 1e-5  # step of finite differences, in standard deviations of the prior
FLATTEST = 0.05  # least eigenvalue of H (the prior's are 1) that is taken for curvature


class Affine(NamedTuple):
    """x = loc + tril u: loc (D,), tril (D, D) lower triangular with a positive diagonal."""

    loc: Array
    tril: Array

    def forward(self, u: Array) -> Array:
        """(*batch, D) to (*batch, D)."""
        return self.loc + u @ self.tril.T

    def inverse(self, x: Array) -> Array:
        """(D,) to (D,)."""
        return solve_triangular(self.tril, x - self.loc, lower=True)


class Target(NamedTuple):
    """The density of u as a product of K factors of the model and D of the prior.

    depends  (K + D, D) whether a factor may read number u_d
    const    (D,) log tril_dd - log(2 pi) / 2, of the prior's factors

    `share` below multiplies the model's factors: 1 / inflation^2 is noise inflated so many times, 0 the prior."""

    factors: Factors
    affine: Affine
    depends: NDArray[np.bool_]
    const: Array

    @property
    def size(self) -> int:
        """D."""
        return len(self.const)

    def evaluate(self, u: Array, share: float = 1.0) -> Array:
        """u (S, D) to every factor (S, K + D); their sum is log p(u, y)."""
        x = self.affine.forward(u)
        out = np.empty((len(u), len(self.depends)))
        likelihood, prior = out[:, : -self.size], out[:, -self.size :]
        np.multiply(self.factors.evaluate(x), share, out=likelihood)
        np.multiply(x, x, out=prior)
        prior *= -0.5
        prior += self.const
        return out

    def gradient(self, u: Array, share: float = 1.0) -> tuple[Array, Array]:
        """u (S, D) to log p(u, y) (S,) and its gradient (S, D)."""
        x = self.affine.forward(u)
        height, slope = self.factors.gradient(x)
        total = share * height - 0.5 * np.einsum("sd,sd->s", x, x) + self.const.sum()
        return total, (share * slope - x) @ self.affine.tril

    def latents(self, u: Array) -> dict[str, Array]:
        """u (*batch, D) to {site: (*batch, *event)}."""
        return self.factors.latents(self.affine.forward(u))


def standard(size: int) -> Affine:
    """The identity: u are the prior's own numbers."""
    return Affine(np.zeros(size), np.eye(size))


def target_of(factors: Factors, affine: Affine) -> Target:
    """The density of u. A factor that reads x_i reads every u_j with tril_ij != 0."""
    reads = affine.tril != 0.0
    depends = np.concatenate([(factors.depends.astype(float) @ reads) > 0.0, reads])
    return Target(factors, affine, depends, np.log(affine.tril.diagonal()) - 0.5 * math.log(2.0 * math.pi))


class Whitening(NamedTuple):
    """A target, where in u a search begins, what it cost to find, and what speaks against it."""

    target: Target
    start: Array
    evaluations: int
    flags: list[str]


def whitening(
    model: Any, evidence: Any, factors: Factors, transform: Literal["prior", "laplace"], init: dict[str, Any] | None
) -> Whitening:
    """The model in the coordinates that an engine's knob `transform` asks for.

    prior    u = x; a search begins at init, else at the prior's median
    laplace  about the mode found from init, else from model.start(evidence), else from the prior's median

    Raises InputError for another word, and for an init that lacks a site or lies outside the prior's support."""
    if transform not in ("prior", "laplace"):
        raise InputError(f"transform must be prior or laplace, but is '{transform}'")
    size = factors.depends.shape[1]
    if transform == "prior":
        return Whitening(target_of(factors, standard(size)), _numbers(factors, init), 0, [])
    if init is None and hasattr(model, "start"):
        init = model.start(evidence)
    affine, evaluations, flags = laplace(model, evidence, factors, _numbers(factors, init))
    return Whitening(target_of(factors, affine), np.zeros(size), evaluations, flags)


def _numbers(factors: Factors, init: dict[str, Any] | None) -> Array:
    """init in whitened numbers (D,)."""
    if init is None:
        return np.zeros(factors.depends.shape[1])
    if not isinstance(init, Mapping):
        raise InputError(f"init is {init!r}; give a value for each site, {{site: value}}")
    if missing := sorted(factors.sites.keys() - init.keys()):
        raise InputError(f"init has no value for {missing}; it holds {sorted(init)}")
    x = factors.whiten(init)
    for name, part in factors.sites.items():
        if not np.isfinite(x[part]).all():
            raise InputError(f"init of '{name}' is {init[name]}, which its prior does not reach; move it inside")
    return x


def laplace(model: Any, evidence: Any, factors: Factors, x: Array) -> tuple[Affine, int, list[str]]:
    """The mode from x (D,) on and the Cholesky factor of the covariance there: (affine, evaluations, flags).

    A model with squares() is minimised by Levenberg-Marquardt, and H is that of Gauss and Newton; any other by BFGS,
    and H is a finite difference of the gradient, shifted by a multiple of I where it is not positive definite."""
    if isinstance(model, HasSquares):
        problem = model.squares(evidence)
        path = squares.minimise(problem, x, num_steps=NUM_STEPS, damping=1e-3, tolerance=TOLERANCE)
        root = np.linalg.inv(colour(path.factor, np.eye(len(x))))  # F of H = F F^T
        mode, hessian, evaluations, flags = path.state.x, root @ root.T, len(path.visited), list[str]()
        left = 0.5 * squared_norm(path.factor, path.state.gradient)
    else:
        mode, hessian, evaluations, left, flags = _descend(factors, x)
    if left > squares.STALL:
        flags.append(
            f"the mode was not found: {left:.2g} nats are still promised after {evaluations} evaluations; "
            "give an init closer to it"
        )
    coupled = factors.depends.T.astype(float) @ factors.depends > 0.0
    np.fill_diagonal(coupled, True)
    return Affine(mode, _root(np.where(coupled, hessian, 0.0))), evaluations, flags


def _root(hessian: Array) -> Array:
    """tril with tril tril^T = hessian^-1: the upper triangular U of hessian = U U^T, transposed and inverted."""
    upper = np.linalg.cholesky(hessian[::-1, ::-1])[::-1, ::-1]
    return np.tril(solve_triangular(upper, np.eye(len(hessian)), trans="T", lower=False))


def _descend(factors: Factors, x: Array) -> tuple[Array, Array, int, float, list[str]]:
    """Minimise |x|^2 / 2 - sum_k f_k(x): (mode, hessian, evaluations, nats left, flags)."""

    def cost(at: Array) -> tuple[float, Array]:
        height, slope = factors.gradient(at[None])
        if not np.isfinite(height[0]):
            return np.inf, at  # a line search turns round there
        return 0.5 * float(at @ at) - float(height[0]), at - slope[0]

    found = minimize(cost, x, jac=True, method="BFGS", options={"maxiter": NUM_STEPS, "gtol": 1e-6})
    mode, (level, gradient) = found.x, cost(found.x)
    if not np.isfinite(level):
        raise InputError("the density is zero where the search for the mode begins; give an init with data it explains")
    hessian, flags = _hessian(factors, mode)
    move = -np.linalg.solve(hessian, gradient)
    new = cost(mode + move)
    if new[0] < level:  # BFGS stops at its tolerance, a Newton step at rounding
        mode, gradient = mode + move, new[1]
    left = 0.5 * float(gradient @ np.linalg.solve(hessian, gradient))
    return mode, hessian, found.nfev + 2 + 2 * len(x), left, flags


def _hessian(factors: Factors, x: Array) -> tuple[Array, list[str]]:
    """I - f''(x) by central differences of the gradient, made symmetric and positive definite: (hessian, flags)."""
    step = DIFFERENCE * np.eye(len(x))
    _, slopes = factors.gradient(np.concatenate([x + step, x - step]))
    bent = (slopes[: len(x)] - slopes[len(x) :]) / (2.0 * DIFFERENCE)
    hessian = np.eye(len(x)) - 0.5 * (bent + bent.T)
    least = float(np.linalg.eigvalsh(hessian)[0])
    if least > FLATTEST:
        return hessian, []
    flag = (
        f"the Hessian at the mode has an eigenvalue of {least:.2g} in units of the prior's precision, so no Gaussian "
        "fits there; start elsewhere (init) or use transform=prior"
    )
    return hessian + (1.0 - least) * np.eye(len(x)), [flag]
