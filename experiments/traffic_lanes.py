"""Lanes from recorded traffic: tracks to lanes by association, lanes to courses by least squares.

    waybayes experiment=lankershim_lanes                            recorded vehicles in Los Angeles
    waybayes experiment=lankershim_lanes scenario.name=lankershim_1
    waybayes experiment=lankershim_lanes scenario=csv scenario.path=tracks.csv

The sibling of experiments.lanes without a structure: models.intersection.traffic_lanes.TrafficLanes finds the lanes,
and the refining engine estimates their courses, once with what lanes of an arm share and once each by itself: the
larger evidence decides. Drivers who are about to turn keep off the middle of their lane, so that recorded lanes share
less than drawn ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from experiments.lanes import BAND, Engine, LanePosterior, Lanes
from experiments.traffic_splines import spline_lanes
from inference.posterior import Posterior
from inference.refusal import answers_first
from models.intersection.free_lines import centre_lines, lane_bands
from models.intersection.routes import RoutedTracks
from models.intersection.tracks import Tracks
from models.intersection.traffic_lanes import TrafficEvidence, TrafficLanes, half_lanes
from models.program import InputError

Array = NDArray[np.float64]
Learn = Callable[[Tracks], tuple[Lanes, Lanes]]
NUM_DRAWS = 500  # for bands
EDGE = 1.6448536269514722  # standard deviations of a normal distribution from its middle to the edge of BAND
assert BAND == 0.9


@dataclass(frozen=True)
class TrafficPosterior(LanePosterior):
    """The posterior of the courses of all lanes.

    again  estimates lanes from other tracks in the same way, and as independent splines, for held-out scores"""

    again: Learn | None = None


@answers_first
def estimate(model: TrafficLanes, evidence: TrafficEvidence, *, seed: int, refine: Engine) -> TrafficPosterior:
    """Courses of the lanes that the model found. Raises InputError for a model that finds none."""
    if not isinstance(model, TrafficLanes):
        raise InputError(
            f"engine lanes_traffic needs model=traffic_lanes, which finds lanes in tracks, not {type(model).__name__}"
        )
    found, evidence = choose(model, evidence, refine, seed)
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


def choose(
    model: TrafficLanes, evidence: TrafficEvidence, refine: Engine, seed: int
) -> tuple[Posterior, TrafficEvidence]:
    """Courses of lanes that share and of lanes by themselves, whichever has the larger evidence; info says which,
    `shared`, and by how many nats, `shared_nats`.

    Raises InputError where the engine tells no evidence."""
    alone = replace(model, courses=replace(model.courses, shared=False))
    apart = evidence._replace(courses=alone.courses.prepare(RoutedTracks(evidence.tracks, {}, evidence.routes)))
    both = [refine(model, evidence, seed=seed), refine(alone, apart, seed=seed)]
    if both[0].log_evidence is None or both[1].log_evidence is None:
        raise InputError("refine tells no evidence to choose by; set refine=least_squares")
    nats = both[0].log_evidence - both[1].log_evidence
    best = int(nats < 0)
    info = both[best].info | {"shared": best == 0, "shared_nats": nats}
    return replace(both[best], info=info), (evidence, apart)[best]


def learn(model: TrafficLanes, refine: Engine, seed: int, tracks: Tracks) -> tuple[Lanes, Lanes]:
    """Lanes of other tracks, and on the same routes as independent splines."""
    found, evidence = choose(model, model.prepare(tracks), refine, seed)
    splines = spline_lanes(evidence.courses, evidence.routes, model.courses.position_std, EDGE)
    return lanes_of(evidence, found, seed), splines


def lanes_of(evidence: TrafficEvidence, posterior: Posterior, seed: int) -> Lanes:
    """Centre lines of the estimate with bands of the draws."""
    lines = centre_lines(evidence.courses, posterior.estimate)
    draws = posterior.resample(NUM_DRAWS, seed)
    left, right = lane_bands(evidence.courses, posterior.estimate, draws, BAND)
    return Lanes(lines, left, right, evidence.routes)
