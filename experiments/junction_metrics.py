"""Is the estimated junction the true one: arms, lanes, and how sure the posterior is.

"Structure right" is ours: every arm found within 10 degrees, no further arm, and the number of
entries and exits right on each; [M20] section V leaves the structure unevaluated.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from experiments.scenarios.paths import wrap
from experiments.scenarios.scene import JunctionTruth, Scene
from inference.posterior import Posterior

Estimate = Mapping[str, NDArray[Any]]  # one state: num_arms (), centre (2,), fields of S arm slots (S,)

TOLERANCE_DEG = 10.0  # between the directions of an estimated arm and its true one


def structure(estimate: Estimate, truth: JunctionTruth, tolerance_deg: float = TOLERANCE_DEG) -> dict[str, float]:
    """Compare one state with the truth, its K arms being those that vehicles used.

    arms_right       1 where as many arms as true, each within the tolerance of its own true arm
    structure_right  1 where moreover the entries and exits of every arm are right
    lanes_right      share of the 2K lane counts that are right; those of a missed arm are wrong
    angle_error_deg  mean over matched arms, nan where there is none
    centre_error_m   distance of the centres
    gap_error_m      mean over matched arms with a known gap, nan where there is none
    """
    slots, arms, difference = match(estimate, truth, tolerance_deg)
    extra = int(estimate["num_arms"]) - len(arms)
    driven = driven_arms(truth)
    scored = driven[arms]
    slots, arms, difference = slots[scored], arms[scored], difference[scored]
    entries = np.asarray(estimate["entries"])[slots] == truth.entries[arms]
    exits = np.asarray(estimate["exits"])[slots] == truth.exits[arms]
    arms_right = len(arms) == driven.sum() and extra == 0
    gaps = np.abs(np.asarray(estimate["gap"])[slots] - truth.gap[arms])
    return {
        "arms_right": float(arms_right),
        "structure_right": float(arms_right and entries.all() and exits.all()),
        "lanes_right": float(entries.sum() + exits.sum()) / max(2 * int(driven.sum()), 1),
        "angle_error_deg": _mean(np.degrees(difference)),
        "centre_error_m": float(np.linalg.norm(np.asarray(estimate["centre"]) - truth.centre)),
        "gap_error_m": _mean(gaps[np.isfinite(gaps)]),
    }


def match(
    estimate: Estimate, truth: JunctionTruth, tolerance_deg: float = TOLERANCE_DEG
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Pair estimated with true arms one to one: as many pairs within the tolerance as possible, of these
    the closest. Returns slots (M,), true arms (M,) and angles between them (M,) [rad]."""
    active = np.asarray(estimate["angle"])[: int(estimate["num_arms"])]
    difference = np.abs(wrap(active[:, None] - truth.angle))  # (arms estimated, K)
    near = difference <= np.radians(tolerance_deg)
    slots, arms = linear_sum_assignment(np.where(near, difference, 100.0))
    matched = near[slots, arms]
    slots, arms = slots[matched], arms[matched]
    return slots, arms, difference[slots, arms]


def metrics(posterior: Posterior, scene: Scene) -> dict[str, float]:
    """Scores of the estimate as in `structure`, and of the draws:

    arm_count_probability    posterior probability of the true number of arms
    lane_counts_probability  that of the true structure, arms and lane counts

    Nothing where the truth is unknown."""
    truth = scene.truth
    if truth is None:
        return {}
    weights = posterior.weights.reshape(-1)
    draws = {site: values.reshape((-1, *values.shape[2:])) for site, values in posterior.draws.items()}
    right_count = draws["num_arms"] == driven_arms(truth).sum()
    right_lanes = 0.0
    for i in np.flatnonzero(right_count):
        right_lanes += weights[i] * structure({s: v[i] for s, v in draws.items()}, truth)["structure_right"]
    return structure(posterior.estimate, truth) | {
        "arm_count_probability": float(weights[right_count].sum()),
        "lane_counts_probability": float(right_lanes),
    }


def driven_arms(truth: JunctionTruth) -> NDArray[np.bool_]:
    """The arms that can be found, (K,)."""
    return np.ones(len(truth.angle), dtype=bool) if truth.driven is None else truth.driven


ARM_COLUMNS = {"angle": "direction_deg", "entries": "entries", "exits": "exits", "width": "width_m", "gap": "gap_m"}


def arms(estimate: Estimate) -> list[dict[str, float]]:
    """The arms of an estimate, a row each, counter-clockwise from west; nothing where it is none of a junction.

    direction_deg   in which the arm leaves the centre, from the x axis counter-clockwise, -180 to 180
    entries, exits  lanes towards and away from the centre
    width_m         of a lane, where the model estimates it
    gap_m           between the innermost entry and exit, where the model estimates it
    """
    if not {"num_arms", "angle", "entries", "exits"} <= estimate.keys():
        return []
    active = {site: np.asarray(estimate[site])[: int(estimate["num_arms"])] for site in ARM_COLUMNS if site in estimate}
    active["angle"] = np.degrees(wrap(active["angle"]))
    order = np.argsort(active["angle"])
    return [{ARM_COLUMNS[site]: round(values[i].item(), 3) for site, values in active.items()} for i in order]


def label_free(posterior: Posterior) -> dict[str, NDArray[np.float64]]:
    """What no relabelling of arms changes, {name: (chain, draw)}: lanes in all and the centre [m]."""
    draws = posterior.draws
    active = np.arange(draws["entries"].shape[-1]) < draws["num_arms"][..., None]
    lanes = {f"num_{side}": (draws[side] * active).sum(-1).astype(float) for side in ("entries", "exits")}
    return lanes | {"centre_x": draws["centre"][..., 0], "centre_y": draws["centre"][..., 1]}


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if len(values) else float("nan")
