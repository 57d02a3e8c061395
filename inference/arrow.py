"""Linear algebra of a Hessian that is a sum of small blocks, by Schur's complement.

    H = I + S (sum of blocks) S = [A  C^T]    S = diag(scale)
                                  [C  B  ]

A holds the latents that are local to one block, B those that blocks share. The Cholesky factor, local latents first,
keeps that shape, an arrow (Nocedal & Wright 2006, section 9.2):

    A = L L^T,   X = L^-1 C^T,   B - X^T X = R^T R,   F = [L    0  ]    F F^T = H
                                                          [X^T  R^T]

L falls into small triangles, one for each block, so time grows with the number of blocks, where that of a dense factor
grows with its cube. A dense Hessian is one block whose latents are all treated as shared.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs, dtrtrs

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class Arrow(NamedTuple):
    """Where the latents are.

    order   (L, P) the numbers of each block, local ones first, then shared ones, then none
    slots   (L, P) the latents that these are
    counts  (L, 2) of local ones, and of both
    shared  (G,) latents; rank (D,) of a shared latent among these
    """

    order: Ints
    slots: Ints
    counts: Ints
    shared: Ints
    rank: Ints


class Factor(NamedTuple):
    """F of a Hessian, damped or not.

    block     (L, P, P) of every block: L in its first rows and columns, X in the rows to the right of it
    corner    (G, G) R, upper triangular
    diagonal  (D,) of H itself, without damping
    """

    arrow: Arrow
    block: Array
    corner: Array
    diagonal: Array


def arrow(blocks: Ints | None, size: int) -> Arrow:
    """The shape of a Hessian of `size` latents. blocks (L, P) as in models.capability.Squares, None for a dense one."""
    if blocks is None:
        every = np.arange(size)
        return Arrow(every[None], every[None], np.array([[0, size]]), every, every)
    local = np.bincount(blocks[blocks >= 0], minlength=size) == 1
    kind = np.where(blocks < 0, 2, np.where(local[blocks], 0, 1))
    order = np.argsort(kind, axis=1, kind="stable")
    counts = np.stack([(kind == 0).sum(1), (kind < 2).sum(1)], 1)
    rank = np.where(local, -1, np.cumsum(~local) - 1)
    return Arrow(order, np.take_along_axis(blocks, order, 1), counts, np.flatnonzero(~local), rank)


@nb.njit(cache=True, error_model="numpy")
def eliminate(arrow, hessian, scale, damping, blocks, corner, diagonal):  # type: ignore[no-untyped-def]
    """Fill blocks and diagonal of a `Factor`, and the lower triangle of B - X^T X; False where A is not positive."""
    orders, slots, counts, _, rank = arrow
    positive = True
    corner[:], diagonal[:] = 0.0, 1.0
    for b in range(len(slots)):
        order, index, f = orders[b], slots[b], blocks[b]
        own, num = counts[b]
        for p in range(num):
            for q in range(p + 1):
                h = hessian[b, max(order[p], order[q]), min(order[p], order[q])]
                f[p, q] = f[q, p] = scale[index[p]] * scale[index[q]] * h
        for p in range(own):
            diagonal[index[p]] += f[p, p]
            f[p, p] += 1.0 + damping * diagonal[index[p]]
        for p in range(own):
            positive = positive and f[p, p] > 0.0
            root = 1.0 / np.sqrt(f[p, p])
            for q in range(p, num):
                f[p, q] *= root
            for k in range(p + 1, num):
                left = f[p, k]
                for q in range(k, num) if k < own else range(own, k + 1):
                    f[k, q] -= left * f[p, q]
        for p in range(own, num):
            i = rank[index[p]]
            for q in range(own, p + 1):
                k = rank[index[q]]
                twice = 2.0 if i == k and p != q else 1.0  # a latent that a block has twice meets itself
                corner[max(i, k), min(i, k)] += twice * f[p, q]
                if i == k:
                    h = hessian[b, max(order[p], order[q]), min(order[p], order[q])]
                    diagonal[index[p]] += twice * scale[index[p]] ** 2 * h
    for i in range(len(rank)):
        if rank[i] >= 0:
            corner[rank[i], rank[i]] += 1.0 + damping * diagonal[i]
    return positive


@nb.njit(cache=True, error_model="numpy")
def forward(arrow, blocks, values):  # type: ignore[no-untyped-def]
    """In values (D,): local ones become L^-1 b, and shared ones lose X^T of these."""
    for b in range(len(arrow[1])):
        index, f, (own, num) = arrow[1][b], blocks[b], arrow[2][b]
        for p in range(own):
            values[index[p]] /= f[p, p]
            for q in range(p + 1, num):
                values[index[q]] -= f[p, q] * values[index[p]]


@nb.njit(cache=True, error_model="numpy")
def backward(arrow, blocks, values):  # type: ignore[no-untyped-def]
    """In values (N, D): local ones become L^-T (b - X x), x the shared ones."""
    for row in values:
        for b in range(len(arrow[1])):
            index, f, (own, num) = arrow[1][b], blocks[b], arrow[2][b]
            for p in range(own - 1, -1, -1):
                total = row[index[p]]
                for q in range(p + 1, num):
                    total -= f[p, q] * row[index[q]]
                row[index[p]] = total / f[p, p]


@nb.njit(cache=True, error_model="numpy")
def local_variances(arrow, blocks, inverse, out):  # type: ignore[no-untyped-def]
    """Fill out (D,) for local latents i: |w|^2 + (X^T w)^T inverse (X^T w), w = L^-1 e_i; inverse (G, G) symmetric."""
    w = np.empty(arrow[1].shape[1])
    for b in range(len(arrow[1])):
        index, f, (own, num) = arrow[1][b], blocks[b], arrow[2][b]
        for i in range(own):
            w[:num], total = 0.0, 0.0
            w[i] = 1.0
            for p in range(i, own):
                w[p] /= f[p, p]
                total += w[p] ** 2
                for q in range(p + 1, num):
                    w[q] -= f[p, q] * w[p]
            for p in range(own, num):
                row = inverse[arrow[4][index[p]]]
                for q in range(own, num):
                    total += w[p] * row[arrow[4][index[q]]] * w[q]
            out[index[i]] = total


def factorise(arrow: Arrow, hessian: Array, scale: Array, damping: float = 0.0) -> Factor:
    """Factor of H + damping diag H.

    hessian  (L, P, P) of the observations in natural units, lower triangles; scale (D,)

    Raises FloatingPointError where H is not positive definite, which only numbers that are not finite can do."""
    shared = len(arrow.shared)
    blocks, corner, diagonal = np.empty(hessian.shape), np.empty((shared, shared)), np.empty(len(scale))
    failed = not eliminate(arrow, hessian, scale, damping, blocks, corner, diagonal)  # type: ignore[call-arg]
    if shared:
        root, info = dpotrf(corner.T, lower=0, overwrite_a=1)
        corner, failed = root, failed or info != 0 or not np.isfinite(root[-1, -1])  # some LAPACKs pass on nan
    if failed:
        raise FloatingPointError("the Hessian has no Cholesky factor: it is not finite")
    return Factor(arrow, blocks, corner, diagonal)


def solve(factor: Factor, b: Array) -> Array:
    """H^-1 b, (D,)."""
    values, shared = b.copy(), factor.arrow.shared
    forward(factor.arrow, factor.block, values)  # type: ignore[call-arg]
    if len(shared):
        values[shared] = dpotrs(factor.corner, values[shared], lower=0)[0]
    backward(factor.arrow, factor.block, values[None])  # type: ignore[call-arg]
    return values


def squared_norm(factor: Factor, b: Array) -> float:
    """b^T H^-1 b."""
    values, shared = b.copy(), factor.arrow.shared
    forward(factor.arrow, factor.block, values)  # type: ignore[call-arg]
    if len(shared):
        values[shared] = dtrtrs(factor.corner, values[shared], lower=0, trans=1)[0]
    return float(values @ values)


def colour(factor: Factor, noise: Array) -> Array:
    """F^-T of every row of noise (N, D): draws of covariance H^-1 from those of covariance I."""
    values, shared = noise.copy(), factor.arrow.shared
    if len(shared):
        values[:, shared] = dtrtrs(factor.corner, values[:, shared].T, lower=0)[0].T
    backward(factor.arrow, factor.block, values)  # type: ignore[call-arg]
    return values


def variances(factor: Factor) -> Array:
    """Diagonal of H^-1, (D,)."""
    shared, out = factor.arrow.shared, np.empty(len(factor.diagonal))
    inverse = np.empty((0, 0))
    if len(shared):
        inverse = np.triu(dpotri(factor.corner, lower=0)[0])
        inverse += np.triu(inverse, 1).T
    out[shared] = inverse.diagonal()
    local_variances(factor.arrow, factor.block, inverse, out)  # type: ignore[call-arg]
    return out


def half_log_determinant(factor: Factor) -> float:
    """log|H| / 2."""
    every = np.concatenate([f.diagonal()[:own] for f, (own, _) in zip(factor.block, factor.arrow.counts, strict=True)])
    return float(np.log(every).sum() + np.log(factor.corner.diagonal()).sum())
