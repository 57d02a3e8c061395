"""Windows of a few scans whose partitions into tracks can all be counted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from inference.track_weight import Track, Window, follow
from models.objects.motion import ConstantVelocity
from models.objects.scans import Scan
from models.objects.sensors import Position
from models.objects.traffic import Kind, Traffic

KINDS = (
    Kind("slow", noise=(0.5, 0.5), share=0.7, lifetime=4.0, speed=(0.0, 2.0)),
    Kind("fast", noise=(2.0, 1.0), share=0.3, lifetime=9.0, speed=(0.0, 8.0)),
)


def small_model(kinds: tuple[Kind, ...] = KINDS, **settings: Any) -> Traffic:
    """Points that are often missed, in many false alarms: nothing about them is sure."""
    sensor = Position(name="plots", noise_std=(1.0, 1.5), detection=0.7, clutter=20.0, extent=50.0)
    return Traffic((sensor,), ConstantVelocity(), kinds, **{"unseen_density": 1.5e-3} | settings)


def small_scans(sizes: Sequence[int] = (2, 3, 2), seed: int = 0, spread: float = 2.0) -> tuple[Scan, ...]:
    """Measurements near the origin, 0.4 s between scans, then 0.7 s."""
    rng = np.random.default_rng(seed)
    times = 0.4 * np.arange(len(sizes)) + 0.3 * (np.arange(len(sizes)) > 1)
    return tuple(
        Scan("plots", float(time), spread * rng.standard_normal((size, 2)), np.zeros(3))
        for time, size in zip(times, sizes, strict=True)
    )


def partitions(scan: Sequence[int], g: int = 0, tracks: tuple[Track, ...] = ()) -> Iterator[tuple[Track, ...]]:
    """All partitions of measurements of these scans into tracks and false alarms."""
    if g == len(scan):
        yield tuple(sorted(tracks))
        return
    yield from partitions(scan, g + 1, tracks)
    yield from partitions(scan, g + 1, (*tracks, (g,)))
    for i, track in enumerate(tracks):
        if scan[track[-1]] < scan[g]:
            yield from partitions(scan, g + 1, (*tracks[:i], (*track, g), *tracks[i + 1 :]))


def posterior(model: Traffic, window: Window) -> dict[tuple[Track, ...], float]:
    """{partition: its probability}."""
    every = list(partitions(window.scan.tolist()))
    tracks = sorted({track for tracks in every for track in tracks})
    trails = follow(model, window, tracks, [None] * len(tracks), gate=np.inf)
    weight = {track: trail.log_weight for track, trail in zip(tracks, trails, strict=True)}
    log_density = np.array([sum(weight[track] for track in tracks) for tracks in every])
    share = np.exp(log_density - log_density.max())
    return dict(zip(every, (share / share.sum()).tolist(), strict=True))


def existence(model: Traffic, window: Window) -> np.ndarray:
    """(G, T) exact probability that the object first shown by each measurement is there at each scan."""
    found = np.zeros((len(window.scan), len(window.scans)))
    alive = dict[Track, np.ndarray]()
    for tracks, probability in posterior(model, window).items():
        for track in tracks:
            if track not in alive:
                (trail,) = follow(model, window, [track], [None], gate=np.inf)
                alive[track] = np.zeros(len(window.scans))
                first, last = window.scan[track[0]], window.scan[track[-1]]
                alive[track][first:last] = 1.0
                alive[track][last : last + len(trail.alive)] = trail.alive
            found[track[0]] += probability * alive[track]
    return found
