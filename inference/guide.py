"""A Gaussian guide for one frame of a filter: what the frame says, as far as a quadratic can tell.

    log L(z) = height + g . (z - z*) - (z - z*)' H (z - z*) / 2

about the mode z* of the predicted cloud's own Gaussian times p(y | z), H Gauss-Newton's information. A particle that
moves by N(mean, A A'), z = mean + A u, then meets L in closed form, and A may be singular:

    N(u; 0, I) L(mean + A u) = mass N(u; c, M^-1),   M = I + A' H A,   b = A' (g - H (mean - z*))
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
NUM_STARTS = 256  # states of the cloud that the search for the mode begins at the best of
NUM_STEPS = 30  # of Levenberg and Marquardt, at most
TOLERANCE = 1e-3  # [nats] that the search may leave: a guide need not be exact
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


def fit(step: GaussianStep, log_weights: Array, rng: np.random.Generator) -> Guide:
    """The guide of a frame, from particles with log weights (N,) and random states that nothing else uses."""
    share = normalise(log_weights)
    mean = share @ step.mean
    apart = step.mean - mean
    cover = (apart * share[:, None]).T @ apart + step.tril @ step.tril.T
    size = len(mean)
    scale = np.sqrt(np.maximum(cover.diagonal(), JITTER))
    root = scale[:, None] * np.linalg.cholesky(cover / np.outer(scale, scale) + JITTER * np.eye(size))
    x = rng.standard_normal((NUM_STARTS, size))
    x[0] = 0.0
    best = x[np.argmax(step.density(mean + x @ root.T) - 0.5 * np.square(x).sum(1))]
    return _climb(step, mean, root, best)


def _climb(step: GaussianStep, mean: Array, root: Array, x: Array) -> Guide:
    """Maximise log p(y | mean + root x) - |x|^2 / 2."""
    at, damping = mean + root @ x, 1e-3
    height, gradient, information = step.slopes(at)
    for _ in range(NUM_STEPS):
        slope, whole = root.T @ gradient - x, root.T @ information @ root
        whole.ravel()[:: len(x) + 1] += 1.0
        move = np.linalg.solve(whole + damping * np.diag(whole.diagonal()), slope)
        if 0.5 * slope @ move < TOLERANCE:
            break
        new = step.slopes(mean + root @ (x + move))
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
