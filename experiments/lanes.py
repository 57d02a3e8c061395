"""Structure, then lanes: an engine made of two.

The structure engine finds arms and lane counts; every track is put on the entry and the exit lane it most probably
drove; routes that turn out to be one lane are merged; the refining engine then estimates the courses of all lanes
together.

    waybayes experiment=lanes                      a simulated junction, lane by lane
    waybayes experiment=lanes scenario.seed=3 engine.courses.heading_std=0.2
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.lanelet_osm import write_osm
from experiments.lanelets import lanelet_map
from inference.posterior import Posterior
from models.intersection.course_evidence import CourseEvidence
from models.intersection.course_lines import centre_lines, lane_bands
from models.intersection.courses import LaneCourses
from models.intersection.evidence import JunctionEvidence
from models.intersection.routes import RoutedTracks, Routes, find_routes
from models.intersection.same_lane import merge_routes
from models.intersection.state import Junction
from models.program import InputError

Engine = Callable[..., Posterior]
Array = NDArray[np.float64]
BAND = 0.9  # posterior probability between the edges of a band


class Lanes(NamedTuple):
    """The centre lines of L lanes.

    lines   L arrays (n, 2) in driving order [m]
    left    L arrays (n,): the centre line lies at most this far to the left of `lines` ...
    right   ... and this far to the right, with 90 % posterior probability at each point [m]
    routes  their entries and exits, and which track drove which lane
    """

    lines: list[Array]
    left: list[Array]
    right: list[Array]
    routes: Routes


@dataclass(frozen=True)
class LanePosterior(Posterior):
    """The posterior of the structure, with the lanes on its best state.

    lanes       centre lines with bands
    first       the same lanes where their refinement began
    lane_width  that arms have in common [m]
    courses     posterior of the refinement
    """

    lanes: Lanes | None = None
    first: list[Array] | None = None
    lane_width: float = 2.7
    courses: Posterior | None = None

    def save(self, folder: Path) -> None:
        """posterior.npz and .json as ever; the lanes in lanes.npz, one array per lane: x, y, left, right; and as a
        Lanelet2 map in lanes.osm."""
        super().save(folder)
        assert self.lanes is not None
        arrays = {
            f"lane_{i}": np.column_stack([line, self.lanes.left[i], self.lanes.right[i]])
            for i, line in enumerate(self.lanes.lines)
        }
        routes = self.lanes.routes._asdict()
        np.savez_compressed(folder / "lanes.npz", allow_pickle=False, **arrays, **routes)
        lanelets = lanelet_map(self.lanes.lines, self.lanes.routes.connections, self.lane_width)
        write_osm(folder / "lanes.osm", lanelets)


def estimate(
    model: Junction,
    evidence: JunctionEvidence,
    *,
    seed: int,
    structure: Engine,
    refine: Engine,
    courses: LaneCourses,
) -> LanePosterior:
    """Run both engines. Raises InputError where a model is none of an intersection with the exact likelihood."""
    if not isinstance(model, Junction) or model.likelihood != "exact":
        raise InputError(
            "engine lanes needs model=junction or junction_real with likelihood exact; it reads their routes"
        )
    seeds = [int(s.generate_state(1)[0]) for s in np.random.SeedSequence(seed).spawn(2)]
    found = structure(model, evidence, seed=seeds[0])
    began = time.perf_counter()
    posterior, course_evidence, routes = refine_lanes(model, evidence, found, refine, courses, seeds[1])
    lines = centre_lines(course_evidence, posterior.estimate)
    left, right = lane_bands(course_evidence, posterior.estimate, posterior.resample(500, seeds[1]), BAND)
    flags = [*found.info.get("flags", []), *posterior.info.get("flags", [])]
    info = found.info | {"lanes": len(lines), "lane_seconds": time.perf_counter() - began, "flags": flags}
    fields = {name: getattr(found, name) for name in found.__dataclass_fields__}
    return LanePosterior(
        **fields | {"info": info},
        lanes=Lanes(lines, left, right, routes),
        first=centre_lines(course_evidence, {}),
        lane_width=float(posterior.estimate.get("lane_width", course_evidence.loc["lane_width"])),
        courses=posterior,
    )


def refine_lanes(
    model: Junction, evidence: JunctionEvidence, found: Posterior, refine: Engine, courses: LaneCourses, seed: int
) -> tuple[Posterior, CourseEvidence, Routes]:
    """From the structure to the courses: their posterior, what it was learnt from, the routes."""
    if evidence.tracks is None:
        raise InputError("lanes need whole tracks, but this evidence was simulated half by half")
    routes = find_routes(model, evidence, found.estimate)
    routed = RoutedTracks(evidence.tracks, whole_structure(model, found), routes)
    course_evidence = courses.prepare(routed)
    merged = merge_routes(course_evidence, routes, courses.spacing)
    if len(merged.connections) < len(routes.connections):
        routes, course_evidence = merged, courses.prepare(routed._replace(routes=merged))
    return refine(courses, course_evidence, seed=seed), course_evidence, routes


def whole_structure(model: Junction, found: Posterior) -> dict[str, NDArray[Any]]:
    """The estimate with the fields of arms that the model holds constant."""
    slots = len(found.estimate["angle"])
    return found.estimate | {name: np.full(slots, value) for name, value in model.constants.items()}
