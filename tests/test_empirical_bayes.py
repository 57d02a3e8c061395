"""Settings learnt from scenes, where the evidence of all scenes is known in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from inference import importance
from inference.empirical_bayes import Learnt, ascend, draw, informations, learn, log_ratios, slope
from inference.posterior import Posterior
from inference.weights import effective_size
from models.capability import Hyper
from models.program import InputError, log_joint

Floats = NDArray[np.float64]
TRUE = np.array([1.0, math.log(0.8), math.log(0.5)])
SCENES, EACH = 80, 4


class Readings(NamedTuple):
    """Readings (m,) of one scene."""

    y: torch.Tensor


class Normals:
    """z ~ N(mu, omega^2), y_j ~ N(z, tau^2); h = (mu, log omega, log tau)."""

    def __init__(self, h: Floats) -> None:
        self.mu, (self.omega, self.tau) = float(h[0]), np.exp(h[1:3])

    def __call__(self, evidence: Readings) -> None:
        z = pyro.sample("z", dist.Normal(torch.tensor(self.mu).double(), float(self.omega)))
        pyro.sample("y", dist.Normal(z[..., None], float(self.tau)).to_event(1), obs=evidence.y)

    def evidence_of(self, y: Floats) -> float:
        """log p(y): a normal with covariance tau^2 I + omega^2 11'."""
        m, inner = len(y), self.tau**2 + len(y) * self.omega**2
        e = y - self.mu
        quadratic = (e @ e - self.omega**2 / inner * e.sum() ** 2) / self.tau**2
        return float(
            -0.5 * (m * math.log(2 * math.pi) + 2 * (m - 1) * math.log(self.tau) + math.log(inner) + quadratic)
        )


def exact(model: Normals, evidence: Readings, *, seed: int, num: int = 400) -> Posterior:
    """The posterior by conjugacy."""
    y, rng = evidence.y.numpy(), np.random.default_rng(seed)
    precision = 1 / model.omega**2 + len(y) / model.tau**2
    mean = (model.mu / model.omega**2 + y.sum() / model.tau**2) / precision
    z = mean + rng.standard_normal((1, num)) / math.sqrt(precision)
    return Posterior({"z": z}, log_evidence=model.evidence_of(y), info={"engine": "exact"})


def complete(data: Readings, draws: dict[str, Floats]) -> Callable[[Floats], Floats]:
    """log p(z, y | h), but for a constant."""
    z, apart = draws["z"], np.square(data.y.numpy() - draws["z"][:, None]).sum(1)

    def height(h: Floats) -> Floats:
        omega, tau = np.exp(h[1:3])
        return -0.5 * ((z - h[0]) / omega) ** 2 - h[1] - 0.5 * apart / tau**2 - EACH * h[2]

    return height


def hyper(names: tuple[str, ...] = ("mu", "omega", "tau"), width: float = 3.0) -> Hyper:
    start = np.zeros(len(names))
    natural = lambda h: np.r_[h[:1], np.exp(h[1:])]  # noqa: E731
    return Hyper(names, start, np.full(len(names), width), natural, Normals, complete)


def scenes(num: int = SCENES, seed: int = 0) -> list[Readings]:
    rng, true = np.random.default_rng(seed), Normals(TRUE)
    z = true.mu + true.omega * rng.standard_normal((num, 1))
    return [Readings(torch.from_numpy(row)) for row in z + true.tau * rng.standard_normal((num, EACH))]


def height(h: Floats, data: list[Readings], family: Hyper) -> float:
    """log p(h) + sum of the scenes' log evidence."""
    return sum(Normals(h).evidence_of(s.y.numpy()) for s in data) - 0.5 * float(np.sum((h / family.width) ** 2))


def scores(h: Floats, data: list[Readings]) -> Floats:
    """d log p(y_s | h) / dh (S, H) by central differences of the closed form."""
    steps = 1e-5 * np.eye(len(h))
    rise = lambda y, d: (Normals(h + d).evidence_of(y) - Normals(h - d).evidence_of(y)) / 2e-5  # noqa: E731
    return np.array([[rise(s.y.numpy(), d) for d in steps] for s in data])


@pytest.fixture(scope="module")
def learnt() -> Learnt:
    return learn(hyper(), scenes(), exact, seed=1, progress=False)


