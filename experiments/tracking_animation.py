"""Tracks in motion, from above, as a GIF: boxes or points, ellipses, labels; the fainter, the less certain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.scenarios.scene import TrafficTruth
from experiments.tracking_metrics import SAME_TIME, times_of
from inference.progress import Progress
from inference.tracks import Tracks

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

INCHES = 4.6
PER_SECOND = 12
SHOWN = 0.05  # least existence that is drawn
TAIL = 15  # scans of the path behind an object
SMOOTH = 15  # scans that the view is averaged over where no car leads it
ELLIPSE = float(np.sqrt(-2.0 * np.log(0.1)))  # standard deviations about 90 % of a normal plane
CIRCLE = np.stack([f(np.linspace(0.0, 2 * np.pi, 40)) for f in (np.cos, np.sin)])  # (2, 40)
CORNERS = 0.5 * np.array([[1, 1, -1, -1], [1, -1, -1, 1]], dtype=np.float64)  # (2, 4)
UNSURE, TRUE, CLUTTER = "#8a8f98", "#111111", "#b4bac1"
PAPER = {"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 1.0}  # behind words, which things may pass


@dataclass(frozen=True)
class Animation:
    """A picture in motion, stored by savefig as a figure is (experiments.report.save_figures), but as GIF.

    readings  times and positions (M, 2) of scans, drawn in grey at their time
    colour    {label: colour}; others are grey
    limits    corners of the whole scene [m]
    view      side of the picture [m], None shows the whole scene
    ego       (T, 2) middle of such a view; None where nobody leads it: it then goes with the objects
    frames    at most
    """

    tracks: Tracks
    truth: TrafficTruth | None
    readings: Sequence[tuple[float, Floats]]
    colour: dict[int, str]
    limits: tuple[Floats, Floats]
    view: float | None
    ego: Floats | None
    frames: int
    suffix: ClassVar[str] = ".gif"

    def savefig(self, file: Path, dpi: float = 130.0) -> None:
        """Draw all frames into a file; a bar tells how far it is where that takes more than two seconds."""
        from matplotlib.animation import PillowWriter

        shown = np.unique(np.linspace(0, len(self.tracks.time) - 1, self.frames).round().astype(int))
        low, high = self.corners()
        width, height = (high - low)[0]
        inch = max(width, height) / INCHES
        size = np.maximum(np.array([width, height]) / inch, 0.4 * INCHES)
        spare = (size * inch - [width, height]) / 2  # a flat scene has room above and below
        low, high = low - spare, high + spare
        figure = Figure(figsize=tuple(size), dpi=dpi)
        axes = figure.add_axes((0.004, 0.004, 0.992, 0.992))
        writer = PillowWriter(fps=PER_SECOND)
        with writer.saving(figure, str(file), dpi), Progress("drawing", len(shown)) as bar:
            for t in shown:
                axes.clear()
                axes.set(xlim=(low[t, 0], high[t, 0]), ylim=(low[t, 1], high[t, 1]), xticks=[], yticks=[])
                axes.set_aspect("equal")
                axes.spines[:].set_color(CLUTTER)
                self.draw(axes, int(t))
                writer.grab_frame()
                bar.advance(1)

    def corners(self) -> tuple[Floats, Floats]:
        """Lower left and upper right corners (T, 2) of the picture at each scan."""
        num = len(self.tracks.time)
        if self.view is None:
            return np.tile(self.limits[0], (num, 1)), np.tile(self.limits[1], (num, 1))
        middle = self.ego if self.ego is not None and len(self.ego) == num else followed(self.tracks, self.limits)
        return middle - self.view / 2, middle + self.view / 2

    def draw(self, axes: Axes, t: int) -> None:
        """What is believed after scan t, the measurements of that scan, and the truth."""
        now, sensor = self.tracks.time[t], self.tracks.sensor[t]
        for time, points in self.readings:
            if abs(time - now) <= SAME_TIME:
                axes.plot(*points.T, "x", ms=4, mew=0.8, color=CLUTTER, zorder=1)
        if self.truth is not None:
            true = times_of(self.truth, self.tracks.time[t : t + 1])[0]
            outline_truth(axes, self.truth, slice(self.truth.offset[true], self.truth.offset[true + 1]))
        outline_tracks(axes, self.tracks, t, self.colour)
        corner: dict[str, Any] = {"transform": axes.transAxes, "bbox": PAPER, "zorder": 9}
        axes.text(0.02, 0.98, f"{now:.2f} s  {sensor}", va="top", fontsize=9, color=TRUE, **corner)
        key = "x measurement   shaded: 90 %" if self.truth is None else "black: true   x measurement   shaded: 90 %"
        axes.text(0.98, 0.02, key, ha="right", fontsize=7, color=UNSURE, **corner)
        scale(axes)


def scale(axes: Axes) -> None:
    """A bar in the lower left corner, as long as it says."""
    left, right = axes.get_xlim()
    rough = 0.25 * (right - left)
    length = max(step for step in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 5000) if step <= max(rough, 1.0))
    share = length / (right - left)
    axes.plot([0.03, 0.03 + share], [0.03, 0.03], transform=axes.transAxes, color=TRUE, lw=1.6)
    axes.text(0.03 + share / 2, 0.038, f"{length} m", transform=axes.transAxes, ha="center", fontsize=8, color=TRUE)


def followed(tracks: Tracks, limits: tuple[Floats, Floats]) -> Floats:
    """(T, 2) a smooth path of the middle of the objects, by their existence."""
    weight = np.bincount(tracks.scan, tracks.existence, len(tracks.time))
    total = np.stack([np.bincount(tracks.scan, tracks.existence * v, len(tracks.time)) for v in tracks.position.T], -1)
    near = np.minimum(SMOOTH, len(weight))
    kernel = np.ones(2 * near + 1)
    smooth = [np.convolve(values, kernel)[near : near + len(values)] for values in (weight, *total.T)]
    middle = np.tile(0.5 * (limits[0] + limits[1]), (len(weight), 1))
    some = smooth[0] > 0.0
    middle[some] = np.stack(smooth[1:], -1)[some] / smooth[0][some, None]
    return middle


def outline_truth(axes: Axes, truth: TrafficTruth, rows: slice) -> None:
    """Boxes as dashed outlines, points as circles."""
    place = truth.position[rows]
    size = np.stack([truth.length[rows], truth.width[rows]], -1)
    solid = np.isfinite(size).all(1) & np.isfinite(truth.heading[rows])
    outlines = boxes(place[solid], truth.heading[rows][solid], size[solid])
    axes.add_collection(PolyCollection(list(outlines), facecolors="none", edgecolors=TRUE, linestyles="--", lw=0.9))
    axes.plot(*place[~solid].T, "o", ms=6, mfc="none", mec=TRUE, mew=0.9)


def outline_tracks(axes: Axes, tracks: Tracks, t: int, colour: dict[int, str]) -> None:
    """The objects after scan t: boxes where states have an extent, else points; ellipses; labels; and tails."""
    here, index = tracks.at(t), tracks.entries("x", "y")
    keep = here.existence >= SHOWN
    if not keep.any():
        return
    label, existence, mean = here.label[keep], here.existence[keep], here.mean[keep]
    place, paint = mean[:, index], [colour.get(int(name), UNSURE) for name in label]
    value, vector = np.linalg.eigh(here.covariance[keep][:, index][:, :, index])
    root = vector * np.sqrt(np.maximum(value, 0.0))[:, None]
    ellipses = place[:, None] + ELLIPSE * (root @ CIRCLE).swapaxes(1, 2)
    axes.add_collection(PolyCollection(list(ellipses), facecolors=paint, edgecolors="none", alpha=0.25 * existence))
    extent = box_of(tracks.names, mean)
    if extent is not None:
        outlines = boxes(place, *extent)
        axes.add_collection(
            PolyCollection(list(outlines), facecolors="none", edgecolors=paint, lw=1.6, alpha=existence)
        )
    before = slice(tracks.offset[max(0, t - TAIL)], tracks.offset[t + 1])
    for name, point, shade, certain in zip(label, place, paint, existence, strict=True):
        tail = tracks.mean[before][tracks.label[before] == name][:, index]
        axes.plot(*tail.T, lw=1.0, color=shade, alpha=0.7 * certain)
        if extent is None:
            axes.plot(*point, "o", ms=4, mew=0, color=shade, alpha=certain)
        axes.annotate(
            str(name),
            tuple(point),
            (5, 5),
            textcoords="offset points",
            color=shade,
            fontsize=8,
            alpha=certain,
            clip_on=True,
        )


def box_of(names: tuple[str, ...], mean: Floats) -> tuple[Floats, Floats] | None:
    """Headings (n,) and sizes (n, 2) of states (n, d), None where they have no extent or no direction."""
    of = dict(zip(names, mean.T, strict=True))
    if "length" not in of or "width" not in of:
        return None
    size = np.stack([of["length"], of["width"]], -1)
    if "heading" in of:
        return of["heading"], size
    return (np.arctan2(of["vy"], of["vx"]), size) if "vx" in of and "vy" in of else None


def boxes(place: Floats, heading: Floats, size: Floats) -> Floats:
    """Corners (n, 4, 2) of rectangles."""
    along, across = (size[..., None] * CORNERS).swapaxes(0, 1)  # (n, 4) each
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    return place[:, None] + np.stack([along * cos - across * sin, along * sin + across * cos], -1)
