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

import math
from collections.abc import Sequence
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from models.objects.scans import Scan

if TYPE_CHECKING:
    from models.objects.traffic import Traffic

Floats = NDArray[np.float64]
LEAST = 1e-3  # of what was there before a look: where later looks have left less of it, looks before are not counted
FEW = 3  # looks that settle it nearly everywhere: more are taken up only where they do not


def left_over(model: Traffic, scan: Scan, past: Sequence[Scan], position: Floats) -> Floats:
    """(M, C) u / u_0 of each kind at positions (M, 2) that a scan shows, after the scans `past`, by time."""
    sensor, shape, time = model.sensor(scan), (len(position), len(model.kinds)), scan.time
    share, left, rows = np.zeros(shape), np.ones(shape), np.arange(len(position))
    detect = model.formulas(sensor)[1].compiled(jacobian=False)
    looks = (look for look in reversed(past) if look.sensor == sensor.name)
    for count in (FEW, None):
        some = list(islice(looks, count))
        if not some or not len(rows):
            break
        pose, times = np.concatenate([look.pose for look in some]), np.array([look.time for look in some])
        states, settings, detection = laid_out(rows, position, pose, sensor.looking, len(model.names))
        detect(states, settings, detection)
        rows = count_looks(rows, detection, time, times, model.lifetime, model.visibility, share, left)
        time = some[-1].time
    share[rows] += left[rows]
    return share


@njit(cache=True, error_model="numpy")
def laid_out(rows, position, pose, looking, size):  # type: ignore[no-untyped-def]
    """What p_D reads: states (R L, n) at some of the positions, at rest, for each of L poses (3 L,) of the car, and
    settings (R L, .) of the sensor there; and where to put it (R L, 1)."""
    R, L, own = len(rows), len(pose) // 3, len(looking)
    states, settings = np.zeros((R * L, size)), np.empty((R * L, own))
    for k in range(L):
        x, y, heading = pose[3 * k], pose[3 * k + 1], pose[3 * k + 2]
        cos, sin = math.cos(heading), math.sin(heading)
        x, y = x + cos * looking[0] - sin * looking[1], y + sin * looking[0] + cos * looking[1]
        for r in range(R):
            at = r * L + k
            states[at, 0], states[at, 1] = position[rows[r], 0], position[rows[r], 1]
            settings[at, 0], settings[at, 1], settings[at, 2] = x, y, heading + looking[2]
            for i in range(3, own):
                settings[at, i] = looking[i]
    return states, settings, np.empty((R * L, 1))


@njit(cache=True, error_model="numpy")
def count_looks(rows, detection, time, times, lifetime, visibility, share, left):  # type: ignore[no-untyped-def]
    """Take L looks at falling times (L,) into account, of which the first is `time` before: the sum and the product of
    the equation in `share` and `left` (M, C), of some rows, with p_D (R L, 1). The rows that are not settled."""
    L, unsettled = len(times), np.empty_like(rows)
    num = 0
    for r in range(len(rows)):
        m, then = rows[r], time
        for k in range(L):
            most = 0.0
            for c in range(len(lifetime)):
                stay = math.exp((times[k] - then) / lifetime[c])
                share[m, c] += left[m, c] * (1.0 - stay)
                left[m, c] *= stay * (1.0 - detection[r * L + k, 0] * visibility[c])
                most = max(most, left[m, c])
            then = times[k]
            if most <= LEAST:
                break
        if most > LEAST:
            unsettled[num] = m
            num += 1
    return unsettled[:num]
