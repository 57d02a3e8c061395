"""One formula over scalars, written once: traced by CasADi, run by numba, CasADi or torch.

    y = f(x, p)        x (n,) the state, p (m,) parameters, y (d,)

A formula is a Python function `f(x, p, ops)` of two tuples of scalars: arithmetic, and the functions of `ops`, nothing
else, no branch (`ops.where` chooses, both sides being evaluated). So it can be traced once with symbols:

    casadi()    a CasADi function, for optimisers and for exact derivatives of any order
    compiled()  straight-line machine code for N points at once, with the Jacobian dy/dx where asked for
    scalar()    the same for one point, of scalars: for the inner loops of other machine code
    torch()     on tensors, differentiable: for programs and tests

Emitted code is a source file named by its own hash beside numba's cache, so that machine code is found again by the
next process; nothing of it is ever edited in place.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from models.program import InputError

if TYPE_CHECKING:
    from torch import Tensor

Function = Callable[[tuple[Any, ...], tuple[Any, ...], Any], Sequence[Any]]
COMMON = ("sin", "cos", "tan", "tanh", "exp", "log", "sqrt", "erf")  # by these names in CasADi and torch alike

# numba's spelling of CasADi's operations; w are work scalars
SPELLING = {
    "OP_ASSIGN": "{0}",
    "OP_ADD": "{0} + {1}",
    "OP_SUB": "{0} - {1}",
    "OP_MUL": "{0} * {1}",
    "OP_DIV": "{0} / {1}",
    "OP_NEG": "-{0}",
    "OP_INV": "1.0 / {0}",
    "OP_SQ": "{0} * {0}",
    "OP_TWICE": "2.0 * {0}",
    "OP_POW": "{0} ** {1}",
    "OP_CONSTPOW": "{0} ** {1}",
    "OP_FABS": "abs({0})",
    "OP_SIGN": "(1.0 if {0} > 0.0 else 0.0) - (1.0 if {0} < 0.0 else 0.0)",
    "OP_FMIN": "min({0}, {1})",
    "OP_FMAX": "max({0}, {1})",
    "OP_LT": "1.0 if {0} < {1} else 0.0",
    "OP_LE": "1.0 if {0} <= {1} else 0.0",
    "OP_EQ": "1.0 if {0} == {1} else 0.0",
    "OP_NE": "1.0 if {0} != {1} else 0.0",
    "OP_NOT": "1.0 if {0} == 0.0 else 0.0",
    "OP_AND": "1.0 if {0} != 0.0 and {1} != 0.0 else 0.0",
    "OP_OR": "1.0 if {0} != 0.0 or {1} != 0.0 else 0.0",
    "OP_IF_ELSE_ZERO": "({1} if {0} != 0.0 else 0.0)",
} | {
    f"OP_{name.upper()}": f"math.{name}(" + ", ".join(f"{{{i}}}" for i in range(count)) + ")"
    for name, count in (
        *((name, 1) for name in (*COMMON, "asin", "acos", "atan", "sinh", "cosh", "log1p", "expm1", "floor", "ceil")),
        ("atan2", 2),
        ("hypot", 2),
    )
}


@dataclass(frozen=True)
class Formula:
    """y = f(x, p): `function(x, p, ops)` of tuples of num_x and num_p scalars; `name` is for files and messages.

    ops: sin, cos, tan, tanh, exp, log, sqrt, erf, atan2(y, x), fabs, fmin, fmax, where(condition, a, b)."""

    name: str
    function: Function
    num_x: int
    num_p: int = 0

    def casadi(self) -> Any:
        """The casadi.Function (x, p) -> y."""
        return _traced(self)

    @cached_property
    def num_y(self) -> int:
        """d, the length of y."""
        return int(_traced(self).size1_out(0))

    def compiled(self, *, jacobian: bool = True) -> Callable[..., None]:
        """Machine code `fill(x, p, y, J)`, or `fill(x, p, y)` without the Jacobian: N points, written in place.

        x (N, n), p (N, m) or (1, m) for all, y (N, d), J (N, d, n) = dy/dx. Raises InputError for an operation that no
        machine code is known for."""
        return _compiled(self, jacobian)

    def scalar(self) -> Callable[..., tuple[float, ...]]:
        """Machine code `f(x0, x1, ..., p0, p1, ...) -> (y0, y1, ...)`, to be called by (and inlined into) other machine
        code, of which it is a global name. Raises InputError for an operation that no machine code is known for."""
        return _scalar(self)

    def __call__(self, x: Any, p: Any) -> Any:
        """y (N, d) of x (N, n) and p (N, m) or (1, m), in machine code."""
        import numpy as np

        y = np.empty((len(x), self.num_y))
        self.compiled(jacobian=False)(np.ascontiguousarray(x, float), np.ascontiguousarray(p, float), y)
        return y

    def torch(self, x: Tensor, p: Tensor) -> Tensor:
        """y (*batch, d) of x (*batch, n) and p (*batch, m)."""
        import torch

        found = self.function(x.unbind(-1), p.unbind(-1), _torch_ops())
        shape = torch.broadcast_shapes(x.shape[:-1], p.shape[:-1])
        return torch.stack([torch.as_tensor(v, dtype=x.dtype).expand(shape) for v in found], -1)


@lru_cache
def _casadi_ops() -> Any:
    import casadi

    named = {name: getattr(casadi, name) for name in (*COMMON, "atan2", "fabs", "fmin", "fmax")}
    return SimpleNamespace(**named, where=casadi.if_else)


@lru_cache
def _torch_ops() -> Any:
    import torch

    def double(value: Any) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float64)

    def of_doubles(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
        return lambda *values: function(*(double(value) for value in values))

    pairs = {"atan2": torch.atan2, "fmin": torch.minimum, "fmax": torch.maximum, "fabs": torch.abs}
    named = {name: of_doubles(f) for name, f in ({n: getattr(torch, n) for n in COMMON} | pairs).items()}
    where = lambda condition, a, b: torch.where(torch.as_tensor(condition), double(a), double(b))  # noqa: E731
    return SimpleNamespace(**named, where=where)


@lru_cache
def _traced(formula: Formula) -> Any:
    import casadi

    x, p = casadi.SX.sym("x", formula.num_x), casadi.SX.sym("p", formula.num_p)
    try:
        y = formula.function(tuple(casadi.vertsplit(x)), tuple(casadi.vertsplit(p)), _casadi_ops())
    except InputError:
        raise
    except Exception as error:
        error.add_note(f"formula '{formula.name}' is told to CasADi by symbols: use ops, not math; ops.where, not if")
        raise
    return casadi.Function(formula.name, [x, p], [casadi.densify(casadi.vertcat(*y))])


@lru_cache
def _compiled(formula: Formula, jacobian: bool) -> Callable[..., None]:
    fill: Callable[..., None] = _loaded(formula.name, emit(formula, jacobian=jacobian)).fill
    return fill


@lru_cache
def _scalar(formula: Formula) -> Callable[..., tuple[float, ...]]:
    value: Callable[..., tuple[float, ...]] = _loaded(f"{formula.name}_scalar", emit_scalar(formula)).value
    return value


def _loaded(name: str, source: str) -> Any:
    """The module of that source, from a file named by its hash."""
    digest = hashlib.sha256(source.encode()).hexdigest()[:16]
    folder = Path(os.environ["NUMBA_CACHE_DIR"]) / "formulas"
    path = folder / f"{name}_{digest}.py"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        draft = path.with_suffix(f".{os.getpid()}")
        draft.write_text(source)
        draft.replace(path)  # in one step: another process may be at the same file
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # numba finds the home of cached machine code there
    spec.loader.exec_module(module)
    return module


def emit(formula: Formula, *, jacobian: bool) -> str:
    """The source of the machine code for many points. Raises InputError for an operation without a spelling."""
    import casadi

    x, p, y = _symbols(formula)
    outputs = [y, casadi.densify(casadi.jacobian(y, x))] if jacobian else [y]
    rows = y.shape[0]

    def given(which: int, entry: int) -> str:
        return f"x[i, {entry}]" if which == 0 else f"p[i * own, {entry}]"

    def place(which: int, entry: int) -> str:
        return f"y[i, {entry}]" if which == 0 else f"J[i, {entry % rows}, {entry // rows}]"

    matrix = "float64[:, ::1]"
    types = ", ".join([matrix] * 3 + ["float64[:, :, ::1]"] * jacobian)
    return "\n".join(
        [
            "import math",
            "",
            "from numba import njit",
            "",
            "",
            f'@njit("void({types})", cache=True, error_model="numpy")',
            f"def fill(x, p, y{', J' if jacobian else ''}):",
            "    own = 1 if p.shape[0] > 1 else 0  # a row of parameters for each point, or one for all",
            "    for i in range(x.shape[0]):",
            *(f"        {line}" for line in _lines(formula.name, [x, p], outputs, given, place)),
            "",
        ]
    )


def emit_scalar(formula: Formula) -> str:
    """The source of the machine code for one point. Raises InputError for an operation without a spelling.

    Not kept on the disk by itself: what is loaded from there cannot be inlined; it is part of its callers' code."""
    x, p, y = _symbols(formula)

    def given(which: int, entry: int) -> str:
        return f"{'xp'[which]}{entry}"

    names = [given(0, k) for k in range(formula.num_x)] + [given(1, k) for k in range(formula.num_p)]
    return "\n".join(
        [
            "import math",
            "",
            "from numba import njit",
            "",
            "",
            '@njit(error_model="numpy")',
            f"def value({', '.join(names)}):",
            *(f"    {line}" for line in _lines(formula.name, [x, p], [y], given, lambda which, entry: f"y{entry}")),
            f"    return ({', '.join(f'y{k}' for k in range(y.shape[0]))},)",
            "",
        ]
    )


