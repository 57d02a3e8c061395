"""A kerb with a driveway, simulated from the model itself."""

import torch

from curb_height.model import CurbHeight, Profile
from experiments.scenarios.scene import Scene
from models.program import fix, observe, simulate


def driveway(seed: int = 0, num: int = 80, begin: float = 15.0, lowered: int = 1) -> Scene:
    """`num` measured heights of a kerb, lowered from `begin` [m] on if `lowered` is 1."""
    blank = Profile(torch.linspace(0.0, 40.0, num, dtype=torch.float64), None)
    fixed = {"begin": torch.tensor(begin, dtype=torch.float64), "lowered": torch.tensor(lowered)}
    draw = simulate(fix(CurbHeight(), **fixed), blank, num=1, seed=seed)
    data, truth = observe(blank, {name: value[0] for name, value in draw.items()} | fixed)
    return Scene(data, {name: value.numpy() for name, value in truth.items()}, "driveway", {"seed": seed})
