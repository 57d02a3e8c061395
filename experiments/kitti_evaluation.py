"""How well a tracker follows KITTI's cars: CLEAR and its average over recall, HOTA and IDF1, on the IoU of 3-D boxes.

CLEAR is counted as the public AB3DMOT evaluation does, pooled over sequences (Weng et al. 2020; pairs and what does not
count: experiments.kitti_matching). With n the labels that count, pairs with labels that do not among the tp,

    MOTA = 1 - (fn + fp + switches) / n,   MOTP = mean IoU of the pairs
    switch          a label paired with another track than in the frame before; after a gap none is counted
    fragmentation   a label whose track changes or comes back, and stays paired in the next frame

Over recall: tracks below a threshold of their mean score go, at the scores where recall passes 1/40, 2/40, ...

    sMOTA_r = max(0, 1 - (fn + fp + switches - (1 - r) n) / (r n)),   sAMOTA = sum_r sMOTA_r / 40

and AMOTA and AMOTP are the same averages of MOTA and MOTP. Recall that is never reached adds nothing. The last
threshold is the lowest score of a pair, whatever the recall there: sAMOTA rewards boxes that nobody would report, by up
to 1/40 at once, and a tracker that gives all tracks one score is judged with all of them at every recall.

HOTA and IDF1 are trackeval's (Luiten et al. 2021; Ristani et al. 2016), on the labels and boxes that count; so are
`mota_gaps`, `ids_gaps` and `frag_gaps`, which count a change of track after a gap of any length, and every gap: AB3DMOT
switches 52 times by that count, never by its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.kitti_matching import LEAST_OVERLAP, Compared, TrackBoxes, compare, match
from experiments.scenarios.scene import Scene
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

RECALLS = 40


class Counts(NamedTuple):
    """What AB3DMOT's evaluation counts; additive over sequences.

    labels    that count
    pairs     all, those with labels that do not count too
    iou       its sum over the pairs
    missed    labels that count, without a pair
    false     boxes that count, without a pair
    """

    labels: int
    pairs: int
    iou: float
    missed: int
    false: int
    switches: int
    fragmentations: int

    @property
    def mota(self) -> float:
        return 1.0 - (self.missed + self.false + self.switches) / max(self.labels, 1)

    @property
    def motp(self) -> float:
        return self.iou / max(self.pairs, 1)

    def scaled_mota(self, recall: float) -> float:
        """sMOTA: one where nothing but what recall leaves out is missed."""
        errors = self.missed + self.false + self.switches - (1.0 - recall) * self.labels
        return min(1.0, max(0.0, 1.0 - errors / max(recall * self.labels, 1e-9)))


def evaluate(
    scenes: Sequence[Scene], tracks: Sequence[TrackBoxes], *, threshold: float = -np.inf, average: bool = True
) -> dict[str, float]:
    """Metrics of a tracker's boxes, pooled over sequences.

    scenes     of experiments.scenarios.kitti_tracking
    tracks     what the tracker reports in each
    threshold  tracks whose mean score is below are left out, but for the averages over recall
    average    whether to average over recall

    Raises InputError where the labels count nothing, and where trackeval is missing."""
    compared = compare_all(scenes, tracks)
    counts = count_all(compared, threshold)
    if not counts.labels:
        raise InputError("no labelled car counts in these sequences; choose others")
    scores = {
        "mota": counts.mota,
        "motp": counts.motp,
        "ids": float(counts.switches),
        "frag": float(counts.fragmentations),
        "recall": counts.pairs / (counts.pairs + counts.missed),
        "precision": counts.pairs / max(counts.pairs + counts.false, 1),
    }
    return scores | trackeval_scores(compared, threshold) | (over_recall(compared) if average else {})


def compare_all(scenes: Sequence[Scene], tracks: Sequence[TrackBoxes]) -> list[Compared]:
    """Lay what a tracker reports beside the labels, sequence by sequence."""
    if len(scenes) != len(tracks):
        raise InputError(f"{len(tracks)} trackers' results for {len(scenes)} sequences; give one for each")
    return [compare(scene.data, scene.truth, boxes) for scene, boxes in zip(scenes, tracks, strict=True)]


# CLEAR


def count_all(compared: Iterable[Compared], threshold: float = -np.inf) -> Counts:
    """Counts over all sequences, without tracks whose mean score is below a threshold."""
    each = [count(some, some.score >= threshold) for some in compared]
    return Counts(*(sum(values) for values in zip(*each, strict=True)))


def count(compared: Compared, kept: Bools) -> Counts:
    """Counts over one sequence, of the boxes kept (R,)."""
    pair = match(compared, kept)
    paired = pair >= 0
    boxes = compared.pairs[pair[paired], 1]
    free = kept & ~compared.small
    free[boxes] = False
    track = np.full(len(pair), -1)
    track[paired] = compared.track[boxes]
    switches = fragmentations = 0
    for label in np.unique(compared.label):
        rows = np.flatnonzero(compared.label == label)
        s, f = changes(track[rows], compared.left_out[rows])
        switches, fragmentations = switches + s, fragmentations + f
    return Counts(
        labels=int((~compared.left_out).sum()),
        pairs=int(paired.sum()),
        iou=float(compared.overlap[pair[paired]].sum()),
        missed=int((~paired & ~compared.left_out).sum()),
        false=int(free.sum()),
        switches=switches,
        fragmentations=fragmentations,
    )


def changes(track: Ints, left_out: Bools) -> tuple[int, int]:
    """Switches and fragmentations of one labelled object, as AB3DMOT's evaluation counts them.

    track     (n,) it is paired with in the frames where it is labelled, -1 where none
    left_out  (n,) frames in which it does not count

    To its letter: what a label was paired with is forgotten where it does not count, but for its first frame; and a
    pair in the last frame is a fragmentation wherever the frame before has another or none."""
    if left_out.all() or (track < 0).all():
        return 0, 0
    switches = fragmentations = 0
    last, end = track[0], len(track) - 1
    for i in range(1, end + 1):
        if left_out[i]:
            last = -1
            continue
        changed = track[i] >= 0 and track[i] != track[i - 1]
        switches += bool(changed and last >= 0 and track[i - 1] >= 0 and track[i] != last)
        fragmentations += bool(changed and ((last >= 0 and track[i + 1] >= 0) if i < end else True))
        last = track[i] if track[i] >= 0 else last
    return switches, fragmentations


# Over recall


def thresholds(compared: Sequence[Compared]) -> list[tuple[float, float]]:
    """(score, recall) where the recall of the labels passes 1/40, 2/40, ..., and the lowest score of a pair."""
    pairs = [match(some, np.ones(len(some.track), dtype=bool)) for some in compared]
    each = [some.score[some.pairs[pair[pair >= 0], 1]] for some, pair in zip(compared, pairs, strict=True)]
    scores = np.sort(np.concatenate(each))[::-1]
    total = len(scores) + count_all(compared).missed
    chosen, recall = [], 0.0
    for i, score in enumerate(scores):
        is_last = i == len(scores) - 1
        here, following = (i + 1) / total, (i + 1 if is_last else i + 2) / total
        if following - recall < recall - here and not is_last:
            continue
        chosen.append((float(score), recall))
        recall += 1.0 / RECALLS
    return chosen[1:]  # the first has recall 0


def over_recall(compared: Sequence[Compared]) -> dict[str, float]:
    """sAMOTA, AMOTA and AMOTP."""
    each = [(count_all(compared, score), recall) for score, recall in thresholds(compared)]
    return {
        "samota": sum(counts.scaled_mota(recall) for counts, recall in each) / RECALLS,
        "amota": sum(counts.mota for counts, _ in each) / RECALLS,
        "amotp": sum(counts.motp for counts, _ in each) / RECALLS,
    }


def best_threshold(compared: Sequence[Compared]) -> float:
    """The threshold of `thresholds` with the highest MOTA: chosen on the labels, as AB3DMOT's figures are."""
    scores = [score for score, _ in thresholds(compared)]
    return max(scores, key=lambda score: count_all(compared, score).mota, default=-np.inf)


