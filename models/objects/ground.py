"""Where objects may be and how fast, as a map or a grid knows it ([K15], III-C: spatial birth probability and maximum
velocity)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from models.program import InputError

Floats = NDArray[np.float64]


class Ground(Protocol):
    """What is known of places, at positions (N, 2)."""

    def density(self, position: Floats) -> Floats:
        """(N,) objects that no scan has shown yet [1/m^2]."""

    def speed_limit(self, position: Floats) -> Floats:
        """(N,) that newcomers keep [m/s], inf where there is none."""


@dataclass(frozen=True)
class Grid:
    """Cells of one size, row after row in y.

    corner   lowest x and y [m]
    cell     side of a cell [m]
    objects  (R, C) density in each [1/m^2]
    limits   (R, C) speed limits [m/s], None for none
    outside  density beyond the grid, where no limit is known
    """

    corner: tuple[float, float]
    cell: float
    objects: tuple[tuple[float, ...], ...]
    limits: tuple[tuple[float, ...], ...] | None = None
    outside: float = 0.0

    def __post_init__(self) -> None:
        for name, table in (("objects", self._objects), ("limits", self._limits)):
            if table.ndim != 2 or table.shape != self._objects.shape or not (table >= 0.0).all():
                raise InputError(f"grid: {name} is of shape {table.shape}; give rows of numbers >= 0, all as long")
        if not 0.0 < self.cell < math.inf or not self.outside >= 0.0:
            raise InputError(f"grid: cell is {self.cell} and outside {self.outside}; give a side > 0, a density >= 0")

    @cached_property
    def _objects(self) -> Floats:
        return np.array(self.objects, dtype=np.float64)

    @cached_property
    def _limits(self) -> Floats:
        return np.full_like(self._objects, math.inf) if self.limits is None else np.array(self.limits, dtype=np.float64)

    def density(self, position: Floats) -> Floats:
        return self._look_up(self._objects, position, self.outside)

    def speed_limit(self, position: Floats) -> Floats:
        return self._look_up(self._limits, position, math.inf)

    def _look_up(self, table: Floats, position: Floats, outside: float) -> Floats:
        column, row = np.floor((position - np.array(self.corner)) / self.cell).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < table.shape[1]) & (row < table.shape[0])
        return np.where(inside, table[np.where(inside, row, 0), np.where(inside, column, 0)], outside)


def limited(mean: float, std: float, limit: Floats) -> tuple[Floats, Floats]:
    """Mean and standard deviation (N,) of a normal number that is below a limit (N,):

    mean - std h,   std sqrt(1 - a h - h^2),   a = (limit - mean) / std,   h = N(a; 0, 1) / Phi(a)"""
    from scipy.special import log_ndtr

    a = np.minimum((limit - mean) / std, 40.0)  # beyond that nothing is cut off
    hazard = np.exp(-0.5 * np.square(a) - 0.5 * math.log(2 * math.pi) - log_ndtr(a))
    return mean - std * hazard, std * np.sqrt(np.maximum(1.0 - a * hazard - np.square(hazard), 1e-6))
