"""Structure, then lanes: an engine made of two.

The structure engine finds arms and lane counts; every track is put on the entry and the exit lane it most probably
drove; routes that turn out to be one lane are merged; the refining engine then estimates the courses of all lanes
together. The same is done for every reading of the tracks among the structure engine's draws (experiments.readings):
the bands of the best structure's lanes hold all of them, and each lane has a probability (experiments.lane_mixture).

    waybayes experiment=lanes                      a simulated junction, lane by lane
    waybayes experiment=lanes scenario.seed=3 engine.courses.heading_std=0.2
    waybayes experiment=lanes engine=lanes_choice  arms with lanes or free curves, as the evidence says
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.course_choice import Choice, Rival, fit
from experiments.lane_mixture import ReadLanes, mix
from experiments.lane_posterior import LanePosterior, Lanes, OtherLane, State
from experiments.readings import Reading, read
from inference.posterior import Posterior
from inference.refusal import answers_first
from models.intersection.course_family import AnyEvidence, Courses, centre_lines, lane_displacements
from models.intersection.courses import LaneCourses
from models.intersection.evidence import JunctionEvidence
from models.intersection.routes import ROUTING, RoutedTracks, Routes, Routing, find_routes
from models.intersection.same_lane import merge_routes
from models.intersection.state import Junction
from models.program import InputError

Engine = Callable[..., Posterior]
Array = NDArray[np.float64]
Refined = tuple[Posterior, AnyEvidence, Routes]
BAND = 0.9  # posterior probability between the edges of a band
NUM_DRAWS = 1000  # of lines, over all readings
LOST = 1.2  # times the cost of the best reading: courses of another one that cost more got lost


@answers_first
def estimate(
    model: Junction,
    evidence: JunctionEvidence,
    *,
    seed: int,
    structure: Engine,
    refine: Engine,
    courses: Courses,
    rival: Rival | None = None,
) -> LanePosterior:
    """Run both engines; with a rival, lanes are of the family that the tracks speak for (experiments.course_choice).

    Raises InputError where a model is none of an intersection with the exact likelihood."""
    if not isinstance(model, Junction) or model.likelihood != "exact":
        raise InputError(
            "engine lanes needs model=junction or junction_real with likelihood exact; it reads their routes"
        )
    seeds = [int(s.generate_state(1)[0]) for s in np.random.SeedSequence(seed).spawn(2)]
    families = courses if rival is None else Choice(courses, rival)
    return with_lanes(model, evidence, structure(model, evidence, seed=seeds[0]), refine, families, seeds[1])


def with_lanes(
    model: Junction,
    evidence: JunctionEvidence,
    found: Posterior,
    refine: Engine,
    courses: Courses | Choice,
    seed: int,
) -> LanePosterior:
    """A posterior of the structure with the lanes of its best state, and what its draws say about them."""
    began = time.perf_counter()
    posterior, course_evidence, routes = refine_lanes(model, evidence, found, refine, courses, seed)
    readings = read(model, evidence, found)
    arguments = (refine, courses, seed)
    seen: list[tuple[Reading, Refined | None]] = [(readings.kept[0], (posterior, course_evidence, routes))]
    for reading in readings.kept[1:]:
        some = len(reading.routes.connections) > 0
        seen.append(
            (reading, refine_routes(model, evidence, reading.state, reading.routes, *arguments) if some else None)
        )
    worst = LOST * _cost(evidence, seen[0][1])
    sound = [(reading, one) for reading, one in seen if _converged(one) or _cost(evidence, one) <= worst]
    total = sum(reading.share for reading, _ in sound)
    lanes_of = [_lanes_of(reading.share / total, reading, refined, seed) for reading, refined in sound]
    best, mixture = lanes_of[0], mix(lanes_of, BAND)
    flags = [*found.info.get("flags", []), *posterior.info.get("flags", []), *readings.flags]
    if len(sound) < len(seen):
        flags.append(
            f"the courses of {len(seen) - len(sound)} of {len(seen)} readings of the tracks, {1 - total:.0%} of their "
            "draws, got lost: bands and probabilities leave them out"
        )
    families = {key: value for key, value in posterior.info.items() if key.startswith("family")}
    info = (
        found.info
        | families
        | {
            "lanes": len(best.lines),
            "readings": len(sound),
            "readings_share": readings.covered * total,
            "evaluations": found.info.get("evaluations", 0) + sum(map(_evaluations, seen)),
            "seconds": found.info.get("seconds", 0.0) + time.perf_counter() - began,
            "lane_seconds": time.perf_counter() - began,
            "flags": flags,
        }
    )
    alternatives = []
    for probability, number, lane in mixture.alternatives:
        own, state = lanes_of[number], sound[number][0].state
        tracks = int((own.routes.track_route == lane).sum())
        alternatives.append(OtherLane(probability, own.lines[lane], own.routes.connections[lane], state, tracks))
    fields = {name: getattr(found, name) for name in found.__dataclass_fields__}
    return LanePosterior(
        **fields | {"info": info},
        lanes=Lanes(best.lines, mixture.left, mixture.right, routes),
        probability=mixture.probability,
        alternatives=alternatives,
        first=centre_lines(course_evidence, {}),
        lane_width=float(posterior.estimate.get("lane_width", mean_width(model, found.estimate))),
        courses=posterior,
    )


def _evaluations(seen: tuple[Reading, Refined | None]) -> int:
    return 0 if seen[1] is None else int(seen[1][0].info.get("evaluations", 0))


def _converged(refined: Refined | None) -> bool:
    return refined is None or bool(refined[0].info.get("converged", True))


def _cost(evidence: JunctionEvidence, refined: Refined | None) -> float:
    """Cost of courses for each point on their routes [nats], 0 where the engine knows none.

    Courses that stall near their minimum, as real ones do where points change their nodes, cost a little more than
    others; those that got lost cost far more, and their Laplace posterior means nothing."""
    if refined is None:
        return 0.0
    assert evidence.tracks is not None
    points = np.diff(evidence.tracks.offsets)[refined[2].track_route >= 0].sum()
    return float(refined[0].info.get("cost", 0.0) / points)


def _lanes_of(share: float, reading: Reading, refined: Refined | None, seed: int) -> ReadLanes:
    """Lines of the estimate, and draws of them in proportion to the share; no lanes where no track is on a route."""
    if refined is None:
        return ReadLanes(share, [], [], reading.routes)
    posterior, evidence, routes = refined
    draws = posterior.resample(max(round(share * NUM_DRAWS), 1), seed)
    across = lane_displacements(evidence, posterior.estimate, draws)
    return ReadLanes(share, centre_lines(evidence, posterior.estimate), across, routes)


def refine_lanes(
    model: Junction,
    evidence: JunctionEvidence,
    found: Posterior,
    refine: Engine,
    courses: Courses | Choice,
    seed: int,
) -> Refined:
    """From the best state of a structure to the courses: their posterior, what it was learnt from, the routes."""
    if evidence.tracks is None:
        raise InputError("lanes need whole tracks, but this evidence was simulated half by half")
    routes = find_routes(model, evidence, found.estimate)
    return refine_routes(model, evidence, found.estimate, routes, refine, courses, seed)


def refine_routes(
    model: Junction,
    evidence: JunctionEvidence,
    state: State,
    routes: Routes,
    refine: Engine,
    courses: Courses | Choice,
    seed: int,
    routing: Routing = ROUTING,
) -> Refined:
    """From a structure and its routes to the courses; routes that are one lane are merged."""
    assert evidence.tracks is not None
    routed = RoutedTracks(evidence.tracks, whole_structure(model, state), routes)
    own = courses.own if isinstance(courses, Choice) else courses
    arms = own if isinstance(own, LaneCourses) else LaneCourses()
    prepared = arms.prepare(routed)
    merged = merge_routes(prepared, routes, arms.spacing, routing)
    same = arms is own and len(merged.connections) == len(routes.connections)
    fitted = fit(refine, courses, routed._replace(routes=merged), seed, prepared if same else None)
    return fitted.posterior, fitted.evidence, merged


def whole_structure(model: Junction, state: State) -> dict[str, NDArray[Any]]:
    """A state with the fields of arms that the model holds constant."""
    slots = len(state["angle"])
    return dict(state) | {name: np.full(slots, value) for name, value in model.constants.items()}


def mean_width(model: Junction, state: State) -> float:
    """Width of a lane over the arms of a state [m]."""
    return float(whole_structure(model, state)["width"][: int(state["num_arms"])].mean())
