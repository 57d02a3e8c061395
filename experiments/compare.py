"""Many engines, seeds and scenes on one model, in one table.

    python -m experiments.compare scenario=line model=gaussian 'engines=[rjmcmc,least_squares]' seeds=3
    python -m experiments.compare scenario=night_road 'engine=[least_squares,bbvi,importance]' scenes=20

engines=[...] (or engine=[...]) names the engines; seeds=N runs seeds 0 to N - 1 of each, 3 where there is one scene,
else 1; scenes=N the scenes scenario.seed=0 to N - 1. Every setting of `waybayes` works here too; `rjmcmc.thin=10` sets
a knob of one engine alone. scenario=NAME without model and experiment brings those of experiment=NAME, if there is one.
Each cell is an ordinary stored run, so a comparison resumes and grows without repeating work.

Behind a score stand, of one scene, the standard deviation over seeds; of many, the standard error over scenes.

    evaluations     of the density, mean over runs

    ess_min         effective draws of the scalar that has the fewest

    time_ms         of the engine by its own clock, median over runs

    processor_ms    of the whole call of the engine, the densities of its snapshots included, median over runs

    to_accuracy_ms  time after which the engine's best state stays, rms over scalars, within half a reference sd of the
                    reference mean; last in line is the posterior mean at the end of the run, all that an engine without
                    snapshots has. The median over runs: never where half of them or more do not end so

    accurate        share of the runs that do

    mean_error_sd   rms over scalars of (mean - reference mean) / reference sd

    sd_ratio        geometric mean over scalars of sd / reference sd

    z_max           largest |mean - reference mean| / standard error, standard errors from the ESS, all seeds pooled:
                    past about 3 (4 over many scenes) the engine is biased

Times are those of warm engines: in a process where an engine has not run yet, it runs once unmeasured before the first
run that counts, and stored runs that were not timed so run again. The reference is the model's exact posterior where it
has one, else that of the engine reference=NAME, else that of the first engine that ran, each scene by itself.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException
from omegaconf import open_dict

from experiments import store
from experiments.command import JobFailed, complain, guarded, in_words
from experiments.compare_cells import Cell, Row, read
from experiments.run import Job, evidence_of, execute, job_of, remedies
from experiments.schema import build
from experiments.signatures import ConfigError
from experiments.store import ROOT

USUAL = ("rjmcmc", "least_squares")


class Plan(NamedTuple):
    """What to compare.

    scenes     how many scenario.seed are run; None leaves the scenario as it is
    shared     settings of every run
    own        {engine: its settings}
    named      whether the engines were asked for by name; one of the usual ones may refuse a model
    reference  the engine that the others are measured by; None takes the first that ran
    """

    engines: list[str]
    seeds: int
    scenes: int | None
    shared: list[str]
    own: dict[str, list[str]]
    named: bool
    reference: str | None = None


class Task(NamedTuple):
    """A run of a plan."""

    engine: str
    scene: int
    seed: int
    job: Job


def plan(words: list[str], usual: tuple[str, ...] = USUAL) -> Plan:
    """Read the command line. Raises ConfigError for words that say nothing."""
    engines: list[str] = []
    counts: dict[str, int | None] = {"seeds": None, "scenes": None}
    rest, reference = [], None
    try:
        overrides = OverridesParser.create().parse_overrides(words)
    except OverrideParseException as error:
        raise ConfigError(in_words(error)) from error
    for word, override in zip(words, overrides, strict=True):
        key, value = override.key_or_group, override.value()
        if key in ("engines", "engine"):
            if engines:
                raise ConfigError(f"engines are named twice, the second time by {word}; give one list")
            if override.is_sweep_override():
                raise ConfigError(f"{word} is no list; write '{key}=[{word.partition('=')[2]}]', quoted")
            engines = [str(name) for name in (value if isinstance(value, list) else [value])]
            if not engines:
                raise ConfigError(f"{key} is empty; name one or more, such as {key}=[rjmcmc,least_squares]")
            if len(set(engines)) < len(engines):
                raise ConfigError(f"{word} names an engine twice; name each once")
        elif key in counts:
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ConfigError(f"{key} is '{value}'; give how many {key} to run, 1 or more")
            counts[key] = value
        elif key == "reference":
            reference = str(value)
        elif key == "seed":
            raise ConfigError(f"a comparison takes seeds=N, not {word}")
        else:
            rest.append(word)
    named, engines = bool(engines), engines or list(usual)
    if reference is not None and reference not in engines:
        raise ConfigError(f"reference is '{reference}', which does not run; choose one of {', '.join(engines)}")
    if counts["scenes"] is not None and any(word.lstrip("+").startswith("scenario.seed=") for word in rest):
        raise ConfigError("scenes=N runs scenario.seed=0 to N - 1; give scenes or scenario.seed, not both")
    heads = {word: word.lstrip("+~").partition(".")[0] for word in rest}
    own = {e: [_for_engine(word, e) for word in rest if heads[word] == e] for e in engines}
    shared = [word for word in rest if heads[word] not in engines]
    seeds = counts["seeds"] or (3 if counts["scenes"] is None else 1)
    return Plan(engines, seeds, counts["scenes"], _whole(shared), own, named, reference)


def _for_engine(word: str, engine: str) -> str:
    """'rjmcmc.num_steps=5' -> 'engine.num_steps=5'."""
    return word.replace(engine, "engine", 1)


def _whole(words: list[str]) -> list[str]:
    """The settings, where a scenario stands without model and experiment with the experiment of its name."""
    given = dict(word.partition("=")[::2] for word in words)
    name = given.get("scenario")
    if name is None or {"model", "experiment"} & given.keys() or not _experiment(name).is_file():
        return words
    return [f"experiment={name}", *words]


def _experiment(name: str) -> Path:
    return ROOT / "configs" / "experiment" / f"{name}.yaml"


def tasks_of(plan: Plan) -> list[Task]:
    """Every run of a plan, composed and checked before the first one starts: all engines of one scene and seed first,
    so that what cannot work says so at once."""
    tasks = []
    with initialize_config_module("configs", version_base="1.3"):
        for scene in range(plan.scenes or 1):
            of_scene = [] if plan.scenes is None else [f"scenario.seed={scene}"]
            for seed in range(plan.seeds):
                for engine in plan.engines:
                    words = [*plan.shared, *of_scene, f"engine={engine}", f"seed={seed}", *plan.own[engine]]
                    config = compose("run", words, return_hydra_config=True)
                    choices = dict(config.hydra.runtime.choices)
                    with open_dict(config):
                        del config["hydra"]
                    tasks.append(Task(engine, scene, seed, job_of(config, choices)))
    return tasks


def gather(tasks: list[Task], say: Callable[[str], None] = print) -> list[Row]:
    """Run what is not done yet, and read all of it."""
    engines = list(dict.fromkeys(task.engine for task in tasks))
    cells: dict[str, list[Cell]] = {engine: [] for engine in engines}
    errors: dict[str, str] = {}
    refused: set[str] = set()
    for number, (engine, scene, seed, job) in enumerate(tasks, start=1):
        if engine in errors:
            continue
        lines: list[str] = []
        try:
            execute(job, lines.append, timed=True)
            cells[engine].append(read(job, scene))
            told = "done already" if lines[0].startswith("done") else f"{cells[engine][-1].ms:.4g} ms"
            say(f"[{number}/{len(tasks)}] {engine}, scene {scene}, seed {seed}: {told}")
        except Exception as error:
            complain(error, engine)
            errors[engine] = in_words(error) or f"{type(error).__name__}: {error}"
            if in_words(error) and not cells[engine]:
                refused.add(engine)
    return [Row(engine, cells[engine], errors.get(engine), engine in refused) for engine in engines]


def refusals(tasks: list[Task]) -> dict[str, Exception]:
    """{engine: why it refuses the model}, asked of all engines before one works, as far as they tell then
    (inference.refusal). The first scene speaks for all; engines that are stored on it have run the model already."""
    first = {task.engine: task.job for task in reversed(tasks)}
    new = {engine: job for engine, job in first.items() if job.force or not store.is_done(job.folder)}
    if not new:
        return {}
    from inference.refusal import ask

    config, found = next(iter(new.values())).config, dict[str, Exception]()
    model = build(config["model"], "model")
    evidence = evidence_of(model, build(config["scenario"], "scenario"))
    for engine, job in new.items():
        try:
            with remedies(model, evidence):
                ask(build(job.config["engine"], "engine"), model, evidence)
        except Exception as error:
            if not in_words(error):
                continue  # no refusal: let it fail, and say how, where it runs
            found[engine] = error
    return found


def exact_reference(job: Job) -> list[dict[str, float]] | None:
    """The model's own exact posterior: mean and sd of each scalar in order; None where it has none."""
    model = build(job.config["model"], "model")
    if not hasattr(model, "exact"):
        return None
    data = build(job.config["scenario"], "scenario").data
    mean, covariance = model.exact(model.prepare(data) if hasattr(model, "prepare") else data)[:2]
    sds = covariance.diagonal().sqrt()
    return [{"mean": float(m), "sd": float(s), "mcse": 0.0} for m, s in zip(mean, sds, strict=True)]


