"""The reader of KITTI's tracking sequences: a made-up one, broken ones, and the real ones where they are."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from experiments.kitti_boxes import image_boxes, to_camera
from experiments.scenarios.kitti_tracking import frames_of, kitti_tracking, sequences
from models.program import InputError

POSE = "1 0 0 0 0 1 0 0 0 0 1 {}"
DETECTION = "{},2,600,150,640,180,{},1.5,1.6,4.0,3.0,1.6,20.0,-1.5707963,0"
LABEL = "{} {} {} 0 1 0 600 150 640 180 1.5 1.6 4.0 3.0 1.6 20.0 -1.5707963"
FILES = {
    "detections_pointrcnn_car/0001.txt.gz": [DETECTION.format(0, 4.5), DETECTION.format(2, -0.5)],
    "detections_rrc_car_2d/0001.txt.gz": ["0,600,150,640,180,0.9"],
    "labels/0001.txt.gz": [LABEL.format(0, 3, "Car"), LABEL.format(1, 3, "Car"), LABEL.format(1, 4, "Van")],
    "labels/0001.dontcare.txt.gz": ["2 -1 DontCare -1 -1 -10 10 20 30 40 -1000 -1000 -1000 -10 -1 -1 -1"],
    "camera_poses_orbslam3/0001.txt.gz": [POSE.format(2 * t) for t in range(3)],
    "calib/0001.txt": ["P0: 1", "P2: 720 0 610 45 0 720 170 0 0 0 1 0", "R0_rect: 1"],
}


def write(root: Path, **changed: list[str]) -> str:
    """The made-up sequence below a data root, some of its files changed, by their first word."""
    for name, lines in FILES.items():
        lines = next((new for word, new in changed.items() if name.startswith(word)), lines)
        path = root / "tracking" / "kitti" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        text = "".join(f"{line}\n" for line in lines).encode()
        path.write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
    return str(root)


def test_a_sequence_is_read_with_its_empty_frames(tmp_path: Path) -> None:
    found = kitti_tracking("0001", write(tmp_path))
    data, truth = found.data, found.truth
    np.testing.assert_allclose(data.time, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(data.detections.offset, [0, 1, 1, 2])
    np.testing.assert_allclose(data.detections.position, [[20, -3, -1.6], [24, -3, -1.6]])  # the camera drove on 4 m
    np.testing.assert_allclose(data.detections.heading, 0.0, atol=1e-7)
    np.testing.assert_allclose(data.detections.score, [4.5, -0.5])
    np.testing.assert_array_equal(data.camera_boxes.offset, [0, 1, 1, 1])
    np.testing.assert_array_equal(truth.offset, [0, 1, 3, 3])
    assert list(truth.kind) == ["Car", "Car", "Van"] and list(truth.occlusion) == [1, 1, 1]
    np.testing.assert_allclose(truth.position[:, 0], [20, 22, 22])
    np.testing.assert_allclose(truth.dont_care, [[10, 20, 30, 40]])
    np.testing.assert_array_equal(truth.dont_care_offset, [0, 0, 0, 1])
    assert data.projection[0, 3] == 45 and found.info["cars"] == 1


def test_files_may_be_empty_but_for_the_poses(tmp_path: Path) -> None:
    found = kitti_tracking("0001", write(tmp_path, detections=[], labels=[]))
    assert len(found.data.detections.score) == len(found.truth.track) == len(found.truth.dont_care) == 0
    np.testing.assert_array_equal(found.data.detections.offset, [0, 0, 0, 0])


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"detections_pointrcnn": ["0,2,3"]}, r"detections.*0001.txt.gz, line 1: 3 columns instead of 15"),
        ({"detections_pointrcnn": [DETECTION.format(0, "x")]}, "line 1: 'x' is no finite number"),
        ({"detections_pointrcnn": [DETECTION.format(0, 1), DETECTION.format(0, "nan")]}, "line 2: 'nan' is no finite"),
        ({"detections_pointrcnn": [DETECTION.format(3, 1)]}, "line 1: frame is 3; there are poses of frames 0 to 2"),
        (
            {"detections_pointrcnn": [DETECTION.format(2, 1), DETECTION.format(1, 1)]},
            "line 2: frame 1 follows frame 2; sort the lines",
        ),
        ({"detections_pointrcnn": [DETECTION.format(0, 1).replace("1.6,4.0", "0,4.0")]}, "length are 1.5, 0, 4"),
        ({"labels/0001.txt": ["0 1 Car 0"]}, r"labels.*line 1: 4 columns instead of 17"),
        ({"camera_poses": ["1 0 0"]}, r"camera_poses.*line 1: 3 columns instead of 12"),
        ({"calib": ["P0: 1"]}, "no line begins with 'P2:'"),
    ],
)
def test_what_cannot_be_read_is_named_with_file_and_line(
    changed: dict[str, list[str]], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=sentence):
        kitti_tracking("0001", write(tmp_path, **changed))


def test_missing_data_and_unknown_sequences_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no tracking/kitti/detections_pointrcnn_car in .*scenario.data_root"):
        kitti_tracking(data_root=str(tmp_path))
    root = write(tmp_path)
    with pytest.raises(InputError, match=r"is named '0099'.*there are 0001"):
        kitti_tracking("0099", root)
    (tmp_path / "tracking/kitti/calib/0001.txt").unlink()
    with pytest.raises(InputError, match="no tracking/kitti/calib"):
        kitti_tracking("0001", root)


def test_a_broken_archive_is_named(tmp_path: Path) -> None:
    root = write(tmp_path)
    (tmp_path / "tracking/kitti/labels/0001.txt.gz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"0001.txt.gz cannot be read as a gzip text file"):
        kitti_tracking("0001", root)


def test_detectors_image_boxes_are_what_their_boxes_cover_of_the_image() -> None:
    """Real ones: so a coasting track, which has no detection, is judged by the same rule."""
    try:
        found = [kitti_tracking(name).data for name in sequences()[:2]]
    except InputError as absent:
        pytest.skip(str(absent))
    for data in found:
        ours = image_boxes(data.detections.camera, data.projection, data.image)
        far = data.detections.camera[:, 5] > 6.0  # nearer ones have corners behind the camera
        np.testing.assert_allclose(ours[far], data.detections.image[far], atol=0.1)  # px
        pose = data.pose[frames_of(data.detections.offset)]
        back = to_camera(data.detections.position, data.detections.heading, data.detections.size, pose)
        np.testing.assert_allclose(back[:, :6], data.detections.camera[:, :6], atol=1e-3)
