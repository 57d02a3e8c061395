"""The toy models: their moves, their closed forms, and that the move check itself can fail."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from models.capability import Move, Proposal
from models.program import Latents, check, log_joint, simulate
from models.toys.gaussian import ConjugateGaussian, Readings
from models.toys.slot_road import Markings, SlotRoad, offset
from tests.involution import assert_involution, uniforms

READINGS = Readings(torch.linspace(-1.0, 3.0, 9, dtype=torch.float64), None)
MARKINGS = Markings(torch.linspace(0.0, 100.0, 21, dtype=torch.float64), None)
TOYS = [(ConjugateGaussian(), READINGS), (SlotRoad(), MARKINGS)]
MOVES = [(model, blank, move) for model, blank in TOYS for move in model.moves()]


def prior(model: ConjugateGaussian | SlotRoad, blank: Readings | Markings, num: int = 200) -> Latents:
    draws = simulate(model, blank, num=num, seed=0)
    return {name: value for name, value in draws.items() if name not in blank._fields}


@pytest.mark.parametrize(("model", "blank", "move"), MOVES, ids=[f"{type(m).__name__}-{v.name}" for m, _, v in MOVES])
def test_move_is_an_involution_and_reports_its_jacobian(model, blank, move) -> None:
    assert_involution(move, prior(model, blank), uniforms(move, 200, seed=1))


@pytest.mark.parametrize(("model", "blank"), TOYS)
def test_move_probabilities_sum_to_one_and_names_differ(model, blank) -> None:
    moves = model.moves()
    assert sum(move.probability for move in moves) == pytest.approx(1.0)
    assert len({move.name for move in moves}) == len(moves)


@pytest.mark.parametrize(("model", "blank"), TOYS)
def test_toys_pass_the_check_of_the_seam(model, blank) -> None:
    check(model, blank)


@pytest.mark.parametrize("term", ["log_forward", "log_backward", "log_jacobian"])
def test_the_move_check_notices_a_missing_term(term: str) -> None:
    model = SlotRoad()
    name = "scale" if term == "log_jacobian" else "birth_death"
    move = next(move for move in model.moves() if move.name == name)

    def forget(z: Latents, u: torch.Tensor) -> Proposal:
        proposal = move.propose(z, u)
        return proposal._replace(**{term: torch.zeros_like(proposal.log_forward)})

    with pytest.raises(AssertionError, match=name):
        assert_involution(move._replace(propose=forget), prior(model, MARKINGS), uniforms(move, 200, seed=1))


def test_the_move_check_notices_a_reverse_that_does_not_return() -> None:
    model = ConjugateGaussian()

    def drift(z: Latents, u: torch.Tensor) -> Proposal:
        proposal = model.moves()[0].propose(z, u)
        return proposal._replace(uniforms=u)

    with pytest.raises(AssertionError, match="does not return 'beta'"):
        assert_involution(
            Move("walk", 1.0, 2, drift), prior(model, READINGS, 50), uniforms(model.moves()[0], 50, seed=1)
        )


def test_closed_form_of_the_gaussian_is_bayes_rule() -> None:
    """log p(beta, y) = log p(y) + log p(beta | y) at any beta."""
    model = ConjugateGaussian()
    draws = simulate(model, READINGS, num=3, seed=4)
    evidence = READINGS._replace(y=draws["y"][0])
    mean, covariance, log_evidence = model.exact(evidence)
    posterior = torch.distributions.MultivariateNormal(mean, covariance)
    torch.testing.assert_close(
        log_joint(model, {"beta": draws["beta"]}, evidence), log_evidence + posterior.log_prob(draws["beta"])
    )


def test_relabelled_knots_are_the_same_road() -> None:
    model = SlotRoad(max_knots=3)
    z = prior(model, MARKINGS) | {"num_knots": torch.full((200,), 3)}
    evidence = MARKINGS._replace(d=torch.zeros(21, dtype=torch.float64))
    swapped = z | {name: z[name][:, [2, 0, 1]] for name in ("knot", "rate")}
    torch.testing.assert_close(log_joint(model, z, evidence), log_joint(model, swapped, evidence))


def test_inactive_knots_do_not_bend_the_road() -> None:
    model = replace(SlotRoad(), noise_std=1e-9)
    draws = simulate(model, MARKINGS, num=50, seed=2)
    active = torch.arange(model.max_knots) < draws["num_knots"][:, None]
    plain = offset(
        MARKINGS.s, draws["d0"], draws["psi0"], draws["kappa0"], draws["knot"], torch.where(active, draws["rate"], 0.0)
    )
    torch.testing.assert_close(draws["d"], plain, atol=1e-7, rtol=0)
