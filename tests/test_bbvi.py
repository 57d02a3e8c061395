"""Variational inference is exact where q can be, is what theory says where it cannot, and says which it was."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from inference import bbvi
from inference.gradients import Gaussian, blocks, overdispersed, reading, reparameterised, score
from inference.posterior import Posterior
from inference.transform import standard, target_of
from models.capability import Factors
from models.program import InputError
from models.toys.slot_road import Markings, SlotRoad
from tests.hierarchy import Hierarchy, readings

Array = NDArray[np.float64]
MODEL = Hierarchy(num_groups=3)
EVIDENCE = readings(MODEL)
FACTORS = MODEL.factors(EVIDENCE)
MEAN, COVARIANCE, LOG_EVIDENCE = MODEL.exact(EVIDENCE)
SD = np.sqrt(COVARIANCE.diagonal())
PRECISION = np.linalg.inv(COVARIANCE)
DRAWS = 4000
SHORT: dict[str, Any] = {"num_draws": DRAWS, "num_snapshots": 0}


def run(**knobs: Any) -> Posterior:
    return bbvi.run(MODEL, EVIDENCE, **({"seed": 1} | SHORT | knobs))


def whitened(posterior: Posterior) -> Array:
    """Draws of x, (N, D)."""
    return np.concatenate([posterior.draws["line"][0], posterior.draws["offset"][0] / MODEL.offset_std], 1)


@pytest.mark.parametrize("estimator", bbvi.ESTIMATORS)
def test_whitened_mean_field_is_exact_on_a_gaussian(estimator: str) -> None:
    """Within 4 standard errors of the draws, 1 / sqrt(N) sd and 1 / sqrt(2 N) for the sd itself, and what Adam's last
    steps leave: 0.02 * 0.1 of a sd each, some tens of them."""
    x = whitened(run(estimator=estimator, num_steps=300))
    assert np.abs((x.mean(0) - MEAN) / SD).max() < 4 / np.sqrt(DRAWS) + 0.04
    assert np.abs(x.std(0) / SD - 1).max() < 4 / np.sqrt(2 * DRAWS) + 0.04
    correlations = np.corrcoef(x.T) - COVARIANCE / np.outer(SD, SD)
    assert np.abs(correlations).max() < 4 / np.sqrt(DRAWS) + 0.04


def test_mean_field_in_the_priors_numbers_has_the_conditional_scales() -> None:
    """Of all independent q the closest one has variances 1 / P_dd (Bishop 2006, eq. 10.12 to 10.15)."""
    posterior = run(transform="prior", estimator="reparameterised", num_steps=800, learning_rate=0.05)
    x = whitened(posterior)
    assert np.abs((x.mean(0) - MEAN) / SD).max() < 0.1
    assert x.std(0) * np.sqrt(PRECISION.diagonal()) == pytest.approx(np.ones(5), abs=0.06)
    assert np.abs(np.corrcoef(x.T) - np.eye(5)).max() < 4.5 / np.sqrt(DRAWS)
    distance = 0.5 * (np.log(PRECISION.diagonal()).sum() - np.linalg.slogdet(PRECISION)[1])
    assert posterior.info["elbo"] == pytest.approx(LOG_EVIDENCE - distance, abs=0.05 + 4 * posterior.info["elbo_error"])


def test_full_rank_recovers_correlations() -> None:
    knobs = {"transform": "prior", "estimator": "reparameterised", "num_steps": 800, "learning_rate": 0.05}
    posterior = run(full_rank=True, **knobs)
    assert np.cov(whitened(posterior).T) / np.outer(SD, SD) == pytest.approx(COVARIANCE / np.outer(SD, SD), abs=0.12)
    assert posterior.info["elbo"] == pytest.approx(LOG_EVIDENCE, abs=0.02)
    assert posterior.info["flags"] == []


def test_weights_restore_the_posterior_from_a_wider_q() -> None:
    """Of a q 1.3 times as wide; the tolerances are 4 standard errors at the weights' effective size."""
    posterior = run(fixed_scale=1.3, estimator="reparameterised", weighted=True)
    x, w = whitened(posterior), posterior.weights[0]
    error = 4 / np.sqrt(posterior.info["ess"])
    mean = w @ x
    assert np.abs((mean - MEAN) / SD).max() < error
    assert x.std(0) / SD == pytest.approx(np.full(5, 1.3), abs=0.1)
    assert np.sqrt(w @ (x - mean) ** 2) / SD == pytest.approx(np.ones(5), abs=error / np.sqrt(2))
    assert posterior.log_evidence == pytest.approx(LOG_EVIDENCE, abs=error)
    assert posterior.info["elbo"] < LOG_EVIDENCE - 0.3


