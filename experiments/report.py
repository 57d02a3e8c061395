"""A run as one self-contained page: scores, how the engine fared, figures, settings, provenance."""

from __future__ import annotations

import base64
import math
import re
import statistics
import traceback
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from experiments.command import in_short
from experiments.signatures import source_of

if TYPE_CHECKING:
    from experiments.run import Result
    from inference.posterior import Posterior

UNITS = {
    "m": "m", "cm": "cm", "mm": "mm", "rad": "rad", "deg": "deg", "s": "s", "ms": "ms", "us": "us", "mps": "m/s",
    "mps2": "m/s²", "mps3": "m/s³", "sd": "sd", "nats": "nats", "pct": "%", "hz": "Hz",
}  # fmt: skip

LISTED = 100  # values of a list that are all told

WORDS = {"r_hat": "R-hat", "ess_bulk": "effective draws", "mcse": "standard error of the mean"}

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1d2430; max-width: 62rem; margin: 2.5rem auto; padding: 0 1.5rem }
h1 { font-size: 1.5rem; margin-bottom: .2rem } h2 { font-size: 1.05rem; margin: 2.2rem 0 .6rem; color: #2f6f9f }
p.sub { color: #667085; margin-top: 0 } img { max-width: 100%; margin: .5rem 0 1rem }
table { border-collapse: collapse; font-variant-numeric: tabular-nums } .wide { overflow-x: auto }
th, td { text-align: left; padding: .28rem 1.2rem .28rem 0; border-bottom: 1px solid #e4e7ec; vertical-align: top }
th { color: #667085; font-weight: 600 } td.n { text-align: right }
.flag { background: #fdf0e7; border-left: 4px solid #d1702c; padding: .5rem .9rem; margin: .4rem 0 }
.fail { background: #fbe9e9; border-left: 4px solid #b3261e; padding: .5rem .9rem; margin: .4rem 0 }
.good { background: #ecf5ef; border-left: 4px solid #3b8a5a; padding: .5rem .9rem; margin: .4rem 0 }
pre { background: #f6f7f9; padding: .9rem; overflow-x: auto; font-size: 13px }
summary { cursor: pointer; color: #2f6f9f }
"""


def write_report(
    folder: Path,
    title: str,
    result: Result,
    tables: dict[str, list[dict[str, Any]]],
    images: dict[str, str],
    failures: dict[str, Exception],
    manifest: dict[str, Any],
) -> None:
    """Write report.html, which embeds its images (save_figures) and needs nothing else.

    tables  {heading: rows}; those without rows are left out"""
    info = result.posterior.info
    unscored = "<p>none: the truth of this scene is unknown</p>" if result.scene.truth is None else "<p>none</p>"
    body = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="sub">scene {escape(result.scene.name)} &middot; {escape(manifest["date"])}</p>',
        failure_boxes(failures),
        _flags(result.flags),
        "".join(
            f"<h2>{escape(title)}</h2>{table(tuple(map(head, rows[0])), [tuple(row.values()) for row in rows])}"
            for title, rows in tables.items()
            if rows
        ),
        "<h2>Scores</h2>",
        scores_table(result.scores, manifest["config"].get("metrics", [])) if result.scores else unscored,
        "".join(f"<h2>{_words(name)}</h2>{image}" for name, image in images.items()),
        "<h2>Convergence</h2>",
        _by_name(_labelled(result.posterior, result.diagnostics)),
        "<h2>Engine</h2>",
        engine_tables(info, result.posterior.log_evidence),
        "<h2>Time</h2>",
        table(("stage", "seconds"), list(result.seconds.items())),
        "<h2>Settings and provenance</h2>",
        details("config", manifest["config"]),
        details("manifest", {k: v for k, v in manifest.items() if k != "config"}),
    ]
    (folder / "report.html").write_text(page(title, "".join(body)))


def save_figures(folder: Path, figures: dict[str, Any]) -> tuple[dict[str, str], dict[str, Exception]]:
    """Write figures/*.png; {name: <img> with the picture inside}, and what matplotlib could not draw.

    What is drawn otherwise than as PNG has a `suffix`, such as .gif, and its own savefig(file, dpi=)."""
    images, failures = {}, {}
    for name, figure in figures.items():
        suffix = getattr(figure, "suffix", ".png")
        file = folder / "figures" / f"{name}{suffix}"
        file.parent.mkdir(exist_ok=True)
        try:
            figure.savefig(file, dpi=130)
        except Exception as error:  # only here does a figure really draw
            file.unlink(missing_ok=True)
            failures[f"figure {name}"] = error
            continue
        data = base64.b64encode(file.read_bytes()).decode()
        images[name] = f'<img alt="{escape(name)}" src="data:image/{suffix[1:]};base64,{data}">'
    return images, failures


def failure_boxes(failures: dict[str, Exception]) -> str:
    """What is missing from the page, and why."""
    boxes = []
    for what, error in failures.items():
        trace = escape("".join(traceback.format_exception(error)))
        head = f"{escape(what)} failed: {escape(in_short({what: error})[what])}"
        boxes.append(f'<div class="fail">{head}<details><summary>traceback</summary><pre>{trace}</pre></details></div>')
    return "".join(boxes)


def scores_table(scores: dict[str, float], metrics: list[dict[str, Any]]) -> str:
    """Scores with what the modules of their metrics, targets of a config, say of them."""
    says = meanings(scores, (metric["_target_"].rpartition(".")[0] for metric in metrics))
    rows = [(label, scores[name], unit, says.get(name, "")) for name in scores for label, unit in [split_unit(name)]]
    return table(("metric", "value", "unit", "meaning"), rows)


def meanings(scores: Iterable[str], modules: Iterable[str]) -> dict[str, str]:
    """What docstrings of the metrics' modules say of scores, in lines 'name  meaning' that may go on below the meaning;
    then those of modules of experiments that they speak of."""
    own = "\n".join(_texts(modules))
    text = "\n".join([own, *_texts(re.findall(r"\bexperiments\.\w+", own))])
    return {name: meaning for name in scores if (meaning := _meaning(name, text))}


def _meaning(name: str, text: str) -> str:
    """Empty where no line tells it."""
    if not (found := re.search(rf"^( *{re.escape(name)}  +)(\S.*)\n", text, re.MULTILINE)):
        return ""
    more = re.match(rf"(?: {{{len(found[1])}}} *\S.*\n)*", text[found.end() :])
    return " ".join([found[2], *(more[0] if more else "").split()]).removesuffix('"""')


def _texts(modules: Iterable[str]) -> list[str]:
    return [file.read_text() for module in dict.fromkeys(modules) if (file := source_of(module))]


def _labelled(posterior: Posterior, diagnostics: dict[str, Any]) -> dict[str, Any]:
    """Numbers with what people call them before their names, where the labels say."""
    labels = {
        f"{site}{list(index)}" if index else site: posterior.title(site, index)
        for site in posterior.labels
        if site in posterior.draws
        for index in np.ndindex(posterior.draws[site].shape[2:])
    }
    return {f"{labels[name]}, {name}" if name in labels else name: row for name, row in diagnostics.items()}


def _words(name: str) -> str:
    """A name as a heading."""
    words = name.replace("_", " ")
    return escape(words[:1].upper() + words[1:])


def split_unit(name: str) -> tuple[str, str]:
    """A readable label and the unit that stands at the end of a metric's name."""
    head, _, tail = name.rpartition("_")
    return (head.replace("_", " "), UNITS[tail]) if head and tail in UNITS else (name.replace("_", " "), "")


def head(name: str) -> str:
    """The heading of a column by its name: 'width_m' -> 'width [m]'."""
    label, unit = split_unit(name)
    return f"{label} [{unit}]" if unit else label


def number(value: Any) -> str:
    """Four digits, without noise; a dash where there is nothing to say."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "–"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    if isinstance(value, int) or (math.isfinite(value) and value == int(value) and abs(value) < 1e9):
        return f"{int(value)}"
    return f"{value:.4g}"


def table(head: tuple[str, ...], rows: list[Any]) -> str:
    """An HTML table; numbers are aligned to the right."""
    if not rows:
        return "<p>none</p>"
    lines = ["<tr>" + "".join(map(_cell, row)) + "</tr>" for row in rows]
    top = "".join(f"<th>{escape(name)}</th>" for name in head)
    return f'<div class="wide"><table><tr>{top}</tr>{"".join(lines)}</table></div>'


def _cell(value: Any) -> str:
    kind = ' class="n"' if value is None or isinstance(value, int | float) else ""
    return f"<td{kind}>{escape(number(value))}</td>"


def _flags(flags: list[str]) -> str:
    """What speaks against the draws."""
    if not flags:
        return '<p class="good">No convergence flag was raised.</p>'
    return "".join(f'<p class="flag">{escape(flag)}</p>' for flag in flags)


def engine_tables(info: dict[str, Any], log_evidence: float | None) -> str:
    """Plain values in one table, and one table for each value by name (acceptance by move, ESS by site)."""
    plain = [(k, v) for k, v in info.items() if not isinstance(v, dict | list | tuple) and k != "flags"]
    plain += [("log evidence [nats]", log_evidence)] if log_evidence is not None else []
    parts = [table(("", "value"), plain)]
    for name, values in info.items():
        if isinstance(values, dict) and values and name != "flags":
            parts.append(f"<h2>{_words(name)}</h2>{_by_name(values)}")
        elif isinstance(values, list | tuple) and values and name != "flags":
            parts.append(f"<h2>{_words(name)}</h2><p>{escape(listed(values))}</p>")
    return "".join(parts)


def listed(values: Sequence[Any]) -> str:
    """All of a few values; of many numbers what they are about."""
    if len(values) <= LISTED or not all(isinstance(value, int | float) for value in values):
        return ", ".join(map(number, values))
    told = {"median": statistics.median(values), "least": min(values), "most": max(values)}
    return f"{len(values)} values: " + ", ".join(f"{name} {number(value)}" for name, value in told.items())


def _by_name(values: dict[str, Any]) -> str:
    """A table of a dictionary; where its values are dictionaries, one column for each of their keys."""
    if all(isinstance(v, dict) for v in values.values()):
        columns = list(dict.fromkeys(key for v in values.values() for key in v))
        return table(
            ("", *(WORDS.get(c, c) for c in columns)),
            [(name, *(v.get(c, "") for c in columns)) for name, v in values.items()],
        )
    return table(("", "value"), list(values.items()))


def details(title: str, content: Any) -> str:
    """A folded block of YAML."""
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>"


def page(title: str, body: str) -> str:
    """A whole HTML page, without outside resources."""
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{escape(title)}</title>'
        f"<style>{STYLE}</style></head><body>{body}</body></html>"
    )
