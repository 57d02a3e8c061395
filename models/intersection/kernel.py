"""The intersection as a compiled kernel: prior, likelihood with a memory of the arms, moves.

The memory holds two rows per slot: the one of the current state and the one evaluated last. A row is
found again by the numbers it was computed from, so `evaluate` is a function of z alone, whatever was
evaluated before; `commit` decides which row to keep."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import numba as nb
import numpy as np
import torch
from numpy.typing import NDArray

from models.capability import Kernel, Move, Proposal, compiled
from models.intersection import density, moves
from models.intersection.density import EXACT, HALF, LIKELIHOODS, POINT
from models.intersection.evidence import JunctionEvidence, clutter_costs, scaled
from models.intersection.moments import NUM_COEFFICIENTS, NUM_MOMENTS, SIDE
from models.intersection.packing import ARM, ENTRIES, EXITS, HEAD, MAX_ARMS, SIZE, pack, unpack
from models.intersection.prior import GAP_MAX, log_head, log_slot, prior_numbers
from models.intersection.refit import EDITS_PER_ARM, FREE, edit, quadratic_model, solve_spd, take_step
from models.intersection.split import (
    NUM_CELLS,
    NUM_SUMS,
    cell_coefficients,
    cell_of,
    half_ranges,
)
from models.intersection.window import window

if TYPE_CHECKING:
    from models.intersection.state import Junction

Array = NDArray[np.float64]

# numbers after the settings of prior and moves
LOG_CLUTTER, LOG_KEPT, POSITION, HEADING, CONSTANT = range(moves.NUM_SETTINGS, moves.NUM_SETTINGS + 5)
FLOATS = moves.NUM_SETTINGS + 5
# whole numbers of the data
LIKELIHOOD, NUM_HALVES, NUM_ENTRIES, NUM_TRACKS, MARGIN = range(5)
INTS = 5
KEY = 2 + ARM  # a row depends on the centre and on its arm
TURN = 3  # its scatter on angle, bend and the split; the direction is kept beside them
MAX_COUNTS = 10  # lanes of a side, at most


@nb.njit(cache=True)
def memory_size(ints):  # type: ignore[no-untyped-def]
    """Length of the cache for this evidence."""
    halves = ints[NUM_HALVES]
    size = MAX_ARMS * (4 + ARM + 2 * KEY + 2 * (TURN + 2) + 4 * halves + MAX_COUNTS) + 2 * halves
    if ints[LIKELIHOOD] == HALF:
        size += NUM_CELLS + (NUM_MOMENTS + 5) * halves + NUM_CELLS * NUM_COEFFICIENTS * halves
    return size


@nb.njit
def memory(cache, halves):  # type: ignore[no-untyped-def]
    """Named views of the cache: which row of each slot is current and which is evaluated, for rows and for their
    scatter; the numbers each was computed from; scatter (2, A, H); costs (2, A, H); counts; room."""
    n = MAX_ARMS
    which, o = window(cache, 0, (4, n)), (4 + ARM) * n
    keys = window(cache, o, (2, n, KEY))
    o += 2 * n * KEY
    turns = window(cache, o, (2, n, TURN + 2))
    o += 2 * n * (TURN + 2)
    scatter = window(cache, o, (2, n, halves))
    o += 2 * n * halves
    rows = window(cache, o, (2, n, halves))
    o += 2 * n * halves
    counts = window(cache, o, (n, MAX_COUNTS))
    o += n * MAX_COUNTS
    return which, keys, turns, scatter, rows, counts, window(cache, o, (len(cache) - o,))


@nb.njit
def remembered_prior(z, numbers, cache):  # type: ignore[no-untyped-def]
    """`log_prior` of a state; the part of each slot is kept with the numbers it was computed from."""
    slots, value = window(cache, 4 * MAX_ARMS, (MAX_ARMS, ARM)), log_head(z, numbers)
    if value == -math.inf:
        return value
    for a in range(MAX_ARMS):
        o, known = HEAD + a * ARM, slots[a, 0] != 0.0
        for j in range(1, ARM):
            known = known and slots[a, j] == z[o + j]
        if not known:
            slots[a, 0] = log_slot(z, a, numbers)
            for j in range(1, ARM):
                slots[a, j] = z[o + j]
        value += slots[a, 0]
    return value


@nb.njit
def side_range(side, entries, halves):  # type: ignore[no-untyped-def]
    """First and last half of the entries (side 0) or the exits (side 1)."""
    return (0, entries) if side == 0 else (entries, halves)


@nb.njit
def lanes_of(z, field):  # type: ignore[no-untyped-def]
    total = 0.0
    for a in range(int(z[0])):
        total += z[HEAD + a * ARM + field]
    return total


@nb.njit
def coefficients_at(cell, floats, ints, room):  # type: ignore[no-untyped-def]
    """[M20]'s halves for a cell of the centre, (19, 2 T); every cell is computed once."""
    halves, tracks = ints[NUM_HALVES], ints[NUM_TRACKS]
    known = room[:NUM_CELLS]
    o = NUM_CELLS
    observed = room[o : o + NUM_MOMENTS * halves].reshape((NUM_MOMENTS, halves))
    o += NUM_MOMENTS * halves
    fixed = room[o : o + 5 * halves].reshape((5, halves))
    o += 5 * halves + cell * NUM_COEFFICIENTS * halves
    coef = room[o : o + NUM_COEFFICIENTS * halves].reshape((NUM_COEFFICIENTS, halves))
    if known[cell] == 0.0:
        offsets = ints[INTS : INTS + tracks + 1]
        table = ints[INTS + tracks + 1 :]
        begin, end = np.empty(halves, np.int64), np.empty(halves, np.int64)
        half_ranges(table, offsets, cell, ints[MARGIN], begin, end)
        num = offsets[tracks]
        sums = floats[FLOATS + 3 * num : FLOATS + 3 * num + NUM_SUMS * (num + tracks)].reshape((num + tracks, NUM_SUMS))
        cell_coefficients(sums, offsets, begin, end, floats[POSITION], floats[HEADING], observed, fixed, coef)
        known[cell] = 1.0
    return coef


