"""Unbiased estimates of the gradient of the ELBO of a Gaussian q.

    ELBO = E_q[log p(u, y) - log q(u)],   u = mean + sd e + lower e,   e ~ N(0, I)

Score function (Ranganath, Gerrish, Blei 2014). With h_d the score of a parameter of q_d, only the factors that read u_d
matter to it (Rao-Blackwellisation), and a multiple of the score is free to take off (control variate):

    gradient_d = E_q[h_d (F_d - a_d)],   F_d = sum_{k reads d} f_k(u) - log q_d(u_d),   a_d = E[h_d^2 F_d] / E[h_d^2]

    h = e / sd for the mean, e^2 - 1 for log sd

Here a_d is taken from the other samples, one sample left out at a time, so that it biases nothing. (The paper takes it
from the same samples, with a bias of order 1 / S.)

Overdispersed (Ruiz, Titsias, Blei 2016): e_b ~ N(0, tau_b) for one block b of numbers at a time, the others from q,

    gradient_d = E[w_d h_d (F_d - a_d)],   w_d = prod_j N(e_j; 0, 1) / N(e_j; 0, tau_b)

over the numbers j of the block that F_d reads: the weights of the others average to one. tau is worth its variance:

    d log V / d log tau = -E[y^2 sum_j (e_j^2 / tau - 1) / 2] / E[y^2],   y = w h (F - a)

Reparameterised, without the score of q, so that the variance vanishes where q = p (Roeder, Wu, Duvenaud 2017): with
g = d/du [log p - log q] at u(e),

    gradient = E[g] for the mean, E[g e sd] for log sd, E[g e^T] for lower

Samples are rows: noise (S, D). `share` tempers the likelihood (inference.transform.Target).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference.transform import Target

Array = NDArray[np.float64]
HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
TINY = 1e-300  # lets 0 / 0 be 0
EVERY = slice(None)


class Gaussian(NamedTuple):
    """q(u): mean (D,), log_sd (D,), and lower (D, D) below the diagonal, None for a mean field."""

    mean: Array
    log_sd: Array
    lower: Array | None = None

    def draw(self, noise: Array) -> Array:
        """u (S, D) from noise (S, D)."""
        u = noise * np.exp(self.log_sd)
        u += self.mean
        return u if self.lower is None else u + noise @ self.lower.T

    def log_density(self, noise: Array) -> Array:
        """log q (S,) at what `draw` makes of the noise."""
        return -0.5 * np.einsum("sd,sd->s", noise, noise) - self.log_sd.sum() - noise.shape[1] * HALF_LOG_2PI


class Reading(NamedTuple):
    """Which parts of the ELBO matter to which numbers.

    factors  (K + D, D) 1 where a factor of the target does
    own      whether of log q only that of the number itself does
    coupled  (D, D) whether F_d reads u_j
    """

    factors: Array
    own: bool
    coupled: NDArray[np.bool_]


class Block(NamedTuple):
    """Numbers that are drawn from a wider q together: rows of the samples, columns of u (a slice where they are
    neighbours), and where F reads several of them: coupled (n, n)."""

    rows: slice
    columns: Any
    coupled: Array


def reading(target: Target, rao_blackwell: bool) -> Reading:
    """Without Rao-Blackwellisation everything matters to every number."""
    depends = target.depends if rao_blackwell else np.ones_like(target.depends)
    factors = depends.astype(float)
    return Reading(factors, rao_blackwell, factors.T @ factors > 0.0)


def signal(values: Array, noise: Array, log_sd: Array, reads: Reading, columns: Any = EVERY) -> Array:
    """F (S, n) of some columns of u from the factors of the target (S, K + D) and noise (S, D)."""
    own = columns if reads.own else EVERY
    e = noise[:, own]
    surprise = e * e
    surprise *= 0.5
    surprise += log_sd[own] + HALF_LOG_2PI  # -log q_d
    if not reads.own:
        surprise = surprise.sum(1, keepdims=True)
    return values @ reads.factors[:, columns] + surprise


def terms(strength: Array, noise: Array, weight: Array | None, control_variates: bool) -> Array:
    """y (S, 2, n), whose means are the gradient by mean / sd and by log sd; strength F, noise and weight w (S, n)."""
    h = np.empty((len(noise), 2, noise.shape[1]))
    h[:, 0] = noise
    np.multiply(noise, noise, out=h[:, 1])
    h[:, 1] -= 1.0
    if weight is not None:
        h *= weight[:, None]
    y = h * strength[:, None]
    if control_variates:
        square, product = h * h, y * h
        np.subtract(product.sum(0), product, out=product)
        np.subtract(square.sum(0), square, out=square)
        product /= square + TINY
        product *= h
        y -= product
    return y


def score(target: Target, q: Gaussian, noise: Array, share: float, reads: Reading, control_variates: bool) -> Array:
    """Gradient by (mean, log sd), (2 D,)."""
    values = target.evaluate(q.draw(noise), share)
    gradient = terms(signal(values, noise, q.log_sd, reads), noise, None, control_variates).sum(0) / len(noise)
    gradient[0] /= np.exp(q.log_sd)
    return gradient.reshape(-1)


def blocks(sites: dict[str, slice], reads: Reading, num_samples: int) -> list[Block]:
    """Sites in groups whose members never meet in an F, each with an equal share of the samples.

    Numbers of one site stay together: to split them would leave few samples for each."""
    coupled = reads.coupled
    groups: list[list[slice]] = []
    for part in sites.values():
        free = (g for g in groups if not any(coupled[part, other].any() for other in g))
        group = next(free, None)
        if group is None:
            groups.append([part])
        else:
            group.append(part)
    ends = [round(num_samples * i / len(groups)) for i in range(len(groups) + 1)]
    plan = []
    for first, last, group in zip(ends[:-1], ends[1:], groups, strict=True):
        columns: Any = np.concatenate([np.arange(part.start, part.stop) for part in group])
        meet = coupled[np.ix_(columns, columns)].astype(float)
        if (np.diff(columns) == 1).all():
            columns = slice(int(columns[0]), int(columns[-1]) + 1)  # views are quicker
        plan.append(Block(slice(first, last), columns, meet))
    return plan


def overdispersed(
    target: Target,
    q: Gaussian,
    noise: Array,
    share: float,
    reads: Reading,
    control_variates: bool,
    plan: list[Block],
    tau: Array,
) -> tuple[Array, Array]:
    """Gradient by (mean, log sd) (2 D,), and d log variance / d log tau (len(plan),), the mean over a block's numbers.

    noise is standard normal; tau (len(plan),) variances of the blocks."""
    wide = noise.copy()
    for block, factor in zip(plan, np.sqrt(tau), strict=True):
        wide[block.rows, block.columns] *= factor
    values = target.evaluate(q.draw(wide), share)
    gradient, slopes = np.empty((2, target.size)), np.empty(len(plan))
    for i, (rows, columns, coupled) in enumerate(plan):
        strength = signal(values[rows], wide[rows], q.log_sd, reads, columns)
        square = np.square(noise[rows, columns])
        log_weight = (0.5 * (math.log(tau[i]) - (tau[i] - 1.0) * square)) @ coupled
        y = terms(strength, wide[rows, columns], np.exp(log_weight), control_variates)  # (S, 2, n)
        gradient[:, columns] = y.sum(0) / len(y)
        y *= y
        power = y.sum(0) + TINY
        y *= (0.5 * ((square - 1.0) @ coupled))[:, None]
        slopes[i] = -np.mean(y.sum(0) / power)
    gradient[0] /= np.exp(q.log_sd)
    return gradient.reshape(-1), slopes


def reparameterised(target: Target, q: Gaussian, noise: Array, share: float) -> Array:
    """Gradient by (mean, log sd), and by the strictly lower triangle (row by row) where q is of full rank."""
    sd = np.exp(q.log_sd)
    _, slope = target.gradient(q.draw(noise), share)
    if q.lower is None:
        slope = slope + noise / sd
        return np.concatenate([slope.mean(0), sd * (slope * noise).mean(0)])
    slope = slope + noise @ np.linalg.inv(q.lower + np.diag(sd))
    outer = slope.T @ noise / len(noise)
    return np.concatenate([slope.mean(0), sd * outer.diagonal(), outer[np.tril_indices(target.size, -1)]])
