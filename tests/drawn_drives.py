"""Short drives drawn from RoadFrames itself: posts on both sides, a car ahead, the car on a way of its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.road import camera
from models.program import simulate
from models.road.cues import Cues
from models.road.drive import RoadDrive, RoadFrame
from models.road.ego import Motion
from models.road.frames import RoadFrames
from models.unroll import observe_frames, stack_frames, unroll

GAP, SPEED, SECONDS = 30.0, 15.0, 0.5


def place(rng: np.random.Generator, driven: float) -> tuple[Cues, NDArray[np.float64]]:
    """Where cues stand along the road, seen by a camera that misses some; the positions are to come."""
    rows = []
    for side, first in enumerate((7.0, 14.0)):
        arc = np.arange((first - driven) % GAP, 130.0, GAP)
        track = 1000 * side + np.round((arc + driven - first) / GAP)
        rows.append(np.stack([arc, np.full(len(arc), side), track], -1)[rng.random(len(arc)) < 0.9 - 0.002 * arc])
    arc, side, track = np.concatenate([*rows, [[60.0, 0.0, 0.0]]]).T
    vehicle = np.arange(len(arc)) == len(arc) - 1
    about = np.stack([arc - 10.0, np.zeros(len(arc))], -1)
    cues = Cues(
        kind=np.where(vehicle, "car", "delineator"),
        left=side > 0,
        track=track.astype(np.int64),
        position=about,
        covariance=camera(about, vehicle),
        flow=np.where(vehicle, 0.0, np.nan),
        flow_std=np.full(len(arc), 0.02),
        confidence=np.ones(len(arc)),
    )
    return cues, arc


def drawn_drive(
    model: RoadFrames, seed: int, num_frames: int
) -> tuple[tuple[RoadFrame, ...], dict[str, NDArray[np.float64]]]:
    """Frames, and the true states {site: (frame, *event)}."""
    rng = np.random.default_rng(seed)
    cues, arcs = zip(*(place(rng, SPEED * SECONDS * t) for t in range(num_frames)), strict=True)
    time = np.linspace(0.0, SECONDS, 6)
    motion = tuple(Motion(time, np.full(6, rng.normal(0.0, 0.02)), np.zeros(6), SPEED) for _ in range(num_frames))
    frames = [
        frame._replace(cues=None, evidence=frame.evidence._replace(arc=arc))
        for frame, arc in zip(model.prepare(RoadDrive(cues, motion)), arcs, strict=True)
    ]
    draws = {n: v[0] for n, v in simulate(unroll(model), frames, num=1, seed=seed).items()}
    seen, latents = observe_frames(frames, draws)
    return seen, stack_frames(latents, 0)
