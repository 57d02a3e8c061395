"""What a drive is judged by: {metric: value}, of what was driven, not of what was planned.

    collisions             road users and boundary lines that were touched
    collisions_at_fault    of these without those who drive into the vehicle from behind, or when it has stood a second
    clearance_m            least distance to a road user
    boundary_clearance_m   least distance to a boundary line
    limit_violations       control steps beyond a limit on acceleration along or across, curvature or speed
    stops_passed           stop points whose line the front passed without permission
    stop_error_m           largest distance of the front from the stop point it stands at
    gap_error_m            at the end behind somebody who keeps a speed: gap against gap + headway * speed
    lateral_acceleration_mps2  largest
    braking_mps2           largest
    jerk_mps3              root mean square along the way
    tracking_m             largest distance from the plan
    consistency_median_m   distance of each plan from the one before over the time that both tell: median
    consistency_p95_m      95 % of cycles are below
    way_m                  driven along the route
    end_speed_mps          at the end
    comfort                share of cycles with a plan within comfortable limits
    relaxed                share with one within what the vehicle can
    emergency              share of emergency stops
    unclear                share of cycles whose plan may touch something or pass a line, standing ones included
    refined                share of cycles that follow a motion refined by optimal control
    cost_mean              of what is followed, without stops of cycles that could not be planned
    plan_cost_mean         of the plans before refinement, in the same cycles
    stated                 cycles that could not be planned
    cycle_median_ms        from tracks to what is followed, without the first cycle, which compiles,
                           and without building problems of optimal control
    cycle_p99_ms           99 % of cycles take less

Rectangles are exact and looked at every 50 ms (experiments.closed_loop.Loop.world). Limits are those of the tier of
what is followed, and the lane's speed limit; 2 % more is no violation.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.closed_loop import Drive
from planning.planner import COMFORT, EMERGENCY, RELAXED

Floats = NDArray[np.float64]
OVER = 1.02  # of a limit that is not yet a violation
PASSED = 0.05  # beyond a line that is passed [m]
STANDING = 0.05  # [m/s]
STOOD = 1.0  # who has stood for as long is not at fault [s]
AT_STOP = 2.0  # before a line stands at it [m]
STEADY = 0.2  # of the acceleration of somebody who keeps a speed [m/s^2]
CORNERS = 0.5 * np.array([[1, 1, -1, -1], [1, -1, -1, 1]], dtype=np.float64)


def metrics(drive: Drive, *, gap: float = 4.0, headway: float = 1.2) -> dict[str, float]:
    """All of the above; what does not occur in a drive is left out.

    gap, headway  wanted behind others [m, s]"""
    log = drive.log
    touched = contacts(drive)
    v, a, kappa = log.ego[:, 3], log.ego[:, 4], log.ego[:, 5]
    apart = np.hypot(*(log.ego - log.wanted)[:, :2].T)
    out = {
        "collisions": float(len(touched)),
        "collisions_at_fault": float(sum(not one.excuse for one in touched)),
        **clearances(drive),
        "limit_violations": float(violations(drive).sum()),
        "stops_passed": float(stops_passed(drive)),
    }
    if (error := stop_error(drive)) is not None:
        out["stop_error_m"] = error
    if (error := gap_error(drive, gap, headway)) is not None:
        out["gap_error_m"] = error
    s = arc_lengths(drive)
    out |= {
        "lateral_acceleration_mps2": float(np.abs(v**2 * kappa).max()),
        "braking_mps2": float(max(-a.min(), 0.0)),
        "jerk_mps3": float(np.sqrt(np.mean((np.diff(a) / np.diff(log.time)) ** 2))),
        "tracking_m": float(apart.max()),
        "consistency_median_m": float(np.nanmedian(log.consistency)),
        "consistency_p95_m": float(np.nanquantile(log.consistency, 0.95)),
        "way_m": float(s[-1] - s[0]),
        "end_speed_mps": float(v[-1]),
    }
    out |= {tier: float((log.tier == tier).mean()) for tier in (COMFORT, RELAXED, EMERGENCY)}
    planned = np.isfinite(log.plan_cost)
    out["refined"] = float(log.refined.mean())
    out |= {f"{name}_mean": float(getattr(log, name)[planned].mean()) for name in ("cost", "plan_cost")}
    out["unclear"] = float((~log.clear).mean())
    out["stated"] = float((log.stated != "").sum())
    later = log.ms[1:] if len(log.ms) > 1 else log.ms
    return out | {"cycle_median_ms": float(np.median(later)), "cycle_p99_ms": float(np.quantile(later, 0.99))}


def outlines(pose: Floats, size: Any) -> Floats:
    """Corners (N, 4, 2) of rectangles with middles pose (N, 3), size (2,) or (N, 2)."""
    along, across = (np.broadcast_to(size, (len(pose), 2))[..., None] * CORNERS).swapaxes(0, 1)
    cos, sin = np.cos(pose[:, 2:3]), np.sin(pose[:, 2:3])
    return pose[:, None, :2] + np.stack([along * cos - across * sin, along * sin + across * cos], -1)


def ego_middles(drive: Drive) -> Floats:
    """(K, 6) of the vehicle at each look: middle, heading, speed, acceleration, curvature."""
    log = drive.log
    step = round(float(np.diff(log.looked[:2])[0] / np.diff(log.time[:2])[0]))
    ego = log.ego[::step].copy()
    ego[:, :2] += drive.planner.vehicle.middle * np.stack([np.cos(ego[:, 2]), np.sin(ego[:, 2])], -1)
    return ego


class Contact(NamedTuple):
    """The first touch of an actor, -1 for boundary lines, at a time [s]; `excuse`: why the vehicle is not at fault,
    nothing where it is."""

    actor: int
    time: float
    excuse: str


def contacts(drive: Drive) -> list[Contact]:
    """Of each road user touched, and of boundary lines."""
    import shapely

    ego, vehicle = ego_middles(drive), drive.planner.vehicle
    own = shapely.polygons(outlines(ego, (vehicle.length, vehicle.width)))
    found = []
    for n, actor in enumerate(drive.scene.actors):
        pose = drive.log.others[:, n]
        there = np.flatnonzero(np.isfinite(pose[:, 0]))
        hit = there[shapely.intersects(own[there], shapely.polygons(outlines(pose[there], actor.size)))]
        if len(hit):
            stood = drive.log.looked >= drive.log.looked[hit[0]] - STOOD
            stands = bool((ego[: hit[0] + 1][stood[: hit[0] + 1], 3] < STANDING).all()) and hit[0] > 0
            behind = _from_behind(ego[hit[0]], pose[hit[0]])
            excuse = "from behind" if behind else f"the vehicle had stood for {STOOD:g} s" if stands else ""
            found.append(Contact(n, float(drive.log.looked[hit[0]]), excuse))
    lines = [shapely.linestrings(line) for line in drive.scene.boundary]
    over = np.flatnonzero(shapely.intersects(own, shapely.multilinestrings(lines))) if lines else ()
    return found + [Contact(-1, float(drive.log.looked[k]), "") for k in over[:1]]


def _from_behind(ego: Floats, other: Floats) -> bool:
    """Whether somebody behind the vehicle's middle drives into it, as fast as it or faster."""
    ahead = np.array([math.cos(ego[2]), math.sin(ego[2])])
    faster = other[3] * math.cos(other[2] - ego[2]) >= ego[3]
    return bool((other[:2] - ego[:2]) @ ahead < 0.0 and faster)


