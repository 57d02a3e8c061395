"""What engines return: weighted summaries against repeated draws, and a file format without pickle."""

from __future__ import annotations

import numpy as np
import pytest

from inference.posterior import Posterior, Snapshots

COUNTS = np.array([[3, 1, 2], [1, 4, 1]])


def weighted() -> tuple[Posterior, np.ndarray]:
    """Draws weighted by whole numbers, and the same draws repeated that often."""
    values = np.random.default_rng(0).normal(size=(2, 3, 2))
    repeated = np.repeat(values.reshape(6, 2), COUNTS.reshape(-1), axis=0)
    return Posterior({"z": values}, log_weights=np.log(COUNTS) - 700.0), repeated


def test_weighted_moments_equal_those_of_repeated_draws() -> None:
    posterior, repeated = weighted()
    np.testing.assert_allclose(posterior.mean("z"), repeated.mean(0))
    np.testing.assert_allclose(posterior.sd("z"), repeated.std(0))


@pytest.mark.parametrize("q", [0.05, 0.3, 0.55, 0.9])
def test_weighted_quantile_equals_that_of_repeated_draws(q: float) -> None:
    posterior, repeated = weighted()
    np.testing.assert_allclose(posterior.quantile("z", q), np.quantile(repeated, q, axis=0, method="inverted_cdf"))


def test_equal_weights_are_the_default() -> None:
    values = np.random.default_rng(1).normal(size=(2, 50))
    posterior = Posterior({"z": values})
    np.testing.assert_allclose(posterior.mean("z"), values.mean())
    np.testing.assert_allclose(posterior.sd("z"), values.std())


def test_resampling_turns_weights_into_counts() -> None:
    posterior, repeated = weighted()
    drawn = posterior.resample(12, seed=3)["z"]  # twelve in all: every count is met exactly
    np.testing.assert_allclose(np.sort(drawn, 0), np.sort(repeated, 0))


def indexed() -> Posterior:
    index = np.array([[1, 2, 1], [1, 1, 3]])
    return Posterior({"z": np.arange(6.0).reshape(2, 3)}, log_weights=np.log(COUNTS), model_index=index)


def test_model_probabilities_are_sums_of_weights() -> None:
    assert indexed().model_probabilities() == pytest.approx({1: 10 / 12, 2: 1 / 12, 3: 1 / 12})


def test_given_keeps_the_draws_of_one_model_and_their_weights() -> None:
    part = indexed().given(1)
    np.testing.assert_array_equal(part.draws["z"], [[0.0, 2.0, 3.0, 4.0]])
    assert part.mean("z") == pytest.approx((0 * 3 + 2 * 2 + 3 * 1 + 4 * 4) / 10)
    assert part.model_probabilities() == pytest.approx({1: 1.0})


def test_given_names_the_models_that_were_visited() -> None:
    with pytest.raises(ValueError, match=r"no draw has model index 9; visited: \[1, 2, 3\]"):
        indexed().given(9)
    with pytest.raises(ValueError, match="one model only"):
        Posterior({"z": np.zeros((1, 2))}).model_probabilities()


def test_saved_posterior_comes_back_equal(tmp_path) -> None:
    random = np.random.default_rng(0)
    before = Posterior(
        draws={"a": random.normal(size=(2, 4)), "slots/b": random.normal(size=(2, 4, 3))},
        log_weights=random.normal(size=(2, 4)),
        log_evidence=-12.5,
        model_index=random.integers(0, 3, (2, 4)),
        estimate={"a": np.array(1.0)},
        info={"flags": ["slow"], "evaluations": np.int64(7), "acceptance": {"walk": 0.25}},
        snapshots=Snapshots(np.arange(2), np.ones(2), np.zeros(2), {"a": np.array([0.5, 1.0])}),
    )
    before.save(tmp_path)
    after = Posterior.load(tmp_path)
    for part in ("draws", "estimate"):
        assert getattr(after, part).keys() == getattr(before, part).keys()
        for name, value in getattr(before, part).items():
            np.testing.assert_array_equal(getattr(after, part)[name], value)
    np.testing.assert_array_equal(after.log_weights, before.log_weights)
    np.testing.assert_array_equal(after.model_index, before.model_index)
    assert after.log_evidence == -12.5
    assert after.info == {"flags": ["slow"], "evaluations": 7, "acceptance": {"walk": 0.25}}
    np.testing.assert_array_equal(after.snapshots.states["a"], [0.5, 1.0])
    np.testing.assert_array_equal(after.snapshots.step, [0, 1])


def test_nothing_pickled_is_written_or_read(tmp_path) -> None:
    with pytest.raises(ValueError, match=r"[Oo]bject"):
        Posterior({"a": np.array([[object()]])}).save(tmp_path)
    np.savez(tmp_path / "posterior.npz", **{"draws/a": np.array([object()])}, allow_pickle=True)
    (tmp_path / "posterior.json").write_text('{"log_evidence": null, "info": {}}')
    with pytest.raises(ValueError, match="allow_pickle"):
        Posterior.load(tmp_path)


def test_posterior_opens_in_arviz() -> None:
    data = weighted()[0].to_arviz()
    assert dict(data.posterior.sizes) == {"chain": 2, "draw": 3, "z_dim_0": 2}
    assert data.sample_stats["log_weight"].shape == (2, 3)