def reference_of(rows: list[Row], best: str | None) -> str | None:
    """The engine that the others are measured by: `best` where it ran, else the first that did."""
    ran = [row.engine for row in rows if row.cells]
    return best if best in ran else next(iter(ran), None)


def main() -> None:
    """`python -m experiments.compare`."""
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    sys.exit(guarded(lambda: compare(sys.argv[1:])))


def compare(words: list[str]) -> None:
    """Plan, run, tabulate, store. Raises JobFailed with exit code 2, before any engine works, where one that was asked
    for by name refuses the model; with 1 at the end where an engine failed."""
    chosen = plan(words)
    tasks = tasks_of(chosen)
    refused = refusals(tasks)
    for engine, error in refused.items():
        complain(error, engine)
    if refused and chosen.named:
        raise JobFailed(2)
    rows = gather([task for task in tasks if task.engine not in refused])
    rows += [Row(engine, [], in_words(error), True) for engine, error in refused.items()]
    conclude(chosen, tasks, rows)
    if all(row.refused for row in rows):
        raise JobFailed(2)
    if any(row.error and (chosen.named or not row.refused) for row in rows):
        raise JobFailed(1)


def conclude(plan: Plan, tasks: list[Task], rows: list[Row]) -> None:
    """Table, figures and report of what ran."""
    from experiments.compare_report import draw, print_table, write
    from experiments.compare_table import exact_references, own_references, tabulate

    best = reference_of(rows, plan.reference)
    exact = {task.scene: exact_reference(task.job) for task in tasks if task.engine == best and task.seed == 0}
    known = {scene: rows for scene, rows in exact.items() if rows is not None}
    references = exact_references(rows, known) if known else own_references(rows, best)
    records = tabulate(rows, references, None if known else best)
    title = "exact posterior" if known else f"posterior of {best}" if best else "none, no engine ran"
    over = f"{plan.scenes} scenes" if plan.scenes else "one scene"
    behind = "± standard error over scenes" if (plan.scenes or 1) > 1 else "± sd over seeds"
    caption = f"{over}, {plan.seeds} seed{'s' * (plan.seeds > 1)}; {behind}; reference: {title}"
    first = tasks[0].job
    key = hashlib.sha256("".join(task.job.name for task in tasks).encode()).hexdigest()[:8]
    pair = first.name.removesuffix(first.name[first.name.rindex(f"-{plan.engines[0]}-") :])
    folder = first.folder.parent / f"compare-{pair}-{key}"
    figures, failures = draw(tasks, rows, references)
    write(folder, records, rows, caption, figures, failures, __doc__ or "")
    print_table(records, caption)
    print(f"report     {folder / 'report.html'}")


if __name__ == "__main__":
    main()
