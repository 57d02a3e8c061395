"""How sure the posterior is of the lanes: the probability of every count on every estimated arm."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from experiments.junction_figures import INK
from experiments.junction_metrics import TOLERANCE_DEG, match
from experiments.scenarios.paths import wrap
from experiments.scenarios.scene import Scene
from inference.posterior import Posterior

Side = Literal["entries", "exits"]
SHOWN = 0.005  # smaller probabilities get no number


def figures(posterior: Posterior, scene: Scene) -> dict[str, Figure]:
    """Entries and exits of every estimated arm; true counts, where known, in a frame."""
    estimate = posterior.estimate
    arms = np.argsort(wrap(np.asarray(estimate["angle"])[: int(estimate["num_arms"])]))
    true: dict[int, int] = {}
    if scene.truth is not None:
        slots, numbers, _ = match(estimate, scene.truth)
        true = dict(zip(slots.tolist(), numbers.tolist(), strict=True))
    shares = {side: count_probabilities(posterior, side)[arms] for side in ("entries", "exits")}
    figure = Figure(figsize=(8.0, 1.3 + 0.42 * len(arms)), layout="constrained")
    for axes, (side, share), colours in zip(figure.subplots(1, 2), shares.items(), ("Blues", "Oranges"), strict=True):
        _draw(axes, share, colours)
        axes.set_title(f"{side} of each arm", loc="left", color=INK, fontsize=11)
        axes.set_yticks(range(len(arms)), [f"{np.degrees(wrap(estimate['angle'][arm])):.0f}°" for arm in arms])
        for row, arm in enumerate(arms.tolist()):
            if arm in true:
                count = int(getattr(scene.truth, side)[true[arm]])
                axes.add_patch(Rectangle((count - 0.5, row - 0.5), 1, 1, fill=False, edgecolor=INK, lw=1.6, zorder=3))
    figure.axes[0].set_ylabel("direction of the arm")
    if true:
        figure.supxlabel("number of lanes (framed: true)", fontsize=10, color=INK)
    return {"lane_counts": figure}


def count_probabilities(posterior: Posterior, side: Side) -> NDArray[np.float64]:
    """Posterior probability that an estimated arm exists within 10 degrees and has n lanes, (arms, N + 1).

    Rows sum to the probability of the arm."""
    draws = {site: v.reshape((-1, *v.shape[2:])) for site, v in posterior.draws.items()}
    weights = posterior.weights.reshape(-1)
    counts: NDArray[Any] = np.asarray(draws[side]).astype(int)  # (D, A)
    active = np.arange(counts.shape[1]) < draws["num_arms"][:, None]
    num_arms = int(posterior.estimate["num_arms"])
    top = int(max(counts[active].max(), np.asarray(posterior.estimate[side])[:num_arms].max()))
    shares = np.zeros((num_arms, top + 1))
    for arm, angle in enumerate(posterior.estimate["angle"][:num_arms]):
        apart = np.where(active, np.abs(wrap(draws["angle"] - angle)), np.inf)
        nearest = apart.argmin(1)
        found = apart.min(1) <= np.radians(TOLERANCE_DEG)
        number = counts[np.arange(len(counts)), nearest]
        shares[arm] = np.bincount(number[found], weights=weights[found], minlength=top + 1)
    return shares


def _draw(axes: Axes, shares: NDArray[np.float64], colours: str) -> None:
    axes.imshow(shares, cmap=colours, vmin=0.0, vmax=1.6, aspect="auto")
    for (row, count), share in np.ndenumerate(shares):
        if share >= SHOWN:
            axes.annotate(f"{share:.2f}", (count, row), ha="center", va="center", color=INK, fontsize=9)
    axes.set_xticks(range(shares.shape[1]))
    axes.tick_params(colors=INK, labelsize=9, length=0)
    axes.spines[:].set_visible(False)
