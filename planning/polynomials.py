"""Jerk-optimal motions in one coordinate: polynomials of degree five or less, at rest in acceleration after their end.

    q(t) = c_0 + c_1 t + ... + c_5 t^5,  0 <= t <= T;      q(t) = q(T) + q'(T) (t - T) beyond

Those from (q, q', q'') to (q, q', q'')(T) with the least integral of the squared jerk are quintic; where q(T) is free
they are quartic (Werling et al. 2010, section V; [K15] calls all of them quintic).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.formula import Formula

Floats = NDArray[np.float64]


class Polynomials(NamedTuple):
    """coefficients (N, 6), rising powers; duration (N,), beyond which the motion is uniform."""

    coefficients: Floats
    duration: Floats

    def at(self, t: ArrayLike) -> Floats:
        """q, q', q'' (N, K, 3) at times t (K,)."""
        t = np.asarray(t, float)
        inside = np.minimum(t, self.duration[:, None])  # (N, K)
        powers = inside[..., None] ** np.arange(6)
        c, k = self.coefficients[:, None, :], np.arange(6.0)
        q = (c * powers).sum(-1)
        first = (c[..., 1:] * k[1:] * powers[..., :5]).sum(-1)
        second = (c[..., 2:] * k[2:] * (k[2:] - 1) * powers[..., :4]).sum(-1)
        over = t - inside
        return np.stack([q + first * over, first, np.where(over > 0, 0.0, second)], -1)

    def end(self) -> Floats:
        """q, q' (N, 2) at each one's own end."""
        powers = self.duration[:, None] ** np.arange(6)
        c, k = self.coefficients, np.arange(1, 6)
        return np.stack([(c * powers).sum(1), (c[:, 1:] * k * powers[:, :5]).sum(1)], -1)

    def later(self, time: float) -> Polynomials:
        """What is left of each after `time`; one that is over goes on uniformly."""
        left = self.duration - time
        shift = np.array([[comb(k, i) * time ** (k - i) if k >= i else 0.0 for k in range(6)] for i in range(6)])
        moved = self.coefficients @ shift.T
        over = left <= 0
        if over.any():
            told = self.at([time])[over, 0]
            moved[over] = 0.0
            moved[over, :2] = told[:, :2]
        return Polynomials(moved, np.maximum(left, 0.0))

    def take(self, index: Any) -> Polynomials:
        """Those of `index` (integers, a slice or a mask)."""
        return Polynomials(self.coefficients[index], self.duration[index])


def _quintic(x: Sequence[Any], p: Sequence[Any], ops: Any) -> tuple[Any, ...]:
    q0, v0, a0, q1, v1, a1, T = x
    dq, dv, da = q1 - q0 - v0 * T - a0 * T * T / 2, v1 - v0 - a0 * T, a1 - a0
    c3 = (20 * dq - 8 * dv * T + da * T * T) / (2 * T**3)
    c4 = (-30 * dq + 14 * dv * T - 2 * da * T * T) / (2 * T**4)
    c5 = (12 * dq - 6 * dv * T + da * T * T) / (2 * T**5)
    return q0, v0, a0 / 2, c3, c4, c5


def _quartic(x: Sequence[Any], p: Sequence[Any], ops: Any) -> tuple[Any, ...]:
    q0, v0, a0, v1, a1, T = x
    dv, da = v1 - v0 - a0 * T, a1 - a0
    return q0, v0, a0 / 2, (3 * dv - da * T) / (3 * T**2), (da * T - 2 * dv) / (4 * T**3), 0.0


def _squared_jerk(x: Sequence[Any], p: Sequence[Any], ops: Any) -> tuple[Any, ...]:
    a, b, c, T = 6 * x[3], 24 * x[4], 60 * x[5], x[6]
    return (T * (a * a + T * (a * b + T * ((b * b + 2 * a * c) / 3 + T * (b * c / 2 + T * c * c / 5)))),)


QUINTIC = Formula("quintic", _quintic, 7)  # (q, q', q''; q, q', q'' at T; T) -> c
QUARTIC = Formula("quartic", _quartic, 6)  # (q, q', q''; q', q'' at T; T) -> c
SQUARED_JERK = Formula("squared_jerk", _squared_jerk, 7)  # (c, T) -> the integral of jerk^2 over [0, T]
NOTHING = np.zeros((1, 0))


def quintics(start: Sequence[float], end: ArrayLike, duration: ArrayLike) -> Polynomials:
    """From start (q, q', q'') to each end (N, 3) = (q, q', q'') in its duration (N,)."""
    end, duration = np.asarray(end, float), np.asarray(duration, float)
    x = np.column_stack([np.broadcast_to(np.asarray(start, float), (len(end), 3)), end, duration])
    return Polynomials(QUINTIC(x, NOTHING), duration)


def quartics(start: Sequence[float], speed: ArrayLike, duration: ArrayLike) -> Polynomials:
    """From start (q, q', q'') to each speed (N,), unaccelerated, wherever, in its duration (N,)."""
    speed, duration = np.asarray(speed, float), np.asarray(duration, float)
    x = np.column_stack(
        [np.broadcast_to(np.asarray(start, float), (len(speed), 3)), speed, np.zeros_like(speed), duration]
    )
    return Polynomials(QUARTIC(x, NOTHING), duration)


def squared_jerk(motion: Polynomials) -> Floats:
    """(N,) the integral of the squared jerk over [0, T] [m^2/s^5]."""
    found: Floats = SQUARED_JERK(np.column_stack(motion), NOTHING)[:, 0]
    return found