def test_a_q_of_fixed_scale_finds_the_mode() -> None:
    """Trusheim et al., eq. 6 and 8: MAP = mean of q, and the draws have the scale of q."""
    posterior = run(transform="prior", fixed_scale=1.0, estimator="reparameterised", num_steps=600)
    assert FACTORS.whiten(posterior.estimate) == pytest.approx(MEAN, abs=0.1 * SD.min())
    assert whitened(posterior).std(0) == pytest.approx(np.ones(5), abs=4 / np.sqrt(2 * DRAWS))
    assert any("scale of q is fixed" in flag for flag in posterior.info["flags"])


def test_noise_annealing_falls_to_the_whole_likelihood() -> None:
    target = target_of(FACTORS, standard(5))
    options = (reading(target, True), True, [], True, False, False)
    plan = bbvi.Plan(target, "score", *options, num_steps=100, learning_rate=0.1, inflation=5.0, annealed=0.4)
    shares = [bbvi.share_of(plan, done) for done in (0, 20, 40, 99)]
    assert shares == pytest.approx([1 / 25, 1 / 5, 1.0, 1.0])
    assert bbvi.share_of(plan._replace(annealed=0.0), 0) == 1.0


@pytest.mark.parametrize("estimator", bbvi.ESTIMATORS)
def test_a_step_follows_the_gradient_of_the_inflated_likelihood(estimator: str) -> None:
    """Adam remembers a tenth of the first gradient and goes along its sign, by the whole rate at the first step."""
    target = target_of(FACTORS, standard(5))
    reads = reading(target, True)
    parts = blocks(FACTORS.sites, reads, 24)
    options = (reads, True, parts, True, False, False)
    plan = bbvi.Plan(target, estimator, *options, num_steps=1000, learning_rate=0.1, inflation=5.0, annealed=0.4)
    before = bbvi.first_state(plan, np.full(5, 0.2), 0.8, 1.5)
    noise = np.random.default_rng(0).standard_normal((24, 5))
    q, slopes = bbvi.q_of(plan, before.numbers), np.zeros(2)
    if estimator == "reparameterised":
        gradient = reparameterised(target, q, noise, 1 / 25)
    elif estimator == "score":
        gradient = score(target, q, noise, 1 / 25, reads, True)
    else:
        gradient, slopes = overdispersed(target, q, noise, 1 / 25, reads, True, parts, before.tau)
    after = bbvi.step(plan, before, noise)
    assert after.drift == pytest.approx(0.1 * gradient, rel=1e-12)
    assert after.numbers - before.numbers == pytest.approx(0.1 * np.sign(gradient), rel=1e-4)
    assert np.array_equal(after.tau > before.tau, slopes < 0.0)  # towards less variance


def two_modes() -> Factors:
    """One number: 2 % of the likelihood in a narrow mode at -2, the rest in a wide one at 1."""

    def parts(x: Array) -> tuple[Array, Array]:
        return 0.02 * np.exp(-0.5 * ((x + 2) / 0.2) ** 2) / 0.2, 0.98 * np.exp(-0.5 * ((x - 1) / 0.5) ** 2) / 0.5

    def evaluate(x: Array) -> Array:
        return np.log(sum(parts(x)) + 1e-300)

    def gradient(x: Array) -> tuple[Array, Array]:
        decoy, main = parts(x)
        return evaluate(x)[:, 0], -(decoy * (x + 2) / 0.04 + main * (x - 1) / 0.25) / (decoy + main + 1e-300)

    whiten = lambda state: np.atleast_1d(np.asarray(state["x"], dtype=np.float64))  # noqa: E731
    return Factors(evaluate, gradient, np.ones((1, 1), bool), {"x": slice(0, 1)}, lambda x: {"x": x}, whiten)


