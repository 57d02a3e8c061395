"""What labels teach of KITTI's cars, and to judge by it a sequence that did not teach it.

Learnt are the weights of calibrated existence (experiments.kitti_existence) and the two thresholds of reporting, those
of a small grid at which least goes wrong in what taught the weights:

    missed + false + switches + fragmentations,  each counted once (experiments.kitti_evaluation)

The same number, of the sequences that teach, chooses between settings of a filter (benchmarks.kitti_folds). Settings,
weights and thresholds with which a sequence is judged owe nothing to its labels so."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.kitti_evaluation import count
from experiments.kitti_existence import Calibration, Candidates, fit, told
from experiments.kitti_matching import Compared, TrackBoxes, compare, match
from experiments.scenarios.kitti_scans import KittiTruth

Bools = NDArray[np.bool_]

ON, OFF = (0.5, 0.6, 0.7), (0.3, 0.4, 0.5)


class Labelled(NamedTuple):
    """Candidates beside the labels of their sequence.

    found
    compared   all of them
    confirmed  (R,) by a label, by the rules of experiments.kitti_matching
    teaches    (R,) those rules leave it not out, and it is in the image
    """

    found: Candidates
    compared: Compared
    confirmed: Bools
    teaches: Bools


class Lesson(NamedTuple):
    """What some sequences teach: the calibration, when to begin and to end reporting, and what goes wrong in them."""

    calibration: Calibration
    on: float
    off: float
    errors: int


def label(truth: KittiTruth, found: Candidates) -> Labelled:
    """Which candidates the labels confirm."""
    compared = compare(truth.sequence, truth.labels, found.boxes)
    pair = match(compared, np.ones(len(compared.track), dtype=bool))
    paired = np.flatnonzero(pair >= 0)
    confirmed, counts = np.zeros(len(compared.track), dtype=bool), ~compared.small
    box = compared.pairs[pair[paired], 1]
    confirmed[box], counts[box] = True, ~compared.left_out[paired]
    return Labelled(found, compared, confirmed, counts & found.shown)


def learn(sequences: Sequence[Labelled]) -> Lesson:
    """The lesson of several sequences. Raises InputError where labels confirm all rows, or none."""
    calibration = fit(
        np.concatenate([some.found.features[some.teaches] for some in sequences]),
        np.concatenate([some.confirmed[some.teaches] for some in sequences]),
    )
    p = [calibration.probability(some.found.features) for some in sequences]
    lessons = [
        Lesson(calibration, on, off, sum(errors(*one, on=on, off=off) for one in zip(sequences, p, strict=True)))
        for on in ON
        for off in OFF
    ]
    return min(lessons, key=lambda lesson: lesson.errors)


def errors(some: Labelled, p: NDArray[np.float64], *, on: float, off: float) -> int:
    """What goes wrong in a sequence whose candidates are cars with probabilities p (R,)."""
    counts = count(some.compared, told(some.found.boxes.track, p, on=on, off=off) & some.found.shown)
    return counts.missed + counts.false + counts.switches + counts.fragmentations


def report(found: Candidates, lesson: Lesson) -> TrackBoxes:
    """What is told of where it is in the image; scores are p."""
    p = lesson.calibration.probability(found.features)
    rows = told(found.boxes.track, p, on=lesson.on, off=lesson.off) & found.shown
    offset = np.concatenate([[0], np.cumsum(rows)])[found.boxes.offset]
    return TrackBoxes(offset, found.boxes.track[rows], found.boxes.box[rows], p[rows])


def leave_one_out(sequences: Sequence[Labelled]) -> list[Lesson]:
    """What all the others teach, for each sequence."""
    return [learn([*sequences[:i], *sequences[i + 1 :]]) for i in range(len(sequences))]