@nb.njit
def point_score(z, floats, ints, counts):  # type: ignore[no-untyped-def]
    """[M20] as printed: every point with its closest lane, halves split at the centre."""
    tracks, halves = ints[NUM_TRACKS], ints[NUM_HALVES]
    offsets, table = ints[INTS : INTS + tracks + 1], ints[INTS + tracks + 1 :]
    begin, end = np.empty(halves, np.int64), np.empty(halves, np.int64)
    half_ranges(table, offsets, cell_of(z[1], z[2]), ints[MARGIN], begin, end)
    points = floats[FLOATS : FLOATS + 3 * offsets[tracks]].reshape((3, offsets[tracks]))
    arms = z[HEAD:].reshape((MAX_ARMS, ARM))
    noise, num, score = floats[POSITION : HEADING + 1], int(z[0]), 0.0
    for side in range(2):
        first, last = side_range(side, tracks, halves)
        sign, lanes = 1.0 - 2.0 * side, lanes_of(z, ENTRIES + side)
        score += density.closest_points(
            points, begin, end, first, last, sign, z[1], z[2], arms, num, lanes, noise, counts
        )
    return score


@nb.njit
def update_arms(z, coef, stray, cell, which, keys, turns, scatter, rows):  # type: ignore[no-untyped-def]
    """Make sure that the rows of all active slots for z are at hand, computing only what changed; lanes are
    summed where there are stray halves.

    cell counts from 1: the cache begins as zeros, and an arm at angle 0 must not be taken for known."""
    for a in range(int(z[0])):
        arm = z[HEAD + a * ARM : HEAD + (a + 1) * ARM]
        row, turn = int(which[0, a]), int(which[2, a])
        known = keys[row, a, 0] == z[1] and keys[row, a, 1] == z[2]
        for j in range(ARM):
            known = known and keys[row, a, 2 + j] == arm[j]
        if not known:
            row = 1 - row
            keys[row, a, 0], keys[row, a, 1] = z[1], z[2]
            for j in range(ARM):
                keys[row, a, 2 + j] = arm[j]
            if not (turns[turn, a, 0] == arm[0] and turns[turn, a, 1] == arm[5] and turns[turn, a, 2] == cell):
                turn = 1 - turn
                turns[turn, a, 0], turns[turn, a, 1], turns[turn, a, 2] = arm[0], arm[5], cell
                turns[turn, a, 3], turns[turn, a, 4] = math.cos(arm[0]), math.sin(arm[0])
                density.scatter_row(coef, turns[turn, a, 3], turns[turn, a, 4], arm[5], scatter[turn, a])
            place = (z[1], z[2], turns[turn, a, 3], turns[turn, a, 4], arm)
            density.mean_row(coef, *place, scatter[turn, a], rows[row, a])
            if len(stray) > 0:
                density.sum_lanes_row(coef, *place, stray, rows[row, a])
        which[1, a], which[3, a] = row, turn


