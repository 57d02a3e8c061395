"""How far estimated centre lines are from the true ones, and how long it takes to find them."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterable
from functools import lru_cache, partial
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

import numpy as np

from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.junction import DEFAULT, Effort, Setting, attempt, configured, configured_engine
from benchmarks.junction_structure import DATA, with_steps
from benchmarks.lane_bound import lane_bound
from benchmarks.lane_papers import m19_refine, m20_refine
from experiments.junction_metrics import structure
from experiments.lane_metrics import COST, band_coverage, lane_error
from experiments.lane_posterior import Lanes
from experiments.lanes import BAND, refine_lanes, whole_structure, with_lanes
from experiments.scenarios.junction import junction, names
from experiments.scenarios.protocol import protocol
from experiments.scenarios.scene import Scene
from inference import least_squares
from inference.posterior import Posterior
from inference.progress import Progress
from models.intersection.course_evidence import CourseEvidence
from models.intersection.course_lines import centre_lines, lane_bands
from models.intersection.courses import LaneCourses
from models.intersection.routes import RoutedTracks, Routes
from models.program import InputError

HEADING_STD = 0.1  # [rad]
SAMPLED = 70_000  # steps of the chains whose draws make bands: 400 draws after the annealing


class LaneSetting(NamedTuple):
    """How the structure is found, and how lanes are refined."""

    structure: Setting
    courses: LaneCourses
    knobs: dict[str, Any]


class LaneTrial(NamedTuple):
    """One scene; times [s] from the tracks to the structure, and on to the centre lines."""

    lanes: Lanes
    found: Posterior
    structure: float
    refine: float


def lane_setting(engine: str, structure: Setting) -> LaneSetting:
    """The config engine=ENGINE, in as many steps as a benchmark has time for."""
    from hydra import compose, initialize_config_module
    from hydra.utils import instantiate

    with initialize_config_module("configs", version_base="1.3"):
        config = compose("run", [f"engine={engine}"]).engine
    knobs = {"num_steps": 12, "tolerance": 1.0, "learn": tuple(config.refine.learn), "num_draws": 1}
    return LaneSetting(structure, instantiate(config.courses), knobs)


@lru_cache
def default() -> LaneSetting:
    """Structure as structure_5000, lanes as engine=lanes."""
    return lane_setting("lanes", DEFAULT)


def refine(setting: LaneSetting, scene: Scene, seed: int) -> LaneTrial:
    """Structure and lanes of one scene, without bands. Raises InputError where the tracks are refused."""
    trial = attempt(setting.structure, scene.data, seed)
    evidence = setting.structure.model.prepare(scene.data)
    began = time.perf_counter()
    posterior, course, routes = course_posterior(setting, evidence, trial.posterior, seed)
    lines = centre_lines(course, posterior.estimate)
    seconds = time.perf_counter() - began
    left, right = lane_bands(course, posterior.estimate, posterior.resample(max(posterior.shape), seed), BAND)
    return LaneTrial(Lanes(lines, left, right, routes), trial.posterior, trial.total, seconds)


def course_posterior(
    setting: LaneSetting, evidence: Any, found: Posterior, seed: int
) -> tuple[Posterior, CourseEvidence, Routes]:
    engine = partial(least_squares.run, **setting.knobs)
    return refine_lanes(setting.structure.model, evidence, found, engine, setting.courses, seed)


class LaneScores(NamedTuple):
    """Lane errors [cm] of scenes; those of a refused one count as if all its lanes were missed."""

    errors: list[float]
    trials: list[LaneTrial]
    refused: int

    @property
    def value(self) -> Value:
        spread = float(np.std(self.errors) / math.sqrt(len(self.errors)))
        detail = f"n = {len(self.errors)}, s.e. {spread:.2f}, median {median(self.errors):.2f}"
        return Value(fmean(self.errors), detail + (f", {self.refused} refused" if self.refused else ""))


def score(setting: LaneSetting, scenes: Iterable[Scene], what: str, total: int, show: bool) -> LaneScores:
    out = LaneScores([], [], 0)
    with Progress(what, total, show) as bar:
        for seed, scene in enumerate(scenes):
            try:
                trial = refine(setting, scene, seed)
            except InputError:
                out.errors.append(100.0 * COST)
                out = out._replace(refused=out.refused + 1)
            else:
                out.errors.append(lane_error(trial.lanes.lines, scene.truth)["lane_error_cm"])
                out.trials.append(trial)
            bar.advance(1)
    return out


def on_protocol(setting: LaneSetting, num: int, what: str, show: bool, **options: Any) -> LaneScores:
    """The frozen scenes 0 .. num - 1, after an untimed one."""
    refine(setting, protocol(0, **options), 0)
    return score(setting, (protocol(i, **options) for i in range(num)), what, num, show)


def main_lanes(effort: Effort) -> Values:
    scores = on_protocol(default(), effort.scenes, "lane_cm_5000", effort.show)
    times = {
        "ms_total_5000": [t.structure + t.refine for t in scores.trials],
        "ms_refine": [t.refine for t in scores.trials],
    }
    medians = {key: Value(1e3 * median(seconds), f"n = {len(seconds)}") for key, seconds in times.items()}
    return {"lane_cm_5000": scores.value} | medians


def variant(key: str, definition: str, at_most: float, structure: Setting = DEFAULT, **options: Any) -> Measurement:
    """A lane error on the protocol."""

    def measure(effort: Effort) -> Values:
        setting = default()._replace(structure=structure)
        return {key: on_protocol(setting, effort.scenes // 2, key, effort.show, **options).value}

    return Measurement((Figure(key, "cm", definition, at_most=at_most),), measure)


def bounds(effort: Effort) -> Values:
    truths = [protocol(i).truth for i in range(effort.few)]
    found = {"crlb_cm": None, "crlb_heading_cm": HEADING_STD}
    return {
        k: Value(100.0 * fmean(lane_bound(t, std) for t in truths), f"n = {len(truths)}") for k, std in found.items()
    }


def papers(effort: Effort) -> Values:
    """The papers' refinements on our structure and routes."""
    lanes: dict[str, list[tuple[float, float]]] = {"m20": [], "m19": []}
    with Progress("m20_lane_cm", effort.few, effort.show) as bar:
        for seed in range(effort.few):
            scene = protocol(seed)
            trial = refine(default(), scene, seed)
            structure = whole_structure(default().structure.model, trial.found.estimate)
            routed = RoutedTracks(scene.data, structure, trial.lanes.routes)
            for name, result in (("m20", m20_refine(routed)), ("m19", m19_refine(routed, seed))):
                lanes[name].append((lane_error(result[0], scene.truth)["lane_error_cm"], result[1]))
            bar.advance(1)
    values = {}
    for name, pairs in lanes.items():
        errors, seconds = zip(*pairs[1:], strict=True)  # the first scene compiles
        values[f"{name}_lane_cm"] = Value(fmean(errors), f"n = {len(errors)}, median {median(errors):.1f}")
        values[f"{name}_ms"] = Value(1e3 * median(seconds), f"n = {len(seconds)}")
    return values


