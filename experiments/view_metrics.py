"""Scores and pictures of those tracks that are within the view of a sensor.

An object that leaves every view may live on, and filters say so; a scenario's truth tells only who can be seen. So
tracks outside are no part of either."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments import tracking_metrics
from experiments.placed_readings import PlacedReadings
from experiments.scenarios.scene import Scene
from inference.posterior import Posterior
from inference.tracks import Tracks
from models.objects.motion import Body
from models.objects.scans import Recording
from models.objects.sensors import mounted
from models.objects.traffic import Traffic


def metrics(posterior: Posterior, scene: Scene, *, traffic: Traffic, cutoff: float = 10.0) -> dict[str, float]:
    """Those of experiments.tracking_metrics, of tracks in view of a sensor of `traffic`."""
    if not isinstance(posterior, Tracks) or not isinstance(scene.data, Recording):
        return {}
    return tracking_metrics.metrics(in_view(posterior, scene.data, traffic), scene, cutoff=cutoff)


def figures(
    posterior: Posterior, scene: Scene, *, traffic: Traffic, cutoff: float = 10.0, view: float | None = None
) -> dict[str, Any]:
    """Those of experiments.tracking_figures, of tracks in view of a sensor of `traffic`; `view` is the side of the
    moving picture [m], None shows the whole scene."""
    from experiments import tracking_figures

    if not isinstance(posterior, Tracks) or not isinstance(scene.data, Recording):
        return {}
    seen = in_view(posterior, scene.data, traffic)
    return tracking_figures.figures(seen, scene, readings=PlacedReadings(traffic), cutoff=cutoff, view=view)


def in_view(tracks: Tracks, recording: Recording, traffic: Traffic) -> Tracks:
    """The rows whose mean is within the view of a sensor, of any that the recording has scans of, on the car where it
    was at the scan of that time."""
    order = np.argsort([scan.time for scan in recording.scans], kind="stable")
    time = np.array([recording.scans[i].time for i in order])
    used = {scan.sensor for scan in recording.scans}
    keep = np.zeros(len(tracks.label), dtype=bool)
    for t, now in enumerate(tracks.time):
        rows = slice(tracks.offset[t], tracks.offset[t + 1])
        x, y = tracks.position[rows].T
        body = Body(x, y, 0.0, 0.0)
        pose = recording.scans[order[max(int(np.searchsorted(time, now, side="right")) - 1, 0)]].pose
        for sensor in traffic.sensors:
            if sensor.name in used:
                keep[rows] |= sensor.view(body, tuple(mounted(pose, sensor.mount)), sensor.settings[3:], np) > 0.5
    return tracks.kept(keep)
