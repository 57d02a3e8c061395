"""Many engines and seeds on one model and scenario, in one table.

    python -m experiments.compare scenario=line model=gaussian 'engines=[rjmcmc,least_squares]' seeds=3

Every setting of `waybayes` works here too; `rjmcmc.num_steps=1000` sets a knob of one engine alone.
Each cell is an ordinary stored run, so a comparison resumes and grows without repeating work.

    mean_error_sd  rms over scalars of (mean - reference mean) / reference sd
    sd_ratio       geometric mean over scalars of sd / reference sd
    z_max          largest |mean - reference mean| / standard error, standard errors from the ESS, all
                   seeds pooled: past about 3 the engine is biased

    time_s         of the engine, the median over seeds: the first run of a process pays for compilation

    ess_min        effective draws of the scalar that has the fewest

The reference is the model's exact posterior where it has one, else that of the engine reference=NAME, else that of the
first engine that ran.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException
from omegaconf import open_dict

from experiments import store
from experiments.command import JobFailed, complain, guarded, in_words
from experiments.run import Job, execute, job_of
from experiments.signatures import ConfigError

Summary = dict[str, dict[str, float]]  # scalar -> mean, sd, mcse (inference.diagnostics.summary)


class Plan(NamedTuple):
    """What to compare.

    shared  settings of every run
    own     {engine: its settings}
    named   whether the engines were asked for by name; one of the usual ones may refuse a model
    reference  the engine that the others are measured by; None takes the first that ran
    """

    engines: list[str]
    seeds: int
    shared: list[str]
    own: dict[str, list[str]]
    named: bool
    reference: str | None = None


class Cell(NamedTuple):
    """The outcome of one engine with one seed, as stored."""

    folder: Path
    scores: dict[str, float]
    summary: Summary
    seconds: float
    evaluations: float | None


class Row(NamedTuple):
    """One engine: its cells, or the sentence that says why there are none.

    refused  whether it said that scenario, model and engine do not fit, before any cell
    """

    engine: str
    cells: list[Cell]
    error: str | None
    refused: bool


def plan(words: list[str]) -> Plan:
    """Read the command line. Raises ConfigError for words that say nothing."""
    engines, seeds, rest, named = ["rjmcmc", "least_squares"], 3, [], False
    reference = None
    for word in words:
        override = OverridesParser.create().parse_override(word)
        if override.key_or_group == "engines":
            value, named = override.value(), True
            engines = [str(name) for name in (value if isinstance(value, list) else [value])]
            if not engines:
                raise ConfigError("engines is empty; name one or more, such as engines=[rjmcmc,least_squares]")
        elif override.key_or_group == "seeds":
            value = override.value()
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ConfigError(f"seeds is '{value}'; give how many seeds to run, 1 or more")
            seeds = value
        elif override.key_or_group == "reference":
            reference = str(override.value())
        elif override.key_or_group in ("engine", "seed"):
            raise ConfigError(f"a comparison takes engines=[...] and seeds=N, not {word}")
        else:
            rest.append(word)
    if reference is not None and reference not in engines:
        raise ConfigError(f"reference is '{reference}', which does not run; choose one of {', '.join(engines)}")
    heads = {word: word.lstrip("+~").partition(".")[0] for word in rest}
    own = {e: [_for_engine(word, e) for word in rest if heads[word] == e] for e in engines}
    return Plan(engines, seeds, [word for word in rest if heads[word] not in engines], own, named, reference)


def _for_engine(word: str, engine: str) -> str:
    """'rjmcmc.num_steps=5' -> 'engine.num_steps=5'."""
    return word.replace(engine, "engine", 1)


def jobs_of(plan: Plan) -> dict[str, list[Job]]:
    """Every run of a plan, composed and checked before the first one starts."""
    jobs: dict[str, list[Job]] = {}
    with initialize_config_module("configs", version_base="1.3"):
        for engine in plan.engines:
            jobs[engine] = []
            for seed in range(plan.seeds):
                words = [*plan.shared, f"engine={engine}", f"seed={seed}", *plan.own[engine]]
                config = compose("run", words, return_hydra_config=True)
                choices = dict(config.hydra.runtime.choices)
                with open_dict(config):
                    del config["hydra"]
                jobs[engine].append(job_of(config, choices))
    return jobs


def gather(jobs: dict[str, list[Job]], say: Callable[[str], None] = print) -> list[Row]:
    """Run what is not done yet, all engines of one seed first: what cannot work says so at once."""
    cells: dict[str, list[Cell]] = {engine: [] for engine in jobs}
    errors: dict[str, str] = {}
    refused: set[str] = set()
    for round_of_seed in zip(*jobs.values(), strict=True):
        for engine, job in zip(jobs, round_of_seed, strict=True):
            if engine in errors:
                continue
            say(f"-- {engine}, seed {job.config['seed']}")
            try:
                execute(job, say)
                cells[engine].append(read(job.folder))
            except Exception as error:
                complain(error, engine)
                errors[engine] = in_words(error) or f"{type(error).__name__}: {error}"
                if in_words(error) and not cells[engine]:
                    refused.add(engine)
    return [Row(engine, cells[engine], errors.get(engine), engine in refused) for engine in jobs]


def read(folder: Path) -> Cell:
    """The outcome of a stored run."""
    info = store.read_json(folder / "posterior.json")["info"]
    seconds = store.read_json(folder / "manifest.json")["seconds"]["engine"]
    summary = store.read_json(folder / "diagnostics.json")["summary"]
    scores = store.read_json(folder / "scores.json")
    return Cell(folder, scores, summary, float(seconds), info.get("evaluations"))


def exact_reference(job: Job) -> Summary | None:
    """The model's own exact posterior: mean and sd of each scalar; None where it has none."""
    from experiments.schema import build

    model = build(job.config["model"], "model")
    if not hasattr(model, "exact"):
        return None
    data = build(job.config["scenario"], "scenario").data
    mean, covariance = model.exact(model.prepare(data) if hasattr(model, "prepare") else data)[:2]
    sds = covariance.diagonal().sqrt()
    return {
        str(i): {"mean": float(m), "sd": float(s), "mcse": 0.0} for i, (m, s) in enumerate(zip(mean, sds, strict=True))
    }


