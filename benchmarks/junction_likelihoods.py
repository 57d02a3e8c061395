"""[M20]'s closest lane of every point against our closest lane of every half track, on the same states."""

from __future__ import annotations

from dataclasses import replace
from statistics import fmean, median, stdev

import numpy as np
from numpy.typing import NDArray

from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.junction import ANNEALED, Effort, Setting, attempt
from experiments.scenarios.protocol import protocol
from inference import rjmcmc
from inference.progress import Progress
from models.capability import Kernel
from models.intersection.state import Junction
from models.intersection.tracks import Tracks

HALF = Junction(likelihood="half", bend_std=0.0)
STATES = {"num_chains": 1, "num_steps": 3000, "warmup": 1000, "thin": 40}  # 50 states at T = 1


def log_likelihoods(kernel: Kernel, states: NDArray[np.float64]) -> NDArray[np.float64]:
    """(S,) of packed states (S, D)."""
    cache, out = np.zeros(kernel.cache_size), np.empty((len(states), 2))
    for state, row in zip(states, out, strict=True):
        kernel.evaluate(state, kernel.floats, kernel.ints, cache, row)
        kernel.commit(cache)
    return out[:, 1]


def gaps(tracks: Tracks, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(S,) log likelihood by points and by halves, of states that a chain with `half` visits from its estimate on."""
    estimate = attempt(Setting(HALF, ANNEALED | {"polish": True}), tracks, seed).posterior.estimate
    evidence = HALF.prepare(tracks)
    chain = rjmcmc.run(HALF, evidence, seed=seed, init=estimate, **STATES)  # type: ignore[arg-type]
    half, point = HALF.kernel(evidence), replace(HALF, likelihood="point").kernel(evidence)
    states = half.pack({site: values[0] for site, values in chain.draws.items()})
    return log_likelihoods(point, states), log_likelihoods(half, states)


def pointwise_gap(effort: Effort) -> Values:
    means, sds, scales, num = [], [], [], max(effort.timed // 2, 1)
    with Progress("pointwise_gap_nats", num, effort.show) as bar:
        for seed in range(num):
            point, half = gaps(protocol(seed).data, seed)
            means.append(float((point - half).mean()))
            sds.append(float((point - half).std()))
            scales.append(float(half.std()))
            bar.advance(1)
    between = f", sd between scenes {stdev(means):.0f}" if num > 1 else ""
    return {
        "pointwise_gap_nats": Value(fmean(means), f"{num} scenes of 50 states{between}"),
        "pointwise_gap_sd_nats": Value(
            median(sds), f"median of {num} scenes; sd of the half-track log likelihood itself {median(scales):.1f}"
        ),
    }


MEASUREMENTS = (
    Measurement(
        (
            Figure(
                "pointwise_gap_nats",
                "nats",
                "log likelihood with the closest lane of every point minus that with the closest lane of every half "
                "track, same states (T = 1, from the polished estimate on, straight arms); mean over protocol scenes",
            ),
            Figure(
                "pointwise_gap_sd_nats",
                "nats",
                "sd of this difference along the states of one scene: what a Markov chain feels of it",
            ),
        ),
        pointwise_gap,
    ),
)