def clearances(drive: Drive) -> dict[str, float]:
    """Least distances of exact rectangles."""
    import shapely

    ego, vehicle = ego_middles(drive), drive.planner.vehicle
    own = shapely.polygons(outlines(ego, (vehicle.length, vehicle.width)))
    out, near = {}, math.inf
    for n, actor in enumerate(drive.scene.actors):
        pose = drive.log.others[:, n]
        there = np.isfinite(pose[:, 0])
        if there.any():
            apart = shapely.distance(own[there], shapely.polygons(outlines(pose[there], actor.size)))
            near = min(near, float(apart.min()))
    if math.isfinite(near):
        out["clearance_m"] = near
    if drive.scene.boundary:
        lines = shapely.multilinestrings([shapely.linestrings(line) for line in drive.scene.boundary])
        out["boundary_clearance_m"] = float(shapely.distance(own, lines).min())
    return out


def arc_lengths(drive: Drive) -> Floats:
    """(N + 1,) along the route, of the rear axle; each foot is looked for from the plan's."""
    log, cycle = drive.log, drive.log.cycle
    which = np.clip(np.searchsorted(cycle, log.time + 1e-9, "right") - 1, 0, len(cycle) - 1)
    near = np.array([made.start.s for made in drive.plans])[which] + log.ego[:, 3] * (log.time - cycle[which])
    return drive.route.line.project(log.ego[:, :2], near)[0][:, 0]


