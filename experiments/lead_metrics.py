"""How well the vehicle ahead is tracked: (posterior, scene) -> {name: value}."""

from __future__ import annotations

import numpy as np

from experiments.scenarios.lead_vehicle import LEAD
from experiments.scenarios.scene import Scene, TrafficTruth
from experiments.tracking_metrics import times_of
from inference.posterior import Posterior
from inference.tracks import Tracks

WARM_UP = 2.0  # not scored [s]
LOST = 3.0  # an estimate farther away is of something else [m]


def metrics(posterior: Posterior, scene: Scene, *, threshold: float = 0.5) -> dict[str, float]:
    """Of the estimate nearest to the vehicle ahead, after each scan but those of the first two seconds; nothing for
    other scenes.

    lead_m       mean distance, of any size
    lead_95_m    which 95 % of the scans do not exceed
    lead_nees    (x - mean)' covariance^-1 (x - mean) of the position, mean where it is within 3 m
    lead_miss    share of the scans without an estimate within 3 m
    lead_labels  number of labels that it is tracked by

    threshold  existence above which there is an estimate"""
    if not isinstance(posterior, Tracks) or not isinstance(scene.truth, TrafficTruth):
        return {}
    if scene.info.get("scenario") != "lead_vehicle":
        return {}
    sure, truth = posterior.confirmed(threshold), scene.truth
    index = sure.entries("x", "y")
    distance, nees, labels, missed, scored = list[float](), list[float](), set[int](), 0, 0
    for t, true in enumerate(times_of(truth, sure.time)):
        rows = slice(truth.offset[true], truth.offset[true + 1])
        here = truth.position[rows][truth.label[rows] == LEAD]
        if sure.time[t] < WARM_UP or not len(here):
            continue
        scored += 1
        objects = sure.at(t)
        gap = objects.mean[:, index] - here[0]
        away = np.hypot(*gap.T)
        if len(away):
            distance.append(float(away.min()))
        if not len(away) or away.min() > LOST:
            missed += 1
            continue
        best = int(away.argmin())
        nees.append(float(gap[best] @ np.linalg.solve(objects.covariance[best][np.ix_(index, index)], gap[best])))
        labels.add(int(objects.label[best]))
    if not distance:
        return {"lead_miss": 1.0} if scored else {}
    return {
        "lead_m": float(np.mean(distance)),
        "lead_95_m": float(np.quantile(distance, 0.95)),
        "lead_nees": float(np.mean(nees)) if nees else float("nan"),
        "lead_miss": missed / scored,
        "lead_labels": float(len(labels)),
    }
