"""KITTI's tracking sequences as scans of two sensors, `pointrcnn` (boxes from laser points) and `rrc` (boxes in the
image of the camera), in the frame of the poses: what models of traffic read.

A detector's score s is a logit of its own. What it says, and how noise falls with it, was read off the labels once for
all sequences together, with few digits (benchmarks.kitti_folds chooses slope and sharpening for each from the others):

    log p(s | car) / p(s | false alarm) = slope (s - 2),  within [-6, 8]
    standard deviations: those of NOISE times exp(-sharpening (s - 7)),  within [0.6, 3]
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.junction import DATA_ROOT
from experiments.scenarios.kitti_tracking import KittiLabels, KittiSequence, kitti_tracking
from experiments.scenarios.scene import Scene
from models.objects.scans import Recording, Scan

Floats = NDArray[np.float64]

LASER, CAMERA = "pointrcnn", "rrc"
SLOPE, EVEN, SAID = 0.85, 2.0, (-6.0, 8.0)
SHARPENING, PLAIN, FACTOR = 0.15, 7.0, (0.6, 3.0)
NOISE = (0.12, 0.07, 0.05, 0.08, 0.1, 0.1, 0.3)  # along and across the line of sight [m], axis [rad], z, h, w, l [m]
IMAGE_NOISE, BLUR = (0.003, 0.003, 0.002), (0.05, 0.05, 0.07)  # left and right side [rad], height as a tangent
MARGIN, BLIND = 3.0, 1.0  # a side nearer to the border is cut off [px], and says as much


class KittiTruth(NamedTuple):
    """The sequence that scans were made of, and what people labelled in it."""

    sequence: KittiSequence
    labels: KittiLabels


def kitti_scans(
    sequence: str = "0006",
    camera: bool = False,
    slope: float = SLOPE,
    sharpening: float = SHARPENING,
    data_root: str = DATA_ROOT,
) -> Scene:
    """A tracking sequence of KITTI: data a Recording, truth a KittiTruth.

    sequence  see experiments.scenarios.kitti_tracking
    camera    whether the camera's boxes are there, too
    slope, sharpening  of what a score of the laser's detector says, and of how noise falls with it"""
    scene = kitti_tracking(sequence, data_root)
    readings = {"camera": camera, "slope": slope, "sharpening": sharpening}
    return scene._replace(
        data=Recording(scans_of(scene.data, camera=camera, slope=slope, sharpening=sharpening)),
        truth=KittiTruth(scene.data, scene.truth),
        info=scene.info | {"readings": readings},
    )


def scans_of(
    sequence: KittiSequence, *, camera: bool = False, slope: float = SLOPE, sharpening: float = SHARPENING
) -> tuple[Scan, ...]:
    """The scans of a sequence: of the laser's detector at each frame, followed by those of the camera's."""
    scans = list[Scan]()
    for t in range(len(sequence.time)):
        scans.append(laser_scan(sequence, t, slope, sharpening))
        if camera:
            scans.append(camera_scan(sequence, t))
    return tuple(scans)


def pose_at(sequence: KittiSequence, t: int) -> Floats:
    """(3,) x, y [m] and heading [rad] of the camera."""
    pose = sequence.pose[t]
    return np.array([pose[0, 3], pose[1, 3], np.arctan2(pose[1, 0], pose[0, 0])])


def laser_scan(sequence: KittiSequence, t: int, slope: float, sharpening: float) -> Scan:
    """What models.objects.box_detector.BoxDetector measures."""
    found, pose = sequence.detections, pose_at(sequence, t)
    rows = slice(found.offset[t], found.offset[t + 1])
    along = found.position[rows, :2] - pose[:2]
    distance, bearing = np.hypot(*along.T), np.arctan2(along[:, 1], along[:, 0]) - pose[2]
    axis = found.heading[rows] - pose[2]
    values = np.column_stack([distance, bearing, axis, found.position[rows, 2], found.size[rows]])
    score = found.score[rows]
    std = np.array(NOISE) * np.clip(np.exp(-sharpening * (score - PLAIN)), *FACTOR)[:, None]
    std[:, 1] /= np.maximum(distance, 1.0)
    said = 1.0 / (1.0 + np.exp(-np.clip(slope * (score - EVEN), *SAID)))
    return Scan(LASER, float(sequence.time[t]), values, pose, np.square(std)[:, :, None] * np.eye(len(NOISE)), said)


def camera_scan(sequence: KittiSequence, t: int) -> Scan:
    """What models.objects.box_detector.ImageBox measures."""
    found, pose, P = sequence.camera_boxes, pose_at(sequence, t), sequence.projection
    rows = slice(found.offset[t], found.offset[t + 1])
    box = found.image[rows]
    tall = (box[:, 3] - box[:, 1]) / P[1, 1]
    values = np.column_stack([np.arctan2(P[0, 2] - box[:, [0, 2]], P[0, 0]), tall])
    width, height = sequence.image
    cut = np.column_stack(
        [box[:, 0] < MARGIN, box[:, 2] > width - MARGIN, (box[:, 1] < MARGIN) | (box[:, 3] > height - MARGIN)]
    )
    std = np.where(cut, BLIND, IMAGE_NOISE + np.multiply.outer(tall, BLUR))
    return Scan(CAMERA, float(sequence.time[t]), values, pose, np.square(std)[:, :, None] * np.eye(3))
