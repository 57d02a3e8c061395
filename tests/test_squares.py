"""Least squares on a compiled sum of squares: exact where it is linear, and it learns what it says it learns."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from inference import least_squares, squares
from inference.arrow import squared_norm
from inference.posterior import Posterior
from models.capability import Chart, Squares
from models.program import InputError, log_joint

Array = NDArray[np.float64]


class Readings(NamedTuple):
    """y (M,) of a design (M, 7)."""

    design: Array
    y: Tensor


class Line:
    """y ~ N(J (a, b), NOISE^2), a ~ N(1, 2^2) of three numbers, b ~ N(-0.5, STD^2) of 2 x 2."""

    NOISE, STD = 0.7, 0.4

    def __call__(self, evidence: Readings) -> None:
        a = pyro.sample("a", dist.Normal(torch.ones(3), 2.0).to_event(1))
        b = pyro.sample("b", dist.Normal(torch.full((2, 2), -0.5), self.STD).to_event(2))
        z = torch.cat([a, b.reshape((*b.shape[:-2], 4))], -1)
        mean = z @ torch.from_numpy(evidence.design).T
        pyro.sample("y", dist.Normal(mean, self.NOISE).to_event(1), obs=evidence.y)


class CompiledLine(Line):
    """The same with its sum of squares written down."""

    def squares(self, evidence: Readings) -> Squares:
        design, y = evidence.design / self.NOISE, evidence.y.numpy() / self.NOISE

        def evaluate(z: Array, hessian: Array, gradient: Array) -> float:
            residual = design @ z - y
            hessian[:], gradient[:] = design.T @ design, design.T @ residual
            return 0.5 * float(residual @ residual)

        loc, scale = np.r_[np.ones(3), np.full(4, -0.5)], np.r_[np.full(3, 2.0), np.full(4, self.STD)]
        log_const = -len(y) * math.log(self.NOISE * math.sqrt(2 * math.pi))
        return Squares(loc, scale, {"a": slice(0, 3), "b": slice(3, 7)}, {"a": (3,), "b": (2, 2)}, evaluate, log_const)


RNG = np.random.default_rng(4)
DESIGN = RNG.standard_normal((12, 7))
SEEN = Readings(
    DESIGN, torch.from_numpy(DESIGN @ np.r_[3.0, 0.0, -2.0, -2.5, 1.0, 0.5, -3.0] + RNG.standard_normal(12))
)
LINE = CompiledLine().squares(SEEN)


def exact(scale: Array) -> tuple[Array, Array, float]:
    """Mean (7,), covariance (7, 7) and log evidence of the conjugate Gaussian."""
    gain = DESIGN.T / Line.NOISE**2
    covariance = np.linalg.inv(np.diag(scale**-2) + gain @ DESIGN)
    mean = covariance @ (LINE.loc / scale**2 + gain @ SEEN.y.numpy())
    spread = DESIGN @ np.diag(scale**2) @ DESIGN.T + Line.NOISE**2 * np.eye(12)
    marginal = dist.MultivariateNormal(torch.from_numpy(DESIGN @ LINE.loc), torch.from_numpy(spread))
    return mean, covariance, float(marginal.log_prob(SEEN.y))


def linearise(scale: Array, x: Array) -> squares.State:
    return squares.linearise(LINE, scale, x, np.empty((1, 7, 7)))


def flat(posterior: Posterior) -> Array:
    """All draws, (D, 7)."""
    return np.concatenate([posterior.draws["a"][0], posterior.draws["b"][0].reshape(-1, 4)], 1)


def test_mean_covariance_and_evidence_are_those_of_the_conjugate_gaussian() -> None:
    mean, covariance, log_evidence = exact(LINE.scale)
    posterior = least_squares.run(CompiledLine(), SEEN, seed=0)
    assert posterior.estimate["b"].shape == (2, 2)
    np.testing.assert_allclose(LINE.pack(posterior.estimate), mean, atol=1e-8)
    assert posterior.log_evidence == pytest.approx(log_evidence, abs=1e-8)
    assert posterior.info["converged"] is True
    assert posterior.info["flags"] == []
    state = linearise(LINE.scale, (mean - LINE.loc) / LINE.scale)
    found = np.linalg.inv(state.hessian[0] + np.diag(LINE.scale**-2))
    np.testing.assert_allclose(found, covariance, atol=1e-10)


def test_draws_have_the_exact_mean_and_covariance() -> None:
    """Within 4 standard errors of 20000 independent draws: sd / sqrt(n), and sd sd' sqrt(2 / n) at most."""
    mean, covariance, _ = exact(LINE.scale)
    posterior = least_squares.run(CompiledLine(), SEEN, seed=1, num_draws=20000)
    assert posterior.draws["a"].shape == (1, 20000, 3)
    assert posterior.draws["b"].shape == (1, 20000, 2, 2)
    sd = np.sqrt(covariance.diagonal())
    assert np.all(np.abs(flat(posterior).mean(0) - mean) < 4 * sd / math.sqrt(20000))
    assert np.all(np.abs(np.cov(flat(posterior).T) - covariance) < 4 * np.outer(sd, sd) * math.sqrt(2 / 20000))


