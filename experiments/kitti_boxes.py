"""Boxes of vehicles between KITTI's camera frame, the frame of the poses and the image: the home of the conversions.

A box of the camera frame is KITTI's row (h, w, l, x, y, z, rot_y): height, width, length [m], the middle of its bottom
in the rectified camera frame (x right, y down, z forward) [m], and the rotation about y: its length points along
(cos rot_y, 0, -sin rot_y). Geiger et al. (2013), Vision meets robotics: the KITTI dataset, section III.

The frame of the poses is x forward, y left, z up at the first frame. A pose (4, 4) leads there from the same axes at
the camera, [R t; 0 1]:

    position = R A (x, y, z) + t,   (cos heading, sin heading) along the first two of R A (cos rot_y, 0, -sin rot_y)

A turns the camera's axes. Boxes stand upright in both frames: where the car pitches by e, what a heading loses on the
way there and back is of the order e^2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # right, down, forward to forward, left, up
NEAR = 0.3  # corners nearer to the plane of the camera, or behind it, are projected from here [m]
# Corners of a box of length, height and width 1 about the middle of its bottom, (3, 8)
UNIT = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-1.0, 0.0) for k in (-0.5, 0.5)]).T


def pose_of(rows: Floats) -> Floats:
    """Poses (T, 4, 4) from rows (T, 12) that lead from the camera to the first camera, in the camera's axes."""
    camera = rows.reshape(-1, 3, 4)
    pose = np.tile(np.eye(4), (len(rows), 1, 1))
    pose[:, :3, :3] = AXES @ camera[:, :, :3] @ AXES.T
    pose[:, :3, 3] = camera[:, :, 3] @ AXES.T
    return pose


def to_world(box: Floats, pose: Floats) -> tuple[Floats, Floats]:
    """Positions (N, 3) of the middles of the bottoms [m] and headings (N,) [rad] in the frame of the poses.

    box   (N, 7) in the camera frame
    pose  (N, 4, 4) of the camera at each"""
    turn = pose[:, :3, :3] @ AXES
    position = (turn @ box[:, 3:6, None])[..., 0] + pose[:, :3, 3]
    along = np.stack([np.cos(box[:, 6]), np.zeros(len(box)), -np.sin(box[:, 6])], 1)
    ahead = (turn @ along[..., None])[..., 0]
    return position, np.arctan2(ahead[:, 1], ahead[:, 0])


def to_camera(position: Floats, heading: Floats, size: Floats, pose: Floats) -> Floats:
    """Boxes (N, 7) of the camera frame: the way back of `to_world`.

    position  (N, 3), heading (N,) in the frame of the poses
    size      (N, 3) h, w, l [m]
    pose      (N, 4, 4) of the camera at each"""
    back = np.swapaxes(pose[:, :3, :3] @ AXES, 1, 2)
    place = (back @ (position - pose[:, :3, 3])[..., None])[..., 0]
    ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros(len(heading))], 1)
    along = (back @ ahead[..., None])[..., 0]
    return np.concatenate([size, place, np.arctan2(-along[:, 2], along[:, 0])[:, None]], 1)


def image_boxes(box: Floats, projection: Floats, image: tuple[int, int]) -> Floats:
    """What boxes (N, 7) of the camera frame cover of the image, (N, 4) left, top, right, bottom [px].

    projection  (3, 4) of the camera
    image       its width and height [px]

    The smallest rectangle about the eight corners, each side moved to the border where it is beyond: beside the image
    it has no width, but keeps its height. Corners at the plane of the camera and behind it are taken to be NEAR."""
    h, w, l, x, y, z, turn = box.T  # noqa: E741  (KITTI's letters)
    along, down, across = UNIT[:, None] * np.stack([l, h, w])[..., None]  # (N, 8) each
    c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
    depth = z[:, None] - s * along + c * across
    corners = np.stack([x[:, None] + c * along + s * across, y[:, None] + down, np.maximum(depth, NEAR)], -1)
    seen = corners @ projection[:, :3].T + projection[:, 3]
    uv = seen[..., :2] / seen[..., 2:]  # (N, 8, 2)
    return np.clip(np.concatenate([uv.min(1), uv.max(1)], 1), 0.0, np.tile(image, 2) - 1.0)


def in_view(box: Floats, projection: Floats, image: tuple[int, int]) -> NDArray[np.bool_]:
    """Whether any of a box is in the image, (N,): trackers that report others report what no label can confirm."""
    covers = image_boxes(box, projection, image)
    reach = 0.5 * (np.abs(np.sin(box[:, 6])) * box[:, 2] + np.abs(np.cos(box[:, 6])) * box[:, 1])
    return (covers[:, 2] > covers[:, 0]) & (covers[:, 3] > covers[:, 1]) & (box[:, 5] + reach > NEAR)
