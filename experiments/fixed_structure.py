"""The continuous part of a junction: an engine made of two.

The structure engine finds arms and lane counts; everything that counts is fixed there, and the refining engine takes
the rest, beginning at the best state. Its posterior is that of the numbers given the structure: narrower than the
posterior over structures, by what the structures add.

    waybayes experiment=demo engine=bbvi_structure
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from inference.posterior import Posterior, Snapshots
from inference.refusal import answers_first
from models.program import InputError, fix

Engine = Callable[..., Posterior]
Array = NDArray[Any]


@answers_first
def estimate(model: Any, evidence: Any, *, seed: int, structure: Engine, refine: Engine) -> Posterior:
    """Run both. Draws, estimate and snapshots hold the fixed sites too; the snapshots of the structure come first.

    Raises InputError for a model of known dimension, where there is nothing to fix."""
    dimension = getattr(model, "dimension", None)
    if dimension is None:
        raise InputError(
            f"{type(model).__name__} has no unknown dimension to fix; choose the refining engine by itself"
        )
    began = time.perf_counter()
    seeds = [int(s.generate_state(1)[0]) for s in np.random.SeedSequence(seed).spawn(2)]
    found = structure(model, evidence, seed=seeds[0])
    between = time.perf_counter() - began
    counts = {n: v for n, v in found.estimate.items() if not np.issubdtype(np.asarray(v).dtype, np.floating)}
    numbers = {n: v for n, v in found.estimate.items() if n not in counts}
    fixed = fix(model, **{n: torch.as_tensor(v) for n, v in counts.items()})
    posterior = refine(fixed, evidence, seed=seeds[1], init=numbers)
    draws = posterior.draws | {n: _spread(v, posterior.shape) for n, v in counts.items()}
    info = posterior.info | {
        "engine": f"{found.info.get('engine', 'structure')}, then {posterior.info.get('engine', 'refinement')}",
        "evaluations": found.info.get("evaluations", 0) + posterior.info.get("evaluations", 0),
        "seconds": found.info.get("seconds", between) + posterior.info.get("seconds", 0.0),
        "structure_seconds": found.info.get("seconds", between),
        "flags": [*found.info.get("flags", []), *posterior.info.get("flags", [])],
    }
    return replace(
        posterior,
        draws=draws,
        log_evidence=None,  # it is that of the structure alone
        model_index=draws[dimension],
        estimate=posterior.estimate | counts,
        info=info,
        snapshots=_joined(found.snapshots, posterior.snapshots, counts, between),
    )


def _spread(value: Array, shape: tuple[int, ...]) -> Array:
    return np.broadcast_to(value, (*shape, *np.shape(value))).copy()


def _joined(
    first: Snapshots | None, second: Snapshots | None, counts: dict[str, Array], later: float
) -> Snapshots | None:
    """Both as one, the second `later` seconds after the first."""
    if second is None:
        return first
    states = second.states | {n: _spread(v, second.step.shape) for n, v in counts.items()}
    second = second._replace(seconds=second.seconds + later, states=states)
    if first is None:
        return second
    return Snapshots(
        np.concatenate([first.step, first.step[-1] + second.step]),
        np.concatenate([first.seconds, second.seconds]),
        np.concatenate([first.log_joint, second.log_joint]),
        {n: np.concatenate([first.states[n], v]) for n, v in second.states.items()},
    )
