"""A street of one lane with a cyclist on it: a scenario is any callable that returns a DriveScene."""

from __future__ import annotations

import numpy as np

from experiments.scenarios.driving import DriveScene, Noise, Scripted
from planning.frenet import Pose
from planning.reference import from_points
from planning.road import Lane


def street(*, pace: float = 4.0, noise: float = 0.0, duration: float = 15.0) -> DriveScene:
    """`pace` of the cyclist [m/s]; noise: standard deviation of place and speed as they are seen [m, m/s]."""
    x = np.arange(0.0, 301.0, 5.0)
    middle, left, right = (np.stack([x, 0.0 * x + offset], -1) for offset in (0.0, 1.75, -1.75))
    cyclist = Scripted(from_points(middle), start=40.0, speed=((0.0, pace),), kind="bicycle", size=(1.8, 0.6))
    return DriveScene(
        name="street",
        lanes={1: Lane(left, right, speed=50 / 3.6)},
        route=(1,),
        stops=(),
        lights={},
        actors=(cyclist,),
        boundary=(left, right),
        ego=Pose(x=5.0, y=0.0, heading=0.0, speed=8.0),
        duration=duration,
        noise=Noise(position=noise, speed=noise),
    )
