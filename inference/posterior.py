"""What every engine returns: weighted draws, what was learnt on the way, and a safe file format."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference import weights

Array = NDArray[Any]


class Snapshots(NamedTuple):
    """The best state known along the iterations: what an anytime user would have had.

    step       (S,) iterations done
    seconds    (S,) since the engine started
    log_joint  (S,) of the state
    states     {site: (S, *event)}
    """

    step: Array
    seconds: Array
    log_joint: Array
    states: dict[str, Array]


@dataclass(frozen=True)
class Posterior:
    """Weighted draws of the latents.

    draws         {site: (chain, draw, *event)}
    log_weights   (chain, draw), unnormalised; None where all are equal
    log_evidence  log p(data), None where the engine has no estimate
    model_index   (chain, draw) the logical model where the dimension is unknown
    estimate      {site: (*event)} the best single state (highest log joint seen)
    info          evaluations, seconds, acceptance by move, flags: plain numbers, strings, lists
    snapshots     along the iterations, None where the engine keeps none
    labels        {site: what people call each of its numbers, with the unit}, where the model says so
    """

    draws: dict[str, Array]
    log_weights: Array | None = None
    log_evidence: float | None = None
    model_index: Array | None = None
    estimate: dict[str, Array] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    snapshots: Snapshots | None = None
    labels: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, int]:
        """(chains, draws)."""
        first = next(iter(self.draws.values()))
        return first.shape[0], first.shape[1]

    def title(self, site: str, index: tuple[int, ...] = ()) -> str:
        """What people call a number of a site; 'site[i]' where nobody says."""
        if site not in self.labels:
            return site + (str(list(index)) if index else "")
        return self.labels[site][int(np.ravel_multi_index(index, self.draws[site].shape[2:])) if index else 0]

    @property
    def weights(self) -> Array:
        """(chain, draw), summing to one."""
        if self.log_weights is None:
            return np.full(self.shape, 1.0 / np.prod(self.shape))
        return weights.normalise(self.log_weights)

    def _weights_like(self, values: Array) -> Array:
        return self.weights.reshape(self.shape + (1,) * (values.ndim - 2))

    def mean(self, site: str) -> Array:
        """Posterior mean of a site, (*event)."""
        values = self.draws[site]
        return np.asarray((values * self._weights_like(values)).sum((0, 1)))

    def sd(self, site: str) -> Array:
        """Posterior standard deviation of a site, (*event)."""
        values = self.draws[site]
        mean = Posterior.mean(self, site)  # Tracks call the means of their states so
        return np.sqrt((np.square(values - mean) * self._weights_like(values)).sum((0, 1)))

    def quantile(self, site: str, q: float) -> Array:
        """Weighted quantile of a site, (*event)."""
        values = self.draws[site].reshape((-1, *self.draws[site].shape[2:]))
        order = np.argsort(values, axis=0)
        shares = self.weights.reshape((-1,) + (1,) * (values.ndim - 1))
        ladder = np.cumsum(np.take_along_axis(np.broadcast_to(shares, values.shape), order, 0), 0)
        first = np.minimum((ladder < q).sum(0), len(values) - 1)[None]
        return np.take_along_axis(np.take_along_axis(values, order, 0), first, 0)[0]

    def resample(self, num: int, seed: int) -> dict[str, Array]:
        """Equally weighted draws, {site: (num, *event)}."""
        uniform = np.random.default_rng(np.random.SeedSequence(seed)).random()
        log_weights = np.zeros(self.shape) if self.log_weights is None else self.log_weights
        index = weights.systematic(log_weights, num, uniform)
        return {site: v.reshape((-1, *v.shape[2:]))[index] for site, v in self.draws.items()}

    def model_probabilities(self) -> dict[int, float]:
        """Posterior probability of each logical model visited."""
        if self.model_index is None:
            raise ValueError("this posterior has one model only: its model_index is None")
        keys, inverse = np.unique(self.model_index, return_inverse=True)
        shares = np.bincount(inverse.reshape(-1), weights=self.weights.reshape(-1))
        return {int(k): float(s) for k, s in zip(keys, shares, strict=True)}

    def given(self, model: int) -> Posterior:
        """The draws of one logical model as a single chain; ArviZ cannot take a changing dimension."""
        if self.model_index is None or not bool((self.model_index == model).any()):
            raise ValueError(f"no draw has model index {model}; visited: {list(self.model_probabilities())}")
        keep = self.model_index == model
        return Posterior(
            draws={site: values[keep][None] for site, values in self.draws.items()},
            log_weights=None if self.log_weights is None else self.log_weights[keep][None],
            model_index=self.model_index[keep][None],
            info=self.info,
        )

    def to_arviz(self) -> Any:
        """ArviZ InferenceData (imported only here: it takes seconds)."""
        import arviz

        groups: dict[str, Any] = {"posterior": self.draws}
        if self.log_weights is not None:
            groups["sample_stats"] = {"log_weight": self.log_weights}
        return arviz.from_dict(**groups)

    def save(self, folder: Path) -> None:
        """Write posterior.npz (arrays) and posterior.json (the rest) into a folder."""
        arrays, rest = self._contents()
        np.savez_compressed(folder / "posterior.npz", allow_pickle=False, **arrays)
        (folder / "posterior.json").write_text(json.dumps(rest, indent=2, default=_plain))

    def _contents(self) -> tuple[dict[str, Array], dict[str, Any]]:
        """The arrays by their names in posterior.npz, and what goes into posterior.json."""
        arrays: dict[str, Array] = {f"draws/{k}": v for k, v in self.draws.items()}
        arrays |= {f"estimate/{k}": v for k, v in self.estimate.items()}
        if self.log_weights is not None:
            arrays["log_weights"] = self.log_weights
        if self.model_index is not None:
            arrays["model_index"] = self.model_index
        if self.snapshots is not None:
            s = self.snapshots
            arrays |= {"snapshots.step": s.step, "snapshots.seconds": s.seconds, "snapshots.log_joint": s.log_joint}
            arrays |= {f"snapshots/{k}": v for k, v in s.states.items()}
        return arrays, {"log_evidence": self.log_evidence, "info": self.info, "labels": self.labels}

    @staticmethod
    def load(folder: Path) -> Posterior:
        """Read what `save` wrote; no pickle is ever opened."""
        return Posterior(**fields_of(*stored(folder)))


def stored(folder: Path) -> tuple[dict[str, Array], dict[str, Any]]:
    """The arrays of posterior.npz and the content of posterior.json; no pickle is ever opened."""
    rest = json.loads((folder / "posterior.json").read_text())
    with np.load(folder / "posterior.npz", allow_pickle=False) as file:
        return dict(file), rest


def fields_of(arrays: dict[str, Array], rest: dict[str, Any]) -> dict[str, Any]:
    """The fields of a Posterior out of what was stored."""
    snapshots = None
    if "snapshots.step" in arrays:
        step, seconds, log_joint = (arrays[f"snapshots.{name}"] for name in ("step", "seconds", "log_joint"))
        snapshots = Snapshots(step, seconds, log_joint, part_of(arrays, "snapshots/"))
    return {
        "draws": part_of(arrays, "draws/"),
        "log_weights": arrays.get("log_weights"),
        "log_evidence": rest["log_evidence"],
        "model_index": arrays.get("model_index"),
        "estimate": part_of(arrays, "estimate/"),
        "info": rest["info"],
        "snapshots": snapshots,
        "labels": {site: tuple(names) for site, names in rest.get("labels", {}).items()},
    }


def part_of(arrays: dict[str, Array], head: str) -> dict[str, Array]:
    """The arrays whose names begin so, without that beginning."""
    return {name.removeprefix(head): values for name, values in arrays.items() if name.startswith(head)}


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)
