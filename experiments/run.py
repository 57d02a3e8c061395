"""One experiment: scenario -> model -> engine -> posterior -> metrics -> figures -> report.

    waybayes scenario=line model=gaussian engine=rjmcmc seed=1
    waybayes -m seed=0,1,2                     a sweep; what is done already is skipped
    waybayes experiment=demo --cfg job         shows every setting, runs nothing

`run` is the same for use from Python, where nothing is stored.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from experiments import store
from experiments.command import JobFailed, complain, guarded, plain
from experiments.schema import build

if TYPE_CHECKING:  # torch and matplotlib take seconds to import: help and skipped runs need neither
    from matplotlib.figure import Figure

    from experiments.scenarios.scene import Scene
    from inference.posterior import Posterior

Engine = Callable[..., "Posterior"]
Metric = Callable[["Posterior", "Scene"], dict[str, float]]
Draw = Callable[["Posterior", "Scene"], dict[str, "Figure"]]


class Result(NamedTuple):
    """What a run found out.

    scores       {metric: value}, units at the end of the names
    diagnostics  {scalar: mean, sd, r_hat, ess_bulk, mcse} (inference.diagnostics.summary)
    flags        what speaks against the draws, in words
    figures      {name: figure}
    seconds      {stage: seconds}
    """

    scene: Scene
    posterior: Posterior
    scores: dict[str, float]
    diagnostics: dict[str, dict[str, float]]
    flags: list[str]
    figures: dict[str, Figure]
    seconds: dict[str, float]


def run(
    scenario: Callable[[], Scene],
    model: Any,
    engine: Engine,
    *,
    seed: int = 0,
    metrics: Iterable[Metric] = (),
    figures: Iterable[Draw] = (),
    say: Callable[[str], None] = lambda line: None,
) -> Result:
    """Run one experiment. Raises InputError where scenario, model and engine do not fit."""
    from inference import diagnostics
    from models.program import check

    seconds: dict[str, float] = {}

    @contextmanager
    def stage(name: str) -> Any:
        start = time.perf_counter()
        yield
        seconds[name] = time.perf_counter() - start

    with stage("scenario"):
        scene = scenario()
    say(f"scenario   {scene.name}")
    with stage("prepare"):
        evidence = model.prepare(scene.data) if hasattr(model, "prepare") else scene.data
        check_reads(model, evidence)
        check(model, evidence)
    say(f"model      {type(model).__name__}")
    with stage("engine"):
        posterior = engine(model, evidence, seed=engine_seed(seed))
    say(f"posterior  {' x '.join(map(str, posterior.shape))} draws in {seconds['engine']:.2f} s")
    with stage("metrics"):
        scores = {name: float(value) for metric in metrics for name, value in metric(posterior, scene).items()}
    with stage("diagnostics"):
        summary, flags = diagnostics.summary(posterior), diagnostics.flags(posterior)
    with stage("figures"):
        drawn = {name: figure for draw in figures for name, figure in draw(posterior, scene).items()}
    return Result(scene, posterior, scores, summary, flags, drawn, seconds)


def engine_seed(seed: int) -> int:
    """The engine's own seed, a child of the run's."""
    import numpy as np

    return int(np.random.SeedSequence(seed).spawn(1)[0].generate_state(1)[0])


def check_reads(model: Any, evidence: Any) -> None:
    """Raise InputError where a model's annotation says that it reads another kind of evidence."""
    from typing import get_type_hints

    from models.program import InputError

    expected = get_type_hints(type(model).__call__).get("evidence")
    if isinstance(expected, type) and not isinstance(evidence, expected):
        raise InputError(
            f"model {type(model).__name__} reads {expected.__name__}, but the scenario gives "
            f"{type(evidence).__name__}; choose a scenario that fits the model"
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
    """Where the outcome of a composed config belongs. Raises where a value cannot be resolved."""
    settings = plain(config)
    root, force = Path(settings.pop("runs")), settings.pop("force")
    title = "-".join(str(choices[part]) for part in ("scenario", "model", "engine"))
    return Job(settings, root / f"{title}-{store.identity(settings)}", force)


def execute(job: Job, say: Callable[[str], None] = print) -> dict[str, float]:
    """Run a job and store its outcome, or read it where that is done already; the scores."""
    if store.is_done(job.folder) and not job.force:
        say(f"done already: {job.folder} (force=true runs it again)")
        return dict(store.read_json(job.folder / "scores.json"))
    from experiments.report import write_report

    parts = {key: build(job.config[key], key) for key in ("model", "engine", "metrics", "figures")}
    scenario = job.config["scenario"]
    result = run(lambda: build(scenario, "scenario"), **parts, seed=job.config["seed"], say=say)
    seeds = {"run": job.config["seed"], "engine": engine_seed(job.config["seed"])}
    with store.writing(job.folder) as folder:
        store.write_json(folder / "scores.json", result.scores)
        store.write_json(folder / "diagnostics.json", {"summary": result.diagnostics, "flags": result.flags})
        result.posterior.save(folder)
        manifest = store.manifest(job.name, job.config, seeds, result.seconds, result.scene.info)
        write_report(folder, job.name, result, manifest)
        store.write_json(folder / "manifest.json", manifest)
    return result.scores


def show(scores: dict[str, float], folder: Path) -> None:
    """Print the scores, what speaks against the draws, and where the report is."""
    from rich.console import Console
    from rich.table import Table

    from experiments.report import number, split_unit

    table = Table("metric", "value", "unit")
    for name, value in scores.items():
        label, unit = split_unit(name)
        table.add_row(label, number(value), unit)
    console = Console()
    if scores:
        console.print(table)
    flags = store.read_json(folder / "diagnostics.json")["flags"]
    for flag in flags[:3]:
        console.print(f"flag       {flag}", style="yellow", soft_wrap=True, markup=False, highlight=False)
    if len(flags) > 3:
        console.print(f"           and {len(flags) - 3} more flags in the report", style="yellow")
    console.print(f"report     {folder / 'report.html'}", soft_wrap=True, highlight=False)


@hydra.main(config_path="pkg://configs", config_name="run", version_base="1.3")
def _launch(config: DictConfig) -> None:
    """One job of the command line: says at once what went wrong; a sweep then goes on."""
    known = HydraConfig.get()
    try:
        job = job_of(config, known.runtime.choices)
        show(execute(job), job.folder)
    except Exception as error:
        code = complain(error, " ".join(["waybayes", *known.overrides.task]))
        if known.mode == RunMode.MULTIRUN:
            raise JobFailed(code) from error
        sys.exit(code)


def main() -> None:
    """The console script `waybayes`."""
    sys.exit(guarded(_launch))


if __name__ == "__main__":
    main()
