"""Roads of pieces: the density that is written down, moves that are involutions, and the right number of knots."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.stats import chi2, kstest

from experiments.metrics import most_probable_count
from experiments.road_figures import figures
from experiments.road_metrics import check_course, label_free, metrics
from experiments.scenarios.road import Line, night_road, see
from experiments.scenarios.road_layout import Layout, Row, place_row
from inference import calibration, diagnostics, importance, rjmcmc
from inference.compiled_chain import CompiledChains
from inference.posterior import Posterior
from models.capability import Move
from models.clothoid import Clothoid, Points, evaluate
from models.program import InputError, Latents, check, fix, log_joint, simulate, terms, total
from models.road.along_road import CuesAlongRoad
from models.road.course import RoadCourse
from models.road.evidence import RoadEvidence
from models.road.segment_data import bound_evidence, even_state
from models.road.segment_kernel import pack, road_samples, unpack
from models.road.segment_moves import improve
from models.road.segments import CuesAlongPieces, SegmentedRoad, batched_moves
from tests.involution import assert_involution, uniforms

Floats = NDArray[np.float64]
ROAD = SegmentedRoad(RoadCourse(clutter=0.1, reach=math.inf, lane_changes=0.0))
PURE = SegmentedRoad(RoadCourse(clutter=0.0))
PAPER = SegmentedRoad(RoadCourse(likelihood="paper", beta_static=0.7, beta_vehicle=1.3, beta_flow=0.4))
MODELS = pytest.mark.parametrize("model", [ROAD, PURE, PAPER], ids=["exact", "pure", "paper"])
SCENE = night_road(2003, mismatch=True)
EVIDENCE = ROAD.prepare(SCENE.data)
ARC = np.linspace(5.0, 150.0, len(EVIDENCE.group))


def drawn(model: Any, num: int, seed: int, evidence: RoadEvidence = EVIDENCE) -> Latents:
    """Roads of the prior, {site: (num, *event)}."""
    return {n: v for n, v in simulate(model, evidence, num=num, seed=seed).items() if n != "cues"}


def curvature_at(z: dict[str, Any], s: Floats) -> Floats:
    """Curvature of one road at arc lengths, as the model's docstring says it."""
    num = int(z["num_knots"])
    order = np.argsort(z["knot"][:num])
    place = np.r_[0.0, np.asarray(z["knot"])[:num][order]]
    bend = np.r_[float(z["curvature"]), np.asarray(z["knot_curvature"])[:num][order]]
    return np.where(s < place[-1], np.interp(s, place, bend), bend[-1] + float(z["rate"]) * (s - place[-1]))


def walked(z: dict[str, Any], s: Floats) -> Floats:
    """x, y, heading of one road at evenly spaced arc lengths from 0, (M, 3), by the rule of the midpoint."""
    step, middle = s[1] - s[0], 0.5 * (s[1:] + s[:-1])
    x, y, heading = (float(v) for v in z["start"])
    turned = heading + np.r_[0.0, np.cumsum(curvature_at(z, middle) * step)]
    half = 0.5 * (turned[1:] + turned[:-1])
    return np.column_stack(
        [x + np.r_[0.0, np.cumsum(np.cos(half) * step)], y + np.r_[0.0, np.cumsum(np.sin(half) * step)], turned]
    )


def one(latents: Latents, row: int) -> dict[str, Any]:
    return {name: value[row].numpy() for name, value in latents.items()}


# The density


def test_samples_lie_along_the_integral_of_the_curvature() -> None:
    """The midpoint rule at 1 cm is off by less than 1e-5 m, Simpson's at 4 m by what its docstring says."""
    latents = drawn(ROAD, 60, seed=1)
    s = np.linspace(0.0, 155.0, 15501)
    table = road_samples(latents, 155.0, 32)  # every 5 m
    for row in range(60):
        z = one(latents, row)
        expected = walked(z, s)[::500]
        rates = np.diff(curvature_at(z, s)) / 0.01
        bound = 1e-5 + np.abs(np.diff(rates)).sum() * 5.0**4 / 500
        assert np.abs(table[row, :, :2] - expected[:, :2]).max() < bound
        np.testing.assert_allclose(table[row, :, 2], expected[:, 2], atol=1e-6)
        np.testing.assert_allclose(table[row, :, 5], curvature_at(z, s[::500]), atol=1e-12)
        np.testing.assert_allclose(table[row, :, 6], s[::500], atol=1e-9)
        np.testing.assert_allclose(
            table[row, :, 3:5], np.stack([np.cos(table[row, :, 2]), np.sin(table[row, :, 2])], -1)
        )


