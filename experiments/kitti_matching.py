"""Which reported box is which labelled car, and which boxes count: the rules of the public AB3DMOT evaluation.

Weng, Wang, Held, Kitani (2020), 3D multi-object tracking: a baseline and new evaluation metrics; class car of
scripts/KITTI/evaluate.py in its repository. In each frame labelled cars and vans are paired with reported boxes so that
as many pairs as possible reach an IoU of 0.25 and their IoU is largest in sum. Then do not count

    labels   vans, and what is truncated (> 0) or hardly visible (occlusion > 2), whether paired or not; with them goes
             the box they are paired with
    boxes    that are not paired and are 25 px or less high in the image, or more than half inside a region where
             nothing is labelled

The image box is what the reported box covers of the image (experiments.kitti_boxes.image_boxes): that is what the
detector's own image boxes are too, and where a track coasts there is no other. A box beside the image counts, and is
false: a tracker has to know what the camera can see (experiments.kitti_boxes.in_view).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from experiments.box_overlap import overlap
from experiments.kitti_boxes import image_boxes, to_camera
from experiments.scenarios.kitti_tracking import KittiLabels, KittiSequence, frames_of
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

LEAST_OVERLAP = 0.25
LEAST_HEIGHT = 25.0  # of a box that counts, more than this [px]
MOST_OCCLUSION = 2
MOST_TRUNCATION = 0
INSIDE = 0.5  # share of a box in a region without labels, more than this does not count


class TrackBoxes(NamedTuple):
    """R boxes that a tracker reports in T frames.

    offset  (T + 1,)
    track   (R,) number of the track, at most once in a frame
    box     (R, 7) in the camera frame (experiments.kitti_boxes)
    score   (R,) of the track at that time, larger is surer; only their order matters
    """

    offset: Ints
    track: Ints
    box: Floats
    score: Floats


class Compared(NamedTuple):
    """A tracker's boxes (R) beside the labelled cars and vans (G) of a sequence of T frames.

    label, label_frame   (G,) number of the object, and its frame
    left_out             (G,) labels that do not count
    track, track_frame   (R,)
    small                (R,) boxes that do not count unless they are paired
    score                (R,) mean over the whole track
    pairs, overlap       (E, 2) label and box of the same frame that overlap, (E,) their IoU
    num_frames           T
    """

    label: Ints
    label_frame: Ints
    left_out: Bools
    track: Ints
    track_frame: Ints
    small: Bools
    score: Floats
    pairs: Ints
    overlap: Floats
    num_frames: int


def boxes_of(
    sequence: KittiSequence, offset: Ints, track: Ints, position: Floats, heading: Floats, size: Floats, score: Floats
) -> TrackBoxes:
    """Reported boxes from their places in the frame of the poses.

    offset    (T + 1,) where each frame's boxes begin
    track     (R,) number of the track
    position  (R, 3) middle of the bottom: x forward, y left, z up at the first frame [m]
    heading   (R,) there [rad]
    size      (R, 3) height, width, length [m]
    score     (R,) how sure the tracker is; equal scores make the metrics that average over recall one step

    Raises InputError for arrays that do not fit together, NaN, a size of 0 or less, and a track twice in a frame."""
    num, wanted = len(track), len(sequence.time) + 1
    shapes = {"position": (num, 3), "heading": (num,), "size": (num, 3), "score": (num,)}
    given = {"position": position, "heading": heading, "size": size, "score": score}
    if np.shape(offset) != (wanted,) or offset[0] != 0 or offset[-1] != num or (np.diff(offset) < 0).any():
        raise InputError(
            f"offset of sequence {sequence.name} has shape {np.shape(offset)} or does not fit the boxes; give {wanted} "
            f"numbers that grow from 0 to the {num} boxes"
        )
    for name, values in given.items():
        if np.shape(values) != shapes[name]:
            raise InputError(f"{name} has shape {np.shape(values)}; {num} boxes need {shapes[name]}")
        if not np.isfinite(values).all():
            raise InputError(f"{name} of sequence {sequence.name} holds a value that is not finite; leave that box out")
    if not (size > 0).all():
        raise InputError(f"size of sequence {sequence.name} is {size.min():g} m somewhere; sizes are above 0")
    frame = frames_of(offset)
    seen, first = np.unique(np.stack([frame, track]), axis=1, return_index=True)
    if seen.shape[1] != num:
        again = np.setdiff1d(np.arange(num), first)[0]
        raise InputError(
            f"track {track[again]} is twice in frame {frame[again]} of sequence {sequence.name}; report it once"
        )
    box = to_camera(position, heading, size, sequence.pose[frame])
    return TrackBoxes(np.asarray(offset, np.int64), np.asarray(track, np.int64), box, np.asarray(score, np.float64))


def compare(sequence: KittiSequence, labels: KittiLabels, tracks: TrackBoxes) -> Compared:
    """Lay a tracker's boxes beside the labels of a sequence."""
    cars = np.flatnonzero(np.isin(labels.kind, ["Car", "Van"]))
    label_frame, track_frame = frames_of(labels.offset)[cars], frames_of(tracks.offset)
    seen = image_boxes(tracks.box, sequence.projection, sequence.image)
    small = seen[:, 3] - seen[:, 1] <= LEAST_HEIGHT
    first = np.searchsorted(label_frame, np.arange(len(sequence.time) + 1))
    pairs, overlaps = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
    for t in range(len(sequence.time)):
        here = slice(tracks.offset[t], tracks.offset[t + 1])
        regions = labels.dont_care[labels.dont_care_offset[t] : labels.dont_care_offset[t + 1]]
        small[here] |= (covered(seen[here], regions) > INSIDE).any(1)
        iou = overlap(labels.camera[cars[first[t] : first[t + 1]]], tracks.box[here])
        g, r = np.nonzero(iou)
        pairs.append(np.stack([g + first[t], r + tracks.offset[t]], 1))
        overlaps.append(iou[g, r])
    _, member = np.unique(tracks.track, return_inverse=True)
    mean = np.bincount(member, tracks.score) / np.maximum(np.bincount(member), 1)
    left_out = (
        (labels.kind[cars] == "Van")
        | (labels.truncation[cars] > MOST_TRUNCATION)
        | (labels.occlusion[cars] > MOST_OCCLUSION)
    )
    return Compared(
        label=labels.track[cars],
        label_frame=label_frame,
        left_out=left_out,
        track=tracks.track,
        track_frame=track_frame,
        small=small,
        score=mean[member],
        pairs=np.concatenate(pairs),
        overlap=np.concatenate(overlaps),
        num_frames=len(sequence.time),
    )


