"""Scores of a filter on a sequence of KITTI: (posterior, scene) -> {name: value}."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from experiments.kitti_evaluation import evaluate
from experiments.kitti_existence import candidates
from experiments.kitti_folds import Labelled, label, learn, report
from experiments.scenarios.junction import DATA_ROOT
from experiments.scenarios.kitti_scans import KittiTruth, kitti_scans
from experiments.scenarios.kitti_tracking import sequences
from experiments.scenarios.scene import Scene, TrafficTruth
from inference.posterior import Posterior
from inference.tracks import Tracks
from models.objects.traffic import Traffic

KEPT = ("mota", "hota", "idf1", "ids", "frag", "recall", "precision")


def followed(
    traffic: Traffic, follow: Callable[..., Tracks], sequence: str, *, data_root: str = DATA_ROOT, **readings: Any
) -> tuple[KittiTruth, Labelled, Tracks]:
    """What a filter holds possible in a sequence; `readings` are those of experiments.scenarios.kitti_scans."""
    scene = kitti_scans(sequence, data_root=data_root, **readings)
    tracks = follow(traffic, scene.data.scans)
    found = candidates(tracks, scene.data.scans, scene.truth.sequence)
    return scene.truth, label(scene.truth, found), tracks


def metrics(
    posterior: Posterior, scene: Scene, *, traffic: Traffic, follow: Callable[..., Tracks], data_root: str = DATA_ROOT
) -> dict[str, float]:
    """experiments.kitti_evaluation of the boxes that the filter reports, and the median time of a frame [ms]. What
    labels teach (experiments.kitti_folds) is learnt on all other sequences that are there: the filter `follow` runs on
    each of them. Nothing without tracks of a sequence of KITTI.

    kitti_mota          1 - (missed + false + switches) / labels (CLEAR), of the boxes that are reported
    kitti_hota          higher order tracking accuracy (trackeval)
    kitti_idf1          F1 of detections whose identity is right (trackeval)
    kitti_ids           switches: labels paired with another track than in the frame before
    kitti_frag          fragmentations: labels whose track changes or comes back
    kitti_recall        share of the labels with a box
    kitti_precision     share of the boxes with a label
    kitti_ms_per_frame  median time of the filter [ms]"""
    if not isinstance(posterior, Tracks) or not isinstance(scene.truth, KittiTruth):
        return {}
    own = scene.truth.sequence
    others = [
        followed(traffic, follow, name, data_root=data_root, **scene.info["readings"])[1]
        for name in sequences(data_root)
        if name != own.name
    ]
    boxes = report(candidates(posterior, scene.data.scans, own), learn(others))
    scores = evaluate([scene_of(scene.truth)], [boxes], average=False)
    ms = 1e3 * float(np.median(frame_seconds(posterior)))
    return {f"kitti_{name}": scores[name] for name in KEPT} | {"kitti_ms_per_frame": ms}


def figures(posterior: Posterior, scene: Scene, *, traffic: Traffic, view: float | None = None) -> dict[str, Any]:
    """experiments.view_metrics.figures, with the paths of the labelled cars and vans; `view` is the side of the moving
    picture [m]."""
    from experiments import view_metrics

    if not isinstance(scene.truth, KittiTruth):
        return {}
    return view_metrics.figures(posterior, scene._replace(truth=paths_of(scene.truth)), traffic=traffic, view=view)


def paths_of(truth: KittiTruth) -> TrafficTruth:
    """Where the labelled cars and vans were; their velocities are unknown."""
    labels, cars = truth.labels, np.isin(truth.labels.kind, ["Car", "Van"])
    unknown = np.full(int(cars.sum()), np.nan)
    return TrafficTruth(
        time=truth.sequence.time,
        offset=np.concatenate([[0], np.cumsum(cars)])[labels.offset],
        label=labels.track[cars],
        x=labels.position[cars, 0],
        y=labels.position[cars, 1],
        vx=unknown,
        vy=unknown,
        heading=labels.heading[cars],
        length=labels.size[cars, 2],
        width=labels.size[cars, 1],
        kind=np.zeros(len(unknown), dtype=np.int64),
    )


def scene_of(truth: KittiTruth) -> Scene:
    """The sequence beside its labels, as the evaluation reads them."""
    return Scene(truth.sequence, truth.labels, f"KITTI {truth.sequence.name}", {})


def frame_seconds(tracks: Tracks) -> Any:
    """(T,) that the filter took for all scans of each frame [s]."""
    frame = np.unique(tracks.time, return_inverse=True)[1]
    return np.bincount(frame, tracks.info["step_seconds"])
