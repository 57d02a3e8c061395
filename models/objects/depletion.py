"""What is left of objects that no scan has shown, where sensors have looked before.

They are a Poisson process (Williams 2015). Of kind k, from its density u_0 where nobody has looked, its density u goes

    predict  u <- s u + (1 - s) u_0,   s = exp(-dt / lifetime_k)     who comes balances who goes
    update   u <- (1 - p_D(x)) u                                     what was looked at and did not show

so that at a scan at t_0, after looks at t_1 >= t_2 ... with detection probabilities p_1, p_2, ...

    u / u_0 = sum_i (1 - s_i) prod_{j < i} s_j (1 - p_j) + prod_i s_i (1 - p_i),
    s_i = exp((t_i - t_{i-1}) / lifetime_k)

A few looks settle it wherever one sees well, so that it is computed where it is asked for and no map is kept.

Each of these only makes u greater, or is too little to matter:
- Only looks of the sensor that asks count, of which what it shows is in view; all sensors' would take a scan half as
  long again.
- To a sensor from which objects hide others, all may have been hidden.
- Objects are taken to have been where they are. (To follow newcomers back along their headings, over the border of a
  view, made road scenes no better.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from models.objects.scans import Scan
from models.objects.sensors import mounted

if TYPE_CHECKING:
    from models.objects.traffic import Traffic

Floats = NDArray[np.float64]
LEAST = 1e-3  # of what was there before a look: where later looks have left less of it, looks before are not counted


def left_over(model: Traffic, scan: Scan, past: Sequence[Scan], state: Floats) -> Floats:
    """(M, C) u / u_0 of each kind at the places of states (M, n) that a scan shows, after the scans `past`, by time."""
    sensor, num = model.sensor(scan), len(state)
    share, left, rows = np.zeros((num, len(model.kinds))), np.ones((num, len(model.kinds))), np.arange(num)
    detect, time = model.formulas(sensor)[1], scan.time
    settings = np.array([(0.0, 0.0, 0.0, *sensor.settings, sensor.occlusion)])
    for look in reversed(past):
        if look.sensor != sensor.name:
            continue
        settings[0, :3] = mounted(look.pose, sensor.mount)
        stay = np.exp((look.time - time) / model.lifetime)
        share[rows] += left * (1.0 - stay)
        left = left * stay * (1.0 - detect(state, settings) * model.visibility)
        time, more = look.time, left.max(1) > LEAST
        if not more.all():  # looks before these change nothing there
            rows, left, state = rows[more], left[more], state[more]
        if not len(rows):
            break
    share[rows] += left
    return share
