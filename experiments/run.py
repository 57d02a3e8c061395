"""One experiment: scenario -> model -> engine -> posterior -> metrics -> figures -> report.

    waybayes scenario=line model=gaussian engine=rjmcmc seed=1
    waybayes -m seed=0,1,2                     a sweep; what is done already is skipped
    waybayes experiment=demo --cfg job         shows every setting, runs nothing

`run` is the same for use from Python, where nothing is stored.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import hydra
from omegaconf import DictConfig

from experiments import store
from experiments.command import Incomplete, guarded, in_short, one_job, plain
from experiments.schema import build
from experiments.signatures import ConfigError

if TYPE_CHECKING:  # torch and matplotlib take seconds to import: help and skipped runs need neither
    from matplotlib.figure import Figure

    from experiments.scenarios.scene import Scene
    from inference.posterior import Posterior

Engine = Callable[..., "Posterior"]
Metric = Callable[["Posterior", "Scene"], dict[str, float]]
Draw = Callable[["Posterior", "Scene"], dict[str, "Figure"]]
LISTS = ("functionals", "metrics", "figures", "compare_figures")
SETTINGS = {"scenario", "model", "engine", "seed", "runs", "force", *LISTS}
REMARKED = 100  # draws that a model looks at for its remarks
Functional = Callable[["Posterior"], dict[str, Any]]


class Result(NamedTuple):
    """What a run found out.

    scores       {metric: value}, units at the end of the names
    diagnostics  {scalar: mean, sd, r_hat, ess_bulk, mcse} (inference.diagnostics.summary)
    flags        what speaks against the draws, in words
    figures      {name: figure}
    seconds      {stage: seconds}, and under "engine, processor" the processor time of that stage
    failures     {what failed once the engine had run: its exception}; the rest is complete
    """

    scene: Scene
    posterior: Posterior
    scores: dict[str, float]
    diagnostics: dict[str, dict[str, float]]
    flags: list[str]
    figures: dict[str, Figure]
    seconds: dict[str, float]
    failures: dict[str, Exception]


def run(
    scenario: Callable[[], Scene],
    model: Any,
    engine: Engine,
    *,
    seed: int = 0,
    functionals: Iterable[Functional] = (),
    metrics: Iterable[Metric] = (),
    figures: Iterable[Draw] = (),
    say: Callable[[str], None] = lambda line: None,
    warm_up: bool = False,
) -> Result:
    """Run one experiment. Raises InputError where scenario, model and engine do not fit.

    warm_up      run the engine once before, unmeasured: no compilation then counts in its seconds
    functionals  posterior -> {name: (chain, draw)}, further scalars for the diagnostics: where slots hold
                 a set, only what no relabelling changes can be compared between draws

    What fails once the engine has run takes nothing else with it: it is listed under `failures`."""
    from inference import diagnostics
    from inference.progress import announce

    seconds: dict[str, float] = {}
    failures: dict[str, Exception] = {}

    @contextmanager
    def stage(name: str) -> Any:
        start = time.perf_counter()
        yield
        seconds[name] = time.perf_counter() - start

    def attempt(what: str, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        try:
            return work()
        except Exception as error:
            failures[what] = error
            return {}

    def collect(kind: str, functions: Iterable[Callable[..., dict[str, Any]]], *given: Any) -> dict[str, Any]:
        parts = [attempt(f"{kind} {_name(function)}", partial(function, *given)) for function in functions]
        return {name: value for part in parts for name, value in part.items()}

    with stage("scenario"):
        scene = scenario()
        check_read(scene)
    say(f"scenario   {scene.name}")
    with stage("prepare"), announce("compiling the model", after=4.0):
        evidence = evidence_of(model, scene)
    say(f"model      {type(model).__name__}")
    if warm_up:
        _infer(engine, model, evidence, engine_seed(seed))
    worked = time.process_time()
    with stage("engine"):
        posterior = _infer(engine, model, evidence, engine_seed(seed))
    seconds["engine, processor"] = time.process_time() - worked
    if hasattr(model, "labels"):
        posterior = replace(posterior, labels=model.labels(evidence))
    say(f"posterior  {' x '.join(map(str, posterior.shape))} draws in {seconds['engine']:.2f} s")
    with stage("metrics"):
        scores = {name: float(value) for name, value in collect("metric", metrics, posterior, scene).items()}
    with stage("diagnostics"):
        scalars = collect("functional", functionals, posterior)
        judged = replace(posterior, draws=posterior.draws | scalars)
        found = attempt("diagnostics", lambda: {"summary": diagnostics.summary(judged)})
        poor = list(getattr(evidence, "flags", ()))  # what the model says against its evidence
        if hasattr(model, "remarks"):
            poor += attempt("remarks", lambda: {"": model.remarks(evidence, posterior.resample(REMARKED, 0))}).get(
                "", []
            )
        found |= attempt("flags", lambda: {"flags": poor + diagnostics.flags(judged)})
    with stage("figures"):
        drawn = collect("figure", figures, posterior, scene)
    return Result(scene, posterior, scores, found.get("summary", {}), found.get("flags", []), drawn, seconds, failures)


def evidence_of(model: Any, scene: Scene) -> Any:
    """What a model makes of a scene. Raises InputError where they do not fit, and for a program that does not run."""
    from models.program import check

    check_read(scene)
    check_reads(model, scene.data)
    evidence = model.prepare(scene.data) if hasattr(model, "prepare") else scene.data
    check(model, evidence)
    return evidence


def check_read(scene: Scene) -> None:
    """Raise InputError for a scene without data."""
    from models.program import InputError

    if not hasattr(scene, "data"):
        raise InputError(
            f"scenario {scene.name} is one to drive in, not to learn from; `python -m experiments.drive` drives it"
        )


def _infer(engine: Engine, model: Any, evidence: Any, seed: int) -> Posterior:
    """The engine's posterior."""
    with remedies(model, evidence):
        return engine(model, evidence, seed=seed)


