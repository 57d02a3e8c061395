"""How the thresholds of routes act on real junctions that are not marked clean: python -m benchmarks.lane_thresholds

    --clean     on the junctions marked clean instead: to report, not to choose by
    --seeds 8   drives on every junction instead of 3

Each threshold takes some other values, all others as they are. Vehicles are simulated; structure and lanes are
estimated as for `real_lane_cm` (python -m benchmarks.intersection). The last column compares scene by scene: a value
is better where its lane error is lower by more than twice the standard error, and by more than drives vary."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.junction import DEFAULT, attempt, configured
from benchmarks.junction_lanes import LaneSetting, lane_setting
from benchmarks.junction_structure import DATA
from benchmarks.timing import single_thread
from experiments.lane_metrics import lane_error
from experiments.lanes import refine_routes
from experiments.scenarios.junction import junction, names
from experiments.scenarios.scene import Scene
from inference import least_squares
from inference.progress import Progress
from models.intersection.course_family import centre_lines
from models.intersection.routes import ROUTING, Routing, find_routes
from models.program import InputError

GRID: dict[str, tuple[float, ...]] = {
    "reluctance": (1.0, 20.0, 150.0),
    "close": (2.0, 3.0, 6.0),
    "along": (0.45, 1.3),
    "same": (0.8, 1.1, 1.6, 2.0),
    "window": (12.0, 18.0, 36.0),
}


class Found(NamedTuple):
    """A scene, what its structure was learnt from, and the structure."""

    scene: Scene
    evidence: Any
    state: dict[str, Any]


def structures(setting: LaneSetting, places: list[str], seeds: int, show: bool) -> list[Found]:
    """The structure of every scene, which no threshold of routes changes."""
    out = []
    with Progress("structures", len(places) * seeds, show) as bar:
        for name in places:
            for seed in range(seeds):
                scene = junction(name, seed, data_root=DATA)
                posterior = attempt(setting.structure, scene.data, seed).posterior
                out.append(Found(scene, setting.structure.model.prepare(scene.data), posterior.estimate))
                bar.advance(1)
    return out


def scores_of(setting: LaneSetting, found: list[Found], routing: Routing) -> NDArray[np.float64]:
    """Missed lanes, phantoms and lane error [cm] of every scene under these thresholds, (S, 3).

    Where no track is on a route all lanes are missed."""
    model, scores = setting.structure.model, []
    engine = partial(least_squares.run, **setting.knobs)
    for seed, (scene, evidence, state) in enumerate(found):
        routes, lines = find_routes(model, evidence, state, routing), []
        try:
            refined = refine_routes(model, evidence, state, routes, engine, setting.courses, seed, routing)
            lines = centre_lines(refined[1], refined[0].estimate)
        except InputError:
            pass
        score = lane_error(lines, scene.truth)
        scores.append([score[key] for key in ("lanes_missed", "lanes_phantom", "lane_error_cm")])
    return np.array(scores)


def main(words: list[str] | None = None) -> int:
    """The command; 2 where the data folder is absent."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.lane_thresholds", description="Thresholds of routes on real junctions."
    )
    parser.add_argument("--clean", action="store_true", help="on the junctions marked clean instead")
    parser.add_argument("--seeds", type=int, default=3, help="drives on every junction")
    options = parser.parse_args(words)
    single_thread()
    try:
        clean = names("clean", DATA)
        places = clean if options.clean else sorted(set(names(None, DATA)) - set(clean))
    except InputError as mistake:
        print(mistake, file=sys.stderr)
        return 2
    setting = lane_setting("lanes_real", DEFAULT._replace(model=configured("junction_real")))
    found = structures(setting, places, options.seeds, sys.stderr.isatty())
    print(f"{len(places)} junctions, {options.seeds} drives on each; means over drives")
    print(f"{'':16s}{'missed':>8s}{'phantom':>9s}{'error [cm]':>12s}{'against as they are [cm]':>30s}")
    first = scores_of(setting, found, ROUTING)
    print(f"{'as they are':16s}" + "{:8.2f}{:9.2f}{:12.2f}".format(*first.mean(0)), flush=True)
    for name, values in GRID.items():
        for value in values:
            scores = scores_of(setting, found, replace(ROUTING, **{name: value}))
            apart = scores[:, 2] - first[:, 2]
            row = "{:8.2f}{:9.2f}{:12.2f}".format(*scores.mean(0))
            spread = apart.std() / len(apart) ** 0.5
            print(f"{name + f' {value:g}':16s}{row}{apart.mean():+20.2f} +- {spread:.2f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