def test_learnt_settings_maximise_the_evidence(learnt: Learnt) -> None:
    best = minimize(lambda h: -height(h, scenes(), hyper()), TRUE, method="BFGS").x
    assert np.all(np.abs(learnt.h - best) < 4 * learnt.noise)  # the reported Monte Carlo error
    assert np.all(learnt.noise < 0.2 * learnt.error)
    assert np.all(np.abs(learnt.h - TRUE) < 3 * learnt.error)
    assert not learnt.flags and len(learnt.path) < 10


def test_the_path_carries_the_evidence_of_all_scenes(learnt: Learnt) -> None:
    for h, evidence in zip(learnt.path, learnt.log_evidence, strict=True):
        assert evidence == pytest.approx([Normals(h).evidence_of(s.y.numpy()) for s in scenes()])
    totals = learnt.log_evidence.sum(1)
    assert totals[-1] - totals[0] > 50.0 and np.all(np.diff(totals) > -0.1)


def test_standard_errors_are_those_of_the_exact_curvature(learnt: Learnt) -> None:
    steps = 1e-3 * np.eye(3)
    total = lambda h: scores(h, scenes()).sum(0) - h / hyper().width ** 2  # noqa: E731
    curvature = np.array([(total(learnt.h - d) - total(learnt.h + d)) / 2e-3 for d in steps])
    # 80 scenes of 200 draws know the variance of the slopes to 1.1 %; what is missing is less than the whole
    assert learnt.information == pytest.approx(curvature, rel=0.03, abs=0.03 * np.abs(curvature).max())
    error = np.sqrt(np.linalg.inv(curvature).diagonal())
    assert learnt.error == pytest.approx(error, rel=0.03)
    each = scores(learnt.h, scenes())  # the scores of 80 scenes know the same to a quarter
    assert error == pytest.approx(np.sqrt(np.linalg.inv(each.T @ each).diagonal()), rel=0.25)


def test_reported_noise_is_the_scatter_over_seeds() -> None:
    family, data = hyper(), scenes(12)
    runs = [learn(family, data, exact, seed=s, num_draws=50, progress=False) for s in range(12)]
    ratio = np.std([run.h for run in runs], axis=0, ddof=1) / np.mean([run.noise for run in runs], axis=0)
    assert np.all((ratio > 0.5) & (ratio < 1.7))  # 12 runs know a spread to 1 / sqrt(22) = 21 %: three of these


def test_the_slope_of_a_step_is_that_of_the_evidence() -> None:
    family, data, h = hyper(), scenes(40), np.array([0.4, 0.2, -0.3])
    drawn = draw(family, data, exact, h, np.random.SeedSequence(3), 4000)
    noise = np.sqrt(informations(family, drawn)[1].diagonal())
    found = np.sum([slope(family, f, h).mean(0) for f in drawn.complete], axis=0)
    gap = np.abs(found - scores(h, data).sum(0))
    # exact() gives 400 draws, from which 4000 are taken, in even steps: ten of each
    assert np.all(gap < 4 * noise * math.sqrt(10)) and np.all(np.abs(found) > 8 * noise)


def test_a_step_promises_what_it_gains() -> None:
    family, data, h = hyper(), scenes(40), np.array([0.7, 0.0, -0.5])
    drawn = draw(family, data, exact, h, np.random.SeedSequence(4), 400)
    step = ascend(family, drawn)
    gain = height(step.h, data, family) - height(h, data, family)
    assert gain > 1.0 and abs(step.gain - gain) < 4 * step.error


def test_a_long_step_is_cut_until_the_draws_bear_it() -> None:
    family, data, h = hyper(width=30.0), scenes(40), np.array([-1.0, -0.5, 0.7])
    drawn = draw(family, data, exact, h, np.random.SeedSequence(5), 200)
    step = ascend(family, drawn)
    ratios = log_ratios(drawn, step.h)
    assert np.mean([effective_size(row) / 200 for row in ratios]) >= 0.5
    assert height(step.h, data, family) - height(h, data, family) > 10.0