@contextmanager
def remedies(model: Any, evidence: Any) -> Iterator[None]:
    """Where an engine refuses a model's latents or densities, name engines that run it."""
    from models.capability import HasSteps
    from models.multi_object import HasObjects
    from models.program import InputError

    try:
        yield
    except InputError as error:
        name, many = type(model).__name__, isinstance(model, HasObjects)
        if "fix()" not in str(error) and not (many and "moves()" in str(error)):
            raise
        if many:
            about, fit = f"{name} is of many objects that come and go", "engine=lmb, lmb_smoothed or track_mcmc"
        elif hasattr(model, "moves"):
            about = f"{name} has an unknown number of parts, and this engine takes a known one"
            fit = "engine=rjmcmc or smc_structure"
            if hasattr(model, "kernel") and model.kernel(evidence).num_edits:  # a greedy search can polish it
                fit = (
                    "engine=rjmcmc_structure, rjmcmc or smc_structure, which find it, or bbvi_structure, which goes on "
                    "with the best structure"
                )
        elif isinstance(model, HasSteps):
            about, fit = f"{name} goes on from frame to frame", "engine=particle_filter, or smc for all frames at once"
        else:
            raise
        raise InputError(f"{about}; choose {fit} (from Python: {error})") from error


def _name(function: Any) -> str:
    return str(getattr(getattr(function, "func", function), "__name__", function))


def engine_seed(seed: int) -> int:
    """The engine's own seed, a child of the run's."""
    import numpy as np

    return int(np.random.SeedSequence(seed).spawn(1)[0].generate_state(1)[0])


def check_reads(model: Any, data: Any) -> None:
    """Raise InputError where a model's annotation, of prepare() if it has one, says that it reads other data."""
    from typing import get_type_hints

    from models.program import InputError

    reads = getattr(type(model), "prepare", type(model).__call__)
    expected = next((hint for name, hint in get_type_hints(reads).items() if name != "return"), Any)
    if isinstance(expected, type) and expected is not Any and not isinstance(data, expected):
        raise InputError(
            f"model {type(model).__name__} reads {expected.__name__}, but the scenario gives "
            f"{type(data).__name__}; choose a scenario that fits the model"
        )


class Job(NamedTuple):
    """A composed config, resolved, with the folder its outcome belongs in."""

    config: dict[str, Any]
    folder: Path
    force: bool

    @property
    def name(self) -> str:
        return self.folder.name


def job_of(config: DictConfig, choices: dict[str, str]) -> Job:
    """Where the outcome of a composed config belongs.

    Raises where a value cannot be resolved, ConfigError for seeds and lists that no run can take."""
    settings = plain(config)
    check_settings(settings, SETTINGS, LISTS)
    root, force = Path(settings.pop("runs")), settings.pop("force")
    title = "-".join(str(choices[part]) for part in ("scenario", "model", "engine"))
    return Job(settings, root / f"{title}-{store.identity(settings)}", force)


def check_settings(settings: dict[str, Any], known: set[str], lists: Iterable[str]) -> None:
    """Raise ConfigError for what would fail late, when all has worked for nothing, or be read by nobody."""
    if unknown := sorted(settings.keys() - known):
        raise ConfigError(f"no setting is called '{unknown[0]}'; there are {', '.join(sorted(known))}")
    for name, seed in (("seed", settings["seed"]), ("scenario.seed", settings["scenario"].get("seed"))):
        if isinstance(seed, int) and seed < 0:
            raise ConfigError(f"{name} is {seed}; choose 0 or more")
    for name in lists:
        value = settings[name]
        if not isinstance(value, list) or not all(isinstance(v, dict) and v.get("_partial_") for v in value):
            raise ConfigError(
                f"{name} is '{value}'; give a list of functions, each {{_target_: module.function, _partial_: true}}, "
                f"or {name}=[] for none"
            )