def test_program_alone_leads_to_the_same() -> None:
    compiled, traced = (least_squares.run(model, SEEN, seed=0, num_draws=1) for model in (CompiledLine(), Line()))
    np.testing.assert_allclose(LINE.pack(compiled.estimate), LINE.pack(traced.estimate), atol=1e-8)
    assert compiled.log_evidence == pytest.approx(traced.log_evidence, abs=1e-8)


def test_init_is_where_it_starts_and_is_forgotten() -> None:
    init = {"a": torch.tensor([5.0, -5.0, 0.0]), "b": torch.ones(2, 2)}
    posterior = least_squares.run(CompiledLine(), SEEN, seed=0, init=init)
    np.testing.assert_allclose(posterior.snapshots.states["a"][0], [5.0, -5.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(LINE.pack(posterior.estimate), exact(LINE.scale)[0], atol=1e-8)


def test_snapshots_hold_the_log_joint_of_their_states() -> None:
    found = least_squares.run(CompiledLine(), SEEN, seed=0).snapshots
    states = {name: torch.from_numpy(value) for name, value in found.states.items()}
    np.testing.assert_allclose(found.log_joint, log_joint(Line(), states, SEEN), rtol=1e-10)


def test_same_seed_same_bits_and_other_seed_other_draws() -> None:
    a, b, c = (least_squares.run(CompiledLine(), SEEN, seed=seed, num_draws=5).draws["a"] for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


class Skewed(Line):
    """a ~ N(MEAN, TRIL TRIL^T) alone, of which the sum of squares sees the whitened numbers."""

    MEAN, TRIL = np.array([1.0, -2.0, 0.5]), np.array([[2.0, 0.0, 0.0], [0.7, 0.5, 0.0], [-0.4, 0.3, 3.0]])

    def __call__(self, evidence: Readings) -> None:
        prior = dist.MultivariateNormal(torch.from_numpy(self.MEAN), scale_tril=torch.from_numpy(self.TRIL))
        mean = pyro.sample("a", prior) @ torch.from_numpy(evidence.design[:, :3]).T
        pyro.sample("y", dist.Normal(mean, self.NOISE).to_event(1), obs=evidence.y)


class CompiledSkewed(Skewed):
    def squares(self, evidence: Readings) -> Squares:
        slopes, gap = evidence.design[:, :3] @ self.TRIL, evidence.y.numpy() - evidence.design[:, :3] @ self.MEAN

        def evaluate(z: Array, hessian: Array, gradient: Array) -> float:
            residual = (slopes @ z - gap) / self.NOISE
            hessian[:], gradient[:] = slopes.T @ slopes / self.NOISE**2, slopes.T @ residual / self.NOISE
            return 0.5 * float(residual @ residual)

        chart = Chart(
            forward=lambda z: self.MEAN + z @ self.TRIL.T,
            inverse=lambda a: np.linalg.solve(self.TRIL, a - self.MEAN),
            log_volume=lambda z: np.full(z.shape[:-1], np.log(np.diag(self.TRIL)).sum()),
        )
        const = -len(gap) * math.log(self.NOISE * math.sqrt(2 * math.pi))
        return Squares(np.zeros(3), np.ones(3), {"a": slice(0, 3)}, {"a": (3,)}, evaluate, const, {"a": chart})


def test_correlated_priors_lead_to_the_same_as_their_program() -> None:
    """Evidence, snapshots in natural units, and init, which is whitened."""
    init = {"a": torch.tensor([0.3, 1.0, -2.0])}
    compiled, traced = (least_squares.run(m, SEEN, seed=0, init=init) for m in (CompiledSkewed(), Skewed()))
    np.testing.assert_allclose(compiled.estimate["a"], traced.estimate["a"], atol=1e-8)
    assert compiled.log_evidence == pytest.approx(traced.log_evidence, abs=1e-8)
    found = compiled.snapshots
    np.testing.assert_allclose(found.states["a"][0], init["a"], atol=1e-6)
    states = {"a": torch.from_numpy(found.states["a"])}
    np.testing.assert_allclose(found.log_joint, log_joint(Skewed(), states, SEEN), rtol=1e-10)


# Where it is not linear


def valley(z: Array, hessian: Array, gradient: Array) -> float:
    """Rosenbrock's residuals 10 (y - x^2) and 1 - x: undamped steps climb its walls."""
    residual = np.array([10.0 * (z[1] - z[0] ** 2), 1.0 - z[0]])
    slopes = np.array([[-20.0 * z[0], 10.0], [-1.0, 0.0]])
    hessian[:], gradient[:] = slopes.T @ slopes, slopes.T @ residual
    return 0.5 * float(residual @ residual)


VALLEY = Squares(np.zeros(2), np.full(2, 1e4), {"z": slice(0, 2)}, {"z": (2,)}, valley, 0.0)


def minimise(problem: Squares, x: Array, **knobs: Any) -> squares.Path:
    return squares.minimise(problem, x, **{"num_steps": 100, "damping": 1e-3, "tolerance": 1e-12, "learn": ()} | knobs)


def test_steps_that_would_climb_are_refused() -> None:
    path = minimise(VALLEY, np.array([-1.2e-4, 1e-4]))
    costs = [cost for _, cost, _ in path.visited]
    assert np.all(np.diff(costs) <= 0)
    assert np.any(np.diff(costs) == 0)  # some were refused
    assert path.converged
    np.testing.assert_allclose(path.visited[-1][2], [1.0, 1.0], atol=1e-5)


def test_too_few_steps_are_flagged_with_a_remedy() -> None:
    class Valley(CompiledLine):
        def squares(self, evidence: Readings) -> Squares:
            return VALLEY

    posterior = least_squares.run(Valley(), SEEN, seed=0, num_steps=5, init={"z": np.array([-1.2, 1.0])})
    assert posterior.info["converged"] is False
    assert "raise num_steps" in posterior.info["flags"][0]


def test_a_search_whose_steps_run_out_at_the_minimum_has_converged() -> None:
    """Kinks of a density make the last steps gain next to nothing for ever."""
    near = minimise(VALLEY, np.array([-1.2e-4, 1e-4])).state.x
    for away, converged in ((1e-9, True), (1e-4, False)):
        path = minimise(VALLEY, near + np.array([away, 0.0]), num_steps=0, tolerance=0.0)
        left = 0.5 * squared_norm(path.factor, path.state.gradient)
        assert path.converged is converged is (left <= squares.NEAR), left


class Uphill(CompiledLine):
    """A gradient that points uphill: every step is refused and the damping grows until steps promise nothing."""

    def squares(self, evidence: Readings) -> Squares:
        def evaluate(z: Array, hessian: Array, gradient: Array) -> float:
            hessian[:], gradient[:] = 1.0, -4.0
            return 4.0 * float(z[0])

        return Squares(np.zeros(1), np.ones(1), {"z": slice(0, 1)}, {"z": (1,)}, evaluate, 0.0)


def test_steps_refused_again_and_again_are_no_convergence() -> None:
    posterior = least_squares.run(Uphill(), SEEN, seed=0)
    assert posterior.info["converged"] is False
    assert "no step lowers the cost, though 4 nats are promised" in posterior.info["flags"][0]


# Learnt scales


def formula(scale: Array) -> float:
    """(4 s_0^2 + sum (z - loc)^2) / (4 + gamma) of b, with mean and variances of the exact posterior under scale."""
    mean, covariance, _ = exact(scale)
    gamma = (1.0 - covariance.diagonal()[3:] / scale[3:] ** 2).sum()
    return float((4.0 * Line.STD**2 + ((mean - LINE.loc)[3:] ** 2).sum()) / (4.0 + gamma))


def learn(scale: Array, x: Array) -> tuple[squares.State, Array]:
    """Learn the scale of b at x."""
    state = linearise(scale, x)
    whitened = np.eye(7) + np.outer(scale, scale) * state.hessian[0]
    return squares.relearn(LINE, state, scale, np.linalg.inv(whitened).diagonal(), ("b",))


def test_relearning_follows_its_formula() -> None:
    mean, _, _ = exact(LINE.scale)
    _, scale = learn(LINE.scale, (mean - LINE.loc) / LINE.scale)
    np.testing.assert_allclose(scale[3:] ** 2, formula(LINE.scale), rtol=1e-10)
    np.testing.assert_array_equal(scale[:3], LINE.scale[:3])


def test_learnt_scale_is_a_fixed_point_of_its_formula() -> None:
    """To a tenth of the variance: learning stops with the steps, for the rest is lost in what four numbers can tell."""
    path = minimise(LINE, np.zeros(7), learn=("b",), tolerance=1e-16)
    assert path.converged
    np.testing.assert_allclose(path.visited[-1][2], exact(path.scale)[0], atol=1e-6)
    learnt = formula(path.scale)
    assert learnt > 2 * Line.STD**2  # the data contradict the configured scale
    np.testing.assert_allclose(path.scale[3:] ** 2, learnt, rtol=0.1)
    np.testing.assert_array_equal(path.scale[:3], LINE.scale[:3])


def test_learning_is_reported_and_used() -> None:
    posterior = least_squares.run(CompiledLine(), SEEN, seed=1, learn=["b"], num_draws=20000, num_steps=200)
    scale = posterior.info["learnt_scales"]["b"]
    mean, covariance, log_evidence = exact(np.r_[LINE.scale[:3], np.full(4, scale)])
    assert posterior.log_evidence == pytest.approx(log_evidence, abs=1e-6)
    sd = np.sqrt(covariance.diagonal())
    assert np.all(np.abs(flat(posterior).mean(0) - mean) < 4 * sd / math.sqrt(20000))
    assert np.all(np.abs(flat(posterior).std(0) / sd - 1.0) < 4 / math.sqrt(2 * 20000))


def test_snapshots_are_all_valued_under_the_scales_learnt_last() -> None:
    posterior = least_squares.run(CompiledLine(), SEEN, seed=1, learn=["b"], num_draws=1)
    found, learnt = posterior.snapshots, Line()
    learnt.STD = posterior.info["learnt_scales"]["b"]  # type: ignore[misc]
    states = {name: torch.from_numpy(value) for name, value in found.states.items()}
    np.testing.assert_allclose(found.log_joint, log_joint(learnt, states, SEEN), rtol=1e-10)


def test_relearning_moves_the_scale_alone() -> None:
    """Latents and what the data say stay, to rounding: cost, gradient and hessian in natural units."""
    x = RNG.standard_normal(7)
    new, scale = learn(LINE.scale, x)
    assert np.all(scale[3:] != LINE.scale[3:])
    np.testing.assert_allclose(scale * new.x, LINE.scale * x, rtol=1e-12)
    again = linearise(scale, new.x)
    assert new.cost == pytest.approx(again.cost, rel=1e-12)
    np.testing.assert_allclose(new.gradient, again.gradient, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(new.hessian, again.hessian, rtol=1e-10, atol=1e-10)


def test_learnt_scale_keeps_within_its_bounds() -> None:
    """Numbers far out reach the upper bound. At their prior's middle they shrink it, but by no more than the trust in
    the configured scale allows, sqrt(4 / (4 + 4))."""
    far, middle = np.full(7, 1e6), np.zeros(7)
    assert learn(LINE.scale, far)[1][3] / Line.STD == pytest.approx(squares.WIDEST)
    assert math.sqrt(0.5) < learn(LINE.scale, middle)[1][3] / Line.STD < 1.0


# Mistakes


def test_learning_a_site_that_is_not_there_is_one_sentence() -> None:
    with pytest.raises(InputError, match=r"^learn names c, d, but the latents are a, b$"):
        least_squares.run(CompiledLine(), SEEN, seed=0, learn=["c", "a", "d"])


def test_the_scale_of_a_charted_site_is_not_learnt() -> None:
    with pytest.raises(InputError, match="learn names a, whose numbers have no prior scale of their own"):
        least_squares.run(CompiledSkewed(), SEEN, seed=0, learn=["a"])


@pytest.mark.parametrize(
    ("knobs", "sentence"),
    [
        ({"num_draws": 0}, "num_draws is 0; least squares needs 1 or more"),
        ({"init": 3}, "init is 3; give a value for each site"),
        ({"init": {"a": torch.full((3,), math.nan), "b": torch.zeros(2, 2)}}, "which is not finite"),
    ],
)
def test_knobs_that_no_fit_can_take_are_one_sentence(knobs: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        least_squares.run(CompiledLine(), SEEN, seed=0, **knobs)


def test_learning_needs_squares() -> None:
    with pytest.raises(InputError, match=r"^learn needs a model with squares\(\), but Line has none; leave it empty$"):
        least_squares.run(Line(), SEEN, seed=0, learn=["b"])


def test_continuation_is_refused() -> None:
    with pytest.raises(InputError, match=r"^continuation is not for models with squares\(\); leave it at \[1.0\]$"):
        least_squares.run(CompiledLine(), SEEN, seed=0, continuation=(5.0, 1.0))


def test_init_without_a_site_names_it() -> None:
    with pytest.raises(InputError, match=r"init has no value for .*b"):
        least_squares.run(CompiledLine(), SEEN, seed=0, init={"a": torch.zeros(3)})


@pytest.mark.parametrize("cost", [math.nan, math.inf])
def test_a_cost_that_is_not_finite_raises_with_the_latents(cost: float) -> None:
    broken = LINE._replace(evaluate=lambda z, hessian, gradient: cost)
    with pytest.raises(FloatingPointError, match=f"sum of squares is {cost} at .*'a'.*'b'"):
        minimise(broken, np.zeros(7))
