"""Boxes between camera, world and image, and how much they overlap."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.box_overlap import overlap
from experiments.kitti_boxes import image_boxes, in_view, pose_of, to_camera, to_world
from tests.drawn_cars import IMAGE, PROJECTION, car


def turned(angle: float, shift: tuple[float, float, float]) -> np.ndarray:
    """A pose (1, 4, 4) from KITTI's row: the camera turned about its y axis, then shifted."""
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return pose_of(np.concatenate([rotation, np.array(shift)[:, None]], 1).reshape(1, 12))


def drawn(rng: np.random.Generator, num: int) -> np.ndarray:
    """Boxes near one another, of all directions."""
    size = rng.uniform([1.0, 1.0, 2.0], [2.0, 2.5, 5.0], (num, 3))
    place = rng.uniform([-2.0, 1.0, 18.0], [2.0, 2.0, 22.0], (num, 3))
    return np.concatenate([size, place, rng.uniform(-np.pi, np.pi, (num, 1))], 1)


def test_a_car_ahead_and_to_the_right_lies_forward_and_to_the_right_in_the_world() -> None:
    position, heading = to_world(car(3.0, 20.0, -np.pi / 2)[None], np.eye(4)[None])  # drives away from the camera
    np.testing.assert_allclose(position, [[20.0, -3.0, -1.6]])
    np.testing.assert_allclose(heading, [0.0], atol=1e-12)
    _, sideways = to_world(car(turn=0.0)[None], np.eye(4)[None])  # to the right
    np.testing.assert_allclose(sideways, [-np.pi / 2])


def test_a_camera_that_turned_right_sees_what_is_ahead_of_it_on_the_right_of_where_it_began() -> None:
    position, heading = to_world(car(0.0, 20.0, -np.pi / 2)[None], turned(np.pi / 2, (1.0, 0.5, 2.0)))
    np.testing.assert_allclose(position, [[2.0, -21.0, -2.1]], atol=1e-12)
    np.testing.assert_allclose(heading, [-np.pi / 2])


def test_world_and_camera_boxes_go_there_and_back() -> None:
    rng = np.random.default_rng(0)
    box, pose = drawn(rng, 50), np.repeat(turned(0.7, (3.0, -1.0, 40.0)), 50, 0)
    position, heading = to_world(box, pose)
    np.testing.assert_allclose(to_camera(position, heading, box[:, :3], pose), box, atol=1e-12)


def test_pitch_costs_a_heading_its_square_at_most() -> None:
    pitch = 0.05
    c, s = np.cos(pitch), np.sin(pitch)
    pose = pose_of(np.array([[1.0, 0, 0, 0, 0, c, -s, 0, 0, s, c, 0]]))
    box = car(2.0, 20.0, 0.8)[None]
    back = to_camera(*to_world(box, pose), box[:, :3], pose)
    np.testing.assert_allclose(back[:, :6], box[:, :6], atol=1e-12)
    assert 0.0 < abs(back[0, 6] - 0.8) < pitch**2


def test_an_image_box_goes_about_all_corners_and_is_cut_at_the_border() -> None:
    ahead = image_boxes(car(0.0, 20.0, -np.pi / 2)[None], PROJECTION, IMAGE)[0]  # its back is 18 m away
    np.testing.assert_allclose(ahead, [610 - 720 * 0.8 / 18, 170 + 720 * 0.1 / 22, 610 + 720 * 0.8 / 18, 170 + 64.0])
    beside = image_boxes(car(-14.0, 14.0)[None], PROJECTION, IMAGE)[0]
    assert beside[0] == 0.0 and 0 < beside[2] < 100


def test_what_is_beside_or_behind_the_camera_is_not_in_view() -> None:
    boxes = np.stack([car(), car(-14.0, 14.0), car(40.0, 10.0), car(0.0, -20.0), car(0.0, -1.0, -np.pi / 2)])
    boxes[3:, 0] = 3.0  # as high as to be seen, were they ahead
    np.testing.assert_array_equal(in_view(boxes, PROJECTION, IMAGE), [True, True, False, False, True])


