"""Log weights: normalise, measure, resample."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def normalise(log_weights: Array) -> Array:
    """Weights that sum to one over all entries. Raises FloatingPointError for NaN or all -inf."""
    top = np.max(log_weights)
    if not np.isfinite(top):
        raise FloatingPointError(f"log weights hold no finite maximum (got {top})")
    weights = np.exp(log_weights - top)
    return weights / weights.sum()


def effective_size(log_weights: Array) -> float:
    """Kish's effective sample size, (sum w)^2 / sum w^2."""
    weights = normalise(log_weights)
    return float(1.0 / np.square(weights).sum())


def systematic(log_weights: Array, num: int, uniform: float) -> NDArray[np.int64]:
    """Indices of systematic resampling (Kitagawa 1996): one uniform number, `num` even steps."""
    ladder = np.cumsum(normalise(log_weights).reshape(-1))
    ladder[-1] = 1.0
    return np.searchsorted(ladder, (np.arange(num) + uniform) / num, side="right").clip(max=ladder.size - 1)


def log_sum(log_weights: Array) -> float:
    """log of the sum of the weights, over all entries."""
    top = np.max(log_weights)
    return float(top + np.log(np.exp(log_weights - top).sum()))


def log_mean(log_weights: Array) -> float:
    """log of the mean weight: log evidence where weights are p(x, y) / q(x)."""
    return log_sum(log_weights) - float(np.log(log_weights.size))


def relative_error(log_weights: Array) -> float:
    """Standard error of the mean of independent weights over that mean, so also of its logarithm."""
    return float(np.sqrt(max(1.0 / effective_size(log_weights) - 1.0 / log_weights.size, 0.0)))


def temper(log_weights: Array, size: float, most: float = 1.0) -> float:
    """Largest exponent a <= most at which the weights w^a have an effective size of at least `size`.

    The effective size falls as a grows, so bisection finds it. Where more weights are zero than `size` bears, a is
    next to nothing: enough to weed them out."""
    if effective_size(most * log_weights) >= size:
        return most
    low, high = 0.0, most
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective_size(middle * log_weights) >= size else (low, middle)
    return high


def pareto_k(log_weights: Array) -> float:
    """Shape k of the generalised Pareto tail of the weights; past 0.7 their means cannot be trusted.

    Vehtari et al. (2024), fitted as Zhang and Stephens (2009) do: for the M largest weights above the next one, y_m,

        k(theta) = mean log(1 - theta y_m),   profile likelihood l(theta) = M (log(-theta / k) - k - 1)
        theta^ = the mean of a grid of theta under exp(l),   k^ = (M k(theta^) + 5) / (M + 10)

    Infinity where fewer than five weights are more than nothing beside the largest one; NaN where fewer than five stand
    out from the others."""
    ordered = np.sort(log_weights.reshape(-1))
    ordered = np.exp(ordered - ordered[-1])
    num = int(np.ceil(min(0.2 * len(ordered), 3.0 * np.sqrt(len(ordered)))))
    if num < 5 or num >= len(ordered):
        return float("nan")
    cut = ordered[-num - 1]
    tail = ordered[ordered > cut] - cut
    num = len(tail)
    if num < 5:
        return float("nan" if cut > 0.0 else "inf")
    grid = 30 + int(np.sqrt(num))
    quartile = tail[int(num / 4 + 0.5) - 1]
    theta = 1.0 / tail[-1] + (1.0 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))) / (3.0 * quartile)
    shape = np.log1p(-theta[:, None] * tail).mean(1)
    height = num * (np.log(-theta / shape) - shape - 1.0)
    best = float(np.sum(theta * normalise(height)))
    return float((num * np.log1p(-best * tail).mean() + 5.0) / (num + 10.0))
