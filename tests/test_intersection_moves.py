"""Moves of the intersection: involutions with their Jacobians, and the proposal densities that [M20] states."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from models.capability import Move
from models.intersection.angles import MIN_SEPARATION
from models.intersection.packing import MAX_ARMS, MIN_ARMS
from models.intersection.state import Junction
from models.program import Latents, quiet_doubles, terms, total
from tests.involution import assert_involution, uniforms
from tests.small_junction import FULL, NO_BENDS, NOTHING, states

MODELS = {
    "extended": FULL,
    "extended, straight": Junction(**NO_BENDS),
    "m20": Junction(**NO_BENDS, steps="m20"),
    "m20, all latents, two-way": replace(FULL, steps="m20", one_way=False, max_lanes=3),
}
MOVES = [(name, move) for name, model in MODELS.items() for move in model.moves()]
IDS = [f"{name}: {move.name}" for name, move in MOVES]
PERIODS = {"angle": 2 * math.pi}


def many_states(model: Junction, num: int = 600) -> Latents:
    """Prior draws, a third of them each with the fewest and the most arms."""
    draws = states(model, 40 * num, seed=0)
    count = draws["num_arms"]
    few, most = (torch.nonzero(count == k)[: num // 3, 0] for k in (MIN_ARMS, MAX_ARMS))
    rows = torch.cat([torch.arange(num - len(few) - len(most)), few, most])
    return {name: value[rows] for name, value in draws.items()}


STATES = {name: many_states(model) for name, model in MODELS.items()}


@pytest.mark.parametrize(("name", "move"), MOVES, ids=IDS)
def test_move_is_an_involution_and_reports_its_jacobian(name: str, move: Move) -> None:
    """Rounding: u = (k + r) / n loses two digits of r for n = 84 lanes."""
    assert_involution(move, STATES[name], uniforms(move, 600, seed=1), periods=PERIODS, relative=1e-8, num_jacobians=60)


@pytest.mark.parametrize(("name", "move"), MOVES, ids=IDS)
def test_move_leads_to_states_of_the_prior(name: str, move: Move) -> None:
    """A step that is called valid has a finite prior density."""
    model = MODELS[name]
    with quiet_doubles():
        proposal = move.propose(STATES[name], uniforms(move, 600, seed=1))
    valid = {n: v[proposal.valid] for n, v in proposal.latents.items()}
    assert bool(torch.isfinite(total(terms(model, valid, NOTHING).prior)).all())


@pytest.mark.parametrize("name", MODELS)
def test_move_probabilities_sum_to_one(name: str) -> None:
    assert sum(move.probability for move in MODELS[name].moves()) == pytest.approx(1.0)


def test_probabilities_of_the_paper() -> None:
    """[M20] Algorithm 1."""
    table = {move.name: move.probability for move in MODELS["m20"].moves()}
    assert table == pytest.approx({"rotate": 0.30, "centre": 0.22, "gap": 0.16, "arms": 0.05, "lanes": 0.27})


def proposals(name: str, kind: str) -> tuple[Latents, Latents, Tensor, Tensor, Tensor]:
    """(z, z', log_forward, log_backward, valid rows) of one kind of move."""
    move = next(move for move in MODELS[name].moves() if move.name == kind)
    with quiet_doubles():
        proposal = move.propose(STATES[name], uniforms(move, 600, seed=2))
    rows = proposal.valid
    pick = lambda z: {n: v[rows] for n, v in z.items()}  # noqa: E731
    return pick(STATES[name]), pick(proposal.latents), proposal.log_forward[rows], proposal.log_backward[rows], rows


def lanes(z: Latents) -> tuple[Tensor, Tensor, Tensor]:
    """(B, A) entries and exits of the active arms, (B,) the sum of both."""
    active = torch.arange(MAX_ARMS) < z["num_arms"][:, None]
    entries, exits = z["entries"] * active, z["exits"] * active
    return entries, exits, (entries + exits).sum(1)


@pytest.mark.parametrize("name", ["m20", "m20, all latents, two-way", "extended"])
def test_lanes_are_added_and_removed_as_the_paper_says(name: str) -> None:
    """q(add) = 1/2 1/2 1/K; q(remove one entry of arm a) = 1/2 E_a / sum(E + O), exits alike."""
    before, after, forward, backward, _ = proposals(name, "lanes")
    for z, other, log_q in ((before, after, forward), (after, before, backward)):
        entries, exits, num = lanes(z)
        changed = torch.stack([lanes(other)[0] - entries, lanes(other)[1] - exits])  # (2, B, A)
        assert bool((changed.abs().sum((0, 2)) == 1).all()), "one lane, no more, no less"
        added = changed.sum((0, 2)) > 0
        same = (torch.stack([entries, exits]) * changed.abs()).sum((0, 2))
        expected = torch.where(added, 0.25 / z["num_arms"].double(), 0.5 * same.double() / num)
        torch.testing.assert_close(log_q, expected.log(), atol=1e-12, rtol=0)
        assert 0.2 < added.double().mean() < 0.8


def free_measure(angles: Tensor) -> Tensor:
    """Length of the circle at least MIN_SEPARATION from all angles, by counting points of a fine grid."""
    grid = (torch.arange(100_000, dtype=torch.float64) + 0.5) * 2 * math.pi / 100_000
    gap = torch.remainder(grid[:, None] - angles + math.pi, 2 * math.pi) - math.pi
    return (gap.abs() >= MIN_SEPARATION).all(1).double().mean() * 2 * math.pi


def log_numbers(model: Junction, z: Latents, row: int, slot: int) -> Tensor:
    """log prior density of a slot's numbers but its angle, from the textbook."""
    normal = torch.distributions.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0)
    value = torch.tensor(-math.log(model.gap_max), dtype=torch.float64)
    low = 0 if model.one_way else 1
    value -= math.log(model.max_lanes + 1 - low)
    value -= math.log(model.max_lanes + 1 - (1 if z["entries"][row, slot] == 0 else low))
    if "width" in z:
        log_width = z["width"][row, slot].log()
        value += normal.log_prob((log_width - math.log(model.width)) / model.width_spread)
        value -= math.log(model.width_spread) + log_width
    for field, std in (("bend", model.bend_std), ("shift", model.shift_std)):
        if field in z:
            value += normal.log_prob(z[field][row, slot] / std) - math.log(std)
    return value


