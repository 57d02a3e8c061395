"""Roads of pieces in machine code: samples along one, and the density of a state.

A state is one row of numbers, with G offsets and K slots for knots,

    z = (num_knots, offset (G), x, y, heading, curvature, rate, knot_curvature (K), knot (K))

Slots 0 .. num_knots - 1 are active, in no order. The numbers between the count and the knots are those that the road is
nearly linear in; `prior_numbers` has them in the same order.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from models.clothoid_kernel import ARC, BEND, COLUMNS, COS, HEADING, SIN, X, Y
from models.intersection.window import window
from models.road.cue_kernel import WIDTH, find_samples, score_groups

Floats = NDArray[np.float64]
SHAPE = 5  # x, y, heading, curvature and rate
LENGTH, REFERENCE_STEP, COUNTS = range(3)  # of the floats; the counts are followed by what `views` names
SLOTS, GROUPS, SAMPLES, CUES, PAPER, GROUP = range(6)  # of the ints; the last is followed by the group of every cue


@nb.njit
def views(floats, ints):  # type: ignore[no-untyped-def]
    """Parts of the floats: log probabilities of the counts (K + 1,), mean and standard deviation (G + 5 + K,) of the
    linear numbers, offsets (G,) and samples (num, 7) of the reference road, cues (N, WIDTH)."""
    slots, groups, num = ints[SLOTS], ints[GROUPS], ints[SAMPLES]
    size, o = groups + SHAPE + slots, COUNTS + slots + 1
    counts, loc, std = (
        window(floats, COUNTS, (slots + 1,)),
        window(floats, o, (size,)),
        window(floats, o + size, (size,)),
    )
    o += 2 * size
    offset, table = window(floats, o, (groups,)), window(floats, o + groups, (num, COLUMNS))
    cues = window(floats, o + groups + num * COLUMNS, (ints[CUES], WIDTH))
    return counts, loc, std, offset, table, cues


@nb.njit(error_model="numpy")
def sort_nodes(z, groups, slots, node, order):  # type: ignore[no-untyped-def]
    """Places and curvatures of the start and of the active knots along the road, node (2, K + 1), and the slot of each,
    order (K + 1,); returns how many knots are active."""
    num, bends = int(z[0]), 1 + groups + SHAPE
    node[0, 0], node[1, 0], order[0] = 0.0, z[bends - 2], -1
    for a in range(num):
        place, i = z[bends + slots + a], a
        while i > 0 and node[0, i] > place:
            node[0, i + 1], node[1, i + 1], order[i + 1] = node[0, i], node[1, i], order[i]
            i -= 1
        node[0, i + 1], node[1, i + 1], order[i + 1] = place, z[bends + a], a
    return num


@nb.njit(error_model="numpy")
def lay_pieces(z, groups, slots, length, table):  # type: ignore[no-untyped-def]
    """Samples at equal steps of arc length from 0 to `length` [m] into table (num, 7), as those of
    models.clothoid_kernel.sample_one; returns the step [m].

    Directions are exact and positions by Simpson's rule, whose error where the rate changes by d within a step h is
    below d h^4 / 500: .1 mm for a change of 1e-4 / m^2 at 4 m."""
    node, order = np.empty((2, slots + 1)), np.empty(slots + 1, np.int64)
    num, o = sort_nodes(z, groups, slots, node, order), 1 + groups
    x, y, turned, rate = z[o], z[o + 1], z[o + 2], z[o + 4]
    step, i, cos0, sin0, cos1, sin1 = length / (len(table) - 1), 0, 0.0, 0.0, 0.0, 0.0
    for m in range(2 * len(table) - 1):
        s = 0.5 * step * m
        while i < num and s >= node[0, i + 1]:
            turned += 0.5 * (node[1, i] + node[1, i + 1]) * (node[0, i + 1] - node[0, i])
            i += 1
        slope = (node[1, i + 1] - node[1, i]) / (node[0, i + 1] - node[0, i]) if i < num else rate
        beyond = s - node[0, i]
        heading = turned + beyond * (node[1, i] + 0.5 * slope * beyond)
        cos, sin = math.cos(heading), math.sin(heading)
        if m % 2 == 1:
            cos1, sin1 = cos, sin
            continue
        k = m // 2
        if k > 0:
            x += step / 6.0 * (cos0 + 4.0 * cos1 + cos)
            y += step / 6.0 * (sin0 + 4.0 * sin1 + sin)
        cos0, sin0 = cos, sin
        table[k, X], table[k, Y], table[k, HEADING] = x, y, heading
        table[k, COS], table[k, SIN], table[k, BEND], table[k, ARC] = cos, sin, node[1, i] + slope * beyond, s
    return step


@nb.njit(error_model="numpy")
def road_density(z, groups, slots, length, paper, cues, group, table):  # type: ignore[no-untyped-def]
    """Log density of all cues (N, WIDTH) beside the road of a state; `table` is room for its samples."""
    near, height, changes = np.empty(len(cues), np.int64), np.empty(groups), np.empty(groups)
    find_samples(cues, table, lay_pieces(z, groups, slots, length, table), near)
    score_groups(paper, cues, group, near, z[1 : 1 + groups], table, height, changes)
    return height.sum()


@nb.njit(error_model="numpy")
def log_prior(z, length, counts, loc, std):  # type: ignore[no-untyped-def]
    """Log prior of a state, inactive slots included."""
    slots, size = len(counts) - 1, len(loc)
    value = counts[int(z[0])] - slots * math.log(length) - 0.5 * size * math.log(2.0 * math.pi)
    for i in range(size):
        e = (z[1 + i] - loc[i]) / std[i]
        value -= 0.5 * e * e + math.log(std[i])
    for a in range(slots):
        if not 0.0 <= z[1 + size + a] <= length:
            return -math.inf
    return value


def evaluate(z, floats, ints, cache, out):  # type: ignore[no-untyped-def]
    """out = (log prior, log likelihood) of a state; the cache is room for samples."""
    counts, loc, std, _, _, cues = views(floats, ints)
    out[0], out[1] = log_prior(z, floats[LENGTH], counts, loc, std), -math.inf
    if out[0] > -math.inf:
        table, group = window(cache, 0, (ints[SAMPLES], COLUMNS)), window(ints, GROUP, (ints[CUES],))
        shape = (ints[GROUPS], ints[SLOTS], floats[LENGTH], ints[PAPER] == 1)
        out[1] = road_density(z, *shape, cues, group, table)


def commit(cache):  # type: ignore[no-untyped-def]
    """Nothing is remembered."""


@nb.njit(cache=True, error_model="numpy")
def cue_densities(z, groups, slots, length, num, paper, cues, group, out):  # type: ignore[no-untyped-def]
    """Log densities (B,) of cues (N, WIDTH) beside the roads of states z (B, size)."""
    table = np.empty((num, COLUMNS))
    for i in range(len(z)):
        out[i] = road_density(z[i], groups, slots, length, paper, cues, group, table)


@nb.njit(cache=True, error_model="numpy")
def lay_roads(z, groups, slots, length, tables):  # type: ignore[no-untyped-def]
    """`lay_pieces` of states z (B, size) into tables (B, num, 7)."""
    for i in range(len(z)):
        lay_pieces(z[i], groups, slots, length, tables[i])


def samples_of(states: Floats, num_groups: int, slots: int, length: float, num: int) -> Floats:
    """Samples (*B, num, 7) at equal steps from 0 to `length` [m] of states (*B, size), columns as in
    models.clothoid_kernel.sample_one."""
    rows = np.ascontiguousarray(states).reshape(-1, states.shape[-1])
    tables = np.empty((len(rows), num, COLUMNS))
    lay_roads(rows, num_groups, slots, length, tables)
    return tables.reshape((*states.shape[:-1], num, COLUMNS))


def road_samples(draws: dict[str, Any], length: float, num: int) -> Floats:
    """The same of {site: (*B, *event)}."""
    return samples_of(pack(draws), draws["offset"].shape[-1], draws["knot"].shape[-1], length, num)


def pack(latents: dict[str, Any]) -> Floats:
    """{site: (*batch, *event)} to states (*batch, size)."""
    values = {name: np.asarray(value, dtype=np.float64) for name, value in latents.items()}
    scalars = {name: values[name][..., None] for name in ("num_knots", "curvature", "rate")}
    values |= scalars
    names = ("num_knots", "offset", "start", "curvature", "rate", "knot_curvature", "knot")
    shape = np.broadcast_shapes(*(values[name].shape[:-1] for name in names))
    return np.concatenate([np.broadcast_to(values[n], (*shape, values[n].shape[-1])) for n in names], -1)


def unpack(z: Floats, slots: int) -> dict[str, Any]:
    """States (*batch, size) to {site: (*batch, *event)}, the inverse of `pack`."""
    knots = z.shape[-1] - slots
    bends = knots - slots
    shape = bends - SHAPE
    return {
        "num_knots": np.rint(z[..., 0]).astype(np.int64),
        "start": z[..., shape : shape + 3].copy(),
        "curvature": z[..., shape + 3].copy(),
        "rate": z[..., shape + 4].copy(),
        "knot": z[..., knots:].copy(),
        "knot_curvature": z[..., bends:knots].copy(),
        "offset": z[..., 1:shape].copy(),
    }
