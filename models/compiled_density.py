"""A compiled log density inside a Pyro distribution: values and first derivatives for torch, second ones refused.

Nothing traces or differentiates through machine code: it hands over its gradient. The derivative of that gradient would
be zero without a word, so asking for it raises.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Floats = NDArray[np.float64]
Evaluate = Callable[[Floats, Floats], tuple[Floats, Floats]]


def compiled_log_prob(numbers: Tensor, value: Tensor, evaluate: Evaluate) -> Tensor:
    """Log density (*B) of value (*B, *event) at numbers (*B, D), differentiable once in the numbers.

    evaluate  (numbers (S, D), one value (*event)) -> (log density (S,), its gradient (S, D)); called once where all
              values are the same one expanded, else row by row"""
    return _LogProb.apply(numbers, value, evaluate)  # type: ignore[no-any-return]


class _LogProb(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, numbers: Tensor, value: Tensor, evaluate: Evaluate) -> Tensor:
        rows = np.ascontiguousarray(numbers.detach().reshape(-1, numbers.shape[-1]).numpy())
        batch = numbers.dim() - 1
        seen = value.detach().reshape(len(rows), *value.shape[batch:])
        if all(step == 0 for step in value.stride()[:batch]):
            height, slope = evaluate(rows, seen[0].numpy())
        else:
            parts = [evaluate(rows[i : i + 1], seen[i].numpy()) for i in range(len(rows))]
            height, slope = (np.concatenate(part) for part in zip(*parts, strict=True))
        ctx.save_for_backward(numbers, torch.from_numpy(slope).reshape(numbers.shape))
        return torch.from_numpy(height).reshape(numbers.shape[:-1])

    @staticmethod
    def backward(ctx: Any, height: Tensor) -> tuple[Tensor | None, ...]:
        numbers, slope = ctx.saved_tensors
        return _Slope.apply(height, numbers, slope), None, None


class _Slope(torch.autograd.Function):
    """The gradient, tied to the numbers it belongs to."""

    @staticmethod
    def forward(ctx: Any, height: Tensor, numbers: Tensor, slope: Tensor) -> Tensor:
        return height[..., None] * slope

    @staticmethod
    def backward(ctx: Any, height: Tensor) -> tuple[Tensor | None, ...]:
        raise RuntimeError("this compiled density has first derivatives only; least squares takes them from squares()")
