"""One junction from tracks to a scored estimate, timed: the work that the figures of the intersection count."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, Literal, NamedTuple

from benchmarks.configured import configured as configured_part
from benchmarks.configured import quiet_engine
from experiments.junction_metrics import structure
from experiments.scenarios.scene import Scene
from inference import rjmcmc
from inference.posterior import Posterior
from inference.progress import Progress
from models.intersection.state import Junction
from models.intersection.tracks import Tracks
from models.program import InputError


class Effort(NamedTuple):
    """How much to measure.

    scenes       of the protocol
    few          scenes of the figures that are reported only
    timed        scenes that are timed, `repeats` times each
    real_seeds   simulated drives on every real junction
    show         progress bars on the standard error
    """

    scenes: int
    few: int
    timed: int
    repeats: int
    real_seeds: int
    show: bool = False


FULL = Effort(scenes=1000, few=100, timed=40, repeats=3, real_seeds=5)
QUICK = Effort(scenes=100, few=50, timed=10, repeats=2, real_seeds=5)


class Setting(NamedTuple):
    """A model and how it is run."""

    model: Junction
    knobs: dict[str, Any]


class Trial(NamedTuple):
    """One scene: the posterior and wall times [s].

    prepare  tracks to evidence, first state and compiled kernel
    chain    all steps with their random numbers and snapshots
    polish   greedy search; 0 without
    total    from tracks to posterior
    """

    posterior: Posterior
    prepare: float
    chain: float
    polish: float
    total: float

    @property
    def us_per_sample(self) -> float:
        """Time of the chain over its evaluated proposals; invalid ones take time, but do not count."""
        return 1e6 * self.chain / self.posterior.info["evaluations"]


NUM_CHAINS = 2
ANNEALED = {"num_chains": NUM_CHAINS, "num_steps": 2500, "warmup": 2500, "start": "data", "start_temperature": 10.0}
DEFAULT = Setting(Junction(), ANNEALED | {"polish": True})


def configured(name: str) -> Junction:
    """The model of the config model=NAME."""
    model = configured_part("model", name)
    assert isinstance(model, Junction)
    return model


def configured_engine(name: str) -> Callable[..., Posterior]:
    """The engine of the config engine=NAME, without a progress bar."""
    return quiet_engine(name)


def m20(likelihood: Literal["half", "point"] = "half", acceptance: Literal["paper", "printed"] = "paper") -> Setting:
    """[M20] as far as it is printed (config model=junction_m20), with our start and schedule T = 50 -> 1."""
    model = replace(configured("junction_m20"), likelihood=likelihood)
    steps = {"num_chains": 1, "num_steps": 5000, "warmup": 5000, "start": "data", "start_temperature": 50.0}
    return Setting(model, steps | {"acceptance": acceptance})


def paper_lanes() -> Junction:
    """The default model with the lanes of [M20]: width known, straight arms through one centre."""
    paper = configured("junction_m20")
    lanes = {name: getattr(paper, name) for name in ("width", "width_spread", "bend_std", "shift_std")}
    return replace(Junction(), **lanes)


def attempt(setting: Setting, tracks: Tracks, seed: int) -> Trial:
    """Run one scene. Raises InputError where the model or the engine refuses the tracks."""
    began = time.perf_counter()
    evidence = setting.model.prepare(tracks)
    prepared = time.perf_counter() - began
    posterior = rjmcmc.run(setting.model, evidence, seed=seed, **setting.knobs)
    total = time.perf_counter() - began
    assert posterior.snapshots is not None
    seconds, polished = posterior.snapshots.seconds, setting.knobs.get("polish", False)
    last = -2 if polished else -1
    polish = float(seconds[-1] - seconds[-2]) if polished else 0.0
    return Trial(posterior, prepared + float(seconds[0]), float(seconds[last] - seconds[0]), polish, total)


class Scores(NamedTuple):
    """What came out of many scenes: 1 where the structure is right, share of lane counts right, trials, refusals."""

    right: list[float]
    lanes: list[float]
    trials: list[Trial]
    refused: int


def score(setting: Setting, scenes: Iterable[Scene], what: str, total: int, show: bool) -> Scores:
    """Run every scene with a seed of its own; a scene that is refused is wrong in all."""
    out = Scores([], [], [], 0)
    with Progress(what, total, show) as bar:
        for seed, scene in enumerate(scenes):
            try:
                trial = attempt(setting, scene.data, seed)
            except InputError:
                right = lanes = 0.0
                out = out._replace(refused=out.refused + 1)
            else:
                marks = structure(trial.posterior.estimate, scene.truth)
                right, lanes = marks["structure_right"], marks["lanes_right"]
                out.trials.append(trial)
            out.right.append(right)
            out.lanes.append(lanes)
            bar.advance(1)
    return out