class TwoModes:
    def __call__(self, evidence: Any) -> None: ...

    def factors(self, evidence: Any) -> Factors:
        return two_modes()


@pytest.mark.parametrize(("inflation", "mode"), [(1.0, -2.0), (8.0, 0.8)])
def test_annealing_leads_out_of_a_narrow_wrong_mode(inflation: float, mode: float) -> None:
    """The main mode of prior times likelihood is at 1 / 1.25 = 0.8; without annealing q stays where it began."""
    knobs: dict[str, Any] = {"transform": "prior", "init": {"x": -2.0}, "start_scale": 0.2, "num_steps": 300}
    posterior = bbvi.run(TwoModes(), None, seed=2, inflation=inflation, annealed=0.7, **(knobs | SHORT))
    assert float(posterior.estimate["x"][0]) == pytest.approx(mode, abs=0.15)


def test_a_run_that_stops_early_says_so() -> None:
    early = run(transform="prior", num_steps=10)
    assert any("not converged" in flag for flag in early.info["flags"])
    late = run(transform="prior", num_steps=800, learning_rate=0.05)
    assert not any("not converged" in flag for flag in late.info["flags"])


def test_weights_with_a_heavy_tail_are_flagged() -> None:
    """A q of half the posterior's width: its weights have k > 0.7, as variance ratios below one half must."""
    posterior = run(fixed_scale=0.4)
    assert posterior.info["pareto_k"] > 0.7
    assert any("Pareto" in flag for flag in posterior.info["flags"])


def test_what_is_left_to_gain_is_known_for_a_gaussian() -> None:
    """p = N(0, 1) in u: a mean off by 0.5 costs 0.125 nats, and curvature is one."""
    unread = Hierarchy(num_groups=3, noise_std=1e6)
    target = target_of(unread.factors(EVIDENCE), standard(5))
    plan = bbvi.Plan(target, "score", reading(target, True), True, [], True, False, False, 1, 0.1, 1.0, 0.0)
    q = Gaussian(np.array([0.5, 0, 0, 0, 0]), np.zeros(5))
    noise = np.random.default_rng(0).standard_normal((20000, 5))
    gain, error = bbvi.gain_left(plan, q, noise, target.evaluate(q.draw(noise)))
    assert error < 0.01
    assert gain == pytest.approx(0.125, abs=4 * error)


def test_what_is_left_to_gain_counts_curvature() -> None:
    """p = N(0, 1), q = N(m, s^2): g_mean = -m s, g_log_sd = 1 - s^2, c = s^2."""
    unread, s, mean = Hierarchy(num_groups=3, noise_std=1e6), 0.5, 0.5
    target = target_of(unread.factors(EVIDENCE), standard(5))
    plan = bbvi.Plan(target, "score", reading(target, True), True, [], True, False, False, 1, 0.1, 1.0, 0.0)
    q, noise = Gaussian(np.array([mean, 0, 0, 0, 0]), np.log([s, 1, 1, 1, 1])), np.random.default_rng(0)
    draws = noise.standard_normal((20000, 5))
    gain, error = bbvi.gain_left(plan, q, draws, target.evaluate(q.draw(draws)))
    assert gain == pytest.approx(0.5 * mean**2 + 0.25 * (1 - s**2) ** 2, abs=4 * error)


def test_the_noise_of_few_draws_is_no_gain() -> None:
    """The closest mean field has nothing to gain: less its noise the sum falls below zero, which is told as zero, about
    every second time. A third of 200 is five standard errors less than half of them."""
    target = target_of(FACTORS, standard(5))
    plan = bbvi.Plan(target, "score", reading(target, True), True, [], True, False, False, 1, 0.1, 1.0, 0.0)
    q, rng = Gaussian(MEAN, -0.5 * np.log(PRECISION.diagonal())), np.random.default_rng(0)
    noises = rng.standard_normal((200, 500, 5))
    found = [bbvi.gain_left(plan, q, noise, target.evaluate(q.draw(noise)))[0] for noise in noises]
    assert 1 / 3 < np.mean(np.equal(found, 0.0)) < 2 / 3


