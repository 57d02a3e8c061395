"""The filter on KITTI's cars, with and without boxes in the camera's image: python -m benchmarks.kitti_tracking

--quick          3 of the 13 sequences
--json           one JSON object on the standard output and nothing else
--only KEY,KEY   only the measurements that yield these figures

Causal; the weights of the calibrated existence and the thresholds of reporting are learnt leaving each sequence out.
Settings of the filter are those of the config, chosen by the pooled scores of these 13 sequences, as the features are;
benchmarks.kitti_folds leaves the reported sequence out of the choice of settings, too."""

from __future__ import annotations

import sys
from collections.abc import Callable

from benchmarks import command
from benchmarks.configured import made
from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.kitti_baseline import DATA, PUBLIC, Effort
from models.program import InputError


def follow(effort: Effort, camera: bool) -> dict[str, Value]:
    """All scores, and the time of a frame, over the sequences."""
    import numpy as np

    from experiments.kitti_evaluation import evaluate
    from experiments.kitti_folds import leave_one_out, report
    from experiments.kitti_metrics import followed, frame_seconds, scene_of
    from experiments.scenarios.kitti_tracking import sequences
    from inference.progress import Progress

    experiment = "kitti_tracking_camera" if camera else "kitti_tracking"
    model, engine = made([f"experiment={experiment}", "engine.progress=false"], "model", "engine")
    names = sequences(DATA)[: effort.scenes]
    followed(model, engine, names[0], camera=camera, data_root=DATA)  # machine code is made here, unmeasured
    truths, found, seconds = [], [], []
    with Progress("tracking", len(names), effort.show) as bar:
        for name in names:
            truth, some, tracks = followed(model, engine, name, camera=camera, data_root=DATA)
            truths.append(truth)
            found.append(some)
            seconds.append(frame_seconds(tracks))
            bar.advance(1)
    lessons = leave_one_out(found)
    told = [report(some.found, lesson) for some, lesson in zip(found, lessons, strict=True)]
    scores = evaluate([scene_of(truth) for truth in truths], told)
    detail = f"{len(names)} sequences, what is reported of each learnt on the others"
    ms = 1e3 * np.concatenate(seconds)
    return {name: Value(value, detail) for name, value in scores.items()} | {
        "ms_per_frame": Value(float(np.median(ms)), f"mean {ms.mean():.2f}, 99 % {np.percentile(ms, 99):.2f}")
    }


def laser(effort: Effort) -> Values:
    """With the detector on laser points alone."""
    return named(LASER, "kitti_", lambda: follow(effort, camera=False))


def both(effort: Effort) -> Values:
    """With the boxes in the camera's image as a second sensor."""
    return named(BOTH, "kitti_", lambda: follow(effort, camera=True))


def named(measurement: Measurement, prefix: str, work: Callable[[], dict[str, Value]]) -> Values:
    """Scores by the keys of a measurement, which begin with `prefix`; none of them where the data is absent."""
    keys = [figure.key for figure in measurement.figures]
    try:
        found = work()
    except InputError as absent:
        return {key: Value(None, f"skipped: {absent}") for key in keys}
    return {key: found[key.removeprefix(prefix).removesuffix("_camera")] for key in keys}


LASER = Measurement(
    (
        Figure("kitti_mota", "", "MOTA at 3-D IoU .25", f".803 {PUBLIC}", at_least=0.87),
        Figure("kitti_hota", "", "HOTA of the same", f".680 {PUBLIC}", at_least=0.725),
        Figure("kitti_idf1", "", "IDF1 of the same", f".861 {PUBLIC}", at_least=0.92),
        Figure("kitti_samota", "", "sMOTA averaged over 40 recalls", f".884 {PUBLIC}", at_least=0.92),
        Figure("kitti_ids", "", "switches of track from one frame to the next", f"0 {PUBLIC}", at_most=5),
        Figure("kitti_frag", "", "fragmentations", f"59 {PUBLIC}", at_most=60),
        Figure(
            "kitti_ms_per_frame", "ms", "median time of the filter, all scans of a frame", "17 AB3DMOT", at_most=1.0
        ),
    ),
    laser,
)
BOTH = Measurement(
    (
        Figure("kitti_mota_camera", "", "MOTA with boxes of the camera", "", at_least=0.91),
        Figure("kitti_hota_camera", "", "HOTA of the same", "", at_least=0.74),
        Figure("kitti_idf1_camera", "", "IDF1 of the same", "", at_least=0.935),
        Figure("kitti_ids_camera", "", "switches of track from one frame to the next"),
        Figure("kitti_frag_camera", "", "fragmentations"),
        Figure("kitti_ms_per_frame_camera", "ms", "median time of the filter, both scans of a frame"),
    ),
    both,
)

MEASUREMENTS = (LASER, BOTH)


def main(words: list[str] | None = None, effort: Effort | None = None) -> int:
    """The command; `effort` replaces both --quick and the full one. Returns the exit code."""
    title = "The filter on KITTI's cars"
    whole = command.Benchmark(
        "benchmarks.kitti_tracking", title, lambda: MEASUREMENTS, lambda: (Effort(), Effort(scenes=3))
    )
    return command.main(whole, words, effort)


if __name__ == "__main__":
    sys.exit(main())