@nb.njit
def exact_data(floats, halves):  # type: ignore[no-untyped-def]
    """Coefficients (19, H) and costs of stray halves (H,) in the data of the exact likelihood."""
    end = FLOATS + NUM_COEFFICIENTS * halves
    return window(floats, FLOATS, (NUM_COEFFICIENTS, halves)), window(floats, end, (halves,))


def evaluate_exact(z, floats, ints, cache, out):  # type: ignore[no-untyped-def]
    """out = (log prior, log likelihood) of a packed state, lane labels summed out."""
    out[0], out[1] = remembered_prior(z, floats, cache), -math.inf
    if out[0] == -math.inf:
        return
    z = window(z, 0, (SIZE,))
    halves, num = ints[NUM_HALVES], int(z[0])
    which, keys, turns, scatter, rows, _, room = memory(cache, halves)
    coef, stray = exact_data(floats, halves)
    update_arms(z, coef, stray, 1.0, which, keys, turns, scatter, rows)
    pick, low, second = which[1], room[:halves], room[halves : 2 * halves]
    density.two_lowest(rows, pick, num, low, second)
    lanes, shares = (lanes_of(z, EXITS), lanes_of(z, ENTRIES)), (floats[LOG_CLUTTER], floats[LOG_KEPT])
    out[1] = floats[CONSTANT]
    out[1] += density.sum_arms(rows, pick, num, coef[SIDE], lanes, stray, *shares, low, second)


def evaluate_closest(z, floats, ints, cache, out):  # type: ignore[no-untyped-def]
    """out = (log prior, score) of a packed state, [M20]'s closest lanes for half tracks or points."""
    out[0], out[1] = remembered_prior(z, floats, cache), -math.inf
    if out[0] == -math.inf:
        return
    z = window(z, 0, (SIZE,))
    halves, entries, num = ints[NUM_HALVES], ints[NUM_ENTRIES], int(z[0])
    which, keys, turns, scatter, rows, counts, room = memory(cache, halves)
    if ints[LIKELIHOOD] == POINT:
        out[1] = point_score(z, floats, ints, counts)
        return
    cell = cell_of(z[1], z[2])
    coef = coefficients_at(cell, floats, ints, room)
    update_arms(z, coef, floats[:0], cell + 1.0, which, keys, turns, scatter, rows)
    out[1] = floats[CONSTANT]
    arms = z[HEAD:].reshape((MAX_ARMS, ARM))
    for side in range(2):
        first, last = side_range(side, entries, halves)
        lanes = lanes_of(z, ENTRIES + side)
        out[1] += density.closest_arms(coef, z[1], z[2], arms, rows, which[1], num, first, last, lanes, counts)


@nb.njit
def newton(z, coef, stray, rows, pick, floats):  # type: ignore[no-untyped-def]
    """One Gauss-Newton step of the continuous numbers, in place."""
    size = 2 + FREE * int(z[0])
    hessian, gradient = np.empty((size, size)), np.empty(size)
    quadratic_model(z, coef, stray, rows, pick, floats, hessian, gradient)
    if solve_spd(hessian, gradient, size):
        take_step(z, gradient, floats[GAP_MAX])


def refit_exact(z, floats, ints, cache):  # type: ignore[no-untyped-def]
    """A Gauss-Newton step; the cache holds z evaluated last."""
    which, _, _, _, rows, _, _ = memory(cache, ints[NUM_HALVES])
    coef, stray = exact_data(floats, ints[NUM_HALVES])
    newton(z, coef, stray, rows, which[1], floats)


def refit_half(z, floats, ints, cache):  # type: ignore[no-untyped-def]
    """A Gauss-Newton step with [M20]'s halves; the cache holds z evaluated last."""
    which, _, _, _, rows, _, room = memory(cache, ints[NUM_HALVES])
    coef = coefficients_at(cell_of(z[1], z[2]), floats, ints, room)
    newton(z, coef, np.full(ints[NUM_HALVES], density.NO_LANE), rows, which[1], floats)


def commit(cache):  # type: ignore[no-untyped-def]
    """Keep the rows evaluated last."""
    n = MAX_ARMS
    for a in range(n):
        cache[a], cache[2 * n + a] = cache[n + a], cache[3 * n + a]


def compiled_evaluate(model: Junction) -> Any:
    """The density of a model: each likelihood is compiled when it is first used."""
    return compiled(evaluate_exact if model.likelihood == "exact" else evaluate_closest, "evaluate")


