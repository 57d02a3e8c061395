"""Courses of lanes beside reference curves as a sum of squares in machine code.

Node j of a lane lies f_j to the left of node j of its reference curve, along the normal n_j there,

    x_j = r_j + f_j n_j,    f = A v

and f is linear in the lane's numbers v. Directions and curvatures are those of the polyline x. Points meet these nodes
as in models.intersection.course_kernel, whose sums and residuals these are.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.intersection.course_kernel import residual_columns, sum_points
from models.normal_equations import square_columns


@nb.njit(error_model="numpy")
def displace(v, reference, design, nodes):  # type: ignore[no-untyped-def]
    """Fill the nodes (n, 5 + D) of one lane: x, y, unit tangent, curvature, displacement along their own normals by
    each of its numbers v (D,).

    reference (n, 4) x, y, unit tangent; design A (n, D)"""
    num, size = design.shape
    for j in range(num):
        f = 0.0
        for p in range(size):
            f += design[j, p] * v[p]
        nodes[j, 0] = reference[j, 0] - f * reference[j, 3]
        nodes[j, 1] = reference[j, 1] + f * reference[j, 2]
    for j in range(num):
        a, b = max(j - 1, 0), min(j + 1, num - 1)
        dx, dy = nodes[b, 0] - nodes[a, 0], nodes[b, 1] - nodes[a, 1]
        length = math.hypot(dx, dy)
        ux, uy = dx / length, dy / length
        nodes[j, 2], nodes[j, 3] = ux, uy
        aligned = ux * reference[j, 2] + uy * reference[j, 3]  # of the two normals
        for p in range(size):
            nodes[j, 5 + p] = aligned * design[j, p]
    for j in range(1, num - 1):
        ax, ay = nodes[j, 0] - nodes[j - 1, 0], nodes[j, 1] - nodes[j - 1, 1]
        bx, by = nodes[j + 1, 0] - nodes[j, 0], nodes[j + 1, 1] - nodes[j, 1]
        turn = math.atan2(ax * by - ay * bx, ax * bx + ay * by)
        nodes[j, 4] = 2.0 * turn / (math.hypot(ax, ay) + math.hypot(bx, by))
    nodes[0, 4], nodes[num - 1, 4] = nodes[1, 4], nodes[num - 2, 4]


@nb.njit(cache=True, error_model="numpy")
def free_nodes(v, reference, design, nodes):  # type: ignore[no-untyped-def]
    """`displace` for callers in Python."""
    displace(v, reference, design, nodes)


@nb.njit(cache=True, error_model="numpy")
def free_equations(z, curves, data, hessian, gradient):  # type: ignore[no-untyped-def]
    """Cost of all points, its gradient (D,) and Gauss-Newton Hessian (D, D) in the numbers z; the cost alone where the
    gradient is empty.

    curves  (where, design, sizes, reference, counts): which of z the lanes depend on, lane by lane, and their A, row by
            row, for `sizes` (L,) numbers and `counts` (L,) nodes; the nodes' reference (., 4)
    data    (tracks, starts, offsets, points, noise) as in course_kernel.normal_equations"""
    where, design, sizes, reference, counts = curves
    tracks, starts, offsets, points, noise = data
    most, widest = counts.max(), sizes.max()
    sums, columns = np.empty((3, most)), np.empty((widest + 1, 2 * most))
    block, v = np.empty((widest + 1, widest)), np.empty(widest)
    cost, node, number, entry = 0.0, 0, 0, 0
    hessian[:] = 0.0
    gradient[:] = 0.0
    for lane in range(len(counts)):
        num, size = counts[lane], sizes[lane]
        index = where[number : number + size]
        own = design[entry : entry + num * size].reshape(num, size)
        for p in range(size):
            v[p] = z[index[p]]
        nodes = np.empty((num, 5 + size))
        displace(v[:size], reference[node : node + num], own, nodes)
        sums[:] = 0.0
        for k in range(starts[lane], starts[lane + 1]):
            t = tracks[k]
            cost += sum_points(points, offsets[t], offsets[t + 1], nodes, num, noise, sums)
        node, number, entry = node + num, number + size, entry + num * size
        if len(gradient) == 0:
            continue
        own_columns, own_block = columns[: size + 1], block[: size + 1, :size]
        filled = residual_columns(nodes, 0, num, (1, num - 1), noise, sums, np.arange(size), own_columns)
        square_columns(own_columns, filled, own_block)
        for p in range(size):
            gradient[index[p]] += own_block[size, p]
            for q in range(p + 1):
                i, k = max(index[p], index[q]), min(index[p], index[q])
                hessian[i, k] += own_block[p, q]
    for i in range(len(gradient)):
        for k in range(i):
            hessian[k, i] = hessian[i, k]
    return cost
