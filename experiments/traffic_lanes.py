"""Lanes from recorded traffic: tracks to lanes by association, lanes to courses by least squares.

    waybayes experiment=lankershim_lanes                            recorded vehicles in Los Angeles
    waybayes experiment=lankershim_lanes scenario.name=lankershim_1
    waybayes experiment=lankershim_lanes scenario=csv scenario.path=tracks.csv

The sibling of experiments.lanes without a structure: models.intersection.traffic_lanes.TrafficLanes finds the lanes,
and the refining engine estimates their courses together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from experiments.lanes import BAND, Engine, LanePosterior, Lanes
from inference.posterior import Posterior
from models.intersection.free_lines import centre_lines, lane_bands
from models.intersection.routes import RoutedTracks
from models.intersection.tracks import Tracks
from models.intersection.traffic_lanes import TrafficEvidence, TrafficLanes, half_lanes
from models.program import InputError

Array = NDArray[np.float64]
Learn = Callable[[Tracks], tuple[Lanes, Lanes]]
NUM_DRAWS = 500  # for bands


@dataclass(frozen=True)
class TrafficPosterior(LanePosterior):
    """The posterior of the courses of all lanes.

    again  estimates lanes from other tracks in the same way, and with every lane by itself, for held-out scores"""

    again: Learn | None = None


def estimate(model: TrafficLanes, evidence: TrafficEvidence, *, seed: int, refine: Engine) -> TrafficPosterior:
    """Courses of the lanes that the model found. Raises InputError for a model that finds none."""
    if not isinstance(model, TrafficLanes):
        raise InputError(
            f"engine lanes_traffic needs model=traffic_lanes, which finds lanes in tracks, not {type(model).__name__}"
        )
    found = refine(model, evidence, seed=seed)
    lanes = lanes_of(evidence, found, seed)
    used = evidence.routes.track_route >= 0
    info = found.info | {
        "lanes": len(lanes.lines),
        "half_lanes": half_lanes(evidence.routes),
        "tracks": len(used),
        "tracks_on_lanes": int(used.sum()),
    }
    fields = {name: getattr(found, name) for name in found.__dataclass_fields__}
    return TrafficPosterior(
        **fields | {"info": info, "estimate": found.estimate | {"angle": evidence.angle}},
        lanes=lanes,
        first=centre_lines(evidence.courses, {}),
        courses=found,
        again=partial(learn, model, refine, seed),
    )


def learn(model: TrafficLanes, refine: Engine, seed: int, tracks: Tracks) -> tuple[Lanes, Lanes]:
    """Lanes of other tracks: together, and on the same routes each by itself."""
    evidence = model.prepare(tracks)
    alone = replace(model, courses=replace(model.courses, shared=False))
    by_itself = evidence._replace(courses=alone.courses.prepare(RoutedTracks(tracks, {}, evidence.routes)))
    return (
        lanes_of(evidence, refine(model, evidence, seed=seed), seed),
        lanes_of(by_itself, refine(alone, by_itself, seed=seed), seed),
    )


def lanes_of(evidence: TrafficEvidence, posterior: Posterior, seed: int) -> Lanes:
    """Centre lines of the estimate with bands of the draws."""
    lines = centre_lines(evidence.courses, posterior.estimate)
    draws = posterior.resample(NUM_DRAWS, seed)
    left, right = lane_bands(evidence.courses, posterior.estimate, draws, BAND)
    return Lanes(lines, left, right, evidence.routes)