def _symbols(formula: Formula) -> tuple[Any, Any, Any]:
    import casadi

    x, p = casadi.SX.sym("x", formula.num_x), casadi.SX.sym("p", formula.num_p)
    return x, p, _traced(formula)(x, p)


def _lines(
    name: str, inputs: list[Any], outputs: list[Any], given: Callable[[int, int], str], place: Callable[[int, int], str]
) -> list[str]:
    """A line of source for each operation; `given` and `place` name the entries of inputs and outputs."""
    import casadi

    spelling = {getattr(casadi, operation): text for operation, text in SPELLING.items()}
    f = casadi.Function("f", inputs, casadi.cse(outputs))
    body = list[str]()
    for i in range(f.n_instructions()):
        code, read, out = f.instruction_id(i), f.instruction_input(i), f.instruction_output(i)
        if code == casadi.OP_CONST:
            value = repr(float(f.instruction_constant(i)))
            body.append(f"w{out[0]} = " + value.replace("inf", "math.inf").replace("nan", "math.nan"))
        elif code == casadi.OP_INPUT:
            body.append(f"w{out[0]} = {given(read[0], read[1])}")
        elif code == casadi.OP_OUTPUT:
            body.append(f"{place(out[0], out[1])} = w{read[0]}")
        elif code in spelling:
            body.append(f"w{out[0]} = " + spelling[code].format(*(f"w{k}" for k in read)))
        else:
            found = next((n for n in dir(casadi) if n.startswith("OP_") and getattr(casadi, n) == code), str(code))
            raise InputError(f"formula {name} uses CasADi's {found}, which has no machine code; rewrite it")
    return body
