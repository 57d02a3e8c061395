"""Engines against a reference: one record for each, over its seeds and scenes.

A reference is a mean and a standard deviation of every scalar, for each scene. How far numbers x are from it,

    apart = rms over scalars of |x - mean| / sd

is told of the posterior mean, and along the way of the best state. A scalar that the reference does not doubt
(sd = 0: a count) must agree, or they are infinitely far apart.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.compare_cells import Cell, Row, Summary

Floats = NDArray[np.float64]
References = dict[int, Summary]  # scene -> what is known there
ACCURATE = 0.5  # reference standard deviations
SAME = 1e-9  # relative rounding of a constant scalar
MEDIANS = ("time_ms", "processor_ms", "to_accuracy_ms")


def tabulate(rows: list[Row], references: References, measure: str | None = None) -> list[dict[str, Any]]:
    """One record for each engine: the mean over its runs of every score, and its distance to the reference.

    measure  the engine that the reference is of, which has no distance to itself

    NAME:sd is the standard deviation over seeds where there is one scene; NAME:se the standard error over scenes where
    there are many. With one scene, scores that are 0 or 1 have their share alone, which says all."""
    records = []
    for row in rows:
        record: dict[str, Any] = {"engine": row.engine, "runs": len(row.cells), "error": row.error}
        if row.cells:
            for name, values in columns(row.cells, references).items():
                record |= column(name, values, [cell.scene for cell in row.cells])
            if row.engine != measure:
                own = by_scene(row.cells)
                record |= against([(pooled(own[scene]), references[scene]) for scene in own if scene in references])
        records.append(record)
    return records


def by_scene(cells: list[Cell]) -> dict[int, list[Cell]]:
    """Cells of each scene."""
    return {scene: [c for c in cells if c.scene == scene] for scene in dict.fromkeys(c.scene for c in cells)}


def columns(cells: list[Cell], references: References) -> dict[str, list[float | None]]:
    """{column: a value for each cell}, None where there is nothing to say."""
    out: dict[str, list[float | None]] = {n: [c.scores.get(n) for c in cells] for n in cells[0].scores}
    times = [time_to_accuracy(c, references[c.scene]) if c.scene in references else None for c in cells]
    accurate = [None if t is None else float(t < np.inf) for t in times]
    return out | {
        "evaluations": [c.evaluations for c in cells],
        "ess_min": [fewest(c.summary) for c in cells],
        "time_ms": [c.ms for c in cells],
        "processor_ms": [c.processor_ms for c in cells],
        "to_accuracy_ms": times,
        "accurate": accurate,
    }


def column(name: str, values: list[float | None], scenes: list[int]) -> dict[str, float | None]:
    """{name: mean or median, name:sd or name:se}."""
    known = np.array([np.nan if v is None else v for v in values], dtype=float)
    there, known = np.array(scenes)[~np.isnan(known)], known[~np.isnan(known)]
    if not len(known):
        return {name: None}
    if name in MEDIANS:
        return {name: float(np.median(known))}
    out: dict[str, float | None] = {name: float(known.mean())}
    if len(set(scenes)) > 1:
        means = np.array([known[there == scene].mean() for scene in np.unique(there)])
        out[f"{name}:se"] = float(means.std(ddof=1) / len(means) ** 0.5) if len(means) > 1 else None
    else:
        varies = len(known) > 1 and not np.isin(known, (0.0, 1.0)).all()
        out[f"{name}:sd"] = float(known.std(ddof=1)) if varies else None
    return out


def exact_references(rows: list[Row], exact: dict[int, list[dict[str, float]]]) -> References:
    """Exact posteriors, {scene: mean and sd of the scalars in their order}, under the names of the scalars."""
    cells = [cell for row in rows for cell in row.cells]
    return {cell.scene: dict(zip(cell.summary, exact[cell.scene], strict=True)) for cell in cells}


def own_references(rows: list[Row], engine: str | None) -> References:
    """The posteriors of an engine."""
    own = by_scene([cell for row in rows if row.engine == engine for cell in row.cells])
    return {scene: pooled(cells) for scene, cells in own.items()}


def pooled(cells: list[Cell]) -> Summary:
    """Mean over seeds of means and sds; the standard error of the mean shrinks with their number."""
    names = [name for name in cells[0].summary if all(name in cell.summary for cell in cells)]

    def values(name: str, key: str) -> Floats:
        return np.array([cell.summary[name][key] for cell in cells], dtype=float)

    return {
        name: {
            "mean": float(values(name, "mean").mean()),
            "sd": float(values(name, "sd").mean()),
            "mcse": float(np.sqrt(np.square(values(name, "mcse")).sum()) / len(cells)),
        }
        for name in names
    }


def against(pairs: list[tuple[Summary, Summary]]) -> dict[str, float]:
    """mean_error_sd, sd_ratio and z_max of summaries against the references of their scenes."""
    found = [(own[n], known[n]) for own, known in pairs for n in own if n in known]
    found = [(own, known) for own, known in found if in_doubt(own) and in_doubt(known)]
    if not found:
        return {}
    gap = np.array([own["mean"] - known["mean"] for own, known in found])
    sd, ratio = np.array([[known["sd"], own["sd"] / known["sd"]] for own, known in found]).T
    error = np.array([np.hypot(own["mcse"], known["mcse"]) for own, known in found])
    with np.errstate(divide="ignore"):
        z = np.divide(np.abs(gap), error, out=np.zeros_like(gap), where=gap != 0)
    return {
        "mean_error_sd": float(np.sqrt(np.mean(np.square(gap / sd)))),
        "sd_ratio": float(np.exp(np.log(ratio).mean())),
        "z_max": float(z.max()),
    }


def in_doubt(row: dict[str, float]) -> bool:
    """Whether a scalar varies by more than rounding."""
    return row["sd"] > rounding(row)


def rounding(row: dict[str, float]) -> float:
    """What a constant scalar may vary by."""
    return SAME * max(abs(row["mean"]), 1.0)


def fewest(summary: Summary) -> float | None:
    """Effective draws of the scalar that has the fewest."""
    sizes = [row["ess_bulk"] for row in summary.values() if row.get("ess_bulk") is not None]
    return min(sizes, default=None)


# Along the way


def approach(cell: Cell, reference: Summary) -> tuple[Floats, Floats]:
    """Milliseconds (S,) and how far apart (S,) the engine's best state then is; last comes the posterior mean, at the
    end of the run, which is all where there are no snapshots. Empty where nothing can be compared."""
    means = {name: np.array([row["mean"]]) for name, row in cell.summary.items()}
    last = apart(means, reference)
    if last is None:
        return np.empty(0), np.empty(0)
    before = None if cell.trail is None else apart(cell.trail.scalars, reference)
    if cell.trail is None or before is None:
        return np.array([cell.ms]), last
    end = max(cell.ms, float(cell.trail.ms.max(initial=0.0)))
    return np.append(cell.trail.ms, end), np.append(before, last)


def apart(scalars: dict[str, Floats], reference: Summary) -> Floats | None:
    """The docstring's distance of scalars (S,), (S,); None where the reference knows none of them."""
    gaps = []
    for name, values in scalars.items():
        if name in reference:
            known = reference[name]
            gap = np.abs(values - known["mean"])
            same = np.where(gap <= rounding(known), 0.0, np.inf)
            gaps.append(gap / known["sd"] if in_doubt(known) else same)
    return np.sqrt(np.mean(np.square(gaps), axis=0)) if gaps else None


def time_to_accuracy(cell: Cell, reference: Summary) -> float | None:
    """Milliseconds after which a run stays accurate, inf where it does not end so; None: nothing to compare."""
    ms, away = approach(cell, reference)
    if not len(ms):
        return None
    wrong = np.flatnonzero(~(away <= ACCURATE))
    if not len(wrong):
        return float(ms[0])
    return float(ms[wrong[-1] + 1]) if wrong[-1] + 1 < len(ms) else float("inf")
