"""Real cars: what a detector saw in KITTI's tracking sequences, where the camera was, and what people labelled.

Detections are those of PointRCNN (laser), camera boxes those of RRC, poses of a stereo ORB-SLAM3: metric, but an
estimate. The data folder's README names sources and licences.
"""

from __future__ import annotations

import gzip
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.kitti_boxes import pose_of, to_world
from experiments.scenarios.junction import DATA_ROOT, find, pick
from experiments.scenarios.scene import Scene
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FOLDER = "tracking/kitti"
STEP = 0.1  # between frames [s]
IMAGE = (1242, 375)  # width and height [px]
OTHER_IMAGES = {"0014": (1224, 370), "0018": (1238, 374), "0020": (1241, 376)}  # recorded on other days
DETECTION = 15  # numbers a line: frame, type, left, top, right, bottom, score, h, w, l, x, y, z, rot_y, alpha
CAMERA_BOX = 6  # frame, left, top, right, bottom, score
LABEL = 17  # frame, id, type, truncation, occlusion, alpha, left, top, right, bottom, h, w, l, x, y, z, rot_y
POSE = 12


class Detections(NamedTuple):
    """N detections of a sequence of T frames, those of frame t from offset[t] to offset[t + 1].

    offset    (T + 1,)
    position  (N, 3) middle of the bottom in the frame of the poses: x forward, y left, z up at the first frame [m]
    heading   (N,) there [rad]; front and back are often mistaken
    size      (N, 3) height, width, length [m]
    score     (N,) a logit
    image     (N, 4) left, top, right, bottom in the image [px]
    camera    (N, 7) the same boxes in the camera frame (experiments.kitti_boxes)
    """

    offset: Ints
    position: Floats
    heading: Floats
    size: Floats
    score: Floats
    image: Floats
    camera: Floats


class CameraBoxes(NamedTuple):
    """C boxes of a detector that looks at the image only.

    offset  (T + 1,)
    image   (C, 4) left, top, right, bottom [px]
    score   (C,) between 0 and 1
    """

    offset: Ints
    image: Floats
    score: Floats


class KittiSequence(NamedTuple):
    """One sequence of T frames, 10 a second, as sensors and detectors give it.

    name         four digits
    time         (T,) [s]
    pose         (T, 4, 4) from the camera, its axes turned to x forward, y left, z up, to where it was at first
    projection   (3, 4) of the left colour camera, from the rectified camera frame
    image        width and height [px]
    """

    name: str
    time: Floats
    pose: Floats
    projection: Floats
    image: tuple[int, int]
    detections: Detections
    camera_boxes: CameraBoxes


class KittiLabels(NamedTuple):
    """What people labelled: G objects and the regions of the image where they labelled nothing.

    offset      (T + 1,)
    track       (G,) number of the object, the same in all frames
    kind        (G,) KITTI's word: Car, Van, Pedestrian, ...
    truncation  (G,) 0 to 2; outside the image
    occlusion   (G,) 0 to 3; 3 is unknown
    image       (G, 4) left, top, right, bottom [px]
    position    (G, 3), heading (G,), size (G, 3), camera (G, 7) as of Detections
    dont_care_offset  (T + 1,)
    dont_care         (D, 4) regions, left, top, right, bottom [px]
    """

    offset: Ints
    track: Ints
    kind: NDArray[np.str_]
    truncation: Ints
    occlusion: Ints
    image: Floats
    position: Floats
    heading: Floats
    size: Floats
    camera: Floats
    dont_care_offset: Ints
    dont_care: Floats


def kitti_tracking(sequence: str = "0006", data_root: str = DATA_ROOT) -> Scene:
    """A tracking sequence of KITTI: data a KittiSequence, truth KittiLabels.

    sequence  "0006", "0010", "0014" and "0018" are not among those that the detector learnt from

    Raises InputError where the data are not there, for a sequence that is not among them, and with file and line for
    what cannot be read."""
    detected = _file(data_root, "detections_pointrcnn_car", ".txt.gz", sequence)
    pose_file = _file(data_root, "camera_poses_orbslam3", ".txt.gz", sequence)
    pose = pose_of(_numbers(pose_file, _rows(pose_file, POSE)))
    data = KittiSequence(
        name=sequence,
        time=STEP * np.arange(len(pose), dtype=np.float64),
        pose=pose,
        projection=_projection(_file(data_root, "calib", ".txt", sequence)),
        image=OTHER_IMAGES.get(sequence, IMAGE),
        detections=_detections(detected, pose),
        camera_boxes=_camera_boxes(_file(data_root, "detections_rrc_car_2d", ".txt.gz", sequence), len(pose)),
    )
    truth = _labels(
        _file(data_root, "labels", ".txt.gz", sequence), _file(data_root, "labels", ".dontcare.txt.gz", sequence), pose
    )
    info = {
        "scenario": "kitti_tracking",
        "sequence": sequence,
        "frames": len(pose),
        "detections": len(data.detections.score),
        "cars": len(np.unique(truth.track[truth.kind == "Car"])),
    }
    return Scene(data, truth, f"KITTI {sequence}", info)


