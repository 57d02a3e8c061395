"""A baseline on KITTI's detections: one Kalman filter a car, each detection to the nearest (GNN).

    x = (x, y, z, rot_y, l, w, h, vx, vy, vz),  positions move by their velocities in each frame, all else stands
    z = (x, y, z, rot_y, l, w, h) + N(0, I)

Predicted boxes and detections are assigned for the largest sum of IoU (Hungarian), pairs below a gate are undone. A
detection left over begins a track; a track is reported after three detections, and for one frame after its last, then
dropped. Front and back are not told apart: angles compare modulo pi. Constants are those of Weng et al. (2020),
AB3DMOT_libs of its repository, units metres, radians and frames; `compensate` lets positions be those of the road.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from experiments.box_overlap import overlap
from experiments.kitti_boxes import in_view, to_camera, to_world
from experiments.kitti_matching import TrackBoxes
from experiments.scenarios.kitti_tracking import KittiSequence, frames_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MEASURED, SIZE = 7, 10
ANGLE = 3
TO_BOX = [6, 5, 4, 0, 1, 2, 3]  # h, w, l, x, y, z, rot_y from the state
TO_STATE = [3, 4, 5, 6, 2, 1, 0]
F = np.eye(SIZE) + np.eye(SIZE, k=MEASURED)
F[3:MEASURED] = np.eye(SIZE)[3:MEASURED]
Q = np.diag([1.0] * MEASURED + [0.01] * 3)
R = np.eye(MEASURED)
P0 = np.diag([10.0] * MEASURED + [10_000.0] * 3)


class Cars(NamedTuple):
    """N cars that are followed.

    mean        (N, 10), covariance (N, 10, 10)
    label       (N,) number of the track
    hits, age   (N,) detections so far, and frames since the last
    score       (N,) of the last detection
    """

    mean: Floats
    covariance: Floats
    label: Ints
    hits: Ints
    age: Ints
    score: Floats

    def take(self, rows: Ints) -> Cars:
        """Some of them."""
        return Cars._make(values[rows] for values in self)


def begin(boxes: Floats, score: Floats, first: int) -> Cars:
    """A car at each box (M, 7), numbered from `first`."""
    num = len(boxes)
    mean = np.pad(boxes[:, TO_STATE], ((0, 0), (0, SIZE - MEASURED)))
    numbers = first + np.arange(num, dtype=np.int64)
    return Cars(mean, np.tile(P0, (num, 1, 1)), numbers, np.ones(num, np.int64), np.zeros(num, np.int64), score)


def step(cars: Cars, boxes: Floats, score: Floats, first: int, *, gate: float, max_age: int) -> Cars:
    """One frame later: predicted, updated by their detections (M, 7); what is left over begins at number `first`."""
    mean, covariance = predict(cars.mean, cars.covariance)
    hits, age, last = cars.hits.copy(), cars.age + 1, cars.score.copy()
    i, j = assign(overlap(mean[:, TO_BOX], boxes), gate)
    mean[i], covariance[i] = update(mean[i], covariance[i], boxes[j][:, TO_STATE])
    hits[i], age[i], last[i] = hits[i] + 1, 0, score[j]
    known = Cars(mean, covariance, cars.label, hits, age, last).take(np.flatnonzero(age < max_age))
    free = np.setdiff1d(np.arange(len(boxes)), j)
    new = begin(boxes[free], score[free], first)
    return Cars._make(np.concatenate(both) for both in zip(known, new, strict=True))


def track(
    sequence: KittiSequence,
    *,
    gate: float = 0.01,
    min_hits: int = 3,
    max_age: int = 2,
    least_score: float = -np.inf,
    compensate: bool = True,
    only_in_view: bool = False,
) -> TrackBoxes:
    """Boxes that the baseline reports in a sequence, causally; a track's score is that of its last detection.

    gate          least IoU of a detection with the predicted box
    min_hits      detections before a track is reported; the first frames of a sequence are exempt
    max_age       frames without a detection after which a track is dropped; it is reported in fewer
    least_score   detections below are not looked at
    compensate    whether to track in the frame of the poses, or in the moving camera's as AB3DMOT did at first
    only_in_view  whether to report nothing that is beside the image; AB3DMOT reports it"""
    detections, still = sequence.detections, np.eye(4)[None]
    if not compensate:
        sequence = sequence._replace(pose=np.tile(still, (len(sequence.time), 1, 1)))
    position, heading = to_world(detections.camera, sequence.pose[frames_of(detections.offset)])
    boxes = to_camera(position, heading, detections.size, still)  # axes of the camera, origin of the poses
    cars, begun, reported = begin(boxes[:0], detections.score[:0], 0), 0, []
    for t in range(len(sequence.time)):
        here = np.arange(detections.offset[t], detections.offset[t + 1])
        here = here[detections.score[here] >= least_score]
        cars = step(cars, boxes[here], detections.score[here], begun, gate=gate, max_age=max_age)
        begun = max(begun, int(cars.label.max(initial=-1)) + 1)
        reported.append(cars.take(np.flatnonzero((cars.hits >= min_hits) | (t < min_hits))))
    frame = np.repeat(np.arange(len(reported)), [len(some.label) for some in reported])
    label = np.concatenate([some.label for some in reported])
    score = np.concatenate([some.score for some in reported])
    box = np.concatenate([some.mean for some in reported])[:, TO_BOX]
    position, heading = to_world(box, still)
    box = to_camera(position, heading, box[:, :3], sequence.pose[frame])
    shown = in_view(box, sequence.projection, sequence.image) | (not only_in_view)
    offset = np.searchsorted(frame[shown], np.arange(len(reported) + 1)).astype(np.int64)
    return TrackBoxes(offset, label[shown], box[shown], score[shown])


def predict(x: Floats, P: Floats) -> tuple[Floats, Floats]:
    """States (N, 10) and covariances (N, 10, 10) one frame later."""
    return x @ F.T, F @ P @ F.T + Q


def update(x: Floats, P: Floats, z: Floats) -> tuple[Floats, Floats]:
    """States and covariances given measurements (N, 7)."""
    innovation = z - x[:, :MEASURED]
    innovation[:, ANGLE] = (innovation[:, ANGLE] + np.pi / 2) % np.pi - np.pi / 2
    gain = np.swapaxes(np.linalg.solve(P[:, :MEASURED, :MEASURED] + R, P[:, :MEASURED, :]), 1, 2)
    return x + (gain @ innovation[..., None])[..., 0], P - gain @ P[:, :MEASURED, :]


def assign(iou: Floats, gate: float) -> tuple[Ints, Ints]:
    """Rows and columns of the assignment with the largest sum, those below the gate undone."""
    i, j = linear_sum_assignment(-iou)
    kept = iou[i, j] >= gate
    return i[kept], j[kept]
