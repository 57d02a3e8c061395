"""The prior of a road's course in the numbers C = (x, y, heading) of its start and of its end.

Roads are built of clothoids, so what is known beforehand is known about curvature, its rate and the length. C is normal
in [T17] eq. 3, with hyper-parameters set by hand; here they are the moments that the clothoids have:

    mean = E[C],  covariance = Cov[C],   C = (start, end of the clothoid from start)

by Gauss-Hermite quadrature over heading, curvature, rate and length. The covariance must be full: the end lies tens
of metres to either side, nearly as its heading says.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray

from models.clothoid import Clothoid, evaluate
from models.program import InputError

Floats = NDArray[np.float64]
ORDER = 9  # of the quadrature, in each of four dimensions


@dataclass(frozen=True)
class CoursePrior:
    """The start (behind the car, in the middle of its lane), and what the road does from there."""

    behind: float = 10.0  # of the car, where the course begins [m]
    behind_std: float = 0.5  # [m]
    lateral_std: float = 0.4  # of the car in its lane [m]
    heading_std: float = 0.03  # of the car against its lane [rad]
    curvature_std: float = 1 / 400  # [1/m]
    rate_std: float = 1 / 36000  # [1/m^2]; a bend of 400 m after 90 m
    length: float = 155.0  # [m]
    length_std: float = 1.0  # of roads; the moments of C, in which bends shorten the chord, imply about 10 [m]

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value) or value <= 0:
                raise InputError(f"{field.name} of the course prior must be finite and positive, but is {value}")


USUAL_ROADS = CoursePrior()


@functools.lru_cache
def course_moments(prior: CoursePrior) -> tuple[Floats, Floats]:
    """Mean (6,) of C = (x, y, heading) of start and end, and the lower Cholesky factor (6, 6) of its covariance."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(ORDER)
    unit = np.array(list(itertools.product(nodes, repeat=4)))
    weight = np.prod(list(itertools.product(weights / weights.sum(), repeat=4)), -1)
    heading, curvature, rate, length = unit.T * [
        [prior.heading_std], [prior.curvature_std], [prior.rate_std], [prior.length_std]
    ]  # fmt: skip
    zero = np.zeros(len(unit))
    parts = [torch.from_numpy(v) for v in (zero, zero, heading, curvature, rate, length + prior.length)]
    end = evaluate(Clothoid(*parts), parts[-1][:, None])
    shape = np.column_stack([zero, zero, heading, *(v[:, 0].numpy() for v in end[:3])])  # from a start at the origin
    mean = weight @ shape
    covariance = ((shape - mean) * weight[:, None]).T @ (shape - mean)
    for axis, std in ((0, prior.behind_std), (1, prior.lateral_std)):  # a start elsewhere moves both ends alike
        ends = np.eye(6)[axis] + np.eye(6)[axis + 3]
        covariance += std**2 * np.outer(ends, ends)
    mean[[0, 3]] -= prior.behind
    return mean, np.linalg.cholesky(covariance)
