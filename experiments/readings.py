"""Readings of the tracks: the distinct structures among the draws of a chain, with the routes of each.

A reading is a structure, its arms and their lane counts, and the routes that tracks take on it: which of them drove
which lane. Two draws are of one reading where both agree; the arms of a draw, a set, are brought into one order first.

    p(reading | tracks) = share of the draws of that reading

Shares are those of the chain alone. The evidence of the courses does not correct them: each reading gives it other
points to score, those of the tracks on its routes, and all of these points were scored by the structure's likelihood
already. Shares are worth what the chain is worth: of chains that do not mix, or that were annealed and not sampled,
they say little, and `flags` says so.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.lane_posterior import State
from experiments.scenarios.paths import wrap
from inference import diagnostics
from inference.posterior import Posterior
from models.intersection.angles import MIN_SEPARATION
from models.intersection.evidence import JunctionEvidence
from models.intersection.packing import FIELDS, WHOLE
from models.intersection.routes import Routes, find_routes
from models.intersection.state import Junction

MOST_DRAWS = 200  # whose routes are looked up: shares are known to .02
MOST = 16  # readings
COVERED = 0.98  # of the draws: the least probable readings are left out
WORTH = 0.9  # of the draws, at least: else bands are too narrow
FEW = 50  # draws, or effective ones: fewer make no shares


class Reading(NamedTuple):
    """One way to read the tracks.

    share   of the draws
    state   {site: (*event)} of the structure: the mean of these draws; of the first reading the best state
    routes  of the tracks on it
    """

    share: float
    state: State
    routes: Routes


class Readings(NamedTuple):
    """The most probable readings, that of the best state first.

    covered  share of the draws that is of these readings
    flags    what speaks against the shares
    """

    kept: list[Reading]
    covered: float
    flags: list[str]


def read(model: Junction, evidence: JunctionEvidence, found: Posterior) -> Readings:
    """The readings of a structure posterior, most probable first but for that of the best state.

    Where no draw is of the best state's reading, it counts as one draw more. Shares sum to one over those kept."""
    best_state = ordered(found.estimate, found.estimate)
    best_routes = find_routes(model, evidence, best_state)
    best = _key(best_state, best_routes)
    per_chain = max(MOST_DRAWS // found.shape[0], 1)
    columns = np.unique(np.linspace(0, found.shape[1] - 1, min(per_chain, found.shape[1])).astype(int))
    weights = found.weights[:, columns] / found.weights[:, columns].sum()
    groups: dict[tuple[bytes, ...], list[tuple[float, State, Routes]]] = {best: []}
    for chain, column in np.ndindex(weights.shape):
        draw = {site: values[chain, columns[column]] for site, values in found.draws.items()}
        state = ordered(draw, found.estimate)
        routes = find_routes(model, evidence, state)
        groups.setdefault(_key(state, routes), []).append((float(weights[chain, column]), state, routes))
    share = {key: sum(weight for weight, _, _ in draws) for key, draws in groups.items()}
    share[best] = share[best] or 1.0 / weights.size
    others = sorted((key for key in groups if key != best), key=lambda key: (-share[key], key))
    total, covered, kept = sum(share.values()), share[best], [best]
    for key in others[: MOST - 1]:
        if covered >= COVERED * total:
            break
        kept.append(key)
        covered += share[key]
    readings = [Reading(share[best] / covered, best_state, best_routes)]
    for key in kept[1:]:
        state = _mean([state for _, state, _ in groups[key]], np.array([weight for weight, _, _ in groups[key]]))
        readings.append(Reading(share[key] / covered, state, groups[key][0][2]))
    return Readings(readings, covered / total, _flags(found, covered / total))


def ordered(state: State, best: State) -> dict[str, NDArray[Any]]:
    """The same state with its arms counter-clockwise from the first arm of the best state on.

    Counting begins half the least angle between two arms before that one: no other arm of the best state is there."""
    num = int(state["num_arms"])
    first = float(best["angle"][0]) - MIN_SEPARATION / 2
    order = np.argsort(np.remainder(np.asarray(state["angle"])[:num] - first, 2 * np.pi))
    slots = np.concatenate([order, np.arange(num, len(state["angle"]))])
    return {site: np.asarray(value)[slots] if site in FIELDS else np.asarray(value) for site, value in state.items()}


def _counts(state: State) -> bytes:
    """Arms and their lane counts, the same for all draws of one structure."""
    arms = slice(int(state["num_arms"]))
    return np.stack([np.asarray(state[side])[arms] for side in WHOLE]).astype(np.int64).tobytes()


def _key(state: State, routes: Routes) -> tuple[bytes, ...]:
    return _counts(state), routes.connections.tobytes(), routes.track_route.tobytes()


def _mean(states: list[State], weights: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """The mean of states of one structure, of angles about the first one's."""
    share, out = weights / weights.sum(), {}
    for site, first in states[0].items():
        values = np.stack([state[site] for state in states])
        if site == "angle":
            out[site] = wrap(first + share @ wrap(values - first))
        else:
            out[site] = first if first.dtype.kind in "iu" else np.tensordot(share, values, 1)
    return out


def _flags(found: Posterior, covered: float) -> list[str]:
    """What speaks against the shares."""
    num_draws = int(np.prod(found.shape))
    if num_draws < FEW:
        return [
            f"the probabilities of lanes are shares of {num_draws} draws, which says little: "
            "sample on after the annealing (num_steps above warmup)"
        ]
    best = _counts(ordered(found.estimate, found.estimate))
    is_best = np.zeros(found.shape)
    for index in np.ndindex(found.shape):
        draw = {site: values[index] for site, values in found.draws.items()}
        is_best[index] = _counts(ordered(draw, found.estimate)) == best
    judged = Posterior({"best_structure": is_best}, found.log_weights)
    flags = diagnostics.flags(judged, min_ess=FEW)
    if covered < WORTH:
        flags.append(
            f"the {MOST} most probable readings of the tracks are {covered:.0%} of the draws: lanes are more uncertain "
            "than their bands say"
        )
    return flags