def pooled(cells: list[Cell]) -> Summary:
    """Mean over seeds of means and sds; the standard error of the mean shrinks with their number."""
    import numpy as np

    names = [name for name in cells[0].summary if all(name in cell.summary for cell in cells)]
    column = lambda name, key: np.array([cell.summary[name][key] for cell in cells], dtype=float)  # noqa: E731
    return {
        name: {
            "mean": float(column(name, "mean").mean()),
            "sd": float(column(name, "sd").mean()),
            "mcse": float(np.sqrt(np.square(column(name, "mcse")).sum()) / len(cells)),
        }
        for name in names
    }


def against(summary: Summary, reference: Summary, by_position: bool) -> dict[str, float]:
    """mean_error_sd, sd_ratio and z_max of one summary against the reference."""
    import numpy as np

    pairs = list(zip(summary.values(), reference.values(), strict=True)) if by_position else []
    if not by_position:
        pairs = [(summary[name], reference[name]) for name in summary if name in reference]
    pairs = [(own, ref) for own, ref in pairs if ref["sd"] > 0 and own["sd"] > 0]
    if not pairs:
        return {}
    gap = np.array([own["mean"] - ref["mean"] for own, ref in pairs])
    sd, ratio = np.array([[ref["sd"], own["sd"] / ref["sd"]] for own, ref in pairs]).T
    error = np.array([np.hypot(own["mcse"], ref["mcse"]) for own, ref in pairs])
    return {
        "mean_error_sd": float(np.sqrt(np.mean(np.square(gap / sd)))),
        "sd_ratio": float(np.exp(np.log(ratio).mean())),
        "z_max": float(np.abs(gap / error).max()),
    }


def reference_of(rows: list[Row], best: str | None) -> str | None:
    """The engine that the others are measured by: `best` where it ran, else the first that did."""
    ran = [row.engine for row in rows if row.cells]
    return best if best in ran else next(iter(ran), None)


def fewest(summary: Summary) -> float | None:
    """Effective draws of the scalar that has the fewest."""
    sizes = [row["ess_bulk"] for row in summary.values() if row.get("ess_bulk") is not None]
    return min(sizes, default=None)


