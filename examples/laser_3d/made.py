"""Makes scans.csv and truth.csv: python -m laser_3d.made. A car climbs a ramp, another comes down, somebody waits."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.scenarios.moving_objects import points, see, truth_of
from experiments.scenarios.own_scans import write, write_truth
from laser_3d.sensor import Laser3D
from models.objects.motion import ConstantVelocity
from models.objects.scans import Recording
from models.objects.traffic import Kind, Traffic

FOLDER = Path(__file__).parent
STEP, SCANS = 0.2, 50  # [s], number
WAYS = ((15.0, -3.0, 6.0, 0.0, -1.5, 0.3), (70.0, 4.0, -6.0, 0.0, 2.0, -0.3), (30.0, 12.0, 0.0, 0.0, -1.5, 0.0))
# x, y [m], vx, vy [m/s], z [m], its rate [m/s]


def main() -> None:
    time = STEP * np.arange(SCANS)
    state = np.array([[(x + vx * t, y + vy * t, vx, vy, z + rate * t) for x, y, vx, vy, z, rate in WAYS] for t in time])
    world, rng = points(time, state), np.random.default_rng(0)
    laser = Laser3D(name="laser", noise_std=(0.1, 0.003, 0.003), angle=2.0, reach=(0.0, 100.0), clutter=3.0)
    motion = ConstantVelocity(("z",))
    model = Traffic((laser,), motion, (Kind(noise=(0.5, 0.5, 0.3), extras=((0.0, 2.0),)),))
    scans = tuple(see(model, "laser", world, t, np.zeros(3), rng)[0] for t in range(SCANS))
    write(FOLDER / "scans.csv", Recording(scans), model)
    write_truth(FOLDER / "truth.csv", truth_of(world, motion))


if __name__ == "__main__":
    main()
