"""Engines say what they refuse before any work."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch

from experiments.fixed_structure import estimate
from experiments.run import remedies
from inference import bbvi, importance, least_squares, nuts, particle_filter, rjmcmc, smc
from inference.refusal import ask
from models.objects.sensors import Position
from models.objects.traffic import Traffic
from models.program import InputError, simulate
from models.toys.gaussian import ConjugateGaussian, Readings
from models.toys.linear_walk import Fix, LinearWalk
from tests.small_junction import FULL, NOTHING, blank_evidence, one, with_points

FOREVER = 10**12
TRAFFIC = Traffic((Position(name="plots", noise_std=(1.0, 1.0)),))
LINE = ConjugateGaussian()
READINGS = Readings(torch.linspace(-1.0, 1.0, 5), torch.zeros(5, dtype=torch.float64))
ENDLESS: dict[str, Any] = {
    "rjmcmc": partial(rjmcmc.run, num_steps=FOREVER),
    "bbvi": partial(bbvi.run, num_steps=FOREVER),
    "importance": partial(importance.run, num_rounds=FOREVER),
    "smc": partial(smc.run, num_moves=FOREVER),
    "nuts": partial(nuts.run, num_draws=FOREVER),
}


@pytest.mark.parametrize("engine", ENDLESS)
def test_an_engine_that_runs_a_model_says_so_without_the_work(engine: str) -> None:
    ask(ENDLESS[engine], LINE, READINGS)


def test_a_filter_answers_before_its_first_frame() -> None:
    frames = [Fix(torch.zeros((), dtype=torch.float64))]
    ask(partial(particle_filter.run, num_particles=FOREVER), LinearWalk(), frames)
    with pytest.raises(InputError, match="needs a sequential model"):
        ask(particle_filter.run, LINE, READINGS)


def test_what_is_asked_first_runs_as_ever_afterwards() -> None:
    ask(least_squares.run, LINE, READINGS)
    assert least_squares.run(LINE, READINGS, seed=0).info["converged"]


def test_an_engine_made_of_two_answers_by_its_first() -> None:
    two = partial(estimate, structure=ENDLESS["rjmcmc"], refine=bbvi.run)
    truth = one(simulate(FULL, NOTHING, num=1, seed=5), 0)
    ask(two, FULL, with_points(FULL, truth, blank_evidence(8, 8, 10), 1))
    with pytest.raises(InputError, match="has no unknown dimension"):
        ask(two, LINE, READINGS)


def test_an_engine_of_the_user_is_not_run_to_ask_it() -> None:
    def own(model: Any, evidence: Any, *, seed: int) -> None:
        raise AssertionError("it works")

    ask(own, LINE, READINGS)


@pytest.mark.parametrize(
    ("model", "says"),
    [
        (FULL, "Junction has an unknown number of parts, .* bbvi_structure"),
        (TRAFFIC, "Traffic is of many objects that come and go; choose engine=lmb"),
        (LinearWalk(), "LinearWalk goes on from frame to frame; choose engine=particle_filter"),
    ],
)
def test_a_refusal_names_an_engine_that_runs_the_model(model: Any, says: str) -> None:
    truth = one(simulate(FULL, NOTHING, num=1, seed=5), 0)
    junction = with_points(FULL, truth, blank_evidence(8, 8, 10), 1)
    with pytest.raises(InputError, match=says), remedies(model, junction):
        raise InputError("least squares needs Gaussian sites, but 'n' is Categorical; fix() it first")
