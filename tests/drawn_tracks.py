"""Small scenes of tracked objects, drawn without a filter: what is believed is the truth, but for Gaussian errors."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.scenarios.scene import TrafficTruth
from inference.tracks import Tracks

NAMES = ("x", "y", "vx", "vy", "heading", "length", "width")
STD = np.array([0.5, 0.3, 0.2, 0.2, 0.02, 0.1, 0.1])


def traffic(num: int = 3, num_scans: int = 20, seed: int = 0) -> TrafficTruth:
    """Objects that drive straight on, the second one coming late, the last one leaving early."""
    rng = np.random.default_rng(seed)
    begin, velocity = rng.uniform(-30.0, 30.0, (num, 2)), rng.uniform(-8.0, 8.0, (num, 2))
    time = 0.1 * np.arange(num_scans)
    there = np.ones((num_scans, num), bool)
    there[:4, 1 % num] = False
    there[-5:, -1] = False
    scan, who = np.nonzero(there)
    place = begin[who] + velocity[who] * time[scan, None]
    heading = np.arctan2(velocity[who, 1], velocity[who, 0])
    return TrafficTruth(
        time,
        np.concatenate([[0], np.cumsum(there.sum(1))]),
        10 + who,
        *place.T,
        *velocity[who].T,
        heading,
        np.full(len(who), 4.5),
        np.full(len(who), 1.8),
        np.zeros(len(who), dtype=np.int64),
    )


def believed(truth: TrafficTruth, seed: int = 0, **changes: Any) -> Tracks:
    """Every true object under its own label with existence .9, off by N(0, covariance)."""
    rng = np.random.default_rng(seed)
    state = np.stack([truth.x, truth.y, truth.vx, truth.vy, truth.heading, truth.length, truth.width], -1)
    root = np.diag(STD)
    root[1, 0] = 0.3  # correlated
    kind = np.tile([0.8, 0.2], (len(state), 1))
    fields: dict[str, Any] = {
        "time": truth.time,
        "offset": truth.offset,
        "label": truth.label,
        "existence": np.full(len(state), 0.9),
        "mean": state + rng.standard_normal(state.shape) @ root.T,
        "covariance": np.tile(root @ root.T, (len(state), 1, 1)),
        "kind": kind,
        "names": NAMES,
        "kind_names": ("car", "bicycle"),
        "sensor": (("radar", "laser") * len(truth.time))[: len(truth.time)],
        "log_evidence": -12.5,
        "info": {"engine": "drawn", "step_seconds": [0.001] * len(truth.time), "flags": []},
    }
    return Tracks(**(fields | changes))
