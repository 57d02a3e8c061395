"""Pictures of an estimated junction: over its tracks, along the iterations, and its arm count."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from experiments.junction_metrics import Estimate, driven_arms, structure
from experiments.scenarios import paths
from experiments.scenarios.protocol import ARM_LENGTH, interior_radius
from experiments.scenarios.scene import JunctionTruth, Scene
from inference.posterior import Posterior
from models.intersection.state import lane_points
from models.intersection.tracks import Tracks

Side = Literal[1, -1]  # entries, exits

ENTRY, EXIT, TRACK, SURFACE, INK = "#2a6fbb", "#d9722e", "#5b646d", "#eceef0", "#2b2f33"
TRUE_LINE: dict[str, Any] = {"color": "#111111", "linewidth": 0.9, "linestyle": (0, (5, 3)), "alpha": 0.8}
MARGIN = 13.0  # around the lanes, for the labels [m]
WIDTH = 2.7  # of drawn lanes where the estimate has none, as in [M20] [m]


def figures(posterior: Posterior, scene: Scene) -> dict[str, Figure]:
    """Every picture this posterior has data for, by name."""
    drawn = {"junction": estimate_over_tracks(posterior, scene), "arm_count": arm_count(posterior, scene)}
    if posterior.snapshots is not None:
        drawn["anytime"] = anytime(posterior, scene)
    return drawn


def estimate_over_tracks(posterior: Posterior, scene: Scene) -> Figure:
    """The best state as coloured lanes over the tracks it was learnt from, true centre lines dashed."""
    estimate = posterior.estimate
    centre = np.asarray(estimate["centre"])
    arms = [_lanes(estimate, arm) for arm in range(int(estimate["num_arms"]))]
    corners = np.concatenate([lane for arm in arms for side in arm.values() for lane in side] + [centre[None]])
    low, high = corners.min(0) - MARGIN, corners.max(0) + MARGIN
    width, height = high - low
    figure = Figure(figsize=(7.2, 7.2 * float(np.clip(height / width, 0.6, 1.2)) + 0.6), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    _draw_surface(axes, estimate, arms)
    _draw_tracks(axes, scene.data)
    for number, arm in enumerate(arms):
        _draw_arm(axes, estimate, number, arm)
    if scene.truth is not None:
        axes.add_collection(LineCollection(_distinct(scene.truth.lines), **TRUE_LINE, zorder=4))
    axes.plot(*centre, marker="+", color=INK, markersize=12, markeredgewidth=2.0, zorder=6)
    _quiet(axes)
    axes.set_title(_headline(estimate, scene), loc="left", color=INK, fontsize=11)
    handles: list[Any] = [
        Line2D([], [], color=TRACK, ls="none", marker=".", label="vehicle tracks"),
        Patch(color=ENTRY, alpha=0.6, label="estimated entries"),
        Patch(color=EXIT, alpha=0.6, label="estimated exits"),
    ]
    if scene.truth is not None:
        handles.append(Line2D([], [], **TRUE_LINE, label="true centre lines"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def _headline(estimate: Estimate, scene: Scene) -> str:
    arms = int(estimate["num_arms"])
    lanes = int(np.asarray(estimate["entries"])[:arms].sum() + np.asarray(estimate["exits"])[:arms].sum())
    head = f"{scene.name}: {arms} arms, {lanes} lanes from {len(scene.data.offsets) - 1} tracks"
    if scene.truth is None:
        return head
    return f"{head}\n{structure(estimate, scene.truth)['lanes_right']:.0%} of the true lane counts found"


def _lanes(estimate: Estimate, arm: int) -> dict[Side, list[NDArray[np.float64]]]:
    """Centre lines of an arm from the interior outwards, by side."""
    s = np.linspace(_interior(estimate)[arm], ARM_LENGTH, 40)
    return {
        1: [lane_points(estimate, arm, lane, 1, s, WIDTH) for lane in range(int(estimate["entries"][arm]))],
        -1: [lane_points(estimate, arm, lane, -1, s, WIDTH) for lane in range(int(estimate["exits"][arm]))],
    }


def _draw_surface(axes: Axes, estimate: Estimate, arms: list[dict[Side, list[NDArray[np.float64]]]]) -> None:
    """The road below: a strip under each arm, joined around the centre."""
    mouths: list[NDArray[np.float64]] = []
    for number in np.argsort(np.asarray(estimate["angle"])[: len(arms)]):
        across = arms[number][-1][::-1] + arms[number][1]  # lanes from right to left, looking outward
        half = _width(estimate, int(number)) / 2
        right, left = across[0] - half * _left_of(across[0]), across[-1] + half * _left_of(across[-1])
        axes.fill(*np.concatenate([right, left[::-1]]).T, color=SURFACE, lw=0, zorder=1)
        mouths += [right[0], left[0]]
    axes.fill(*np.array(mouths).T, color=SURFACE, lw=0, zorder=1)


def _draw_tracks(axes: Axes, tracks: Tracks) -> None:
    axes.plot(*tracks.points.T, ls="none", marker=".", markersize=2.0, mew=0, color=TRACK, alpha=0.6, zorder=2)


def _draw_arm(axes: Axes, estimate: Estimate, arm: int, lanes: dict[Side, list[NDArray[np.float64]]]) -> None:
    """Lanes of an arm as bands with arrows in driving direction, and how many there are."""
    for (side, lines), colour in zip(lanes.items(), (ENTRY, EXIT), strict=True):
        for line in lines:
            axes.fill(*_band(line, 0.86 * _width(estimate, arm)).T, color=colour, alpha=0.5, lw=0, zorder=3)
            driven = line[::-1] if side == 1 else line
            arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.6, "mutation_scale": 13, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", tuple(driven[23]), tuple(driven[17]), arrowprops=arrow, zorder=5)
    ends = np.array([line[-1] for line in lanes[-1][::-1] + lanes[1]])
    angle = float(estimate["angle"][arm])
    place = (ends[0] + ends[-1]) / 2 + 7.5 * np.array([np.cos(angle), np.sin(angle)])
    text = f"{len(lanes[1])} in\n{len(lanes[-1])} out"
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5}
    axes.annotate(text, tuple(place), ha="center", va="center", color=INK, fontsize=9, bbox=box, zorder=6)


def _distinct(lines: list[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
    """Lines without the parts that run on top of earlier ones, where dashes would close up."""
    runs: list[NDArray[np.float64]] = []
    for line in lines:
        new = np.arange(len(line))
        if runs:
            new = np.flatnonzero(cKDTree(np.concatenate(runs)).query(line)[0] > 0.2)
        runs += [line[run] for run in np.split(new, np.flatnonzero(np.diff(new) > 1) + 1) if len(run) > 1]
    return runs


def _band(line: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Outline of a strip around a centre line."""
    left = _left_of(line) * width / 2
    return np.concatenate([line + left, (line - left)[::-1]])