def test_a_weight_that_bears_all_is_flagged() -> None:
    """A q so far off that every other weight is nothing beside the largest: no tail is left to fit."""
    model = Hierarchy(num_groups=12, noise_std=1e-4)
    posterior = bbvi.run(model, readings(model), seed=1, transform="prior", num_steps=2, **SHORT)
    assert posterior.info["pareto_k"] == np.inf
    assert any("Pareto tail of k = inf" in flag for flag in posterior.info["flags"])


def test_tau_follows_the_variance() -> None:
    held = run(estimator="overdispersed", adapt_tau=False, num_steps=100)
    assert held.info["tau"] == [1.5, 1.5]
    free = run(estimator="overdispersed", num_steps=100)
    assert free.info["tau"] != [1.5, 1.5]
    assert all(1.0 <= tau <= bbvi.TAU_MAX for tau in free.info["tau"])


def test_the_same_seed_gives_the_same_bits() -> None:
    one, two, other = (run(seed=seed, estimator="overdispersed", num_steps=30) for seed in (5, 5, 6))
    assert np.array_equal(one.draws["line"], two.draws["line"])
    assert one.log_evidence == two.log_evidence
    assert not np.array_equal(one.draws["line"], other.draws["line"])


def test_snapshots_follow_the_mean_of_q() -> None:
    posterior = run(transform="prior", num_steps=200, num_snapshots=4)
    shots = posterior.snapshots
    assert shots is not None
    assert list(shots.step) == [0, 50, 100, 150, 200]
    assert np.array_equal(shots.states["line"][0], np.zeros(2))
    assert np.array_equal(shots.states["line"][-1], posterior.estimate["line"])
    assert shots.log_joint[-1] > shots.log_joint[0] + 5
    assert np.all(np.diff(shots.seconds) > 0)
    assert run(num_steps=5).snapshots is None
    assert posterior.info["evaluations"] == 200 * 64 + DRAWS


@pytest.mark.parametrize(
    ("knobs", "sentence"),
    [
        ({"estimator": "rebar"}, "estimator must be one of score, overdispersed, reparameterised, but is 'rebar'"),
        ({"full_rank": True}, "full_rank=true needs estimator=reparameterised, but it is score"),
        ({"fixed_scale": -1.0}, "fixed_scale is -1.0; it must be positive"),
        ({"num_steps": 0}, "num_steps is 0; bbvi needs 1 or more"),
        ({"learning_rate": 0.0}, "learning_rate is 0.0; it must be positive"),
        ({"inflation": 0.5}, "inflation is 0.5; bbvi needs 1 or more"),
        ({"annealed": 1.5}, "annealed is the share of the steps with inflated noise, 0 to 1, but is 1.5"),
        ({"num_samples": 3}, "num_samples is 3; estimator=score needs 4 or more on this model"),
        ({"num_samples": 7, "estimator": "overdispersed"}, "estimator=overdispersed needs 8 or more"),
        ({"transform": "pca"}, "transform must be prior or laplace, but is 'pca'"),
    ],
)
def test_knobs_that_cannot_be_are_refused_in_one_sentence(knobs: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        run(**knobs)


def test_discrete_latents_are_refused_by_name_with_the_remedy() -> None:
    s = torch.linspace(0.0, 50.0, 4, dtype=torch.float64)
    with pytest.raises(InputError, match="'num_knots' is Categorical; fix\\(\\) it first"):
        bbvi.run(SlotRoad(), Markings(s, torch.zeros(4, dtype=torch.float64)), seed=0)


def test_a_gradient_that_is_not_finite_is_named_with_the_draw() -> None:
    class Cliff(TwoModes):
        def factors(self, evidence: Any) -> Factors:
            return two_modes()._replace(evaluate=lambda x: np.where(x > 1.0, -np.inf, 0.0))

    with pytest.raises(FloatingPointError, match=r"not finite at step 0, with a draw of q at .'x': array"):
        bbvi.run(Cliff(), None, seed=0, transform="prior")
