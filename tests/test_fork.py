"""A road that forks or that another joins: its density, its moves, and that engines find what is there."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from experiments.scenarios.forked_road import forked_road
from inference import diagnostics, rjmcmc, smc
from inference.posterior import Posterior
from models.clothoid import Clothoid, Points, evaluate
from models.program import InputError, Latents, fix, simulate, terms, total
from models.road.along_fork import CuesAlongFork, Fork, both_courses, log_odds_of_second, sampled_courses, things_of
from models.road.along_road import CuesAlongRoad
from models.road.course import RoadCourse
from models.road.evidence import RoadEvidence
from models.road.fork import ForkedRoad, main_from, pack, unpack
from tests.involution import assert_involution, uniforms

Floats = NDArray[np.float64]
MODEL = ForkedRoad()
PLAIN = ForkedRoad(road=RoadCourse(reach=math.inf, lane_changes=0.0))  # what is left of the density when these are out
PAPER = ForkedRoad(road=RoadCourse(likelihood="paper"), share=0.3)
SCENE = forked_road(10)
EVIDENCE = MODEL.prepare(SCENE.data)
MOVES = {move.name: move for move in replace(MODEL, joining=0.3).moves()}
LENGTH, BEHIND = MODEL.road.prior.length, MODEL.road.prior.behind


def prior(num: int, seed: int = 0, **values: Any) -> Latents:
    """Draws of the prior, some sites at given values."""
    draws = simulate(MODEL, EVIDENCE, num=num, seed=seed)
    return draws | {n: torch.full_like(draws[n], v) for n, v in values.items()}


def fork_of(z: Latents) -> Fork:
    return Fork(*(z[name] for name in Fork._fields))


def log_prob(model: ForkedRoad, z: Latents, evidence: RoadEvidence = EVIDENCE) -> Tensor:
    assert evidence.cues is not None
    return CuesAlongFork(model, evidence, fork_of(z), z["offset"]).log_prob(evidence.cues)


def test_tables_are_the_courses_as_torch_evaluates_them() -> None:
    """Cumulative Simpson against Gauss-Legendre quadrature."""
    arc = torch.linspace(0.0, LENGTH, MODEL.road.num_samples, dtype=torch.float64)
    for joins in (0, 1):
        fork = fork_of(prior(200, num_courses=2, joins=joins))
        for table, points in zip(sampled_courses(MODEL, fork), both_courses(MODEL, fork, arc), strict=True):
            np.testing.assert_allclose(table[..., 0], points.x, atol=2e-4)
            np.testing.assert_allclose(table[..., 1], points.y, atol=2e-4)
            np.testing.assert_allclose(table[..., 2], points.heading, atol=1e-9)
            np.testing.assert_allclose(table[..., 5], points.curvature, atol=1e-12)


def test_courses_are_one_where_they_are_shared_and_part_without_a_kink() -> None:
    for joins in (0, 1):
        fork = fork_of(prior(50, num_courses=2, joins=joins))
        place = LENGTH - fork.shared if joins else fork.shared
        away = 1.0 - 2.0 * joins
        arc = torch.linspace(0.0, LENGTH, 500, dtype=torch.float64)
        first, second = both_courses(MODEL, fork, arc)
        gap = torch.hypot(first.x - second.x, first.y - second.y)
        way = away * (arc - place[:, None])
        assert bool((gap[way <= 0.0] == 0.0).all())
        near = (way > 0.0) & (way < 1.0)
        assert bool((gap[near] < 0.02).all()), "a kink of .02 rad would show"
        assert bool((gap[:, 0 if joins else -1] > 0.0).all())


def written_down(model: ForkedRoad, evidence: RoadEvidence, z: Latents) -> Tensor:
    """Log likelihood (S,) in plain torch: all samples, the nearest, then the equations of models.road.cue_kernel."""
    arc = torch.linspace(0.0, LENGTH, model.road.num_samples, dtype=torch.float64)
    each = torch.stack([cue_by_cue(model.road, evidence, c, z["offset"]) for c in both_courses(model, fork_of(z), arc)])
    thing, num = things_of(evidence)
    along = torch.zeros((*each.shape[:-1], num), dtype=torch.float64).index_add(-1, torch.from_numpy(thing), each)
    mixed = torch.logaddexp(along[0] + math.log(1.0 - model.share), along[1] + math.log(model.share))
    return torch.where(z["num_courses"][:, None] == 2, mixed, along[0]).sum(-1)


def cue_by_cue(model: RoadCourse, evidence: RoadEvidence, road: Points, offset: Tensor) -> Tensor:
    """(S, N) of cues beside samples (S, num) of one course."""
    assert evidence.cues is not None
    px, py, flow = (column[None, :, None] for column in evidence.cues.T)
    dx, dy = px - road.x[:, None], py - road.y[:, None]  # (S, N, num)
    nearest = (dx**2 + dy**2).argmin(-1, keepdim=True)
    dx, dy, theta, bend = (
        v.expand(*nearest.shape[:-1], -1).gather(-1, nearest)[..., 0]
        for v in (dx, dy, road.heading[:, None], road.curvature[:, None])
    )
    along, across = dx * theta.cos() + dy * theta.sin(), dy * theta.cos() - dx * theta.sin()
    lateral = across - offset[:, torch.from_numpy(evidence.group)]
    turn = flow[..., 0] - torch.from_numpy(evidence.turn) - theta
    spread, seen = torch.from_numpy(evidence.spread), torch.from_numpy(np.isfinite(evidence.flow_spread))
    if model.likelihood == "paper":
        flow_std = torch.from_numpy(evidence.flow_spread).clamp(max=1.0)
        return normal(torch.hypot(along, lateral), spread) + seen * normal(1.0 - turn.cos(), flow_std)
    angle = theta + torch.atan(bend * along)
    m = torch.stack([-angle.sin(), angle.cos()], -1)
    variance = (m[..., None, :] @ torch.from_numpy(evidence.covariance) @ m[..., None])[..., 0, 0] + spread**2
    flow_std = torch.where(seen, torch.from_numpy(np.hypot(evidence.flow_spread, evidence.flow_std)), 1.0)
    gap = turn - bend * along
    gap = gap - 2 * math.pi * torch.round(gap / (2 * math.pi))
    follows = normal(lateral - 0.5 * bend * along**2, variance.sqrt()) + seen * normal(gap, flow_std)
    stray = math.log(model.clutter / model.clutter_width) - seen.double() * math.log(2 * math.pi)
    return torch.logaddexp(follows + math.log(1 - model.clutter), stray.expand_as(follows))


def normal(value: Tensor, std: Tensor) -> Tensor:
    return -0.5 * (value / std) ** 2 - std.log() - 0.5 * math.log(2 * math.pi)


def near_truth(num: int, seed: int) -> Latents:
    """States about the posterior of the scene, and away from it; both kinds, one course and two."""
    z, begin = prior(num, seed), MODEL.start(EVIDENCE)
    share = torch.linspace(0.02, 0.5, num, dtype=torch.float64)
    centre = {n: torch.as_tensor(begin[n]) for n in ("main", "offset", "bend")}
    return z | {n: c + share[:, None] * (z[n] - c) for n, c in centre.items()}


@pytest.mark.parametrize("model", [PLAIN, PAPER], ids=["exact", "paper"])
def test_density_is_the_one_written_down(model: ForkedRoad) -> None:
    z = near_truth(60, 3)
    np.testing.assert_allclose(log_prob(model, z), written_down(model, EVIDENCE, z), rtol=1e-6)


@pytest.mark.parametrize("model", [MODEL, PAPER], ids=["exact", "paper"])
def test_with_one_course_the_density_is_that_of_the_road_course(model: ForkedRoad) -> None:
    z = near_truth(40, 4) | {"num_courses": torch.ones(40, dtype=torch.long)}
    zero = torch.zeros(40, dtype=torch.float64)
    road = Clothoid(zero - BEHIND, *z["main"].unbind(-1), zero + LENGTH)  # type: ignore[call-arg]
    ends = evaluate(road, torch.tensor([0.0, LENGTH], dtype=torch.float64).expand(40, 2))
    course = torch.stack(ends[:3], -1).flatten(-2)
    assert EVIDENCE.cues is not None
    along = CuesAlongRoad(model.road, EVIDENCE, course, z["offset"]).log_prob(EVIDENCE.cues)
    np.testing.assert_allclose(log_prob(model, z), along, rtol=1e-7)
    back = torch.stack([main_from(Clothoid(*(v[i] for v in road)), BEHIND) for i in range(40)])
    np.testing.assert_allclose(back, z["main"], rtol=1e-9, atol=1e-12)


def test_two_courses_that_run_together_have_the_density_of_one() -> None:
    """With sight and changes of lanes, whatever share the second has."""
    z = near_truth(40, 4) | {"bend": torch.zeros(40, 2, dtype=torch.float64)}
    one, two = (z | {"num_courses": torch.full((40,), num)} for num in (1, 2))
    assert EVIDENCE.moves.any()
    np.testing.assert_allclose(log_prob(MODEL, two), log_prob(MODEL, one), rtol=1e-6)


def turned_round(z: Latents) -> tuple[Latents, RoadEvidence]:
    """One state and its scene as they look to a car at the end of the road that drives back."""
    assert EVIDENCE.cues is not None
    curvature, rate = z["main"][0, 2:]
    start = [torch.tensor(v, dtype=torch.float64) for v in (-BEHIND, LENGTH)]
    end = evaluate(Clothoid(start[0], *z["main"][0], start[1]), start[1][None])  # type: ignore[call-arg]
    angle = -(float(end.heading[0]) + math.pi)
    rotate = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]).double()
    place = torch.stack([end.x[0], end.y[0]])
    position = (EVIDENCE.cues[:, :2] - place) @ rotate.T + torch.tensor([-BEHIND, 0.0])
    measured = torch.from_numpy(np.isfinite(EVIDENCE.flow_spread))
    flow = torch.where(measured, EVIDENCE.cues[:, 2] + angle, 0.0)
    evidence = EVIDENCE._replace(
        cues=torch.cat([position, flow[:, None]], -1),
        covariance=rotate.numpy() @ EVIDENCE.covariance @ rotate.numpy().T,
        turn=EVIDENCE.turn + math.pi,
    )
    zero = torch.zeros((), dtype=torch.float64)
    main = torch.stack([zero, zero, -(curvature + rate * LENGTH), rate])[None]
    return z | {"main": main, "offset": -z["offset"], "joins": 1 - z["joins"]}, evidence


@pytest.mark.parametrize("joins", [0, 1])
def test_a_road_that_joins_is_one_that_leaves_as_seen_the_other_way_round(joins: int) -> None:
    z = near_truth(30, 5)
    z |= {"num_courses": torch.full((30,), 2), "joins": torch.full((30,), joins)}
    for i in range(30):
        one = {n: v[i : i + 1] for n, v in z.items()}
        there, evidence = turned_round(one)
        assert float(log_prob(PLAIN, there, evidence)) == pytest.approx(float(log_prob(PLAIN, one)), rel=1e-5)


def test_the_compiled_density_is_the_program() -> None:
    z = near_truth(40, 6)
    kernel, split = MODEL.kernel(EVIDENCE), terms(MODEL, z, EVIDENCE)
    rows, out = kernel.pack({n: v.numpy() for n, v in z.items()}), np.empty(2)
    for row, log_prior, likelihood in zip(rows, total(split.prior), total(split.likelihood), strict=True):
        kernel.evaluate(row, kernel.floats, kernel.ints, np.zeros(1), out)
        np.testing.assert_allclose(out, [log_prior, likelihood], rtol=1e-12)
    for name, value in kernel.unpack(rows).items():
        np.testing.assert_array_equal(value, z[name])
    rows[:, 2] = MODEL.most + 1.0
    kernel.evaluate(rows[0], kernel.floats, kernel.ints, np.zeros(1), out)
    assert out[0] == -math.inf


def test_odds_of_a_thing_are_what_the_share_changes() -> None:
    """d log p / d logit(share) = P(second) - share, summed over things."""
    z, step = near_truth(20, 7) | {"num_courses": torch.full((20,), 2)}, 1e-5
    odds = log_odds_of_second(MODEL, EVIDENCE, fork_of(z), z["offset"])
    _, first = np.unique(things_of(EVIDENCE)[0], return_index=True)
    more, less = (log_prob(replace(MODEL, share=1 / (1 + math.exp(-s))), z) for s in (step, -step))
    expected = (1.0 / (1.0 + np.exp(-odds[:, first])) - 0.5).sum(-1)
    np.testing.assert_allclose((more - less) / (2 * step), expected, atol=1e-5)


def test_a_vehicle_is_one_thing_and_every_post_is_one() -> None:
    thing, num = things_of(EVIDENCE)
    cars = EVIDENCE.moves
    assert num == (~cars).sum() + len(set(EVIDENCE.group[cars]))
    assert len(set(thing[~cars])) == (~cars).sum()
    for group in set(EVIDENCE.group[cars]):
        assert len(set(thing[EVIDENCE.group == group])) == 1
    assert set(thing) == set(range(num))


@pytest.mark.parametrize("name", MOVES)
def test_moves_are_involutions_with_the_jacobian_they_report(name: str) -> None:
    z, move = prior(60, seed=1), MOVES[name]
    assert_involution(move, z, uniforms(move, 60, seed=2), relative=1e-8)


def test_a_swap_brings_the_main_course_to_the_second() -> None:
    """To a part of how far the second was from it, near the car above all: weights (1 - u)^2 as the move has."""
    z = prior(200, seed=8, num_courses=2)
    swapped = MOVES["swap"].propose(z, torch.full((200, 6), 0.5, dtype=torch.float64)).latents
    arc = torch.linspace(0.0, LENGTH, 40, dtype=torch.float64)
    weight = (1.0 - arc / LENGTH) ** 2
    first, second = both_courses(MODEL, fork_of(z), arc)
    now, other = both_courses(MODEL, fork_of(swapped), arc)

    def apart(one: Points, two: Points) -> float:
        return float((weight * ((one.x - two.x) ** 2 + (one.y - two.y) ** 2)).sum(-1).sqrt().median())

    assert apart(now, second) < 0.2 * apart(first, second)
    assert apart(other, first) < 0.2 * apart(first, second)


def test_the_prior_comes_back_when_the_cue_says_nothing() -> None:
    """Means within 4.5 of their own standard errors."""
    blind = EVIDENCE._replace(
        cues=EVIDENCE.cues[:1] if EVIDENCE.cues is not None else None,
        **{n: getattr(EVIDENCE, n)[:1] for n in ("group", "spread", "flow_spread", "flow_std", "turn", "moves")},
        covariance=1e10 * np.eye(2)[None],
    )
    model = replace(MODEL, forking=0.3, joining=0.2)
    found = rjmcmc.run(model, blind, seed=1, num_chains=8, num_steps=100_000, warmup=10_000, thin=15)
    draws, loc, std = found.draws, EVIDENCE.offset_loc, EVIDENCE.offset_std
    middle, span = 0.5 * (model.least + model.most), model.most - model.least
    columns = {"forks": draws["num_courses"] == 2, "joins": draws["joins"], "shared": draws["shared"]}
    expected = {"forks": 0.3, "joins": 0.2, "shared": middle, "width": span**2 / 12}
    columns["width"] = (draws["shared"] - middle) ** 2
    for name, std_of in (("main", model.main_std.numpy()), ("bend", model.bends_std.numpy())):
        for i, s in enumerate(std_of):
            columns |= {f"{name}{i}": draws[name][..., i] / s, f"{name}{i}^2": (draws[name][..., i] / s) ** 2}
            expected |= {f"{name}{i}": 0.0, f"{name}{i}^2": 1.0}
    columns["offset^2"] = (draws["offset"][..., 0] - loc[0]) ** 2 / std[0] ** 2
    for name, value in columns.items():
        error = diagnostics.standard_error(value.astype(np.float64))
        assert abs(value.mean() - expected.get(name, 1.0)) < 4.5 * error, name


def run(evidence: RoadEvidence, steps: int = 12_000, seed: int = 1, model: ForkedRoad = MODEL) -> Posterior:
    """As the experiment does, shorter."""
    options: dict[str, Any] = {"start": "data", "start_temperature": 20, "resample": True, "thin": 10}
    return rjmcmc.run(model, evidence, seed=seed, num_chains=4, num_steps=steps, warmup=steps // 2, **options)


def test_probability_of_a_second_course_is_the_ratio_of_evidences() -> None:
    """Of a scene that leaves it open. The evidence of each structure by tempering walkers, which know no moves of the
    model; the population over structures must say the same. Within 4 standard errors of all."""
    evidence = MODEL.prepare(forked_road(36).data)
    jumps = run(evidence, 100_000, model=PLAIN)
    forks = jumps.draws["num_courses"] == 2
    share, error = forks.mean(), diagnostics.standard_error(forks.astype(np.float64))
    heights, variance = [], 0.0
    for num, joins in ((1, 0), (2, 0), (2, 1)):
        found = smc.run(fix(PLAIN, num_courses=num, joins=joins), evidence, seed=1, moves="walk", num_particles=4000)
        assert found.log_evidence is not None
        heights.append(found.log_evidence + (0.0 if num == 2 else math.log(2.0)))  # with one course joins says nothing
        variance += found.info["log_evidence_error"] ** 2
    odds = np.logaddexp(*heights[1:]) - heights[0]
    spread = math.sqrt(variance + (error / (share * (1 - share))) ** 2)
    assert spread < 0.2, "too noisy to test anything"
    assert abs(math.log(share / (1 - share)) - odds) < 4 * spread
    crowd = smc.run(PLAIN, evidence, seed=1, num_particles=300, num_moves=500)
    noise = math.sqrt(share * (1 - share) / crowd.info["families"] + error**2)
    assert abs(crowd.model_probabilities()[2] - share) < 4 * noise


def test_the_right_number_of_courses_is_found() -> None:
    """20 of 20 when this was written (and 40 of 40 with longer chains); a wrong one is no bug, two are."""
    wrong = 0
    for seed in range(20):
        scene = forked_road(seed)
        share = run(MODEL.prepare(scene.data)).model_probabilities().get(2, 0.0)
        wrong += (share > 0.5) != (scene.truth["num_courses"] == 2)
    assert wrong <= 1


def test_probabilities_are_true_of_scenes_that_the_model_draws() -> None:
    """Of S scenes of the prior with probabilities p of a second course, sum p have one, within 3.5 sqrt(sum p (1 - p));
    and the shared length of those that have one has evenly distributed ranks."""
    num = 30
    blank = EVIDENCE._replace(cues=None, arc=np.linspace(3.0, 150.0, len(EVIDENCE.group)))
    draws = simulate(MODEL, blank, num=num, seed=2)
    shares, ranks, have = [], [], draws["num_courses"].numpy() == 2
    for i in range(num):
        found = run(EVIDENCE._replace(cues=draws["cues"][i]), seed=i)
        forks = found.draws["num_courses"] == 2
        shares.append(forks.mean())
        if have[i]:
            ranks.append((found.draws["shared"][forks] < float(draws["shared"][i])).mean())
    p = np.array(shares)
    assert np.square(p - 0.5).mean() > 0.1, "these scenes show nothing"
    assert abs(have.sum() - p.sum()) < 3.5 * math.sqrt((p * (1.0 - p)).sum())
    assert abs(np.mean(ranks) - 0.5) < 3.5 / math.sqrt(12 * len(ranks))


def test_a_start_is_a_state_of_the_model_and_has_the_fork() -> None:
    for seed, num, joins in ((10, 2, 0), (0, 2, 1)):
        evidence = MODEL.prepare(forked_road(seed).data)
        begin = MODEL.start(evidence)
        assert (begin["num_courses"], begin["joins"]) == (num, joins)
        assert begin.keys() == simulate(MODEL, evidence, num=1, seed=0).keys()


def test_packing_returns_what_was_packed() -> None:
    z = prior(5)
    for name, value in unpack(pack(z)).items():
        np.testing.assert_array_equal(value, z[name])


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"forking": 1.0}, "forking is 1.0; give a probability between 0 and 1"),
        ({"share": 0.0}, "share is 0.0; give a probability between 0 and 1"),
        ({"bend_std": math.nan}, "bend_std must be finite and positive, but is nan"),
        ({"most": 150.0}, r"the road shared is 20.0 to 150.0 m long; .* choose least < most in \[7.95, 147\]"),
    ],
)
def test_wrong_settings_are_named(settings: dict[str, float], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        ForkedRoad(**settings)  # type: ignore[arg-type]


def test_only_a_density_simulates_and_only_with_arc_lengths() -> None:
    blank = EVIDENCE._replace(cues=None)
    with pytest.raises(InputError, match="give the evidence arc lengths"):
        simulate(MODEL, blank, num=1, seed=0)
    with pytest.raises(InputError, match="'paper' is no density of positions"):
        simulate(PAPER, blank._replace(arc=np.zeros(len(EVIDENCE.group))), num=1, seed=0)
    with pytest.raises(InputError, match="has no cues"):
        MODEL.kernel(blank)
