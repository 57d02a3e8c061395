"""A comparison as a table on the terminal, as pictures, and as one self-contained page."""

from __future__ import annotations

import math
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments import store
from experiments.compare_cells import Row, posterior_of
from experiments.report import details, head, number, page, save_figures, table
from experiments.schema import build

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from experiments.compare import Task

COLOURS = ("#2f6f9f", "#d1702c", "#3b8a5a", "#7b3f9e", "#b3261e", "#8a5a2b", "#c2459e", "#444c55")
SPAN = (0.01, 100.0)  # that distances are drawn in [reference sd]


def rows_of(records: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    """The table with a column for each engine: the heading of each row, then its entries."""
    names = dict.fromkeys(name for record in records for name in record)
    shown = [n for n in names if n not in ("engine", "error") and not n.endswith((":sd", ":se"))]
    return [(head(name), *(_entry(record, name) for record in records)) for name in shown]


def _entry(record: dict[str, Any], name: str) -> str:
    value, spread = record.get(name), record.get(f"{name}:sd") or record.get(f"{name}:se")
    if value is None:
        return "–"
    if value == math.inf:
        return "never"
    return _shown(value) + (f" ± {_shown(spread, 2)}" if spread else "")


def _shown(value: float, digits: int = 4) -> str:
    """A few digits; large numbers without an exponent."""
    return f"{value:.0f}" if 10**digits <= abs(value) < 1e9 else number(float(f"{value:.{digits}g}"))


def print_table(records: list[dict[str, Any]], caption: str) -> None:
    """The table on the terminal; an engine that failed has its error in a line of its own."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    console.width = console.width if console.is_terminal else 160
    shown = Table("", *(record["engine"] for record in records))
    for name, *entries in rows_of(records):
        shown.add_row(Text(name), *entries)
    console.print(shown)
    console.print(caption, soft_wrap=True, markup=False, highlight=False)
    for record in records:
        if record["error"]:
            console.print(f"{record['engine']}: {record['error']}", style="red", soft_wrap=True, markup=False)


def write(
    folder: Path,
    records: list[dict[str, Any]],
    rows: list[Row],
    caption: str,
    figures: dict[str, Figure],
    failures: dict[str, Exception],
    meaning: str,
) -> None:
    """compare.csv, compare.json, figures/*.png and a self-contained report.html in a folder of their own.

    meaning   of the columns, in words
    failures  figures that could not be made"""
    from experiments.command import in_short

    heads = ("", *(record["engine"] for record in records))
    failed = [(record["engine"], record["error"]) for record in records if record["error"]]
    runs = {row.engine: [cell.folder.name for cell in row.cells] for row in rows}
    with store.writing(folder) as temporary:
        images, unsaved = save_figures(temporary, figures)
        body = [f"<h1>{escape(folder.name)}</h1><p class='sub'>{escape(caption)}</p>", table(heads, rows_of(records))]
        body += ["<h2>Failed</h2>", table(("engine", "error"), failed)] if failed else []
        body += [f"<h2>{escape(name.replace('_', ' '))}</h2>{image}" for name, image in images.items()]
        body += [
            f'<div class="fail">{escape(what)}: {escape(why)}</div>'
            for what, why in in_short(failures | unsaved).items()
        ]
        body += ["<h2>What the rows mean</h2><pre>", escape(meaning.strip()), "</pre>", details("runs", runs)]
        store.write_json(temporary / "compare.json", {"caption": caption, "records": records, "runs": runs})
        store.write_rows(temporary / "compare.csv", records)
        (temporary / "report.html").write_text(page(folder.name, "".join(body)))


# Pictures


def draw(
    tasks: list[Task], rows: list[Row], references: dict[int, Any]
) -> tuple[dict[str, Figure], dict[str, Exception]]:
    """How near each engine is along its time, and the config's compare_figures of the first scene; what failed."""
    figures: dict[str, Figure] = {}
    failures: dict[str, Exception] = {}
    ran = {row.engine for row in rows if row.cells}
    first = {task.engine: task.job for task in reversed(tasks) if task.engine in ran}
    if not first:
        return figures, failures
    if (figure := approach_figure(rows, references)) is not None:
        figures["accuracy_against_time"] = figure
    config = tasks[0].job.config
    functions = build(config["compare_figures"], "compare_figures")
    if functions:
        order = [row.engine for row in rows if row.engine in first]
        scene = build(config["scenario"], "scenario")
        posteriors = {engine: posterior_of(first[engine]) for engine in order}
        for function in functions:
            try:
                figures |= function(posteriors, scene)
            except Exception as error:  # a picture less is no reason to lose the table
                failures[f"figure {function.func.__name__}"] = error
    return figures, failures


def approach_figure(rows: list[Row], references: dict[int, Any]) -> Figure | None:
    """Distance to the reference against time, the median over runs, a dot where that ends; None without any."""
    import numpy as np
    from matplotlib.figure import Figure

    from experiments.compare_table import ACCURATE, approach

    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    axes = figure.subplots()
    drawn = False
    for row, colour in zip(rows, COLOURS * len(rows), strict=False):
        paths = [approach(cell, references[cell.scene]) for cell in row.cells if cell.scene in references]
        paths = [(ms, away) for ms, away in paths if len(ms)]
        if not paths:
            continue
        drawn = True
        half = len(paths) // 2
        ends = float(np.sort([ms[-1] for ms, _ in paths])[half])
        times = np.unique(np.concatenate([ms for ms, _ in paths]))
        times = times[(times > 0) & (times <= ends)]
        middle = np.sort([_held(ms, np.clip(away, *SPAN), times) for ms, away in paths], axis=0)[half]
        middle[np.isinf(middle)] = np.nan  # the median run has not begun
        axes.step(times, middle, where="post", color=colour, lw=1.8, label=row.engine)
        axes.plot(times[-1], middle[-1], "o", color=colour, ms=5)
    axes.axhline(ACCURATE, color="#8a8f98", lw=0.9, ls="--")
    axes.text(
        1.0, ACCURATE, " accurate", color="#667085", fontsize=9, va="center", transform=axes.get_yaxis_transform()
    )
    axes.set(xscale="log", yscale="log", ylim=SPAN, xlabel="time since the engine began [ms]")
    axes.set_ylabel("best state from the reference mean\n[reference sd, rms over scalars]")
    axes.set_title("median over runs; the dot is the posterior mean at the end of the run", loc="left", fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.09, 0.5))
    return figure if drawn else None


def _held(ms: Any, away: Any, times: Any) -> Any:
    """Values that hold from their times on, at other times; infinite before the first."""
    import numpy as np

    index = np.searchsorted(ms, times, side="right") - 1
    return np.where(index >= 0, away[np.maximum(index, 0)], np.inf)
