"""The centre line of a lane across a junction as nodes with their derivatives, in machine code.

A lane runs along its entry arm, through the interior, and along its exit arm. On arm e, at distance t from the
centre along direction d with normal n to its left, its points are those of `Junction`,

    P_e(t) = c + t d + (shift + offset + side (gap / 2 + (lane + 1/2) width) + bend t (t - CHORD) / 2) n

with side +1 on the entry arm and -1 on the exit arm. Inside it is the cubic Bezier curve between P_0(r_0) and
P_1(r_1), r_e = onset of the arm + advance of the lane. Its handles lie along the arms and are those of a circular
arc, stretched:

    h_e = handle_e |P_1 - P_0| / (3 cos^2(theta / 4)),   theta the change of heading

which is (2/3) tan(theta/4) / sin(theta/2) written without its removable pole.

Real lanes are no such curves. Waves, cubic B-splines across them, make up for it where they are latent: one of each
arm and one of each lane of an arm, in t, and one of each interior, in the parameter of its Bezier curve, which
vanishes with two derivatives where the interior ends.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.intersection.moments import CHORD
from models.intersection.wrap import wrap
from models.spline import ORDER, spline_bows, spline_weights

# what one end of a lane depends on
ANGLE, GAP, WIDTH, BEND, SHIFT, ONSET, OFFSET, ADVANCE, HANDLE = range(9)
END = 9
HEAD = 3  # centre x, y and the lane width that arms have in common; then the entry end and the exit end
LOCAL = HEAD + 2 * END
LEAST_ONSET = 2.0  # [m]
LEAST_HANDLE, LARGEST_HANDLE = 0.2, 2.0
SHARPEST = 2.9  # [rad] of turn: sharper ones keep these handles

WAVE_BEGIN, WAVE_PIECE, WAVE_PIECES = 8.0, 8.0, 7  # [m] from the centre; constant before and beyond
ARM_WAVE = WAVE_PIECES + 3  # controls
INNER_WAVE = 6  # controls, those of INNER_WAVE + 3 pieces that vanish at both ends
RIPPLED = LOCAL + INNER_WAVE  # numbers of a lane with a wave of its interior ...
WAVY = RIPPLED + 4 * ARM_WAVE  # ... and with those of the entry arm, its lane, the exit arm and its lane, too


@nb.njit(error_model="numpy")
def arm_point(v, end, lane, t, dx, dy, point, tangent, slopes):  # type: ignore[no-untyped-def]
    """Point at distance t out on an arm of direction d and its outward tangent d + bend (t - CHORD / 2) n, with their
    derivatives; returns the bend there.

    v       (LOCAL,) numbers of the lane; (RIPPLED,) or (WAVY,) with waves
    slopes  (len(v) + 1, 4) of (point, tangent), zeros at first; the last row is the derivative in t"""
    o, side, nx, ny = HEAD + END * end, 1.0 - 2.0 * end, -dy, dx
    arch, lean = 0.5 * t * (t - CHORD), t - 0.5 * CHORD
    rank = side * (lane + 0.5)
    across = v[o + SHIFT] + v[o + OFFSET] + 0.5 * side * v[o + GAP] + rank * (v[2] + v[o + WIDTH]) + v[o + BEND] * arch
    slope, curve = v[o + BEND] * lean, v[o + BEND]
    if len(v) > RIPPLED:
        first = RIPPLED + 2 * ARM_WAVE * end
        slopes[first : first + 2 * ARM_WAVE] = 0.0
        across, slope, curve = add_waves(v, first, t, nx, ny, slopes, across, slope, curve)
    point[0], point[1] = v[0] + t * dx + across * nx, v[1] + t * dy + across * ny
    tangent[0], tangent[1] = dx + slope * nx, dy + slope * ny
    slopes[0, 0] = slopes[1, 1] = 1.0
    slopes[2, 0], slopes[2, 1] = rank * nx, rank * ny
    slopes[o + ANGLE, 0], slopes[o + ANGLE, 1] = t * nx - across * dx, t * ny - across * dy
    slopes[o + ANGLE, 2], slopes[o + ANGLE, 3] = nx - slope * dx, ny - slope * dy
    for field, push in ((GAP, 0.5 * side), (WIDTH, rank), (SHIFT, 1.0), (OFFSET, 1.0), (BEND, arch)):
        slopes[o + field, 0], slopes[o + field, 1] = push * nx, push * ny
    slopes[o + BEND, 2], slopes[o + BEND, 3] = lean * nx, lean * ny
    slopes[len(v), 0], slopes[len(v), 1] = tangent[0], tangent[1]
    slopes[len(v), 2], slopes[len(v), 3] = curve * nx, curve * ny
    return curve


@nb.njit(error_model="numpy")
def add_waves(v, first, t, nx, ny, slopes, across, slope, curve):  # type: ignore[no-untyped-def]
    """Add the waves of an arm and of its lane, controls from `first` on, to the offset and its two derivatives in t."""
    weights, last = np.empty((3, ORDER)), WAVE_BEGIN + WAVE_PIECE * WAVE_PIECES
    place, inside = min(max(t, WAVE_BEGIN), last), 1.0 if WAVE_BEGIN < t < last else 0.0
    piece = spline_weights(place, WAVE_BEGIN, WAVE_PIECE, ARM_WAVE, weights[0], weights[1])
    spline_bows(place, WAVE_BEGIN, WAVE_PIECE, ARM_WAVE, weights[2])
    for k in range(ORDER):
        value, lean, bow = weights[0, k], inside * weights[1, k], inside * weights[2, k]
        for i in (first + piece + k, first + ARM_WAVE + piece + k):
            across, slope, curve = across + value * v[i], slope + lean * v[i], curve + bow * v[i]
            slopes[i, 0], slopes[i, 1], slopes[i, 2], slopes[i, 3] = value * nx, value * ny, lean * nx, lean * ny
    return across, slope, curve


@nb.njit(error_model="numpy")
def start_of_interior(v, end):  # type: ignore[no-untyped-def]
    """Distance from the centre where the interior begins on an arm, and whether it follows the numbers."""
    r = v[HEAD + END * end + ONSET] + v[HEAD + END * end + ADVANCE]
    return (r, 1.0) if r > LEAST_ONSET else (LEAST_ONSET, 0.0)


@nb.njit(error_model="numpy")
def stretch(v, end):  # type: ignore[no-untyped-def]
    """Relative length of a handle, and whether it follows the number."""
    value = v[HEAD + END * end + HANDLE]
    inside = LEAST_HANDLE < value < LARGEST_HANDLE
    return min(max(value, LEAST_HANDLE), LARGEST_HANDLE), 1.0 if inside else 0.0


@nb.njit(error_model="numpy")
def interior_end(v, end, lane, point, tangent, slopes):  # type: ignore[no-untyped-def]
    """`arm_point` where the interior begins, onset and advance among the derivatives."""
    r, free = start_of_interior(v, end)
    angle = v[HEAD + END * end + ANGLE]
    slopes[:] = 0.0
    arm_point(v, end, lane, r, math.cos(angle), math.sin(angle), point, tangent, slopes)
    for field in (ONSET, ADVANCE):
        for j in range(4):
            slopes[HEAD + END * end + field, j] = free * slopes[len(v), j]


@nb.njit(error_model="numpy")
def arm_nodes(v, end, lane, reach, num, nodes, first):  # type: ignore[no-untyped-def]
    """`num` nodes from `reach` down to the interior of the entry arm, or outwards on the exit arm, from row `first`."""
    r, _ = start_of_interior(v, end)
    own, waves = HEAD + END * end, RIPPLED + 2 * ARM_WAVE * end
    dx, dy = math.cos(v[own + ANGLE]), math.sin(v[own + ANGLE])
    point, tangent, slopes = np.empty(2), np.empty(2), np.zeros((len(v) + 1, 4))
    forward = 2.0 * end - 1.0  # outward tangents point against the traffic of an entry
    for i in range(num):
        share = (num - i) / num if end == 0 else (i + 1) / num
        bend = arm_point(v, end, lane, r + share * (reach - r), dx, dy, point, tangent, slopes)
        length = math.hypot(tangent[0], tangent[1])
        ux, uy = forward * tangent[0] / length, forward * tangent[1] / length
        node = nodes[first + i]
        node[:] = 0.0
        node[0], node[1], node[2], node[3], node[4] = point[0], point[1], ux, uy, forward * bend / length**3
        for p in range(HEAD):
            node[5 + p] = -uy * slopes[p, 0] + ux * slopes[p, 1]
        for p in range(own, own + END):
            node[5 + p] = -uy * slopes[p, 0] + ux * slopes[p, 1]
        if len(v) > RIPPLED:
            for p in range(waves, waves + 2 * ARM_WAVE):
                node[5 + p] = -uy * slopes[p, 0] + ux * slopes[p, 1]


@nb.njit(error_model="numpy")
def interior_nodes(v, lanes, num, nodes, first):  # type: ignore[no-untyped-def]
    """`num` + 1 nodes of the Bezier curve, its ends included, from row `first`."""
    p0, t0, s0 = np.empty(2), np.empty(2), np.empty((len(v) + 1, 4))
    p3, t3, s3 = np.empty(2), np.empty(2), np.empty((len(v) + 1, 4))
    interior_end(v, 0, lanes[0], p0, t0, s0)
    interior_end(v, 1, lanes[1], p3, t3, s3)
    ex, ey = p3[0] - p0[0], p3[1] - p0[1]
    distance = math.hypot(ex, ey) + 1e-9
    ex, ey = ex / distance, ey / distance
    turn = wrap(math.atan2(t3[1], t3[0]) - math.atan2(-t0[1], -t0[0]))
    bounded = min(max(turn, -SHARPEST), SHARPEST)
    arc = 1.0 / (3.0 * math.cos(0.25 * bounded) ** 2)
    arc_slope = 0.5 * arc * math.tan(0.25 * bounded) if abs(turn) < SHARPEST else 0.0
    (k0, free0), (k3, free3) = stretch(v, 0), stretch(v, 1)
    h0, h3 = k0 * distance * arc, k3 * distance * arc
    q1, q2 = np.empty((len(v), 2)), np.empty((len(v), 2))  # derivatives of the two inner control points
    long0, long3 = t0[0] ** 2 + t0[1] ** 2, t3[0] ** 2 + t3[1] ** 2
    for p in range(len(v)):
        nearer = ex * (s3[p, 0] - s0[p, 0]) + ey * (s3[p, 1] - s0[p, 1])
        bending = (t3[0] * s3[p, 3] - t3[1] * s3[p, 2]) / long3 - (t0[0] * s0[p, 3] - t0[1] * s0[p, 2]) / long0
        longer = nearer * arc + distance * arc_slope * bending
        d0 = k0 * longer + (free0 * distance * arc if p == HEAD + HANDLE else 0.0)
        d3 = k3 * longer + (free3 * distance * arc if p == HEAD + END + HANDLE else 0.0)
        for j in range(2):
            q1[p, j] = s0[p, j] - d0 * t0[j] - h0 * s0[p, 2 + j]
            q2[p, j] = s3[p, j] - d3 * t3[j] - h3 * s3[p, 2 + j]
    for i in range(num + 1):
        u = i / num
        w = 1.0 - u
        b0, b1, b2, b3 = w * w * w, 3.0 * u * w * w, 3.0 * u * u * w, u * u * u
        node = nodes[first + i]
        gx = gy = ax = ay = 0.0
        for j in range(2):
            p1, p2 = p0[j] - h0 * t0[j], p3[j] - h3 * t3[j]
            node[j] = b0 * p0[j] + b1 * p1 + b2 * p2 + b3 * p3[j]
            speed = 3.0 * w * w * (p1 - p0[j]) + 6.0 * u * w * (p2 - p1) + 3.0 * u * u * (p3[j] - p2)
            change = 6.0 * w * (p2 - 2.0 * p1 + p0[j]) + 6.0 * u * (p3[j] - 2.0 * p2 + p1)
            gx, gy = (speed, gy) if j == 0 else (gx, speed)
            ax, ay = (change, ay) if j == 0 else (ax, change)
        length = math.hypot(gx, gy) + 1e-9
        ux, uy = gx / length, gy / length
        node[2], node[3], node[4] = ux, uy, (gx * ay - gy * ax) / length**3
        for p in range(len(v)):
            x = b0 * s0[p, 0] + b1 * q1[p, 0] + b2 * q2[p, 0] + b3 * s3[p, 0]
            y = b0 * s0[p, 1] + b1 * q1[p, 1] + b2 * q2[p, 1] + b3 * s3[p, 1]
            node[5 + p] = -uy * x + ux * y
        if len(v) > LOCAL:
            ripple(v, u, length, node)


@nb.njit(error_model="numpy")
def ripple(v, u, speed, node):  # type: ignore[no-untyped-def]
    """Add the wave of the interior at parameter u, where the Bezier curve has this speed, to its node."""
    first, weights, num = LOCAL, np.empty((3, ORDER)), INNER_WAVE + 6
    piece = spline_weights(u, 0.0, 1.0 / (num - 3), num, weights[0], weights[1])
    spline_bows(u, 0.0, 1.0 / (num - 3), num, weights[2])
    across = slope = curve = 0.0
    for k in range(ORDER):
        i = piece + k - 3
        if 0 <= i < INNER_WAVE:
            across += weights[0, k] * v[first + i]
            slope += weights[1, k] * v[first + i] / speed
            curve += weights[2, k] * v[first + i] / speed**2
            node[5 + first + i] = weights[0, k]
    ux, uy, length = node[2], node[3], math.hypot(1.0, slope)
    node[0], node[1] = node[0] - across * uy, node[1] + across * ux
    node[2], node[3] = (ux - slope * uy) / length, (uy + slope * ux) / length
    node[4] += curve / length**3


@nb.njit(error_model="numpy")
def course_nodes(v, lanes, reach, counts, nodes):  # type: ignore[no-untyped-def]
    """All nodes of a lane in driving order; returns how many.

    v       (LOCAL,) numbers of the lane; (RIPPLED,) or (WAVY,) with waves
    lanes   (2,) number of its entry lane and of its exit lane on their arms
    reach   (2,) distance from the centre to which it is known on either arm
    counts  (3,) nodes on the entry arm, pieces of the interior, nodes on the exit arm
    nodes   (N, 5 + len(v)): x, y, unit tangent, curvature, displacement to the left per unit of every number"""
    arm_nodes(v, 0, lanes[0], reach[0], counts[0], nodes, 0)
    interior_nodes(v, lanes, counts[1], nodes, counts[0])
    arm_nodes(v, 1, lanes[1], reach[1], counts[2], nodes, counts[0] + counts[1] + 1)
    return counts[0] + counts[1] + 1 + counts[2]
