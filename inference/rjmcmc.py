"""Reversible-jump Markov chain Monte Carlo over models with slots, a mask and moves (Green 1995).

A move maps (z, u), u uniform on the unit cube, to (z', u') and back; inference.acceptance says when the step is
taken. Two paths run the same moves: a model with a kernel runs whole chains in machine code, any other program runs
all chains in a batch. The warm-up may be annealed: temperatures fall geometrically to one. Chains may be resampled
between themselves while they anneal, with weights p(y|z)^(1/T' - 1/T), T' a block of steps ahead: chains in poor
modes die out.
"""

from __future__ import annotations

import time
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from inference import weights
from inference.acceptance import RULES, log_acceptance
from inference.posterior import Posterior, Snapshots
from inference.progress import Progress, announce
from inference.refusal import accept, answers_first
from models.capability import HasMoves, Move
from models.program import InputError, Latents, quiet_doubles, simulate, terms, total

Array = NDArray[Any]
TRIED, EVALUATED, ACCEPTED = range(3)
BLOCK = 500  # steps between snapshots, resampling and progress


class State(NamedTuple):
    """States of all chains: latents {site: (B, ...)}, log prior (B,), log likelihood (B,)."""

    latents: Latents
    log_prior: Tensor
    log_likelihood: Tensor


def init(model: HasMoves, latents: Latents, evidence: Any) -> State:
    """A state from latents {site: (B, ...)}."""
    parts = terms(model, latents, evidence)
    batch = next(iter(latents.values())).shape[:1]
    return State(latents, total(parts.prior).expand(batch), total(parts.likelihood).expand(batch))


def step(
    model: HasMoves, move: Move, state: State, evidence: Any, u: Tensor, log_u: Tensor, rule: int, temperature: float
) -> tuple[State, Tensor, Tensor]:
    """One Metropolis-Hastings-Green step of all chains: (state, accepted (B,), valid (B,)).

    u (B, U) drives the move, log_u (B,) the acceptance."""
    with quiet_doubles():
        proposal = move.propose(state.latents, u)
    stay = ~proposal.valid
    latents = {n: _choose(stay, state.latents[n], proposal.latents[n]) for n in state.latents}
    new = init(model, latents, evidence)
    chance = float(np.log(move.probability))
    log_ratio = log_acceptance(
        rule,
        temperature,
        new.log_prior - state.log_prior,
        new.log_likelihood - state.log_likelihood,
        proposal.log_forward + chance,
        proposal.log_backward + chance,
        proposal.log_jacobian,
    )
    accepted = proposal.valid & (log_u < log_ratio)
    latents = {n: _choose(accepted, latents[n], state.latents[n]) for n in latents}
    log_prior = torch.where(accepted, new.log_prior, state.log_prior)
    log_likelihood = torch.where(accepted, new.log_likelihood, state.log_likelihood)
    return State(latents, log_prior, log_likelihood), accepted, proposal.valid