def test_density_is_the_one_written_down() -> None:
    """Nearest of all samples, distance from the parabola through it, and the mixture with clutter."""
    latents, evidence, course = drawn(ROAD, 30, seed=2), EVIDENCE, ROAD.course
    assert evidence.cues is not None
    found = terms(ROAD, latents, evidence).likelihood["cues"]
    table = road_samples(latents, course.prior.length, course.num_samples)
    px, py, flow = evidence.cues.numpy().T
    for row in range(30):
        x, y, heading, cos, sin, bend, _ = table[row].T
        nearest = ((px[:, None] - x) ** 2 + (py[:, None] - y) ** 2).argmin(1)
        heading, cos, sin, bend = (column[nearest] for column in (heading, cos, sin, bend))
        dx, dy = px - x[nearest], py - y[nearest]
        along, across = dx * cos + dy * sin, dy * cos - dx * sin
        foot = heading + np.arctan(bend * along)
        normal = np.stack([-np.sin(foot), np.cos(foot)], -1)
        variance = np.einsum("ni,nij,nj->n", normal, evidence.covariance, normal) + evidence.spread**2
        lateral = across - 0.5 * bend * along**2 - latents["offset"][row].numpy()[evidence.group]
        height = -0.5 * lateral**2 / variance - 0.5 * np.log(2 * np.pi * variance) + math.log(1 - course.clutter)
        seen = np.isfinite(evidence.flow_spread)
        std = np.where(seen, np.hypot(evidence.flow_spread, evidence.flow_std), 1.0)
        turn = np.angle(np.exp(1j * (flow - heading - bend * along - evidence.turn))) / std
        height += np.where(seen, -0.5 * turn**2 - np.log(std) - 0.5 * math.log(2 * np.pi), 0.0)
        stray = math.log(course.clutter / course.clutter_width) - seen * math.log(2 * np.pi)
        assert float(found[row]) == pytest.approx(np.logaddexp(height, stray).sum(), rel=1e-9)


@MODELS
def test_without_knots_the_cues_are_those_along_a_clothoid(model: SegmentedRoad) -> None:
    latents = drawn(fix(model, num_knots=0), 40, seed=3)
    place = latents["start"].unbind(-1)
    length = torch.full_like(latents["rate"], model.course.prior.length)
    road = Clothoid(*place, latents["curvature"], latents["rate"], length)
    end = torch.cat(evaluate(road, length[:, None])[:3], -1)
    assert EVIDENCE.cues is not None
    course = CuesAlongRoad(model.course, EVIDENCE, torch.cat([latents["start"], end], -1), latents["offset"])
    found = terms(fix(model, num_knots=0), latents, EVIDENCE).likelihood["cues"]
    np.testing.assert_allclose(found, course.log_prob(EVIDENCE.cues), rtol=1e-7)


@MODELS
def test_compiled_density_is_the_programs(model: SegmentedRoad) -> None:
    latents, kernel = drawn(model, 50, seed=4), model.kernel(EVIDENCE)
    parts, cache, out = terms(model, latents, EVIDENCE), np.zeros(kernel.cache_size), np.empty(2)
    z = kernel.pack({name: value.numpy() for name, value in latents.items()})
    expected = np.stack([total(parts.prior), total(parts.likelihood)], -1)
    for row, both in zip(z, expected, strict=True):
        kernel.evaluate(row, kernel.floats, kernel.ints, cache, out)
        np.testing.assert_allclose(out, both, rtol=1e-10)
    z[0, -1] = -1.0  # a knot, active or not
    kernel.evaluate(z[0], kernel.floats, kernel.ints, cache, out)
    assert out[0] == -np.inf
    back = kernel.unpack(z[1:])
    for name, value in latents.items():
        np.testing.assert_array_equal(back[name], value[1:])


def test_a_relabelling_is_the_same_road() -> None:
    latents = drawn(fix(ROAD, num_knots=4), 20, seed=5)
    turned = latents | {name: latents[name].flip(-1) for name in ("knot", "knot_curvature")}
    np.testing.assert_allclose(*(log_joint(fix(ROAD, num_knots=4), z, EVIDENCE) for z in (latents, turned)), rtol=1e-12)