def compiled_refit(model: Junction) -> Any:
    """The refit of a model; None where every point has a lane of its own."""
    functions = {"exact": refit_exact, "half": refit_half}
    return compiled(functions[model.likelihood], "refit") if model.likelihood in functions else None


def settings(model: Junction) -> Array:
    """Numbers of the prior and the moves."""
    spreads = (model.width_spread, model.bend_std, model.shift_std)
    low = 0 if model.one_way else 1
    numbers = prior_numbers(model.centre_std, model.gap_max, model.width, spreads, low, model.max_lanes)
    return np.array([*numbers, float(model.steps == "extended")])


def bound_data(model: Junction, evidence: JunctionEvidence, observed: Array) -> tuple[Array, NDArray[np.int64]]:
    """The kernel's floats and ints for observed moments (12, H)."""
    kind = LIKELIHOODS[model.likelihood]
    log_share = [math.log(model.clutter) if model.clutter > 0 else -math.inf, math.log1p(-model.clutter)]
    heading = model.heading_std
    if kind == EXACT:
        front, stray = clutter_costs(evidence, observed, model)
        stray = stray if model.clutter > 0 else np.full_like(stray, 0.1 * density.NO_LANE)
        head = [*settings(model), *log_share, model.position_std, heading, front.sum()]
        floats = np.concatenate([head, scaled(evidence, observed, model).ravel(), stray])
        return floats, np.array([kind, evidence.num_halves, evidence.num_entries, 0, 0], dtype=np.int64)
    assert evidence.whole is not None
    rows, offsets, sums, table = evidence.whole
    num, margin = len(offsets) - 1, int(model.inner_radius)
    head = [*settings(model), *log_share, model.position_std, heading, 0.0]
    floats = np.concatenate([head, rows.ravel(), sums.ravel()])
    return floats, np.concatenate([[kind, 2 * num, num, num, margin], offsets, table]).astype(np.int64)


def junction_kernel(model: Junction, evidence: JunctionEvidence) -> Kernel:
    """The compiled kernel of a model and its evidence."""
    floats, ints = bound_data(model, evidence, evidence.moments)
    table = move_table(model)
    constants = model.constants
    return Kernel(
        move_names=tuple(moves.NAMES),
        probabilities=np.array([table.get(kind, 0.0) for kind in range(len(moves.NAMES))]),
        num_uniforms=moves.NUM_UNIFORMS,
        size=SIZE,
        floats=floats,
        ints=ints,
        cache_size=int(memory_size(ints)),
        propose=compiled(moves.propose, "propose"),
        evaluate=compiled_evaluate(model),
        commit=compiled(commit, "commit"),
        pack=lambda latents: pack(latents, constants, evidence.origin),
        unpack=lambda z: unpack(z, constants, evidence.origin),
        edit=compiled(edit, "edit"),
        refit=compiled_refit(model),
        num_edits=MAX_ARMS * EDITS_PER_ARM,
    )


def move_table(model: Junction) -> dict[int, float]:
    """{kind: probability} of the model's moves."""
    return moves.probabilities(model.steps, {name: name not in model.constants for name in ("width", "bend", "shift")})


def batched_moves(model: Junction) -> tuple[Move, ...]:
    """The compiled involutions as moves over batches of latents."""
    numbers, none = settings(model), np.zeros(1, dtype=np.int64)
    constants, origin = model.constants, np.zeros(2)

    def involution(kind: int, latents: dict[str, torch.Tensor], u: torch.Tensor) -> Proposal:
        z = pack(latents, constants, origin)
        z_new, u_new, log_q = np.empty_like(z), np.empty(u.shape), np.empty((len(z), 3))
        valid = np.empty(len(z), dtype=np.bool_)
        propose, numbers_in = compiled(moves.propose, "propose"), np.ascontiguousarray(u.numpy())
        for b in range(len(z)):
            valid[b] = propose(kind, z[b], numbers_in[b], numbers, none, z_new[b], u_new[b], log_q[b])
        new = {name: torch.from_numpy(np.array(value)) for name, value in unpack(z_new, constants, origin).items()}
        forward, backward, jacobian = torch.from_numpy(log_q).unbind(-1)
        return Proposal(new, torch.from_numpy(u_new), forward, backward, jacobian, torch.from_numpy(valid))

    return tuple(
        Move(moves.NAMES[kind], share, moves.NUM_UNIFORMS, partial(involution, kind))
        for kind, share in move_table(model).items()
    )
