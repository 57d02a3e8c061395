"""Pictures of tracks of many objects: all paths from above, what is believed over time, and the scene in motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from experiments.junction_figures import INK, TRACK, TRUE_LINE
from experiments.road_figures import ESTIMATE, FAINT
from experiments.scenarios.scene import Scene, TrafficTruth
from experiments.tracking_animation import Animation
from experiments.tracking_metrics import BAND, judge, paths
from inference.posterior import Posterior
from inference.tracks import Tracks, rows_by_label

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Readings = Sequence[tuple[float, Floats]]  # time [s] and positions (M, 2) in the world [m] of each scan

COLOURS = (
    "#2a6fbb", "#d9722e", "#3b8a5a", "#7b3f9e", "#c2459e", "#8a5a2b", "#1c9aa0", "#b8352f", "#7a8b1f", "#4b4fc4",
)  # fmt: skip
NAMED = 40  # labels that a picture has room for
MARGIN = 0.06  # of a picture's extent, around what it shows


def figures(
    posterior: Posterior,
    scene: Scene,
    *,
    readings: Callable[[Any], Readings] | None = None,
    threshold: float = 0.5,
    cutoff: float = 10.0,
    order: float = 1.0,
    window: int = 10,
    view: float | None = None,
    frames: int = 60,
) -> dict[str, Any]:
    """Nothing for a posterior without tracks.

    readings               the scene's data -> the measurements to draw in grey; None draws none
    threshold              existence above which an object is drawn as a track
    cutoff, order, window  of OSPA and OSPA(2), as in experiments.tracking_metrics
    view                   side of the moving picture [m], which then goes with the car; None shows the whole scene
    frames                 of the moving picture at most; 0 draws none
    """
    if not isinstance(posterior, Tracks):
        return {}
    truth = scene.truth if isinstance(scene.truth, TrafficTruth) else None
    seen = [] if readings is None else list(readings(scene.data))
    colour = colours(posterior.confirmed(threshold).label)
    drawn: dict[str, Any] = {
        "tracks": from_above(posterior.confirmed(threshold), truth, seen, colour),
        "over_time": over_time(
            posterior, truth, colour, threshold=threshold, cutoff=cutoff, order=order, window=window
        ),
    }
    if frames:
        limits = extent(posterior.confirmed(threshold), truth, seen)
        drawn["animation"] = Animation(posterior, truth, seen, colour, limits, view, ego(scene.data), frames)
    return drawn


def colours(label: Ints) -> dict[int, str]:
    """{label: colour}, by turns in the order of first appearance."""
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(rows_by_label(label))}


def ego(data: Any) -> Floats | None:
    """(T, 2) positions of the car at the scans, None where they do not tell."""
    data = getattr(data, "scans", data)
    scans = list(data) if isinstance(data, Sequence) else []
    if not scans or not all(hasattr(scan, "pose") for scan in scans):
        return None
    return np.array([scan.pose[:2] for scan in scans], dtype=np.float64)


def extent(tracks: Tracks, truth: TrafficTruth | None, readings: Readings) -> tuple[Floats, Floats]:
    """Lower left and upper right corner of what is to be shown [m]: true and estimated paths, else the readings."""
    corners = [tracks.position] + ([truth.position] if truth is not None else [])
    if not sum(map(len, corners)):
        corners = [points for _, points in readings]
    points = np.concatenate([*corners, np.zeros((0, 2))])
    if not len(points):
        points = np.zeros((1, 2))
    low, high = points.min(0), points.max(0)
    margin = max(MARGIN * float((high - low).max()), 5.0)
    return low - margin, high + margin


def from_above(tracks: Tracks, truth: TrafficTruth | None, readings: Readings, colour: dict[int, str]) -> Figure:
    """All tracks in the colours of their labels, true paths dashed, measurements grey."""
    low, high = extent(tracks, truth, readings)
    ratio = float(np.clip((high - low)[1] / (high - low)[0], 0.35, 1.1))
    figure = Figure(figsize=(8.0, 8.0 * ratio + 0.8), layout="constrained")
    axes = figure.add_subplot()
    handles = []
    if points := [points for _, points in readings if len(points)]:
        axes.plot(*np.concatenate(points).T, ".", ms=1.5, color=FAINT, alpha=0.6, zorder=1, rasterized=True)
        handles.append(Line2D([], [], ls="none", marker=".", color=FAINT, label="measurement"))
    if truth is not None:
        for path in paths(truth.label, truth.offset, truth.position):
            axes.plot(*path.T, zorder=4, **TRUE_LINE)
        handles.append(Line2D([], [], label="true path", **TRUE_LINE))
    places = paths(tracks.label, tracks.offset, tracks.position)
    lasting = sorted(rows_by_label(tracks.label).items(), key=lambda item: -len(item[1]))
    told = {label for label, _ in lasting[:NAMED]}
    for label, path in zip(np.unique(tracks.label), places, strict=True):
        axes.plot(*path.T, lw=2.2, color=colour[int(label)], solid_capstyle="round", zorder=3)
        axes.plot(*path[alone(path[:, 0])].T, ".", ms=5, mew=0, color=colour[int(label)], zorder=3)
        if int(label) in told:
            begin = path[~np.isnan(path[:, 0])][0]
            note(axes, begin, str(label), colour[int(label)])
    handles.append(Line2D([], [], lw=2.2, color=COLOURS[0], label="track, its label where it begins"))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.set_title(f"{len(lasting)} tracks", loc="left", color=INK, fontsize=11)
    axes.legend(handles=handles, frameon=False, fontsize=9, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    return figure


def alone(values: Floats) -> NDArray[np.bool_]:
    """(T,) which have no neighbour, so that a line does not show them; NaN are none."""
    there = np.concatenate([[False], np.isfinite(values), [False]])
    return there[1:-1] & ~there[:-2] & ~there[2:]


def note(axes: Axes, place: Floats, text: str, colour: str) -> None:
    """A label beside a place, inside the picture."""
    words = axes.annotate(text, tuple(place), (4, 4), textcoords="offset points", color=colour, fontsize=8, zorder=6)
    words.set_clip_on(True)
    words.set_bbox({"facecolor": "white", "alpha": 0.7, "lw": 0, "pad": 0.6})


def over_time(
    tracks: Tracks,
    truth: TrafficTruth | None,
    colour: dict[int, str],
    *,
    threshold: float,
    cutoff: float,
    order: float,
    window: int,
) -> Figure:
    """Existence of each track, the number of objects with its 90 % band, and where the truth is known OSPA."""
    rows = 2 if truth is None else 3
    figure = Figure(figsize=(8.0, 2.1 * rows), layout="constrained")
    existence, count, *rest = figure.subplots(rows, 1, sharex=True)
    for label, own in rows_by_label(tracks.label).items():
        if label in colour:
            sure = np.full(len(tracks.time), np.nan)
            sure[tracks.scan[own]] = tracks.existence[own]
            existence.plot(tracks.time, sure, lw=1.2, color=colour[label])
            existence.plot(tracks.time[alone(sure)], sure[alone(sure)], ".", ms=4, mew=0, color=colour[label])
    above = existence.axhline(threshold, color=TRACK, lw=0.8, ls=":", label="a track above this")
    existence.legend(handles=[above], frameon=False, fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    existence.set(ylim=(-0.03, 1.05), ylabel="existence")
    low, high = (tracks.count_quantile(q) for q in BAND)
    count.fill_between(tracks.time, low, high, step="mid", color=ESTIMATE, alpha=0.25, lw=0, label="90 % band")
    count.plot(tracks.time, tracks.count_mean(), color=ESTIMATE, lw=1.4, label="expected")
    count.set(ylim=(0.0, None), ylabel="number of objects")
    if truth is not None:
        found = judge(tracks.confirmed(threshold), truth, cutoff=cutoff, order=order, window=window)
        count.step(tracks.time, found.true_count, where="mid", label="true", **TRUE_LINE)
        (errors,) = rest
        errors.plot(tracks.time, found.ospa, lw=1.0, color=ESTIMATE, label="OSPA")
        errors.plot(tracks.time, found.ospa2, lw=1.4, color=COLOURS[1], label=f"OSPA(2), {window} scans")
        errors.set(ylim=(0.0, None), ylabel=f"distance, at most {cutoff:g} m [m]")
        errors.legend(frameon=False, fontsize=8, ncols=2)
    count.legend(frameon=False, fontsize=8, ncols=3)
    for axes in (existence, count, *rest):
        axes.grid(color=FAINT, lw=0.4)
        axes.margins(x=0)
    (existence, count, *rest)[-1].set_xlabel("time [s]")
    return figure
