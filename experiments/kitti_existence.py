"""Calibrated existence: how probable it is that what a filter follows is a car that somebody labelled.

The filter's own r is of its model, in which false alarms come and go. Real ones persist: a hedge looks like a car for
as long as it is in view, and r goes to one. So a logistic regression reads r, what the detections of the track were
like so far, and where it is:

    p = 1 / (1 + exp(-w (1, a))),   a the features, standardised, within +-3
    w = argmax sum log p(y | a) - |w|^2 / 2

y says whether the labels confirm a row. A track is reported from p > on until p <= off: at one threshold a p about it
would break tracks. All of it is causal. What is learnt of labels (experiments.kitti_folds) is learnt on other sequences
than the one it judges; which features there are was chosen by the scores of all 13 sequences together.

Features without bounds (powers of the range, height over the road) fail on other sequences than those of the fit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.special import expit, logit

from experiments.kitti_boxes import image_boxes, in_view
from experiments.kitti_matching import TrackBoxes, boxes_of
from experiments.scenarios.kitti_scans import CAMERA, LASER
from experiments.scenarios.kitti_tracking import KittiSequence
from inference.tracks import Tracks, rows_by_label
from models.objects.scans import Scan
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

BOUND = 3.0  # of standardised features
FAINT = 1e-4  # r is taken to be no nearer to 0 and 1
LONG = 6  # scans without a detection beyond which no more are counted
FADE, SHARE = 0.85, 0.5  # of older detections, and of the newest, in the evidence of the scores
SAID = (-6.0, 8.0)
CLOSE = 2.5  # objects nearer to a surer one may be the same [m]
CAR = (1.53, 3.9)  # height and length [m]


class Candidates(NamedTuple):
    """R boxes that may be cars, and what is known of each.

    boxes     their score is r
    features  (R, F)
    shown     (R,) whether any of it is in the image
    """

    boxes: TrackBoxes
    features: Floats
    shown: Bools


class Past(NamedTuple):
    """What one sensor has shown of each row's object so far (R,): detections, scans since the last one, and mean,
    largest and last score (0 where the last scan missed it), and their faded sum."""

    hits: Floats
    misses: Floats
    mean: Floats
    most: Floats
    last: Floats
    faded: Floats


class Calibration(NamedTuple):
    """Middle and scale (F,) of the features, weights (1 + F,)."""

    middle: Floats
    scale: Floats
    weights: Floats

    def probability(self, features: Floats) -> Floats:
        """(R,)."""
        return np.asarray(expit(_design(features, self.middle, self.scale) @ self.weights))


def candidates(tracks: Tracks, scans: Sequence[Scan], sequence: KittiSequence) -> Candidates:
    """What the filter believes after each frame. Raises InputError for tracks that do not say what they were seen by,
    or that are not of the sequence."""
    last = np.flatnonzero(np.diff(tracks.time, append=np.inf) > 0.0)  # of each frame's scans
    if len(last) != len(sequence.time) or len(scans) != len(tracks.time):
        raise InputError(
            f"tracks of {len(last)} frames are not of sequence {sequence.name}: {len(sequence.time)} frames"
        )
    rows = np.flatnonzero(np.isin(tracks.scan, last))
    offset = np.concatenate([[0], np.cumsum(np.diff(tracks.offset)[last])])
    (z, height, width, length, heading) = tracks.entries("z", "height", "width", "length", "heading")
    mean, r = tracks.mean[rows], tracks.existence[rows]
    boxes = boxes_of(
        sequence,
        offset,
        tracks.label[rows],
        np.column_stack([mean[:, :2], mean[:, z]]),
        mean[:, heading],
        np.maximum(mean[:, [height, width, length]], 0.1),
        r,
    )
    spread = np.sqrt(tracks.covariance[rows, 0, 0] + tracks.covariance[rows, 1, 1])
    own = [
        logit(np.clip(r, FAINT, 1.0 - FAINT)),
        np.log(spread),
        *_place(boxes, sequence),
        _crowded(boxes, mean[:, :2]),
    ]
    past = {name: Past(*(part[rows] for part in past_of(tracks, scans, name))) for name in (LASER, CAMERA)}
    own += _seen(past[LASER], own[3]) + (_confirmed(past[CAMERA], own[3]) if CAMERA in tracks.sensor else [])
    shown = in_view(boxes.box, sequence.projection, sequence.image)
    return Candidates(boxes, np.column_stack(own), shown)


def _place(boxes: TrackBoxes, sequence: KittiSequence) -> list[Floats]:
    """Range, twice, share of the width in the image, whether all of it, height in the image, height and length."""
    height, _, length, x, _, depth, _ = boxes.box.T
    distance, f = np.hypot(x, depth), sequence.projection[0, 0]
    depth = np.maximum(depth, 0.3)
    u, half = f * x / depth + sequence.projection[0, 2], 1.5 * f / depth
    share = np.clip(np.minimum(u + half, sequence.image[0] - u + half) / (2 * half), 0.0, 1.0)
    covers = image_boxes(boxes.box, sequence.projection, sequence.image)
    tall = np.log(np.maximum(covers[:, 3] - covers[:, 1], 5.0))
    return [distance, np.tanh((distance - 35.0) / 15.0), share, share < 0.99, tall, height - CAR[0], length - CAR[1]]


def _crowded(boxes: TrackBoxes, position: Floats) -> Floats:
    """(R,) whether a surer object is nearer than CLOSE."""
    found = np.zeros(len(position))
    for a, b in zip(boxes.offset[:-1], boxes.offset[1:], strict=True):
        apart = np.hypot(*(position[a:b, None] - position[None, a:b]).transpose(2, 0, 1))
        surer = boxes.score[None, a:b] > boxes.score[a:b, None]
        found[a:b] = (surer & (apart < CLOSE)).any(1)
    return found


def _seen(past: Past, far: Floats) -> list[Floats]:
    """Features of what the laser's detector has shown."""
    often = np.log(np.maximum(past.hits, 1.0))
    missed = np.minimum(past.misses, LONG)
    return [often, often * past.mean, often * far, past.misses > 0, missed, past.mean, past.most, past.last, past.faded]