@pytest.mark.parametrize("name", ["m20", "m20, all latents, two-way", "extended"])
def test_arms_are_born_on_the_free_angles_and_die_uniformly(name: str) -> None:
    """q(birth) = 1/2 1/(K + 1) 1/|free| p(numbers), into a uniform slot of labelled ones; q(death) = 1/2 1/K and the
    pseudo-prior of the slot that falls idle. A grid of 1e5 angles finds |free| within 2 K / 1e5 of the circle."""
    model = MODELS[name]
    before, after, forward, backward, _ = proposals(name, "arms")
    births = after["num_arms"] > before["num_arms"]
    assert 0.2 < births.double().mean() < 0.8
    for row in range(0, len(births), 4):
        down, up = (before, after) if births[row] else (after, before)
        to_birth, to_death = (forward, backward) if births[row] else (backward, forward)
        num = int(down["num_arms"][row])
        own = {float(a) for a in down["angle"][row, :num]}
        new = [k for k in range(num + 1) if float(up["angle"][row, k]) not in own]
        assert len(new) == 1, "the other arms stay as they are"
        free = free_measure(down["angle"][row, :num])
        birth = -math.log(2.0 * (num + 1)) + log_numbers(model, up, row, new[0]) - free.log()
        death = -math.log(2.0 * (num + 1)) + log_numbers(model, down, row, num) - math.log(2 * math.pi)
        assert float(to_birth[row]) == pytest.approx(float(birth), abs=2 * 7 * 2 * math.pi / 1e5 / float(free) + 1e-9)
        assert float(to_death[row]) == pytest.approx(float(death), abs=1e-9)


