"""A formula is the same in CasADi, in machine code and in torch."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import casadi
import numpy as np
import pytest
import torch

from models.formula import SPELLING, Formula, emit
from models.program import InputError

EACH: dict[str, Callable[[Any, Any, Any], Any]] = {
    "arithmetic": lambda a, b, ops: (a + b) * (a - b) / (2.5 - a) - a**3 + 2 * b + 1 / b + a * a,
    "powers": lambda a, b, ops: (a * a + 1.0) ** b + b**0.5,
    "trigonometry": lambda a, b, ops: ops.sin(a) + ops.cos(b) * ops.tan(a) + ops.atan2(a, b),
    "exponentials": lambda a, b, ops: ops.exp(-a) + ops.log(b) + ops.tanh(a) + ops.erf(b),
    "roots": lambda a, b, ops: ops.sqrt(a * a + b),
    "kinks": lambda a, b, ops: ops.fabs(a) + ops.fmin(a, b) - 2 * ops.fmax(a, b),
    "choice": lambda a, b, ops: ops.where(a < 0.3, a * b, a + b) + ops.where(a <= b, 1.0, b),
}
POINTS = np.random.default_rng(1).normal(size=(7, 2)) * [1.0, 0.0] + np.random.default_rng(2).random((7, 2)) * [0, 2]


def with_parameter(f: Callable[[Any, Any, Any], Any]) -> Callable[[Any, Any, Any], Any]:
    return lambda x, p, ops: (f(x[0], x[1], ops) * p[0], p[0] + x[1], 3.0)


@pytest.mark.parametrize("name", EACH)
def test_all_backends_agree(name: str) -> None:
    formula = Formula(name, with_parameter(EACH[name]), 2, 1)
    p = np.linspace(0.5, 2.0, len(POINTS))[:, None]
    y, J = np.empty((7, 3)), np.empty((7, 3, 2))
    formula.compiled()(POINTS, p, y, J)
    np.testing.assert_allclose(formula(POINTS, p), y, rtol=0, atol=0)
    traced = np.stack([np.array(formula.casadi()(x, q)).ravel() for x, q in zip(POINTS, p, strict=True)])
    np.testing.assert_allclose(y, traced, rtol=1e-14, atol=1e-14)
    x, q = torch.from_numpy(POINTS), torch.from_numpy(p)
    np.testing.assert_allclose(y, formula.torch(x, q).numpy(), rtol=1e-14, atol=1e-14)
    slopes = torch.func.vmap(torch.func.jacrev(formula.torch))(x, q)
    np.testing.assert_allclose(J, slopes.numpy(), rtol=1e-12, atol=1e-12)


def test_one_row_of_parameters_serves_all_points() -> None:
    formula = Formula("scaled", lambda x, p, ops: (x[0] * p[0],), 2, 1)
    np.testing.assert_array_equal(formula(POINTS, np.array([[3.0]])), 3.0 * POINTS[:, :1])
    np.testing.assert_array_equal(formula(POINTS[:2], np.array([[3.0], [4.0]])), [[3.0], [4.0]] * POINTS[:2, :1])


UNARY = ("sin cos tan tanh exp log sqrt erf asin acos atan sinh cosh log1p expm1 floor ceil fabs sign").split()


@pytest.mark.parametrize("name", UNARY)
def test_every_emitted_function(name: str) -> None:
    function = getattr(casadi, name)
    formula = Formula(f"op_{name}", lambda x, p, ops: (function(x[0]), function(0.5 * x[0])), 1)
    points = np.array([[0.1], [0.45], [0.9]])
    expected = [np.array(formula.casadi()(x, [])).ravel() for x in points]
    np.testing.assert_allclose(formula(points, np.zeros((1, 0))), expected, rtol=1e-14)


LOGIC: dict[str, Callable[[Any, Any], Any]] = {
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
    "and": lambda a, b: casadi.logic_and(a, b),
    "or": lambda a, b: casadi.logic_or(a, b),
    "not": lambda a, b: casadi.logic_not(a),
    "hypot": lambda a, b: casadi.hypot(a, b),
    "atan2": lambda a, b: casadi.atan2(a, b),
}


@pytest.mark.parametrize("name", LOGIC)
def test_every_emitted_comparison(name: str) -> None:
    formula = Formula(f"op_{name}", lambda x, p, ops: (LOGIC[name](x[0], x[1]),), 2)
    points = np.array([[0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [0.0, 0.0], [2.0, -1.0]])
    expected = [np.array(formula.casadi()(x, [])).ravel() for x in points]
    np.testing.assert_array_equal(formula(points, np.zeros((1, 0))), expected)


def test_all_spellings_are_operations_of_casadi() -> None:
    assert all(hasattr(casadi, name) for name in SPELLING)


def test_an_operation_without_machine_code_is_named() -> None:
    with pytest.raises(InputError, match="formula odd uses CasADi's OP_FMOD"):
        emit(Formula("odd", lambda x, p, ops: (casadi.fmod(x[0], 2.0),), 1), jacobian=False)


def test_where_does_not_pass_on_the_nan_of_the_side_not_taken() -> None:
    formula = Formula("guarded", lambda x, p, ops: (ops.where(x[0] > 0.0, ops.log(x[0]), -1.0),), 1)
    points, y, J = np.array([[-2.0], [2.0]]), np.empty((2, 1)), np.empty((2, 1, 1))
    formula.compiled()(points, np.zeros((1, 0)), y, J)
    np.testing.assert_allclose(y[:, 0], [-1.0, math.log(2.0)])
    np.testing.assert_allclose(J[:, 0, 0], [0.0, 0.5])
    np.testing.assert_allclose(formula.torch(torch.from_numpy(points), torch.zeros(0)).numpy(), y)


def test_constants_need_not_be_finite() -> None:
    def function(x: Any, p: Any, ops: Any) -> Any:
        return ops.where(x[0] > 0.0, x[0], math.inf), ops.where(x[0] > 0.0, -math.inf, 1.0), math.nan

    found = Formula("without_end", function, 1)(np.array([[-2.0], [2.0]]), np.zeros((1, 0)))
    np.testing.assert_array_equal(found, [[math.inf, 1.0, math.nan], [2.0, -math.inf, math.nan]])


def test_torch_broadcasts_parameters() -> None:
    formula = Formula("product", lambda x, p, ops: (x[0] * p[0], 1.0), 1, 1)
    found = formula.torch(torch.ones(3, 1, 1, dtype=torch.float64), torch.ones(4, 1, dtype=torch.float64))
    assert found.shape == (3, 4, 2)


def test_processes_may_emit_the_same_formula_at_once(tmp_path: Any) -> None:
    code = (
        "import os; os.environ['NUMBA_CACHE_DIR'] = r'" + str(tmp_path) + "'\n"
        "import numpy as np\nfrom models.formula import Formula\n"
        "f = Formula('shared', lambda x, p, ops: (ops.sin(x[0]) + 1.0,), 1)\n"
        "print(f(np.zeros((1, 1)), np.zeros((1, 0)))[0, 0])"
    )
    both = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert [process.communicate(timeout=120)[0].strip() for process in both] == ["1.0", "1.0"]
    assert len(list((tmp_path / "formulas").glob("shared_*.py"))) == 1


@pytest.mark.parametrize("name", EACH)
def test_one_point_inside_other_machine_code_is_the_same(name: str) -> None:
    from numba import njit

    formula = Formula(name, with_parameter(EACH[name]), 2, 1)
    value = formula.scalar()

    @njit
    def doubled(a: float, b: float, p: float) -> tuple[float, ...]:
        y = value(a, b, p)
        return 2 * y[0], 2 * y[1], 2 * y[2]

    for x in POINTS:
        expected = 2 * formula(x[None], np.array([[0.7]]))[0]
        np.testing.assert_allclose(doubled(x[0], x[1], 0.7), expected, rtol=1e-14)


def test_a_branch_on_a_symbol_is_told_what_to_do() -> None:
    with pytest.raises(RuntimeError) as caught:
        Formula("step", lambda x, p, ops: (1.0 if x[0] > 0.0 else 0.0,), 1).casadi()
    assert "formula 'step' is told to CasADi by symbols" in caught.value.__notes__[0]
