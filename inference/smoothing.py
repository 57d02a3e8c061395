"""Smoothing of tracks whose measurements are given: where each object was, all of its measurements considered.

For one component of a track (its kind, the heading it came with), with its measurements z_s at some of the scans,

    minimise  |x_f - m|^2_P + sum_s |z_s - h_s(x_s)|^2_R + sum_s |x_s - f(x_(s-1))|^2_(L L')

by Gauss and Newton: f and h are linearised at the states found last, at first at those of the filter, and the linear
problem is solved by Kalman's filter and the pass of Rauch, Tung and Striebel (1965) back:

    x_s <- m_s + A (x_(s+1) - f(m_s)),   P_s <- P_s + A (P_(s+1) - M) A',   A = P_s F' M^-1,   M = F P_s F' + L L'

This is the iterated extended Kalman smoother (Bell 1994). R and L are those at the last states, and that p_D and
survival depend on the state is left out. It is exact at once where the model is linear.

As an engine: the labeled multi-Bernoulli filter runs, says how probably objects exist, and which measurements its
confirmed tracks most probably have (inference.lmb_association); of those, states are smoothed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference.lmb import LONGEST, Knobs
from inference.lmb_association import associate
from inference.lmb_kernel import propagate
from inference.refusal import answers_first
from inference.track_kernel import see
from inference.track_weight import Track, Window, follow, picked, window_of
from inference.tracking import require_objects
from inference.tracks import Tracks
from models.multi_object import Components, HasObjects, Moved, no_objects

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
ONE = np.array([0, 1])
STATES = ("mean", "covariance", "kind")


class Smoothed(NamedTuple):
    """A track from the scan of its first measurement to the last of the window, S scans.

    mean        (S, n)
    covariance  (S, n, n)
    kind        (C,) probabilities of the kinds
    converged   whether the iteration stood still
    """

    mean: Floats
    covariance: Floats
    kind: Floats
    converged: bool


class Node(NamedTuple):
    """A time of the chain: `seconds` after the one before; at scan `scan` (-1: between two), which shows the object as
    measurement `row` of it (-1: not)."""

    seconds: float
    scan: int
    row: int


class Pass(NamedTuple):
    """Kalman's filter over K nodes: what was predicted and what was then known, and the slopes of the motion there."""

    ahead: Floats  # (K, n)
    ahead_covariance: Floats
    mean: Floats
    covariance: Floats
    slope: Floats


def smooth(
    model: HasObjects, window: Window, track: Track, *, max_iterations: int = 10, tolerance: float = 1e-6
) -> Smoothed:
    """Smooth a track's most probable component.

    tolerance  largest change of a state, in its standard deviations, that ends the iteration"""
    (trail,) = follow(model, window, [track], [None], gate=math.inf)
    weight = trail.rows[-1].weight
    best = int(weight.argmax())
    kind = np.bincount(trail.kind, weight, len(model.kind_names)).astype(np.float64)
    first = int(window.scan[track[0]])
    prior = window.prior[first]
    start = int(prior.offset[track[0] - window.offset[first]]) + best
    begin = picked(prior, [start], ONE)
    nodes = _nodes(window, track)
    forward = _filter(model, window, nodes, begin, None)
    mean, covariance = _back(forward, model.period)
    converged = False
    for _ in range(max_iterations):
        before = mean
        mean, covariance = _back(_filter(model, window, nodes, begin, before), model.period)
        std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        converged = bool((np.abs(mean - before) <= tolerance * std + 1e-12 * np.abs(mean)).all())
        if converged:
            break
    at = [k for k, node in enumerate(nodes) if node.scan >= 0]
    return Smoothed(mean[at], covariance[at], kind, converged)


def _nodes(window: Window, track: Track) -> list[Node]:
    """Of the chain: longer times are gone in several steps, as filters do."""
    rows = {int(window.scan[g]): int(g - window.offset[window.scan[g]]) for g in track}
    first = min(rows)
    nodes = [Node(0.0, first, rows[first])]
    for s in range(first + 1, len(window.scans)):
        seconds = float(window.seconds[s])
        steps = max(1, math.ceil(seconds / LONGEST - 1e-9))
        nodes += [Node(seconds / steps, -1, -1)] * (steps - 1)
        nodes.append(Node(seconds / steps, s, rows.get(s, -1)))
    return nodes


