"""Pictures of a drive: one cycle from above with what its planner turned down, and the drive over time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from experiments.closed_loop import Drive
from experiments.closed_loop_metrics import arc_lengths, limits_driven, outlines
from experiments.tracking_animation import CIRCLE, ELLIPSE
from planning.check_kernel import REASONS
from planning.planner import COMFORT, EMERGENCY, RELAXED, candidates_of, judge, plan
from planning.plans import Candidates

Floats = NDArray[np.float64]
INK, FAINT, KERB, ROUTE = "#1d2430", "#c9ced6", "#5b3f8c", "#8a8f98"
PLAN, EGO, OTHER, PREDICTED = "#0b5fa5", "#0b5fa5", "#d1702c", "#d1702c"
GOOD, LINE = "#3b8a5a", "#b3261e"
BAD = ("#c2459e", "#b3261e", "#e0a100", "#7b3f9e", "#8a5a2b", "#00868b")  # the reasons met most, then the rest
REST = "#9aa1ab"
TIERS = {COMFORT: "none", RELAXED: "#fdf0d5", EMERGENCY: "#fbdada"}
SHOWN = 400  # candidates at most
EVERY = 10  # steps between ellipses of a prediction
LEAST = 0.02  # probability of predictions that are drawn
VIEW = np.array([42.0, 18.0])  # half of what is seen [m]
BEFORE = 0.4  # share of it that the vehicle is before its middle


class Fan(NamedTuple):
    """Candidates of a cycle as they are drawn: paths (N, K, 2), the reason each is bad for (N,), {reason: how many}.

    Reasons of one name are told as the first of them."""

    path: Floats
    reason: NDArray[np.int64]
    numbers: dict[int, int]


def figures(drive: Drive) -> dict[str, Figure]:
    """The cycle that turned most candidates down, and the time series."""
    return {"cycle": cycle_figure(drive, busiest(drive)), "drive": time_series(drive)}


def busiest(drive: Drive) -> int:
    """The cycle whose plan turned most candidates down; the one in the middle where none was."""
    turned_down = [sum(made.rejected.values()) for made in drive.plans]
    return int(np.argmax(turned_down)) if any(turned_down) else len(turned_down) // 2


def cycle_figure(drive: Drive, number: int) -> Figure:
    """One cycle from above."""
    fan = fan_of(drive, number, SHOWN)
    figure = Figure(figsize=(10.0, 5.9), layout="constrained")
    axes = figure.subplots()
    colours = colours_of(fan)
    draw_cycle(axes, drive, number, fan, colours)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    tier, count = drive.log.tier[number], sum(fan.numbers.values())
    axes.set_title(
        f"{drive.scene.name}, {drive.log.cycle[number]:.2f} s: {tier}, {count} candidates",
        loc="left",
        fontsize=11,
    )
    handles = [
        Line2D([], [], color=PLAN, lw=2.6, label="plan (3 s)"),
        Line2D([], [], color=KERB, lw=1.8, label="boundary lines"),
        Line2D([], [], color=ROUTE, lw=1.0, ls="--", label="reference line"),
        Patch(facecolor=EGO, label="vehicle"),
    ]
    if drive.scene.actors:
        handles.append(Patch(facecolor=OTHER, label="road users"))
        handles.append(Patch(facecolor=PREDICTED, alpha=0.3, label="where they will be, 90 %"))
    handles += candidate_handles(fan, colours)
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def fan_of(drive: Drive, number: int, most: int) -> Fan:
    """Candidates of a cycle, all judged; of many, evenly by rank of cost."""
    previous, cycle = drive.plans[number - 1] if number else None, drive.planner.fans.cycle
    found = plan(drive.planner, drive.given[number], previous, cycle, all_reasons=True)
    made = found.candidates
    if made is None or found.tier == EMERGENCY:  # then these are stops: show what was wanted before them
        made = candidates_of(drive.planner, drive.given[number], previous, cycle)
        made = judge(drive.planner, drive.given[number], made, drive.planner.comfort, first_good=False)
    shown = made.order[np.unique(np.linspace(0, len(made.order) - 1, most).astype(int))]
    reason = np.array([REASONS.index(name) for name in REASONS])[made.reason]
    which, numbers = np.unique(reason, return_counts=True)
    return Fan(
        _paths(drive, number, made, shown), reason[shown], dict(zip(which.tolist(), numbers.tolist(), strict=True))
    )


def _paths(drive: Drive, number: int, made: Candidates, shown: NDArray[np.int64]) -> Floats:
    """x, y (N, K, 2) along the horizon."""
    t = np.linspace(0.0, drive.planner.horizon, 31)
    i, j = np.divmod(shown, len(made.lateral.cost))
    s = np.maximum.accumulate(made.longitudinal.motion.at(t)[i, :, 0], axis=1)
    d = made.lateral.motion.at(t)[j, :, 0]
    for row in np.flatnonzero(made.lateral.by_way[j]):
        d[row] = made.lateral.motion.take([j[row]]).at(s[row] - s[row, 0])[0, :, 0]
    return drive.given[number].line.place(s, d)


def colours_of(fan: Fan) -> dict[int, str]:
    """{reason: colour}; the rarest share one."""
    bad = sorted((r for r in fan.numbers if r > 0), key=lambda reason: -fan.numbers[reason])
    return {0: GOOD} | {reason: BAD[k] if k < len(BAD) else REST for k, reason in enumerate(bad)}


def candidate_handles(fan: Fan, colours: dict[int, str]) -> list[Line2D]:
    """For the legend, with numbers; reasons of one colour are one entry."""
    order = sorted(fan.numbers, key=lambda reason: (reason != 0, -fan.numbers[reason]))
    rest = [r for r in order if colours[r] == REST]
    told = [(colours[r], REASONS[r] if r else "good", fan.numbers[r]) for r in order if r not in rest]
    if rest:
        told.append((REST, REASONS[rest[0]] if len(rest) == 1 else "other reasons", sum(fan.numbers[r] for r in rest)))
    return [Line2D([], [], color=colour, lw=1.4, label=f"{name}: {number}") for colour, name, number in told]


def draw_cycle(axes: Axes, drive: Drive, number: int, fan: Fan, colours: dict[int, str]) -> None:
    """The world of a cycle, its candidates and its plan; the view goes with the vehicle."""
    log, vehicle, given = drive.log, drive.planner.vehicle, drive.given[number]
    ego = log.ego[round(log.cycle[number] / (log.time[1] - log.time[0]))]
    ahead = np.array([math.cos(ego[2]), math.sin(ego[2])])
    _view(axes, ego[:2], ahead)
    for lane in drive.scene.lanes.values():
        for border in (lane.left, lane.right):
            axes.plot(*border.T, color=FAINT, lw=0.8, zorder=1)
    axes.plot(*drive.route.line.table[::4, :2].T, color=ROUTE, lw=1.0, ls="--", zorder=1)
    axes.add_collection(LineCollection(list(given.boundary.segment.reshape(-1, 2, 2)), colors=KERB, lw=1.8, zorder=2))
    axes.add_collection(
        LineCollection(list(fan.path), colors=[colours[int(r)] for r in fan.reason], lw=0.5, alpha=0.45)
    )
    _predictions(axes, drive, number)
    look = round(log.cycle[number] / (log.looked[1] - log.looked[0]))
    for n, actor in enumerate(drive.scene.actors):
        pose = log.others[look, n]
        if np.isfinite(pose[0]):
            axes.add_collection(PolyCollection(list(outlines(pose[None, :3], actor.size)), facecolors=OTHER, zorder=4))
    middle = ego[:3] + vehicle.middle * np.r_[ahead, 0.0]
    axes.add_collection(
        PolyCollection(list(outlines(middle[None], (vehicle.length, vehicle.width))), facecolors=EGO, zorder=5)
    )
    axes.plot(*log.planned[number, :, :2].T, color=PLAN, lw=2.6, zorder=6)
    if math.isfinite(given.stop) and given.stop < given.line.length - 1e-6:
        across = given.line.place([given.stop, given.stop], [-2.0, 2.0])
        axes.plot(*across.T, color=LINE, lw=2.2, zorder=3)


def _view(axes: Axes, place: Floats, ahead: Floats) -> None:
    """Around a place, farther ahead of it than behind."""
    low, high = place + BEFORE * ahead * VIEW - VIEW, place + BEFORE * ahead * VIEW + VIEW
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect("equal")


def _predictions(axes: Axes, drive: Drive, number: int) -> None:
    """Mean paths, and ellipses that hold 90 %; fainter where less likely."""
    obstacles = drive.given[number].obstacles
    for pose, S, chance in zip(obstacles.pose, obstacles.covariance, obstacles.probability, strict=True):
        if chance < LEAST:
            continue
        axes.plot(*pose[:, :2].T, color=PREDICTED, lw=1.2, alpha=float(chance), zorder=3)
        value, vector = np.linalg.eigh(S[EVERY - 1 :: EVERY])
        root = vector * np.sqrt(np.maximum(value, 0.0))[:, None]
        rings = pose[EVERY - 1 :: EVERY, None, :2] + ELLIPSE * (root @ CIRCLE).swapaxes(1, 2)
        axes.add_collection(
            PolyCollection(list(rings), facecolors=PREDICTED, edgecolors="none", alpha=0.3 * float(chance), zorder=3)
        )


def time_series(drive: Drive) -> Figure:
    """Speed, accelerations and their limits, offset, and the way that is free ahead."""
    log, limits = drive.log, limits_driven(drive)
    t, v, a, kappa = log.time, log.ego[:, 3], log.ego[:, 4], log.ego[:, 5]
    s = arc_lengths(drive)
    offset = drive.route.line.project(log.ego[:, :2], s)[0][:, 1]
    figure = Figure(figsize=(10.0, 10.5), layout="constrained")
    speed, along, across, aside, free = figure.subplots(5, 1, sharex=True)
    for axes in (speed, along, across, aside, free):
        _shade(axes, drive)
        axes.grid(color="#eceff3", lw=0.8)
        axes.margins(x=0)
    speed.plot(t, v, color=EGO, label="driven")
    speed.step(log.cycle, log.goal[:, 1], where="post", color=OTHER, lw=1.0, label="of the goal")
    allowed = np.minimum(limits["speed"], drive.route.limit_at(s))
    speed.plot(t, allowed, color=INK, ls="--", lw=1.0, label="limit")
    speed.set(ylabel="speed [m/s]", ylim=(-0.5, 1.1 * float(max(v.max(), allowed.max()))))
    along.plot(t, a, color=EGO, label="driven")
    along.plot(t, limits["acceleration"], color=INK, ls="--", lw=1.0, label="limits")
    along.plot(t, -limits["braking"], color=INK, ls="--", lw=1.0)
    along.set(ylabel="acceleration\nalong [m/s²]")
    across.plot(t, v**2 * kappa, color=EGO, label="driven")
    across.plot(t, limits["lateral_acceleration"], color=INK, ls="--", lw=1.0, label="limits")
    across.plot(t, -limits["lateral_acceleration"], color=INK, ls="--", lw=1.0)
    across.set(ylabel="acceleration\nacross [m/s²]")
    aside.plot(t, offset, color=EGO, label="driven")
    aside.step(log.cycle, [given.wanted for given in drive.given], where="post", color=OTHER, lw=1.0, label="wanted")
    low, high = aside.get_ylim()
    aside.set(ylabel="offset from the\nreference line [m]", ylim=(min(low, -0.5), max(high, 0.5)))
    gap, stop = _free_way(drive, s)
    told = ((log.looked, gap, OTHER, "gap to the road user ahead"), (t, stop, LINE, "way to the stop point"))
    for at, way, colour, name in told:
        if np.isfinite(way).any():
            free.plot(at, way, color=colour, label=name)
    if not free.lines:
        free.text(0.5, 0.5, "nothing ahead", transform=free.transAxes, ha="center", va="center", color=ROUTE)
    free.set(ylabel="free way [m]", xlabel="time [s]")
    free.set_ylim(bottom=-1.0)
    for axes in (speed, along, across, aside, free):
        if axes.lines:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=9)
    tiers = [Patch(facecolor=TIERS[tier], label=f"{tier} plan") for tier in (RELAXED, EMERGENCY) if tier in log.tier]
    if tiers:
        figure.legend(handles=tiers, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return figure


def _shade(axes: Axes, drive: Drive) -> None:
    log = drive.log
    ends = np.append(log.cycle[1:], log.time[-1])
    for begin, end, tier in zip(log.cycle, ends, log.tier, strict=True):
        if tier != COMFORT:
            axes.axvspan(begin, end, color=TIERS[str(tier)], lw=0)


def _free_way(drive: Drive, s: Floats) -> tuple[Floats, Floats]:
    """Gap (K,) to the nearest actor ahead on the own way; way (N + 1,) to the stop point; NaN where there is none."""
    log, vehicle, line = drive.log, drive.planner.vehicle, drive.route.line
    front = s + vehicle.front
    step = round((log.looked[1] - log.looked[0]) / (log.time[1] - log.time[0]))
    gap = np.full(len(log.looked), math.inf)
    for n, actor in enumerate(drive.scene.actors):
        there = np.flatnonzero(np.isfinite(log.others[:, n, 0]))
        told, ended = line.project(log.others[there, n, :2])
        rear = told[:, 0] - actor.size[0] / 2
        ahead = (ended == 0) & (np.abs(told[:, 1]) < vehicle.width) & (told[:, 0] > front[::step][there])
        gap[there[ahead]] = np.minimum(gap[there[ahead]], (rear - front[::step][there])[ahead])
    which = np.clip(np.searchsorted(log.cycle, log.time + 1e-9, "right") - 1, 0, len(log.cycle) - 1)
    stop = np.where(log.stop < line.length - 1e-6, log.stop, math.nan)[which] - front
    return np.where(np.isfinite(gap), gap, math.nan), np.where(np.isfinite(stop), stop, math.nan)
