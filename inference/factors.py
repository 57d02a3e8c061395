"""Any model as a whitened product of factors (models.capability.Factors), for engines that evaluate batches.

A model with factors() hands over its compiled ones. Any other program is read through models.whitening.bind: one
factor for each observed site, which may depend on every number; values and gradients come from torch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.capability import Factors, HasFactors
from models.program import Latents, Model
from models.whitening import bind

Array = NDArray[np.float64]


def factored(model: Model, evidence: Any) -> Factors:
    """The factors of a model given its evidence.

    Raises InputError by name for a latent that no map of normal numbers reaches, such as a discrete one."""
    if isinstance(model, HasFactors):
        return model.factors(evidence)
    bound = bind(model, evidence)
    ends = np.cumsum([0, *(shape.numel() for shape in bound.shapes.values())])
    sites = {name: slice(int(a), int(b)) for name, a, b in zip(bound.shapes, ends[:-1], ends[1:], strict=True)}
    width = len(bound.log_likelihoods(torch.zeros(1, bound.size, dtype=torch.float64)))

    def columns(x: Tensor) -> Tensor:  # (S, K)
        return torch.stack([f.expand(len(x)) for f in bound.log_likelihoods(x).values()], -1)

    def evaluate(x: Array) -> Array:
        with torch.no_grad():
            return columns(torch.from_numpy(x)).numpy()

    def gradient(x: Array) -> tuple[Array, Array]:
        at = torch.from_numpy(x).clone().requires_grad_()
        height = columns(at).sum(-1)
        (slope,) = torch.autograd.grad(height.sum(), at)
        return height.detach().numpy(), slope.numpy()

    def latents(x: Array) -> dict[str, Array]:
        flat = torch.from_numpy(np.ascontiguousarray(x).reshape(-1, bound.size))
        found = bound.latents(flat)
        return {n: v.reshape((*x.shape[:-1], *bound.shapes[n])).detach().numpy() for n, v in found.items()}

    def whiten(state: dict[str, Any]) -> Array:
        values: Latents = {n: torch.as_tensor(state[n], dtype=torch.float64) for n in bound.shapes}
        return bound.whiten(values).numpy()

    depends = np.ones((width, bound.size), dtype=bool)
    return Factors(evaluate, gradient, depends, sites, latents, whiten)
