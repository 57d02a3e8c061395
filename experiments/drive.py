"""One drive in closed loop: scenario -> driver -> planner -> control -> metrics -> figures -> report.

    python -m experiments.drive scenario=drive_follow seed=1
    python -m experiments.drive -m scenario=drive_follow,drive_merge     a sweep; what is done already is skipped
    python -m experiments.drive scenario=drive_follow --cfg job          shows every setting, drives nothing

A scenario is any callable that returns a DriveScene (experiments.scenarios.driving), a driver any callable that returns
a Mind (experiments.closed_loop); examples/cyclist_ahead has one of each. `drive` of experiments.closed_loop
is the same for use from Python, where nothing is stored.
"""

from __future__ import annotations

import re
import sys
import time
from collections import Counter
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from omegaconf import DictConfig

from experiments import store
from experiments.command import Incomplete, guarded, in_short, one_job, plain
from experiments.run import Job, check_settings
from experiments.schema import build

if TYPE_CHECKING:
    from experiments.closed_loop import Drive

LISTS = ("metrics", "figures")
PARTS = ("driver", "planner", "loop", *LISTS)
SETTINGS = {"scenario", "seed", "runs", "force", *PARTS}


def job_of(config: DictConfig, choices: dict[str, str]) -> Job:
    """Where the outcome of a composed config belongs; raises as experiments.run.job_of does."""
    settings = plain(config)
    check_settings(settings, SETTINGS, LISTS)
    root, force = Path(settings.pop("runs")), settings.pop("force")
    title = f"{choices['scenario']}-{choices['planner']}"
    return Job(settings, root / f"{title}-{store.identity(settings)}", force)


def execute(job: Job, say: Callable[[str], None] = print) -> dict[str, float]:
    """Drive and store the outcome, or read it where that is done already; the scores.

    Raises InputError for a scenario that is none to drive in, Incomplete, all else being stored, where a metric or a
    figure failed."""
    if store.is_done(job.folder) and not job.force:
        say(f"done already: {job.folder} (force=true runs it again)")
        return dict(store.read_json(job.folder / "scores.json"))
    from experiments.closed_loop import drive
    from experiments.scenarios.driving import DriveScene
    from models.program import InputError

    parts = {key: build(job.config[key], key) for key in PARTS}
    scene = build(job.config["scenario"], "scenario")
    if not isinstance(scene, DriveScene):
        name = getattr(scene, "name", type(scene).__name__)
        raise InputError(f"scenario {name} is none to drive in; choose one whose name begins with drive_")
    say(f"scenario   {scene.name}, {scene.duration:g} s")
    seconds: dict[str, float] = {}
    began = time.perf_counter()
    found = drive(scene, parts["driver"], parts["planner"], parts["loop"], seed=job.config["seed"], progress=True)
    seconds["drive"] = time.perf_counter() - began
    seconds["building"] = float(found.log.building.sum())
    of_it = f", of it {seconds['building']:.1f} s to build problems of optimal control" if seconds["building"] else ""
    say(f"driven     {len(found.plans)} cycles in {seconds['drive']:.1f} s{of_it}")
    failures: dict[str, Exception] = {}

    def collect(kind: str) -> dict[str, Any]:
        began = time.perf_counter()
        out: dict[str, Any] = {}
        for function in parts[kind]:
            name = getattr(function, "func", function).__name__
            try:
                out |= function(found)
            except Exception as error:  # one metric or picture less loses nothing else
                failures[f"{kind.removesuffix('s')} {name}"] = error
        seconds[kind] = time.perf_counter() - began
        return out

    scores, figures = collect("metrics"), collect("figures")
    if failures := write(job, found, scores, figures, seconds, failures):
        raise Incomplete(job.folder, failures)
    return scores


def write(
    job: Job,
    found: Drive,
    scores: dict[str, float],
    figures: dict[str, Any],
    seconds: dict[str, float],
    failures: dict[str, Exception],
) -> dict[str, Exception]:
    """Store a drive in the folder of its job; all failures, those of saving figures included."""
    import numpy as np

    from experiments.report import save_figures

    info = {"name": found.scene.name, **found.scene.info}
    with store.writing(job.folder) as folder:
        store.write_json(folder / "scores.json", scores)
        np.savez_compressed(folder / "drive.npz", **found.log._asdict())
        store.write_rows(folder / "cycles.csv", cycles(found))
        manifest = store.manifest(job.name, job.config, {"run": job.config["seed"]}, seconds, info)
        images, unsaved = save_figures(folder, figures)
        failures = failures | unsaved
        (folder / "report.html").write_text(report(job, found, scores, images, failures, manifest))
        store.write_json(folder / "manifest.json", manifest | {"failures": in_short(failures)})
    return failures