def real(effort: Effort) -> Values:
    """Vehicles simulated on the junctions marked clean."""
    keys = ("real_lane_cm", "real_lane_cm_heading", "real_lane_cm_each", "real_ms")
    if not Path(DATA).exists():
        return {key: Value(None, "the data folder is absent") for key in keys}
    on_real = DEFAULT._replace(model=configured("junction_real"))
    setting, clean = lane_setting("lanes_real", on_real), names("clean", DATA)
    each: dict[str, float] = {}
    trials: list[LaneTrial] = []
    errors: dict[float | None, list[float]] = {None: [], HEADING_STD: []}
    refine(setting, junction(clean[0], 0, data_root=DATA), 0)
    for std, found in errors.items():
        for name in clean:
            scenes = (junction(name, seed, heading_std=std, data_root=DATA) for seed in range(effort.real_seeds))
            scores = score(setting, scenes, name, effort.real_seeds, effort.show)
            found += scores.errors
            if std is None:
                each[name] = fmean(scores.errors)
                trials += scores.trials
    for name in sorted(set(names(None, DATA)) - set(clean)):
        scenes = (junction(name, seed, data_root=DATA) for seed in range(effort.real_seeds))
        each[f"({name})"] = fmean(score(setting, scenes, name, effort.real_seeds, effort.show).errors)
    detail = f"{len(clean)} junctions, {effort.real_seeds} seeds each"
    return {
        "real_lane_cm": Value(fmean(errors[None]), f"{detail}, median {median(errors[None]):.1f}"),
        "real_lane_cm_heading": Value(
            fmean(errors[HEADING_STD]), f"{detail}, median {median(errors[HEADING_STD]):.1f}"
        ),
        "real_lane_cm_each": Value(each, f"{effort.real_seeds} seeds each"),
        "real_ms": Value(1e3 * median(t.refine for t in trials), f"n = {len(trials)}"),
    }


