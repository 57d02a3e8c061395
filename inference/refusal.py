"""Ask an engine whether it refuses a model, without the work.

An engine calls `accept` where nothing is left to refuse and the work begins; one marked `answers_first` does so, itself
or through the first engine that it calls. `ask` calls an engine as far as that. So what an engine refuses is said in
one place, the engine, and a comparison can ask all of its engines before the first one runs.
"""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from functools import partial
from typing import Any, TypeVar

Run = TypeVar("Run", bound=Callable[..., Any])
_asked: ContextVar[bool] = ContextVar("asked", default=False)
_answering: list[Any] = []


class _Accepted(Exception):
    """Ends a call that only asks."""


def answers_first(run: Run) -> Run:
    """Mark an engine that calls `accept` before its work."""
    _answering.append(run)
    return run


def accept() -> None:
    """The engine runs the model: the end of a call by `ask`, nothing in any other."""
    if _asked.get():
        raise _Accepted


def ask(engine: Callable[..., Any], model: Any, evidence: Any) -> None:
    """Raise what the engine raises against the model, InputError as a rule. Of engines that are not marked nothing is
    known before they run."""
    function: Any = engine
    while isinstance(function, partial):
        function = function.func
    if not any(function is known for known in _answering):
        return
    token = _asked.set(True)
    try:
        engine(model, evidence, seed=0)
    except _Accepted:
        return
    finally:
        _asked.reset(token)
