"""Picture of a road that may fork: both courses from above, and which of them each cue follows."""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.special import expit

from experiments.fork_metrics import DrawnFork, drawn_fork, fork_of
from experiments.junction_figures import INK
from experiments.metrics import known
from experiments.road_figures import ESTIMATE, FAINT, LOOKS, OTHER, TRUTH, draw_band, draw_spreads, normals
from experiments.road_metrics import BAND
from experiments.scenarios.scene import Scene
from inference.posterior import Posterior
from models.road.along_fork import log_odds_of_second
from models.road.cues import Cues
from models.road.fork import ForkedRoad

Floats = NDArray[np.float64]
SECOND, EITHER = "#d1702c", "#8a8f98"
SURE = 0.8  # probability from which a cue is said to follow one of the courses


def figures(posterior: Posterior, scene: Scene, *, forks: ForkedRoad | None = None) -> dict[str, Figure]:
    """Nothing for a posterior without forks."""
    if "bend" not in posterior.draws or not isinstance(scene.data, Cues):
        return {}
    return {"fork": fork(posterior, scene, forks or ForkedRoad())}


def fork(posterior: Posterior, scene: Scene, model: ForkedRoad) -> Figure:
    """Both courses with their 90 % bands if two are more probable than one, the truth dashed, cues in the colour of the
    course that they follow with a probability of SURE, grey where they may follow either."""
    drawn = drawn_fork(posterior, model)
    figure = Figure(figsize=(10.5, 5.2), layout="constrained")
    axes = figure.subplots()
    for points, colour, name in zip(drawn.courses, (ESTIMATE, SECOND), ("main course", "second course"), strict=False):
        middle = points.mean(0)
        left = ((points - middle) * normals(middle)).sum(-1)
        low, high = np.quantile(left, BAND, axis=0)
        draw_band(axes, middle, (low, high), colour)
        axes.plot(*middle.T, color=colour, lw=2.0, label=name, zorder=4 if colour == ESTIMATE else 5)
    for i, name in enumerate(name for name in ("line", "branch") if name in known(scene)):
        text = None if i else "truth"
        axes.plot(*known(scene)[name][:, :2].T, ls=(0, (5, 3)), lw=1.1, color=TRUTH, label=text, zorder=6)
    draw_spreads(axes, scene.data)
    _draw_followers(axes, scene.data, followers(drawn, scene.data, model))
    axes.plot(0.0, 0.0, marker="o", ms=9, mfc="white", mec=INK, mew=1.6, ls="none", label="own car", zorder=7)
    axes.set(xlabel="x, ahead of the car [m]", ylabel="y, to the left [m]")
    axes.set_ylim(min(axes.get_ylim()[0], -15.0), max(axes.get_ylim()[1], 15.0))
    axes.grid(color=FAINT, lw=0.4)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
    axes.set_title(f"{scene.name}: {in_words(drawn)}", loc="left", color=INK, fontsize=11)
    return figure


def in_words(drawn: DrawnFork) -> str:
    """How probable a second course is, and where it parts from the main one."""
    if drawn.probability <= 0.5:
        return f"one course; a second has the probability {drawn.probability:.2f}"
    low, middle, high = np.quantile(drawn.place, (BAND[0], 0.5, BAND[1]))
    verb = "joins" if drawn.joins > 0.5 else "leaves"
    where = f"{middle:.0f} m ahead (90 %: {low:.0f} to {high:.0f} m)"
    return f"a second course {verb} {where} with probability {drawn.probability:.2f}"


def followers(drawn: DrawnFork, cues: Cues, model: ForkedRoad) -> Floats:
    """Probability that each cue follows the second course, (N,); 0 where one course is more probable."""
    if len(drawn.courses) == 1:
        return np.zeros(len(cues.kind))
    draws = {name: values[drawn.forked] for name, values in drawn.draws.items()}
    odds = log_odds_of_second(model, model.prepare(cues), fork_of(draws), torch.from_numpy(draws["offset"]))
    odds = np.where(drawn.swapped[:, None], -odds, odds)
    return np.asarray(expit(odds).mean(0))


def _draw_followers(axes: Axes, cues: Cues, second: Floats) -> None:
    """Cues by kind, coloured by course."""
    for colour, text in ((ESTIMATE, "follows the main course"), (SECOND, "follows the second"), (EITHER, "either")):
        axes.plot([], [], marker="o", color=colour, ms=5.5, mew=0, ls="none", label=text)
    for kind in dict.fromkeys(cues.kind.tolist()):
        marker, _ = LOOKS.get(kind, OTHER)
        axes.plot([], [], marker=marker, color=EITHER, ms=5.5, mew=0, ls="none", label=kind)
        for colour, follows in (
            (ESTIMATE, second <= 1.0 - SURE),
            (EITHER, np.abs(second - 0.5) < SURE - 0.5),
            (SECOND, second >= SURE),
        ):
            seen = follows & (cues.kind == kind)
            axes.plot(*cues.position[seen].T, marker=marker, color=colour, ms=5.5, mew=0, ls="none", zorder=3)
