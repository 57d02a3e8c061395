"""Marginal probabilities of data association between T tracks and M measurements of one scan.

Every track takes one measurement or is missed, and no two take the same one:

    p(theta) = 1 / Z  prod_t w_t(theta_t),   w_t(missed) = missed_t,   w_t(j) = ratio_(t, j)
    Z = sum over theta: {1..T} -> {missed, 1..M}, injective where not missed

This table is all that engines for many objects need to know of model and scan. For Bernoulli tracks with existence r,
detection probability p_D, likelihood g and clutter intensity lambda (Reuter, Vo, Vo and Dietmayer 2014),

    ratio_(t, j) = r_t p_D g(z_j | t) / lambda(z_j),   missed_t = 1 - r_t p_D

and p(scan) = exp(-integral lambda) prod_j lambda(z_j) Z.

auto    groups of tracks that share measurements are summed over exactly, by forward-backward over bit masks
        (`inference.association_exact`), and by loopy belief propagation where they need more than max_shared bits
loopy   belief propagation for every group of two tracks or more (`inference.association_loopy`)
gibbs   distinct associations met by Gibbs sampling, a slow reference (`inference.association_gibbs`)

Numba code calls `associate` and `choose` of `inference.association_kernel` with plain arrays.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference.association_kernel import AUTO, GIBBS, IMPOSSIBLE, LOOPY, MISSED, associate, choose
from models.program import InputError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
METHODS = {"auto": AUTO, "loopy": LOOPY, "gibbs": GIBBS}
MAX_BITS = 20  # masks of a million: beyond, memory and time run away

__all__ = ["MISSED", "Marginals", "Table", "associate", "best", "choose", "draw", "marginals"]


class Table(NamedTuple):
    """Weights of the associations, by track (CSR).

    offset       (T + 1,) track t has the entries offset[t] to offset[t + 1]
    measurement  (E,) of an entry, once per track
    ratio        (E,) >= 0
    missed       (T,) >= 0
    """

    offset: Ints
    measurement: Ints
    ratio: Array
    missed: Array


class Marginals(NamedTuple):
    """taken (E,) and free (T,) sum to one by track.

    taken            (E,) P(track takes measurement)
    free             (T,) P(track is missed)
    log_partition    log Z: exact, or with the Bethe approximation (loopy) or a lower bound (gibbs) for groups so summed
    num_approximate  how many groups were not summed exactly
    num_unconverged  how many of these belief propagation gave up on at its cap
    """

    taken: Array
    free: Array
    log_partition: float
    num_approximate: int
    num_unconverged: int


def marginals(
    table: Table,
    *,
    method: Literal["auto", "loopy", "gibbs"] = "auto",
    max_shared: int = 8,
    tolerance: float = 1e-6,
    max_iterations: int = 200,
    num_sweeps: int = 1000,
    seed: int = 0,
) -> Marginals:
    """Marginals and log Z of a table.

    max_shared      bits of the masks up to which a group is exact; its time grows with 2^bits
    tolerance       of probabilities, at which belief propagation stops; max_iterations its cap
    num_sweeps      of the Gibbs sampler; seed of its random numbers

    Raises InputError for weights that are NaN, negative or infinite, a broken table, and tracks that no association
    has room for."""
    if method not in METHODS:
        raise InputError(f"method must be one of {', '.join(METHODS)}, but is '{method}'")
    if max_iterations < 1 or num_sweeps < 1:
        raise InputError(f"max_iterations={max_iterations} and num_sweeps={num_sweeps} must be 1 or more")
    table, num_measurements = _check(table, max_shared)
    taken, free, random = np.empty(len(table.ratio)), np.empty(len(table.missed)), np.array([seed], np.uint64)
    found = associate(
        *table,
        num_measurements,
        METHODS[method],
        max_shared,
        tolerance,
        max_iterations,
        num_sweeps,
        random,
        taken,
        free,
    )
    if found[0] == -np.inf:
        track = np.repeat(np.arange(len(free)), np.diff(table.offset))
        _refuse(np.flatnonzero(free + np.bincount(track, taken, len(free)) == 0.0))
    return Marginals(taken, free, *found)


def best(table: Table) -> Ints:
    """theta (T,) of the most probable association: measurements, MISSED (-1) for none. Raises as `marginals`."""
    table, num_measurements = _check(table, 0)
    theta = np.empty((1, len(table.missed)), np.int64)
    choose(*table, num_measurements, 0, 0, np.zeros(1, np.uint64), False, theta)
    _refuse(np.flatnonzero(theta[0] == IMPOSSIBLE))
    return theta[0]


def draw(table: Table, rng: np.random.Generator, num: int = 1, *, max_shared: int = 8, num_sweeps: int = 50) -> Ints:
    """theta (num, T) drawn from p: measurements, MISSED (-1) for none. Raises as `marginals`.

    Draws are independent and exact in groups that need max_shared bits at most. In larger ones each is picked from
    num_sweeps further sweeps of one Gibbs sampler that starts at the most probable association: they are correlated,
    and follow p as num_sweeps grows."""
    if num < 1 or num_sweeps < 1:
        raise InputError(f"num={num} and num_sweeps={num_sweeps} must be 1 or more")
    table, num_measurements = _check(table, max_shared)
    theta, random = np.empty((num, len(table.missed)), np.int64), rng.integers(0, 2**64, 1, dtype=np.uint64)
    choose(*table, num_measurements, max_shared, num_sweeps, random, True, theta)
    _refuse(np.flatnonzero(theta[0] == IMPOSSIBLE))
    return theta


def _check(table: Table, max_shared: int) -> tuple[Table, int]:
    """The table as contiguous arrays, and the number of measurements that it needs."""
    offset, measurement = (np.ascontiguousarray(a, np.int64) for a in table[:2])
    ratio, missed = (np.ascontiguousarray(a, np.float64) for a in table[2:])
    num, size = len(missed), len(ratio)
    if not 0 <= max_shared <= MAX_BITS:
        raise InputError(f"max_shared is {max_shared}; choose 0 to {MAX_BITS} bits")
    if len(offset) != num + 1 or offset[0] != 0 or offset[-1] != size or (np.diff(offset) < 0).any():
        raise InputError(
            f"the association table's offset must rise from 0 to its {size} entries in {num + 1} steps, "
            f"one more than it has tracks, but is {offset}"
        )
    if len(measurement) != size:
        raise InputError(f"the association table has {size} ratios, but {len(measurement)} measurements; pair them")
    track = np.repeat(np.arange(num), np.diff(offset))
    for name, values, tracks in (("ratio", ratio, track), ("missed", missed, np.arange(num))):
        if (wrong := np.flatnonzero(~((values >= 0.0) & (values < np.inf)))).size:
            raise InputError(
                f"{name} of track {tracks[wrong[0]]} is {values[wrong[0]]} in the association table; "
                "weights are finite and not negative"
            )
    if (wrong := np.flatnonzero(measurement < 0)).size:
        raise InputError(f"track {track[wrong[0]]} has measurement {measurement[wrong[0]]}; they count from 0")
    order = np.lexsort((measurement, track))
    if (twice := np.flatnonzero((np.diff(track[order]) == 0) & (np.diff(measurement[order]) == 0))).size:
        k = order[twice[0]]
        raise InputError(f"track {track[k]} has measurement {measurement[k]} twice; add the ratios up")
    with np.errstate(over="ignore"):
        total = missed + np.bincount(track, ratio, num)
    if (wrong := np.flatnonzero(total == 0.0)).size:
        raise InputError(f"track {wrong[0]} can neither be missed nor take a measurement: all of its weights are zero")
    if (wrong := np.flatnonzero(total == np.inf)).size:
        raise InputError(f"the weights of track {wrong[0]} sum to infinity; divide them all by their largest")
    return Table(offset, measurement, ratio, missed), int(measurement.max(initial=-1)) + 1


def _refuse(tracks: Ints) -> None:
    """No association has positive weight for these."""
    if tracks.size:
        raise InputError(
            f"no association is possible for tracks {', '.join(map(str, tracks[:10]))}: they cannot all be missed or "
            "take measurements of their own; give them missed weight (p_D < 1) or more measurements"
        )
