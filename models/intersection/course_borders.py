"""Border points as a cue of lane courses: they make the width of lanes observable.

The border between lanes k - 1 and k of one side of an arm is where a lane k - 1/2 would run. A point is beside the
border at t, its distance from the centre along the arm, and off it by

    residual  n . (p - P(t)) / border,   n normal to the border at P(t) = `arm_point` of lane k - 1/2

Where along the border a point was taken says nothing. Offsets and waves of a lane are its own: borders have none.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
import torch
from numpy.typing import NDArray
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from models.intersection.border_points import BorderPoints
from models.intersection.course_nodes import ANGLE, END, HEAD, arm_point
from models.normal_equations import add_columns
from models.program import InputError

Array = NDArray[np.float64]


@nb.njit(cache=True, error_model="numpy")
def border_equations(z, where, latent, slots, points, row, number, std, hessian, gradient):  # type: ignore[no-untyped-def]
    """Cost of all points; adds its gradient (D,) and fills its Gauss-Newton Hessian, arm by arm and side by side,
    (2 K, P, P), lower triangles.

    where   (2 K, D') which of the numbers z each side of an arm depends on, -1 for none; latent (P,) and slots (2 K, P)
            as in `course_kernel.normal_equations`
    points  (2, M), row (M,) 2 arm + end, rising, and number (M,) of the border that each is on"""
    size, width, cost, i = len(latent), where.shape[1], 0.0, 0
    v, slopes, point, tangent = np.empty(width), np.zeros((width + 1, 4)), np.empty(2), np.empty(2)
    columns, block = np.empty((size + 1, points.shape[1])), np.empty((size + 1, size))
    for side in range(len(hessian)):  # loops: assignments of slices take seconds to compile
        for p in range(size):
            for q in range(size):
                hessian[side, p, q] = 0.0
    while i < points.shape[1]:
        side, n, end = row[i], 0, row[i] % 2
        slopes[:], block[:] = 0.0, 0.0
        for p in range(width):
            v[p] = z[where[side, p]] if where[side, p] >= 0 else 0.0
        angle = v[HEAD + END * end + ANGLE]
        dx, dy = math.cos(angle), math.sin(angle)
        while i < points.shape[1] and row[i] == side:
            t = (points[0, i] - v[0]) * dx + (points[1, i] - v[1]) * dy
            arm_point(v, end, number[i] - 0.5, t, dx, dy, point, tangent, slopes)
            scale = 1.0 / (std * math.hypot(tangent[0], tangent[1]))
            nx, ny = -tangent[1] * scale, tangent[0] * scale
            residual = nx * (points[0, i] - point[0]) + ny * (points[1, i] - point[1])
            cost += 0.5 * residual**2
            for p in range(size):
                columns[p, n] = -nx * slopes[latent[p], 0] - ny * slopes[latent[p], 1]
            columns[size, n] = residual
            n, i = n + 1, i + 1
        add_columns(columns, n, block)
        for p in range(size):
            if slots[side, p] >= 0:
                gradient[slots[side, p]] += block[size, p]
            for q in range(p + 1):
                hessian[side, p, q] = block[p, q]
    return cost


def border_arrays(borders: BorderPoints, std: float) -> tuple[Any, ...]:
    """What `border_equations` reads besides the numbers."""
    return np.ascontiguousarray(borders.points.numpy()), 2 * borders.arm + borders.end, borders.number, std


def log_border_constant(borders: BorderPoints, std: float) -> float:
    """log p(border points | courses) plus the cost."""
    return -borders.points.shape[1] * (math.log(std) + 0.5 * math.log(2 * math.pi))


class PointsOnBorders(TorchDistribution):
    """Points (2, M) about the borders of arms; normal across them, anywhere along them. It cannot simulate.

    numbers  (*batch, D') of courses; where (2 K, .) which of them each side of an arm depends on"""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.real, 2)

    def __init__(self, borders: BorderPoints, std: float, numbers: Tensor, where: NDArray[np.int64]) -> None:
        self.borders, self.std, self.numbers, self.where = borders, std, numbers, where
        super().__init__(numbers.shape[:-1], borders.points.shape, validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        if value is not self.borders.points:
            raise InputError("lane courses score the borders that their evidence was prepared from; prepare() others")
        none = np.zeros((len(self.where), 0, 0))
        rest = (self.where, np.zeros(0, np.int64), np.zeros(none.shape[:2], np.int64))
        rest += (*border_arrays(self.borders, self.std), none, np.zeros(0))
        rows = self.numbers.detach().reshape(-1, self.numbers.shape[-1]).numpy()
        costs = [border_equations(z, *rest) for z in rows]  # type: ignore[call-arg]
        constant = log_border_constant(self.borders, self.std)
        return constant - torch.tensor(costs, dtype=torch.float64).reshape(self.batch_shape)
