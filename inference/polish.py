"""Greedy search over structures: try every edit, refit the rest by Gauss-Newton, keep what is better.

Not MCMC: it climbs to a mode of p(z | y) near a chain's best state. An edit costs a few refits, so that a
sweep over all edits is far cheaper than the random steps that would find one of them."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.capability import Kernel, kernel_types, pointer
from models.overwrite import overwrite

REFITS = 12  # Gauss-Newton steps after an edit, at most
PATIENCE = 2  # refits after which an edit must be close to the best
SWEEPS = 6  # rounds over all edits, at most
HOPELESS = 100.0  # nats below the best after the first refit: give the edit up
CLOSE = 25.0  # nats
SETTLED = 0.02  # nats gained by a refit
WORTH = 0.5  # nats that make another round worthwhile


def _climb(edit, refit, evaluate, commit, num_edits, z, floats, ints, cache, score):  # type: ignore[no-untyped-def]
    """Improve z in place; score (1,) its log joint."""
    trial, best, out = z.copy(), z.copy(), np.zeros(2)
    evaluate(z, floats, ints, cache, out)
    commit(cache)
    score[0] = out[0] + out[1]
    index, idle = -1, 0  # first refit the state itself, then go round the edits until none of them helps
    for _ in range(SWEEPS * num_edits):
        if index < 0 or edit(index, z, floats, trial):
            top = -np.inf
            for step in range(REFITS + 1):
                evaluate(trial, floats, ints, cache, out)
                value = out[0] + out[1]
                gain = value - top
                if gain > 0.0:
                    top = value
                    overwrite(best, trial)
                if not np.isfinite(value) or (step > 0 and top < score[0] - HOPELESS):
                    break
                if step >= PATIENCE and (top < score[0] - CLOSE or gain < SETTLED):
                    break
                refit(trial, floats, ints, cache)
            idle = 0 if top > score[0] + WORTH and index >= 0 else idle
            if top > score[0] + 1e-6:
                score[0] = top
                overwrite(z, best)
                evaluate(z, floats, ints, cache, out)
                commit(cache)
        index, idle = (index + 1) % num_edits, idle + 1
        if idle > num_edits:
            break


@lru_cache(maxsize=1)
def compiled_climb() -> Any:
    """The greedy search for any kernel, called without looking at the types of its arguments."""
    import numba as nb

    types = kernel_types()
    functions = (types["function"](types[name]) for name in ("edit", "refit", "evaluate", "commit"))
    vector, index = types["vector"], types["index"]
    signature = nb.void(*functions, nb.int64, vector, vector, index, vector, vector)
    only: Any = next(iter(nb.njit(signature, cache=True, nogil=True)(_climb).overloads.values()))
    return only.entry_point


def polish(kernel: Kernel, z: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """The mode near a packed state (D,) and its log joint. Needs a kernel with edits and a refit."""
    z, score = z.copy(), np.empty(1)
    cache = np.zeros(kernel.cache_size)
    functions = (pointer(f) for f in (kernel.edit, kernel.refit, kernel.evaluate, kernel.commit))
    compiled_climb()(*functions, kernel.num_edits, z, kernel.floats, kernel.ints, cache, score)
    return z, float(score[0])
