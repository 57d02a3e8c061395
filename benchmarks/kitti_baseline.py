"""A baseline on KITTI's cars, a Kalman filter a car and nearest neighbours: python -m benchmarks.kitti_baseline

--quick          3 of the 13 sequences
--json           one JSON object on the standard output and nothing else
--only KEY,KEY   only the measurements that yield these figures"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

from benchmarks import command
from benchmarks.figure import Figure, Measurement, Value, Values
from experiments.scenarios.junction import DATA_ROOT
from models.program import InputError

DATA = str(Path(__file__).resolve().parents[1] / DATA_ROOT)
PUBLIC = "AB3DMOT on the same sequences"


class Effort(NamedTuple):
    """How many sequences, the first of them, and whether to show progress."""

    scenes: int = 13
    show: bool = False


def baseline(effort: Effort) -> Values:
    """The baseline, with the threshold of track scores that is best on the labels, as AB3DMOT's figures have it."""
    from experiments.kitti_baseline import track
    from experiments.kitti_evaluation import best_threshold, compare_all, evaluate
    from experiments.scenarios.kitti_tracking import kitti_tracking, sequences
    from inference.progress import Progress

    try:
        scenes = [kitti_tracking(name, DATA) for name in sequences(DATA)[: effort.scenes]]
    except InputError as absent:
        return {f.key: Value(None, f"skipped: {absent}") for f in BASELINE.figures}
    tracks = []
    with Progress("baseline", len(scenes), effort.show) as bar:
        for scene in scenes:
            tracks.append(track(scene.data))
            bar.advance(1)
    threshold = best_threshold(compare_all(scenes, tracks))
    best, free = evaluate(scenes, tracks, threshold=threshold), evaluate(scenes, tracks, average=False)
    found = {
        key: Value(best[key], f"{len(scenes)} sequences; {free[key]:.4g} without the threshold of {threshold:.3g}")
        for key in ("mota", "hota", "idf1", "ids", "frag")
    }
    found["samota"] = Value(best["samota"], f"{len(scenes)} sequences, over all thresholds")
    return {f"kitti_baseline_{key}": value for key, value in found.items()}


BASELINE = Measurement(
    (
        Figure("kitti_baseline_mota", "", "MOTA at 3-D IoU .25, threshold chosen on the labels", f".803 {PUBLIC}"),
        Figure("kitti_baseline_hota", "", "HOTA of the same", f".680 {PUBLIC}"),
        Figure("kitti_baseline_idf1", "", "IDF1 of the same", f".861 {PUBLIC}"),
        Figure("kitti_baseline_ids", "", "switches of track from one frame to the next", f"0 {PUBLIC}"),
        Figure("kitti_baseline_frag", "", "fragmentations", f"59 {PUBLIC}"),
        Figure("kitti_baseline_samota", "", "sMOTA averaged over 40 recalls", f".884 {PUBLIC}"),
    ),
    baseline,
)

MEASUREMENTS = (BASELINE,)


def main(words: list[str] | None = None, effort: Effort | None = None) -> int:
    """The command; `effort` replaces both --quick and the full one. Returns the exit code."""
    title = "A baseline on KITTI's cars"
    whole = command.Benchmark(
        "benchmarks.kitti_baseline", title, lambda: MEASUREMENTS, lambda: (Effort(), Effort(scenes=3))
    )
    return command.main(whole, words, effort)


if __name__ == "__main__":
    sys.exit(main())
