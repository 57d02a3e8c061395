"""Lanes from recorded vehicles, scored against drawn maps and by vehicles held out, and the same on simulated ones."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np

from benchmarks.configured import made
from benchmarks.figure import Figure, Measurement, Value, Values, share
from benchmarks.junction import Effort
from benchmarks.junction_structure import DATA
from experiments import held_out, traffic_metrics
from experiments.lane_metrics import COST, lane_error
from experiments.scenarios import traffic as recordings
from experiments.scenarios.junction import junction, names
from experiments.scenarios.scene import Scene
from experiments.traffic_lanes import TrafficPosterior
from inference.progress import Progress
from models.program import InputError

RECORDING = "lankershim_2"
SEEDS = 2  # simulated drives on every junction, at most
ABSENT = "the data folder is absent"


@lru_cache
def configured() -> tuple[Any, Callable[..., TrafficPosterior]]:
    """The model and the engine of experiment=lankershim_lanes."""
    return made(["experiment=lankershim_lanes"], "model", "engine")  # type: ignore[return-value]


def lanes(scene: Scene) -> TrafficPosterior:
    """Lanes of one scene. Raises InputError where there is none."""
    model, engine = configured()
    return engine(model, model.prepare(scene.data), seed=0)


def recorded(effort: Effort) -> Values:
    """The main recording."""
    if not (Path(DATA) / "trajectories").exists():
        return {figure.key: Value(None, ABSENT) for figure in RECORDED}
    scene = recordings.traffic(RECORDING, DATA)
    found = lanes(scene)
    began = time.perf_counter()
    assert found.lanes is not None and found.again is not None
    lanes(scene)
    seconds = time.perf_counter() - began
    used = f"{found.info['tracks_on_lanes']} of {found.info['tracks']} tracks on {found.info['lanes']} lanes"
    scores = {key: Value(value, used) for key, value in traffic_metrics.metrics(found, scene).items()}
    nats = held_out.scores(found.again, scene.data, held_out.FOLDS)
    points, vehicles = len(scene.data.points), nats.shape[1]
    gain = f"{held_out.FOLDS} folds of {vehicles} vehicles"
    error = math.sqrt(vehicles) * float((nats[0] - nats[1]).std()) / points
    together, alone = (Value(float(each.sum()) / points, gain) for each in nats)
    together = together._replace(detail=f"{gain}, s.e. of the difference {error:.4f}")
    return scores | {"traffic_nll": together, "traffic_nll_splines": alone, "traffic_s": Value(seconds, used)}


def every(effort: Effort) -> Values:
    """The median distance on all recordings."""
    if not (Path(DATA) / "trajectories").exists():
        return {"traffic_m_each": Value(None, ABSENT)}
    each: dict[str, float] = {}
    tracks, none = [], []
    for name in recordings.names(DATA):
        scene = recordings.traffic(name, DATA)
        try:
            each[name] = traffic_metrics.metrics(lanes(scene), scene)["traffic_m"]
        except InputError:
            none.append(name)
        tracks.append(f"{name} {len(scene.data.offsets) - 1}")
    return {"traffic_m_each": Value(each, f"tracks: {', '.join(tracks)}; no lane: {', '.join(none) or 'none'}")}


def simulated(effort: Effort) -> Values:
    """Vehicles simulated on real lanes, where the truth is known; junctions not marked clean chose no threshold."""
    keys = ("traffic_lanes_right", "traffic_sim_cm", "traffic_sim_cm_clean")
    if not (Path(DATA) / "intersections").exists():
        return {key: Value(None, ABSENT) for key in keys}
    clean, every_one = names("clean", DATA), names(None, DATA)
    seeds = min(SEEDS, effort.real_seeds)
    errors: dict[bool, list[float]] = {True: [], False: []}
    right: list[float] = []
    with Progress("traffic_sim_cm", len(every_one) * seeds, effort.show) as bar:
        for name in every_one:
            for seed in range(seeds):
                scene = junction(name, seed, data_root=DATA)
                error = _lane_error(scene)
                errors[name in clean].append(error["lane_error_cm"])
                right += [] if name in clean else [float(error["lanes_missed"] + error["lanes_phantom"] == 0)]
                bar.advance(1)
    detail = {kind: f"n = {len(each)}, median {median(each):.1f}" for kind, each in errors.items()}
    return {
        "traffic_lanes_right": share(right),
        "traffic_sim_cm": Value(fmean(errors[False]), detail[False]),
        "traffic_sim_cm_clean": Value(fmean(errors[True]), detail[True]),
    }


def _lane_error(scene: Scene) -> dict[str, float]:
    try:
        found = lanes(scene).lanes
    except InputError:
        return {"lane_error_cm": 100.0 * COST, "lanes_missed": float(len(np.unique(scene.truth.track_lane))),
                "lanes_phantom": 0.0}  # fmt: skip
    assert found is not None
    return lane_error(found.lines, scene.truth)


WHERE = f"recording {RECORDING}"
RECORDED = (
    Figure("traffic_m", "m", f"{WHERE}: median distance of the lanes' points to the nearest map lane", at_most=0.2),
    Figure("traffic_p90_m", "m", "the 90 % quantile of the same distances", at_most=0.75),
    Figure("traffic_precision_1m", "share", "of these points within 1 m of a map lane", at_least=0.95),
    Figure("traffic_arms_precision_1m", "share", "the same outside the crossing area", at_least=0.95),
    Figure("traffic_recall_driven", "share", "of the map lanes that two vehicles drove that are found", at_least=0.75),
    Figure("traffic_raw_m", "m", "median distance of the points of the tracks to the nearest map lane"),
    Figure("traffic_raw_p90_m", "m", "the 90 % quantile of the same distances"),
    Figure("traffic_nll", "nats", f"{WHERE}: minus the log density of a point of unseen vehicles"),
    Figure("traffic_nll_splines", "nats", "the same of independent splines of 20 controls, on the same routes"),
    Figure("traffic_s", "s", "from tracks to lanes with bands, warm"),
)
MEASUREMENTS = (
    Measurement(RECORDED, recorded),
    Measurement(
        (Figure("traffic_m_each", "m", "traffic_m of every recording where lanes are found"),),
        every,
    ),
    Measurement(
        (
            Figure(
                "traffic_lanes_right",
                "share",
                "of simulated drives on the nine junctions not marked clean where no lane is missed and none a phantom",
                at_least=0.95,
            ),
            Figure(
                "traffic_sim_cm", "cm", "lane error of the same drives, lanes found from tracks alone", at_most=15.0
            ),
            Figure("traffic_sim_cm_clean", "cm", "the same on the 15 junctions marked clean"),
        ),
        simulated,
    ),
)