def test_simulated_cues_stand_beside_the_road() -> None:
    """Of single cues far to the left, with hardly any noise."""
    exact = EVIDENCE._replace(
        cues=None, arc=np.sort(np.random.default_rng(0).uniform(0.0, 155.0, len(ARC))),
        covariance=np.tile(1e-12 * np.eye(2), (len(ARC), 1, 1)), spread=np.full(len(ARC), 1e-6),
    )  # fmt: skip
    draw = simulate(PURE, exact, num=5, seed=6)
    s = np.linspace(0.0, 155.0, 155001)
    for row in range(5):
        line = walked(one(draw, row), s)[np.rint(exact.arc / 0.001).astype(int)]
        aside = draw["offset"][row].numpy()[exact.group]
        seen = line[:, :2] + aside[:, None] * np.stack([-np.sin(line[:, 2]), np.cos(line[:, 2])], -1)
        np.testing.assert_allclose(draw["cues"][row, :, :2], seen, atol=2e-3)


# Fits and moves


def test_the_fit_given_the_knots_is_near_the_mode() -> None:
    """Slopes of the log joint at the centre, in its own standard deviations: a perfect fit has none. Two linearisations
    leave little, and steps of the slopes of another parametrisation would leave much."""
    floats, ints = bound_evidence(PURE, EVIDENCE)
    kernel, out, cache = PURE.kernel(EVIDENCE), np.empty(2), np.zeros(10000)
    groups = len(EVIDENCE.names)
    for num in range(4):
        z = even_state(PURE, EVIDENCE.offset_loc, num, PURE.max_knots)
        assert improve(z, floats, ints)  # type: ignore[call-arg]
        size = groups + 5 + num

        def height(at: Floats) -> float:
            kernel.evaluate(at, floats, ints, cache, out)
            return float(out.sum())

        for i in range(1, size + 1):
            scale = 1e-3 * np.r_[EVIDENCE.offset_std, 0.5, 0.4, 0.03, 1 / 400, 1 / 36000, np.full(4, 1 / 400)][i - 1]
            up, down = z.copy(), z.copy()
            up[i] += scale
            down[i] -= scale
            slope = (height(up) - height(down)) / (2 * scale)
            bend = -(height(up) + height(down) - 2 * height(z)) / scale**2
            assert abs(slope) / math.sqrt(bend) < 0.15, (num, i)


BOUND = {"with cues": batched_moves(ROAD, EVIDENCE), "without": ROAD.moves()}
MOVES = [(name, move) for name, moves in BOUND.items() for move in moves]


def near(num: int, seed: int) -> Latents:
    """States about the posterior, with 0 to max_knots knots, inactive slots drawn from the prior."""
    floats, ints = bound_evidence(ROAD, EVIDENCE)
    latents, rng = drawn(ROAD, num, seed), np.random.default_rng(seed)
    latents["num_knots"] = torch.from_numpy(rng.integers(0, ROAD.max_knots + 1, num))
    z, groups = pack({name: value.numpy() for name, value in latents.items()}), len(EVIDENCE.names)
    scale = np.r_[np.full(groups, 0.05), 0.1, 0.1, 0.002, 1e-4, 1e-6, np.full(ROAD.max_knots, 1e-4)]
    for row in z:
        assert improve(row, floats, ints)  # type: ignore[call-arg]
        size = groups + 5 + int(row[0])
        row[1 : 1 + size] += scale[:size] * rng.standard_normal(size)
    return {name: torch.from_numpy(np.asarray(v)) for name, v in unpack(z, ROAD.max_knots).items()}


@pytest.mark.parametrize(("name", "move"), MOVES, ids=[f"{move.name} {name}" for name, move in MOVES])
def test_a_move_is_an_involution_and_tells_its_jacobian(name: str, move: Move) -> None:
    """Rounding: w is up to some hundreds in the worst whitened direction of these states, and normal_cdf(w) loses its
    digits in its upper tail."""
    states = near(60, seed=7) if name == "with cues" else drawn(ROAD, 60, seed=7)
    assert_involution(move, states, uniforms(move, 60, seed=8), relative=1e-6, tolerance=1e-4, num_jacobians=12)


def test_shifts_and_births_carry_the_road_along() -> None:
    """A new knot or a moved one changes where the road leads by about its posterior spread, not by the metres that
    other numbers held still would: that is what makes them accepted."""
    states, shifts = near(200, seed=9), next(move for move in BOUND["with cues"] if move.name == "shift")
    u = uniforms(shifts, 200, seed=10)
    u[:, 1] = 0.0  # long ones
    proposal = shifts.propose(states, u)
    bare = states | {"knot": proposal.latents["knot"]}
    before, after, alone = (
        road_samples({name: value[proposal.valid] for name, value in road.items()}, 140.0, 36)[..., 1]
        for road in (states, proposal.latents, bare)
    )
    carried, left = (np.median(np.abs(road - before).max(1)) for road in (after, alone))
    assert len(before) > 50
    assert carried < 1.5 and left > 2.0 * carried, (carried, left)


