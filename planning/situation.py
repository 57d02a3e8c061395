"""Situation analysis ([K15], section IV-A): the lanes that road users are on, and where they will be.

A track at offset d +- sigma_d from the middle of a lane of half width b, turned by psi against it, is weighed

    w = (Phi((b - d) / sigma_d) - Phi((-b - d) / sigma_d)) exp(-psi^2 / 2 sigma_psi^2)

and is on lane l with probability w_l / max(sum w, 1), on no lane with what is left. Along each lane, and into each of
its successors, it goes a way w(t) with an acceleration that fades out, and comes back to the lane's middle:

    w'(t) = v + a tau (1 - e^(-t / tau)) >= 0,    d(w) = (d0 + (d0' + d0 / xi) w) e^(-w / xi)
    var w = sigma_s^2 + g (sigma_v^2 t^2 + q t^3 / 3) + (1 - g) (sigma_v tau (1 - e^(-t / tau)))^2
    var d = sigma_0^2 e^(-2 w / xi) + sigma_lane^2 (1 - e^(-2 w / xi))

g = min(w / (v0 t), 1): who stands, or brakes to a stand, is expected to stand on, so that parked cars do not grow.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.program import InputError
from planning.reference import ReferenceLine, from_points
from planning.reference_kernel import BEYOND_ENDS, FOUND
from planning.road import Floats, Lanes, Route, Tracks, check_tracks, even
from planning.shapes import Obstacles

Ints = NDArray[np.int64]
NO_LANE = -1
COARSE = 16  # rows of a route's table between those that a search for the foot starts at
JOINT = 0.5  # a lane's line goes on for this beyond its ends: lines that join may leave a gap [m]
STEEPEST = 1.2  # |d'| at which a track that turns away from a lane is believed to go


@dataclass(frozen=True)
class Situation:
    """Settings of relations and predictions.

    heading_std   [rad] of road users against their lane
    least         relations less likely than this share of the likeliest are left out
    fading        tau, in which an acceleration fades out, or what who stands seems to move [s]
    moving        v0, the mean speed from which on road users move [m/s]
    diffusion     q, of speed [m^2/s^3]
    back          xi, way in which road users come back to the middle of their lane [m]
    lane_std      of road users about it [m]
    turn_std      of the direction of those on no lane [rad]
    walk_std      of the speed of pedestrians, whichever way they go [m/s]
    later, step   how far, and at which steps, predictions reach for decisions and behaviour [s]
    """

    heading_std: float = 0.35
    least: float = 0.05
    fading: float = 1.0
    moving: float = 1.0
    diffusion: float = 0.1
    back: float = 10.0
    lane_std: float = 0.25
    turn_std: float = 0.1
    walk_std: float = 0.3
    later: float = 15.0
    step: float = 0.25

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"situation: {name} is {getattr(self, name)}, but must be positive and finite")


class Network(NamedTuple):
    """Lanes with what is worked out once per map.

    lines  {lane: the line along its middle}
    half   {lane: (K,) half its width at equal shares of its length [m]}
    box    (L, 4) least x, y, largest x, y of each lane's borders, in the order of `lanes` [m]
    """

    lanes: Lanes
    lines: dict[int, ReferenceLine]
    half: dict[int, Floats]
    box: Floats


def network(lanes: Lanes, *, std: float = 0.05) -> Network:
    """Of a map. Raises InputError for borders that make no line, and for successors that the map has not."""
    lines, half, boxes = {}, {}, [np.zeros((0, 4))]
    for key, lane in lanes.items():
        for after in lane.successors:
            if after not in lanes:
                raise InputError(f"lane {key} leads to lane {after}, which the map has not; leave it out or add it")
        lines[key] = from_points(lane.centre, std=std, name=f"lane {key}")
        num = max(len(lane.left), len(lane.right))
        half[key] = np.hypot(*(even(lane.left, num) - even(lane.right, num)).T) / 2
        both = np.concatenate([lane.left, lane.right])
        boxes.append(np.r_[both.min(0), both.max(0)][None])
    return Network(lanes, lines, half, np.concatenate(boxes))


class Relations(NamedTuple):
    """Of M tracks to L lanes.

    lanes        (L,) ids
    probability  (M, L + 1) that a track is on each, and, last, on none
    s, d, slope  (M, L) arc length (below 0, or above the length, before and after the lane), offset, and tan of the
                 direction against the lane; 0 where it is far away
    """

    lanes: Ints
    probability: Floats
    s: Floats
    d: Floats
    slope: Floats


def relations(roads: Network, tracks: Tracks, settings: Situation = Situation()) -> Relations:
    """The lanes that tracks are on. Pedestrians, and who drives backwards, are on none."""
    from scipy.special import ndtr

    check_tracks(tracks)
    ids = np.array(list(roads.lanes), np.int64)
    x, y = tracks.position[:, :1], tracks.position[:, 1:]
    reach = JOINT + 4.0 * np.sqrt(tracks.covariance.trace(axis1=1, axis2=2))[:, None]  # beyond it no mass is left
    least_x, least_y, most_x, most_y = roads.box.T
    near = (x >= least_x - reach) & (x <= most_x + reach) & (y >= least_y - reach) & (y <= most_y + reach)
    near &= ((tracks.kind != "pedestrian") & (tracks.speed >= 0))[:, None]
    row, col = np.nonzero(near.T)[::-1]  # lane by lane
    told, ended = np.zeros((len(row), 6)), np.zeros(len(row), np.int64)  # s, d, x, y, theta, half the width
    for begin, end in pairwise([*np.flatnonzero(np.diff(col, prepend=-1)), len(row)]):
        lane = int(ids[col[begin]])
        line, half, part = roads.lines[lane], roads.half[lane], told[begin:end]
        part[:, :2], ended[begin:end] = line.project(tracks.position[row[begin:end]])
        part[:, 2:5] = line.at(part[:, 0])[:, :3]
        part[:, 5] = np.interp(part[:, 0] / line.length, np.linspace(0.0, 1.0, len(half)), half)
    s, d, _, _, theta, wide = told.T
    left = np.stack([-np.sin(theta), np.cos(theta)], -1)
    off = tracks.position[row] - told[:, 2:4]
    ahead = off[:, 0] * left[:, 1] - off[:, 1] * left[:, 0]
    s = s + np.where(ended == BEYOND_ENDS, ahead, 0.0)
    on = (ended == FOUND) | ((ended == BEYOND_ENDS) & (np.abs(ahead) < JOINT))
    std = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", left, tracks.covariance[row], left), 1e-6))
    turned = np.remainder(tracks.heading[row] - theta + math.pi, 2 * math.pi) - math.pi
    mass = ndtr((wide - d) / std) - ndtr((-wide - d) / std)
    slope = np.clip(np.tan(np.clip(turned, -1.5, 1.5)), -STEEPEST, STEEPEST)
    found = np.zeros((4, *near.shape))
    found[:, row, col] = on * mass * np.exp(-((turned / settings.heading_std) ** 2) / 2), s, d, slope
    total = found[0].sum(1, keepdims=True)
    chance = np.hstack([found[0] / np.maximum(total, 1.0), np.maximum(1.0 - total, 0.0)])
    return Relations(ids, chance, *found[1:])


class Predictions(NamedTuple):
    """M hypotheses: a track along a lane and into one branch, or straight ahead.

    obstacles    at the planner's times; probability: existence x relation x branch
    tracks       that are predicted; track (M,) the row of each hypothesis; lane (M,) where it begins, or NO_LANE
    times        (L,) from 0 on, for decisions and behaviour [s]
    pose         (M, L, 3) at these times; way, speed, std (M, L) gone since now, and standard deviation of the way
    """

    obstacles: Obstacles
    tracks: Tracks
    track: Ints
    lane: Ints
    times: Floats
    pose: Floats
    way: Floats
    speed: Floats
    std: Floats

    @property
    def probability(self) -> Floats:
        """(M,)"""
        return self.obstacles.probability

    @property
    def covariance(self) -> Floats:
        """(M, 2, 2) of where they are now [m^2]."""
        return self.tracks.covariance[self.track]


def predict(
    roads: Network,
    tracks: Tracks,
    times: ArrayLike,
    settings: Situation = Situation(),
    *,
    known: Relations | None = None,
) -> Predictions:
    """Where tracks will be at times (K,), the horizon's steps without the first, and later.

    known  their relations to lanes, where they are at hand. Raises InputError for tracks that are none (NaN, shapes)"""
    related = relations(roads, tracks, settings) if known is None else known
    soon = np.asarray(times, float)
    later = np.arange(round(settings.later / settings.step) + 1) * np.float64(settings.step)
    every = np.r_[later, soon]
    way, speed = _ways(tracks, every, settings)
    found = list(_hypotheses(roads, related, way.max(1, initial=0.0), settings))
    track = np.array([h.track for h in found], np.int64)
    lane = np.array([h.lanes[0] if h.lanes else NO_LANE for h in found], np.int64)
    probability = tracks.existence[track] * np.array([h.probability for h in found])
    pose, spread, along = (
        np.zeros((len(found), len(every), 3)),
        np.zeros((len(found), len(every), 2, 2)),
        lane != NO_LANE,
    )
    _along_lanes(roads, found, way[track], pose)
    straight = track[~along]
    heading = tracks.heading[straight]
    gone = way[straight][..., None] * np.stack([np.cos(heading), np.sin(heading)], -1)[:, None]
    pose[~along, :, :2] = tracks.position[straight][:, None] + gone
    pose[~along, :, 2] = heading[:, None]
    variance, back = _variance(tracks, track, along, every, way[track], settings)
    ahead = np.stack([np.cos(pose[..., 2]), np.sin(pose[..., 2])], -1)
    left = np.stack([-ahead[..., 1], ahead[..., 0]], -1)
    # what is known now turns with the lane; across, it fades with the way back to the middle
    now = tracks.covariance[track]
    for axis, unit in enumerate((ahead, left)):
        first = np.einsum("mi,mij,mj->m", unit[:, 0], now, unit[:, 0])[:, None]
        variance[..., axis] += first * (back if axis else 1.0)
        spread += variance[..., axis, None, None] * unit[..., :, None] * unit[..., None, :]
    mixed = np.einsum("mi,mij,mj->m", ahead[:, 0], now, left[:, 0])[:, None] * np.sqrt(back)
    both = ahead[..., :, None] * left[..., None, :]
    spread += mixed[..., None, None] * (both + both.swapaxes(-1, -2))
    num = len(later)
    obstacles = Obstacles(pose[:, num:], tracks.size[track], spread[:, num:], probability)
    return Predictions(
        obstacles, tracks, track, lane, later, pose[:, :num], way[track, :num], speed[track, :num],
        np.sqrt(variance[:, :num, 0]),
    )  # fmt: skip


def _ways(tracks: Tracks, t: Floats, settings: Situation) -> tuple[Floats, Floats]:
    """Way and speed (M, T) of tracks at times; who brakes stands in the end, who drives backwards goes on so."""
    tau, v, a = settings.fading, tracks.speed[:, None], tracks.acceleration[:, None]
    gained = tau * (1.0 - np.exp(-t / tau))
    speed = v + a * gained
    way = v * t + a * tau * (t - gained)
    with np.errstate(divide="ignore", invalid="ignore"):
        # v + a tau (1 - e^(-t / tau)) = 0
        rest = np.where((v > 0) & (a < 0) & (v < -a * tau), -tau * np.log1p(v / (a * tau)), np.inf)
    still = np.where(np.isfinite(rest), rest, 0.0)
    stood = v * still + a * tau * (still - tau * (1.0 - np.exp(-still / tau)))
    forwards = v >= 0
    speed = np.where(forwards & (t >= rest), 0.0, np.where(forwards, np.maximum(speed, 0.0), v))
    return np.where(forwards, np.where(t >= rest, stood, np.maximum(way, 0.0)), v * t), speed


class _Hypothesis(NamedTuple):
    track: int
    probability: float
    lanes: tuple[int, ...]
    s: float = 0.0
    d: float = 0.0
    slope: float = 0.0
    back: float = 1.0


def _hypotheses(roads: Network, related: Relations, farthest: Floats, settings: Situation) -> Iterator[_Hypothesis]:
    for row, chances in enumerate(related.probability):
        kept = np.flatnonzero(chances >= settings.least * chances.max())
        total = chances[kept].sum()
        for col in kept:
            share = float(chances[col] / total)
            if col == len(related.lanes):
                yield _Hypothesis(row, share, ())
                continue
            s, d, slope = float(related.s[row, col]), float(related.d[row, col]), float(related.slope[row, col])
            for lanes, branch in _branches(roads, int(related.lanes[col]), s + float(farthest[row])):
                yield _Hypothesis(row, share * branch, lanes, s, d, slope, settings.back)


def _branches(roads: Network, lane: int, reach: float) -> Iterator[tuple[tuple[int, ...], float]]:
    """The ways on from a lane up to a length, and the chance of each: successors are equally likely."""
    left: list[tuple[tuple[int, ...], float, float]] = [((lane,), 1.0, reach - roads.lines[lane].length)]
    while left:
        lanes, chance, rest = left.pop()
        after = roads.lanes[lanes[-1]].successors
        if rest <= 0.0 or not after:
            yield lanes, chance
            continue
        left += [((*lanes, a), chance / len(after), rest - roads.lines[a].length) for a in reversed(after)]


def _along_lanes(roads: Network, found: list[_Hypothesis], way: Floats, pose: Floats) -> None:
    """Fill pose (M, T, 3) of hypotheses along lanes, lane by lane; beyond the ends of the first and last: straight."""
    pieces: dict[int, list[tuple[int, float, float, float]]] = {}
    for m, h in enumerate(found):
        zero = -h.s
        for n, a in enumerate(h.lanes):
            begin, end = zero if n else -math.inf, zero + roads.lines[a].length
            pieces.setdefault(a, []).append((m, zero, begin, end if n + 1 < len(h.lanes) else math.inf))
            zero = end
    start = np.array([(h.d, h.slope, h.back) for h in found])
    for a, told in pieces.items():
        line, which = roads.lines[a], np.array([m for m, *_ in told])
        zeros, begins, ends = np.array([part for _, *part in told]).T[..., None]
        piece, k = np.nonzero((way[which] >= begins) & (way[which] < ends))
        row = which[piece]
        w, (d0, slope, back) = way[row, k], start[row].T
        s = w - zeros[piece, 0]
        on = line.at(np.clip(s, 0.0, line.length))
        over = s - np.clip(s, 0.0, line.length)
        fade, pull = np.exp(-w / back), slope + d0 / back
        d, rate = (d0 + pull * w) * fade, (pull - (d0 + pull * w) / back) * fade
        cos, sin = np.cos(on[:, 2]), np.sin(on[:, 2])
        x, y = on[:, 0] + over * cos - d * sin, on[:, 1] + over * sin + d * cos
        pose[row, k] = np.stack([x, y, on[:, 2] + np.arctan(rate)], -1)


def _variance(
    tracks: Tracks, track: Ints, along: NDArray[np.bool_], t: Floats, way: Floats, settings: Situation
) -> tuple[Floats, Floats]:
    """What time adds to the variances (M, T, 2) ahead and across, and what is left (M, T) of today's across."""
    moves = np.minimum(np.abs(way) / (settings.moving * np.maximum(t, settings.step)), 1.0)
    squared, faded = tracks.speed_std[track, None] ** 2, settings.fading * (1.0 - np.exp(-t / settings.fading))
    grown = moves * (squared * t**2 + settings.diffusion * t**3 / 3) + (1.0 - moves) * squared * faded**2
    back = np.where(along[:, None], np.exp(-2 * np.abs(way) / settings.back), 1.0)
    walking = (tracks.kind[track] == "pedestrian")[:, None] * (settings.walk_std * t) ** 2
    across = np.where(along[:, None], settings.lane_std**2 * (1 - back), (settings.turn_std * way) ** 2 + walking)
    return np.stack([grown + walking, across], -1), back


class Along(NamedTuple):
    """Predictions (M, L) told along a route: s, d of middles, ahead: cos of the direction against the route's, on:
    whether there is such a place on it."""

    s: Floats
    d: Floats
    ahead: Floats
    on: NDArray[np.bool_]


def along(route: Route, predictions: Predictions) -> Along:
    """Where predictions are on a route."""
    shape = predictions.pose.shape[:2]
    from planning.reference_kernel import nearest

    points = np.ascontiguousarray(predictions.pose[..., :2].reshape(-1, 2))
    start = np.empty(len(points))
    nearest(np.ascontiguousarray(route.line.table[::COARSE]), points, start)
    found, ended = route.line.project(points, start * COARSE * route.line.step)
    theta = route.line.at(found[:, 0])[:, 2].reshape(shape)
    s, d = found[:, 0].reshape(shape), found[:, 1].reshape(shape)
    return Along(s, d, np.cos(predictions.pose[..., 2] - theta), (ended == FOUND).reshape(shape))
