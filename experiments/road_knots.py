"""Where the clothoids of a road of pieces meet, by the draws of models.road.segments.SegmentedRoad.

Knots are a set, and draws differ in how many there are. So places are told of the draws that have the most probable
number of them, in their order along the road."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from experiments.road_metrics import BAND, Roads
from inference.posterior import Posterior
from models.clothoid_kernel import ARC, X, Y

Floats = NDArray[np.float64]
COLOUR = "#7b3f9e"
LOOK: dict[str, Any] = {"ls": "none", "marker": "o", "ms": 6.5, "mfc": "white", "mec": COLOUR, "mew": 1.8}
SEEN = 0.02  # probability from which on a number of knots is told


class Knots(NamedTuple):
    """K = the most probable number of knots.

    shares  (slots + 1,) posterior probability of each number
    middle  (K,) mean arc length of the k-th knot along the road [m], given that there are K
    edges   (2, K) quantiles (BAND) of it
    """

    shares: Floats
    middle: Floats
    edges: Floats

    @property
    def num(self) -> int:
        return len(self.middle)

    def __str__(self) -> str:
        told = [f"{k}: {share:.0%}" for k, share in enumerate(self.shares) if share >= SEEN]
        return f"number of knots {', '.join(told)}".replace("%", " %")


def knots_of(posterior: Posterior, num_draws: int = 1000) -> Knots | None:
    """The knots of a posterior; None where its roads have no slots for them."""
    if not {"num_knots", "knot"} <= posterior.draws.keys():
        return None
    draws: dict[str, NDArray[Any]] = posterior.resample(num_draws, 0)
    count, slots = draws["num_knots"], draws["knot"].shape[-1]
    shares = np.bincount(count, minlength=slots + 1) / len(count)
    num = int(shares.argmax())
    places = np.sort(draws["knot"][count == num][:, :num], axis=1)
    return Knots(shares, places.mean(0), np.quantile(places, BAND, axis=0))


def draw_knots(axes: Axes, knots: Knots, road: Roads) -> None:
    """Each knot on an estimated road, and below, bar by bar, the stretch that holds it with 90 %."""
    table = road.table[0]
    place = {column: np.interp(knots.middle, table[:, ARC], table[:, column]) for column in (X, Y)}
    ends = np.interp(knots.edges, table[:, ARC], table[:, X])
    low = axes.get_xaxis_transform()
    for k, (x, y) in enumerate(zip(place[X], place[Y], strict=True)):
        height = 0.04 + 0.045 * k
        text = ("knot: a clothoid ends", "90 % of its place") if k == 0 else (None, None)
        axes.plot(x, y, **LOOK, label=text[0], zorder=7)
        axes.plot(ends[:, k], [height, height], color=COLOUR, lw=4.0, alpha=0.35, transform=low, label=text[1])
        axes.plot(x, height, "|", color=COLOUR, ms=8, mew=1.8, transform=low)
