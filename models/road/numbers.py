"""The course in the numbers that engines run on: those of its clothoid.

    theta = (x, y, heading, curvature, rate, length)      start pose [m, m, rad], [1/m], [1/m^2], [m]
    C(theta) = (x, y, heading) of start and end           models.road.prior, [T17] eq. 1

Cues say where the road runs, hardly where the course ends: in C the posterior slides along the road and is bent like
it, in theta only the length is free. The density of theta is that of C times

    |dC / dtheta| = det [d(x, y, heading) of the end / d(curvature, rate, length)]

in the frame of the start, for the start is in C as it is. With M_k = integral of s^k (cos, sin)(heading(s) - heading),
its columns are (-M_1s, M_1c, l), (-M_2s, M_2c, l^2) / 2 and (cos, sin, curvature) of the end.

Whitened, theta = mean + tril x with the moments that theta has where C follows its prior, so that N(x; 0, 1) is near
the prior, and one more factor corrects it:  log N(C; ..) + log |dC / dx| - log N(x; 0, 1).
"""

from __future__ import annotations

import functools
import itertools
import math

import numba as nb
import numpy as np
import torch
from numpy.typing import NDArray

from models.clothoid import hermite_or_inf
from models.clothoid_kernel import (
    CURVATURE,
    HEADING,
    LENGTH,
    MAX_STRETCH,
    NODES,
    RATE,
    WEIGHTS,
    X,
    Y,
    guess_bow,
    hermite_one,
)
from models.program import InputError
from models.road.prior import CoursePrior, course_moments

Floats = NDArray[np.float64]
ORDER = 3  # of the quadrature of the moments: exact to the fifth power of C
NEAR_GUESS = 0.65  # [rad] about the guess of the Hermite fit, which is within 0.6 of the bow it finds
SHORTEST = 1.0  # [m]: a shorter course is none