def _confirmed(past: Past, far: Floats) -> list[Floats]:
    """Features of what the camera's has."""
    often, missed = np.log1p(past.hits), np.minimum(past.misses, LONG)
    return [often, past.hits == 0, past.misses > 0, missed, often * far, past.faded]


def past_of(tracks: Tracks, scans: Sequence[Scan], sensor: str) -> Past:
    """What a sensor has shown of the object of each row of tracks, until then."""
    if tracks.measurement is None:
        raise InputError("calibrated existence reads which measurement is of which object; choose engine=lmb")
    found = Past(*np.zeros((6, len(tracks.label))))
    own = np.array([name == sensor for name in tracks.sensor])[tracks.scan]
    hit = own & (tracks.measurement >= 0)
    said = np.zeros(len(own))
    for row in np.flatnonzero(hit):
        score = scans[tracks.scan[row]].score
        said[row] = SAID[1] if score is None else np.clip(logit(score[tracks.measurement[row]]), *SAID)
    for rows in rows_by_label(tracks.label).values():
        h, s = hit[rows], said[rows]
        looked, hits = np.cumsum(own[rows]), np.cumsum(h)
        misses = looked - np.maximum.accumulate(np.where(h, looked, 0))
        latest = np.maximum.accumulate(np.where(h, np.arange(len(h)), 0))
        faded = np.concatenate([[0.0], lfilter([SHARE], [1.0, -FADE], s[h])])
        found.hits[rows], found.misses[rows] = hits, misses
        found.mean[rows] = np.cumsum(s) / np.maximum(hits, 1)
        found.most[rows] = np.maximum.accumulate(np.where(h, s, SAID[0]))
        found.last[rows] = np.where((misses == 0) & (hits > 0), s[latest], 0.0)
        found.faded[rows] = faded[hits]
    return found


def fit(features: Floats, confirmed: Bools, *, ridge: float = 1.0, steps: int = 30) -> Calibration:
    """Newton's steps to the maximum. Raises InputError without rows of both sorts."""
    if confirmed.all() or not confirmed.any():
        raise InputError("a calibration needs rows that labels confirm and rows that they do not; give more sequences")
    middle, scale = features.mean(0), np.maximum(features.std(0), 1e-9)
    A, w = _design(features, middle, scale), np.zeros(1 + features.shape[1])
    for _ in range(steps):
        p = expit(A @ w)
        slope = A.T @ (confirmed - p) - ridge * w
        curvature = (A * (p * (1.0 - p))[:, None]).T @ A + ridge * np.eye(len(w))
        w = w + np.linalg.solve(curvature, slope)
    return Calibration(middle, scale, w)


def _design(features: Floats, middle: Floats, scale: Floats) -> Floats:
    bounded = np.clip((features - middle) / scale, -BOUND, BOUND)
    return np.concatenate([np.ones((len(bounded), 1)), bounded], 1)


def told(track: Ints, p: Floats, *, on: float, off: float) -> Bools:
    """Which rows (R,), in the order of time, are told of: from p > on until p <= off; on is not below off."""
    order = np.argsort(track, kind="stable")
    track, p = track[order], p[order]
    first = np.diff(track, prepend=-1) != 0
    decided = np.maximum.accumulate(np.where(first | (p > on) | (p <= off), np.arange(len(p)), 0))
    found = np.zeros(len(p), dtype=bool)
    found[order] = (p > on)[decided]
    return found