# The posterior

BLIND = EVIDENCE._replace(covariance=np.tile(1e14 * np.eye(2), (len(ARC), 1, 1)), flow_spread=np.full(len(ARC), np.inf))


def assert_prior(posterior: Posterior, model: SegmentedRoad) -> None:
    """The number of knots by chi-square, all other numbers by Kolmogorov's test, on draws far enough apart; each of the
    tests would fail once in a thousand seeds. Idle slots far down the stack wait long for their turn: not tested."""
    share = [math.exp(-model.knots_mean) * model.knots_mean**k / math.factorial(k) for k in range(model.max_knots + 1)]
    counts = np.bincount(posterior.model_index.ravel(), minlength=model.max_knots + 1)
    expected = counts.sum() * np.array(share) / sum(share)
    assert ((counts - expected) ** 2 / expected).sum() < chi2.ppf(0.999, model.max_knots), (counts, expected)
    flat = {name: values.reshape(-1, *values.shape[2:]) for name, values in posterior.draws.items()}
    prior, num = model.course.prior, flat["num_knots"]
    active = np.arange(model.max_knots) < num[:, None]
    numbers = {
        "curvature": flat["curvature"] / prior.curvature_std,
        "rate": flat["rate"] / prior.rate_std,
        "heading": flat["start"][:, 2] / prior.heading_std,
        "x": (flat["start"][:, 0] + prior.behind) / prior.behind_std,
        "offset": (flat["offset"][:, 0] - EVIDENCE.offset_loc[0]) / EVIDENCE.offset_std[0],
        "active bend": flat["knot_curvature"][active] / prior.curvature_std,
    }
    for name, values in numbers.items():
        assert kstest(values, "norm").pvalue > 1e-3, name
    assert kstest(flat["knot"][active] / prior.length, "uniform").pvalue > 1e-3


def test_the_prior_is_found_again_when_the_cues_say_nothing() -> None:
    """All chains begin without a knot. Draws are 200 steps apart."""
    knobs = {"start": "data", "num_chains": 8, "num_steps": 21000, "warmup": 1000, "thin": 200}
    assert_prior(rjmcmc.run(PURE, BLIND, seed=1, **knobs), PURE)


def test_the_moves_without_cues_find_the_prior_too() -> None:
    """The last states of chains that all begin at one."""
    small = SegmentedRoad(PURE.course, max_knots=2)
    state, knobs = small.start(BLIND), {"path": "batched", "num_chains": 200, "num_steps": 500, "warmup": 499}
    assert_prior(rjmcmc.run(small, BLIND, seed=2, init=state, **knobs), small)


def even_rows(line: Line, seed: int, gap: float) -> RoadEvidence:
    """Delineators on both sides of a road, all the way."""
    layout, rng = Layout([], [], [], []), np.random.default_rng(seed)
    for left in (False, True):
        place_row(layout, Row("delineator", left, gap), 155.0, rng)
    return ROAD.prepare(see(layout, line, rng, np.random.SeedSequence(seed)).cues)


def line_of(z: dict[str, Any]) -> Line:
    s = np.arange(0.0, 155.5, 0.5)
    track = walked(z, s)
    return Line(s, Points(*(torch.from_numpy(np.ascontiguousarray(v)) for v in (*track.T, curvature_at(z, s)))))


def pieces(*bends: float, knot: float, rate: float) -> dict[str, Any]:
    """A road with one knot: its curvature at the start and there, and the rate from there on."""
    return {
        "num_knots": 1, "start": np.array([-10.0, 0.0, 0.0]), "curvature": bends[0], "rate": rate,
        "knot": np.array([knot]), "knot_curvature": np.array(bends[1:]),
    }  # fmt: skip


S_BEND = pieces(0.006, -0.004, knot=75.0, rate=3e-5)