@functools.lru_cache
def number_moments(prior: CoursePrior) -> tuple[Floats, Floats]:
    """Mean (6,) of theta and the lower Cholesky factor (6, 6) of its covariance, where C follows its prior.

    Raises InputError for a prior whose roads turn back."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(ORDER)
    unit = np.array(list(itertools.product(nodes, repeat=6)))
    weight = np.prod(list(itertools.product(weights / weights.sum(), repeat=6)), -1)
    mean, tril = course_moments(prior)
    start, end = torch.from_numpy(mean + unit @ tril.T).split(3, -1)
    found = hermite_or_inf(start, end)
    if torch.isinf(found.length).any():
        raise InputError(
            f"the prior of the course has roads that turn back, which no clothoid of start and end tells: {prior}; "
            "lower its length, curvature_std or rate_std"
        )
    theta = torch.stack(tuple(found), -1).numpy()
    centre = weight @ theta
    return centre, np.linalg.cholesky(((theta - centre) * weight[:, None]).T @ (theta - centre))


@functools.lru_cache
def prior_root(prior: CoursePrior) -> tuple[Floats, Floats]:
    """Mean (6,) of C and the inverse (6, 6) of the Cholesky factor of its covariance: what `course_density` reads."""
    mean, tril = course_moments(prior)
    return mean, np.asarray(np.linalg.inv(tril))


def to_numbers(course: Floats, prior: CoursePrior) -> Floats:
    """Whitened numbers (6,) of a course C (6,). Raises InputError where no sane clothoid joins its ends."""
    theta, (mean, tril) = np.empty(6), number_moments(prior)
    hermite_one(*np.asarray(course, dtype=np.float64).reshape(6), theta)  # type: ignore[call-arg]
    if theta[LENGTH] == np.inf:
        raise InputError(f"no clothoid joins the ends of the course {course}; give start and end of a drivable road")
    return np.asarray(np.linalg.solve(tril, theta - mean))


def to_courses(x: Floats, prior: CoursePrior) -> Floats:
    """Courses C (*B, 6) of whitened numbers (*B, 6)."""
    out = np.empty((x.size // 6, 6))
    courses_of(np.ascontiguousarray(x, dtype=np.float64).reshape(-1, 6), *number_moments(prior), out)  # type: ignore[call-arg]
    return out.reshape(x.shape)


def log_volumes(x: Floats, prior: CoursePrior) -> Floats:
    """log |dC / dx|, (*B), at whitened numbers (*B, 6)."""
    out = np.empty(x.size // 6)
    volumes_of(np.ascontiguousarray(x, dtype=np.float64).reshape(-1, 6), *number_moments(prior), out)  # type: ignore[call-arg]
    return out.reshape(x.shape[:-1])


@nb.njit(error_model="numpy")
def affine(x, mean, tril, theta):  # type: ignore[no-untyped-def]
    """theta (6,) = mean + tril x, of the first six numbers of x."""
    for i in range(6):
        theta[i] = mean[i]
        for j in range(i + 1):
            theta[i] += tril[i, j] * x[j]


@nb.njit(error_model="numpy")
def moments_of(theta, out):  # type: ignore[no-untyped-def]
    """M_k of k = 0, .., out (num, 2), from the start to the end of a clothoid; returns how far it turns [rad]."""
    curvature, rate, length = theta[CURVATURE], theta[RATE], theta[LENGTH]
    out[:] = 0.0
    for i in range(len(NODES)):
        s = length * NODES[i]
        angle, power = s * (curvature + 0.5 * rate * s), length * WEIGHTS[i]
        cos, sin = math.cos(angle), math.sin(angle)
        for k in range(len(out)):
            out[k, 0] += power * cos
            out[k, 1] += power * sin
            power *= s
    return length * (curvature + 0.5 * rate * length)


@nb.njit(error_model="numpy")
def end_of(theta, moment, turn, course):  # type: ignore[no-untyped-def]
    """C (6,) of a clothoid and its `moments_of`."""
    c, s = math.cos(theta[HEADING]), math.sin(theta[HEADING])
    course[0], course[1], course[2] = theta[X], theta[Y], theta[HEADING]
    course[3] = theta[X] + c * moment[0, 0] - s * moment[0, 1]
    course[4] = theta[Y] + s * moment[0, 0] + c * moment[0, 1]
    course[5] = theta[HEADING] + turn


@nb.njit(error_model="numpy")
def is_shortest(theta, moment, turn):  # type: ignore[no-untyped-def]
    """Whether theta is the clothoid that the Hermite fit gives to its ends, and not one that winds about instead."""
    chord, along = math.hypot(moment[0, 0], moment[0, 1]), math.atan2(moment[0, 1], moment[0, 0])
    p, q, bow = -along, turn - along, 0.5 * theta[RATE] * theta[LENGTH] ** 2
    if not theta[LENGTH] <= MAX_STRETCH * chord or abs(p) > math.pi or abs(q) > math.pi:
        return False
    return abs(bow - guess_bow(p, q)) < NEAR_GUESS


@nb.njit(error_model="numpy")
def cross(a, b, out):  # type: ignore[no-untyped-def]
    """a x b into out (3,)."""
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@nb.njit(error_model="numpy")
def end_columns(theta, moment, turn, columns):  # type: ignore[no-untyped-def]
    """d(x, y, heading) of the end / d(curvature, rate, length), each a row of (3, 3); returns its determinant."""
    length, last = theta[LENGTH], theta[CURVATURE] + theta[RATE] * theta[LENGTH]
    columns[0, 0], columns[0, 1], columns[0, 2] = -moment[1, 1], moment[1, 0], length
    columns[1, 0], columns[1, 1], columns[1, 2] = -0.5 * moment[2, 1], 0.5 * moment[2, 0], 0.5 * length**2
    columns[2, 0], columns[2, 1], columns[2, 2] = math.cos(turn), math.sin(turn), last
    normal = np.empty(3)
    cross(columns[1], columns[2], normal)
    return normal[0] * columns[0, 0] + normal[1] * columns[0, 1] + normal[2] * columns[0, 2]


@nb.njit(error_model="numpy")
def volume_slopes(theta, moment, turn, columns, det, slopes):  # type: ignore[no-untyped-def]
    """d log det / d(curvature, rate, length), slopes (3,)."""
    length = theta[LENGTH]
    cos, sin = columns[2, 0], columns[2, 1]
    bent, normal = np.empty((3, 3)), np.empty(3)
    slopes[:] = 0.0
    for number in range(3):
        for c in range(2):  # of the columns
            if number < 2:
                part, k = -(0.5 ** (number + c)), 2 + number + c  # the rate bends by s^2 / 2, the curvature by s
                bent[c, 0], bent[c, 1], bent[c, 2] = part * moment[k, 0], part * moment[k, 1], 0.0
            else:
                part = 0.5**c * length ** (c + 1)
                bent[c, 0], bent[c, 1], bent[c, 2] = -part * sin, part * cos, length**c
        swing = columns[2, 2] if number == 2 else 0.5**number * length ** (number + 1)
        spin = theta[RATE] if number == 2 else length**number
        bent[2, 0], bent[2, 1], bent[2, 2] = -sin * swing, cos * swing, spin
        for c in range(3):
            cross(columns[(c + 1) % 3], columns[(c + 2) % 3], normal)
            slopes[number] += bent[c, 0] * normal[0] + bent[c, 1] * normal[1] + bent[c, 2] * normal[2]
        slopes[number] /= det


@nb.njit(error_model="numpy")
def course_density(theta, mean, root, gradient, hessian):  # type: ignore[no-untyped-def]
    """log N(C(theta); mean, (root^T root)^-1) + log |dC / dtheta|, -inf where there is no course.

    gradient  (6,) in theta, unless empty
    hessian   (6, 6) of Gauss and Newton, minus the second derivatives, unless empty"""
    if not theta[LENGTH] > SHORTEST:
        return -np.inf
    moment, columns, course, white = np.empty((5, 2)), np.empty((3, 3)), np.empty(6), np.empty(6)
    turn = moments_of(theta, moment)
    det = end_columns(theta, moment, turn, columns)
    if not det > 0.0 or not is_shortest(theta, moment, turn):
        return -np.inf
    end_of(theta, moment, turn, course)
    height = math.log(det) - 3.0 * math.log(2.0 * math.pi)
    for i in range(6):
        white[i] = 0.0
        for j in range(i + 1):
            white[i] += root[i, j] * (course[j] - mean[j])
        height += math.log(root[i, i]) - 0.5 * white[i] ** 2
    if len(gradient) == 0:
        return height
    c, s = math.cos(theta[HEADING]), math.sin(theta[HEADING])
    slopes = np.zeros((6, 6))  # dC / dtheta
    slopes[0, 0] = slopes[1, 1] = slopes[2, 2] = slopes[3, 0] = slopes[4, 1] = slopes[5, 2] = 1.0
    slopes[3, 2], slopes[4, 2] = course[1] - course[4], course[3] - course[0]
    for n in range(3):
        slopes[3, 3 + n] = c * columns[n, 0] - s * columns[n, 1]
        slopes[4, 3 + n] = s * columns[n, 0] + c * columns[n, 1]
        slopes[5, 3 + n] = columns[n, 2]
    whitened = np.zeros((6, 6))
    for i in range(6):
        for k in range(i + 1):
            for j in range(6):
                whitened[i, j] += root[i, k] * slopes[k, j]
    volume_slopes(theta, moment, turn, columns, det, gradient[3:])
    gradient[:3] = 0.0
    for j in range(6):
        for i in range(6):
            gradient[j] -= whitened[i, j] * white[i]
    if len(hessian) > 0:
        for j in range(6):
            for k in range(6):
                hessian[j, k] = 0.0
                for i in range(6):
                    hessian[j, k] += whitened[i, j] * whitened[i, k]
    return height


@nb.njit(cache=True, error_model="numpy")
def courses_of(x, mean, tril, out):  # type: ignore[no-untyped-def]
    """C, out (S, 6), of whitened numbers x (S, 6)."""
    theta, moment = np.empty(6), np.empty((1, 2))
    for i in range(len(x)):
        affine(x[i], mean, tril, theta)
        end_of(theta, moment, moments_of(theta, moment), out[i])


@nb.njit(cache=True, error_model="numpy")
def volumes_of(x, mean, tril, out):  # type: ignore[no-untyped-def]
    """log |dC / dx|, out (S,), at whitened numbers x (S, 6)."""
    theta, moment, columns = np.empty(6), np.empty((3, 2)), np.empty((3, 3))
    for i in range(len(x)):
        affine(x[i], mean, tril, theta)
        out[i] = math.log(end_columns(theta, moment, moments_of(theta, moment), columns))
        for j in range(6):
            out[i] += math.log(tril[j, j])