@pytest.mark.parametrize(
    ("moved", "iou"),
    [
        ((0.0, 0.0, 0.0, 0.0), 1.0),
        ((2.0, 0.0, 0.0, 0.0), 1 / 3),  # half of the length
        ((0.0, 0.75, 0.0, 0.0), 1 / 3),  # half of the height
        ((0.0, 0.0, 0.8, 0.0), 1 / 3),  # half of the width
        ((0.0, 0.0, 0.0, np.pi), 1.0),  # front to back
        ((0.0, 0.0, 0.0, np.pi / 2), 1.6**2 / (2 * 1.6 * 4 - 1.6**2)),  # a cross
        ((4.0, 0.0, 0.0, 0.0), 0.0),
        ((0.0, 1.5, 0.0, 0.0), 0.0),
    ],
)
def test_overlap_of_hand_worked_cases(moved: tuple[float, ...], iou: float) -> None:
    """Along the length, down, across, and turned."""
    for turn in (0.0, 0.6):
        c, s = np.cos(turn), np.sin(turn)
        along, down, across, more = moved
        a = car(1.0, 20.0, turn)
        b = a + np.array([0, 0, 0, c * along + s * across, down, -s * along + c * across, more])
        np.testing.assert_allclose(overlap(a[None], b[None]), [[iou]], atol=1e-12)


def test_a_square_turned_by_45_degrees_shares_an_octagon() -> None:
    square = np.array([[1.0, 2.0, 2.0, 0.0, 0.0, 0.0, 0.0]])
    diamond = square + np.array([0, 0, 0, 0, 0, 0, np.pi / 4])
    octagon = 8 * (np.sqrt(2) - 1)  # with an inscribed circle of radius 1
    np.testing.assert_allclose(overlap(square, diamond), octagon / (8 - octagon))


def test_overlap_is_the_share_of_points_in_both() -> None:
    """20 000 points uniform in a: V / V_a is within 5 standard errors, at most 0.5 / sqrt(20 000) each."""
    rng = np.random.default_rng(1)
    a, b = drawn(rng, 8), drawn(rng, 8)
    iou = overlap(a, b)
    num = 20_000
    for i in range(len(a)):
        unit = rng.uniform([-0.5, -1.0, -0.5], [0.5, 0.0, 0.5], (num, 3))
        points = from_own(unit * a[i, [2, 0, 1]], a[i])
        for j in range(len(b)):
            inside = to_own(points, b[j]) / b[j, [2, 0, 1]]
            share = ((np.abs(inside[:, [0, 2]]) < 0.5).all(1) & (inside[:, 1] < 0) & (inside[:, 1] > -1)).mean()
            volumes = a[i, :3].prod(), b[j, :3].prod()
            shared = iou[i, j] * sum(volumes) / (1 + iou[i, j])
            assert abs(shared / volumes[0] - share) < 5 * 0.5 / num**0.5
    assert 0.3 < (iou > 0.05).mean()  # there is something to see


def from_own(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Points along a box's length, down and across from the middle of its bottom, in the camera frame."""
    return points @ axes(box) + box[3:6]


def to_own(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    return (points - box[3:6]) @ axes(box).T


def axes(box: np.ndarray) -> np.ndarray:
    c, s = np.cos(box[6]), np.sin(box[6])
    return np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])


def test_overlap_is_symmetric_and_one_with_itself() -> None:
    boxes = drawn(np.random.default_rng(2), 30)
    iou = overlap(boxes, boxes)
    np.testing.assert_allclose(iou, iou.T, atol=1e-12)
    np.testing.assert_allclose(np.diag(iou), 1.0)
    assert overlap(boxes[:0], boxes).shape == (0, 30)
