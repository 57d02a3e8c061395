"""How good an estimated road course is after a part of the iterations: [T17]'s last experiment on simulated scenes.

    python -m experiments.anytime                      200 frozen scenes, from the prior and from the Laplace fit
    python -m experiments.anytime scenes=50 'engines=[bbvi,bbvi_overdispersed]' bbvi.num_steps=60

    TPR      share of all scenes whose course, the mean of q, is wholly inside the wide tube, .8 m + .015 r, 5 to 140 m
    FPR      share of all scenes where it is not, though a course is offered
    abstain  share of all scenes where none is offered, whatever the iterations: the draws at the end of the run are not
             trusted as far as 40 m (experiments.road_metrics)

100 % are the iterations needed: the first count whose TPR is within half a point of the last; none where the start is
there already. The paper gives neither its tube nor when it abstains. engines=[...] are any with a fixed number of
iterations and snapshots; every setting of `waybayes` works, ENGINE.knob=... of one engine alone. Engines that are done
are not run again (force=true insists).
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments import store
from experiments.command import guarded
from experiments.compare import plan, tasks_of
from experiments.schema import build
from experiments.signatures import ConfigError

if TYPE_CHECKING:  # numba and matplotlib take seconds to import: --help needs neither
    from matplotlib.figure import Figure

    from experiments.anytime_rates import Outcomes
    from experiments.run import Job

USUAL = ("bbvi_annealed", "bbvi_overdispersed")
SCENES = 200
STARTS = {"prior": "the prior", "laplace": "a Laplace fit"}  # by the engine's knob `transform`
COLOURS = ("#d1702c", "#2f6f9f", "#3b8a5a", "#7b3f9e", "#8a5a2b", "#c2459e")


def main() -> None:
    """`python -m experiments.anytime`."""
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    sys.exit(guarded(lambda: anytime(sys.argv[1:])))


def anytime(words: list[str]) -> None:
    """Sweep the scenes with each engine, tabulate, store. Raises ConfigError and InputError for what cannot run."""
    jobs, num = jobs_of(words)
    found = {engine: sweep(job, engine, num) for engine, job in jobs.items()}
    records = tabulate(found, {engine: job.config["engine"] for engine, job in jobs.items()})
    first = next(iter(jobs.values()))
    key = store.identity({"anytime": [job.name for job in jobs.values()], "scenes": num})
    folder = first.folder.parent / f"anytime-{first.config['scenario']['_target_'].rpartition('.')[2]}-{key}"
    write(folder, records, found, num, {engine: job.config for engine, job in jobs.items()})
    show(records, num)
    print(f"report     {folder / 'report.html'}")


def jobs_of(words: list[str]) -> tuple[dict[str, Job], int]:
    """{engine: its job, on the first scene} and the number of scenes."""
    keys = {word.partition("=")[0].lstrip("+") for word in words}
    for key in ("seeds", "reference"):
        if key in keys:
            raise ConfigError(f"anytime takes scenes=N, not {key}; the number of a scene is the engine's seed, too")
    words = words if keys & {"experiment", "scenario", "model"} else ["experiment=night_road", *words]
    chosen = plan(words if "scenes" in keys else [*words, f"scenes={SCENES}"], USUAL)
    assert chosen.scenes is not None
    jobs = {task.engine: task.job for task in tasks_of(chosen._replace(scenes=1))}
    for engine, job in jobs.items():
        if "num_steps" not in job.config["engine"]:
            raise ConfigError(
                f"anytime counts iterations, but engine={engine} takes no num_steps; choose one such as bbvi"
            )
    return jobs, chosen.scenes


def sweep(job: Job, engine: str, num: int) -> Outcomes:
    """Outcomes of an engine on scenes 0 to num - 1: read where they are stored, else computed and stored."""
    import numpy as np

    from experiments.anytime_rates import Outcomes, outcomes
    from experiments.run import check_read, check_reads

    file = job.folder.parent / f"anytime-{job.name}-{num}" / "outcomes.npz"
    if file.is_file() and not job.force:
        print(f"done already: {file.parent} (force=true runs it again)")
        with np.load(file, allow_pickle=False) as stored:
            return Outcomes(*(stored[name] for name in Outcomes._fields))
    model, run = build(job.config["model"], "model"), build(job.config["engine"], "engine")
    if "progress" in run.keywords:
        run = partial(run, progress=False)  # the bar of the sweep is the one
    scenario = job.config["scenario"]
    scene = build(scenario, "scenario")
    check_read(scene)
    check_reads(model, scene.data)
    scenes = (build(scenario | {"seed": seed}, "scenario") for seed in range(num))
    found = outcomes(run, model, scenes, num, f"anytime, {engine}", show=True)
    with store.writing(file.parent) as folder:
        np.savez_compressed(folder / file.name, allow_pickle=False, **found._asdict())
        store.write_json(folder / "config.json", job.config | {"scenes": num})
    print(f"{engine}: {num} scenes, TPR {found.tpr[-1]:.3f} after all {found.step[-1]:.0f} iterations")
    return found


def tabulate(found: dict[str, Outcomes], configs: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """A record for each engine and share of the iterations; the paper's last."""
    from experiments.anytime_rates import PAPER, QUARTERS, rows

    records: list[dict[str, Any]] = []
    for engine, one in found.items():
        knob = configs[engine].get("transform")
        records += [
            {"engine": engine, "start": STARTS.get(str(knob)), "scenes": len(one.offered)} | r for r in rows(one)
        ]
    for share, tpr, fpr in zip(QUARTERS, PAPER["tpr"], PAPER["fpr"], strict=True):
        paper = {"tpr": tpr, "fpr": fpr, "abstain": round(1.0 - tpr - fpr, 4)}
        records.append({"engine": "paper", "start": None, "scenes": None, "share": share, "steps": None} | paper)
    return records


