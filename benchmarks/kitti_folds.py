"""The filter on KITTI's cars, with settings chosen for each sequence from all others: python -m benchmarks.kitti_folds

--quick          3 of the 13 sequences
--json           one JSON object on the standard output and nothing else
--only KEY,KEY   only the measurements that yield these figures

In benchmarks.kitti_tracking what is reported of a sequence is learnt on all others. Here the settings of the filter are
chosen on them, too: from those of the config on, one after the other takes the value of GRID with which least goes
wrong in the other sequences, with the weights and thresholds that these taught (experiments.kitti_folds). A sequence's
labels have no part in what it is judged with, but that all 13 showed where to lay the grid, and which features to read.

The filter runs over all sequences once for each combination that some sequence asks for: minutes."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

from benchmarks import command
from benchmarks.configured import made
from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.kitti_baseline import DATA, PUBLIC, Effort
from benchmarks.kitti_tracking import named


class Settings(NamedTuple):
    """Of the filter: false alarms of the laser's detector [1/m^2], how much of a hidden car goes unseen; and of what
    its scores say (experiments.scenarios.kitti_scans)."""

    clutter_density: float
    occlusion: float
    slope: float
    sharpening: float


GRID: dict[str, tuple[float, ...]] = {
    "clutter_density": (9e-5, 2.7e-4, 8e-4),
    "occlusion": (0.7, 0.9, 1.0),
    "slope": (0.6, 0.85, 1.2),
    "sharpening": (0.1, 0.15, 0.22),
}


class Trial(NamedTuple):
    """What settings come to: for each sequence what all others teach, and what is reported of it by that."""

    lessons: Sequence[Any]
    told: Sequence[Any]


def attempt(model: Any, engine: Callable[..., Any], names: Sequence[str], camera: bool, settings: Settings) -> Trial:
    """The filter with these settings, over all sequences."""
    from experiments.kitti_folds import leave_one_out, report
    from experiments.kitti_metrics import followed

    laser, *others = (replace(sensor, occlusion=settings.occlusion) for sensor in model.sensors)
    traffic = replace(model, sensors=(replace(laser, clutter_density=settings.clutter_density), *others))
    readings = {"camera": camera, "slope": settings.slope, "sharpening": settings.sharpening}
    found = [followed(traffic, engine, name, data_root=DATA, **readings)[1] for name in names]
    lessons = leave_one_out(found)
    return Trial(lessons, [report(some.found, taught) for some, taught in zip(found, lessons, strict=True)])


def choose(
    trial: Callable[[Settings], Trial], i: int, start: Settings, grid: Mapping[str, Sequence[float]] = GRID
) -> Settings:
    """The settings with which least goes wrong in the sequences other than i, one setting after the other."""
    best = start
    for name, values in grid.items():
        tried = [best, *(best._replace(**{name: value}) for value in values)]
        best = min(tried, key=lambda settings: trial(settings).lessons[i].errors)
    return best


def follow(effort: Effort, camera: bool) -> dict[str, Value]:
    """All scores over the sequences."""
    from experiments.kitti_evaluation import evaluate
    from experiments.scenarios.kitti_scans import SHARPENING, SLOPE
    from experiments.scenarios.kitti_tracking import kitti_tracking, sequences
    from inference.progress import Progress

    experiment = "kitti_tracking_camera" if camera else "kitti_tracking"
    model, engine = made([f"experiment={experiment}", "engine.progress=false"], "model", "engine")
    names = sequences(DATA)[: effort.scenes]
    trial = cache(partial(attempt, model, engine, names, camera))
    start = Settings(model.sensors[0].clutter_density, model.sensors[0].occlusion, SLOPE, SHARPENING)
    chosen, told = [], []
    with Progress("choosing settings", len(names), effort.show) as bar:
        for i in range(len(names)):
            chosen.append(choose(trial, i, start))
            told.append(trial(chosen[i]).told[i])
            bar.advance(1)
    scores = evaluate([kitti_tracking(name, DATA) for name in names], told)
    detail = f"{len(names)} sequences; {described(chosen)}"
    return {name: Value(value, detail) for name, value in scores.items()}


def described(chosen: Sequence[Settings]) -> str:
    """How many sequences chose which value of each."""
    each = zip(Settings._fields, zip(*chosen, strict=True), strict=True)
    counted = ((name, sorted(Counter(values).items())) for name, values in each)
    return "; ".join(f"{name} " + ", ".join(f"{value:g} ({n})" for value, n in counts) for name, counts in counted)


def laser(effort: Effort) -> Values:
    """With the detector on laser points alone."""
    return named(LASER, "kitti_folds_", lambda: follow(effort, camera=False))


def both(effort: Effort) -> Values:
    """With the boxes in the camera's image as a second sensor."""
    return named(BOTH, "kitti_folds_", lambda: follow(effort, camera=True))


LASER = Measurement(
    (
        Figure("kitti_folds_mota", "", "MOTA at 3-D IoU .25, all chosen on others", f".803 {PUBLIC}", at_least=0.87),
        Figure("kitti_folds_hota", "", "HOTA of the same", f".680 {PUBLIC}", at_least=0.725),
        Figure("kitti_folds_idf1", "", "IDF1 of the same", f".861 {PUBLIC}", at_least=0.92),
        Figure("kitti_folds_samota", "", "sMOTA averaged over 40 recalls", f".884 {PUBLIC}", at_least=0.92),
        Figure("kitti_folds_ids", "", "switches of track from one frame to the next", f"0 {PUBLIC}", at_most=5),
        Figure("kitti_folds_frag", "", "fragmentations", f"59 {PUBLIC}", at_most=60),
    ),
    laser,
)
BOTH = Measurement(
    (
        Figure("kitti_folds_mota_camera", "", "MOTA with boxes of the camera", "", at_least=0.91),
        Figure("kitti_folds_hota_camera", "", "HOTA of the same", "", at_least=0.74),
        Figure("kitti_folds_idf1_camera", "", "IDF1 of the same", "", at_least=0.935),
        Figure("kitti_folds_ids_camera", "", "switches of track from one frame to the next"),
        Figure("kitti_folds_frag_camera", "", "fragmentations"),
    ),
    both,
)

MEASUREMENTS = (LASER, BOTH)


def main(words: list[str] | None = None, effort: Effort | None = None) -> int:
    """The command; `effort` replaces both --quick and the full one. Returns the exit code."""
    title = "The filter on KITTI's cars, settings chosen on the other sequences"
    whole = command.Benchmark(
        "benchmarks.kitti_folds", title, lambda: MEASUREMENTS, lambda: (Effort(), Effort(scenes=3))
    )
    return command.main(whole, words, effort)


if __name__ == "__main__":
    sys.exit(main())
