"""Markov chain Monte Carlo data association over a window of scans (Oh, Russell and Sastry 2009).

The state is a partition of all measurements of the window into tracks and false alarms; where the objects are, and when
they go after their last measurement, is integrated out (inference.track_weight). A move takes some tracks away and adds
others (inference.track_moves), and is accepted with probability

    min(1, prod_added w / prod_removed w * prod_freed lambda_c / prod_taken lambda_c * q' / q)

What a track weighs is kept, and shared by all chains, so that most steps only look it up. What chains ask for
together is filtered side by side, each track only from where it differs from one that is known already. A chain needs
some tens of steps for each measurement.

What comes out is about the window: the posterior given all of its scans, of objects that a scan has shown. An object is
labelled by its first measurement, as in inference.lmb: a label has, at a scan, the existence

    r = mean over draws of the probability that the track that begins with this measurement is still there

and the states of its most frequent track, smoothed (inference.smoothing). `draws` are exact ones of the number of
objects at each scan. At the last scan, all of this is what a filter says if it is exact.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference.lmb import Knobs
from inference.lmb_association import associate
from inference.progress import Progress, announce
from inference.refusal import accept, answers_first
from inference.smoothing import smooth
from inference.track_moves import (
    NAMES,
    SHARES,
    Edit,
    Proposals,
    apply,
    owner_of,
    proposals,
    propose,
    tracks_of,
)
from inference.track_weight import Track, Trail, Window, follow, window_of
from inference.tracking import require_objects
from inference.tracks import COUNT, Tracks
from models.multi_object import HasObjects
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
ROOM = 2000  # filtered tracks that are kept, to go on from
LADDER = np.cumsum(SHARES[:-1])
TRIED, SENSIBLE, ACCEPTED = range(3)


class Weight(NamedTuple):
    """What is remembered of a track: see Trail."""

    log_weight: float
    alive: Floats


class Library:
    """What tracks weigh, each filtered once."""

    def __init__(self, model: HasObjects, window: Window, gate: float) -> None:
        self.model, self.window, self.gate = model, window, gate
        self.weights, self.trails = dict[Track, Weight](), dict[Track, Trail]()
        self.filtered = 0

    def learn(self, wanted: Sequence[tuple[Track, Sequence[Track]]]) -> None:
        """Filter tracks that are not known yet, from where they differ from one of their parents."""
        new = {track: parents for track, parents in wanted if track not in self.weights}
        if not new:
            return
        known = [self._longest(track, parents) for track, parents in new.items()]
        trails = follow(self.model, self.window, list(new), known, gate=self.gate)
        self.filtered += len(new)
        for track, trail in zip(new, trails, strict=True):
            self.weights[track] = Weight(trail.log_weight, trail.alive)
            if trail.log_weight > -math.inf:
                self.trails[track] = trail
        for track in list(self.trails)[: max(len(self.trails) - ROOM, 0)]:
            del self.trails[track]

    def _longest(self, track: Track, parents: Sequence[Track]) -> tuple[Trail, int] | None:
        """The trail of a parent, and how many of its rows are of the track, too."""
        found, most, scan = None, 0, self.window.scan
        for parent in parents:
            if parent not in self.trails or parent[0] != track[0]:
                continue
            trail = self.trails[parent] = self.trails.pop(parent)  # used last, forgotten last
            same = next((i for i, (a, b) in enumerate(zip(track, parent, strict=False)) if a != b), -1)
            if same < 0:
                same = min(len(track), len(parent))
            ends = [int(scan[each[same]]) for each in (track, parent) if same < len(each)]
            rows = min([len(trail.rows), *(end - int(scan[track[0]]) for end in ends)])
            rows = min(rows, int(scan[track[-1]] - scan[track[0]]) + 1)
            if rows > most:
                found, most = (trail, rows), rows
        return found


class Chain:
    """A partition that moves, how many steps it has made, and the step that it has drawn but not made yet."""

    def __init__(self, tracks: Sequence[Track], log_density: float, rng: np.random.Generator) -> None:
        self.owner, self.log_density, self.rng, self.steps = owner_of(tracks), log_density, rng, 0
        self.drawn: tuple[int, Edit | None, float] | None = None
        self.best, self.log_best = tuple(tracks), log_density


def step(chain: Chain, window: Window, by: Proposals, library: Library, counts: Ints) -> bool:
    """One Metropolis-Hastings step, in place; False where the library must first learn the tracks that are drawn."""
    if chain.drawn is None:
        move = int(np.searchsorted(LADDER, chain.rng.random(), side="right"))
        chain.drawn = move, propose(chain.owner, window, by, move, chain.rng), chain.rng.random()
    move, edit, u = chain.drawn
    if edit and not all(track in library.weights for track in edit.added):
        return False
    chain.drawn, chain.steps = None, chain.steps + 1
    counts[move, TRIED] += 1
    if edit is None:
        return True
    counts[move, SENSIBLE] += 1
    change = sum(library.weights[track].log_weight for track in edit.added)
    change -= sum(library.weights[track].log_weight for track in edit.removed)
    if math.log(u + 1e-300) < change + edit.log_ratio:
        counts[move, ACCEPTED] += 1
        chain.log_density += change
        apply(chain.owner, edit)
        if chain.log_density > chain.log_best + 1e-9:
            chain.best, chain.log_best = tracks_of(chain.owner), chain.log_density
    return True


def advance(chains: Sequence[Chain], window: Window, by: Proposals, library: Library, counts: Ints, until: int) -> None:
    """Run all chains on to so many steps, each as far as it can before what they ask for is learnt at once."""
    while behind := [chain for chain in chains if chain.steps < until]:
        for chain in behind:
            while chain.steps < until and step(chain, window, by, library, counts):
                pass
        drawn = [chain.drawn[1] for chain in behind if chain.drawn]
        library.learn([(track, edit.removed) for edit in drawn if edit for track in edit.added])


@answers_first
def run(
    model: HasObjects,
    scans: Sequence[Any],
    *,
    seed: int,
    start: Literal["lmb", "nothing"] = "lmb",
    num_chains: int = 8,
    num_steps: int = 3000,
    warmup: int = 1000,
    thin: int = 10,
    gate: float = 36.0,
    reach: int = 5,
    report: float = 0.01,
    progress: bool = False,
) -> Tracks:
    """Sample partitions of the measurements of all scans, in the order of time.

    start   of all chains: the tracks of the labeled multi-Bernoulli filter; or false alarms only, from where long
            tracks are found slowly
    thin    every so many steps after the warm-up a partition is kept
    gate    squared Mahalanobis distance beyond which a measurement is not of a track
    reach   scans within which moves look for the next measurement of a track, as a rule
    report  objects less probable than this are not told of

    Raises InputError for a model of something else than many objects, for a scan that it cannot use, and for numbers
    out of range."""
    began = time.perf_counter()
    require_objects(model, "track_mcmc")
    if start not in ("lmb", "nothing"):
        raise InputError(f"start is '{start}'; choose lmb or nothing")
    for name, value in (("num_chains", num_chains), ("thin", thin), ("reach", reach)):
        if value < 1:
            raise InputError(f"{name} is {value}; track_mcmc needs 1 or more")
    if num_steps < thin:
        raise InputError(f"num_steps is {num_steps}, but every {thin}. step is kept (thin); give {thin} or more")
    if not 0 <= warmup <= num_steps - thin:
        raise InputError(f"warmup is {warmup}; choose 0 to {num_steps - thin}, so that num_steps - thin are left")
    window = window_of(model, scans)
    accept()
    with announce("compiling the sampler", after=4.0):
        library = Library(model, window, gate)
        tracks = _start(model, window, library) if start == "lmb" else []
        by = proposals(model, window, reach=reach)
    log_density = sum(library.weights[track].log_weight for track in tracks)
    seeds = np.random.SeedSequence(seed).spawn(num_chains + 1)
    chains = [Chain(tracks, log_density, np.random.default_rng(each)) for each in seeds[:-1]]
    counts, due = np.zeros((len(NAMES), 3), dtype=np.int64), range(warmup + thin, num_steps + 1, thin)
    kept: list[list[tuple[Track, ...]]] = [[] for _ in chains]
    with Progress("data association", len(due), progress) as bar:
        for until in due:
            if len(window.scan):
                advance(chains, window, by, library, counts, until)
            for own, chain in zip(kept, chains, strict=True):
                own.append(tracks_of(chain.owner))
            bar.advance(1)
    top = max(chains, key=lambda chain: chain.log_best)
    info = {
        "engine": "track_mcmc",
        "seconds": time.perf_counter() - began,
        "evaluations": library.filtered,
        "acceptance": {name: float(c[ACCEPTED] / max(c[TRIED], 1)) for name, c in zip(NAMES, counts, strict=True)},
        "sensible": {name: float(c[SENSIBLE] / max(c[TRIED], 1)) for name, c in zip(NAMES, counts, strict=True)},
        "log_joint": top.log_best,
        "scans": len(window.scans),
        "flags": list[str](),
    }
    return _tracks(model, window, library, kept, top.best, report, info, np.random.default_rng(seeds[-1]))


def _start(model: HasObjects, window: Window, library: Library) -> list[Track]:
    """The tracks of the filter, those that are possible."""
    found = associate(model, window.scans, Knobs(), threshold=0.5, report=0.01, progress=False).measurements
    tracks = [tuple(int(window.offset[s]) + j for s, j in own) for own in found.values()]
    library.learn([(track, ()) for track in tracks])
    return sorted(track for track in tracks if library.weights[track].log_weight > -math.inf)


def _tracks(
    model: HasObjects,
    window: Window,
    library: Library,
    kept: list[list[tuple[Track, ...]]],
    best: tuple[Track, ...],
    report: float,
    info: dict[str, Any],
    rng: np.random.Generator,
) -> Tracks:
    """All that the kept partitions say, labels counted from 0 in the order of first measurements."""
    num, num_scans = sum(map(len, kept)), len(window.scans)
    often = Counter(track for own in kept for tracks in own for track in tracks)
    existence, usual = dict[int, Floats](), dict[int, Track]()
    for track in sorted(often):
        own = existence.setdefault(track[0], np.zeros(num_scans))
        own += often[track] / num * _there(window, track, library.weights[track].alive)
        if often[track] > often.get(usual.get(track[0], ()), 0):
            usual[track[0]] = track
    label, scan, r, mean, covariance, kind = (list[Any]() for _ in range(6))
    rough = 0
    told = [g for g in sorted(existence) if existence[g].max() > report]
    for rank, g in enumerate(told):
        smoothed, begin = smooth(model, window, usual[g]), int(window.scan[g])
        rough += not smoothed.converged
        rows = np.flatnonzero(existence[g] > report)
        label.append(np.full(len(rows), rank))
        scan.append(rows)
        r.append(existence[g][rows])
        mean.append(smoothed.mean[rows - begin])
        covariance.append(smoothed.covariance[rows - begin])
        kind.append(np.tile(smoothed.kind, (len(rows), 1)))
    size, order = len(model.names), np.argsort(np.concatenate([np.zeros(0, int), *scan]), kind="stable")
    counted = np.concatenate([np.zeros(0, int), *scan])
    which = np.full(len(window.scan), -1)
    for rank, track in enumerate(best):
        which[list(track)] = rank
    if rough:
        info["flags"].append(f"the states of {rough} tracks had not settled; they are those of the last iteration")
    draws = np.stack([np.stack([_count(window, library, tracks, rng) for tracks in own]) for own in kept])
    return Tracks(
        draws={COUNT: draws},
        model_index=draws[:, :, -1],
        estimate={"track": which},
        time=np.array([float(one.time) for one in window.scans]),
        offset=np.concatenate([[0], np.cumsum(np.bincount(counted, minlength=num_scans))]),
        label=np.concatenate([np.zeros(0, int), *label])[order],
        existence=np.minimum(np.concatenate([np.zeros(0), *r])[order], 1.0),
        mean=np.concatenate([np.zeros((0, size)), *mean])[order],
        covariance=np.concatenate([np.zeros((0, size, size)), *covariance])[order],
        kind=np.concatenate([np.zeros((0, len(model.kind_names))), *kind])[order],
        names=model.names,
        kind_names=model.kind_names,
        sensor=tuple(one.sensor for one in window.scans),
        info=info,
    )


def _there(window: Window, track: Track, alive: Floats) -> Floats:
    """(T,) how probably the object of a track is there, and has been shown, at each scan."""
    first, last = window.scan[track[0]], window.scan[track[-1]]
    there = np.zeros(len(window.scans))
    there[first:last] = 1.0
    there[last : last + len(alive)] = alive
    return there


def _count(window: Window, library: Library, tracks: tuple[Track, ...], rng: np.random.Generator) -> Ints:
    """(T,) objects of one partition, each of which goes at a time drawn from its posterior."""
    count = np.zeros(len(window.scans), dtype=np.int64)
    for track in tracks:
        count += _there(window, track, library.weights[track].alive) > rng.random()
    return count
