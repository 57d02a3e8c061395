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