def limits_driven(drive: Drive) -> dict[str, Floats]:
    """{limit: (N + 1,)} that hold at each step of control, by the tier of its plan."""
    planner, log = drive.planner, drive.log
    which = np.clip(np.searchsorted(log.cycle, log.time + 1e-9, "right") - 1, 0, len(log.cycle) - 1)
    easy = log.tier[which] == COMFORT
    names = ("speed", "acceleration", "braking", "lateral_acceleration", "curvature")
    told = {
        name: np.where(easy, getattr(planner.comfort, name), getattr(planner.able, name)).astype(float)
        for name in names
    }
    return told


def violations(drive: Drive) -> NDArray[np.bool_]:
    """(N + 1,) whether a limit is broken."""
    v, a, kappa = drive.log.ego[:, 3], drive.log.ego[:, 4], drive.log.ego[:, 5]
    limits = limits_driven(drive)
    allowed = np.minimum(limits["speed"], drive.route.limit_at(arc_lengths(drive)))
    broken = np.abs(v**2 * kappa) > OVER * limits["lateral_acceleration"]
    broken |= (np.abs(kappa) > OVER * limits["curvature"]) | (v > OVER * allowed)
    return broken | (a > OVER * limits["acceleration"]) | (-a > OVER * limits["braking"])


def stops_passed(drive: Drive) -> int:
    """Stop points that the front was beyond while the cycle's plan had no permission."""
    log, front = drive.log, arc_lengths(drive) + drive.planner.vehicle.front
    which = np.clip(np.searchsorted(log.cycle, log.time + 1e-9, "right") - 1, 0, len(log.cycle) - 1)
    beyond = front > log.stop[which] + PASSED
    return len(np.unique(log.stop[which][beyond]))


def stop_error(drive: Drive) -> float | None:
    """Of all that the vehicle stood at."""
    log, front = drive.log, arc_lengths(drive) + drive.planner.vehicle.front
    which = np.clip(np.searchsorted(log.cycle, log.time + 1e-9, "right") - 1, 0, len(log.cycle) - 1)
    left = log.stop[which] - front
    at = (log.ego[:, 3] < STANDING) & (np.abs(left) < AT_STOP)
    if not at.any():
        return None
    last = [np.flatnonzero(at & (log.stop[which] == stop))[-1] for stop in np.unique(log.stop[which][at])]
    return float(np.abs(left[last]).max())


def gap_error(drive: Drive, gap: float, headway: float) -> float | None:
    """Behind the nearest actor ahead on the own way, where that one keeps a speed."""
    pose, vehicle = drive.log.others[-1], drive.planner.vehicle
    s = float(arc_lengths(drive)[-1]) + vehicle.front
    speed, nearest = float(drive.log.ego[-1, 3]), None
    for n, actor in enumerate(drive.scene.actors):
        if not np.isfinite(pose[n, 0]):
            continue
        told, ended = drive.route.line.project(pose[n : n + 1, :2])
        rear = float(told[0, 0]) - actor.size[0] / 2
        ahead = not ended[0] and abs(told[0, 1]) < vehicle.width and rear > s
        if ahead and (nearest is None or rear < nearest[0]):
            nearest = rear, float(pose[n, 3]), float(pose[n, 4])
    if nearest is None or nearest[1] < STANDING or abs(nearest[2]) > STEADY or not np.isfinite(drive.log.goal[-1, 0]):
        return None
    return abs(nearest[0] - s - gap - headway * speed)