def sequences(data_root: str = DATA_ROOT) -> list[str]:
    """Names of the sequences that are there."""
    return list(find(data_root, f"{FOLDER}/detections_pointrcnn_car", ".txt.gz", "crossing_targets"))


def frames_of(offset: Ints) -> Ints:
    """The frame (N,) of each row that offsets (T + 1,) tell."""
    return np.repeat(np.arange(len(offset) - 1), np.diff(offset))


def _file(data_root: str, folder: str, ending: str, sequence: str) -> Path:
    return pick(sequence, find(data_root, f"{FOLDER}/{folder}", ending, "crossing_targets"), f"sequence in {folder}")


def _detections(path: Path, pose: Floats) -> Detections:
    table = _numbers(path, _rows(path, DETECTION, ","))
    offset, camera = _offsets(path, table[:, 0], len(pose)), table[:, 7:14]
    _check_sizes(path, camera)
    position, heading = to_world(camera, pose[frames_of(offset)])
    return Detections(offset, position, heading, camera[:, :3], table[:, 6], table[:, 2:6], camera)


def _camera_boxes(path: Path, num_frames: int) -> CameraBoxes:
    table = _numbers(path, _rows(path, CAMERA_BOX, ","))
    return CameraBoxes(_offsets(path, table[:, 0], num_frames), table[:, 1:5], table[:, 5])


def _labels(path: Path, dont_care_path: Path, pose: Floats) -> KittiLabels:
    rows, around = _rows(path, LABEL), _rows(dont_care_path, LABEL)
    table = _numbers(path, [row[:2] + row[3:] for row in rows])  # all but the type
    regions = _numbers(dont_care_path, [row[:1] + row[6:10] for row in around])
    offset, camera = _offsets(path, table[:, 0], len(pose)), table[:, 9:16]
    _check_sizes(path, camera)
    position, heading = to_world(camera, pose[frames_of(offset)])
    return KittiLabels(
        offset=offset,
        track=table[:, 1].astype(np.int64),
        kind=np.array([row[2] for row in rows], dtype=np.str_),
        truncation=table[:, 2].astype(np.int64),
        occlusion=table[:, 3].astype(np.int64),
        image=table[:, 5:9],
        position=position,
        heading=heading,
        size=camera[:, :3],
        camera=camera,
        dont_care_offset=_offsets(dont_care_path, regions[:, 0], len(pose)),
        dont_care=regions[:, 1:5],
    )


def _projection(path: Path) -> Floats:
    """The left colour camera's, from the line that begins with P2."""
    for line in path.read_text().splitlines():
        head, *words = line.split()
        if head == "P2:" and len(words) == POSE:
            return _numbers(path, [words])[0].reshape(3, 4)
    raise InputError(f"{path}: no line begins with 'P2:' and has {POSE} numbers; give KITTI's calibration file")


def _rows(path: Path, width: int, separator: str | None = None) -> list[list[str]]:
    """The words of each line. Raises InputError for a line with too few or too many."""
    try:
        with gzip.open(path, "rt") as file:
            rows = [line.strip().split(separator) for line in file]
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as a gzip text file ({error}); copy it again") from error
    for number, row in enumerate(rows, 1):
        if len(row) != width:
            raise InputError(f"{path}, line {number}: {len(row)} columns instead of {width}; copy the file again")
    return rows


def _numbers(path: Path, rows: list[list[str]]) -> Floats:
    """Rows of words as finite numbers (N, width). Raises InputError with the line of the first that is none."""
    try:
        table = np.array(rows, dtype=np.float64)
        if np.isfinite(table).all():
            return table if len(rows) else np.zeros((0, LABEL))
    except ValueError:
        pass
    number, word = next((n, word) for n, row in enumerate(rows, 1) for word in row if not _is_number(word))
    raise InputError(f"{path}, line {number}: '{word}' is no finite number; copy the file again")


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def _offsets(path: Path, frame: Floats, num_frames: int) -> Ints:
    """Where each frame's rows begin, (T + 1,). Raises InputError for frames out of order or without a pose."""
    wrong = np.flatnonzero((frame != np.round(frame)) | (frame < 0) | (frame >= num_frames))
    if len(wrong):
        raise InputError(
            f"{path}, line {wrong[0] + 1}: frame is {frame[wrong[0]]:g}; there are poses of frames 0 to "
            f"{num_frames - 1}"
        )
    back = np.flatnonzero(np.diff(frame) < 0)
    if len(back):
        raise InputError(
            f"{path}, line {back[0] + 2}: frame {frame[back[0] + 1]:g} follows frame {frame[back[0]]:g}; sort the lines"
        )
    return np.searchsorted(frame, np.arange(num_frames + 1)).astype(np.int64)


def _check_sizes(path: Path, camera: Floats) -> None:
    wrong = np.flatnonzero((camera[:, :3] <= 0).any(1))
    if len(wrong):
        size = ", ".join(f"{value:g}" for value in camera[wrong[0], :3])
        raise InputError(f"{path}, line {wrong[0] + 1}: height, width and length are {size}; they are above 0 m")
