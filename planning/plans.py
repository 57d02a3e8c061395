"""Plans: motions along and across a line, chosen among candidates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.candidates import Lateral, Longitudinal
from planning.frenet import FrenetState, to_poses
from planning.polynomials import Polynomials
from planning.reference import ReferenceLine

Floats = NDArray[np.float64]
# from powers of t / T to Bernstein's basis: a polynomial on [0, T] lies between its least and largest coefficient there
BERNSTEIN = np.array([[math.comb(i, k) / math.comb(4, k) for k in range(5)] for i in range(5)])
AHEAD = 1e-9  # [m/s] a speed that is always more never turns
SLOWEST = 0.05  # [m/s] above which a motion told by time tells a direction


class Candidates(NamedTuple):
    """All n x m of them, cheapest first in `order`; `reason` each is bad for (planning.check_kernel.REASONS), -1 where
    none was asked for; `when` it arises [steps]; `best` the cheapest good one, or -1."""

    longitudinal: Longitudinal
    lateral: Lateral
    cost: Floats
    order: NDArray[np.int64]
    reason: NDArray[np.int64]
    when: NDArray[np.int64]
    best: int


class Plan(NamedTuple):
    """A motion from `start` on and how it was come by.

    tier       comfort, relaxed, emergency
    clear      whether it breaks nothing within the horizon (an emergency stop may, and others who stands)
    cost       of its candidate
    rejected   {reason: how many cheaper candidates were turned down for it} (planning.check_kernel.REASONS)
               Each counts once: those that touch a road user and a line for the road user or, where all reasons were
               asked for, for what they touch first.
    candidates that it was chosen from; None where they were let go (a megabyte)
    """

    line: ReferenceLine
    start: FrenetState
    longitudinal: Polynomials
    lateral: Lateral
    tier: str
    clear: bool
    cost: float
    rejected: dict[str, int]
    candidates: Candidates | None

    def along(self, t: Floats) -> Floats:
        """s, s', s'' (K, 3), never backwards: it stands where the motion turns, until that is back."""
        told = self.longitudinal.at(t)[0]
        rate = self.longitudinal.coefficients[0, 1:] * np.arange(1.0, 6.0)  # of the speed's powers
        if (BERNSTEIN @ (rate * self.longitudinal.duration[0] ** np.arange(5.0)) > AHEAD).all():  # it never turns
            return told
        speed = np.polynomial.Polynomial(rate)
        roots = np.asarray(speed.roots(), complex)
        turns: Floats = np.sort(roots[np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots.real))].real)
        turns = np.r_[0.0, turns[(turns > 0.0) & (turns < self.longitudinal.duration[0])]]
        farthest = np.maximum.accumulate(self.longitudinal.at(turns)[0, :, 0])
        farthest = farthest[np.searchsorted(turns, t, side="right") - 1]
        still = (told[:, 1] < 0.0) | (farthest > told[:, 0])
        told[still, 0] = np.maximum(farthest, told[:, 0])[still]
        told[still, 1:] = 0.0
        return told

    def states(self, t: Sequence[float] | Floats) -> list[FrenetState]:
        """Where the vehicle is along the line at times t after the start."""
        along = self.along(np.asarray(t, float))
        if self.lateral.by_way[0]:
            across = self.lateral.motion.at(along[:, 0] - self.start.s)[0]
            return [FrenetState(*map(float, (*a, *d))) for a, d in zip(along, across, strict=True)]
        across = self.lateral.motion.at(np.asarray(t, float))[0]
        return [state_of(a, d) for a, d in zip(along, across, strict=True)]

    def trajectory(self, t: Sequence[float] | Floats) -> Floats:
        """x, y, heading, speed, acceleration, curvature (K, 6) at times t after the start."""
        return to_poses(self.line, self.states(t))


def forwards(along: Floats) -> Floats:
    """s, s', s'' (K, 3) at rising times, standing where they would go back."""
    told = along.copy()
    still = (told[:, 1] < 0.0) | (np.maximum.accumulate(told[:, 0]) > told[:, 0])
    told[:, 0] = np.maximum.accumulate(told[:, 0])
    told[still, 1:] = 0.0
    return told


def state_of(along: Floats, across: Floats) -> FrenetState:
    """The state of s, s', s'' and d, d', d'' in time; at rest the line's direction."""
    s, ds, dds = map(float, along)
    d, dd, ddd = map(float, across)
    if ds < SLOWEST:
        return FrenetState(s, ds, dds, d)
    slope = dd / ds
    return FrenetState(s, ds, dds, d, slope, (ddd - slope * dds) / ds**2)
