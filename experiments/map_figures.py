"""A stored map over the tracks that verify it: which lanes are there, which are gone, which nobody drove."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from experiments.junction_figures import INK, TRACK
from experiments.scenarios.protocol import ARM_LENGTH
from experiments.scenarios.scene import Scene
from experiments.scenarios.stored_map import StoredMap, from_plain
from experiments.verify_map import SIDES, Side, Verdict, align, match_arms, verify
from inference.posterior import Posterior
from models.intersection.borders import interior_radius
from models.intersection.state import lane_points

Floats = NDArray[np.float64]
THERE, GONE, UNSEEN, LACKING = "#2e8b57", "#c2282d", "#8b949c", "#c2282d"
OPEN = (0, (2.2, 1.6))
REACH = 7.0  # of the labels beyond the lanes [m]
MARGIN = 26.0  # around the lanes, for the labels [m]


def figures(posterior: Posterior, scene: Scene) -> dict[str, Figure]:
    """Nothing for a scene without a map."""
    if "map" not in scene.info:
        return {}
    stored = from_plain(scene.info["map"])
    return {"map": map_over_tracks(posterior, scene, stored, verify(posterior, stored, scene.data))}


def map_over_tracks(posterior: Posterior, scene: Scene, stored: StoredMap, verdict: Verdict) -> Figure:
    """Mapped lanes by their odds, the number of tracks at their ends; dotted what the best state has and the map lacks.

    Lanes whose odds of being gone exceed 1 are red, dashed where nobody drove either; grey are those that nobody drove
    though the draws have them: the draws fill the room between others with them."""
    figure = Figure(figsize=(7.6, 7.6), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(*scene.data.points.T, ls="none", marker=".", markersize=2.0, mew=0, color=TRACK, alpha=0.35, zorder=2)
    half = stored.gap / 2
    radius = interior_radius(stored.angle, half + stored.entries * stored.width, half + stored.exits * stored.width)
    state = stored._asdict()
    for arm, angle in enumerate(stored.angle):
        s = np.linspace(min(radius[arm], ARM_LENGTH - 15.0), ARM_LENGTH, 30)
        for side in SIDES:
            for lane, gone in enumerate(verdict.lane_gone[side][arm]):
                seen = int(verdict.tracks[side][arm][lane])
                line = lane_points(state, arm, lane, side, s)
                colour = GONE if gone > 1 else THERE if seen else UNSEEN
                style = "-" if seen else OPEN
                axes.plot(*line.T, color=colour, ls=style, lw=3.0, zorder=4)
                tip, tail = (12, 18) if side == 1 else (18, 12)  # s grows outwards, vehicles enter inwards
                arrow = {"arrowstyle": "-|>", "color": colour, "lw": 0, "mutation_scale": 15}
                axes.annotate("", tuple(line[tip]), tuple(line[tail]), arrowprops=arrow, zorder=5)
                place = lane_points(state, arm, lane, side, s[-1:] + 2.5)[0]
                axes.annotate(str(seen), tuple(place), ha="center", va="center", fontsize=7.5, color=colour)
        place = stored.centre + (ARM_LENGTH + REACH) * np.array([np.cos(angle), np.sin(angle)])
        sideways = "center" if abs(np.cos(angle)) < 0.5 else "left" if np.cos(angle) > 0 else "right"
        upwards = "center" if abs(np.sin(angle)) < 0.5 else "bottom" if np.sin(angle) > 0 else "top"
        axes.annotate(_label(verdict, arm), tuple(place), ha=sideways, va=upwards, fontsize=8.5, color=INK)
    _draw_lacking(axes, posterior, stored, radius)
    low, high = scene.data.points.min(0) - MARGIN, scene.data.points.max(0) + MARGIN
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.tick_params(colors=INK, labelsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    changes = scene.info.get("map_changes")
    title = f"{scene.name}: odds that the map is outdated {_short(verdict.outdated)}"
    axes.set_title(f"{title}\nmade wrong: {changes}" if changes else title, loc="left", color=INK, fontsize=11)
    handles = [
        Line2D([], [], color=THERE, lw=3, label="mapped and there"),
        Line2D([], [], color=GONE, lw=3, label="odds of being gone > 1"),
        Line2D([], [], color=GONE, lw=3, ls=OPEN, label="the same, and no track on it"),
        Line2D([], [], color=UNSEEN, lw=3, ls=OPEN, label="no track on it"),
        Line2D([], [], color=LACKING, lw=1.4, ls=":", label="found, not in the map"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def _label(verdict: Verdict, arm: int) -> str:
    """The number of an arm, and every odds on it that exceeds 1."""
    words = [f"arm {arm + 1}"]
    if verdict.arm_gone[arm] > 1:
        return f"{words[0]}\ngone: {_short(verdict.arm_gone[arm])}"
    for side, word in SIDES.items():
        for lane, gone in enumerate(verdict.lane_gone[side][arm], start=1):
            words += [f"{word} {lane} gone: {_short(gone)}"] if gone > 1 else []
        words += [f"another {word}: {_short(verdict.more[side][arm])}"] if verdict.more[side][arm] > 1 else []
    return "\n".join(words)


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _draw_lacking(axes: Axes, posterior: Posterior, stored: StoredMap, radius: Floats) -> None:
    """Lanes of the best state that the map lacks, as thin dotted lines."""
    estimate = posterior.estimate
    single = {site: np.asarray(value)[None] for site, value in estimate.items()}
    slots, found, _ = match_arms(single, stored)
    arm_of = {int(slots[0, arm]): int(arm) for arm in np.flatnonzero(found[0])}
    for slot in range(int(estimate["num_arms"])):
        for side in SIDES:
            for lane in _lacking(single, slot, arm_of.get(slot), stored, side):
                inner = radius[arm_of[slot]] if slot in arm_of else radius.mean()
                s = np.linspace(min(inner, ARM_LENGTH - 15.0), ARM_LENGTH, 30)
                axes.plot(*lane_points(estimate, slot, lane, side, s).T, color=LACKING, ls=":", lw=2.0, zorder=5)


def _lacking(
    single: dict[str, NDArray[np.float64]], slot: int, arm: int | None, stored: StoredMap, side: Side
) -> list[int]:
    """Numbers of the lanes of a slot that lie on no mapped one."""
    if arm is None:
        return list(range(int(single["entries" if side == 1 else "exits"][0, slot])))
    count, first = align(single, np.array([slot]), stored, arm, side)
    return [lane for lane in range(count[0]) if not 0 <= first[0] + lane < stored.lanes(side)[arm]]
