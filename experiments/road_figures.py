"""Pictures of an estimated road course: from above, and across it by the distance from the car."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.junction_figures import INK
from experiments.metrics import known
from experiments.road_knots import draw_knots, knots_of
from experiments.road_metrics import (
    BAND,
    LEAST_RANGE,
    RANGES,
    TUBES,
    at_ranges,
    drawn_roads,
    estimated_road,
    half_width,
    has_road,
    offsets_from,
    road_points,
    trusted_range,
)
from experiments.scenarios.scene import Scene
from inference.posterior import Posterior
from models.road.cues import Cues

Floats = NDArray[np.float64]
ESTIMATE, TRUTH, FAINT = "#2f6f9f", "#111111", "#c9ced4"
LOOKS = {
    "guardrail": ("s", "#8a5a2b"),
    "delineator": ("^", "#3b8a5a"),
    "pole": ("D", "#6b7280"),
    "lantern": ("*", "#d9a400"),
    "reflector": ("P", "#b3261e"),
    "marking": (".", "#9aa3ab"),
    "bicycle": ("v", "#7b3f9e"),
    "car": (">", "#d1702c"),
    "motorbike": ("<", "#c2459e"),
    "truck": ("h", "#a8341f"),
}  # marker and colour of each kind
OTHER = ("o", "#444c55")  # of a kind that a user added


def figures(posterior: Posterior, scene: Scene) -> dict[str, Figure]:
    """Nothing for a posterior without a road."""
    if not has_road(posterior) or not isinstance(scene.data, Cues):
        return {}
    return {"road": road(posterior, scene)}


def road(posterior: Posterior, scene: Scene) -> Figure:
    """Above: cues with their measured covariances, the estimate with its 90 % band, the truth dashed. Below: how far
    each is to the left of the estimate, and the tubes. Beyond the calibrated range the estimate is dotted. A road of
    pieces has its knots, too, and how many there are."""
    estimate = estimated_road(posterior)
    guess = road_points(estimate)
    left = -offsets_from(drawn_roads(posterior), guess)  # of the drawn roads
    low, high = np.quantile(left, BAND, axis=0)
    reach = trusted_range(-left)
    line = known(scene).get("line")
    figure = Figure(figsize=(10.5, 6.4), layout="constrained")
    above, across = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    _draw_above(above, scene.data, guess, (low, high), reach)
    knots = knots_of(posterior)
    if knots is not None:
        draw_knots(above, knots, estimate)
    if line is not None:
        above.plot(*line[:, :2].T, ls=(0, (5, 3)), lw=1.1, color=TRUTH, label="true course", zorder=4)
    above.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
    title = _headline(scene, reach) + (f"\n{knots}" if knots is not None else "")
    above.set_title(title, loc="left", color=INK, fontsize=11)
    _draw_across(across, guess, (low, high), reach)
    if line is not None:
        error = offsets_from(estimate, at_ranges(line))[0]
        across.plot(guess[:, 0], error, ls=(0, (5, 3)), lw=1.1, color=TRUTH, label="true course")
    across.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
    return figure


def _headline(scene: Scene, reach: float) -> str:
    head = f"{scene.name}: {len(scene.data.kind)} cues"
    if reach < LEAST_RANGE:
        return f"{head}; abstains: not to be trusted as far as {LEAST_RANGE:.0f} m"
    return f"{head}; to be trusted to {reach:.0f} m"


def _draw_above(axes: Axes, cues: Cues, guess: Floats, band: tuple[Floats, Floats], reach: float) -> None:
    draw_band(axes, guess, band, ESTIMATE)
    _draw_estimate(axes, guess, reach)
    _draw_cues(axes, cues)
    axes.plot(0.0, 0.0, marker="o", ms=9, mfc="white", mec=INK, mew=1.6, ls="none", label="own car", zorder=6)
    lowest, highest = (f([f(guess[:, 1]), f(cues.position[:, 1])]) for f in (np.min, np.max))
    middle, half = 0.5 * (lowest + highest), max(0.5 * (highest - lowest) + 4.0, 15.0)
    axes.set(xlim=(-12.0, RANGES[-1] + 12.0), ylim=(middle - half, middle + half), ylabel="y, to the left [m]")
    axes.grid(color=FAINT, lw=0.4)


def draw_band(axes: Axes, line: Floats, band: tuple[Floats, Floats], color: str) -> None:
    """The area from low to high (R,), to the left of a line (R, 2) [m]."""
    normal = normals(line)
    edges = [line + side[:, None] * normal for side in band]
    axes.fill(*np.concatenate([edges[0], edges[1][::-1]]).T, color=color, alpha=0.25, lw=0, label="90 % band")


def normals(line: Floats) -> Floats:
    """Unit vectors (R, 2) to the left of a line (R, 2)."""
    tangent = np.gradient(line, axis=0)
    return np.stack([-tangent[:, 1], tangent[:, 0]], -1) / np.hypot(*tangent.T)[:, None]


def _draw_estimate(axes: Axes, guess: Floats, reach: float) -> None:
    """A line that is dotted where it is not to be trusted."""
    near = RANGES <= reach
    far = RANGES >= RANGES[near].max(initial=0.0)
    axes.plot(*guess[near].T, color=ESTIMATE, lw=2.2, label="estimate", zorder=5)
    axes.plot(*guess[far].T, color=ESTIMATE, lw=1.6, ls=":", label="not to be trusted" if far.sum() > 1 else None)
    if near.any():
        axes.axvline(guess[near][-1, 0], color=ESTIMATE, lw=0.9, ls="-.", label="calibrated range")


def _draw_cues(axes: Axes, cues: Cues) -> None:
    """Cues by kind, with ellipses of one standard deviation."""
    draw_spreads(axes, cues)
    for kind in dict.fromkeys(cues.kind.tolist()):
        marker, colour = LOOKS.get(kind, OTHER)
        seen = cues.kind == kind
        axes.plot(*cues.position[seen].T, marker=marker, color=colour, ms=5.5, mew=0, ls="none", label=kind, zorder=3)


def draw_spreads(axes: Axes, cues: Cues) -> None:
    """An ellipse of one standard deviation about each cue."""
    values, vectors = np.linalg.eigh(cues.covariance)
    angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    wide, narrow = 2.0 * np.sqrt(values[:, 1]), 2.0 * np.sqrt(values[:, 0])
    place = {"offsets": cues.position, "offset_transform": axes.transData}
    look = {"facecolors": "none", "edgecolors": "#9aa3ab", "linewidths": 0.6, "zorder": 2}
    axes.add_collection(EllipseCollection(wide, narrow, angle, units="xy", **place, **look))
    axes.plot([], [], marker=r"$\bigcirc$", color="#9aa3ab", ms=8, mew=0, ls="none", label="measured within 1 sd")


def _draw_across(axes: Axes, guess: Floats, band: tuple[Floats, Floats], reach: float) -> None:
    ahead = guess[:, 0]
    for name, style in (("mid", "-"), ("wide", "--")):
        width = half_width(name)
        near, growth = TUBES[name]
        text = f"{name} tube, {near:g} m + {growth:g} r"
        axes.plot(ahead, width, color="#9aa3ab", lw=0.9, ls=style, label=text)
        axes.plot(ahead, -width, color="#9aa3ab", lw=0.9, ls=style)
    axes.fill_between(ahead, *band, color=ESTIMATE, alpha=0.25, lw=0, label="90 % band")
    axes.axhline(0.0, color=ESTIMATE, lw=1.6)
    if reach:
        axes.axvline(float(ahead[RANGES <= reach][-1]), color=ESTIMATE, lw=0.9, ls="-.")
    most = 1.15 * max(half_width("wide")[-1], float(np.abs(band).max()))
    axes.set(xlabel="x, ahead of the car [m]", ylabel="left of the estimate [m]", ylim=(-most, most))
