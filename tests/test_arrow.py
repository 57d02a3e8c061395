"""Arrow factors: the same step, determinant, variances and draws as the dense Hessian has."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.junction_lanes import default
from experiments.scenarios.protocol import protocol
from inference.arrow import arrow, colour, factorise, half_log_determinant, solve, squared_norm, variances
from inference.squares import minimise
from tests.small_lanes import true_routes

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class Problem(NamedTuple):
    """Blocks (L, P) of latents with a Hessian (L, P, P), scales and a gradient (D,)."""

    blocks: Ints
    hessian: Array
    scale: Array
    gradient: Array


def random_problem(blocks: list[list[int]], size: int) -> Problem:
    """Upper triangles are wrong on purpose."""
    rng, slots = np.random.default_rng(3), np.array(blocks)
    slopes = rng.standard_normal((*slots.shape, 2 * slots.shape[1]))
    hessian = np.tril(slopes @ slopes.swapaxes(1, 2)) + np.triu(np.full(slots.shape[1:] * 2, 99.0), 1)
    return Problem(slots, hessian, rng.uniform(0.2, 3.0, size), rng.standard_normal(size))


def lanes() -> Problem:
    """A junction of the protocol, at its priors' middles."""
    courses = default().courses
    squares = courses.squares(courses.prepare(true_routes(protocol(5))))
    assert squares.blocks is not None
    hessian, gradient = np.empty((*squares.blocks.shape, squares.blocks.shape[1])), np.empty(len(squares.loc))
    squares.evaluate(squares.loc, hessian, gradient)
    return Problem(squares.blocks, hessian, squares.scale, gradient)


PROBLEMS = {
    "two local, three shared": random_problem([[0, 7, 8, 1], [2, 9, 3, 8], [9, 4, 7, 5]], 10),
    "ragged": random_problem([[0, 1, 2, -1], [-1, 5, 2, 3], [3, 2, 4, 6]], 8),  # 7 is in no block
    "nothing shared": random_problem([[0, 1], [3, 2]], 4),
    "nothing local": random_problem([[0, 1, 2], [2, 0, 1]], 3),
    "twice in a block": random_problem([[0, 4, 1, 4], [2, 3, 4, 5], [5, 6, 3, 5]], 7),
    "lanes": lanes(),
}
EACH = pytest.mark.parametrize("name", PROBLEMS)


def dense(problem: Problem, damping: float = 0.0) -> Array:
    """H + damping diag H."""
    blocks, hessian, scale, _ = problem
    total = np.zeros((len(scale), len(scale)))
    for slots, block in zip(blocks, hessian, strict=True):
        whole, used = np.tril(block) + np.tril(block, -1).T, slots >= 0
        np.add.at(total, np.ix_(slots[used], slots[used]), whole[np.ix_(used, used)])
    total = np.eye(len(scale)) + scale[:, None] * total * scale
    return np.asarray(total + damping * np.diag(total.diagonal()))


@EACH
@pytest.mark.parametrize("damping", [0.0, 0.7])
def test_factor_does_what_the_dense_hessian_does(name: str, damping: float) -> None:
    """Step, norm, determinant, variances, and the covariance of draws: F^-T I gives all of F^-T F^-1."""
    problem = PROBLEMS[name]
    size, whole = len(problem.scale), dense(problem, damping)
    factor = factorise(arrow(problem.blocks, size), problem.hessian, problem.scale, damping)
    inverse = np.linalg.inv(whole)
    close = {"rtol": 1e-9, "atol": 1e-11 * float(np.abs(inverse).max())}
    np.testing.assert_allclose(factor.diagonal, dense(problem).diagonal(), rtol=1e-12)
    np.testing.assert_allclose(solve(factor, problem.gradient), inverse @ problem.gradient, atol=1e-9)
    assert squared_norm(factor, problem.gradient) == pytest.approx(problem.gradient @ inverse @ problem.gradient)
    assert half_log_determinant(factor) == pytest.approx(0.5 * np.linalg.slogdet(whole)[1], rel=1e-12)
    np.testing.assert_allclose(variances(factor), inverse.diagonal(), **close)
    roots = colour(factor, np.eye(size))
    np.testing.assert_allclose(roots.T @ roots, inverse, **close)


@pytest.mark.parametrize("blocks", [[[0, 1, 2, 3]], None])
def test_a_dense_hessian_is_one_block(blocks: list[list[int]] | None) -> None:
    problem = random_problem([[0, 1, 2, 3]], 4)
    factor = factorise(arrow(None if blocks is None else np.array(blocks), 4), problem.hessian, problem.scale)
    np.testing.assert_allclose(solve(factor, problem.gradient), np.linalg.solve(dense(problem), problem.gradient))
    np.testing.assert_allclose(variances(factor), np.linalg.inv(dense(problem)).diagonal())


def test_lanes_share_what_arms_have() -> None:
    """Ten numbers of every lane are its own: two advances, two handles and six controls of its wave."""
    problem = PROBLEMS["lanes"]
    shape = arrow(problem.blocks, len(problem.scale))
    assert np.all(shape.counts[:, 0] == 10)
    assert len(shape.shared) == len(problem.scale) - 10 * len(problem.blocks)


@pytest.mark.parametrize("where", [0, 1])
def test_numbers_that_are_not_finite_are_refused(where: int) -> None:
    """Local or shared."""
    problem = PROBLEMS["two local, three shared"]
    broken = problem.hessian.copy()
    broken[0, where, where] = np.nan
    with pytest.raises(FloatingPointError, match="not finite"):
        factorise(arrow(problem.blocks, 10), broken, problem.scale)


def test_lanes_are_refined_as_by_a_dense_hessian() -> None:
    """The same path, learnt scales included, where the same blocks are summed into one matrix."""
    courses = default().courses
    squares = courses.squares(courses.prepare(true_routes(protocol(5, max_lanes=2))))

    def evaluate(z: Array, hessian: Array, gradient: Array) -> float:
        cost, hessian[:], gradient[:] = squares.dense(z)
        return cost

    knobs = {"num_steps": 12, "damping": 1e-3, "tolerance": 1e-6, "learn": ("advance", "handle", "width")}
    x = np.zeros(len(squares.loc))
    structured, whole = (minimise(s, x, **knobs) for s in (squares, squares._replace(evaluate=evaluate, blocks=None)))
    np.testing.assert_allclose(structured.scale, whole.scale, rtol=1e-6)
    np.testing.assert_allclose(structured.state.x, whole.state.x, atol=1e-5)
    assert len(structured.visited) == len(whole.visited)
    assert half_log_determinant(structured.factor) == pytest.approx(half_log_determinant(whole.factor), rel=1e-8)