def tabulate(rows: list[Row], exact: Summary | None, best: str | None = None) -> list[dict[str, Any]]:
    """One record for each engine: mean and sd over its seeds of every score, and its distance to the reference: the
    exact posterior, else that of the engine `best`, else that of the first that ran.

    Scores that are 0 or 1 have their share alone, which says all."""
    import numpy as np

    first = reference_of(rows, best)
    reference = exact or next((pooled(row.cells) for row in rows if row.engine == first), {})
    records = []
    for row in rows:
        record: dict[str, Any] = {"engine": row.engine, "seeds": len(row.cells), "error": row.error}
        if row.cells:
            columns = {name: [c.scores.get(name) for c in row.cells] for name in row.cells[0].scores}
            columns |= {"time_s": [c.seconds for c in row.cells], "evaluations": [c.evaluations for c in row.cells]}
            columns |= {"ess_min": [fewest(c.summary) for c in row.cells]}
            for name, values in columns.items():
                known = np.array([v for v in values if v is not None], dtype=float)
                centre = np.median if name == "time_s" else np.mean
                record[name] = float(centre(known)) if len(known) else None
                varies = len(known) > 1 and not np.isin(known, (0.0, 1.0)).all()
                record[f"{name}:sd"] = float(known.std(ddof=1)) if varies else None
            if exact or row.engine != first:
                record |= against(pooled(row.cells), reference, by_position=exact is not None)
        records.append(record)
    return records


def main() -> None:
    """`python -m experiments.compare`."""
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    sys.exit(guarded(lambda: compare(sys.argv[1:])))


def compare(words: list[str]) -> None:
    """Plan, run, tabulate, store. Raises JobFailed at the end where an engine failed: one that refuses
    the model only if it was asked for by name or none is left."""
    try:
        chosen = plan(words)
    except OverrideParseException as error:
        raise ConfigError(in_words(error)) from error
    jobs = jobs_of(chosen)
    rows = gather(jobs)
    first = jobs[chosen.engines[0]][0]
    exact = exact_reference(first) if any(row.cells for row in rows) else None
    records = tabulate(rows, exact, chosen.reference)
    key = hashlib.sha256("".join(job.name for jobs_ in jobs.values() for job in jobs_).encode()).hexdigest()[:8]
    pair = first.name.removesuffix(first.name[first.name.rindex(f"-{chosen.engines[0]}-") :])
    folder = first.folder.parent / f"compare-{pair}-{key}"
    best = reference_of(rows, chosen.reference)
    title = "exact posterior" if exact else f"posterior of {best}" if best else "none, no engine ran"
    write(folder, records, rows, f"reference: {title}")
    print_table(records, f"reference: {title}")
    print(f"report     {folder / 'report.html'}")
    if best is None or any(row.error and (chosen.named or not row.refused) for row in rows):
        raise JobFailed(1)


def _columns(records: list[dict[str, Any]]) -> list[str]:
    names = dict.fromkeys(name for record in records for name in record)
    return [name for name in names if name not in ("engine", "error") and not name.endswith(":sd")]


def _entry(record: dict[str, Any], name: str) -> str:
    from experiments.report import number

    value, spread = record.get(name), record.get(f"{name}:sd")
    if value is None:
        return "–"
    return number(value) + (f" ± {spread:.2g}" if spread else "")


def print_table(records: list[dict[str, Any]], caption: str) -> None:
    """The table on the terminal, a column for each engine; one that failed has its error in a line of its own."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from experiments.report import head

    console = Console()
    console.width = console.width if console.is_terminal else 160
    table = Table("", *(record["engine"] for record in records), caption=caption)
    for name in _columns(records):
        table.add_row(Text(head(name)), *(_entry(record, name) for record in records))
    console.print(table)
    for record in records:
        if record["error"]:
            console.print(f"{record['engine']}: {record['error']}", style="red", soft_wrap=True, markup=False)


def write(folder: Path, records: list[dict[str, Any]], rows: list[Row], caption: str) -> None:
    """compare.csv, compare.json and a self-contained report.html in a folder of their own."""
    from experiments.report import details, head, page, table

    heads = ("", *(record["engine"] for record in records))
    entries = [(head(name), *(_entry(record, name) for record in records)) for name in _columns(records)]
    failed = [(record["engine"], record["error"]) for record in records if record["error"]]
    runs = {row.engine: [cell.folder.name for cell in row.cells] for row in rows}
    body = [f"<h1>{folder.name}</h1><p class='sub'>mean ± sd over seeds; {caption}</p>"]
    body += [table(heads, entries)]
    body += ["<h2>Failed</h2>", table(("engine", "error"), failed)] if failed else []
    body += ["<h2>What the columns mean</h2><pre>", "\n".join((__doc__ or "").splitlines()[7:-1]), "</pre>"]
    body += [details("runs", runs)]
    with store.writing(folder) as temporary:
        store.write_json(temporary / "compare.json", {"records": records, "runs": runs})
        store.write_rows(temporary / "compare.csv", records)
        (temporary / "report.html").write_text(page(folder.name, "".join(body)))


if __name__ == "__main__":
    main()
