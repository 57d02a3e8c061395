"""Small scenes for tests of the intersection: a few half tracks of a few points, with fixed positions."""

from __future__ import annotations

import numpy as np

from inference.calibration import predict
from models.intersection.evidence import JunctionEvidence
from models.intersection.state import Junction
from models.program import Latents, simulate


def blank_evidence(
    num_entries: int = 5, num_exits: int = 4, num_points: int = 10, seed: int = 0, heading: bool = True
) -> JunctionEvidence:
    """Half tracks of about `num_points` points, 20 to 60 m from the origin, whose positions are to be simulated."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(max(num_points - 3, 1), num_points + 4, num_entries + num_exits)
    s = np.concatenate([np.zeros(0), *(20.0 + 40.0 * np.sort(rng.random(n)) for n in sizes)])
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    return JunctionEvidence(None, s, starts, num_entries, np.array([3.0, -7.0]), heading, None)


def states(model: Junction, num: int, seed: int, evidence: JunctionEvidence | None = None) -> Latents:
    """Prior draws of the latents (num, *event)."""
    draws = simulate(model, evidence or blank_evidence(), num=num, seed=seed)
    return {name: value for name, value in draws.items() if name != "points"}


def one(latents: Latents, row: int) -> Latents:
    return {name: value[row] for name, value in latents.items()}


def with_points(model: Junction, latents: Latents, blank: JunctionEvidence, seed: int) -> JunctionEvidence:
    """Evidence simulated from one state (*event)."""
    batch = predict(model, {n: v[None] for n, v in latents.items()}, blank, seed=seed)
    return batch._replace(points=batch.points[0])
