"""Any model as a whitened product of factors (models.capability.Factors), for engines that evaluate batches.

A model with factors() hands over its compiled ones; a compiled sum of squares is one factor (inference.squared). Any
other program is read through models.whitening.bind: one factor for each observed site, which may depend on every
number; values and gradients come from torch. Where torch cannot see through a compiled density, gradients are central
differences, at the price of 2 D values.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from inference.squared import squared
from models.capability import Factors, HasFactors, HasSquares
from models.program import Latents, Model
from models.whitening import Bound, bind

Array = NDArray[np.float64]
DIFFERENCE = 1e-4  # step of central differences, in standard deviations of the prior


def factored(model: Model, evidence: Any) -> Factors:
    """The factors of a model given its evidence.

    Raises InputError by name for a latent that no map of normal numbers reaches, such as a discrete one."""
    if isinstance(model, HasFactors):
        return model.factors(evidence)
    if isinstance(model, HasSquares):
        return squared(model.squares(evidence))
    bound = bind(model, evidence)
    ends = np.cumsum([0, *(shape.numel() for shape in bound.shapes.values())])
    sites = {name: slice(int(a), int(b)) for name, a, b in zip(bound.shapes, ends[:-1], ends[1:], strict=True)}
    width = len(bound.log_likelihoods(torch.zeros(1, bound.size, dtype=torch.float64)))

    def columns(x: Tensor) -> Tensor:  # (S, K)
        heights = [f.expand(len(x)) for f in bound.log_likelihoods(x).values()]
        return torch.stack(heights, -1) if heights else x.new_zeros((len(x), 0))

    def evaluate(x: Array) -> Array:
        with torch.no_grad():
            return columns(torch.from_numpy(x)).numpy()

    def gradient(x: Array) -> tuple[Array, Array]:
        at = torch.from_numpy(x).clone().requires_grad_()
        height = columns(at).sum(-1)
        (slope,) = torch.autograd.grad(height.sum(), at)
        return height.detach().numpy(), slope.numpy()

    def differences(x: Array) -> tuple[Array, Array]:
        steps = DIFFERENCE * np.concatenate([np.eye(bound.size), -np.eye(bound.size)])
        around = evaluate((x[:, None] + steps).reshape(-1, bound.size)).sum(-1).reshape(len(x), 2, bound.size)
        return evaluate(x).sum(-1), (around[:, 0] - around[:, 1]) / (2.0 * DIFFERENCE)

    def latents(x: Array) -> dict[str, Array]:
        flat = torch.from_numpy(np.ascontiguousarray(x).reshape(-1, bound.size))
        found = bound.latents(flat)
        return {n: v.reshape((*x.shape[:-1], *bound.shapes[n])).detach().numpy() for n, v in found.items()}

    def whiten(state: dict[str, Any]) -> Array:
        values: Latents = {n: torch.as_tensor(state[n], dtype=torch.float64) for n in bound.shapes}
        return bound.whiten(values).numpy()

    depends = np.ones((width, bound.size), dtype=bool)
    slope = gradient if _is_seen_through(bound) else differences
    return Factors(evaluate, slope, depends, sites, latents, whiten)


def _is_seen_through(bound: Bound) -> bool:
    """Whether torch follows the observed densities down to the numbers: each that moves must have a gradient, and one
    must, for torch refuses the gradient of what is constant."""
    first, second = (torch.full((1, bound.size), at, dtype=torch.float64) for at in (0.1, 0.3))
    try:
        here = bound.log_likelihoods(first.requires_grad_())
    except RuntimeError:  # a tensor with gradients has no numpy()
        return False
    there = bound.log_likelihoods(second)
    seen = [f.requires_grad for f in here.values()]
    return any(seen) and all(s or torch.equal(f, there[name]) for s, (name, f) in zip(seen, here.items(), strict=True))