def covered(boxes: Floats, regions: Floats) -> Floats:
    """Share (N, D) of image boxes (N, 4) that lies in each of the regions (D, 4)."""
    corner = np.maximum(boxes[:, None, :2], regions[:, :2])
    side = np.maximum(np.minimum(boxes[:, None, 2:], regions[:, 2:]) - corner, 0.0)
    area = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
    return np.prod(side, axis=2) / np.where(area > 0, area, 1.0)[:, None]


def match(compared: Compared, kept: Bools) -> Ints:
    """The pair (an index into pairs) of each label among the boxes kept (R,), -1 where it has none, (G,).

    A pair whose label and box touch no other pair needs no search; the rest is assigned frame by frame."""
    near = np.flatnonzero((compared.overlap >= LEAST_OVERLAP) & kept[compared.pairs[:, 1]])
    g, r = compared.pairs[near].T
    alone = (np.bincount(g, minlength=len(compared.label))[g] == 1) & (
        np.bincount(r, minlength=len(compared.track))[r] == 1
    )
    matched = np.full(len(compared.label), -1)
    matched[g[alone]] = near[alone]
    contested = near[~alone]
    frame = compared.label_frame[g[~alone]]
    for some in np.split(contested, np.flatnonzero(np.diff(frame)) + 1) if len(contested) else []:
        rows, i = np.unique(compared.pairs[some, 0], return_inverse=True)
        columns, j = np.unique(compared.pairs[some, 1], return_inverse=True)
        cost, index = np.full((len(rows), len(columns)), 1e6), np.full((len(rows), len(columns)), -1)
        cost[i, j], index[i, j] = 1.0 - compared.overlap[some], some
        chosen = index[linear_sum_assignment(cost)]
        chosen = chosen[chosen >= 0]
        matched[compared.pairs[chosen, 0]] = chosen
    return matched
