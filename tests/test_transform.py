"""Coordinates shared by engines: densities change with them as they must, and Laplace's are exact on Gaussians."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from inference import transform
from inference.factors import factored
from inference.transform import Affine, laplace, standard, target_of, whitening
from models.capability import Factors
from models.program import InputError
from models.toys.gaussian import ConjugateGaussian
from models.whitening import bind
from tests.hierarchy import Hierarchy, readings

MODEL = Hierarchy(num_groups=4)
EVIDENCE = readings(MODEL)
FACTORS = MODEL.factors(EVIDENCE)
MEAN, COVARIANCE, LOG_EVIDENCE = MODEL.exact(EVIDENCE)
U = np.random.default_rng(0).standard_normal((5, 6))


def skewed() -> Affine:
    rng = np.random.default_rng(1)
    return Affine(rng.standard_normal(6), np.tril(rng.standard_normal((6, 6)), -1) + np.diag(rng.uniform(0.3, 2.0, 6)))


def test_the_toy_is_its_program() -> None:
    import torch

    height = FACTORS.evaluate(U).sum(-1) - 0.5 * (U**2 + np.log(2 * np.pi)).sum(-1)
    assert height == pytest.approx(bind(MODEL, EVIDENCE).log_density(torch.from_numpy(U)).numpy(), rel=1e-12)


def test_density_of_u_is_that_of_x_times_the_jacobian() -> None:
    affine = skewed()
    x = affine.forward(U)
    height = FACTORS.evaluate(x).sum(-1) - 0.5 * (x**2 + np.log(2 * np.pi)).sum(-1)
    height += np.linalg.slogdet(affine.tril)[1]
    assert target_of(FACTORS, affine).evaluate(U).sum(-1) == pytest.approx(height, rel=1e-12)
    assert affine.inverse(x[2]) == pytest.approx(U[2], rel=1e-9)


@pytest.mark.parametrize("share", [1.0, 0.25])
def test_gradient_is_that_of_the_tempered_density(share: float) -> None:
    target, eps = target_of(FACTORS, skewed()), 1e-6
    value, slope = target.gradient(U, share)
    assert value == pytest.approx(target.evaluate(U, share).sum(-1), rel=1e-12)
    for d in range(6):
        step = eps * np.eye(6)[d]
        apart = target.evaluate(U + step, share).sum(-1) - target.evaluate(U - step, share).sum(-1)
        assert slope[:, d] == pytest.approx(apart / (2 * eps), rel=1e-6, abs=1e-6)


def test_a_factor_depends_on_exactly_the_numbers_that_move_it() -> None:
    affine, _, _ = laplace(MODEL, EVIDENCE, FACTORS, np.zeros(6))
    for coordinates in (standard(6), affine):
        target = target_of(FACTORS, coordinates)
        here = target.evaluate(U)
        for d in range(6):
            there = target.evaluate(U + 0.1 * np.eye(6)[d])
            assert np.array_equal((here != there).any(0), target.depends[:, d])


def test_laplace_is_the_posterior_of_a_gaussian() -> None:
    affine, _, flags = laplace(MODEL, EVIDENCE, FACTORS, np.full(6, 0.3))
    assert flags == []
    assert affine.loc == pytest.approx(MEAN, abs=1e-9)
    assert affine.tril @ affine.tril.T == pytest.approx(COVARIANCE, abs=1e-8)
    heights = target_of(FACTORS, affine).evaluate(U).sum(-1) + 0.5 * (U**2 + np.log(2 * np.pi)).sum(-1)
    assert heights == pytest.approx(np.full(5, LOG_EVIDENCE), abs=1e-7)


def test_local_latents_stay_apart_after_whitening() -> None:
    affine, _, _ = laplace(MODEL, EVIDENCE, FACTORS, np.zeros(6))
    local = affine.tril[2:, 2:]
    assert np.array_equal(local != 0.0, np.eye(4, dtype=bool))
    assert (affine.tril[2:, 0] != 0.0).all()  # the other column is zero but for rounding, which varies by machine
    depends = target_of(FACTORS, affine).depends
    assert np.array_equal(depends[:4], FACTORS.depends)


def test_laplace_by_least_squares_and_by_bfgs_agree() -> None:
    """The same Gaussian through its program, minimised by BFGS, and through squares()."""
    from models.capability import Squares

    class WithSquares(Hierarchy):
        def squares(self, evidence: Any) -> Squares:
            design, y = self.designs(evidence).reshape(-1, 6) / self.noise_std, evidence.y.numpy().reshape(-1)

            def evaluate(z: Any, hessian: Any, gradient: Any) -> float:
                gap = design @ z - y / self.noise_std
                hessian[:], gradient[:] = design.T @ design, design.T @ gap
                return 0.5 * float(gap @ gap)

            sites = {"line": slice(0, 2), "offset": slice(2, 6)}
            return Squares(np.zeros(6), np.ones(6), sites, {"line": (2,), "offset": (4,)}, evaluate, 0.0)

    affine, _, flags = laplace(WithSquares(4), EVIDENCE, FACTORS, np.zeros(6))
    assert flags == []
    assert affine.loc == pytest.approx(MEAN, abs=1e-4)
    assert affine.tril @ affine.tril.T == pytest.approx(COVARIANCE, abs=1e-9)
    assert np.array_equal(affine.tril[2:, 2:] != 0.0, np.eye(4, dtype=bool))


def bumpy(height: float) -> Factors:
    """One number whose likelihood falls off with cos: a saddle of the posterior at 0 where height > 1."""
    return Factors(
        evaluate=lambda x: -height * np.cos(x),
        gradient=lambda x: (-height * np.cos(x[:, 0]), height * np.sin(x)),
        depends=np.ones((1, 1), bool),
        sites={"x": slice(0, 1)},
        latents=lambda x: {"x": x},
        whiten=lambda state: np.atleast_1d(np.asarray(state["x"], dtype=np.float64)),
    )


def test_a_saddle_is_flagged_and_no_wider_than_the_prior() -> None:
    affine, _, flags = laplace(None, None, bumpy(3.0), np.zeros(1))
    assert len(flags) == 1 and "eigenvalue of -2" in flags[0]
    assert affine.tril == pytest.approx(np.ones((1, 1)))


def test_a_mode_that_was_not_reached_is_flagged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transform, "NUM_STEPS", 1)
    rough = bumpy(0.0)._replace(evaluate=lambda x: -(x**4), gradient=lambda x: (-(x[:, 0] ** 4), -4.0 * x**3))
    _, _, flags = laplace(None, None, rough, np.full(1, 30.0))
    assert len(flags) == 1 and "the mode was not found" in flags[0] and "give an init closer to it" in flags[0]


def test_prior_whitening_begins_at_init_and_laplace_at_the_mode() -> None:
    init = {"line": np.array([0.5, -0.5]), "offset": np.full(4, 0.7)}
    prior = whitening(MODEL, EVIDENCE, FACTORS, "prior", init)
    assert prior.start == pytest.approx([0.5, -0.5, 1, 1, 1, 1])
    assert prior.evaluations == 0
    found = whitening(MODEL, EVIDENCE, FACTORS, "laplace", init)
    assert np.array_equal(found.start, np.zeros(6))
    assert found.target.affine.loc == pytest.approx(MEAN, abs=1e-9)


def test_an_init_that_cannot_be_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="init has no value for \\['offset'\\]"):
        whitening(MODEL, EVIDENCE, FACTORS, "prior", {"line": np.zeros(2)})
    with pytest.raises(InputError, match="init of 'offset'"):
        whitening(MODEL, EVIDENCE, FACTORS, "prior", {"line": np.zeros(2), "offset": np.full(4, np.nan)})
    with pytest.raises(InputError, match="transform must be prior or laplace, but is 'pca'"):
        whitening(MODEL, EVIDENCE, FACTORS, "pca", None)  # type: ignore[arg-type]


def test_programs_without_factors_are_whitened_too() -> None:
    from tests.test_factors import EVIDENCE as READ

    model = ConjugateGaussian()
    mean, covariance, _ = model.exact(READ)
    found = whitening(model, READ, factored(model, READ), "laplace", None)
    assert found.target.latents(np.zeros(2))["beta"] == pytest.approx(mean.numpy(), abs=1e-9)
    scale = np.diag(model.prior_std) @ found.target.affine.tril
    assert scale @ scale.T == pytest.approx(covariance.numpy(), abs=1e-8)
