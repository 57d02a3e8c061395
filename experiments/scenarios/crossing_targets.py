"""Twelve targets that cross on straight ways among false alarms: the benchmark of Vo, Vo and others for tracking.

100 scans, one a second, of positions with a noise of 10 m in a square of 2 km; targets come at four places at known
times, cross near the middle, and two leave. The numbers are those of the linear Gaussian example in the public tracking
toolbox of B.-T. Vo, on which many papers report.
"""

from __future__ import annotations

import math

import numpy as np

from experiments.scenarios.moving_objects import points, see, truth_of
from experiments.scenarios.scene import Scene
from models.objects.motion import ConstantVelocity
from models.objects.scans import Recording
from models.objects.sensors import Position
from models.objects.traffic import Kind, Traffic
from models.program import InputError

MOST_CLUTTER = 1e5  # of a scan
SCANS, EXTENT = 100, 1000.0  # number; half width of the square [m]
# x, vx, y, vy at birth [m], [m/s]; the scan of birth, and the first without the target
TARGETS = (
    (0.0, 0.0, 0.0, -10.0, 0, 69),
    (400.0, -10.0, -600.0, 5.0, 0, 100),
    (-800.0, 20.0, -200.0, -5.0, 0, 69),
    (400.0, -7.0, -600.0, -4.0, 19, 100),
    (400.0, -2.5, -600.0, 10.0, 19, 100),
    (0.0, 7.5, 0.0, -5.0, 19, 100),
    (-800.0, 12.0, -200.0, 7.0, 39, 100),
    (-200.0, 15.0, 800.0, -10.0, 39, 100),
    (-800.0, 3.0, -200.0, 15.0, 59, 100),
    (-200.0, -3.0, 800.0, -15.0, 59, 100),
    (0.0, -20.0, 0.0, -15.0, 79, 100),
    (-200.0, 15.0, 800.0, -5.0, 79, 100),
)


def crossing_targets(seed: int = 0, clutter: float = 30.0, detection: float = 0.98, noise: float = 10.0) -> Scene:
    """The benchmark: what happens is the same for all seeds, what is seen is not.

    clutter    false alarms a scan; 30 and 66 are usual
    detection  probability to detect a target
    noise      standard deviation of x and y [m]

    Raises InputError for a negative seed or clutter, a noise that is not positive, and what is no probability."""
    if seed < 0 or not 0.0 <= clutter <= MOST_CLUTTER or not 0.0 < noise < math.inf:
        raise InputError(
            f"scenario crossing_targets: seed is {seed}, clutter {clutter} and noise {noise}; "
            f"give seed >= 0, 0 to {MOST_CLUTTER:g} false alarms a scan and noise > 0"
        )
    sensor = Position(name="plots", noise_std=(noise, noise), detection=detection, clutter=clutter, extent=EXTENT)
    model = Traffic((sensor,), ConstantVelocity(), (Kind(noise=(1.0, 1.0)),))
    world = points(np.arange(float(SCANS)), _ways())
    seeds = np.random.SeedSequence(seed).spawn(SCANS)
    scans = tuple(see(model, "plots", world, t, np.zeros(3), np.random.default_rng(seeds[t]))[0] for t in range(SCANS))
    info = {"scenario": "crossing_targets", "seed": seed, "clutter": clutter, "detection": detection}
    info |= {"noise_m": noise, "scans": SCANS, "measurements": sum(len(scan.values) for scan in scans)}
    return Scene(Recording(scans), truth_of(world, model.motion), f"crossing_targets {seed}", info)


def _ways() -> np.ndarray:
    """(T, N, 4) x, y, vx, vy."""
    state = np.full((SCANS, len(TARGETS), 4), np.nan)
    for i, (x, vx, y, vy, begin, end) in enumerate(TARGETS):
        gone = np.arange(float(end - begin))
        state[begin:end, i] = np.stack(
            [x + vx * gone, y + vy * gone, np.full_like(gone, vx), np.full_like(gone, vy)], -1
        )
    return state
