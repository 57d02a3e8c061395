"""The continuous part of a junction, its structure found by one engine and its numbers by another."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from experiments.fixed_structure import estimate
from experiments.scenarios.scene import Scene
from experiments.structure_bars import figures, shares_of, structure_of
from inference import bbvi, rjmcmc
from inference.posterior import Posterior
from models.program import InputError, log_joint, simulate
from models.toys.gaussian import ConjugateGaussian, Readings
from tests.small_junction import FULL, NOTHING, blank_evidence, one, with_points


@pytest.fixture(scope="module")
def found() -> tuple[Posterior, Posterior, Any]:
    """The posterior of both engines, that of the refining one alone, and the evidence."""
    truth = one(simulate(FULL, NOTHING, num=1, seed=5), 0)
    evidence = with_points(FULL, truth, blank_evidence(8, 8, 10), 1)
    structure = lambda model, data, *, seed: rjmcmc.run(model, data, seed=seed, num_steps=500, warmup=500)  # noqa: E731
    knobs: dict[str, Any] = {"num_steps": 10, "num_samples": 16, "num_draws": 100, "num_snapshots": 2}
    refined: list[Posterior] = []

    def refine(model: Any, data: Any, **given: Any) -> Posterior:
        refined.append(bbvi.run(model, data, **knobs, **given))
        return refined[-1]

    return estimate(FULL, evidence, seed=0, structure=structure, refine=refine), refined[0], evidence


def test_draws_hold_the_fixed_structure_beside_the_numbers(found: tuple[Posterior, Posterior, Any]) -> None:
    posterior = found[0]
    assert posterior.shape == (1, 100)
    for site in ("num_arms", "entries", "exits"):
        assert (posterior.draws[site] == posterior.estimate[site]).all()
        assert posterior.draws[site].shape[2:] == posterior.estimate[site].shape
    assert np.ptp(posterior.draws["centre"], axis=1).min() > 0
    assert posterior.model_index is not None and posterior.log_evidence is None


def test_snapshots_run_on_from_those_of_the_structure_under_one_density(
    found: tuple[Posterior, Posterior, Any],
) -> None:
    posterior, refined, evidence = found
    shots = posterior.snapshots
    assert shots is not None and refined.snapshots is not None
    later = shots.seconds[-len(refined.snapshots.step) :] - refined.snapshots.seconds
    assert np.ptp(later) < 1e-9 and later[0] >= posterior.info["structure_seconds"]
    assert np.all(np.diff(shots.seconds) >= 0) and np.all(np.diff(shots.step) >= 0)
    assert posterior.info["structure_seconds"] < posterior.info["seconds"]
    for i in (0, len(shots.step) - 1):  # the first is of the structure engine, the last of the refinement
        state = {n: torch.as_tensor(v[i]) for n, v in shots.states.items()}
        assert shots.log_joint[i] == pytest.approx(float(log_joint(FULL, state, evidence)), rel=1e-9)


def test_a_model_of_known_dimension_has_nothing_to_fix() -> None:
    readings = Readings(torch.linspace(-1.0, 1.0, 5), None)
    with pytest.raises(InputError, match="ConjugateGaussian has no unknown dimension"):
        estimate(ConjugateGaussian(), readings, seed=0, structure=rjmcmc.run, refine=bbvi.run)


def test_a_structure_is_the_same_wherever_its_arms_begin() -> None:
    angle, entries, exits = np.array([0.1, 2.0, -2.0]), np.array([1, 2, 3]), np.array([4, 5, 6])
    first = structure_of(angle, entries, exits)
    assert first == ((3, 6), (1, 4), (2, 5))  # counter-clockwise, the largest first
    assert structure_of(angle + 2.5, entries, exits) == first  # turned, so that another arm is the first
    assert structure_of(angle[[2, 0, 1]], entries[[2, 0, 1]], exits[[2, 0, 1]]) == first
    assert structure_of(-angle, entries, exits) != first  # a mirror image


def test_probabilities_of_structures_are_weighted_shares_of_the_draws() -> None:
    draws = {
        "num_arms": np.array([[2, 2, 3]]),
        "angle": np.array([[[0.0, 3.0, 9.0], [3.0, 0.0, 9.0], [0.0, 2.0, 4.0]]]),
        "entries": np.array([[[1, 2, 9], [2, 1, 9], [1, 1, 1]]]),
        "exits": np.ones((1, 3, 3), dtype=int),
    }
    posterior = Posterior(draws, log_weights=np.log([[1.0, 2.0, 1.0]]))
    shares = shares_of(posterior)
    assert dict(shares) == pytest.approx({((2, 1), (1, 1)): 0.75, ((1, 1), (1, 1), (1, 1)): 0.25})
    drawn = figures({"some": posterior, "more": posterior}, Scene(None, None, "here", {}))["structures"]
    assert [label.get_text() for label in drawn.axes[0].get_yticklabels()] == ["2 arms: 2+1 1+1", "3 arms: 1+1 1+1 1+1"]
    assert figures({"none": Posterior({"z": np.zeros((1, 2))})}, Scene(None, None, "here", {})) == {}