_warm: set[str] = set()  # scenario, model and engine of runs that this process has done


def execute(job: Job, say: Callable[[str], None] = print, *, timed: bool = False) -> dict[str, float]:
    """Run a job and store its outcome, or read it where that is done already; the scores.

    timed  its seconds are to be compared: an engine that this process has not run yet runs once before, unmeasured,
           and what is stored without such a warm-up runs again

    Raises Incomplete, all else being stored, where something failed after the engine."""
    pair = job.name.rpartition("-")[0]
    if store.is_done(job.folder) and not job.force and (not timed or is_warm(job.folder)):
        say(f"done already: {job.folder} (force=true runs it again)")
        return dict(store.read_json(job.folder / "scores.json"))
    parts = {key: build(job.config[key], key) for key in ("model", "engine", "functionals", "metrics", "figures")}
    scenario = job.config["scenario"]
    warm_up = timed and pair not in _warm
    result = run(lambda: build(scenario, "scenario"), **parts, seed=job.config["seed"], say=say, warm_up=warm_up)
    failures = write(job, result, warm_up or pair in _warm)
    _warm.add(pair)
    if failures:
        raise Incomplete(job.folder, failures)
    return result.scores


def is_warm(folder: Path) -> bool:
    """Whether the engine of a stored run had run in its process before: then its seconds hold no compilation."""
    return bool(store.read_json(folder / "manifest.json").get("warm"))


def write(job: Job, result: Result, warm: bool = False) -> dict[str, Exception]:
    """Store a result in the folder of its job; all failures, those of writing figures and report included."""
    from experiments.junction_metrics import arms
    from experiments.lane_posterior import LanePosterior
    from experiments.report import save_figures, write_report
    from inference.diagnostics import summary
    from inference.tracks import Tracks

    seeds = {"run": job.config["seed"], "engine": engine_seed(job.config["seed"])}
    with store.writing(job.folder) as folder:
        store.write_json(folder / "scores.json", result.scores)
        store.write_json(folder / "diagnostics.json", {"summary": result.diagnostics, "flags": result.flags})
        result.posterior.save(folder)
        manifest = store.manifest(job.name, job.config, seeds, result.seconds, result.scene.info) | {"warm": warm}
        images, unsaved = save_figures(folder, result.figures)
        failures = result.failures | unsaved
        try:
            found = arms(result.posterior.estimate)
            if found:
                store.write_rows(folder / "arms.csv", found)
            lanes = result.posterior.table() if isinstance(result.posterior, LanePosterior) else []
            if isinstance(result.posterior, LanePosterior) and result.posterior.courses is not None:
                store.write_json(folder / "courses.json", summary(result.posterior.courses))
            tracks = result.posterior.table() if isinstance(result.posterior, Tracks) else []
            if tracks:
                store.write_rows(folder / "tracks.csv", tracks)
            tables = {"Arms found": found, "Lanes found": lanes, "Tracks found": tracks}
            write_report(folder, job.name, result, tables, images, failures, manifest)
        except Exception as error:
            failures["report"] = error
        store.write_json(folder / "manifest.json", manifest | {"failures": in_short(failures)})
    return failures


def show(folder: Path) -> None:
    """Print the arms and scores of a stored run, what speaks against its draws, and where the report is."""
    from rich.console import Console
    from rich.table import Table

    from experiments.report import number, split_unit

    scores = store.read_json(folder / "scores.json")
    table = Table("metric", "value", "unit")
    for name, value in scores.items():
        label, unit = split_unit(name)
        table.add_row(label, number(value), unit)
    console = Console()
    if (folder / "arms.csv").exists():
        arms = store.read_rows(folder / "arms.csv")
        columns = [f"{label}\n[dim]{unit}[/]" if unit else label for label, unit in map(split_unit, arms[0])]
        found = Table(*columns, title="arms found", title_justify="left")
        for arm in arms:
            found.add_row(*(number(float(value)) for value in arm.values()))
        console.print(found)
    if scores:
        console.print(table)
    flags = store.read_json(folder / "diagnostics.json")["flags"]
    for flag in flags[:3]:
        console.print(f"flag       {flag}", style="yellow", soft_wrap=True, markup=False, highlight=False)
    if len(flags) > 3:
        more = f"{len(flags) - 3} more flag{'s' if len(flags) > 4 else ''}"
        console.print(f"           and {more} in the report", style="yellow")
    console.print(f"report     {folder / 'report.html'}", soft_wrap=True, highlight=False)


@hydra.main(config_path="pkg://configs", config_name="run", version_base="1.3")
def _launch(config: DictConfig) -> None:
    one_job("waybayes", lambda choices: job_of(config, choices), execute, show)


def main() -> None:
    """The console script `waybayes`."""
    sys.exit(guarded(_launch))


if __name__ == "__main__":
    main()
