"""Snapshots of engines whose own densities are whitened: the program says what the states are worth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from inference.posterior import Snapshots
from models.program import Model, log_joint


def snapshots(
    model: Model, evidence: Any, steps: Sequence[int], seconds: Sequence[float], states: dict[str, np.ndarray]
) -> Snapshots:
    """States {site: (S, *event)} with their log joint; those that stay the same are evaluated once.

    One by one: in a program with plates a global latent has no place for a flat batch."""
    heights = list[float]()
    for i in range(len(steps)):
        same = i > 0 and all(np.array_equal(v[i], v[i - 1]) for v in states.values())
        row = {name: torch.as_tensor(value[i]) for name, value in states.items()}
        heights.append(heights[-1] if same else float(log_joint(model, row, evidence)))
    return Snapshots(np.array(steps), np.array(seconds), np.array(heights), states)
