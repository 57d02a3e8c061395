"""Particles that a tempered population is made of, and how they move at one temperature.

`Walkers` are whitened numbers u of N(0, I) before any evidence. At exponent b their density is N(u; 0, I) e^(b h(u)),
and two kinds of steps leave it as it is, both learnt from the cloud: its mean m and covariance C,

    walk    u' = u + s e                                  e ~ N(0, C)
    shrink  u' = m + sqrt(1 - s^2) (u - m) + s e          reversible for N(m, C), so its Hastings term is
                                                          log N(u; m, C) - log N(u'; m, C)

The first finds its way in clouds of any shape, the second (Neal 1999; Cotter et al. 2013) takes steps that do not
shorten with the dimension where the cloud is near normal. Each step's s follows the share of steps taken.

`Movers` are states of a model with moves: its own reversible-jump steps at temperature 1 / b, as in inference.rjmcmc.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from inference.rjmcmc import ACCEPTED, EVALUATED, RULES, TRIED, BatchedChains, Chains, first_states
from models.capability import HasMoves

Array = NDArray[np.float64]
WANTED = {"walk": 0.3, "shrink": 0.5}  # shares of steps taken that s is led to
LONGEST = {"walk": 10.0, "shrink": 1.0}


class Population(Protocol):
    """N particles; `heat` (N,) is the log of what an exponent is put on."""

    @property
    def heat(self) -> Array: ...
    @property
    def evaluations(self) -> int: ...
    @property
    def acceptance(self) -> dict[str, float]: ...
    def choose(self, index: NDArray[np.int64]) -> None: ...
    def move(self, exponent: float) -> None: ...
    def best(self) -> dict[str, NDArray[Any]]: ...
    def draws(self) -> dict[str, NDArray[Any]]: ...


class Walkers:
    """Whitened numbers under `density`, u (N, D) -> h (N,)."""

    def __init__(
        self,
        density: Callable[[Array], Array],
        latents: Callable[[Array], dict[str, NDArray[Any]]],
        shape: tuple[int, int],
        num_moves: int,
        rng: np.random.Generator,
    ) -> None:
        self.density, self.latents, self.num_moves, self.rng = density, latents, num_moves, rng
        self.u = rng.standard_normal(shape)
        self.heat = density(self.u)
        self.evaluations = len(self.u)
        self.length = {"walk": 2.38 / np.sqrt(shape[1]), "shrink": 0.7}
        self.counts = {name: np.zeros(2) for name in self.length}  # tried, accepted
        self.top, self.height = self.u[0], -np.inf
        self._remember()

    @property
    def acceptance(self) -> dict[str, float]:
        """Share of the steps taken, by kind."""
        return {name: float(taken / tried) for name, (tried, taken) in self.counts.items() if tried}

    def choose(self, index: NDArray[np.int64]) -> None:
        """Replace particle n by particle index[n]."""
        self.u, self.heat = self.u[index], self.heat[index]

    def move(self, exponent: float) -> None:
        """Steps of both kinds in turn, with the cloud's moments as they are now."""
        mean = self.u.mean(0)
        apart = self.u - mean
        cover = apart.T @ apart / len(apart) + 1e-9 * np.eye(len(mean))
        tril = np.linalg.cholesky(cover)
        inverse = np.linalg.inv(tril)
        for number in range(self.num_moves):
            self._step("shrink" if number % 2 else "walk", exponent, mean, tril, inverse)

    def _step(self, kind: str, exponent: float, mean: Array, tril: Array, inverse: Array) -> None:
        s, noise = self.length[kind], self.rng.standard_normal(self.u.shape) @ tril.T
        centre = self.u if kind == "walk" else mean + np.sqrt(1.0 - s * s) * (self.u - mean)
        new = centre + s * noise
        heat = self.density(new)
        log_ratio = exponent * (heat - self.heat) - 0.5 * (np.square(new) - np.square(self.u)).sum(1)
        if kind == "shrink":
            log_ratio += log_hastings(self.u - mean, new - mean, inverse)
        accepted = np.log(self.rng.random(len(new))) < log_ratio
        self.u = np.where(accepted[:, None], new, self.u)
        self.heat = np.where(accepted, heat, self.heat)
        self.evaluations += len(new)
        self.counts[kind] += len(new), accepted.sum()
        self.length[kind] = min(s * float(np.exp(accepted.mean() - WANTED[kind])), LONGEST[kind])
        self._remember()

    def _remember(self) -> None:
        height = self.heat - 0.5 * np.square(self.u).sum(1)
        if height.max() > self.height:
            self.top, self.height = self.u[height.argmax()].copy(), float(height.max())

    def best(self) -> dict[str, NDArray[Any]]:
        """The latents of highest whitened density so far, {site: (*event)}."""
        return self.latents(self.top)

    def draws(self) -> dict[str, NDArray[Any]]:
        """{site: (N, *event)}."""
        return self.latents(self.u)


def log_hastings(old: Array, new: Array, inverse: Array) -> Array:
    """log N(old; 0, C) - log N(new; 0, C), (N,), of rows whose C has a Cholesky factor of this inverse."""
    return 0.5 * (np.square(new @ inverse.T) - np.square(old @ inverse.T)).sum(1)


class Movers:
    """States of a model with moves, from its prior."""

    def __init__(self, model: HasMoves, evidence: Any, num: int, num_moves: int, seed: np.random.SeedSequence) -> None:
        first, shared, *seeds = seed.spawn(num + 2)
        latents = first_states(model, evidence, None, num, int(first.generate_state(1)[0]))
        self.num_moves, self.done = num_moves, 0
        exact = RULES["exact"]
        self.chains: Chains
        if hasattr(model, "kernel"):
            from inference.compiled_chain import CompiledChains

            kernel = model.kernel(evidence)
            z = kernel.pack({n: v.numpy() for n, v in latents.items()})
            self.chains = CompiledChains(kernel, z, exact, num_moves, 0, seeds, 1)
        else:
            self.chains = BatchedChains(model, evidence, latents, exact, num_moves, 0, shared)
        self.last = {n: v.numpy() for n, v in latents.items()}

    @property
    def heat(self) -> Array:
        """(N,) log likelihood."""
        return self.chains.log_likelihood

    @property
    def evaluations(self) -> int:
        """Of the density, the first states included."""
        return len(self.heat) + int(self.chains.counts[:, EVALUATED].sum())

    @property
    def acceptance(self) -> dict[str, float]:
        """Share of the steps taken, by kind."""
        pairs = zip(self.chains.names, self.chains.counts, strict=True)
        return {name: float(c[ACCEPTED] / c[TRIED]) for name, c in pairs if c[TRIED]}

    def choose(self, index: NDArray[np.int64]) -> None:
        """Replace particle n by particle index[n]."""
        self.chains.choose(index)
        self.last = {n: v[index] for n, v in self.last.items()}

    def move(self, exponent: float) -> None:
        """num_moves reversible-jump steps; of the states they pass, the last is kept."""
        (kept,) = self.chains.advance(self.done, np.full(self.num_moves, 1.0 / exponent))
        self.done += self.num_moves
        self.last = {n: v[:, 0] for n, v in kept.items()}

    def best(self) -> dict[str, NDArray[Any]]:
        """The latents of highest log joint so far, {site: (*event)}."""
        state, _ = self.chains.best()
        return {n: v[0] for n, v in self.chains.unpack([state]).items()}

    def draws(self) -> dict[str, NDArray[Any]]:
        """{site: (N, *event)}."""
        return self.last
