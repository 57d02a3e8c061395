"""The compiled density of cues along a road is the one that is written down, and so are its derivatives."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.special import ndtr
from torch import Tensor

from experiments.scenarios.road import night_road
from inference.factors import factored
from models.clothoid import Clothoid, evaluate, hermite, sample
from models.program import InputError, log_joint, simulate
from models.road.along_road import CuesAlongRoad
from models.road.course import RoadCourse
from models.road.cue_kernel import UNDERFLOW, nearest_sample, normal_share
from models.road.evidence import RoadEvidence
from models.road.kernel import NO_ROAD
from models.road.numbers import log_volumes, number_moments, to_courses, to_numbers
from models.road.prior import CoursePrior, course_moments

Floats = NDArray[np.float64]
EXACT, PURE = RoadCourse(clutter=0.1, lane_changes=0.2), RoadCourse(clutter=0.0, lane_changes=0.0)
PAPER = RoadCourse(likelihood="paper", beta_static=0.7, beta_vehicle=1.3, beta_flow=0.4)
MODELS = pytest.mark.parametrize("model", [EXACT, PURE, PAPER], ids=["exact", "pure", "paper"])
SCENE = night_road(2)
CUES = SCENE.data._replace(confidence=np.random.default_rng(0).uniform(0.3, 1.0, len(SCENE.data.kind)))
EVIDENCE = EXACT.prepare(CUES)
GROUPS = len(EVIDENCE.names)
OF_CUES = ("cues", "group", "covariance", "spread", "flow_spread", "flow_std", "turn", "moves")


def numbers(seed: int, num: int = 4) -> Floats:
    """Whitened numbers (num, 6 + G) about the truth and away from it."""
    factors = EXACT.factors(EVIDENCE)
    rng = np.random.default_rng(seed)
    return factors.whiten(SCENE.truth) + rng.uniform(0.01, 0.3, (num, 1)) * rng.standard_normal((num, 6 + GROUPS))


def written_down(model: RoadCourse, evidence: RoadEvidence, x: Tensor) -> Tensor:
    """Log likelihood (S,) of whitened x (S, 6 + G) in plain torch: nearest of all samples, then the equations."""
    course, offset = natural(x)
    road = sample(hermite(course[:, :3], course[:, 3:]), model.num_samples)  # the fit finds the clothoid again
    assert evidence.cues is not None
    px, py, flow = (column[None, :, None] for column in evidence.cues.T)
    dx, dy = px - road.x[:, None], py - road.y[:, None]  # (S, N, num)
    heading = road.heading[:, None].expand_as(dx)
    t, n = dx * torch.cos(heading) + dy * torch.sin(heading), dy * torch.cos(heading) - dx * torch.sin(heading)
    nearest = (dx**2 + dy**2).argmin(-1, keepdim=True)
    along, across, theta, bend = (
        v.gather(-1, nearest)[..., 0] for v in (t, n, heading, road.curvature[:, None].expand_as(dx))
    )
    arc = torch.linspace(0.0, 1.0, model.num_samples, dtype=torch.float64) * natural_length(x)[:, None]
    length = arc.gather(-1, nearest[..., 0]) + along
    lateral = across - offset[:, torch.from_numpy(evidence.group)]
    turn = flow[..., 0] - torch.from_numpy(evidence.turn)
    spread, seen = torch.from_numpy(evidence.spread), torch.from_numpy(np.isfinite(evidence.flow_spread))
    if model.likelihood == "paper":
        beta = torch.from_numpy(np.where(evidence.moves, model.beta_vehicle, model.beta_static))
        place = normal(torch.hypot(along, lateral), spread / beta.sqrt())
        flow_std = torch.from_numpy(evidence.flow_spread).clamp(max=1.0) / math.sqrt(model.beta_flow)
        return (place + torch.where(seen, normal(1 - torch.cos(turn - theta), flow_std), 0.0)).sum(-1)
    angle = theta + torch.atan(bend * along)
    m = torch.stack([-torch.sin(angle), torch.cos(angle)], -1)
    variance = (m[..., None, :] @ torch.from_numpy(evidence.covariance) @ m[..., None])[..., 0, 0] + spread**2
    foot = lateral - 0.5 * bend * along**2
    place = normal(foot, variance.sqrt())
    flow_std = torch.where(seen, torch.from_numpy(np.hypot(evidence.flow_spread, evidence.flow_std)), 1.0)
    gap = turn - theta - bend * along
    gap = gap - 2 * math.pi * torch.round(gap / (2 * math.pi))
    follows = place + torch.where(seen, normal(gap, flow_std), 0.0) + in_sight(model, evidence, angle, length, foot)
    if model.clutter > 0:
        stray = math.log(model.clutter / model.clutter_width) - seen.double() * math.log(2 * math.pi)
        single = torch.logaddexp(follows + math.log(1 - model.clutter), stray.expand_as(follows))
    else:
        single = follows
    there = normal(foot, (variance + model.change_std**2).sqrt())
    swerving = torch.hypot(flow_std, torch.full_like(flow_std, model.change_turn))
    there = there + torch.where(seen, normal(gap, swerving), 0.0)
    wide = evidence._replace(spread=np.hypot(evidence.spread, model.change_std))
    there = there + in_sight(model, wide, angle, length, foot)
    total = torch.zeros(len(x), dtype=torch.float64)
    for g in range(len(evidence.names)):
        mine = torch.from_numpy(evidence.group == g)
        stays = single[:, mine].sum(-1)
        if evidence.moves[evidence.group == g][0] and model.lane_changes > 0:
            leaves = math.log(model.lane_changes) + there[:, mine].sum(-1)
            stays = torch.logaddexp(math.log(1.0 - model.lane_changes) + stays, leaves)
        total = total + stays
    return total


def in_sight(model: RoadCourse, evidence: RoadEvidence, angle: Tensor, length: Tensor, lateral: Tensor) -> Tensor:
    """log of the mean of seen(l) over where each cue may stand, by Gauss-Hermite quadrature: (S, N).

    l = length - slant lateral + noise, the noise along that is independent of the noise across."""
    t = torch.stack([torch.cos(angle), torch.sin(angle)], -1)
    n = torch.stack([-t[..., 1], t[..., 0]], -1)
    covariance, spread = torch.from_numpy(evidence.covariance), torch.from_numpy(evidence.spread)
    tt, tn, nn = ((a[..., None, :] @ covariance @ b[..., None])[..., 0, 0] for a, b in ((t, t), (t, n), (n, n)))
    slant = tn / (nn + spread**2)
    std = (tt - slant * tn).sqrt()
    nodes, weights = (torch.from_numpy(v) for v in np.polynomial.hermite_e.hermegauss(60))
    places = (length - slant * lateral)[..., None] + std[..., None] * nodes
    shares = torch.special.ndtr((model.prior.behind + model.reach - places) / model.reach_std)
    return (shares @ (weights / weights.sum())).log()


def normal(value: Tensor, std: Tensor) -> Tensor:
    return -0.5 * (value / std) ** 2 - std.log() - 0.5 * math.log(2 * math.pi)


def course_factor(x: Tensor) -> Tensor:
    """The factor (S,) of the course at whitened x (S, 6 + G), in plain torch: what `to_courses` does, its Jacobian by
    autograd."""
    (centre, tril), (mean, root) = (map(torch.from_numpy, v(EXACT.prior)) for v in (number_moments, course_moments))

    def course(row: Tensor) -> Tensor:
        theta = centre + tril @ row
        end = evaluate(Clothoid(*theta), theta[5:])
        return torch.cat([theta[:3], end.x, end.y, end.heading])

    prior = torch.distributions.MultivariateNormal(mean, scale_tril=root)
    volume = torch.vmap(torch.func.jacrev(course))(x[:, :6])
    seen = torch.vmap(course)(x[:, :6])
    white = -0.5 * (x[:, :6] ** 2 + math.log(2 * math.pi)).sum(-1)
    return prior.log_prob(seen) + torch.linalg.slogdet(volume).logabsdet - white


@MODELS
def test_density_and_gradient_are_those_written_down_wherever_the_point_moves(model: RoadCourse) -> None:
    factors = model.factors(EVIDENCE)
    for seed in (0, 1):
        x = torch.from_numpy(numbers(seed)).requires_grad_()
        expected = written_down(model, EVIDENCE, x) + course_factor(x)
        (slope,) = torch.autograd.grad(expected.sum(), x)
        height, gradient = factors.gradient(x.detach().numpy())
        np.testing.assert_allclose(height, expected.detach(), rtol=1e-9)
        np.testing.assert_allclose(factors.evaluate(x.detach().numpy()).sum(-1), height, rtol=1e-12)
        np.testing.assert_allclose(gradient, slope, rtol=1e-6, atol=1e-7 * float(slope.abs().max()))


@MODELS
def test_factors_and_prior_are_the_bound_program(model: RoadCourse) -> None:
    x, factors = numbers(2), factored(model, EVIDENCE)
    height = factors.evaluate(x).sum(-1) - 0.5 * (x**2 + np.log(2 * np.pi)).sum(-1)
    latents = {n: torch.from_numpy(v) for n, v in factors.latents(x).items()}
    volume = log_volumes(x[:, :6], model.prior) + np.log(EVIDENCE.offset_std).sum()
    np.testing.assert_allclose(height, log_joint(model, latents, EVIDENCE) + volume, rtol=1e-12)


def natural_length(x: Tensor) -> Tensor:
    """Lengths (*B) of the courses of whitened numbers."""
    mean, tril = (torch.from_numpy(v) for v in number_moments(EXACT.prior))
    return mean[5] + x[..., :6] @ tril[5]


def natural(x: Tensor) -> tuple[Tensor, Tensor]:
    """Course and offsets of whitened numbers (*B, 6 + G), in torch."""
    mean, tril = (torch.from_numpy(v) for v in number_moments(EXACT.prior))
    loc, std = torch.from_numpy(EVIDENCE.offset_loc), torch.from_numpy(EVIDENCE.offset_std)
    theta = Clothoid(*(mean + x[..., :6] @ tril.T).unbind(-1))
    end = evaluate(theta, theta.length[..., None])
    course = torch.stack([theta.x, theta.y, theta.heading, *(v[..., 0] for v in end[:3])], -1)
    return course, loc + std * x[..., 6:]


@pytest.mark.parametrize("prior", [CoursePrior(length=300.0), CoursePrior(curvature_std=0.01)])
def test_wide_priors_have_the_density_of_the_program_or_none(prior: CoursePrior) -> None:
    """Numbers of clothoids that wind about between ends which a shorter one joins are no roads."""
    model = RoadCourse(prior=prior)
    factors = model.factors(EVIDENCE)
    x = np.random.default_rng(0).standard_normal((300, 6 + GROUPS))
    height = factors.evaluate(x).sum(-1)
    there = height > 0.5 * NO_ROAD
    assert 0.2 < there.mean() < 1.0
    latents = {n: torch.from_numpy(v) for n, v in factors.latents(x[there]).items()}
    volume = log_volumes(x[there, :6], prior) + np.log(EVIDENCE.offset_std).sum()
    white = 0.5 * (x[there] ** 2 + np.log(2 * np.pi)).sum(-1)
    expected = log_joint(model, latents, EVIDENCE).numpy() + volume + white
    np.testing.assert_allclose(height[there], expected, rtol=1e-6)


def test_priors_whose_roads_turn_back_are_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"has roads that turn back.*lower its length, curvature_std or rate_std"):
        RoadCourse(prior=CoursePrior(length=400.0, curvature_std=0.02)).factors(EVIDENCE)


def test_hessian_of_the_course_s_own_factor_is_that_of_finite_differences() -> None:
    """At the mean of C, where what Gauss and Newton leave out is the curvature of the volume alone."""
    blind = EVIDENCE._replace(**{name: getattr(EVIDENCE, name)[:0] for name in OF_CUES})
    squares, size = PURE.squares(blind), 6 + GROUPS
    x, step = np.r_[to_numbers(course_moments(PURE.prior)[0], PURE.prior), np.zeros(GROUPS)], 1e-4
    hessian, gradient = np.empty((size, size)), np.empty(size)
    slopes = np.empty((size, size))
    for i in range(6):
        ahead, back = np.empty(size), np.empty(size)
        for sign, slope in ((1.0, ahead), (-1.0, back)):
            squares.evaluate(squares.loc + squares.scale * (x + sign * step * np.eye(size)[i]), hessian, slope)
        slopes[i] = (ahead - back) / (2.0 * step)
    squares.evaluate(squares.loc + squares.scale * x, hessian, gradient)
    np.testing.assert_allclose(symmetric(hessian)[:6, :6], slopes[:6, :6], atol=0.05)


def test_the_end_of_sight_weighs_by_its_own_curvature() -> None:
    """Minus the second derivative of log Phi by differences, near and far beyond where it underflows."""
    for x in (-1e4, -50.0, -30.1, -29.9, -3.0, 0.0, 2.0, 6.0):
        step = 1e-3 * max(1.0, abs(x) * 1e-3)
        points = (x - step, x, x + step)
        below, here, above = (normal_share(at, ndtr(at) if at > UNDERFLOW else 0.0) for at in points)
        assert here[1] == pytest.approx((above[0] - below[0]) / (2 * step), rel=1e-5)
        assert here[2] == pytest.approx(-(above[1] - below[1]) / (2 * step), rel=1e-4, abs=1e-9)


def test_cues_far_beyond_the_sight_leave_gradients_finite() -> None:
    tight = EVIDENCE._replace(covariance=np.broadcast_to(1e-6 * np.eye(2), EVIDENCE.covariance.shape).copy())
    for reach in (1.0, 1e-3):
        model = RoadCourse(reach=reach, reach_std=1e-4)
        height, gradient = model.factors(tight).gradient(numbers(8))
        assert np.isfinite(height).all() and np.isfinite(gradient).all()


def test_numbers_and_courses_are_inverse_and_volumes_are_those_of_autograd() -> None:
    whole = torch.from_numpy(numbers(6))
    x = whole.numpy()[:, :6]
    np.testing.assert_allclose(to_courses(x, EXACT.prior), natural(whole)[0], rtol=1e-12, atol=1e-10)
    back = [to_numbers(course, EXACT.prior) for course in to_courses(x, EXACT.prior)]
    np.testing.assert_allclose(back, x, rtol=1e-8, atol=1e-8)
    jacobian = torch.stack([torch.func.jacrev(lambda row: natural(row)[0])(row) for row in whole])[..., :6]
    expected = torch.linalg.slogdet(jacobian).logabsdet
    np.testing.assert_allclose(log_volumes(x, EXACT.prior), expected, rtol=1e-9)


@MODELS
def test_program_has_first_derivatives_and_refuses_second_ones(model: RoadCourse) -> None:
    assert EVIDENCE.cues is not None
    x = torch.from_numpy(numbers(3)).requires_grad_()
    height = CuesAlongRoad(model, EVIDENCE, *natural(x)).log_prob(EVIDENCE.cues)
    (slope,) = torch.autograd.grad(height.sum(), x, create_graph=True)
    (expected,) = torch.autograd.grad(written_down(model, EVIDENCE, x).sum(), x)
    np.testing.assert_allclose(slope.detach(), expected, rtol=1e-6, atol=1e-7 * float(expected.abs().max()))
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.grad(slope.sum(), x)


@MODELS
def test_each_factor_reads_the_course_and_its_own_offset(model: RoadCourse) -> None:
    """Measured: which factors move when a number does. A vehicle that is clutter anyway may stand still."""
    factors, x = model.factors(EVIDENCE), numbers(4, num=1)
    still = factors.evaluate(x)
    moved = (np.concatenate([factors.evaluate(x + 0.1 * step) for step in np.eye(6 + GROUPS)]) != still).T
    np.testing.assert_array_equal(moved[1:], factors.depends[1:])
    assert not np.any(moved[0] & ~factors.depends[0])  # a start aside is as probable under both priors
    assert factors.depends.sum() == 6 + GROUPS * 7


@MODELS
def test_squares_have_the_cost_and_slope_of_the_factors(model: RoadCourse) -> None:
    squares, factors = model.squares(EVIDENCE), model.factors(EVIDENCE)
    x = numbers(5)
    hessian, gradient = np.empty((6 + GROUPS, 6 + GROUPS)), np.empty(6 + GROUPS)
    for row, height, slope in zip(x, *factors.gradient(x), strict=True):
        z = squares.loc + squares.scale * row
        assert squares.log_const - squares.evaluate(z, hessian, gradient) == pytest.approx(height, rel=1e-12)
        np.testing.assert_allclose(-gradient * squares.scale, slope, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(squares.unpack(z)["course"], factors.latents(row)["course"], rtol=1e-12)
        np.testing.assert_allclose(squares.pack(factors.latents(row)), z, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(squares.log_volume(z), log_volumes(row[:6], model.prior), rtol=1e-12)


@pytest.mark.parametrize("reach", [125.0, math.inf])
def test_hessian_is_the_covariance_of_the_slope(reach: float) -> None:
    """Fisher's information of a density is both, and the mean slope is zero; on a straight road, where distances across
    it are exactly normal. Within 4.5 standard errors of 2000 simulated scenes, the largest of a hundred.

    Cues are as frequent along the road as the model says; no end of the sight is a road much longer than the course.
    Noise along the line of sight moves cues along and across at once, where each foot has a normal of its own: slopes
    are moved by a tenth of a standard deviation at most."""
    num, size = 2000, 6 + GROUPS
    model = dataclasses.replace(PURE, reach=reach)
    z = model.squares(EVIDENCE).loc
    course, offset = (v[0] for v in natural(torch.zeros(1, size, dtype=torch.float64)))
    rng = np.random.default_rng(0)
    slopes, hessian, mean = np.empty((num, size)), np.empty((size, size)), np.zeros((size, size))
    torch.manual_seed(0)
    for slope in slopes:
        blank = EVIDENCE._replace(arc=seen_arcs(rng, len(EVIDENCE.group), reach))
        cues = CuesAlongRoad(model, blank, course, offset).sample()
        model.squares(EVIDENCE._replace(cues=cues)).evaluate(z, hessian, slope)
        mean += symmetric(hessian) / num
    blind, alone = EVIDENCE._replace(**{name: getattr(EVIDENCE, name)[:0] for name in OF_CUES}), np.empty(size)
    model.squares(blind).evaluate(z, hessian, alone)  # the factor of the course is no data
    slopes, mean = slopes - alone, mean - symmetric(hessian)
    seen_by_cues = [1, 2, 3, 4, *range(6, size)]  # a straight road may begin and end anywhere along itself
    slopes, mean = slopes[:, seen_by_cues], mean[np.ix_(seen_by_cues, seen_by_cues)]
    scale = 1.0 / np.sqrt(np.diag(mean))
    scores = slopes * scale
    products = scores[:, :, None] * scores[:, None]
    error = products.std(0) / math.sqrt(num)
    assert np.all(np.abs(scores.mean(0)) < 4.5 / math.sqrt(num) + 0.1)
    assert np.all(np.abs(products.mean(0) - scale * mean * scale[:, None]) < 4.5 * error)


def test_vehicles_change_lanes_with_all_their_detections_and_as_far_as_said() -> None:
    """Of 4000 simulated scenes: the share of vehicles with a detection beyond 4 sd of those that stay, and the spread
    and turn of those that leave. Standard errors times 4."""
    num, model = 4000, dataclasses.replace(PURE, lane_changes=0.5, reach=math.inf)
    tight = EVIDENCE._replace(
        cues=None,
        covariance=np.broadcast_to(1e-8 * np.eye(2), EVIDENCE.covariance.shape).copy(),
        spread=np.full(len(EVIDENCE.group), 1e-3),
        arc=np.linspace(5.0, 150.0, len(EVIDENCE.group)),
    )
    course, offset = (v[0] for v in natural(torch.zeros(1, 6 + GROUPS, dtype=torch.float64)))
    torch.manual_seed(3)
    along = CuesAlongRoad(model, tight, course.expand(num, 6), offset.expand(num, GROUPS))
    seen = along.sample()
    aside = seen[..., 1].numpy() - offset.numpy()[tight.group]  # the road is straight and along x
    leaves = np.abs(aside) > 0.02  # 20 sd of those that stay; those that leave are nearer by chance in 1 of 120
    group = int(np.flatnonzero(np.bincount(tight.group[tight.moves], minlength=GROUPS) > 1)[0])
    mine = leaves[:, tight.group == group]
    assert np.abs(mine.any(1).mean() - 0.5) < 4 * 0.5 / math.sqrt(num)
    gone = mine.any(1)
    assert mine[gone].mean() > 0.98  # all of them, or none
    assert not leaves[:, ~tight.moves].any()
    far = aside[:, tight.group == group][gone]
    turned = seen[..., 2].numpy()[:, tight.group == group][gone] - tight.turn[tight.group == group]
    std = np.hypot(tight.flow_spread, tight.flow_std)[tight.group == group]
    assert far.std() == pytest.approx(model.change_std, rel=4 / math.sqrt(far.size))
    for column, own in zip(turned.T, std, strict=True):
        assert column.std() == pytest.approx(math.hypot(own, model.change_turn), rel=4 / math.sqrt(2 * len(column)))


def seen_arcs(rng: np.random.Generator, num: int, reach: float) -> Floats:
    """Arc lengths (num,) of cues that a camera of this reach sees, from the start of the course on."""
    if math.isinf(reach):
        return rng.uniform(5.0, 150.0, num)
    arcs = rng.uniform(5.0, 220.0, 50 * num)
    seen = rng.random(50 * num) < ndtr((EXACT.prior.behind + reach - arcs) / EXACT.reach_std)
    return np.asarray(arcs[seen][:num])


def symmetric(lower: Floats) -> Floats:
    """The matrix whose lower half is filled."""
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)


def test_residuals_are_white_at_the_truth_and_weights_count_the_clutter() -> None:
    """Over 3000 simulated scenes of N cues; standard errors of mean, standard deviation and share, times 4.

    Noise along a bend moves cues across it; bends to the left and to the right are equally probable, so that means are
    not moved, and standard deviations by less than 0.02."""
    num, arc = 3000, np.linspace(5.0, 150.0, len(EVIDENCE.group))
    measured = np.isfinite(EVIDENCE.flow_spread)
    for model in (PURE, EXACT):
        blank = EVIDENCE._replace(cues=None, arc=arc)
        draw = simulate(model, blank, num=num, seed=1)
        road = CuesAlongRoad(model, blank, draw["course"], draw["offset"])
        lateral, turn, weight = road.whitened(draw["cues"]).numpy().transpose(2, 0, 1)
        if model is EXACT:
            stays = np.where(EVIDENCE.moves, 1.0 - EXACT.lane_changes, 1.0)
            share = float((1.0 - EXACT.clutter) * stays.mean())
            together = (weight.mean(1)).std() / math.sqrt(num)  # all cues of a vehicle change lanes at once
            assert abs(weight.mean() - share) < 4 * together + 1e-3
            continue
        for residual in (lateral, turn[:, measured]):
            assert np.all(np.abs(residual.mean(0)) < 4 / math.sqrt(num))
            assert np.all(np.abs(residual.std(0) - 1.0) < 4 / math.sqrt(2 * num) + 0.02)
        assert np.all(turn[:, ~measured] == 0.0)


def test_courses_that_no_sane_road_has_are_left_but_break_nothing() -> None:
    nowhere = torch.tensor([-10.0, 0.0, 0.0, -10.0, 0.0, 0.0], dtype=torch.float64, requires_grad=True)
    x = np.zeros((2, 6 + GROUPS))
    x[1, :6] = np.linalg.solve(number_moments(EXACT.prior)[1], [0.0, 0.0, 0.0, 0.0, 0.0, -200.0])  # a length below 0
    with pytest.raises(InputError, match="no clothoid joins the ends"):
        to_numbers(nowhere.detach().numpy(), EXACT.prior)
    for model in (EXACT, PAPER):
        factors = model.factors(EVIDENCE)
        height, gradient = factors.gradient(x)
        assert np.isfinite(height[0])
        assert height[1] == (1 + GROUPS) * NO_ROAD
        assert np.all(factors.evaluate(x)[1] == NO_ROAD)
        assert np.all(gradient[1] == 0.0)
        assert EVIDENCE.cues is not None
        beside = CuesAlongRoad(model, EVIDENCE, nowhere, torch.from_numpy(EVIDENCE.offset_loc))
        density = beside.log_prob(EVIDENCE.cues)
        assert density == GROUPS * NO_ROAD
        assert torch.autograd.grad(density, nowhere)[0].eq(0.0).all()


def test_parabola_at_the_nearest_sample_is_near_enough_to_the_foot() -> None:
    """Samples every 4 m against every 0.25 m: less than a hundredth of a nat for each cue about the truth."""
    x = EXACT.factors(EVIDENCE).whiten(SCENE.truth)[None]
    fine = dataclasses.replace(PURE, spacing=0.25).factors(EVIDENCE).evaluate(x)[:, 1:]
    assert np.all(np.abs(fine - PURE.factors(EVIDENCE).evaluate(x)[:, 1:]) < 0.01 * np.bincount(EVIDENCE.group))


def test_only_a_density_simulates_and_only_where_arc_lengths_are_known() -> None:
    blank = EVIDENCE._replace(cues=None)
    with pytest.raises(InputError, match="give the evidence arc lengths"):
        simulate(EXACT, blank, num=1, seed=0)
    with pytest.raises(InputError, match="'paper' is no density of positions, so it cannot simulate; choose 'exact'"):
        simulate(PAPER, blank._replace(arc=np.zeros(len(EVIDENCE.group))), num=1, seed=0)
    with pytest.raises(InputError, match="no cues"):
        EXACT.factors(blank)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"likelihood": "printed"}, "likelihood is 'printed'; choose 'exact' or 'paper'"),
        ({"clutter": 1.0}, r"clutter is 1.0; give a share in \[0, 1\)"),
        ({"spacing": 0.0}, "spacing must be finite and positive, but is 0.0"),
        ({"beta_flow": math.nan}, "beta_flow must be finite and positive, but is nan"),
    ],
)
def test_wrong_settings_are_named(settings: dict[str, float], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        RoadCourse(**settings)  # type: ignore[arg-type]


def test_the_nearest_sample_is_found_inside_a_sharp_bend() -> None:
    """A circle of 20 m with samples every 4 m: there the tangent alone says too little of where the foot is."""
    step, radius = 4.0, 20.0
    arc = step * np.arange(8.0)
    turned = arc / radius
    x, y = radius * np.sin(turned), radius * (1.0 - np.cos(turned))
    table = np.stack([x, y, turned, np.cos(turned), np.sin(turned), np.full(8, 1.0 / radius), arc], -1)
    place, inward = (v.ravel() for v in np.meshgrid(np.linspace(0.0, 28.0, 200), [-4.0, 0.0, 6.0, 10.0]))
    centre = np.stack([np.zeros(800), np.full(800, radius)], -1)
    cues = centre + (radius - inward)[:, None] * np.stack([np.sin(place / radius), -np.cos(place / radius)], -1)
    found = [nearest_sample(cues, n, table, step) for n in range(len(cues))]
    distance = np.hypot(cues[:, :1] - x, cues[:, 1:] - y)
    np.testing.assert_allclose(distance[np.arange(800), found], distance.min(1), atol=1e-9)