def test_number_of_knots_is_as_probable_as_the_evidences_of_the_fixed_numbers_say() -> None:
    """log p(k, cues) by importance sampling from the prior, each k fixed, against the visits of reversible jump, within
    four standard errors of both. The cues are so few and poor that no number is certain, nor as probable as before."""
    model = SegmentedRoad(RoadCourse(clutter=0.05), max_knots=2)
    evidence = even_rows(line_of(S_BEND), seed=1, gap=30.0)
    evidence = evidence._replace(covariance=evidence.covariance + np.eye(2))
    log_joint, error = np.empty(3), np.empty(3)
    for k in range(3):
        knobs = {"transform": "prior", "num_draws": 8000, "num_rounds": 20}
        found = importance.run(fix(model, num_knots=k), evidence, seed=k, **knobs)
        log_joint[k], error[k] = found.log_evidence, found.info["log_evidence_error"]
    exact = np.exp(log_joint - np.logaddexp.reduce(log_joint))
    posterior = rjmcmc.run(model, evidence, seed=4, start="data", num_chains=8, num_steps=12000, warmup=2000, thin=5)
    visits = [(posterior.model_index == k).astype(float) for k in range(3)]
    prior = np.array([1.0, 1.5, 1.125]) / 3.625
    assert np.abs(exact - prior).max() > 0.1 and exact.min() > 0.02
    slopes = np.diag(exact) - np.outer(exact, exact)  # of the shares in the log evidences
    for share, visited, slope in zip(exact, visits, slopes, strict=True):
        gap = math.hypot(diagnostics.standard_error(visited), float(np.hypot.reduce(slope * error)))
        assert gap < 0.02
        assert abs(visited.mean() - share) < 4 * gap, (visited.mean(), share, gap)


def test_a_clear_change_is_found_where_it_is_and_one_clothoid_misses_it() -> None:
    sharp = pieces(0.006, -0.006, knot=75.0, rate=6e-5)
    evidence, line = even_rows(line_of(sharp), seed=3, gap=8.0), walked(sharp, np.arange(0.0, 155.5, 0.5))
    posterior = rjmcmc.run(ROAD, evidence, seed=5, start="data", num_chains=4, num_steps=4000, warmup=1000, thin=5)
    assert posterior.model_probabilities().get(0, 0.0) < 0.01
    count = most_probable_count(posterior, SCENE, dimension="num_knots")
    assert count["num_knots_map"] >= 1 and count["num_knots_probability"] == max(
        posterior.model_probabilities().values()
    )
    place = posterior.given(1).draws["knot"][..., 0]
    assert abs(np.median(place) - 75.0) < 3 * place.std() < 60.0
    found, other = (check_course(p, line) for p in (posterior, importance.run(ROAD.course, evidence, seed=5)))
    assert found.inside("mid") and not other.inside("mid")


def test_chains_from_the_prior_reach_those_from_the_data() -> None:
    """Where the road leads at 40, 80 and 140 m, with and without annealing, within four standard errors."""
    knobs = {"num_chains": 4, "num_steps": 7000, "warmup": 3000, "thin": 10}
    starts = [("data", 1.0), ("prior", 1.0), ("prior", 100.0)]
    runs = [rjmcmc.run(ROAD, EVIDENCE, seed=6, start=s, start_temperature=heat, **knobs) for s, heat in starts]
    for k in (8, 16, 28):
        left = [road_samples(run.draws, 150.0, 31)[..., k, 1] for run in runs]
        first, *others = [(values.mean(), diagnostics.standard_error(values)) for values in left]
        for mean, error in others:
            assert abs(mean - first[0]) < 4 * math.hypot(error, first[1])


def transition(latents: Latents, evidence: Any, seed: int) -> Latents:
    """A hundred steps of the compiled chain for every scene of a batch."""
    ends = []
    for row, (cues, one_seed) in enumerate(
        zip(evidence.cues, np.random.SeedSequence(seed).spawn(len(evidence.cues)), strict=True)
    ):
        kernel = ROAD.kernel(evidence._replace(cues=cues))
        z = kernel.pack({name: value[row : row + 1].numpy() for name, value in latents.items()})
        chain = CompiledChains(kernel, z, rjmcmc.RULES["exact"], 1, 100, [one_seed], 1)
        chain.advance(0, np.ones(100))
        ends.append(chain.z[0])
    return {name: torch.as_tensor(value) for name, value in kernel.unpack(np.array(ends)).items()}


def end(z: Latents) -> Floats:
    """Where the road is at its end, to the left [m]."""
    return road_samples({name: np.asarray(value) for name, value in z.items()}, 155.0, 40)[:, -1, 1]


def active(z: Latents) -> torch.Tensor:
    return torch.arange(ROAD.max_knots) < torch.as_tensor(z["num_knots"])[:, None]