# trackeval


def trackeval_scores(compared: Sequence[Compared], threshold: float = -np.inf) -> dict[str, float]:
    """HOTA, its two halves, IDF1 and trackeval's own CLEAR, on what counts. Raises InputError without trackeval."""
    try:
        from trackeval.metrics import CLEAR, HOTA, Identity
    except ImportError as error:
        raise InputError(
            f"the metrics of tracks need trackeval, which cannot be imported ({error}); "
            "pip install 'waybayes[tracking]'"
        ) from error
    quiet = {"THRESHOLD": LEAST_OVERLAP, "PRINT_CONFIG": False}
    data = {str(i): trackeval_data(some, some.score >= threshold) for i, some in enumerate(compared)}
    found: dict[str, Any] = {}
    for metric in (HOTA(), Identity(quiet), CLEAR(quiet)):
        found |= metric.combine_sequences({name: metric.eval_sequence(one) for name, one in data.items()})
    return {
        "hota": float(np.mean(found["HOTA"])),
        "deta": float(np.mean(found["DetA"])),
        "assa": float(np.mean(found["AssA"])),
        "idf1": float(found["IDF1"]),
        "mota_gaps": float(found["MOTA"]),
        "ids_gaps": float(found["IDSW"]),
        "frag_gaps": float(found["Frag"]),
    }


def trackeval_data(compared: Compared, kept: Bools) -> dict[str, Any]:
    """One sequence as trackeval's metrics read it: labels and boxes that count, numbered from 0."""
    pair = match(compared, kept)
    counted = kept & ~compared.small
    counted[compared.pairs[pair[pair >= 0], 1]] = True
    counted[compared.pairs[pair[(pair >= 0) & compared.left_out], 1]] = False
    g, r = np.flatnonzero(~compared.left_out), np.flatnonzero(counted)
    label_names, label = np.unique(compared.label[g], return_inverse=True)
    track_names, track = np.unique(compared.track[r], return_inverse=True)
    frames = np.arange(compared.num_frames + 1)
    g_first, r_first = (
        np.searchsorted(compared.label_frame[g], frames),
        np.searchsorted(compared.track_frame[r], frames),
    )
    row, column = np.full(len(compared.label), -1), np.full(len(compared.track), -1)
    row[g], column[r] = np.arange(len(g)), np.arange(len(r))
    similarity = [np.zeros(shape) for shape in zip(np.diff(g_first), np.diff(r_first), strict=True)]
    for (i, j), iou in zip(compared.pairs, compared.overlap, strict=True):
        if row[i] >= 0 and column[j] >= 0:
            t = compared.label_frame[i]
            similarity[t][row[i] - g_first[t], column[j] - r_first[t]] = iou
    return {
        "num_timesteps": compared.num_frames,
        "num_gt_dets": len(g),
        "num_tracker_dets": len(r),
        "num_gt_ids": len(label_names),
        "num_tracker_ids": len(track_names),
        "gt_ids": np.split(label, g_first[1:-1]),
        "tracker_ids": np.split(track, r_first[1:-1]),
        "similarity_scores": similarity,
    }
