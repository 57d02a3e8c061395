"""Scenes of tracking, models as configured, and what a filter makes of them: the work that the figures count."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.configured import configured, quiet_engine
from benchmarks.figure import Value
from experiments.scenarios.scene import Scene
from experiments.tracking_metrics import judge
from inference.tracks import Tracks
from models.objects.traffic import Traffic

CUTOFF = 100.0  # of the crossing targets [m], as usual there


class Effort(NamedTuple):
    """How much to measure.

    scenes   of each sort, with seeds from 0 on
    peers    of them, on which Stone Soup runs: it takes seconds for each
    seconds  that drives last [s]
    objects  of the larger of the two scenes that are timed
    show     progress bars on the standard error
    """

    scenes: int
    peers: int
    seconds: float
    objects: int = 100
    show: bool = False


FULL = Effort(scenes=20, peers=8, seconds=20.0)
QUICK = Effort(scenes=4, peers=1, seconds=8.0)


def plots(clutter: float, *, places: bool = False) -> Traffic:
    """The model of crossing targets, that comes with or without knowledge of the places that targets come from."""
    model = configured("model", "traffic_plots_places" if places else "traffic_plots")
    return replace(model, sensors=tuple(replace(sensor, clutter=clutter) for sensor in model.sensors))


def ospa_m(tracks: Tracks, scene: Scene, cutoff: float = CUTOFF) -> float:
    """Mean OSPA distance of order 1 over the scans."""
    return float(judge(tracks.confirmed(), scene.truth, cutoff=cutoff).ospa.mean())


def step_ms(runs: Sequence[Tracks], warm_up: int = 0) -> np.ndarray:
    """How long every scan took but the first `warm_up` of each run, by the filter's clock."""
    return 1e3 * np.concatenate([tracks.info["step_seconds"][warm_up:] for tracks in runs])


def lmb() -> Callable[..., Tracks]:
    """The filter as configured."""
    return quiet_engine("lmb")  # type: ignore[return-value]


def ratio(ours: Sequence[float], theirs: Sequence[float], unit: str = "m") -> Value:
    """Mean of ours over mean of theirs, scene by scene the same; with its standard error (delta method)."""
    a, b = np.array(ours), np.array(theirs)
    value = float(a.mean() / b.mean())
    told = f"{a.mean():.3g} / {b.mean():.3g} {unit}, {len(a)} scenes"
    if len(a) > 1:
        told += f", s.e. {(a - value * b).std(ddof=1) / len(a) ** 0.5 / b.mean():.3f}"
    return Value(value, told)