def entries(records: list[dict[str, Any]]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Heads and rows: three outcomes for each engine, in % at each share of the iterations."""
    shares = list(dict.fromkeys(record["share"] for record in records))
    out = []
    for engine in dict.fromkeys(record["engine"] for record in records):
        own = [record for record in records if record["engine"] == engine]
        whole, start = own[-1]["steps"], own[0]["start"]
        abstains = "abstain" if whole is None else "abstain, at the end"
        for name, label in (("tpr", "TPR"), ("fpr", "FPR"), ("abstain", abstains)):
            cells = [
                f"{100 * r[name]:.1f}" + (f" ± {100 * r['tpr:se']:.1f}" if name == "tpr" and r.get("tpr:se") else "")
                for r in own
            ]
            steps = "–" if whole is None else f"{whole:.0f}" if whole else "none: there from the start"
            out.append((engine, start or "–", steps, f"{label} [%]", *cells))
    return ("engine", "begins at", "iterations needed (100 %)", "", *(f"{100 * share:.0f} %" for share in shares)), out


def caption(num: int) -> str:
    return (
        f"{num} scenes; TPR ± standard error, at shares of the iterations needed: up to the first count within half a "
        "point of the last TPR. Tubes and abstention are ours; the draws at the end of the run tell who abstains, "
        "at all shares alike, for along the way only means are kept"
    )


def show(records: list[dict[str, Any]], num: int) -> None:
    """The table on the terminal."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    console.width = console.width if console.is_terminal else 160
    heads, lines = entries(records)
    shown = Table(*heads, caption=caption(num))
    for line in lines:
        shown.add_row(*line, end_section=line[3].startswith("abstain"))
    console.print(shown)


def write(
    folder: Path, records: list[dict[str, Any]], found: dict[str, Outcomes], num: int, configs: dict[str, Any]
) -> None:
    """anytime.csv, anytime.json, the figure and a self-contained report.html."""
    from experiments.report import details, page, save_figures, table

    along = {engine: {"step": o.step, "tpr": o.tpr, "fpr": o.fpr, "abstain": o.abstain} for engine, o in found.items()}
    with store.writing(folder) as temporary:
        images, failures = save_figures(temporary, {"anytime": draw(records, found)})
        for error in failures.values():
            raise error
        body = [f"<h1>{folder.name}</h1><p class='sub'>{caption(num)}</p>", table(*entries(records)), *images.values()]
        body += ["<h2>What this is</h2><pre>", __doc__ or "", "</pre>", details("configs", configs)]
        store.write_json(temporary / "anytime.json", {"records": records, "along": along})
        store.write_rows(temporary / "anytime.csv", records)
        (temporary / "report.html").write_text(page(folder.name, "".join(body)))


def draw(records: list[dict[str, Any]], found: dict[str, Outcomes]) -> Figure:
    """Left: TPR and FPR by the share of the iterations, beside the paper. Right: both along the iterations."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import PercentFormatter

    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    colours = dict(zip(found, COLOURS * len(found), strict=False)) | {"paper": "#111111"}
    for engine, colour in colours.items():
        own = [record for record in records if record["engine"] == engine]
        begins = f", from {own[0]['start']}" if own[0]["start"] else ""
        share = [record["share"] for record in own]
        left.plot(share, [r["tpr"] for r in own], "o-", color=colour, lw=1.8, label=f"{engine}{begins}")
        left.plot(share, [r["fpr"] for r in own], "o:", color=colour, lw=1.4, mfc="white")
        if engine in found:
            one, whole = found[engine], own[-1]
            right.plot(one.step, one.tpr, color=colour, lw=1.8)
            right.plot(one.step, one.fpr, ":", color=colour, lw=1.4)
            right.plot(whole["steps"], whole["tpr"], "o", color=colour)
    title = "; ".join(f"{engine} abstains on {one.abstain:.1%} of the scenes" for engine, one in found.items())
    left.set(xlabel="share of the iterations needed", ylabel="share of all scenes", ylim=(-0.02, 1.02))
    left.set_xticks([0.25, 0.5, 0.75, 1.0])
    left.xaxis.set_major_formatter(PercentFormatter(1.0))
    left.yaxis.set_major_formatter(PercentFormatter(1.0))
    right.set(xlabel="iterations; the dot: those needed", xlim=(0, None))
    figure.suptitle(f"{title}; who abstains is told by the draws at the end of each run", fontsize=9, x=0.01, ha="left")
    for axes, title in ((left, "TPR solid, FPR dotted"), (right, "the same along the iterations")):
        axes.set_title(title, loc="left", fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="#e4e7ec", lw=0.6)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


if __name__ == "__main__":
    main()
