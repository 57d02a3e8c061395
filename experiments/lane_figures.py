"""Pictures of estimated lanes: how sure each is along its way, and what the refinement changed."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from experiments.junction_figures import INK, TRACK, TRUE_LINE
from experiments.lane_posterior import LanePosterior
from experiments.scenarios.scene import Scene
from inference.posterior import Posterior

Floats = NDArray[np.float64]
BEFORE, AFTER, BAND = "#9aa3ab", "#c2452d", "#e8a798"
OTHER, FAINTEST = "#7b3f9e", 0.15
SURE = 0.95  # probability of a lane above which it is called sure
ZOOM = 26.0  # half the side of the detailed view [m]
_ALTERNATIVE = Line2D([], [], color=OTHER, ls=":", lw=1.6, label="lanes of other readings")


def figures(posterior: Posterior, scene: Scene) -> dict[str, Figure]:
    """Nothing for a posterior without lanes."""
    if not isinstance(posterior, LanePosterior) or posterior.lanes is None:
        return {}
    return {"lanes": sure_lanes(posterior, scene), "lane_refinement": before_and_after(posterior, scene)}


def sure_lanes(posterior: LanePosterior, scene: Scene) -> Figure:
    """Centre lines over the tracks, coloured by half the width of the 90 % band; dotted, fainter the less probable, the
    lanes of other readings."""
    lanes = posterior.lanes
    assert lanes is not None
    pieces, half = [], []
    for line, left, right in zip(lanes.lines, lanes.left, lanes.right, strict=True):
        pieces.append(np.stack([line[:-1], line[1:]], 1))
        width = 50.0 * (left + right)  # [cm]
        half.append((width[:-1] + width[1:]) / 2)
    figure = Figure(figsize=(7.6, 7.2), layout="constrained")
    axes = figure.add_subplot()
    draw_tracks(axes, scene)
    values = np.concatenate(half)
    drawn = LineCollection(list(np.concatenate(pieces)), array=values, cmap="viridis_r", lw=2.2, zorder=3)
    drawn.set_clim(0.0, float(np.quantile(values, 0.98)))
    axes.add_collection(drawn)
    _alternatives(axes, posterior)
    figure.colorbar(drawn, ax=axes, shrink=0.7, label="90 % band: this far to either side [cm]")
    dress(axes)
    sure = "" if posterior.probability is None else f", {(posterior.probability > SURE).sum()} of them sure"
    axes.set_title(f"{scene.name}: {len(lanes.lines)} lanes{sure}", loc="left", color=INK, fontsize=11)
    if posterior.alternatives:
        axes.legend(handles=[_ALTERNATIVE], loc="upper right", frameon=False, fontsize=9)
    return figure


def before_and_after(posterior: LanePosterior, scene: Scene) -> Figure:
    """The middle of the junction: lanes as the structure suggests them, and refined with their 90 % bands."""
    lanes, first = posterior.lanes, posterior.first
    assert lanes is not None and first is not None
    figure = Figure(figsize=(10.4, 5.6), layout="constrained")
    centre = np.asarray(posterior.estimate["centre"])
    for axes, title in zip(figure.subplots(1, 2), ("structure alone", "refined, 90 % bands"), strict=True):
        draw_tracks(axes, scene)
        if title == "structure alone":
            axes.add_collection(LineCollection(first, color=BEFORE, lw=1.6, zorder=3))
        else:
            _alternatives(axes, posterior)
            for line, left, right in zip(lanes.lines, lanes.left, lanes.right, strict=True):
                axes.fill(*strip(line, left, right).T, color=BAND, lw=0, zorder=3)
            axes.add_collection(LineCollection(lanes.lines, color=AFTER, lw=0.8, zorder=4))
        if scene.truth is not None:
            axes.add_collection(LineCollection(scene.truth.lines, **TRUE_LINE, zorder=5))
        dress(axes)
        axes.set(xlim=centre[0] + np.array([-ZOOM, ZOOM]), ylim=centre[1] + np.array([-ZOOM, ZOOM]))
        axes.set_title(title, loc="left", color=INK, fontsize=11)
    handles = [Line2D([], [], color=BEFORE, label="before"), Line2D([], [], color=AFTER, label="after")]
    if scene.truth is not None:
        handles.append(Line2D([], [], **TRUE_LINE, label="true centre lines"))
    if posterior.alternatives:
        handles.append(_ALTERNATIVE)
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def _alternatives(axes: Axes, posterior: LanePosterior) -> None:
    """Lanes of other readings, as opaque as they are probable."""
    for other in posterior.alternatives:
        axes.plot(*other.line.T, color=OTHER, ls=":", lw=1.6, alpha=max(other.probability, FAINTEST), zorder=3)


def strip(line: Floats, left: Floats, right: Floats) -> Floats:
    """Outline of a band around a centre line."""
    tangent = np.gradient(line, axis=0)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], 1) / np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.concatenate([line + left[:, None] * normal, (line - right[:, None] * normal)[::-1]])


def draw_tracks(axes: Axes, scene: Scene) -> None:
    points = scene.data.points
    axes.plot(*points.T, ls="none", marker=".", markersize=2.0, mew=0, color=TRACK, alpha=0.35, zorder=2)


def dress(axes: Axes) -> None:
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.tick_params(colors=INK, labelsize=9)
    axes.spines[["top", "right"]].set_visible(False)
