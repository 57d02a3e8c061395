"""Settings of a model learnt from scenes, and whether that helps on scenes held out.

    python -m experiments.learn experiment=night_road scenes=60 held_out=30 'learn=[clutter,delineator]'
    python -m experiments.learn experiment=kitti_course scenario.sequence=00,05,07 held_out.scenario.sequence=03,04,10

Every setting of `waybayes` works here too. The scenes are seeds 0, 1, .. of the scenario, those held out the seeds that
follow; values after commas take turns. A word that begins with `held_out.` counts for held-out scenes only. Without
learn=[..] all settings are learnt that the scenes say something about; `delineator` stands for all of that kind.
num_draws=N and num_rounds=N are those of the method.

Behind the change of a held-out score stands its standard error over the scenes, which are the same for both settings.

The method is inference.empirical_bayes, the settings are those of models.road.hyper. The engine is importance unless
another one that tells the log evidence is named. What was learnt is stored as an experiment that `waybayes` takes.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml
from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException
from omegaconf import open_dict

from experiments import store
from experiments.command import guarded, in_words
from experiments.run import check_read, check_reads, engine_seed, job_of
from experiments.signatures import ConfigError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from experiments.scenarios.scene import Scene
    from inference.empirical_bayes import Learnt
    from models.capability import Hyper

LEAST = 2  # scenes; one cannot tell settings from chance
RESAMPLED = 1000  # times, for standard errors of scores
HEADS = ("held-out score", "configured", "learnt", "change ± s.e.")


class Plan(NamedTuple):
    """What to learn from.

    scenes, held_out  how many of each
    names             settings, none for all
    words             settings of `waybayes`, one list for each combination of values that take turns
    held_words        the same of the held-out scenes
    knobs             of inference.empirical_bayes.learn
    """

    scenes: int
    held_out: int
    names: list[str]
    words: list[list[str]]
    held_words: list[list[str]]
    knobs: dict[str, int]


class Task(NamedTuple):
    """A composed plan: plain configs of all scenes, model and engine, and where the outcome belongs."""

    scenes: list[dict[str, Any]]
    held_out: list[dict[str, Any]]
    names: list[str]
    knobs: dict[str, int]
    config: dict[str, Any]
    choices: dict[str, str]
    folder: Path
    force: bool


class Row(NamedTuple):
    """One setting before and after, its standard error and the Monte Carlo error of that."""

    setting: str
    configured: float
    learnt: float
    error: float
    noise: float


class Score(NamedTuple):
    """A score under both settings, and the standard error of its change: both are judged on the same scenes."""

    before: float
    after: float
    error: float

    @property
    def change(self) -> str:
        return f"{self.after - self.before:+.3g} ± {self.error:.2g}"


class Held(NamedTuple):
    """Held-out scenes under the configured and the learnt settings.

    gain    (S,) of the log evidence of each [nats]
    scores  {score: Score}: medians over the scenes of scores with a unit, means of all others
    """

    gain: Any
    scores: dict[str, Score]


def plan(words: list[str]) -> Plan:
    """Read the command line. Raises ConfigError for words that say nothing."""
    numbers, names = {"scenes": 60, "held_out": 30, "num_draws": 200, "num_rounds": 15}, list[str]()
    rest, held = [["engine=importance"]], [list[str]()]
    for word in words:
        (override,) = OverridesParser.create().parse_overrides([word])
        key = override.key_or_group
        if key in numbers:
            value = override.value()
            least = 1 if key == "num_rounds" else LEAST
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ConfigError(f"{key} is '{value}'; give a whole number, {least} or more")
            numbers[key] = value
        elif key == "learn":
            value = list(override.sweep_string_iterator()) if override.is_sweep_override() else override.value()
            names = [str(name) for name in (value if isinstance(value, list) else [value])]
            if not names:
                raise ConfigError("learn is empty; name settings, such as learn=[clutter,delineator], or leave it out")
        elif key.removeprefix("held_out.") == "scenario.seed":
            raise ConfigError(f"learning numbers its scenes itself; give scenes=N and held_out=N instead of {word}")
        elif key.startswith("held_out.") and not key.startswith("held_out.scenario"):
            raise ConfigError(f"{word} is no setting of a scenario; held-out scenes differ by held_out.scenario alone")
        else:
            values = list(override.sweep_string_iterator()) if override.is_sweep_override() else None
            turns = [word] if values is None else [f"{_key(word)}={value}" for value in values]
            if key.startswith("held_out."):
                held = [[*few, turn.removeprefix("held_out.")] for few in held for turn in turns]
            else:
                rest = [[*few, turn] for few in rest for turn in turns]
    other = {_key(word) for word in held[0]}
    kept = dict.fromkeys(tuple(word for word in few if _key(word) not in other) for few in rest)
    both = [[*few, *own] for few in kept for own in held]
    scenes, held_out = numbers.pop("scenes"), numbers.pop("held_out")
    return Plan(scenes, held_out, names, rest, both, numbers)


def _key(word: str) -> str:
    """'scenario.clutter=.1' -> 'scenario.clutter'."""
    return word.partition("=")[0]


def task_of(plan: Plan) -> Task:
    """The plan composed and checked. Raises where a setting cannot be resolved, ConfigError for a scenario without
    seeds."""
    jobs, choices, force = [], dict[str, str](), False
    with initialize_config_module("configs", version_base="1.3"):
        for words in (*plan.words, *plan.held_words):
            composed = compose("run", words, return_hydra_config=True)
            choices = choices or dict(composed.hydra.runtime.choices)
            with open_dict(composed):
                del composed["hydra"]
            jobs.append(job_of(composed, choices))
            if "seed" not in jobs[-1].config["scenario"]:
                raise ConfigError(f"scenario {choices['scenario']} has no seed, so it is one scene; choose another")
    turns, held = jobs[: len(plan.words)], jobs[len(plan.words) :]
    scenes = [{**turns[i % len(turns)].config["scenario"], "seed": i // len(turns)} for i in range(plan.scenes)]
    first = -(-plan.scenes // len(turns))
    others = [{**held[i % len(held)].config["scenario"], "seed": first + i // len(held)} for i in range(plan.held_out)]
    config = {key: value for key, value in turns[0].config.items() if key not in ("figures", "functionals")}
    whole = config | {"scenario": [*scenes, *others], "scenes": plan.scenes, "learn": plan.names} | plan.knobs
    title = "-".join(str(choices[part]) for part in ("scenario", "model", "engine"))
    folder = turns[0].folder.parent / f"learn-{title}-{store.identity(whole)}"
    return Task(scenes, others, plan.names, plan.knobs, config, choices, folder, force or turns[0].force)


def run(task: Task, say: Callable[[str], None] = print) -> None:
    """Learn, judge on held-out scenes and store the outcome. Raises InputError where scenes and settings do not fit."""
    from experiments.schema import build
    from inference import empirical_bayes
    from models.program import InputError

    model, engine, metrics = (build(task.config[key], key) for key in ("model", "engine", "metrics"))
    if not hasattr(model, "hyper"):
        raise InputError(f"{type(model).__name__} has no settings to learn (hyper()); choose model=road_course")
    if "progress" in getattr(engine, "keywords", {}):
        engine.keywords["progress"] = False
    scenes, others = ([build(scene, "scenario") for scene in each] for each in (task.scenes, task.held_out))
    for scene in scenes[:1]:
        check_read(scene)
        check_reads(model, scene.data)
    say(f"scenes     {len(scenes)} to learn from, {len(others)} held out")
    data, knobs = [scene.data for scene in scenes], task.knobs
    family = model.hyper(data, task.names)
    seed, began = engine_seed(task.config["seed"]), time.perf_counter()
    learnt = empirical_bayes.learn(
        family, data, engine, seed=seed, num_draws=knobs["num_draws"], num_rounds=knobs["num_rounds"]
    )
    seconds = time.perf_counter() - began
    say(f"learnt     {len(family.names)} settings in {len(learnt.path) - 1} rounds, {seconds:.0f} s")
    after = family.model(learnt.h)
    held = judge(others, (model, after), engine, metrics, seed)
    info = {"scenes": [scene.name for scene in scenes], "held_out": [scene.name for scene in others]}
    manifest = store.manifest(task.folder.name, task.config, {"run": task.config["seed"]}, {"learning": seconds}, info)
    write(task, table_of(family, learnt), held, learnt, difference(model, after), manifest)


def judge(scenes: Sequence[Scene], models: tuple[Any, Any], engine: Any, metrics: Sequence[Any], seed: int) -> Held:
    """Both models on scenes that neither was learnt from, with the same random numbers."""
    import numpy as np

    from experiments.report import split_unit
    from inference.empirical_bayes import posterior_of
    from inference.progress import Progress

    evidence: Any = [[], []]
    scores: Any = [[], []]
    with Progress("judging on held-out scenes", 2 * len(scenes)) as bar:
        for i, scene in enumerate(scenes):
            for side, model in enumerate(models):
                posterior = posterior_of(model, scene.data, engine, seed + i)
                evidence[side].append(posterior.log_evidence)
                scores[side].append({k: v for metric in metrics for k, v in metric(posterior, scene).items()})
                bar.advance(1)
    both = {}
    for name in scores[0][0]:
        centre = np.nanmedian if split_unit(name)[1] else np.nanmean
        columns = [np.array([each.get(name, np.nan) for each in side], dtype=float) for side in scores]
        if not any(np.isnan(column).all() for column in columns):
            both[name] = compared(columns[0], columns[1], centre)
    return Held(np.subtract(evidence[1], evidence[0]), both)


def compared(before: Any, after: Any, centre: Callable[..., Any]) -> Score:
    """Centres of scores (S,) of the same scenes; the error is that of their difference under resampled scenes."""
    import warnings

    import numpy as np

    index = np.random.default_rng(0).integers(len(before), size=(RESAMPLED, len(before)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a sample may hold only scenes without this score
        change = centre(after[index], axis=1) - centre(before[index], axis=1)
    wider = (len(before) / (len(before) - 1)) ** 0.5  # resampled means vary by the variance over S, not S - 1
    return Score(float(centre(before)), float(centre(after)), wider * float(np.nanstd(change)))


def table_of(family: Hyper, learnt: Learnt) -> list[Row]:
    """Settings in natural numbers; errors by the slope of the map at what was learnt."""
    import numpy as np

    step = 1e-6 * family.width
    slope = (family.natural(learnt.h + step) - family.natural(learnt.h - step)) / (2.0 * step)
    columns = (family.natural(family.start), family.natural(learnt.h), slope * learnt.error, slope * learnt.noise)
    return [Row(name, *map(float, row)) for name, row in zip(family.names, np.transpose(columns), strict=True)]


def node_of(value: Any) -> Any:
    """A dataclass as the config node that builds it, floats to five digits."""
    if is_dataclass(value) and not isinstance(value, type):
        kind = type(value)
        target = {"_target_": f"{kind.__module__}.{kind.__qualname__}"}
        return target | {field.name: node_of(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple):
        return [node_of(each) for each in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def difference(before: Any, after: Any) -> dict[str, Any]:
    """Fields of the model's config node that were learnt."""
    old, new = node_of(before), node_of(after)
    return {key: value for key, value in new.items() if value != old[key]}


