"""The same seed gives the same bits, whatever the number of threads."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from inference import rjmcmc
from inference.posterior import Posterior
from tests.small_junction import FULL, blank_evidence, one, states, with_points

EVIDENCE = with_points(FULL, one(states(FULL, 1, seed=3), 0), blank_evidence(20, 20), seed=4)


def run(seed: int, **settings: Any) -> Posterior:
    """Four chains over three blocks, between which they are resampled."""
    return rjmcmc.run(
        FULL, EVIDENCE, seed=seed, num_chains=4, num_steps=1500, warmup=1200, start_temperature=50.0, **settings
    )


def assert_same(a: Posterior, b: Posterior) -> None:
    for site in a.draws:
        np.testing.assert_array_equal(a.draws[site], b.draws[site])
    for site in a.estimate:
        np.testing.assert_array_equal(a.estimate[site], b.estimate[site])
    assert a.info["log_joint"] == b.info["log_joint"]
    assert a.info["acceptance"] == b.info["acceptance"]


@pytest.mark.parametrize("settings", [{}, {"resample": True}, {"polish": True}, {"start": "data"}], ids=str)
def test_draws_do_not_depend_on_the_number_of_threads(settings: dict[str, Any]) -> None:
    first = run(1, num_workers=1, **settings)
    for workers in (1, 2, 2):
        assert_same(first, run(1, num_workers=workers, **settings))


def test_another_seed_gives_other_draws() -> None:
    assert not np.array_equal(run(1).draws["centre"], run(2).draws["centre"])


def test_chains_of_a_run_differ() -> None:
    centre = run(1).draws["centre"]
    assert len(np.unique(centre[:, -1, 0])) == 4


def test_resampling_copies_chains() -> None:
    """After the warm-up's last resampling some chains share a past: the option does something."""
    plain, resampled = run(1), run(1, resample=True)
    assert not np.array_equal(plain.draws["centre"], resampled.draws["centre"])


def test_batched_path_is_reproducible_too() -> None:
    settings: dict[str, Any] = {"num_chains": 3, "num_steps": 40, "warmup": 10, "path": "batched"}
    first, again, other = (rjmcmc.run(FULL, EVIDENCE, seed=seed, **settings) for seed in (1, 1, 2))
    assert_same(first, again)
    assert not np.array_equal(first.draws["centre"], other.draws["centre"])
