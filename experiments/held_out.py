"""How well lanes predict vehicles they have not seen: a score that needs no map.

Lanes are learnt without a fold of the vehicles; each of these is then as probable as a mixture over lanes says,

    p(track) = (1 - STRAY) sum_l share_l prod_i [ (1 - STRAY) N(d_i; 0, s_l^2 + v_l(i)) / length_l + STRAY / area ]
               + STRAY / area^n

d_i is the lateral distance of point i of n from lane l, v_l the variance of the lane's course there (from its band),
share_l that of lane l in the training vehicles and s_l their spread about it,

    s_l^2 = (TRUST s^2 + sum d^2) / (TRUST + number of points),    s the same of all lanes: turns are driven less alike.

Along a lane a vehicle may be anywhere, as in the model. A point beyond the end of a lane, or driven against it, has
the term of the area only, the box of all points, which also keeps every track possible.

Points of a vehicle are taken as independent given its lane, which they are not: differences of the score rank
estimates, its absolute value says little.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import logsumexp

from experiments.lanes import Lanes
from experiments.scenarios import paths
from experiments.scenarios.scene import Scene, join_tracks
from experiments.traffic_lanes import EDGE, Learn, TrafficPosterior
from inference.posterior import Posterior
from models.intersection.laid_tracks import ways
from models.intersection.tracks import Tracks
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
FOLDS = 5
TRUST = 50.0  # points that the spread about all lanes counts for in that about one
STRAY = 0.02  # share of points, and of tracks, that are on no lane


class Predictive(NamedTuple):
    """What lanes say about a new vehicle.

    lines     L arrays (n, 2) [m]
    variance  L arrays (n,) of a point across its lane there: of vehicles about the course, and of the course [m^2]
    share     (L,) of the vehicles, summing to 1
    area      where points may be [m^2]
    """

    lines: list[Floats]
    variance: list[Floats]
    share: Floats
    area: float


def metrics(posterior: Posterior, scene: Scene, folds: int = FOLDS) -> dict[str, float]:
    """Held-out scores of the engine that made a posterior; nothing where it cannot be run again.

    traffic_nll          minus the log density of unseen vehicles under the engine's lanes [nats per point]
    traffic_nll_splines  the same of independent splines (experiments.traffic_splines); tracks are on the same lanes

    Raises InputError for fewer than two folds or fewer vehicles than folds."""
    if not isinstance(posterior, TrafficPosterior) or posterior.again is None:
        return {}
    together, alone = scores(posterior.again, scene.data, folds).sum(1) / len(scene.data.points)
    return {"traffic_nll": float(together), "traffic_nll_splines": float(alone)}


def scores(learn: Learn, tracks: Tracks, folds: int) -> Floats:
    """Minus the log density of every vehicle under both kinds of lanes that `learn` makes without it, (2, T) [nats]."""
    fold = folds_of(len(tracks.offsets) - 1, folds)
    area = float(np.ptp(tracks.points, axis=0).prod())
    out = np.zeros((2, len(fold)))
    for number in range(folds):
        train, test = (pick(tracks, np.flatnonzero(each)) for each in (fold != number, fold == number))
        for kind, lanes in enumerate(learn(train)):
            out[kind, fold == number] = -log_density(predictive(lanes, train, area), test)
    return out


def folds_of(num: int, folds: int) -> Ints:
    """The fold (num,) of every vehicle: the same shuffle at all times, sizes within one of one another."""
    if not 2 <= folds <= num:
        raise InputError(f"{folds} folds of {num} vehicles leave nothing to learn from or to score; choose 2 to {num}")
    return np.asarray(np.random.default_rng(0).permutation(num) % folds)


def pick(tracks: Tracks, index: Ints) -> Tracks:
    """Some of the tracks."""
    parts = [slice(*tracks.offsets[i : i + 2]) for i in index]
    headings = None if tracks.heading is None else [tracks.heading[part] for part in parts]
    return join_tracks([tracks.points[part] for part in parts], headings)


def predictive(lanes: Lanes, train: Tracks, area: float) -> Predictive:
    """Lanes with the spread and the shares of the vehicles they were learnt from."""
    route, pieces = lanes.routes.track_route, _pieces(train)
    num, square = np.zeros(len(lanes.lines)), np.zeros(len(lanes.lines))
    for track in np.flatnonzero(route >= 0):
        across = lateral(*pieces[track], lanes.lines[route[track]])[0]
        num[route[track]] += np.isfinite(across).sum()
        square[route[track]] += (across[np.isfinite(across)] ** 2).sum()
    spread = (TRUST * square.sum() / num.sum() + square) / (TRUST + num)
    sides = zip(lanes.left, lanes.right, strict=True)
    course = [((left + right) / (2 * EDGE)) ** 2 for left, right in sides]
    size = np.bincount(route[route >= 0], minlength=len(lanes.lines))
    return Predictive(lanes.lines, [s + v for s, v in zip(spread, course, strict=True)], size / size.sum(), area)


def lateral(points: Floats, heading: Floats, line: Floats) -> tuple[Floats, Ints]:
    """Distance (n,) of points across a line, infinite beyond its ends and where their heading (n,) is against it, and
    the index of the nearest point of the line."""
    _, nearest = cKDTree(line).query(points)
    course = paths.headings(line)[nearest]
    gap = points - line[nearest]
    across = -np.sin(course) * gap[:, 0] + np.cos(course) * gap[:, 1]
    along = np.cos(course) * gap[:, 0] + np.sin(course) * gap[:, 1]
    beyond = ((nearest == 0) & (along < 0)) | ((nearest == len(line) - 1) & (along > 0))
    return np.where(beyond | (np.cos(heading - course) < 0), np.inf, across), nearest


def log_density(given: Predictive, tracks: Tracks) -> Floats:
    """log p(track) of every track, (T,) [nats]: the equation above."""
    out = []
    for points, heading in _pieces(tracks):
        logs = [math.log(STRAY) - len(points) * math.log(given.area)]
        for line, variance, share in zip(given.lines, given.variance, given.share, strict=True):
            across, nearest = lateral(points, heading, line)
            point = point_log_density(across, variance[nearest], line, given.area)
            logs.append(math.log1p(-STRAY) + math.log(share) + point.sum())
        out.append(logsumexp(logs))
    return np.array(out)


def point_log_density(across: Floats, variance: Floats, line: Floats, area: float) -> Floats:
    """Log density (n,) of points of a vehicle on a lane: its bracket in the equation above [nats]."""
    on_it = -0.5 * (across**2 / variance + np.log(2 * math.pi * variance)) - math.log(paths.arc_length(line)[-1])
    return np.logaddexp(math.log1p(-STRAY) + on_it, math.log(STRAY) - math.log(area))


def _pieces(tracks: Tracks) -> list[tuple[Floats, Floats]]:
    """Points and directions of every track, of the smoothed path: those of single noisy steps point anywhere."""
    every = ways(tracks)
    return list(zip(every.pieces, np.split(every.heading, every.offsets[1:-1]), strict=True))