def cycles(found: Drive) -> list[dict[str, Any]]:
    """What each cycle did, in rows."""
    log = found.log
    told = {
        "time_s": log.cycle,
        "cycle_ms": log.ms,
        "tier": log.tier,
        "clear": log.clear,
        "cost": log.cost,
        "plan_cost": log.plan_cost,
        "refined": log.refined,
        "unrefined": log.unrefined,
        "consistency_m": log.consistency,
        "thought": log.words,
        "stated": log.stated,
    }
    rows = [dict(zip(told, map(_plain, row), strict=True)) for row in zip(*told.values(), strict=True)]
    for row, made in zip(rows, found.plans, strict=True):
        row["rejected"] = ", ".join(f"{reason} {count}" for reason, count in made.rejected.items())
    return rows


def touches(found: Drive) -> list[tuple[str, str, str]]:
    """Who was touched: when first [s], what, and whose fault it is, in words."""
    from experiments.closed_loop_metrics import contacts

    return [
        (f"{one.time:.2f}", f"road user {one.actor}" if one.actor >= 0 else "boundary line", one.excuse or "at fault")
        for one in contacts(found)
    ]


def _plain(value: Any) -> Any:
    value = value.item()
    return round(value, 6) if isinstance(value, float) else value


def report(
    job: Job,
    found: Drive,
    scores: dict[str, float],
    images: dict[str, str],
    failures: dict[str, Exception],
    manifest: dict[str, Any],
) -> str:
    """The drive as one page that needs nothing else."""
    from experiments.report import details, failure_boxes, page, scores_table, table

    touched = touches(found)
    stated = [(f"{at:.2f}", why) for at, why in zip(found.log.cycle, found.log.stated, strict=True) if why]
    thought = [("0.00", found.log.words[0])]
    for at, words in zip(found.log.cycle[1:], found.log.words[1:], strict=True):
        if re.sub(r"[\d.]+", "", words) != re.sub(r"[\d.]+", "", thought[-1][1]):
            thought.append((f"{at:.2f}", words))
    turned_down: dict[str, int] = {}
    for made in found.plans:
        for reason, count in made.rejected.items():
            turned_down[reason] = turned_down.get(reason, 0) + count
    unrefined = Counter(str(why) for why in found.log.unrefined if why).most_common()
    body = [
        f"<h1>{escape(job.name)}</h1>",
        f'<p class="sub">scene {escape(found.scene.name)} &middot; {escape(manifest["date"])}</p>',
        failure_boxes(failures),
        "<h2>Scores</h2>",
        scores_table(scores, manifest["config"]["metrics"]),
        "".join(f"<h2>{escape(name.replace('_', ' ').capitalize())}</h2>{image}" for name, image in images.items()),
        *(["<h2>Touched</h2>", table(("first at [s]", "what", "fault"), touched)] if touched else []),
        "<h2>Cycles that could not be planned</h2>",
        table(("time [s]", "why"), stated),
        "<h2>Candidates turned down</h2>",
        table(
            ("reason", "candidates cheaper than the plan, over all cycles"),
            sorted(turned_down.items(), key=lambda item: -item[1]),
        ),
        *(["<h2>Cycles that were not refined</h2>", table(("why", "cycles"), unrefined)] if unrefined else []),
        "<h2>What was thought</h2>",
        table(("from [s]", "thought"), thought),
        "<h2>Time</h2>",
        table(("stage", "seconds"), list(manifest["seconds"].items())),
        "<h2>Settings and provenance</h2>",
        details("config", manifest["config"]),
        details("manifest", {k: v for k, v in manifest.items() if k != "config"}),
    ]
    return page(job.name, "".join(body))


def show(folder: Path) -> None:
    """Print the scores of a stored drive and where the report is."""
    from rich.console import Console
    from rich.table import Table

    from experiments.report import number, split_unit

    table = Table("metric", "value", "unit")
    for name, value in store.read_json(folder / "scores.json").items():
        label, unit = split_unit(name)
        table.add_row(label, number(value), unit)
    console = Console()
    console.print(table)
    console.print(f"report     {folder / 'report.html'}", soft_wrap=True, highlight=False)


@hydra.main(config_path="pkg://configs", config_name="drive", version_base="1.3")
def _launch(config: DictConfig) -> None:
    one_job("drive", lambda choices: job_of(config, choices), execute, show)


def main() -> None:
    """`python -m experiments.drive`."""
    sys.exit(guarded(_launch))


if __name__ == "__main__":
    main()
