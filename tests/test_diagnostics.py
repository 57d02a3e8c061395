"""Diagnostics against chains whose autocorrelation is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from inference import diagnostics
from inference.posterior import Posterior


def chains(rho: float, num_draws: int, *, seed: int = 0, num_chains: int = 4) -> np.ndarray:
    """Stationary first-order autoregression with standard normal marginals, (chain, draw)."""
    noise = np.random.default_rng(seed).normal(size=(num_chains, num_draws))
    values = noise.copy()
    for t in range(1, num_draws):
        values[:, t] = rho * values[:, t - 1] + math.sqrt(1 - rho**2) * noise[:, t]
    return values


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_standard_error_accounts_for_autocorrelation(rho: float) -> None:
    """sd sqrt((1 + rho) / (1 - rho) / n); ESS itself is estimated to some 10 % at this length."""
    exact = math.sqrt((1 + rho) / (1 - rho) / (4 * 5000))
    assert diagnostics.standard_error(chains(rho, 5000)) == pytest.approx(exact, rel=0.2)


def test_summary_holds_mean_sd_and_effective_draws_of_every_element() -> None:
    values = np.stack([chains(0.0, 1000), 3.0 + 2.0 * chains(0.8, 1000, seed=1)], -1)
    table = diagnostics.summary(Posterior({"z": values}))
    assert set(table) == {"z[0]", "z[1]"}
    row = table["z[1]"]
    assert row["mean"] == pytest.approx(values[..., 1].mean())
    assert row["sd"] == pytest.approx(values[..., 1].std())
    assert row["r_hat"] < 1.05
    assert row["ess_bulk"] == pytest.approx(4000 / 9, rel=0.3)
    assert abs(row["mean"] - 3.0) < 4 * row["mcse"]


def test_chains_apart_are_flagged_in_words() -> None:
    apart = chains(0.0, 500) + np.array([[0.0], [0.0], [0.0], [3.0]])
    found = diagnostics.flags(Posterior({"d0": apart}))
    assert len(found) == 1  # nothing of a standard error that supposes agreement
    assert found[0].startswith("r_hat of 'd0' is 1.") and "over 4 chains" in found[0]


def test_an_r_hat_just_above_its_limit_shows_that_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnostics, "r_hat", lambda draws: 1.01034)
    found = diagnostics.flags(Posterior({"d0": chains(0.0, 1000)}))
    assert found[0].startswith("r_hat of 'd0' is 1.0103 over 4 chains (above 1.01)")


@pytest.mark.parametrize("values", [(3.0, 4.0, 3.0, 4.0), (0.1, 0.3, 0.1, 0.7)])
def test_chains_that_stand_still_apart_are_flagged_without_warnings(
    values: tuple[float, ...], recwarn: pytest.WarningsRecorder
) -> None:
    still = Posterior({"num_arms": np.repeat(np.array(values)[:, None], 500, axis=1)})
    assert diagnostics.summary(still)["num_arms"]["r_hat"] == math.inf
    found = diagnostics.flags(still)
    assert found[0].startswith("r_hat of 'num_arms' is inf over 4 chains") and "the chains disagree" in found[0]
    assert not [warning for warning in recwarn if warning.category is RuntimeWarning]


def test_few_effective_draws_are_told() -> None:
    found = diagnostics.flags(Posterior({"d0": chains(0.9, 600)}), max_r_hat=2.0)
    assert len(found) == 1
    assert "effective draws (below 400)" in found[0]


def test_good_chains_and_constants_raise_no_flag() -> None:
    good = Posterior({"d0": chains(0.0, 1000), "fixed": np.ones((4, 1000))})
    assert diagnostics.flags(good) == []


@pytest.mark.parametrize(("num_chains", "num_draws"), [(1, 1), (4, 1), (4, 3)])
def test_too_few_draws_to_judge_are_told(num_chains: int, num_draws: int) -> None:
    found = diagnostics.flags(Posterior({"d0": chains(0.0, num_draws, num_chains=num_chains)}))
    assert len(found) == 1
    assert f"only {num_draws} draw{'s' * (num_draws > 1)} a chain: convergence cannot be judged" in found[0]


def test_draws_whose_effective_size_is_unknown_are_told() -> None:
    broken = chains(0.0, 1000)
    broken[2, 17] = np.nan
    assert any("'d0' has nan effective draws" in flag for flag in diagnostics.flags(Posterior({"d0": broken})))


def test_flags_of_the_engine_come_first() -> None:
    posterior = Posterior({"d0": chains(0.9, 600)}, info={"flags": ["not converged: why"]})
    assert diagnostics.flags(posterior)[0] == "not converged: why"


def test_a_single_chain_has_no_r_hat() -> None:
    row = diagnostics.summary(Posterior({"d0": chains(0.0, 1000, num_chains=1)}))["d0"]
    assert math.isnan(row["r_hat"])
    assert row["ess_bulk"] > 500


def test_weighted_draws_count_by_their_weights() -> None:
    log_weights = np.where(np.arange(1000) < 100, 0.0, -np.inf)[None]
    row = diagnostics.summary(Posterior({"d0": chains(0.0, 1000, num_chains=1)}, log_weights=log_weights))["d0"]
    assert row["ess_bulk"] == pytest.approx(100.0)
    assert row["mcse"] == pytest.approx(row["sd"] / 10)


def test_slots_are_not_averaged_where_the_dimension_is_unknown() -> None:
    index = np.random.default_rng(0).integers(0, 3, (4, 500))
    posterior = Posterior({"d0": chains(0.0, 500), "knot": np.zeros((4, 500, 2))}, model_index=index)
    assert set(diagnostics.summary(posterior)) == {"model_index", "d0"}


def test_model_probabilities_come_with_their_binomial_error() -> None:
    index = np.random.default_rng(0).integers(0, 4, (4, 2000))
    for share, error in diagnostics.model_probabilities(Posterior({"z": index * 1.0}, model_index=index)).values():
        assert error == pytest.approx(math.sqrt(0.25 * 0.75 / 8000), rel=0.2)
        assert abs(share - 0.25) < 4 * error
