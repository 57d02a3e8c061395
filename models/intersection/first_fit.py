"""The course of one lane by itself, beside a curve near it: the reference for estimating all lanes together."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.intersection.free_kernel import free_equations, free_nodes
from models.intersection.free_splines import ENDS, bridge
from models.intersection.reference import arc_length, reference_curve, resampled, tangents, turns
from models.spline import ORDER, basis

Array = NDArray[np.float64]


ROUNDS = 4  # of fits, each about the one before
FACTORS = np.geomspace(0.1, 10.0, 9)


class Scales(NamedTuple):
    """Standard deviations [m]: of offsets, of third differences between stubs, of a point on each axis."""

    offset: float
    inner: float
    position: float


def spline_values(t: Array, knots: float, num: int) -> Array:
    """(n, num) what each of a spline's controls counts at t (n,)."""
    pieces, weights, _ = basis(t, 0.0, knots, num)
    values = np.zeros((len(t), num))
    np.put_along_axis(values, pieces[:, None] + np.arange(ORDER), weights, 1)
    return values


def first_course(tracks: list[Array], spacing: float, knots: float, scales: Scales) -> tuple[Array, float]:
    """A first course (n, 2) of a lane from its tracks, each (m, 2), with nodes about `spacing` apart, and the standard
    deviation of its third differences."""
    line, std = reference_curve(tracks, spacing), scales.inner
    for _ in range(ROUNDS):
        course, std = fitted(line, tracks, knots, scales)
        line = resampled(course, spacing)
    return line, std


def fitted(line: Array, tracks: list[Array], knots: float, scales: Scales) -> tuple[Array, float]:
    """The course (n, 2) that one Gauss-Newton step leads to from a curve near it, and the standard deviation of its
    third differences [m]: of FACTORS times scales.inner the one with the largest marginal likelihood of the positions
    of its tracks, each (m, 2)."""
    s = arc_length(line)
    pieces = max(math.ceil(s[-1] / knots - 1e-6), 1)
    link = bridge(turns(line, s, pieces, knots), slice(0, pieces + ENDS), scales.inner / scales.offset)
    design = spline_values(s, knots, pieces + ENDS) @ link.own
    size = design.shape[1]
    offsets = np.cumsum([0, *(len(t) for t in tracks)])
    points = np.vstack([np.concatenate(tracks).T, np.zeros(offsets[-1])])
    reference = np.hstack([line, tangents(line)])
    own = (np.arange(size), design.reshape(-1), np.array([size]), reference, np.array([len(line)]))
    data = (np.arange(len(tracks)), np.array([0, len(tracks)]), offsets, points, np.array([scales.position, np.inf]))
    hessian, gradient = np.empty((size, size)), np.empty(size)
    free_equations(np.zeros(size), own, data, hessian, gradient)  # type: ignore[call-arg]
    z, std = smoothest(hessian, gradient, link.middle, scales.inner * FACTORS)
    nodes = np.empty((len(line), 5 + size))
    free_nodes(z, reference, design, nodes)
    return nodes[:, :2], std


def smoothest(hessian: Array, gradient: Array, middle: Array, stds: Array) -> tuple[Array, float]:
    """The mode z of N(middle, std^2) times exp(-z' H z / 2 - g' z), and the one of `stds` with the largest integral.

    In the eigenvectors of H numbers are independent: with precisions p = h + 1 / std^2, the integral's logarithm is
    sum (b^2 / p - middle^2 / std^2 - log(std^2 p)) / 2,   b = middle / std^2 - g,   mode = b / p"""
    values, vectors = np.linalg.eigh(hessian)
    rows = 1.0 / stds[:, None] ** 2
    m, precision = vectors.T @ middle, np.maximum(values, 0.0) + rows
    right = m * rows - vectors.T @ gradient
    evidence = 0.5 * (right**2 / precision - m**2 * rows - np.log(precision / rows)).sum(1)
    best = int(evidence.argmax())
    return vectors @ (right[best] / precision[best]), float(stds[best])