def experiment_of(task: Task, changes: dict[str, Any]) -> str:
    """An experiment file that has the learnt settings and else is the one they were learnt under."""
    chosen = task.choices.get("experiment")
    groups = ("scenario", "model", "engine")
    base = [chosen] if chosen else [{f"override /{group}": task.choices[group]} for group in groups]
    content = {"defaults": [*base, "_self_"] if chosen else base, "model": changes}
    return f"# @package _global_\n# Learnt by {task.folder.name}.\n{yaml.safe_dump(content, sort_keys=False)}"


def write(
    task: Task, rows: list[Row], held: Held, learnt: Learnt, changes: dict[str, Any], manifest: dict[str, Any]
) -> None:
    """learnt.csv, held_out.json, conf/experiment/<name>.yaml, figures/settings.png, manifest.json and report.html."""
    from experiments.report import details, page, save_figures, table

    with store.writing(task.folder) as folder:
        (folder / "conf" / "experiment").mkdir(parents=True)
        text = experiment_of(task, changes)
        (folder / "conf" / "experiment" / f"{name_of(task)}.yaml").write_text(text)
        store.write_rows(folder / "learnt.csv", [row._asdict() for row in rows])
        outcome = {"gain": held.gain, "scores": held.scores, "flags": learnt.flags}
        store.write_json(folder / "held_out.json", outcome | {"log_evidence": learnt.log_evidence.sum(1)})
        images, failures = save_figures(folder, {"settings": figure(rows, learnt)})
        body = [
            f"<h1>{task.folder.name}</h1><p class='sub'>{len(task.scenes)} scenes, {len(task.held_out)} held out</p>",
            *(f'<p class="flag">{escape(flag)}</p>' for flag in learnt.flags),
            table(("setting", "configured", "learnt", "standard error", "Monte Carlo error"), rows),
            f"<h2>Held-out scenes</h2><p>{sentence(held)}</p>",
            table(HEADS, [(name, score.before, score.after, score.change) for name, score in held.scores.items()]),
            *images.values(),
            f"<h2>To use them</h2><pre>{escape(usage(task))}</pre>",
            details("experiment", changes),
            details("manifest", manifest),
        ]
        (folder / "report.html").write_text(page(task.folder.name, "".join(body)))
        store.write_json(folder / "manifest.json", manifest | {"failures": {k: str(v) for k, v in failures.items()}})


