"""How long engines take on one road, and what a step of Pyro's own variational inference takes."""

from __future__ import annotations

import time
from statistics import median
from typing import Any

from benchmarks.clothoid import FIGURES as CLOTHOID
from benchmarks.clothoid import measure as clothoid
from benchmarks.configured import quiet_engine
from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.plain_road import PlainRoad
from benchmarks.road_trials import MODEL, Effort, drive, frozen
from models.program import Model
from models.road.evidence import RoadEvidence

DRAWS = 400  # enough for bands
ENGINES: dict[str, tuple[str, dict[str, Any], float]] = {
    "ms_lm": ("least_squares", {"num_draws": DRAWS, "tolerance": 1e-6}, 1.0),
    "ms_bbvi": ("bbvi", {"num_samples": 64, "num_steps": 15, "num_snapshots": 0, "num_draws": DRAWS}, 10.0),
    "ms_ais": ("importance", {}, 15.0),
    "ms_obbvi": ("bbvi_overdispersed", {"num_snapshots": 0, "num_draws": DRAWS}, 40.0),
}
PARTICLES = 64
STEPS = 100


def times(effort: Effort) -> Values:
    values = {}
    for key, (name, knobs, _) in ENGINES.items():
        trials = drive(quiet_engine(name, **knobs), frozen(effort.scenes)[: effort.timed], key, effort.timed, False)
        spent = sorted(trial.ms for trial in trials)
        values[key] = Value(median(spent), f"n = {len(spent)}, {spent[0]:.2f} to {spent[-1]:.2f}")
    return values


TIMES = Measurement(
    tuple(
        Figure(
            key,
            "ms",
            f"processor time from evidence to posterior, {' '.join([name, *(f'{k}={v}' for k, v in knobs.items())])}: "
            "one thread, warm, median over frozen scenes",
            at_most=most,
        )
        for key, (name, knobs, most) in ENGINES.items()
    ),
    times,
)


def pyro_ms(model: Model, evidence: RoadEvidence, steps: int, batched: bool) -> float:
    """Processor time of one of Pyro's own steps [ms]: AutoNormal, PARTICLES draws at once, or one after the other as
    Pyro does if it is not told."""
    import pyro
    import torch
    from pyro.infer import SVI, Trace_ELBO
    from pyro.infer.autoguide import AutoNormal
    from pyro.optim import Adam

    from models.program import quiet_doubles

    with quiet_doubles(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        pyro.clear_param_store()
        loss = Trace_ELBO(num_particles=PARTICLES, vectorize_particles=batched, max_plate_nesting=0)
        svi = SVI(model, AutoNormal(model), Adam({"lr": 0.01}), loss)
        spent = []
        for _ in range(steps + 1):
            began = time.process_time()
            svi.step(evidence)
            spent.append(1e3 * (time.process_time() - began))
        pyro.clear_param_store()
    return median(spent[1:])  # the first makes the guide


def our_ms(evidence: RoadEvidence) -> float:
    """The same of engine=bbvi with as many draws: what STEPS more steps take."""
    knobs = {"estimator": "reparameterised", "num_samples": PARTICLES, "num_snapshots": 0}
    spent = []
    for _ in range(5):
        lengths = []
        for steps in (1, 1 + STEPS):
            began = time.process_time()
            quiet_engine("bbvi", num_steps=steps, **knobs)(MODEL, evidence, seed=0)
            lengths.append(1e3 * (time.process_time() - began))
        spent.append((lengths[1] - lengths[0]) / STEPS)
    return median(spent)


def pyro_step(effort: Effort) -> Values:
    """All fit a mean-field Gaussian by reparameterised gradients of as many draws."""
    plain, values = PlainRoad(MODEL), {}
    evidence = [MODEL.prepare(scene.data) for scene in frozen(effort.scenes)[: max(effort.timed // 4, 1)]]
    ours = [our_ms(each) for each in evidence]
    for key, program, batched, steps in (
        ("pyro_step_ratio", MODEL, True, STEPS // 4),
        ("pyro_plain_step_ratio", plain, True, STEPS // 4),
        ("pyro_loop_step_ratio", plain, False, 2),
    ):
        theirs = [pyro_ms(program, each, steps, batched) for each in evidence]
        ratios = [a / b for a, b in zip(theirs, ours, strict=True)]
        told = f"n = {len(ratios)}, {min(ratios):.1f} to {max(ratios):.1f}"
        values[key] = Value(median(ratios), f"{told}; {median(theirs):.1f} ms / {median(ours):.2f} ms")
    return values


PYRO = Measurement(
    (
        Figure(
            "pyro_step_ratio",
            "",
            f"processor time of one step of Pyro's SVI (AutoNormal, vectorised) over ours, same model and evidence, "
            f"{PARTICLES} reparameterised draws, median over frozen scenes; Pyro's step calls our compiled density too",
            at_least=20.0,
        ),
        Figure(
            "pyro_plain_step_ratio",
            "",
            "the same, where the program that Pyro runs has this density in torch (benchmarks.plain_road)",
        ),
        Figure(
            "pyro_loop_step_ratio",
            "",
            "as pyro_plain_step_ratio, where Pyro takes one draw after the other, as it does if it is not told",
        ),
    ),
    pyro_step,
)


def fits(effort: Effort) -> Values:
    return clothoid()


MEASUREMENTS = (TIMES, PYRO, Measurement(CLOTHOID, fits))
