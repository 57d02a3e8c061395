"""Settings of the road course learnt from roads that were simulated under others."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from experiments.scenarios.road import camera, night_road
from experiments.scenarios.road_layout import random_layout
from inference import importance
from inference.empirical_bayes import Learnt, draw, learn
from models.capability import Hyper
from models.program import InputError, log_joint, simulate
from models.road.course import RoadCourse
from models.road.cues import CueKind, Cues
from models.road.hyper import changed, hyper, learnable, setting
from models.road.prior import course_moments

Floats = NDArray[np.float64]
ENGINE = partial(importance.run, num_draws=200, num_rounds=3)
SCENES = [night_road(seed).data for seed in range(6)]
PAPER = RoadCourse(likelihood="paper", beta_static=0.7, beta_vehicle=1.3, beta_flow=0.4)
TRUE = {
    "clutter": 0.12,
    "delineator.std": 0.4,
    "delineator.right.mean": -4.2,
    "delineator.right.std": 0.5,
    "car.flow_std": 0.1,
    "prior.curvature_std": 1 / 250,
}


def simulated(model: RoadCourse, seed: int) -> Cues:
    """A night road as this model has it, clutter included."""
    streams = np.random.SeedSequence(seed).spawn(2)
    _, layout = random_layout(np.random.default_rng(streams[0]))
    num = len(layout.kind)
    moves = np.isin(layout.kind, ["car", "truck"])
    where = np.stack([np.array(layout.arc), np.zeros(num)], -1)  # about; for the noise of the camera
    blank = Cues(
        np.array(layout.kind), np.array(layout.left), np.array(layout.track), where + 1e-3 * np.arange(num)[:, None],
        camera(where, moves), np.where(moves, 0.0, np.nan), 0.02 + 0.0012 * where[:, 0], np.ones(num),
    )  # fmt: skip
    evidence = model.prepare(blank)._replace(cues=None, arc=np.array(layout.arc))
    seen = simulate(model, evidence, num=1, seed=int(streams[1].generate_state(1)[0]))["cues"][0].numpy()
    return blank._replace(position=seen[:, :2], flow=np.where(moves, seen[:, 2], np.nan))


def about(model: RoadCourse, cues: Cues, num: int = 5) -> dict[str, Floats]:
    """Some courses of the prior and offsets."""
    rng, evidence = np.random.default_rng(0), model.prepare(cues)
    mean, tril = course_moments(model.prior)
    offset = evidence.offset_loc + evidence.offset_std * rng.standard_normal((num, len(evidence.offset_loc)))
    return {"course": mean + rng.standard_normal((num, 6)) @ tril.T, "offset": offset}


@pytest.mark.parametrize(
    "model", [RoadCourse(clutter=0.1), RoadCourse(clutter=0.0), PAPER], ids=["exact", "pure", "paper"]
)
def test_the_density_of_draws_is_the_program_s_under_other_settings(model: RoadCourse) -> None:
    rng, family = np.random.default_rng(1), hyper(model, SCENES)
    for cues in SCENES[:3]:
        confident = cues._replace(confidence=rng.uniform(0.3, 1.0, len(cues.kind)))
        draws = about(model, confident)
        f, latents = family.complete(confident, draws), {n: torch.from_numpy(v) for n, v in draws.items()}
        first, second = (family.start + 0.3 * family.width * rng.standard_normal(len(family.start)) for _ in range(2))
        program = [
            log_joint(m, latents, m.prepare(confident)).numpy() for m in (family.model(first), family.model(second))
        ]
        assert f(first) - f(second) == pytest.approx(program[0] - program[1], rel=1e-9, abs=1e-7)
        assert f(first) - f(second) == pytest.approx(program[0] - program[1])  # once more, from what was kept


def test_numbers_and_settings_go_there_and_back() -> None:
    model = RoadCourse(clutter=0.07, extra_kinds=(CueKind("sign", (-4.0, 1.0), (6.0, 1.0), 0.3),))
    family = hyper(model, SCENES)
    assert family.natural(family.start) == pytest.approx([setting(model, name).value for name in family.names])
    h = family.start + np.linspace(-0.5, 0.5, len(family.names))
    other = family.model(h)
    assert family.natural(h) == pytest.approx([setting(other, name).value for name in family.names])
    assert model.extra_kinds[0] in other.extra_kinds  # nobody saw a sign
    assert other.prior.length == model.prior.length


@pytest.fixture(scope="module")
def taught() -> tuple[Hyper, Learnt]:
    truth = changed(RoadCourse(), TRUE)
    scenes = [simulated(truth, seed) for seed in range(60)]
    family = hyper(RoadCourse(), scenes, list(TRUE))
    return family, learn(family, scenes, ENGINE, seed=0, num_draws=60, progress=False)


def test_settings_that_made_the_roads_are_learnt_from_them(taught: tuple[Hyper, Learnt]) -> None:
    family, learnt = taught
    natural = family.natural(learnt.h)
    truth = family.start.copy()
    for i, name in enumerate(family.names):
        scale = {"clutter": lambda v: np.log(v / (1 - v)), "delineator.right.mean": float}.get(name, np.log)
        truth[i] = scale(TRUE[name])
    gaps = np.abs(learnt.h - truth) / np.hypot(learnt.error, learnt.noise)
    assert np.all(gaps < 3.0), dict(zip(family.names, zip(natural, gaps, strict=True), strict=True))
    assert np.abs((family.start - truth) / learnt.error).max() > 6.0  # while the defaults are far from it
    assert all("the engine warns in" in flag for flag in learnt.flags)  # of three scenes with heavy weights
    totals = learnt.log_evidence.sum(1)
    assert totals[-1] - totals[0] > 30.0


def test_held_out_roads_are_more_probable_than_under_the_defaults(taught: tuple[Hyper, Learnt]) -> None:
    family, learnt = taught
    scenes = [simulated(changed(RoadCourse(), TRUE), 1000 + seed) for seed in range(80)]
    evidence = [
        draw(family, scenes, ENGINE, h, np.random.SeedSequence(5), 50).log_evidence for h in (family.start, learnt.h)
    ]
    gap = evidence[1] - evidence[0]
    error = gap.std(ddof=1) / np.sqrt(len(gap))
    assert gap.mean() > 3 * error, (gap.mean(), error)  # 30 scenes would leave 1.3 +- .4 nats


def test_the_paper_s_beta_learns_how_coarse_the_samples_are() -> None:
    model = RoadCourse(likelihood="paper")
    family = hyper(model, SCENES, ["beta_static"])
    learnt = learn(family, SCENES, ENGINE, seed=0, num_draws=50, progress=False)
    assert 0.2**2 / (0.2**2 + 4**2 / 12) / 3 < family.natural(learnt.h)[0] < 0.2


@pytest.mark.parametrize(
    ("model", "name", "sentence"),
    [
        (RoadCourse(), "delineatr.std", "teach nothing called 'delineatr.std'; did you mean 'delineator.std'"),
        (RoadCourse(), "bicycle", "'bicycle' cannot be learnt: no scene has a bicycle"),
        (RoadCourse(), "beta_flow", "'beta_flow' has no part in these scenes under likelihood=exact"),
        (RoadCourse(clutter=0.0), "clutter", "clutter is 0, from where no share can be learnt"),
        (PAPER, "clutter", "'clutter' has no part in these scenes under likelihood=paper"),
        (PAPER, "delineator.std", "one number to likelihood=paper; learn beta_static"),
    ],
)
def test_what_cannot_be_learnt_is_one_sentence(model: RoadCourse, name: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        hyper(model, SCENES, [name])


def test_a_scene_without_cues_is_refused() -> None:
    with pytest.raises(InputError, match="scene 1 has no cues"):
        hyper(RoadCourse(), [SCENES[0], SCENES[0].take(np.zeros(len(SCENES[0].kind), dtype=bool))])


def test_a_kind_stands_for_all_its_numbers() -> None:
    one = hyper(RoadCourse(), SCENES, ["car"]).names
    assert one and all(name.startswith("car.") for name in one) and set(one) < set(learnable(RoadCourse(), SCENES))
    assert "beta_static" in hyper(PAPER, SCENES).names and "car.std" not in hyper(PAPER, SCENES).names
