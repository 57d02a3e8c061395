"""A road that forks or that another joins: its density, its moves, and that both are right."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from experiments.scenarios.road import night_road
from models.program import Latents, simulate
from models.road.along_fork import Fork, both_courses, sampled_courses
from models.road.fork import ForkedRoad
from tests.involution import assert_involution, uniforms

Floats = NDArray[np.float64]
MODEL = ForkedRoad()
EVIDENCE = MODEL.prepare(night_road(6).data)
MOVES = {move.name: move for move in MODEL.moves()}


def prior(num: int, seed: int = 0, **values: Any) -> Latents:
    """Draws of the prior, some sites at given values."""
    draws = simulate(MODEL, EVIDENCE, num=num, seed=seed)
    return draws | {n: torch.full_like(draws[n], v) for n, v in values.items()}


def fork_of(z: Latents) -> Fork:
    return Fork(*(z[name] for name in Fork._fields))


def test_tables_are_the_courses_as_torch_evaluates_them() -> None:
    """Cumulative Simpson against Gauss-Legendre quadrature."""
    for joins in (0, 1):
        fork = fork_of(prior(200, num_courses=2, joins=joins))
        arc = torch.linspace(0.0, MODEL.road.prior.length, MODEL.road.num_samples, dtype=torch.float64)
        for table, points in zip(sampled_courses(MODEL, fork), both_courses(MODEL, fork, arc), strict=True):
            np.testing.assert_allclose(table[..., 0], points.x, atol=2e-4)
            np.testing.assert_allclose(table[..., 1], points.y, atol=2e-4)
            np.testing.assert_allclose(table[..., 2], points.heading, atol=1e-9)
            np.testing.assert_allclose(table[..., 5], points.curvature, atol=1e-12)


@pytest.mark.parametrize("name", MOVES)
def test_moves_are_involutions_with_the_jacobian_they_report(name: str) -> None:
    z, move = prior(60, seed=1), MOVES[name]
    assert_involution(move, z, uniforms(move, 60, seed=2), relative=1e-8)