def _left_of(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit normals to the left of a line, (n, 2)."""
    heading = paths.headings(line)
    return np.stack([-np.sin(heading), np.cos(heading)], axis=1)


def _width(estimate: Estimate, arm: int) -> float:
    return float(estimate["width"][arm]) if "width" in estimate else WIDTH


def _interior(estimate: Estimate) -> NDArray[np.float64]:
    """Where the lanes of each active arm meet those of its neighbours."""
    arms = int(estimate["num_arms"])
    width = np.array([_width(estimate, arm) for arm in range(arms)])
    shift = np.asarray(estimate["shift"])[:arms] if "shift" in estimate else np.zeros(arms)
    half = np.asarray(estimate["gap"])[:arms] / 2
    left = half + shift + np.asarray(estimate["entries"])[:arms] * width
    right = half - shift + np.asarray(estimate["exits"])[:arms] * width
    return interior_radius(np.asarray(estimate["angle"])[:arms], left, right)


def anytime(posterior: Posterior, scene: Scene) -> Figure:
    """What an anytime user would have had: how far the log joint of the best state lies below the
    highest one and, where the truth is known, the share of lane counts still wrong."""
    snapshots = posterior.snapshots
    assert snapshots is not None
    figure = Figure(figsize=(7.2, 3.6 if scene.truth is None else 5.2), layout="constrained")
    milliseconds = _since_first(snapshots.seconds)
    if scene.truth is None:
        upper = figure.add_subplot()
    else:
        upper, lower = figure.subplots(2, 1, sharex=True)
        _draw_errors(lower, milliseconds, _scores(snapshots.states, scene.truth))
        upper.tick_params(labelbottom=False)
    below = snapshots.log_joint.max() - snapshots.log_joint
    upper.step(milliseconds, below, where="post", color=ENTRY, lw=1.6)
    upper.set_yscale("symlog", linthresh=1.0)
    upper.set(ylabel="log joint below\nits best value [nats]", ylim=(0, None))
    upper.set_title(f"{scene.name}: best state so far", loc="left", color=INK, fontsize=11)
    figure.axes[-1].set(xscale="log", xlabel="time since the first state [ms]")
    _quiet(upper)
    return figure


def _since_first(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Milliseconds since the first snapshot; that one stands where a logarithm can show it."""
    milliseconds = 1e3 * (seconds - seconds[0])
    if len(seconds) > 1:
        milliseconds[0] = milliseconds[1] / 2
    return milliseconds


def _scores(states: dict[str, NDArray[Any]], truth: JunctionTruth) -> list[dict[str, float]]:
    number = len(states["num_arms"])
    return [structure({site: values[i] for site, values in states.items()}, truth) for i in range(number)]


def _draw_errors(axes: Axes, milliseconds: NDArray[np.float64], scores: list[dict[str, float]]) -> None:
    lanes = [1.0 - score["lanes_right"] for score in scores]
    arms = [1.0 - score["arms_right"] for score in scores]
    axes.step(milliseconds, lanes, where="post", color=EXIT, lw=1.6, label="lane counts wrong (share)")
    axes.fill_between(milliseconds, arms, step="post", color=TRACK, alpha=0.25, lw=0, label="arms wrong")
    axes.set(ylim=(-0.03, max(0.3, 1.1 * max(lanes))), ylabel="error")
    axes.legend(frameon=False, fontsize=9, loc="upper right")
    _quiet(axes)


def arm_count(posterior: Posterior, scene: Scene) -> Figure:
    """Posterior probability of each number of arms; the true number, where known, is filled."""
    counts = np.asarray(posterior.draws["num_arms"]).reshape(-1).astype(int)
    support = np.arange(2, max(7, counts.max()) + 1)
    weights = posterior.weights.reshape(-1)
    probability = np.array([weights[counts == k].sum() for k in support])
    true = None if scene.truth is None else int(driven_arms(scene.truth).sum())
    figure = Figure(figsize=(4.8, 3.2), layout="constrained")
    axes = figure.add_subplot()
    bars = axes.bar(support, probability, width=0.62, color=[ENTRY if k == true else "#b9c7d6" for k in support])
    axes.bar_label(bars, [f"{p:.2f}" if p >= 0.005 else "" for p in probability], color=INK, fontsize=9, padding=2)
    axes.set(xlabel="number of arms", ylabel="posterior probability", ylim=(0, 1.12), yticks=[0, 0.5, 1])
    truth_known = "" if true is None else f" (true: {true})"
    axes.set_title(f"{scene.name}{truth_known}", loc="left", color=INK, fontsize=11)
    _quiet(axes)
    return figure


def _quiet(axes: Axes) -> None:
    """Leave only what the reader needs of the frame."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK, labelsize=9)
    axes.set_facecolor("white")