def test_a_narrow_prior_holds_the_settings_back() -> None:
    family, data = hyper(width=0.15), scenes(40)
    found = learn(family, data, exact, seed=4, progress=False)
    best = minimize(lambda h: -height(h, data, family), TRUE, method="BFGS").x
    assert np.all(np.abs(found.h - best) < 4 * found.noise)
    free = minimize(lambda h: -height(h, data, hyper()), TRUE, method="BFGS").x
    assert np.abs(found.h - free).max() > 20 * found.noise.max()


def wide(model: Normals, evidence: Readings, *, seed: int) -> Posterior:
    """Weighted draws from a normal about the posterior, beside it and twice as wide."""
    y, rng = evidence.y.numpy(), np.random.default_rng(seed)
    precision = 1 / model.omega**2 + len(y) / model.tau**2
    x = rng.standard_normal((1, 800))
    z = (model.mu / model.omega**2 + y.sum() / model.tau**2) / precision + (0.5 + 2 * x) / math.sqrt(precision)
    return Posterior({"z": z}, 0.5 * x**2 - 0.5 * (0.5 + 2 * x) ** 2, model.evidence_of(y))


def test_weighted_draws_teach_the_same_with_more_noise() -> None:
    data, family = scenes(20), hyper()
    found = learn(family, data, wide, seed=2, num_draws=800, progress=False)
    best = minimize(lambda h: -height(h, data, family), TRUE, method="BFGS").x
    assert np.all(np.abs(found.h - best) < 4 * found.noise)
    drawn = draw(family, data, wide, found.h, np.random.SeedSequence(6), 800)
    assert drawn.size == pytest.approx(np.full(20, worth_of_wide() * 800), rel=0.15)
    sharp = learn(family, data, partial(exact, num=800), seed=2, num_draws=800, progress=False)
    assert found.noise / sharp.noise == pytest.approx(np.full(3, worth_of_wide() ** -0.5), rel=0.12)


def worth_of_wide() -> float:
    """E[w]^2 / E[w^2] of the weights of `wide`."""
    x = np.linspace(-9.0, 9.0, 4001)
    w, p = np.exp(0.5 * x**2 - 0.5 * (0.5 + 2 * x) ** 2), np.exp(-0.5 * x**2)
    p /= p.sum()
    return float((w @ p) ** 2 / (w**2 @ p))


def test_an_engine_of_this_house_learns_the_same() -> None:
    engine = partial(importance.run, num_draws=100, num_rounds=2)
    data = scenes(12)
    found = learn(hyper(), data, engine, seed=2, num_draws=100, progress=False)
    best = minimize(lambda h: -height(h, data, hyper()), TRUE, method="BFGS").x
    assert np.all(np.abs(found.h - best) < 4 * found.noise)


def test_a_number_that_no_scene_reads_stays_and_says_so() -> None:
    names = ("mu", "omega", "tau", "nothing")
    found = learn(hyper(names), scenes(20), exact, seed=3, progress=False)
    assert found.h[3] == pytest.approx(0.0, abs=1e-6) and found.error[3] == pytest.approx(3.0)
    assert [flag for flag in found.flags if "the scenes say little of 'nothing'" in flag]


def test_the_density_of_this_file_is_the_program_s() -> None:
    (data,), z, h = scenes(1), np.linspace(-1.0, 2.0, 5), np.array([0.3, 0.2, -0.4])
    program = [log_joint(Normals(at), {"z": torch.from_numpy(z)}, data).numpy() for at in (h, TRUE)]
    f = complete(data, {"z": z})
    assert f(h) - f(TRUE) == pytest.approx(program[0] - program[1])


def test_a_search_that_was_cut_short_says_so() -> None:
    found = learn(hyper(), scenes(20), exact, seed=3, num_rounds=1, progress=False)
    assert len(found.path) == 2 and "still moved after 1 rounds" in found.flags[0]


def test_what_cannot_teach_is_refused() -> None:
    without = lambda model, evidence, seed: Posterior({"z": np.zeros((1, 9))}, info={"engine": "lazy"})  # noqa: E731
    data: list[Any] = scenes(2)
    with pytest.raises(InputError, match="1 scene cannot tell settings from chance"):
        learn(hyper(), data[:1], exact, seed=0)
    with pytest.raises(InputError, match="lazy gives no log evidence"):
        learn(hyper(), data, without, seed=0, progress=False)
    with pytest.raises(InputError, match="num_draws is 3"):
        learn(hyper(), data, exact, seed=0, num_draws=3)
