"""Named capabilities a model may offer, so that more engines can run on it.

    moves()            involutions for reversible jump
    start(evidence)    a data-driven first state, {site: (*event)}
    kernel(evidence)   a compiled density over a packed state
    squares(evidence)  a compiled sum of squares of normal latents, for least squares without tracing the program
    factors(evidence)  the whitened density factor by factor in machine code, for engines that evaluate batches
    dimension          name of the site that counts the active slots
    labels(evidence)   {site: what people call each of its numbers, with the unit}, for figures and reports
    initial, transition, observe
                       a sequential model frame by frame, for the particle filter (models.unroll makes it one program)
    gaussian_step(state, frame)
                       the same where a state moves by Gaussian steps, for proposals that look at the frame

A move is an involution on (state, auxiliary numbers): (z, u) -> (z', u') and back, with u uniform
on the unit cube. Choices are recycled: u = (k + r) / n picks k of n and keeps r. Then one number,
the Jacobian of the whole map on the cube, is the complete proposal ratio (Green 1995, eq. 7):

    log |d(z', u') / d(z, u)| = log_backward - log_forward + log_jacobian

Moves report the three parts, because the papers' acceptance rules treat them differently: log q of
the step and of its reverse in natural units [rad, m], and the Jacobian of the deterministic map.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from torch import Tensor

from models.program import Latents


class Proposal(NamedTuple):
    """Where a move leads, batched over chains.

    latents       z', {site: (B, *event)}
    uniforms      u', (B, U): the numbers that carry z' back to z
    log_forward   (B,) log q(z -> z'), the choice of the move excluded
    log_backward  (B,) log q(z' -> z)
    log_jacobian  (B,) of the map in natural units
    valid         (B,) False where the step leaves the state space
    """

    latents: Latents
    uniforms: Tensor
    log_forward: Tensor
    log_backward: Tensor
    log_jacobian: Tensor
    valid: Tensor


class Move(NamedTuple):
    """One kind of step: how often it is tried, how many uniform numbers it uses, the involution."""

    name: str
    probability: float
    num_uniforms: int
    propose: Callable[[Latents, Tensor], Proposal]


class HasMoves(Protocol):
    """A program that reversible jump can run on."""

    def __call__(self, evidence: Any) -> None: ...

    def moves(self) -> tuple[Move, ...]: ...


class Kernel(NamedTuple):
    """A compiled density over packed states, for engines that run whole chains in machine code.

    The functions are numba functions with the signatures of `kernel_types`, so that the compiled chain
    is shared by all models and kept in the disk cache. `floats` and `ints` hold the data.

    propose(kind, z, u, floats, ints, z_new, u_new, log_q) -> valid
        the involution of the model's moves; log_q = (forward, backward, jacobian)
    evaluate(z, floats, ints, cache, out)
        out = (log prior, log likelihood); may reuse what the cache holds of the current state
    commit(cache)
        the state evaluated last becomes the current one
    edit(index, z, floats, z_new) -> applies
        edit number `index` of the structure, for a greedy search
    refit(z, floats, ints, cache)
        one Gauss-Newton step of the continuous numbers of the state evaluated last, in place
    """

    move_names: tuple[str, ...]
    probabilities: np.ndarray  # (M,) of the moves
    num_uniforms: int
    size: int  # length of a packed state
    floats: np.ndarray
    ints: np.ndarray
    cache_size: int
    propose: Any
    evaluate: Any
    commit: Any
    pack: Callable[[dict[str, Any]], np.ndarray]  # {site: (B, *event)} -> (B, size)
    unpack: Callable[[np.ndarray], dict[str, np.ndarray]]  # (*batch, size) -> {site: (*batch, *event)}
    edit: Any = None  # where the model has edits
    refit: Any = None
    num_edits: int = 0


def kernel_types() -> dict[str, Any]:
    """The explicit numba types of a kernel's functions: with them a compiled chain that takes the
    functions as arguments is found again in the disk cache."""
    from numba import boolean, float64, int64, types, void

    vector, index = float64[::1], int64[::1]
    return {
        "propose": boolean(int64, vector, vector, vector, index, vector, vector, vector),
        "evaluate": void(vector, vector, index, vector, vector),
        "commit": void(vector),
        "edit": boolean(int64, vector, vector, vector),
        "refit": void(vector, vector, index, vector),
        "vector": vector,
        "index": index,
        "function": types.FunctionType,
    }


@lru_cache
def compiled(function: Any, kind: str) -> Any:
    """A function of a kernel with its explicit signature (`kernel_types`), from the disk cache where possible."""
    import numba

    return numba.njit(kernel_types()[kind], cache=True, error_model="numpy")(function)


@lru_cache
def pointer(function: Any) -> Any:
    """A compiled numba function of one explicit signature as a plain function pointer.

    Passing the function itself to machine code looks its address up at every call, which is slow;
    a pointer is found once."""
    from numba.core.types import WrapperAddressProtocol

    (signature,) = function.nopython_signatures
    result = function.get_compile_result(signature)
    address = result.library.get_pointer_to_function(result.fndesc.llvm_cfunc_wrapper_name)

    class Pointer(WrapperAddressProtocol):
        owner = function  # keeps the machine code alive

        def __wrapper_address__(self) -> int:
            return int(address)

        def signature(self) -> Any:
            return signature

    return Pointer()


class Chart(NamedTuple):
    """A site in numbers z of its own.

    forward     z (*batch, n) -> the site (*batch, n)
    inverse     the site (n,) -> z (n,)
    log_volume  z (*batch, n) -> log |d site / dz| (*batch)
    """

    forward: Callable[[np.ndarray], np.ndarray]
    inverse: Callable[[np.ndarray], np.ndarray]
    log_volume: Callable[[np.ndarray], np.ndarray]


class Squares(NamedTuple):
    """A program of normal latents whose observations are a sum of squares in machine code.

        -log p(z, y) = |(z - loc) / scale|^2 / 2 + cost(z) + const,   z all latents one after the other

    loc, scale  (D,) of the prior
    sites       {site: part of z}, in the order of z
    shapes      {site: shape of its event}
    evaluate    (z, hessian, gradient (D,)) -> cost; fills the Gauss-Newton model of the cost at z: hessian (D, D), or
                (L, P, P) with `blocks`, of which the lower triangles are read
    log_const   of the observations: log p(y | z) = log_const - cost(z)
    charts      {site: Chart} where a site is not z itself: the density above is that of z, whatever its prior is
    blocks      (L, P) for a Hessian that is a sum of L small ones: the latents that meet in each, -1 for none. A plate
                makes such sums, and latents that are in one block only are solved for by themselves, which is quicker
    """

    loc: np.ndarray
    scale: np.ndarray
    sites: dict[str, slice]
    shapes: dict[str, tuple[int, ...]]
    evaluate: Callable[[np.ndarray, np.ndarray, np.ndarray], float]
    log_const: float
    charts: Mapping[str, Chart] = MappingProxyType({})
    blocks: np.ndarray | None = None

    def unpack(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """(*batch, D) to {site: (*batch, *event)}."""
        latents = {n: z[..., part] for n, part in self.sites.items()}
        latents |= {n: chart.forward(latents[n]) for n, chart in self.charts.items()}
        return {n: v.reshape(z.shape[:-1] + self.shapes[n]) for n, v in latents.items()}

    def pack(self, latents: dict[str, Any]) -> np.ndarray:
        """{site: (*event)} to (D,)."""
        z = {n: np.asarray(latents[n], dtype=np.float64).reshape(-1) for n in self.sites}
        z |= {n: chart.inverse(z[n]) for n, chart in self.charts.items()}
        return np.concatenate([z[n] for n in self.sites])

    def dense(self, z: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Cost at z, its whole Hessian (D, D), all blocks in one matrix, and its gradient (D,)."""
        size, gradient = len(self.loc), np.empty(len(self.loc))
        if self.blocks is None:
            hessian = np.empty((size, size))
            cost = self.evaluate(z, hessian, gradient)
        else:
            parts, hessian = np.zeros((*self.blocks.shape, self.blocks.shape[1])), np.zeros((size + 1, size + 1))
            cost = self.evaluate(z, parts, gradient)
            for slots, part in zip(self.blocks, parts, strict=True):
                np.add.at(hessian, np.ix_(slots, slots), np.tril(part) + np.tril(part, -1).T)  # -1: the last row
        lower = np.tril(hessian[:size, :size])
        return cost, lower + np.tril(lower, -1).T, gradient

    def log_volume(self, z: np.ndarray) -> np.ndarray:
        """log |d latents / dz| at z (*batch, D), (*batch)."""
        parts = [chart.log_volume(z[..., self.sites[n]]) for n, chart in self.charts.items()]
        return np.asarray(sum(parts, start=np.zeros(z.shape[:-1])))


@runtime_checkable
class HasSquares(Protocol):
    """A program of normal latents that offers its observations as a compiled sum of squares."""

    def __call__(self, evidence: Any) -> None: ...

    def squares(self, evidence: Any) -> Squares: ...


class Factors(NamedTuple):
    """A whitened density as a product of factors, evaluated for a whole batch.

        log p(z, y) + log |dz / dx| = sum_d log N(x_d; 0, 1) + sum_k f_k(x),   z = T(x) all latents

    evaluate  x (S, D) -> f (S, K)
    gradient  x (S, D) -> (sum_k f_k (S,), its gradient (S, D))
    depends   (K, D) whether factor k may read number d: what Rao-Blackwellisation and blocks go by
    sites     {site: part of x}
    latents   x (*batch, D) -> {site: (*batch, *event)}
    whiten    {site: (*event)} -> x (D,)
    """

    evaluate: Callable[[np.ndarray], np.ndarray]
    gradient: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    depends: np.ndarray
    sites: dict[str, slice]
    latents: Callable[[np.ndarray], dict[str, np.ndarray]]
    whiten: Callable[[dict[str, Any]], np.ndarray]


@runtime_checkable
class HasFactors(Protocol):
    """A program that offers its whitened density factor by factor. Where it offers squares too, their numbers are the
    same x: loc 0 and scale 1, or the same order of latents under the same prior."""

    def __call__(self, evidence: Any) -> None: ...

    def factors(self, evidence: Any) -> Factors: ...


class Hyper(NamedTuple):
    """Some settings of a model as unconstrained numbers h (H,), to be learnt from scenes (inference.empirical_bayes).

        log p(h) = sum_i log N(h_i; start_i, width_i^2)     weak: it decides only what no scene says anything about

    names     (H,) of the settings
    start     (H,) as configured
    width     (H,) of the prior
    natural   h -> (H,) the settings as people write them
    model     h -> the program that has them
    complete  (data, {site: (n, *event)}) -> a function h -> log p(z, y | h) (n,), but for what h does not change
    """

    names: tuple[str, ...]
    start: np.ndarray
    width: np.ndarray
    natural: Callable[[np.ndarray], np.ndarray]
    model: Callable[[np.ndarray], Any]
    complete: Callable[[Any, dict[str, np.ndarray]], Callable[[np.ndarray], np.ndarray]]


State = Latents  # of a sequential model: name -> (*batch, *event)


@runtime_checkable
class HasSteps(Protocol):
    """A sequential model: a state that moves from frame to frame and is seen in each.

        p(z, y) = p(z_0) prod_t p(z_t | z_(t-1)) prod_t p(y_t | z_t)

    Each part is a program fragment, batched over leading dimensions. `initial` and `transition` sample sites and return
    the state, by the names that reports show; `observe` has the observed sites, and no latent ones. A frame is a
    NamedTuple whose fields are named as the sites they observe; None simulates. What a step needs to know of the world
    between two frames (how long, how far) is in the later frame."""

    def initial(self, frame: Any) -> State: ...

    def transition(self, state: State, frame: Any) -> State: ...

    def observe(self, state: State, frame: Any) -> None: ...


class GaussianStep(NamedTuple):
    """How N states come to a frame, and what it says of a state, in packed numbers z (D,).

        z | previous state n ~ N(mean_n, tril tril^T),   -d2 log p(y | z) / dz2 ~ information

    mean     (N, D); (1, D) at the first frame
    tril     (D, D) the same for all, and singular where numbers stand still
    density  z (S, D) -> log p(y | z) (S,)
    slopes   z (D,) -> log p(y | z), its gradient (D,), information (D, D), positive semidefinite (Gauss-Newton's)
    state    z (S, D) -> the state (S, *event)
    """

    mean: np.ndarray
    tril: np.ndarray
    density: Callable[[np.ndarray], np.ndarray]
    slopes: Callable[[np.ndarray], tuple[float, np.ndarray, np.ndarray]]
    state: Callable[[np.ndarray], State]


@runtime_checkable
class HasGaussianSteps(Protocol):
    """A sequential model whose state moves by Gaussian steps; the first has no previous state (None)."""

    def gaussian_step(self, state: State | None, frame: Any) -> GaussianStep: ...
