"""Pictures that make sense for the toys and for any posterior: (posterior, scene) -> {name: Figure}."""

from __future__ import annotations

from collections.abc import Callable
from textwrap import fill

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.metrics import compared_sites, known
from experiments.scenarios.scene import Scene
from inference.posterior import Posterior
from models.toys.slot_road import offset

Floats = NDArray[np.float64]
BLUE, ORANGE, GREY = "#2f6f9f", "#d1702c", "#8a8f98"


def marginals(posterior: Posterior, scene: Scene, *, most: int = 8) -> dict[str, Figure]:
    """Chains along the draws and the marginal of each real number, the truth dashed.

    most  rows at most"""
    rows = [(s, i) for s in compared_sites(posterior) for i in np.ndindex(posterior.draws[s].shape[2:])][:most]
    has_models = posterior.model_index is not None
    count = len(rows) + has_models
    if not count:
        return {}
    figure = Figure(figsize=(9.0, 1.7 * count), layout="constrained")
    axes = figure.subplots(count, 2, squeeze=False, width_ratios=(2.5, 1))
    for (site, index), (left, right) in zip(rows, axes, strict=False):
        values = posterior.draws[site][(..., *index)]  # (chain, draw)
        truth = known(scene).get(site)
        _row(left, right, values, posterior.weights, bins=40)
        left.set_ylabel(fill(posterior.title(site, index), 20))
        if truth is not None and np.shape(truth) == posterior.draws[site].shape[2:]:
            left.axhline(truth[index], color=ORANGE, ls="--", lw=1)
            right.axvline(truth[index], color=ORANGE, ls="--", lw=1)
    if posterior.model_index is not None:
        _row(
            axes[-1][0],
            axes[-1][1],
            posterior.model_index,
            posterior.weights,
            bins=_integer_bins(posterior.model_index),
        )
        axes[-1][0].set_ylabel(_counted(posterior))
        axes[-1][0].yaxis.get_major_locator().set_params(integer=True)
        axes[-1][1].xaxis.get_major_locator().set_params(integer=True)
    axes[-1][0].set_xlabel("draw")
    axes[-1][1].set_xlabel("value")
    return {"marginals": figure}


def _counted(posterior: Posterior) -> str:
    """What the model index counts, if the labels say."""
    same = (site for site in posterior.labels if np.array_equal(posterior.draws[site], posterior.model_index))  # type: ignore[arg-type]
    return next((posterior.title(site) for site in same), "model index")


def _integer_bins(values: NDArray[np.int64]) -> list[float]:
    return [float(edge) for edge in np.arange(values.min() - 0.5, values.max() + 1.0)]


def _row(left: Axes, right: Axes, values: Floats, weights: Floats, bins: int | list[float]) -> None:
    """Traces of the chains and their pooled, weighted histogram."""
    left.plot(values.T, lw=0.5, alpha=0.8)
    left.margins(x=0)
    right.hist(values.ravel(), bins=bins, weights=weights.ravel(), density=True, color=BLUE)
    right.set_yticks([])
    left.ticklabel_format(axis="y", scilimits=(-3, 4), useMathText=True)  # a rate of curvature is 1e-5 / m^2
    right.ticklabel_format(axis="x", scilimits=(-3, 4), useMathText=True)
    right.locator_params(axis="x", nbins=5)


def line_fit(posterior: Posterior, scene: Scene) -> dict[str, Figure]:
    """Readings of a line and what the posterior makes of them."""
    t = np.linspace(float(scene.data.t.min()), float(scene.data.t.max()), 100)
    curve = lambda z: z["beta"][..., :1] + z["beta"][..., 1:] * t  # noqa: E731
    return {"fit": _fit(posterior, scene, t, scene.data.t, scene.data.y, curve, ("t", "y"))}


def road_fit(posterior: Posterior, scene: Scene) -> dict[str, Figure]:
    """Detections of a marking and what the posterior makes of them."""
    s = np.linspace(float(scene.data.s.min()), float(scene.data.s.max()), 200)

    def curve(z: dict[str, Floats]) -> Floats:
        active = np.arange(z["rate"].shape[-1]) < z["num_knots"][..., None]
        values = (z["d0"], z["psi0"], z["kappa0"], z["knot"], z["rate"] * active)
        return offset(torch.as_tensor(s), *map(torch.as_tensor, values)).numpy()

    return {"fit": _fit(posterior, scene, s, scene.data.s, scene.data.d, curve, ("s [m]", "d [m]"))}


def _fit(
    posterior: Posterior,
    scene: Scene,
    x: Floats,
    at: torch.Tensor,
    seen: torch.Tensor,
    curve: Callable[[dict[str, Floats]], Floats],
    labels: tuple[str, str],
) -> Figure:
    """Data, truth and the posterior's band of 90 % around its median."""
    low, middle, high = np.quantile(curve(posterior.resample(400, seed=0)), (0.05, 0.5, 0.95), axis=0)
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.scatter(at, seen, s=12, color=GREY, label="data", zorder=3)
    axes.fill_between(x, low, high, color=BLUE, alpha=0.25, lw=0, label="90 % of the posterior")
    axes.plot(x, middle, color=BLUE, label="median")
    if known(scene):
        axes.plot(
            x, curve({k: np.asarray(v)[None] for k, v in known(scene).items()})[0], "--", color=ORANGE, label="truth"
        )
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.legend(frameon=False)
    return figure
