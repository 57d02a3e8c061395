"""Pictures of lanes from recorded traffic: which vehicles show them, and how far the map agrees."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from experiments.junction_figures import INK, TRACK, TRUE_LINE
from experiments.lane_figures import AFTER, BAND, dress, strip, sure_lanes
from experiments.scenarios.scene import Scene
from experiments.traffic_lanes import TrafficPosterior
from inference.posterior import Posterior

UNUSED = "#5a8fc0"  # tracks on no lane
ARROW = 0.6  # of the way along a lane


def figures(posterior: Posterior, scene: Scene) -> dict[str, Figure]:
    """Nothing for a posterior that is not of recorded traffic."""
    if not isinstance(posterior, TrafficPosterior) or posterior.lanes is None:
        return {}
    return {"traffic_lanes": lanes_over_tracks(posterior, scene), "lanes": sure_lanes(posterior, scene)}


def lanes_over_tracks(posterior: TrafficPosterior, scene: Scene) -> Figure:
    """Centre lines with 90 % bands and driving directions over the tracks; map lanes, where known, dashed."""
    lanes = posterior.lanes
    assert lanes is not None
    pieces = np.split(scene.data.points, scene.data.offsets[1:-1])
    route = lanes.routes.track_route
    figure = Figure(figsize=(8.6, 8.8), layout="constrained")
    axes = figure.add_subplot()
    for colour, on_lane in ((TRACK, True), (UNUSED, False)):
        chosen = [piece for piece, number in zip(pieces, route, strict=True) if bool(number >= 0) == on_lane]
        axes.add_collection(LineCollection(chosen, color=colour, lw=0.5, alpha=0.45, zorder=2))
    for line, left, right in zip(lanes.lines, lanes.left, lanes.right, strict=True):
        axes.fill(*strip(line, left, right).T, color=BAND, lw=0, zorder=3)
        at = int(ARROW * len(line))
        arrow = {"arrowstyle": "-|>", "color": AFTER, "lw": 1.2, "mutation_scale": 12, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", tuple(line[at + 1]), tuple(line[at - 1]), arrowprops=arrow, zorder=5)
    axes.add_collection(LineCollection(lanes.lines, color=AFTER, lw=1.1, zorder=4))
    handles: list[Any] = [
        Line2D([], [], color=TRACK, lw=0.8, label="tracks on lanes"),
        Line2D([], [], color=UNUSED, lw=0.8, label="other tracks"),
        Line2D([], [], color=AFTER, label="lanes"),
        Patch(color=BAND, label="90 % bands"),
    ]
    if scene.truth is not None:
        axes.add_collection(LineCollection(scene.truth.lines, **TRUE_LINE, zorder=4))
        handles.append(Line2D([], [], **TRUE_LINE, label="map lanes"))
    dress(axes)
    low, high = scene.data.points.min(0) - 5.0, scene.data.points.max(0) + 5.0
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    used = f"{int((route >= 0).sum())} of {len(route)} tracks"
    axes.set_title(f"{scene.name}: {len(lanes.lines)} lanes from {used}", loc="left", color=INK, fontsize=11)
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=9)
    return figure
