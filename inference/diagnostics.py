"""How far the draws of an engine can be trusted.

R-hat compares chains (Vehtari et al. 2021; 1.01 is their threshold), the effective sample size counts
independent draws, and the standard error of a mean is sd / sqrt(ESS). ArviZ computes them and is
imported only here, in use: the import takes seconds.

Where the dimension is unknown, the coordinates of slots mean different things in different draws:
only the model index and scalar sites are measured then.
"""

from __future__ import annotations

import warnings
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from inference import weights
from inference.posterior import Posterior

Array = NDArray[np.float64]

MODEL_INDEX = "model_index"
MIN_DRAWS = 4  # of a chain; halves of fewer have no variance, and R-hat and ESS are NaN


def scalars(posterior: Posterior) -> dict[str, Array]:
    """Scalars whose meaning is the same in every draw, {"site" or "site[i]": (chain, draw)}.

    The model index stands under its own name only where it is not one of the sites."""
    columns: dict[str, Array] = {}
    if posterior.model_index is not None and not _is_site(posterior.model_index, posterior):
        columns[MODEL_INDEX] = posterior.model_index.astype(np.float64)
    for site, values in posterior.draws.items():
        if values.ndim == 2:
            columns[site] = values.astype(np.float64)
        elif posterior.model_index is None:
            for index in np.ndindex(values.shape[2:]):
                columns[f"{site}{list(index)}"] = values[(..., *index)].astype(np.float64)
    return columns


def _is_site(index: Array, posterior: Posterior) -> bool:
    return any(values.ndim == 2 and np.array_equal(values, index) for values in posterior.draws.values())


def summary(posterior: Posterior) -> dict[str, dict[str, float]]:
    """{scalar: mean, sd, r_hat, ess_bulk, mcse}; r_hat is NaN for one chain or weighted draws.

    Weighted draws are taken as independent: their ESS is Kish's, (sum w)^2 / sum w^2."""
    table = {}
    for label, values in scalars(posterior).items():
        mean = float((values * posterior.weights).sum())
        sd = float(np.sqrt((np.square(values - mean) * posterior.weights).sum()))
        row = {"mean": mean, "sd": sd, "r_hat": float("nan")}
        if posterior.log_weights is None:
            row |= {"r_hat": r_hat(values), "ess_bulk": _ess(values), "mcse": standard_error(values)}
        else:
            size = weights.effective_size(posterior.log_weights)
            row |= {"ess_bulk": size, "mcse": sd / size**0.5}
        table[label] = row
    return table


def flags(posterior: Posterior, *, max_r_hat: float = 1.01, min_ess: float = 400.0) -> list[str]:
    """What speaks against the draws, in words: the engine's own flags first, then R-hat and ESS.

    Where the chains of a scalar disagree, its ESS is not told: the standard error would mislead."""
    found = list(posterior.info.get("flags", []))
    num_chains, num_draws = posterior.shape[:2]
    if num_draws < MIN_DRAWS:
        few = f"only {num_draws} draw{'s' if num_draws > 1 else ''} a chain"
        return [*found, f"{few}: convergence cannot be judged; keep at least {MIN_DRAWS}"]
    for label, row in summary(posterior).items():
        if row["sd"] == 0.0:
            continue  # a constant has neither R-hat nor ESS
        if row["r_hat"] > max_r_hat:
            value = _above(row["r_hat"], max_r_hat)
            found.append(
                f"r_hat of '{label}' is {value} over {num_chains} chains (above {max_r_hat}): "
                "the chains disagree; run longer, or start and anneal them better"
            )
        elif not row["ess_bulk"] >= min_ess:  # NaN too
            found.append(
                f"'{label}' has {row['ess_bulk']:.0f} effective draws (below {min_ess:.0f}): "
                f"its mean is known to {row['mcse']:.2g}; run longer if that is not enough"
            )
    return found


def _above(value: float, limit: float) -> str:
    """A value above a limit with three digits, or as many as show that it is above."""
    return next(text for digits in range(3, 18) if float(text := f"{value:.{digits}g}") > limit)


def r_hat(draws: Array) -> float:
    """Rank-normalised split R-hat of draws (chain, draw); NaN for a single chain and for constants.

    Infinite where every half of a chain stands still, but not all at the same value."""
    if draws.shape[0] == 1 or np.ptp(draws) == 0:
        return float("nan")
    half = draws.shape[1] // 2
    if half and not np.ptp(draws[:, :half], axis=1).any() and not np.ptp(draws[:, -half:], axis=1).any():
        return float("inf")  # 0 / 0 to ArviZ, or a huge number by rounding
    return _quietly("rhat", draws)


def standard_error(draws: Array) -> float:
    """Standard error of the mean of draws (chain, draw), autocorrelation included."""
    return _quietly("mcse", np.asarray(draws, dtype=np.float64), method="mean")


def model_probabilities(posterior: Posterior) -> dict[int, tuple[float, float]]:
    """{model: (probability, its standard error)} of unweighted draws over every model visited."""
    shares = posterior.model_probabilities()
    assert posterior.model_index is not None
    return {k: (share, standard_error(posterior.model_index == k)) for k, share in shares.items()}


def _ess(draws: Array) -> float:
    return _quietly("ess", draws, method="bulk")


def _quietly(name: str, draws: Array, **options: str) -> float:
    """A statistic of ArviZ; chains that stand still are no news, so numpy says nothing of 0 / 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.squeeze(getattr(_arviz(), name)(draws, **options)))


def _arviz() -> ModuleType:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # the announcement of version 1
        import arviz
    return arviz
