"""Whole reversible-jump chains in machine code, for models with a kernel.

The chain takes the kernel's functions as arguments of explicit function types: one machine code for all
models, found again in numba's disk cache."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from inference.acceptance import log_acceptance
from inference.polish import polish
from models.capability import Kernel, kernel_types, pointer
from models.overwrite import overwrite

Array = NDArray[Any]
acceptance = nb.njit(log_acceptance)


def _chain(  # type: ignore[no-untyped-def]
    propose, evaluate, commit, z, log_terms, best, uniforms, temperatures, setup, floats, ints, cache, draws, counts
):
    """Run one chain for len(temperatures) steps, in place.

    z (D,) state; log_terms (2,) its log prior and log likelihood; best (D + 1,) best state and its log joint
    uniforms  (n, 2 + U): move, acceptance, the move's own
    setup     (3 + 2 M,) rule, first draw, thin, cumulative and log probability of the moves
    draws     (., D) states at steps first draw, first draw + thin, ...
    counts    (M, 3) tried, evaluated, accepted"""
    num_moves = len(counts)
    cumulative, log_chance = setup[3 : 3 + num_moves], setup[3 + num_moves :]
    z_new, u_new, log_q, out = z.copy(), uniforms[0, 2:].copy(), np.zeros(3), np.zeros(2)
    rule, due, row = int(setup[0]), int(setup[1]), 0
    for i in range(len(temperatures)):
        kind = 0
        while kind < num_moves - 1 and uniforms[i, 0] >= cumulative[kind]:
            kind += 1
        counts[kind, 0] += 1
        if propose(kind, z, uniforms[i, 2:], floats, ints, z_new, u_new, log_q):
            counts[kind, 1] += 1
            evaluate(z_new, floats, ints, cache, out)
            forward, backward = log_q[0] + log_chance[kind], log_q[1] + log_chance[kind]
            prior, likelihood = out[0] - log_terms[0], out[1] - log_terms[1]
            log_ratio = acceptance(rule, temperatures[i], prior, likelihood, forward, backward, log_q[2])
            if np.log(uniforms[i, 1]) < log_ratio:
                counts[kind, 2] += 1
                commit(cache)
                overwrite(z, z_new)
                overwrite(log_terms, out)
                if out[0] + out[1] > best[-1]:
                    overwrite(best, z)
                    best[-1] = out[0] + out[1]
        if i == due:
            overwrite(draws[row], z)
            due, row = due + int(setup[2]), row + 1


@lru_cache(maxsize=1)
def compiled_chain() -> Any:
    """The chain for any kernel, called without looking at the types of its arguments at every block."""
    types = kernel_types()
    vector, index, function = types["vector"], types["index"], types["function"]
    rows = nb.float64[:, ::1]
    signature = nb.void(
        *(function(types[name]) for name in ("propose", "evaluate", "commit")),
        *(vector, vector, vector, rows, vector, vector, vector, index, vector, rows, rows),
    )
    only: Any = next(iter(nb.njit(signature, cache=True, nogil=True)(_chain).overloads.values()))
    return only.entry_point


class CompiledChains:
    """All chains of a run on a kernel; every chain has its own random numbers, so threads change nothing."""

    def __init__(
        self, kernel: Kernel, z: Array, rule: int, thin: int, keep_from: int, seeds: list[Any], num_workers: int
    ) -> None:
        num_chains, num_moves = len(z), len(kernel.probabilities)
        self.kernel, self.z, self.names = kernel, z, kernel.move_names
        self.rule, self.thin, self.keep_from, self.num_workers = rule, thin, keep_from, num_workers
        self.rngs = [np.random.default_rng(seed) for seed in seeds]
        self.caches = [np.zeros(kernel.cache_size) for _ in range(num_chains)]
        self.log_terms = np.empty((num_chains, 2))
        self.each_counts = np.zeros((num_chains, num_moves, 3))
        self.chain = compiled_chain()
        self.functions = tuple(pointer(f) for f in (kernel.propose, kernel.evaluate, kernel.commit))
        with np.errstate(divide="ignore"):
            self.chances = np.concatenate([np.cumsum(kernel.probabilities), np.log(kernel.probabilities)])
        for c in range(num_chains):
            kernel.evaluate(z[c], kernel.floats, kernel.ints, self.caches[c], self.log_terms[c])
            kernel.commit(self.caches[c])
        self.tops = np.concatenate([z, self.log_terms.sum(1, keepdims=True)], 1)

    @property
    def log_likelihood(self) -> Array:
        """(C,) of the current states."""
        return self.log_terms[:, 1]

    @property
    def log_joint(self) -> Array:
        """(C,) of the current states."""
        return self.log_terms.sum(1)

    @property
    def counts(self) -> Array:
        """(M, 3) steps tried, evaluated and accepted by move."""
        return np.asarray(self.each_counts.sum(0))

    def advance(self, first: int, temperatures: Array) -> list[dict[str, Array]]:
        """Run all chains on from step `first`; the draws kept, {site: (C, n, *event)}, in a list if any."""
        steps = np.arange(first, first + len(temperatures))
        due = np.flatnonzero((steps >= self.keep_from) & ((steps - self.keep_from) % self.thin == self.thin - 1))
        setup = np.concatenate([[self.rule, due[0] if len(due) else -1, self.thin], self.chances])
        draws = np.empty((len(self.z), max(len(due), 1), self.kernel.size))

        def one(c: int) -> None:
            kernel = self.kernel
            uniforms = self.rngs[c].random((len(temperatures), 2 + kernel.num_uniforms))
            state = (self.z[c], self.log_terms[c], self.tops[c], uniforms, temperatures, setup)
            data = (kernel.floats, kernel.ints, self.caches[c], draws[c], self.each_counts[c])
            self.chain(*self.functions, *state, *data)

        if self.num_workers > 1:
            with ThreadPoolExecutor(self.num_workers) as pool:
                list(pool.map(one, range(len(self.z))))
        else:
            for c in range(len(self.z)):
                one(c)
        return [self.kernel.unpack(draws)] if len(due) else []

    def choose(self, index: Array) -> None:
        """Replace chain c by chain index[c]."""
        self.z[:], self.log_terms[:] = self.z[index], self.log_terms[index]

    def best(self) -> tuple[Array, float]:
        """The best state of all chains so far, packed, and its log joint."""
        row = self.tops[self.tops[:, -1].argmax()]
        return row[:-1].copy(), float(row[-1])

    def unpack(self, states: list[Array]) -> dict[str, Array]:
        """{site: (S, *event)} of states from `best`."""
        return self.kernel.unpack(np.stack(states))

    def polish(self) -> None:
        """Climb from the best state of every chain; the kernel must have edits and a refit."""
        for row in self.tops:
            row[:-1], row[-1] = polish(self.kernel, row[:-1])