def name_of(task: Task) -> str:
    """Of the experiment that has the learnt settings."""
    return f"{task.choices.get('experiment') or task.choices['scenario']}_learnt"


def usage(task: Task) -> str:
    """How to run with the learnt settings."""
    return f"waybayes experiment={name_of(task)} 'hydra.searchpath=[file://{task.folder.absolute()}/conf]'"


def sentence(held: Held) -> str:
    """What learning changed in the held-out log evidence."""
    import numpy as np

    gain = np.asarray(held.gain, dtype=float)
    error = gain.std(ddof=1) / len(gain) ** 0.5
    told = f"log evidence of a held-out scene {gain.mean():+.2f} ± {error:.2f} nats against the configured settings"
    if gain.mean() < 2.0 * error:
        return f"{told}: no proven gain; keep the configured settings, or learn from more scenes"
    return told


def figure(rows: list[Row], learnt: Learnt) -> Figure:
    """Left: what was configured against what was learnt, in standard errors. Right: log evidence along the rounds."""
    from matplotlib.figure import Figure

    from experiments.report import number

    drawn = Figure(figsize=(10.0, 1.6 + 0.26 * len(rows)), layout="constrained")
    left, right = drawn.subplots(1, 2, width_ratios=(2, 1))
    before, places = (learnt.path[0] - learnt.h) / learnt.error, range(len(rows))
    left.axvspan(-1.0, 1.0, color="#c9ced4", alpha=0.4, lw=0, label="one standard error")
    left.hlines(places, 0.0, before, color="#8a8f98", lw=1)
    left.scatter(before, places, s=22, facecolor="white", edgecolor="#8a8f98", zorder=3, label="configured")
    left.scatter([0.0] * len(rows), places, s=22, color="#2f6f9f", zorder=3, label="learnt")
    labels = [f"{row.setting}  {number(row.configured)} \u2192 {number(row.learnt)}" for row in rows]
    left.set_yticks(places, labels, fontsize=8)
    left.invert_yaxis()
    left.set_xlabel("distance from what was learnt [standard errors]")
    left.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 1.0 + 0.7 / len(rows)), ncols=3)
    right.plot(learnt.log_evidence.mean(1), marker="o", ms=3, color="#2f6f9f")
    right.set(xlabel="round", ylabel="log evidence of a scene [nats]")
    right.xaxis.get_major_locator().set_params(integer=True)
    return drawn


