"""A made-up KITTI sequence in memory for tests: a camera that stands, cars before it, nothing detected."""

from __future__ import annotations

import numpy as np

from experiments.kitti_boxes import image_boxes, to_world
from experiments.kitti_existence import Candidates
from experiments.kitti_matching import TrackBoxes
from experiments.scenarios.kitti_scans import KittiTruth
from experiments.scenarios.kitti_tracking import CameraBoxes, Detections, KittiLabels, KittiSequence
from experiments.scenarios.scene import Scene

PROJECTION = np.array([[720.0, 0.0, 610.0, 0.0], [0.0, 720.0, 170.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
IMAGE = (1242, 375)


def car(x: float = 0.0, z: float = 20.0, turn: float = 0.0) -> np.ndarray:
    """A car's box in the camera frame."""
    return np.array([1.5, 1.6, 4.0, x, 1.6, z, turn])


def offsets(frame: np.ndarray, num_frames: int) -> np.ndarray:
    return np.searchsorted(frame, np.arange(num_frames + 1))


def scene(
    rows: list[tuple[int, int, np.ndarray]],
    num_frames: int,
    kind: str = "Car",
    truncation: int = 0,
    occlusion: int = 0,
    dont_care: list[tuple[int, list[float]]] | None = None,
) -> Scene:
    """Labels from rows (frame, track, box) sorted by frame; regions from rows (frame, left top right bottom)."""
    frame = np.array([row[0] for row in rows])
    box = np.array([row[2] for row in rows]).reshape(-1, 7)
    pose = np.tile(np.eye(4), (num_frames, 1, 1))
    position, heading = to_world(box, pose[frame])
    regions = dont_care or []
    labels = KittiLabels(
        offset=offsets(frame, num_frames),
        track=np.array([row[1] for row in rows]),
        kind=np.full(len(rows), kind),
        truncation=np.full(len(rows), truncation),
        occlusion=np.full(len(rows), occlusion),
        image=image_boxes(box, PROJECTION, IMAGE),
        position=position,
        heading=heading,
        size=box[:, :3],
        camera=box,
        dont_care_offset=offsets(np.array([row[0] for row in regions]), num_frames),
        dont_care=np.array([row[1] for row in regions], dtype=float).reshape(-1, 4),
    )
    nothing = np.zeros(num_frames + 1, dtype=np.int64)
    empty = np.zeros((0, 4))
    data = KittiSequence(
        name="made up",
        time=0.1 * np.arange(num_frames),
        pose=pose,
        projection=PROJECTION,
        image=IMAGE,
        detections=Detections(
            nothing, np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0), empty, np.zeros((0, 7))
        ),
        camera_boxes=CameraBoxes(nothing, empty, np.zeros(0)),
    )
    return Scene(data, labels, "made up", {})


def detected(given: Scene, rows: list[tuple[int, float, np.ndarray]]) -> KittiSequence:
    """The sequence of a scene with detections from rows (frame, score, box) sorted by frame."""
    sequence: KittiSequence = given.data
    offset = offsets(np.array([row[0] for row in rows]), len(sequence.time))
    box = np.array([row[2] for row in rows]).reshape(-1, 7)
    position, heading = to_world(box, sequence.pose[[row[0] for row in rows]])
    seen = image_boxes(box, sequence.projection, sequence.image)
    score = np.array([row[1] for row in rows])
    return sequence._replace(detections=Detections(offset, position, heading, box[:, :3], score, seen, box))


def report(rows: list[tuple[int, int, np.ndarray]], num_frames: int, score: float = 1.0) -> TrackBoxes:
    """What a tracker reports, from rows (frame, track, box) sorted by frame."""
    return TrackBoxes(
        offsets(np.array([row[0] for row in rows]), num_frames),
        np.array([row[1] for row in rows], dtype=np.int64),
        np.array([row[2] for row in rows]).reshape(-1, 7),
        np.full(len(rows), score),
    )


def beside_a_hedge(seed: int) -> tuple[KittiTruth, Candidates]:
    """A car that stands (track 5), and something beside it that looks less like one (track 6); the one feature says
    which, not surely."""
    rng, frames = np.random.default_rng(seed), 40
    whole = scene([(t, 0, car(-3.0)) for t in range(frames)], frames)
    box = np.array([car(-3.0), car(3.0)] * frames)
    boxes = TrackBoxes(2 * np.arange(frames + 1), np.tile([5, 6], frames), box, np.full(2 * frames, 0.5))
    feature = np.tile([1.0, -1.0], frames) + rng.normal(0.0, 0.5, 2 * frames)
    return KittiTruth(whole.data, whole.truth), Candidates(boxes, feature[:, None], np.ones(2 * frames, dtype=bool))
