"""Half tracks as moments: all that a straight or bent lane needs to know about many points.

A half track is the part of a track on one arm, before or behind the crossing area. Seen from the
arm (direction d, normal n, offset o of the lane, bend kappa) its points at distance s are

    p_i = c + (s_i + a) d + (o + b + kappa tau_i) n + noise,    tau = s (s - CHORD) / 2
    phi_i = alpha + (pi if incoming) + kappa (s_i - CHORD / 2) + noise

The bend leaves the chord from the centre to s = CHORD in place: alpha is the direction to the arm.
Squared residuals summed over the points of a half are quadratic forms in its mean and scatter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CHORD = 50.0  # [m]

# rows of the observed moments: means, then scatter about the means
MX, MY, CXX, CXY, CYY, CXS, CYS, CXT, CYT, MPHI, CPP, CPS = range(12)
NUM_MOMENTS = 12
# rows of the fixed moments of the positions along the lane
COUNT, MS, MT, CSS, CTT = range(5)


class Noise(NamedTuple):
    """What separates a vehicle's points from its lane.

    position  across the lane, point by point [m]
    along     along the lane, point by point [m]
    offset    across the lane, common to one half track: drivers keep off centre [m]
    phase     along the lane, common to one half track: where along the lane it was is not known [m]
    heading   point by point [rad]; inf where headings say nothing
    """

    position: float
    along: float
    offset: float
    phase: float
    heading: float


@nb.njit(cache=True)
def moments(x, y, phi, s, starts):  # type: ignore[no-untyped-def]
    """Means and scatter of every half track, (12, H); half h holds points starts[h]:starts[h+1]."""
    num = len(starts) - 1
    out = np.zeros((NUM_MOMENTS, num))
    for h in range(num):
        first, last = starts[h], starts[h + 1]
        n = last - first
        if n == 0:
            continue
        mx = my = ms = mt = mp = 0.0
        for i in range(first, last):
            mx += x[i]
            my += y[i]
            ms += s[i]
            mt += 0.5 * s[i] * (s[i] - CHORD)
            mp += phi[i]
        mx, my, ms, mt, mp = mx / n, my / n, ms / n, mt / n, mp / n
        out[MX, h], out[MY, h], out[MPHI, h] = mx, my, mp
        for i in range(first, last):
            dx, dy, ds, dp = x[i] - mx, y[i] - my, s[i] - ms, phi[i] - mp
            dt = 0.5 * s[i] * (s[i] - CHORD) - mt
            out[CXX, h] += dx * dx
            out[CXY, h] += dx * dy
            out[CYY, h] += dy * dy
            out[CXS, h] += dx * ds
            out[CYS, h] += dy * ds
            out[CXT, h] += dx * dt
            out[CYT, h] += dy * dt
            out[CPP, h] += dp * dp
            out[CPS, h] += dp * ds
    return out


@nb.njit(cache=True)
def along_moments(s, starts):  # type: ignore[no-untyped-def]
    """Count, means and scatter of the fixed positions along the lane, (5, H)."""
    num = len(starts) - 1
    out = np.zeros((5, num))
    for h in range(num):
        first, last = starts[h], starts[h + 1]
        n = last - first
        if n == 0:
            continue
        out[COUNT, h] = n
        for i in range(first, last):
            out[MS, h] += s[i] / n
            out[MT, h] += 0.5 * s[i] * (s[i] - CHORD) / n
        for i in range(first, last):
            ds, dt = s[i] - out[MS, h], 0.5 * s[i] * (s[i] - CHORD) - out[MT, h]
            out[CSS, h] += ds * ds
            out[CTT, h] += dt * dt
    return out


# rows of the coefficients that the density reads, see `coefficients`
X, Y, S, T, SIDE, OUTGOING, W_ACROSS, W_ALONG, W_HEADING = range(9)
A0, A_XX, A_YY, A_XY, A_X, A_Y, A_KY, A_KX, A_K, A_KK = range(9, 19)
NUM_COEFFICIENTS = 19


@nb.njit(cache=True)
def coefficients(observed, fixed, entries, position, along, offset, phase, heading, out):  # type: ignore[no-untyped-def]
    """Moments scaled by the noise, (19, H): four means, side (+1 for the first `entries` halves, -1 for the rest),
    the mean heading as seen by somebody driving out, three weights of the mean residuals, and

        scatter cost(d, kappa) = A0 + dx^2 A_XX + dy^2 A_YY + dx dy A_XY + dx A_X + dy A_Y
                                 + kappa (dy A_KY - dx A_KX + A_K) + kappa^2 A_KK

    A weight is 1 / (noise^2 / N + common^2): the common offset of a half is integrated out."""
    across2, along2 = 0.5 / position**2, 0.5 / along**2
    head2 = 0.5 / heading**2
    for h in range(observed.shape[1]):
        n = fixed[COUNT, h]
        out[X, h], out[Y, h] = observed[MX, h], observed[MY, h]
        out[SIDE, h] = 1.0 if h < entries else -1.0
        out[OUTGOING, h] = observed[MPHI, h] - (math.pi if h < entries else 0.0)
        out[S, h], out[T, h] = fixed[MS, h], fixed[MT, h]
        out[W_ACROSS, h] = n / (position**2 + n * offset**2)
        out[W_ALONG, h] = n / (along**2 + n * phase**2) if along2 > 0.0 else 0.0
        out[W_HEADING, h] = 2.0 * head2 * n
        cxx, cxy, cyy = observed[CXX, h], observed[CXY, h], observed[CYY, h]
        out[A0, h] = along2 * fixed[CSS, h] + head2 * observed[CPP, h]
        out[A_XX, h] = across2 * cyy + along2 * cxx
        out[A_YY, h] = across2 * cxx + along2 * cyy
        out[A_XY, h] = 2.0 * (along2 - across2) * cxy
        out[A_X, h] = -2.0 * along2 * observed[CXS, h]
        out[A_Y, h] = -2.0 * along2 * observed[CYS, h]
        out[A_KY, h] = 2.0 * across2 * observed[CXT, h]
        out[A_KX, h] = 2.0 * across2 * observed[CYT, h]
        out[A_K, h] = -2.0 * head2 * observed[CPS, h]
        out[A_KK, h] = across2 * fixed[CTT, h] + head2 * fixed[CSS, h]


def log_normaliser(fixed: Array, noise: Noise) -> Array:
    """log of the Gaussian factors in front of exp(-cost), (H,)."""
    n = fixed[COUNT]
    value = -0.5 * n * math.log(2 * math.pi * noise.position**2)
    value = value - 0.5 * np.log1p(n * noise.offset**2 / noise.position**2)
    value = value - 0.5 * n * math.log(2 * math.pi * noise.along**2)
    value = value - 0.5 * np.log1p(n * noise.phase**2 / noise.along**2)
    if math.isfinite(noise.heading):
        value = value - 0.5 * n * math.log(2 * math.pi * noise.heading**2)
    return np.asarray(value)