def _choose(where: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(where.reshape(-1, *[1] * (old.dim() - 1)), new, old)


class Chains(Protocol):
    """All chains of a run, on either path."""

    names: tuple[str, ...]

    @property
    def log_likelihood(self) -> Array: ...
    @property
    def log_joint(self) -> Array: ...
    @property
    def counts(self) -> Array: ...
    def advance(self, first: int, temperatures: Array) -> list[dict[str, Array]]: ...
    def choose(self, index: Array) -> None: ...
    def best(self) -> tuple[Any, float]: ...
    def unpack(self, states: list[Any]) -> dict[str, Array]: ...


class BatchedChains:
    """All chains side by side through the program; every step draws one move for all of them."""

    def __init__(
        self, model: HasMoves, evidence: Any, latents: Latents, rule: int, thin: int, keep_from: int, seed: Any
    ) -> None:
        self.model, self.evidence, self.moves = model, evidence, model.moves()
        self.rule, self.thin, self.keep_from = rule, thin, keep_from
        self.names = tuple(move.name for move in self.moves)
        self.rng = np.random.default_rng(seed)
        shares = np.array([move.probability for move in self.moves])
        self.shares = shares / shares.sum()
        self.moves = tuple(m._replace(probability=p) for m, p in zip(self.moves, self.shares, strict=True))
        self.counts = np.zeros((len(self.moves), 3))
        self.state = init(model, latents, evidence)
        self.top: tuple[dict[str, Array], float] = ({}, -np.inf)
        self._remember()

    @property
    def log_likelihood(self) -> Array:
        """(C,) of the current states."""
        return self.state.log_likelihood.numpy()

    @property
    def log_joint(self) -> Array:
        """(C,) of the current states."""
        return (self.state.log_prior + self.state.log_likelihood).numpy()

    def _remember(self) -> None:
        chain = int(self.log_joint.argmax())
        if self.log_joint[chain] > self.top[1]:
            state = {n: v[chain].numpy().copy() for n, v in self.state.latents.items()}
            self.top = (state, float(self.log_joint[chain]))

    def advance(self, first: int, temperatures: Array) -> list[dict[str, Array]]:
        """Run all chains on from step `first`; the draws kept, {site: (C, n, *event)}, in a list if any."""
        kept: list[dict[str, Array]] = []
        for i, temperature in enumerate(temperatures, start=first):
            kind = int(self.rng.choice(len(self.moves), p=self.shares))
            move, num_chains = self.moves[kind], len(self.log_joint)
            u = torch.from_numpy(self.rng.random((num_chains, move.num_uniforms)))
            log_u = torch.from_numpy(np.log(self.rng.random(num_chains)))
            arguments = (self.evidence, u, log_u, self.rule, float(temperature))
            self.state, accepted, valid = step(self.model, move, self.state, *arguments)
            self.counts[kind] += num_chains, int(valid.sum()), int(accepted.sum())
            self._remember()
            if i >= self.keep_from and (i - self.keep_from) % self.thin == self.thin - 1:
                kept.append({n: v.numpy().copy() for n, v in self.state.latents.items()})
        return [{n: np.stack([k[n] for k in kept], 1) for n in kept[0]}] if kept else []

    def choose(self, index: Array) -> None:
        """Replace chain c by chain index[c]."""
        chosen = {n: v[index] for n, v in self.state.latents.items()}
        self.state = State(chosen, self.state.log_prior[index], self.state.log_likelihood[index])

    def best(self) -> tuple[dict[str, Array], float]:
        """The best state of all chains so far and its log joint."""
        return self.top

    def unpack(self, states: list[dict[str, Array]]) -> dict[str, Array]:
        """{site: (S, *event)} of states from `best`."""
        return {n: np.stack([state[n] for state in states]) for n in states[0]}


def temperatures_of(num_steps: int, warmup: int, start_temperature: float) -> Array:
    """(num_steps,) geometric from start_temperature to 1 along the warm-up, then 1."""
    ladder = np.ones(num_steps)
    if warmup > 0:
        ladder[:warmup] = start_temperature ** (1.0 - np.arange(1, warmup + 1) / warmup)
    return ladder


def first_states(model: Any, evidence: Any, init: Latents | None, num_chains: int, seed: int) -> Latents:
    """(num_chains, *event) of every site: `init` repeated, else draws from the prior."""
    if init is None:
        return simulate(model, evidence, num=num_chains, seed=seed)
    tensors = {n: torch.as_tensor(np.asarray(v)) for n, v in init.items()}
    return {n: v.expand((num_chains, *v.shape)).clone() for n, v in tensors.items()}


@answers_first
def run(
    model: HasMoves,
    evidence: Any,
    *,
    seed: int,
    init: Latents | None = None,
    start: Literal["prior", "data"] = "prior",
    num_chains: int = 4,
    num_steps: int = 5000,
    warmup: int = 1000,
    thin: int = 1,
    acceptance: Literal["exact", "paper", "printed"] = "exact",
    start_temperature: float = 1.0,
    resample: bool = False,
    polish: bool = False,
    path: Literal["auto", "compiled", "batched"] = "auto",
    num_workers: int = 1,
    progress: bool = False,
) -> Posterior:
    """Sample p(z | y); the first `warmup` steps are annealed from start_temperature to 1 and discarded.

    init         {site: value} first state of all chains; without it `start`: draws from the prior, or
                 the model's data-driven start
    thin         keep every thin-th state after the warm-up; warmup = num_steps keeps the last state
    resample     resample chains between themselves while they anneal, every BLOCK steps
    polish       climb greedily from the best state of every chain over edits of the structure; the draws stay
    num_workers  threads of the compiled path; the draws do not depend on it

    Raises InputError where the model lacks moves, a start or a kernel that is asked for."""
    began = time.perf_counter()
    if not hasattr(model, "moves"):
        raise InputError(
            f"rjmcmc needs a model with moves(), but {type(model).__name__} has none; where all its numbers are "
            "continuous, use importance, smc or nuts"
        )
    if start == "data" and init is None and not hasattr(model, "start"):
        raise InputError(
            f"start=data needs a model with start(), but {type(model).__name__} has none; "
            "use start=prior (engine.start=prior on the command line)"
        )
    if path == "compiled" and not hasattr(model, "kernel"):
        raise InputError(f"path=compiled needs a model with kernel(), but {type(model).__name__} has none")
    if acceptance not in RULES:
        raise InputError(f"acceptance must be one of {', '.join(RULES)}, but is '{acceptance}'")
    counts = {"num_chains": num_chains, "num_steps": num_steps, "num_workers": num_workers}
    for name, value in (counts | {"start_temperature": start_temperature}).items():
        if not value >= 1:
            raise InputError(f"{name} is {value}; rjmcmc needs 1 or more")
    if not 0 <= warmup <= num_steps:
        raise InputError(f"warmup is {warmup}; choose 0 to the {num_steps} of num_steps")
    if thin < 1 or thin > max(num_steps - warmup, 1):
        raise InputError(f"thin must be 1 to the {num_steps - warmup} steps after the warm-up, but is {thin}")
    if resample and start_temperature == 1:
        raise InputError("resample=true acts while chains anneal: it needs start_temperature above 1")
    if polish and (path == "batched" or not hasattr(model, "kernel")):
        raise InputError(f"polish=true needs the compiled path, which {type(model).__name__} does not run on here")
    if init is not None:
        _check_init(model, evidence, init)
    elif start == "data":
        init = model.start(evidence)  # type: ignore[attr-defined]
    entropy, shared, *seeds = np.random.SeedSequence(seed).spawn(num_chains + 2)
    latents = first_states(model, evidence, init, num_chains, int(entropy.generate_state(1)[0]))
    keep_from = min(warmup, num_steps - 1)
    chains: Chains
    climb = None
    if path != "batched" and hasattr(model, "kernel"):
        with announce(f"compiling the sampler for {type(model).__name__}"):
            from inference.compiled_chain import CompiledChains
            from inference.polish import compiled_climb

            kernel = model.kernel(evidence)
            if polish and kernel.refit is None:
                raise InputError("polish=true needs a kernel with edits and a refit, but this model's has none")
            accept()
            z = kernel.pack({n: v.numpy() for n, v in latents.items()})
            compiled = CompiledChains(kernel, z, RULES[acceptance], thin, keep_from, seeds, num_workers)
            chains, climb = compiled, compiled.polish
            if polish:
                compiled_climb()  # now, so that it is not timed with the chains
    else:
        accept()
        chains = BatchedChains(model, evidence, latents, RULES[acceptance], thin, keep_from, shared)
    _check_start(chains)
    rng = np.random.default_rng(shared.spawn(1)[0])
    ladder = temperatures_of(num_steps, warmup, start_temperature)
    draws, shots = [], [_snapshot(chains, 0, began)]
    with Progress("reversible jump", num_steps, progress) as bar:
        for first in range(0, num_steps, BLOCK):
            part = ladder[first : first + BLOCK]
            draws += chains.advance(first, part)
            last = first + len(part)
            if resample and last < warmup:
                heat = 1.0 / ladder[min(last + BLOCK, num_steps) - 1] - 1.0 / part[-1]
                tempered = chains.log_joint if acceptance == "paper" else chains.log_likelihood
                chains.choose(weights.systematic(heat * tempered, num_chains, rng.random()))
            shots.append(_snapshot(chains, last, began))
            bar.advance(len(part))
    if polish and climb is not None:
        climb()
        shots.append(_snapshot(chains, num_steps, began))
    return _posterior(model, chains, draws, shots, time.perf_counter() - began)


def _check_init(model: Any, evidence: Any, init: Latents) -> None:
    sites = simulate(model, evidence, num=1, seed=0).keys()
    if init.keys() != sites:
        raise InputError(f"init must give a value to each of {sorted(sites)}, but gives {sorted(init)}")


def _check_start(chains: Chains) -> None:
    bad = np.flatnonzero(~np.isfinite(chains.log_joint))
    if len(bad):
        raise InputError(
            f"chain {bad[0]} starts where the density is {np.exp(chains.log_joint[bad[0]])}; give another init"
        )


def _snapshot(chains: Chains, step: int, began: float) -> tuple[int, float, float, Any]:
    state, joint = chains.best()
    return step, time.perf_counter() - began, joint, state


def _posterior(model: Any, chains: Chains, draws: list[Any], shots: list[Any], seconds: float) -> Posterior:
    joined = {n: np.concatenate([d[n] for d in draws], 1) for n in draws[0]}
    counts = chains.counts
    used = counts[:, TRIED] > 0
    acceptance = {
        name: float(c[ACCEPTED] / max(c[TRIED], 1)) for name, c, u in zip(chains.names, counts, used, strict=True) if u
    }
    states = chains.unpack([shot[3] for shot in shots])
    steps, times, joints = (np.array([shot[k] for shot in shots]) for k in range(3))
    dimension = getattr(model, "dimension", None)
    return Posterior(
        draws=joined,
        model_index=joined[dimension] if dimension else None,
        estimate={n: values[-1] for n, values in states.items()},
        info={
            "engine": "rjmcmc",
            "seconds": seconds,
            "evaluations": int(counts[:, EVALUATED].sum()),  # of the chains, the greedy search not counted
            "invalid_share": float(1 - counts[:, EVALUATED].sum() / counts[:, TRIED].sum()),
            "acceptance": acceptance,
            "log_joint": chains.best()[1],
        },
        snapshots=Snapshots(steps, times, joints, states),
    )