def show(task: Task) -> None:
    """Print a stored outcome."""
    from rich.console import Console
    from rich.table import Table

    from experiments.report import number

    console = Console()
    found = Table("setting", "configured", "learnt", "± s.e.")
    for row in store.read_rows(task.folder / "learnt.csv"):
        found.add_row(row["setting"], *(number(float(row[key])) for key in ("configured", "learnt", "error")))
    console.print(found)
    outcome = store.read_json(task.folder / "held_out.json")
    scores = Table(*HEADS)
    for name, values in outcome["scores"].items():
        score = Score(*values)
        scores.add_row(name, number(score.before), number(score.after), score.change)
    console.print(scores)
    for flag in outcome["flags"]:
        console.print(f"flag       {flag}", style="yellow", soft_wrap=True, markup=False, highlight=False)
    print(f"held out   {sentence(Held(outcome['gain'], {}))}")
    print(f"use        {usage(task)}")
    print(f"report     {task.folder / 'report.html'}")


def learn(words: list[str]) -> None:
    """Plan, learn, store, print; what is done already is printed again."""
    try:
        task = task_of(plan(words))
    except OverrideParseException as error:
        raise ConfigError(in_words(error)) from error
    if store.is_done(task.folder) and not task.force:
        print(f"done already: {task.folder} (force=true learns again)")
    else:
        run(task)
    show(task)


def main() -> None:
    """`python -m experiments.learn`."""
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(__doc__)
        return
    sys.exit(guarded(lambda: learn(sys.argv[1:])))


if __name__ == "__main__":
    main()
