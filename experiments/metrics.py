"""Scores that make sense for any posterior over named sites: (posterior, scene) -> {name: value}.

A unit stands at the end of a name (`_m`, `_rad`, `_sd`), where there is one."""

from __future__ import annotations

import numpy as np

from experiments.scenarios.scene import Scene
from inference.posterior import Posterior
from models.program import InputError


def site_error(posterior: Posterior, scene: Scene) -> dict[str, float]:
    """Root mean square over a site of (posterior mean - truth) / posterior sd, for every real site.

    About 1 where the posterior is calibrated. With an unknown dimension only scalar sites count:
    slots are a set, and their labels mean nothing."""
    scores = {}
    for site in compared_sites(posterior):
        truth = known(scene).get(site)
        if truth is not None and np.shape(truth) == posterior.draws[site].shape[2:]:
            gap = (posterior.mean(site) - truth) / posterior.sd(site)
            scores[f"{site}_error_sd"] = float(np.sqrt(np.mean(np.square(gap))))
    return scores


def compared_sites(posterior: Posterior) -> list[str]:
    """Real-valued sites whose entries mean the same in every draw."""
    fixed = posterior.model_index is None
    return [
        site
        for site, draws in posterior.draws.items()
        if np.issubdtype(draws.dtype, np.floating) and (fixed or draws.ndim == 2)
    ]


def model_probability(posterior: Posterior, scene: Scene, *, dimension: str) -> dict[str, float]:
    """Posterior probability of the true number of active slots, and the most probable number.

    dimension  the site that counts them

    Raises InputError where the truth has no such site or the posterior no model index."""
    if dimension not in known(scene) or posterior.model_index is None:
        raise InputError(
            f"metric model_probability needs a true '{dimension}' and a posterior over it; "
            "leave the metric out for this scenario or engine"
        )
    shares = posterior.model_probabilities()
    best = max(shares, key=lambda index: shares[index])
    return {"true_model_probability": shares.get(int(known(scene)[dimension]), 0.0), f"{dimension}_map": float(best)}


def most_probable_count(posterior: Posterior, scene: Scene, *, dimension: str) -> dict[str, float]:
    """How many slots are probably active, where nobody knows how many there are. Nothing without a model index.

    dimension  the site that counts them

    num_knots_map          most probable number of knots, where one clothoid of a road ends and the next begins
    num_knots_probability  its posterior probability
    """
    if posterior.model_index is None:
        return {}
    shares = posterior.model_probabilities()
    best = max(shares, key=lambda index: shares[index])
    return {f"{dimension}_map": float(best), f"{dimension}_probability": shares[best]}


def known(scene: Scene) -> dict[str, np.ndarray]:
    """The true latents by site; empty where nobody knows."""
    return scene.truth if isinstance(scene.truth, dict) else {}