def test_new_arms_are_uniform_on_the_free_angles() -> None:
    """Kolmogorov-Smirnov on the share of the free circle below the new angle; the reverse numbers are uniform too.

    p below 1e-3 for one of the ten numbers has odds of 1 in 100 (fixed seed)."""
    from scipy import stats

    name, num = "extended", 600
    move = next(move for move in MODELS[name].moves() if move.name == "arms")
    u = uniforms(move, num, seed=3)
    u[:, 0] *= 0.5  # births
    three = {n: v.clone() for n, v in states(MODELS[name], num, seed=5).items()}
    three["num_arms"][:] = 3
    three["angle"][:, :3] = torch.tensor([0.0, 1.0, -2.0])
    with quiet_doubles():
        proposal = move.propose(three, u)
    assert bool(proposal.valid.all())
    moved = (proposal.latents["angle"][:, :4, None] - torch.tensor([0.0, 1.0, -2.0])).abs().amin(2).argmax(1)
    new = proposal.latents["angle"][torch.arange(num), moved]
    grid = (torch.arange(100_000, dtype=torch.float64) + 0.5) * 2 * math.pi / 100_000 - math.pi
    gap = torch.remainder(grid[:, None] - torch.tensor([0.0, 1.0, -2.0]) + math.pi, 2 * math.pi) - math.pi
    free = grid[(gap.abs() >= MIN_SEPARATION).all(1)]
    share = torch.searchsorted(free, new).double() / len(free)
    assert stats.kstest(share.numpy(), "uniform").pvalue > 1e-3
    assert stats.chisquare(torch.bincount(moved, minlength=4).numpy()).pvalue > 1e-3
    for column in range(1, move.num_uniforms):
        assert stats.kstest(proposal.uniforms[:, column].numpy(), "uniform").pvalue > 1e-3


def test_the_move_check_notices_a_missing_term() -> None:
    """Each term taken away on purpose fails the check of the moves that need it."""
    cases = {"log_forward": "arms", "log_backward": "lanes", "log_jacobian": "width"}
    for term, kind in cases.items():
        move = next(move for move in MODELS["extended"].moves() if move.name == kind)

        def forget(z: Latents, u: Tensor, move: Move = move, term: str = term):  # type: ignore[no-untyped-def]
            proposal = move.propose(z, u)
            return proposal._replace(**{term: torch.zeros_like(proposal.log_forward)})

        with pytest.raises(AssertionError, match=kind):
            mutant = move._replace(propose=forget)
            assert_involution(mutant, STATES["extended"], uniforms(move, 600, seed=1), periods=PERIODS, relative=1e-8)


def test_toggles_keep_the_other_lanes_in_place() -> None:
    """With the axis moved by its shift: outer lanes stay within the little steps of gap (0.3 m) and angle."""
    move = next(move for move in FULL.moves() if move.name == "toggle")
    z, u = STATES["extended"], uniforms(move, 600, seed=4)
    u[:, 3], u[:, 4], u[:, 5] = 0.5, 0.1, 0.5  # no little steps, by shift
    with quiet_doubles():
        proposal = move.propose(z, u)

    def outer(latents: Latents) -> tuple[Tensor, Tensor]:
        half, width = 0.5 * latents["gap"], latents["width"]
        return (
            latents["shift"] + half + latents["entries"] * width,
            latents["shift"] - half - latents["exits"] * width,
        )

    same = proposal.valid
    assert same.sum() > 50
    for before, after, count in zip(outer(z), outer(proposal.latents), ("entries", "exits"), strict=True):
        both = (z[count] > 0) & (proposal.latents[count] > 0) & same[:, None]
        torch.testing.assert_close(before[both], after[both], atol=1e-9, rtol=0)