def _filter(model: HasObjects, window: Window, nodes: list[Node], begin: Components, at: Floats | None) -> Pass:
    """Kalman's filter of one component, linearised at states `at` (K, n); at its own without."""
    num, size, kind = len(nodes), len(model.names), begin.kind
    ahead, mean, slope = np.empty((num, size)), np.empty((num, size)), np.zeros((num, size, size))
    ahead_covariance, covariance = np.empty((num, size, size)), np.empty((num, size, size))
    m, P = begin.mean.copy(), begin.covariance.copy()
    for k, node in enumerate(nodes):
        if k and node.seconds > 0.0:
            point = m if at is None else at[k - 1 : k]
            moved: Moved = model.move(kind, point, node.seconds)
            propagate(ONE, np.ones(1), np.ones(1), P, moved.slope, moved.noise, np.ones(1))
            m = moved.mean + (moved.slope[0] @ apart(m, point, model.period)[0])[None]
            slope[k] = moved.slope[0]
        elif k:
            slope[k] = np.eye(size)
        ahead[k], ahead_covariance[k] = m[0], P[0]
        if node.row >= 0:
            point = m if at is None else at[k : k + 1]
            parts = Components(ONE, np.ones(1), kind, point, P)
            view = model.view(window.scans[node.scan], no_objects(size), parts)
            shifted = view.predicted + (view.slope[0] @ apart(m, point, model.period)[0])[None]
            m = m.copy()
            see(ONE, np.ones(1), kind, m, P, np.array([node.row]), *view._replace(predicted=shifted), math.inf)
        mean[k], covariance[k] = m[0], P[0]
    return Pass(ahead, ahead_covariance, mean, covariance, slope)


def _back(forward: Pass, period: Floats) -> tuple[Floats, Floats]:
    """The pass of Rauch, Tung and Striebel: means (K, n) and covariances (K, n, n)."""
    mean, covariance = forward.mean.copy(), forward.covariance.copy()
    for k in range(len(mean) - 2, -1, -1):
        over, P = forward.ahead_covariance[k + 1], forward.covariance[k]
        A = P @ forward.slope[k + 1].T @ _inverse(over)
        mean[k] = forward.mean[k] + A @ apart(mean[k + 1], forward.ahead[k + 1], period)
        covariance[k] = P + A @ (covariance[k + 1] - over) @ A.T
        covariance[k] = 0.5 * (covariance[k] + covariance[k].T)
    return mean, covariance


def _inverse(P: Floats) -> Floats:
    """Of a covariance, entries of which may be of very different sizes, or known exactly."""
    scale = np.sqrt(np.diagonal(P))
    scale = np.where(scale > 0.0, scale, 1.0)
    return np.asarray(np.linalg.pinv(P / np.outer(scale, scale), rcond=1e-14, hermitian=True) / np.outer(scale, scale))


def apart(a: Floats, b: Floats, period: Floats) -> Floats:
    """a - b, angles within half a period."""
    gap = a - b
    finite = np.isfinite(period)
    turn = np.where(finite, period, 1.0)
    return np.where(finite, gap - turn * np.floor(gap / turn + 0.5), gap)


@answers_first
def run(
    model: HasObjects,
    scans: Sequence[Any],
    *,
    seed: int = 0,
    threshold: float = 0.5,
    max_iterations: int = 10,
    gate: float = Knobs().gate,
    least: float = Knobs().least,
    merge: float = Knobs().merge,
    most: int = Knobs().most,
    faint: float = Knobs().faint,
    max_shared: int = Knobs().max_shared,
    report: float = 0.01,
    progress: bool = False,
) -> Tracks:
    """The tracks of the labeled multi-Bernoulli filter, in the order of time, of which those that are ever more
    probable than `threshold` have smoothed states. Nothing is random: `seed` is not read.

    How probably objects exist is what the filter says after each scan. The other knobs are those of inference.lmb.

    Raises InputError for a model of something else than many objects, and for a scan that it cannot use."""
    require_objects(model, "lmb_smoothed")
    window = window_of(model, scans)
    knobs = Knobs(gate, least, merge, most, faint, max_shared)
    found = associate(model, window.scans, knobs, threshold=threshold, report=report, progress=progress)
    tracks, mean, covariance, kind = found.tracks, *(getattr(found.tracks, n).copy() for n in STATES)
    rough = 0
    for label, measurements in found.measurements.items():
        track = tuple(int(window.offset[s]) + j for s, j in measurements)
        if not math.isfinite(window.log_first[track[0]]):
            continue
        smoothed = smooth(model, window, track, max_iterations=max_iterations)
        rough += not smoothed.converged
        begin = int(window.scan[track[0]])
        rows = np.flatnonzero((tracks.label == label) & (tracks.scan >= begin))
        mean[rows], kind[rows] = smoothed.mean[tracks.scan[rows] - begin], smoothed.kind
        covariance[rows] = smoothed.covariance[tracks.scan[rows] - begin]
    flags = list(tracks.info["flags"])
    if rough:
        flags.append(f"{rough} tracks had not settled after {max_iterations} iterations; raise max_iterations")
    info = tracks.info | {"engine": "lmb_smoothed", "smoothed": len(found.measurements), "flags": flags}
    return replace(tracks, mean=mean, covariance=covariance, kind=kind, info=info)
