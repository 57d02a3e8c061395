"""Lane courses as a sum of squares in machine code: every point against the nearest node of its lane.

    lateral residual  (n . (p - x) - curvature along^2 / 2 + curvature position^2 / 2) / position
    heading residual  wrap(phi - heading - curvature along) / sqrt(heading^2 + curvature^2 position^2)

x is the nearest node, along the distance from it along the lane. The last term of the lateral residual is the bias
of white noise in the plane: on the outside of a bend there is more room. Where along its lane a vehicle was says
nothing. Points are summed node by node, so that the normal equations cost nodes, not points.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.intersection.course_nodes import course_nodes
from models.intersection.wrap import wrap
from models.normal_equations import add_columns

STRIDE = 4  # nodes between those that a track's first point is compared with
LOST = 5.0  # [m] from the node that a point was followed to: it is sought anew, for distances rise before a sharp bend


@nb.njit(error_model="numpy")
def nearest_node(nodes, num, x, y, j):  # type: ignore[no-untyped-def]
    """The node where the distance to (x, y) stops falling, from node j on."""
    least = (nodes[j, 0] - x) ** 2 + (nodes[j, 1] - y) ** 2
    for step in (1, -1):
        while 0 <= j + step < num:
            other = (nodes[j + step, 0] - x) ** 2 + (nodes[j + step, 1] - y) ** 2
            if other >= least:
                break
            j, least = j + step, other
    return j


@nb.njit(error_model="numpy")
def rough_node(nodes, num, x, y):  # type: ignore[no-untyped-def]
    """The nearest one of every STRIDE-th node."""
    j, least = 0, np.inf
    for k in range(0, num, STRIDE):
        far = (nodes[k, 0] - x) ** 2 + (nodes[k, 1] - y) ** 2
        if far < least:
            j, least = k, far
    return j


@nb.njit(error_model="numpy")
def sum_points(points, first, last, nodes, num, noise, sums):  # type: ignore[no-untyped-def]
    """Add the residuals of one track to the sums of its lane's nodes; returns its cost.

    noise (position, heading), heading inf where none is measured; sums (3, N): points, lateral, heading residuals"""
    j = rough_node(nodes, num, points[0, first], points[1, first])
    variance, cost = noise[0] ** 2, 0.0
    for i in range(first, last):
        j = nearest_node(nodes, num, points[0, i], points[1, i], j)
        if (nodes[j, 0] - points[0, i]) ** 2 + (nodes[j, 1] - points[1, i]) ** 2 > LOST**2:
            j = rough_node(nodes, num, points[0, i], points[1, i])
            j = nearest_node(nodes, num, points[0, i], points[1, i], j)
        ux, uy, curvature = nodes[j, 2], nodes[j, 3], nodes[j, 4]
        dx, dy = points[0, i] - nodes[j, 0], points[1, i] - nodes[j, 1]
        along = ux * dx + uy * dy
        lateral = -uy * dx + ux * dy - 0.5 * curvature * along**2 + 0.5 * curvature * variance
        sums[0, j] += 1.0
        sums[1, j] += lateral
        cost += 0.5 * lateral**2 / variance
        if noise[1] < np.inf:
            spread = noise[1] ** 2 + curvature**2 * variance
            turn = wrap(points[2, i] - math.atan2(uy, ux) - curvature * along)
            sums[2, j] += turn
            cost += 0.5 * turn**2 / spread + 0.5 * math.log(spread / noise[1] ** 2)
    return cost


@nb.njit(error_model="numpy")
def residual_columns(nodes, begin, end, inner, noise, sums, latent, columns):  # type: ignore[no-untyped-def]
    """The mean residuals of nodes [begin, end), times the root of their weights, as columns (P + 1, .); their number.

    latent  (P,) which of the lane's numbers the slopes are of
    inner   [first, last) of the nodes whose headings belong to these: their slopes lie between the nodes beside them"""
    n, size = 0, len(latent)
    for j in range(begin, end):
        if sums[0, j] > 0.0:
            root = math.sqrt(sums[0, j]) / noise[0]
            for p in range(size):
                columns[p, n] = -root * nodes[j, 5 + latent[p]]
            columns[size, n] = root * sums[1, j] / sums[0, j]
            n += 1
    if noise[1] == np.inf:
        return n
    for j in range(inner[0], inner[1]):
        if sums[0, j] > 0.0:
            root = math.sqrt(sums[0, j] / (noise[1] ** 2 + (nodes[j, 4] * noise[0]) ** 2))
            apart = math.hypot(nodes[j + 1, 0] - nodes[j - 1, 0], nodes[j + 1, 1] - nodes[j - 1, 1])
            for p in range(size):
                columns[p, n] = -root * (nodes[j + 1, 5 + latent[p]] - nodes[j - 1, 5 + latent[p]]) / apart
            columns[size, n] = root * sums[2, j] / sums[0, j]
            n += 1
    return n


@nb.njit(error_model="numpy")
def square_lane(nodes, counts, noise, sums, latent, columns, block):  # type: ignore[no-untyped-def]
    """Hessian and, in the row below, gradient of a lane in its latent numbers: block (P + 1, P), lower triangle.

    Arm by arm and the interior: a number of one arm moves no node of the other."""
    block[:] = 0.0
    first, last = counts[0], counts[0] + counts[1] + 1  # of the interior
    total = last + counts[2]
    parts = ((0, first, 1, first - 1), (first, last, first - 1, last + 1), (last, total, last + 1, total - 1))
    for begin, end, left, right in parts:
        add_columns(columns, residual_columns(nodes, begin, end, (left, right), noise, sums, latent, columns), block)


@nb.njit(cache=True, error_model="numpy")
def normal_equations(  # type: ignore[no-untyped-def]
    z, where, latent, slots, lanes, reach, counts, tracks, starts, offsets, points, noise, hessian, gradient
):
    """Cost of all points, its gradient (D,) in the latent ones of the numbers z and their Gauss-Newton Hessian, lane by
    lane, (L, P, P), lower triangles.

    where   (L, D') which of z each lane depends on; latent (P,) the columns of it that are latent, and slots (L, P)
            their places among all latents
    lanes, reach, counts as in `course_nodes`, for every lane
    tracks  of lane l: tracks[starts[l]:starts[l + 1]]; track t holds points (3, N) offsets[t]:offsets[t + 1]"""
    most = 0
    for lane in range(len(where)):
        most = max(most, counts[lane, 0] + counts[lane, 1] + 1 + counts[lane, 2])
    width, size, cost = where.shape[1], len(latent), 0.0
    nodes, sums, columns = np.empty((most, 5 + width)), np.empty((3, most)), np.empty((size + 1, 2 * most))
    near = np.empty((most, 5))  # the nodes without their derivatives, close together in memory for the points
    block, v = np.empty((size + 1, size)), np.empty(width)
    gradient[:] = 0.0
    for lane in range(len(where)):
        for p in range(width):
            v[p] = z[where[lane, p]]
        num = course_nodes(v, lanes[lane], reach[lane], counts[lane], nodes)
        for j in range(num):
            for p in range(5):
                near[j, p] = nodes[j, p]
        sums[:] = 0.0
        for k in range(starts[lane], starts[lane + 1]):
            t = tracks[k]
            cost += sum_points(points, offsets[t], offsets[t + 1], near, num, noise, sums)
        square_lane(nodes, counts[lane], noise, sums, latent, columns, block)
        for p in range(size):
            gradient[slots[lane, p]] += block[size, p]
            for q in range(p + 1):  # an assignment of slices takes seconds to compile
                hessian[lane, p, q] = block[p, q]
    return cost


@nb.njit(cache=True, error_model="numpy")
def centre_line(v, lanes, reach, counts, nodes):  # type: ignore[no-untyped-def]
    """`course_nodes` for callers in Python."""
    return course_nodes(v, lanes, reach, counts, nodes)
