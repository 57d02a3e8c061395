"""The calibration harness on exact samplers, and on samplers that are wrong in a known way."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from inference import calibration, least_squares
from inference.posterior import Posterior
from models.program import Latents
from models.toys.gaussian import ConjugateGaussian, Readings

MODEL = ConjugateGaussian()
BLANK = Readings(torch.linspace(-1.0, 3.0, 6, dtype=torch.float64), None)
FUNCTIONALS: dict[str, calibration.Functional] = {
    "level": lambda z: z["beta"][:, 0],
    "slope": lambda z: z["beta"][:, 1],
}
CONSTANT: dict[str, calibration.Functional] = {"one": lambda z: 0 * z["beta"][:, 0]}


def exact_draws(evidence: Readings, num: int, seed: int, spread: float = 1.0) -> np.ndarray:
    mean, covariance, _ = MODEL.exact(evidence)
    noise = np.random.default_rng(seed).standard_normal((num, 2))
    return mean.numpy() + spread * noise @ torch.linalg.cholesky(covariance).numpy().T


def conjugate(spread: float = 1.0) -> calibration.Engine:
    """Exact draws, their spread about the mean multiplied."""

    def engine(model: Any, evidence: Readings, seed: int) -> Posterior:
        return Posterior({"beta": exact_draws(evidence, 19, seed, spread)[None]})

    return engine


def refresh(spread: float = 1.0) -> calibration.Transition:
    """Forget the latents and draw them anew, as far as `spread` is one exactly."""

    def go(latents: Latents, evidence: Readings, seed: int) -> Latents:
        rows = [
            exact_draws(Readings(evidence.t, y), 1, seed + i, spread)[0] for i, y in enumerate(torch.unbind(evidence.y))
        ]
        return {"beta": torch.from_numpy(np.stack(rows))}

    return go


def ranks(spread: float) -> calibration.Ranks:
    return calibration.ranks(MODEL, BLANK, conjugate(spread), FUNCTIONALS, num=300, num_draws=19, seed=0)


def test_ranks_of_an_exact_sampler_are_uniform() -> None:
    found = ranks(1.0)
    assert set(found.ranks) == {"level", "slope", "log_joint"}
    assert all(len(r) == 300 and r.min() >= 0 and r.max() <= 19 for r in found.ranks.values())
    assert min(found.p_values().values()) > 1e-3  # odds of a false alarm: 3 in 1000, the seed is fixed


@pytest.mark.parametrize("spread", [0.7, 1.5])
def test_ranks_notice_a_wrong_spread(spread: float) -> None:
    assert ranks(spread).p_values()["level"] < 1e-4


def test_least_squares_is_calibrated_on_a_linear_model() -> None:
    engine = lambda model, evidence, seed: least_squares.run(model, evidence, seed=seed, num_draws=19)  # noqa: E731
    found = calibration.ranks(MODEL, BLANK, engine, FUNCTIONALS, num=100, num_draws=19, seed=2)
    assert min(found.p_values().values()) > 1e-3


def test_batched_engine_ranks_each_scene_against_its_own_chain() -> None:
    def together(model: Any, evidence: Readings, seed: int) -> Posterior:
        rows = [exact_draws(Readings(evidence.t, y), 19, seed + i) for i, y in enumerate(torch.unbind(evidence.y))]
        return Posterior({"beta": np.stack(rows)})

    found = calibration.ranks(MODEL, BLANK, together, FUNCTIONALS, num=300, num_draws=19, seed=0, batched=True)
    assert min(found.p_values().values()) > 1e-3


def test_ties_are_broken_uniformly() -> None:
    found = calibration.ranks(MODEL, BLANK, conjugate(), CONSTANT, num=300, num_draws=9, seed=1)
    assert found.p_values()["one"] > 1e-3
    assert set(found.ranks["one"]) == set(range(10))


def test_uniformity_is_a_test_of_uniformity() -> None:
    even = np.arange(200) % 20
    assert calibration.uniformity(even, 19) == pytest.approx(1.0)
    assert calibration.uniformity(even // 2, 19) < 1e-10


def geweke(spread: float) -> dict[str, float]:
    functionals = FUNCTIONALS | {"level^2": lambda z: z["beta"][:, 0] ** 2}
    return calibration.geweke(MODEL, BLANK, refresh(spread), functionals, num=300, num_steps=5, seed=3)


def test_joint_test_passes_an_exact_transition() -> None:
    assert max(map(abs, geweke(1.0).values())) < 4.0


def test_joint_test_notices_a_wrong_spread() -> None:
    assert abs(geweke(1.3)["log_joint"]) > 5.0


def test_predicted_observations_follow_the_latents() -> None:
    """Residuals of 4000 replicates have mean 0 and the noise's sd, within 4 standard errors."""
    latents = {"beta": torch.tensor([[1.0, -2.0]], dtype=torch.float64).expand(4000, 2)}
    state = torch.get_rng_state()
    evidence = calibration.predict(MODEL, latents, BLANK, seed=0)
    assert torch.equal(torch.get_rng_state(), state)
    residual = (evidence.y - (1.0 - 2.0 * BLANK.t)) / MODEL.noise_std
    assert residual.shape == (4000, 6)
    assert abs(float(residual.mean())) < 4 / math.sqrt(24000)
    assert abs(float(residual.std()) - 1.0) < 4 / math.sqrt(2 * 24000)
