"""One planning cycle from plain arrays: a lane, a standing cyclist at its right edge, a line to stop at.

`python -m cyclist_ahead.plan_once` tells why candidates were turned down, and what refining makes of the best.
"""

from __future__ import annotations

import numpy as np

from planning.candidates import stop
from planning.frenet import Pose, to_frenet
from planning.optimal import Refined, refine
from planning.planner import Planner, plan
from planning.plans import Plan
from planning.reference import from_points
from planning.scene import Scene
from planning.shapes import Obstacles, boundary

LINE = 60.0  # where the front must stop [m]


def planned() -> tuple[Plan, Refined]:
    """The best of the candidates, and what optimal control makes of it."""
    planner = Planner()  # its settings: limits, weights, fans of candidates, horizon, risk
    steps = planner.num_steps  # of the horizon; 60 of 0.05 s
    x = np.arange(0.0, 201.0, 2.0)
    line = from_points(np.stack([x, 0.0 * x], -1))  # the lane's middle; offsets count to the left of it
    edges = [np.stack([x, 0.0 * x + offset], -1) for offset in (-1.75, 5.25)]
    cyclist = Obstacles(
        pose=np.tile([45.0, -1.5, 0.0], (1, steps, 1)),  # x, y, heading of its middle at each step
        size=np.array([[1.8, 0.6]]),
        covariance=np.tile(0.1**2 * np.eye(2), (1, steps, 1, 1)),
        probability=np.ones(1),
    )
    scene = Scene(
        line,
        to_frenet(line, Pose(x=25.0, y=0.0, heading=0.0, speed=10.0)),  # the middle of the rear axle
        goal=stop(LINE, planner.vehicle.front),  # or Keep(speed), follow(...), merge(...)
        offsets=np.linspace(-0.4, 2.0, 13),  # that candidates end at
        wanted=0.0,
        boundary=boundary(edges, planner.radius),
        obstacles=cyclist,
        stop=LINE,  # the goal aims at it; this forbids to pass it within the horizon
    )
    found = plan(planner, scene)
    return found, refine(planner, scene, found)


if __name__ == "__main__":
    found, better = planned()
    clear = "clear" if found.clear else "not clear"
    print(f"{found.tier} plan, {clear}, cost {found.cost:.1f}; cheaper ones were turned down for:")
    for reason, count in found.rejected.items():
        print(f"  {count:5d}  {reason}")
    print(f"refined: cost {better.cost:.1f}" if better.accepted else f"not refined: {better.why}")
    print("x [m], y [m], heading [rad], speed [m/s], acceleration [m/s^2], curvature [1/m], every half second:")
    for row in better.trajectory(np.arange(0.0, 3.1, 0.5)):
        print("".join(f"{value:9.3f}" for value in row))
