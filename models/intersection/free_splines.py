"""Splines of stubs and of lanes: controls as linear functions of normal numbers.

Third differences T c of uniform cubic controls c (h apart) tell how curvature changes, for f'' = (c_(k-1) - 2 c_k +
c_(k+1)) / h^2 at the knots; they do not see parabolas. A lane on an arm lies at

    offset + arm_bow . (x, x^2) + stub_bow . (x, x^2) + T^+ arm_jerk + T^+ stub_jerk,   x = -1 outside .. 1 inside

controls beside the axis of the arm: arm numbers are those of all its lanes, stub numbers of the lanes that begin or end
as one. Between its stubs a lane is free: given their controls c_b, its own ones c_i are normal with

    T c ~ N(v, inner_std^2),   c_i = P^-1 T_i' (v - T_b c_b) + L^-T inner,   P = L L' = T_i' T_i

v is what makes the third differences those of the course itself rather than of its distance from the reference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular

from models.spline import ORDER

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
ENDS = ORDER - 1  # controls more than pieces


class Numbered(NamedTuple):
    """Controls (n, D) as linear functions of D of all numbers, `where` (D,) tells which."""

    controls: Array
    where: Ints

    def first(self, num: int) -> Numbered:
        """The first `num` controls."""
        return self._replace(controls=self.controls[:num])


def from_third(num: int) -> Array:
    """T^+ (num, num - 3): the controls without a parabola that have given third differences."""
    return np.asarray(np.linalg.pinv(np.diff(np.eye(num), ENDS, axis=0)))


def stub_controls(pieces: int, arm_pieces: int) -> Array:
    """Controls (pieces + 3, .) of a stub from outside inwards, beside the axis of an arm with at least as many pieces,
    by offset (1), arm_bow (2), stub_bow (2), arm_jerk (arm_pieces) and stub_jerk (pieces)."""
    x = 2.0 * (np.arange(pieces + ENDS) - 1) / arm_pieces - 1.0
    bow = np.stack([x, x**2], 1)
    arm, stub = from_third(arm_pieces + ENDS)[: pieces + ENDS], from_third(pieces + ENDS)
    return np.hstack([np.ones((len(x), 1)), bow, bow, arm, stub])


class Bridge(NamedTuple):
    """The free controls of a lane: c = given c_b + own z, and the middle of z."""

    given: Array
    own: Array
    middle: Array


def bridge(thirds: Array, free: slice, anchor: float) -> Bridge:
    """Free controls given the others of a lane; `free` is their place among all, thirds v (pieces,).

    Where a lane has no other controls, its first, middle and last are normal about 0 with inner_std / anchor."""
    num = len(thirds) + ENDS
    rows = np.diff(np.eye(num), ENDS, axis=0)
    touching = np.abs(rows[:, free]).sum(1) > 0
    rows, right = rows[touching], thirds[touching]
    if free == slice(0, num):
        rows, right = np.vstack([rows, anchor * np.eye(num)[[0, num // 2, num - 1]]]), np.r_[right, np.zeros(3)]
    own = rows[:, free]
    others = np.delete(rows, np.r_[free], axis=1)
    lower = np.linalg.cholesky(own.T @ own)
    half = solve_triangular(lower, own.T, lower=True)  # L^-1 T_i'
    return Bridge(
        -solve_triangular(lower, half @ others, trans="T", lower=True),
        solve_triangular(lower, np.eye(len(lower)), trans="T", lower=True),
        half @ right,
    )


def lane_controls(link: Bridge, begin: int, given: list[Numbered], has_exit: bool, own: Ints) -> Numbered:
    """Controls of a whole lane in driving order, to the left of its reference.

    begin  number of its controls on the entry stub
    given  controls of its stubs from outside inwards, entry first; the last one is the exit's if it has one
    own    which of all numbers the free controls' are"""
    if has_exit:
        given = [*given[:-1], Numbered(-given[-1].controls[::-1], given[-1].where)]
    shared = block_diag(*(stub.controls for stub in given)) if given else np.zeros((0, 0))
    fixed = np.hstack([shared, np.zeros((len(shared), len(own)))])
    free = np.hstack([link.given @ shared, link.own])
    where = np.concatenate([*(stub.where for stub in given), own])
    unique, inverse = np.unique(where, return_inverse=True)  # on a U-turn both stubs are on one arm
    controls = np.zeros((len(fixed) + len(free), len(unique)))
    np.add.at(controls.T, inverse, np.vstack([fixed[:begin], free, fixed[begin:]]).T)
    return Numbered(controls, unique)
