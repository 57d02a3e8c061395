"""Figures of a benchmark: what each means, what the paper has, what must be reached; as a table or as JSON."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple


class Figure(NamedTuple):
    """One number that a benchmark reports.

    paper              what the paper states, in words
    at_least, at_most  the target; a figure with neither is reported only
    """

    key: str
    unit: str
    definition: str
    paper: str = ""
    at_least: float | None = None
    at_most: float | None = None

    @property
    def target(self) -> str:
        if self.at_least is not None and self.at_most is not None:
            return f"{self.at_least:g} to {self.at_most:g}"
        if self.at_least is not None:
            return f">= {self.at_least:g}"
        return "" if self.at_most is None else f"<= {self.at_most:g}"

    def met(self, value: Any) -> bool | None:
        """Whether a value reaches the target; None without a target or a value."""
        if value is None or not self.target:
            return None
        high = self.at_least is None or value >= self.at_least
        return bool(high and (self.at_most is None or value <= self.at_most))


class Value(NamedTuple):
    """A measured figure: a number, several by name, or None where it could not be measured; `detail` says why,
    or how many scenes and how uncertain."""

    value: float | dict[str, float] | None
    detail: str = ""


Values = dict[str, Value]


class Measurement(NamedTuple):
    """Figures that come out of the same runs. measure(effort) -> {key: Value}, one for each figure."""

    figures: tuple[Figure, ...]
    measure: Callable[[Any], Values]


def share(hits: Sequence[float], refused: int = 0) -> Value:
    """Mean of 0/1 outcomes and its standard error, at (hits + 1/2) / (n + 1): without failures too it is not zero."""
    n = len(hits)
    p = (sum(hits) + 0.5) / (n + 1.0)
    detail = f"n = {n}, s.e. {(p * (1 - p) / n) ** 0.5:.3f}" + (f", {refused} refused" if refused else "")
    return Value(sum(hits) / n, detail)


def as_json(figures: Sequence[Figure], values: Mapping[str, Value], run: Mapping[str, Any]) -> str:
    """One object: {key: value}, and under `definitions` and `run` what the numbers mean and where they were made."""
    definitions = {
        f.key: {
            "definition": f.definition,
            "unit": f.unit,
            "paper": f.paper,
            "target": f.target,
            "met": f.met(values[f.key].value),
            "detail": values[f.key].detail,
        }
        for f in figures
    }
    plain = {f.key: values[f.key].value for f in figures}
    return json.dumps(plain | {"definitions": definitions, "run": dict(run)}, indent=2)


def print_table(title: str, figures: Sequence[Figure], values: Mapping[str, Value], run: Mapping[str, Any]) -> None:
    """A table for people, on the standard output."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    if not console.is_terminal:
        console = Console(width=160)
    table = Table(title=title, caption=", ".join(f"{k} {v}" for k, v in run.items()), show_lines=True)
    for name in ("figure", "value", "unit", "target", "", "paper", "what it is"):
        table.add_column(name, overflow="fold", no_wrap=name == "figure")
    marks = {None: "", True: "[green]ok[/green]", False: "[red]miss[/red]"}
    for f in figures:
        found = values[f.key]
        meaning = f"{f.definition} [dim]({found.detail})[/dim]" if found.detail else f.definition
        table.add_row(f.key, readable(found.value), f.unit, f.target, marks[f.met(found.value)], f.paper, meaning)
    console.print(table)


def readable(value: float | dict[str, float] | None) -> str:
    """A value for people: four digits are more than any of these figures is worth."""
    if value is None:
        return "-"
    if isinstance(value, dict):
        return "\n".join(f"{name} {number:.4g}" for name, number in value.items())
    return f"{value:.4g}"


def machine() -> dict[str, Any]:
    """Where the numbers were made, and how busy it was."""
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    return {"machine": platform.machine(), "python": platform.python_version(), "cores": os.cpu_count(), "load": load}
