"""What the stored run of one engine with one seed on one scene says to a comparison."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from experiments import store
from experiments.schema import build

if TYPE_CHECKING:  # torch takes seconds to import: --help needs none
    from numpy.typing import NDArray

    from experiments.run import Job
    from inference.posterior import Posterior

Summary = dict[str, dict[str, float]]  # scalar -> mean, sd, mcse (inference.diagnostics.summary)


class Trail(NamedTuple):
    """The best state of an engine along its iterations: (S,) milliseconds since it began, {scalar: (S,)}."""

    ms: NDArray[Any]
    scalars: dict[str, NDArray[Any]]


class Cell(NamedTuple):
    """The outcome of one engine with one seed on one scene, as stored.

    scene         its number: that of `scenes=N`, else 0
    ms            of the engine by its own clock, else of the whole stage
    processor_ms  of the whole stage, the densities of snapshots that the engine's clock leaves out included
    trail         None where the engine keeps no snapshots
    """

    folder: Path
    scores: dict[str, float]
    summary: Summary
    ms: float
    processor_ms: float | None = None
    evaluations: float | None = None
    scene: int = 0
    trail: Trail | None = None


class Row(NamedTuple):
    """One engine: its cells, or the sentence that says why there are none.

    refused  whether it said that scenario, model and engine do not fit, before any cell
    """

    engine: str
    cells: list[Cell]
    error: str | None
    refused: bool


def read(job: Job, scene: int = 0) -> Cell:
    """The outcome of a stored run. Where lanes were refined, what is summed up are the numbers of their courses."""
    info = store.read_json(job.folder / "posterior.json")["info"]
    seconds = store.read_json(job.folder / "manifest.json")["seconds"]
    courses = job.folder / "courses.json"
    refined = store.read_json(courses) if courses.exists() else None
    own = info.get("seconds", seconds["engine"])
    return Cell(
        job.folder,
        store.read_json(job.folder / "scores.json"),
        refined or store.read_json(job.folder / "diagnostics.json")["summary"],
        1e3 * float(own),
        1e3 * float(seconds["engine, processor"]),
        info.get("evaluations"),
        scene,
        None if refined else trail_of(posterior_of(job), build(job.config["functionals"])),
    )


def posterior_of(job: Job) -> Posterior:
    """The posterior of a stored run."""
    from inference.posterior import Posterior

    return Posterior.load(job.folder)


def trail_of(posterior: Posterior, functionals: list[Any]) -> Trail | None:
    """The scalars that diagnostics look at, in the snapshots of a posterior."""
    import numpy as np

    from inference.diagnostics import MODEL_INDEX, scalars
    from inference.posterior import Posterior

    shots = posterior.snapshots
    if shots is None:
        return None
    index = None if posterior.model_index is None else np.zeros((1, len(shots.step)))  # slots mean nothing
    states = Posterior({site: values[None] for site, values in shots.states.items()}, model_index=index)
    columns = scalars(states) | {name: v for f in functionals for name, v in f(states).items()}
    return Trail(1e3 * shots.seconds, {name: v[0] for name, v in columns.items() if name != MODEL_INDEX})
