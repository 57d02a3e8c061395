"""A baseline on KITTI's detections: one Kalman filter a car, each detection to the nearest (GNN).

    x = (x, y, z, rot_y, l, w, h, vx, vy, vz),  positions move by their velocities in each frame, all else stands
    z = (x, y, z, rot_y, l, w, h) + N(0, I)

Predicted boxes and detections are assigned for the largest sum of IoU (Hungarian), pairs below a gate are undone. A
detection left over begins a track; a track is reported after three detections, and for one frame after its last, then
dropped. Front and back are not told apart: angles compare modulo pi. Constants are those of Weng et al. (2020),
AB3DMOT_libs of its repository, units metres, radians and frames; `compensate` lets positions be those of the road.
"""

from __future__ import annotations

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
    x, P = np.zeros((0, SIZE)), np.zeros((0, SIZE, SIZE))
    label, hits, age, score = (np.zeros(0, kind) for kind in (np.int64, np.int64, np.int64, np.float64))
    begun, reported = 0, []
    for t in range(len(sequence.time)):
        here = np.arange(detections.offset[t], detections.offset[t + 1])
        here = here[detections.score[here] >= least_score]
        x, P = predict(x, P)
        age = age + 1
        i, j = assign(overlap(x[:, TO_BOX], boxes[here]), gate)
        x[i], P[i] = update(x[i], P[i], boxes[here[j]][:, TO_STATE])
        hits[i], age[i], score[i] = hits[i] + 1, 0, detections.score[here[j]]
        new = np.setdiff1d(here, here[j])
        x = np.concatenate([x, np.pad(boxes[new][:, TO_STATE], ((0, 0), (0, SIZE - MEASURED)))])
        P = np.concatenate([P, np.tile(P0, (len(new), 1, 1))])
        label = np.concatenate([label, begun + np.arange(len(new))])
        hits, age = np.append(hits, np.ones(len(new), np.int64)), np.append(age, np.zeros(len(new), np.int64))
        score, begun = np.append(score, detections.score[new]), begun + len(new)
        alive = age < max_age
        x, P, label, hits, age, score = (values[alive] for values in (x, P, label, hits, age, score))
        shown = np.flatnonzero((hits >= min_hits) | (t < min_hits))
        reported.append((label[shown], x[shown][:, TO_BOX], score[shown]))
    frame = np.repeat(np.arange(len(reported)), [len(labels) for labels, _, _ in reported])
    label, box, score = (np.concatenate(parts) for parts in zip(*reported, strict=True))
    position, heading = to_world(box, np.broadcast_to(still, (len(box), 4, 4)))
    box = to_camera(position, heading, box[:, :3], sequence.pose[frame])
    shown = in_view(box, sequence.projection, sequence.image) | (not only_in_view)
    offset = np.searchsorted(frame[shown], np.arange(len(reported) + 1))
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