def coverage(effort: Effort) -> Values:
    """How often the true lines run inside the bands, those given the best structure and those over all readings."""
    setting, sampler = default(), configured_engine("rjmcmc_structure")
    engine = partial(least_squares.run, **setting.knobs | {"num_steps": 30, "tolerance": 1e-3, "num_draws": 1000})
    given, every = [], []
    with Progress("band_coverage_90", effort.few, effort.show) as bar:
        for seed in range(effort.few):
            scene = protocol(seed)
            model = setting.structure.model
            evidence = model.prepare(scene.data)
            found = sampler(model, evidence, seed=seed, num_steps=SAMPLED)
            estimate = with_lanes(model, evidence, found, engine, setting.courses, seed)
            assert estimate.lanes is not None
            every.append(band_coverage(estimate.lanes, scene.truth))
            if structure(found.estimate, scene.truth)["structure_right"] == 1.0:
                posterior, course, routes = refine_lanes(model, evidence, found, engine, setting.courses, seed)
                left, right = lane_bands(course, posterior.estimate, posterior.resample(1000, seed), BAND)
                alone = Lanes(estimate.lanes.lines, left, right, routes)
                given.append(band_coverage(alone, scene.truth))
            bar.advance(1)
    return {
        "band_coverage_90_given": Value(fmean(given), f"n = {len(given)}"),
        "band_coverage_90": Value(fmean(every), f"n = {len(every)}"),
    }


def lanelets(effort: Effort) -> Values:
    """Routes of exported maps, found by the lanelet2 library."""
    try:
        import lanelet2  # noqa: F401
    except ImportError:
        return {
            "lanelet_routes_ok": Value(None, "install the extra `maps`: pip install -c constraints.txt -e '.[maps]'")
        }
    from experiments.lanelet_osm import routes_ok, write_osm
    from experiments.lanelets import lanelet_map

    found = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(effort.few):
            trial = refine(default(), protocol(seed), seed)
            exported = lanelet_map(trial.lanes.lines, trial.lanes.routes.connections)
            path = Path(folder) / f"{seed}.osm"
            write_osm(path, exported)
            found.append(routes_ok(exported, path))
    return {"lanelet_routes_ok": Value(fmean(found), f"n = {len(found)}")}


ERROR = (
    "mean distance from the true centre lines to the matched estimated ones, a missed or phantom lane costing 2.7 m, "
    "over all protocol scenes"
)
MEASUREMENTS = (
    Measurement(
        (
            Figure("lane_cm_5000", "cm", f"{ERROR}, positions only, structure as structure_5000", "7", at_most=4.7),
            Figure(
                "ms_total_5000", "ms", "wall time from tracks to centre lines, same runs, median", "96", at_most=18.0
            ),
            Figure("ms_refine", "ms", "of it: routes and refinement", "47", at_most=6.0),
        ),
        main_lanes,
    ),
    variant(
        "lane_cm_10000",
        "as lane_cm_5000 on half the scenes, structure as structure_10000",
        4.7,
        with_steps(DEFAULT, 10000),
    ),
    variant(
        "lane_cm_heading_5000",
        "as lane_cm_5000 on half the scenes, headings measured with sd .1 rad",
        4.1,
        heading_std=HEADING_STD,
    ),
    variant(
        "lane_cm_mismatch",
        "as lane_cm_5000 on half the scenes, interiors clothoid-arc-clothoid with bumps of sd .4 m",
        6.2,
        interior="bumps",
    ),
    variant(
        "lane_cm_mismatch_heading",
        "the same, headings measured with sd .1 rad",
        5.0,
        interior="bumps",
        heading_std=HEADING_STD,
    ),
    Measurement(
        (
            Figure("crlb_cm", "cm", "bound of Cramer-Rao type for lane_cm_5000: structure and family known"),
            Figure("crlb_heading_cm", "cm", "the same for lane_cm_heading_5000"),
        ),
        bounds,
    ),
    Measurement(
        (
            Figure("m20_lane_cm", "cm", "[M20]'s B-splines with e1 and e2 on our structure and routes", "7"),
            Figure("m20_ms", "ms", "of it: the refinement, median", "47"),
            Figure("m19_lane_cm", "cm", "[M19]'s sampled polylines on our structure and routes", "15"),
            Figure("m19_ms", "ms", "of it: the chain, median", "140"),
        ),
        papers,
    ),
    Measurement(
        (
            Figure("real_lane_cm", "cm", "as lane_cm_5000 on the 15 real junctions marked clean", "10", at_most=10.5),
            Figure("real_lane_cm_heading", "cm", "the same, headings measured with sd .1 rad", at_most=9.0),
            Figure(
                "real_lane_cm_each",
                "cm",
                "real_lane_cm junction by junction; in brackets those that are not marked clean",
            ),
            Figure("real_ms", "ms", "routes and refinement, positions only, median", "34", at_most=40.0),
        ),
        real,
    ),
    Measurement(
        (
            Figure(
                "band_coverage_90_given",
                "share",
                "of the lanes' nodes whose true place is inside the 90 % band given the best structure, where that is "
                "right",
            ),
            Figure(
                "band_coverage_90",
                "share",
                "the same of the bands over all structures and routes among the draws, in all scenes; chains of "
                f"{SAMPLED} steps, else as engine=lanes",
            ),
        ),
        coverage,
    ),
    Measurement(
        (Figure("lanelet_routes_ok", "share", "of the routes of exported maps that lanelet2 finds", at_least=1.0),),
        lanelets,
    ),
)