FUNCTIONALS: dict[str, calibration.Functional] = {
    "num_knots": lambda z: z["num_knots"],
    "end^2": lambda z: end(z) ** 2,
    "curvature^2": lambda z: z["curvature"] ** 2,
    "rate^2": lambda z: z["rate"] ** 2,
    "offset": lambda z: z["offset"].sum(-1),
    "active": lambda z: (z["knot_curvature"] ** 2 * (torch.arange(4) < torch.as_tensor(z["num_knots"])[:, None])).sum(
        -1
    ),
}
BLANK = EVIDENCE._replace(cues=None, arc=ARC, covariance=EVIDENCE.covariance + 0.04 * np.eye(2))


def test_steps_and_simulator_agree_on_the_joint_density() -> None:
    """Seven standard normal z-scores: one in two thousand such sets exceeds 4 (the seed is fixed)."""
    scores = calibration.geweke(ROAD, BLANK, transition, FUNCTIONALS, num=150, num_steps=4, seed=1)
    assert max(map(abs, scores.values())) < 4.0, scores


@pytest.mark.slow
def test_ranks_of_the_truth_are_uniform() -> None:
    """Simulation-based calibration; p below 1e-4 in one of seven functionals has odds of 1 in 1500."""

    def engine(model: Any, evidence: Any, seed: int) -> Posterior:
        return rjmcmc.run(model, evidence, seed=seed, start="data", num_chains=2, num_steps=5000, warmup=1000, thin=40)

    found = calibration.ranks(ROAD, BLANK, engine, FUNCTIONALS, num=300, num_draws=19, seed=2)
    assert min(found.p_values().values()) > 1e-4, found.p_values()


# Reports and refusals


def test_roads_of_pieces_are_scored_as_courses_are() -> None:
    """The same roads told by their ends and by their pieces."""
    latents = {n: v.numpy()[None] for n, v in drawn(fix(ROAD, num_knots=0), 40, seed=11).items()}
    latents["num_knots"] = np.zeros((1, 40), dtype=np.int64)
    narrow = latents | {"start": latents["start"][:, :1].repeat(40, 1), "curvature": 0.1 * latents["curvature"]}
    narrow["rate"] = 0.1 * narrow["rate"]
    end = road_samples({n: v[0] for n, v in narrow.items()}, 155.0, 40)[:, -1, :3]
    course = np.concatenate([narrow["start"][0], end], -1)[None]
    line = SCENE.truth["line"]
    pieces, clothoids = check_course(Posterior(narrow), line), check_course(Posterior({"course": course}), line)
    np.testing.assert_allclose(pieces.error, clothoids.error, atol=0.02)
    np.testing.assert_allclose(pieces.spread, clothoids.spread, atol=1e-3)
    np.testing.assert_array_equal(pieces.covered, clothoids.covered)
    assert pieces.reach == clothoids.reach
    assert set(metrics(Posterior(narrow), SCENE)) == set(metrics(Posterior({"course": course}), SCENE))
    left = [label_free(Posterior(draws))["left_140_m"] for draws in (narrow, {"course": course})]
    np.testing.assert_allclose(left[0] - left[0].mean(), left[1] - left[1].mean(), atol=5e-3)
    assert set(figures(Posterior(narrow), SCENE)) == {"road"}


def test_what_cannot_be_is_refused_in_a_sentence() -> None:
    with pytest.raises(InputError, match="max_knots is 0; give 1 or more, or use RoadCourse for a single clothoid"):
        SegmentedRoad(max_knots=0)
    with pytest.raises(InputError, match="knots_mean must be finite and positive, but is -1"):
        SegmentedRoad(knots_mean=-1.0)
    blank = EVIDENCE._replace(cues=None)
    with pytest.raises(InputError, match="give the evidence arc lengths"):
        simulate(ROAD, blank, num=1, seed=0)
    with pytest.raises(InputError, match="'paper' is no density of positions"):
        simulate(PAPER, blank._replace(arc=ARC), num=1, seed=0)
    with pytest.raises(InputError, match="this evidence has no cues"):
        ROAD.kernel(blank)
    check(ROAD, EVIDENCE)


def test_torch_refuses_a_gradient_rather_than_telling_none() -> None:
    latents = drawn(ROAD, 3, seed=12)
    latents["rate"].requires_grad_()
    assert EVIDENCE.cues is not None
    with pytest.raises(RuntimeError, match="requires grad"):
        CuesAlongPieces(ROAD, EVIDENCE, latents).log_prob(EVIDENCE.cues)
