"""Gaussian guides for one frame of a filter: what the frame says, as far as quadratics can tell.

    log L_k(z) = height + g . (z - z_k) - (z - z_k)' H (z - z_k) / 2

about each mode z_k of the predicted cloud's own Gaussian times p(y | z), H Gauss-Newton's information. A particle that
moves by N(mean, A A'), z = mean + A u, then meets L in closed form, and A may be singular:

    N(u; 0, I) L(mean + A u) = mass N(u; c, M^-1),   M = I + A' H A,   b = A' (g - H (mean - z_k))
    c = M^-1 b,   log mass = log L(mean) + b' M^-1 b / 2 - log |M| / 2
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from inference.weights import normalise
from models.capability import GaussianStep

Array = NDArray[np.float64]
NUM_STATES = 256  # of the cloud, of which the best begin a search for a mode
NUM_STARTS = 8
NUM_STEPS = 30  # of Levenberg and Marquardt, at most
TOLERANCE = 1e-3  # [nats] that the search may leave: a guide need not be exact
APART = 1.0  # standard deviations between two modes, at least
FAINT = 10.0  # [nats] of mass below the heaviest mode: such a one is left to the unguided moves
JITTER = 1e-9  # of the cloud's covariance, for numbers that stand still


class Guide(NamedTuple):
    """L of one frame: at z* (D,), height log p(y | z*), gradient g (D,), information H (D, D)."""

    at: Array
    height: float
    gradient: Array
    information: Array

    def log_density(self, z: Array) -> Array:
        """log L of z (S, D), (S,)."""
        gap = z - self.at
        return np.asarray(
            self.height + gap @ self.gradient - 0.5 * np.einsum("si,ij,sj->s", gap, self.information, gap)
        )


class Ahead(NamedTuple):
    """Where each of N particles is led.

    log_mass  (N,) of p(z | particle) L(z)
    centre    (N, D) mean of u
    tril      (D, D) its Cholesky factor
    """

    log_mass: Array
    centre: Array
    tril: Array


def fit(step: GaussianStep, log_weights: Array, rng: np.random.Generator) -> list[Guide]:
    """The guides of a frame, from particles with log weights (N,) and random states that nothing else uses."""
    share = normalise(log_weights)
    mean = share @ step.mean
    apart = step.mean - mean
    cover = (apart * share[:, None]).T @ apart + step.tril @ step.tril.T
    size = len(mean)
    scale = np.sqrt(np.maximum(cover.diagonal(), JITTER))
    root = scale[:, None] * np.linalg.cholesky(cover / np.outer(scale, scale) + JITTER * np.eye(size))
    x = rng.standard_normal((NUM_STATES, size))
    x[0] = 0.0
    height = step.density(mean + x @ root.T) - 0.5 * np.square(x).sum(1)
    whole = GaussianStep(mean[None], root, step.density, step.slopes, step.state)  # the cloud as one wide particle
    found, mass = list[Guide](), list[float]()
    for start in x[np.argsort(-height)[:NUM_STARTS]]:
        guide = climb(whole, start)
        tril = np.linalg.inv(look_ahead(guide, whole).tril.T)  # of the precision of x
        gaps = (np.linalg.solve(root, guide.at - other.at) for other in found)
        if all(np.square(gap @ tril).sum() > APART**2 for gap in gaps):
            found.append(guide)
            mass.append(float(look_ahead(guide, whole).log_mass[0]))
    return [guide for guide, m in zip(found, mass, strict=True) if m > max(mass) - FAINT]


def climb(whole: GaussianStep, x: Array) -> Guide:
    """The guide at a maximum of log p(y | mean + root x) - |x|^2 / 2, from x on."""
    mean, root = whole.mean[0], whole.tril
    at, damping = mean + root @ x, 1e-3
    height, gradient, information = whole.slopes(at)
    for _ in range(NUM_STEPS):
        slope, curved = root.T @ gradient - x, root.T @ information @ root
        curved.ravel()[:: len(x) + 1] += 1.0
        move = np.linalg.solve(curved + damping * np.diag(curved.diagonal()), slope)
        if 0.5 * slope @ move < TOLERANCE:
            break
        new = whole.slopes(mean + root @ (x + move))
        if new[0] - 0.5 * np.square(x + move).sum() > height - 0.5 * np.square(x).sum():
            x, damping = x + move, 0.2 * damping
            at, (height, gradient, information) = mean + root @ x, new
        else:
            damping = 5.0 * max(damping, 1e-3)
    return Guide(at, height, gradient, information)


def look_ahead(guide: Guide, step: GaussianStep) -> Ahead:
    """Mass, centre and spread of every particle's move under the guide."""
    A, gap = step.tril, step.mean - guide.at
    pull = (guide.gradient - gap @ guide.information) @ A  # b, (N, D)
    root = np.linalg.cholesky(np.eye(len(A)) + A.T @ guide.information @ A)
    half = solve_triangular(root, pull.T, lower=True)  # (D, N)
    log_mass = guide.log_density(step.mean) + 0.5 * np.square(half).sum(0) - np.log(root.diagonal()).sum()
    back = solve_triangular(root, np.eye(len(A)), lower=True).T  # upper: M^-1 = back back'
    return Ahead(log_mass, (back @ half).T, back)
