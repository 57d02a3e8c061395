"""The choice between families of lane courses."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from experiments.course_choice import Choice, Rival, fit
from inference import least_squares
from inference.posterior import Posterior
from models.intersection.course_family import centre_lines, lane_displacements
from models.intersection.courses import LaneCourses
from models.intersection.free_courses import FreeCourses
from models.program import InputError
from tests.small_lanes import error, small_scene, true_routes

SCENE = small_scene()
ROUTED = true_routes(SCENE)
CHOICE = Choice(LaneCourses(), Rival(FreeCourses(), ("inner",)))


@pytest.mark.parametrize(("arms", "free", "family"), [(-10.0, -12.5, "LaneCourses"), (-12.5, -10.0, "FreeCourses")])
def test_the_larger_evidence_wins_and_tells_by_how_much(arms: float, free: float, family: str) -> None:
    learnt = []

    def engine(model: Any, evidence: Any, *, seed: int, learn: tuple[str, ...] = ("handle",)) -> Posterior:
        learnt.append(learn)
        return Posterior(draws={}, log_evidence=free if isinstance(model, FreeCourses) else arms)

    info = fit(engine, CHOICE, ROUTED, 0).posterior.info
    assert (info["family"], info["family_nats"]) == (family, 2.5)
    assert info["family_log_evidence"] == {"LaneCourses": arms, "FreeCourses": free}
    assert learnt == [("handle",), ("inner",)]  # each its own scales


def test_without_evidence_there_is_no_choice() -> None:
    with pytest.raises(InputError, match="tells no evidence"):
        fit(lambda model, evidence, seed, learn=(): Posterior(draws={}), CHOICE, ROUTED, 0)


def test_border_points_that_one_family_alone_scores_leave_no_choice() -> None:
    marked = ROUTED._replace(tracks=ROUTED.tracks._replace(borders=np.zeros((1, 2))))
    with pytest.raises(InputError, match="border points are data of LaneCourses alone"):
        fit(lambda model, evidence, seed, learn=(): Posterior(draws={}, log_evidence=0.0), CHOICE, marked, 0)


@pytest.mark.parametrize("courses", [LaneCourses(), FreeCourses()])
def test_either_family_draws_its_lines(courses: LaneCourses | FreeCourses) -> None:
    engine = partial(least_squares.run, num_draws=3)
    posterior, evidence = fit(engine, courses, ROUTED, 0)
    assert SCENE.truth is not None
    lines = centre_lines(evidence, posterior.estimate)
    across = lane_displacements(evidence, posterior.estimate, {n: v[0] for n, v in posterior.draws.items()})
    for line, moved, true in zip(lines, across, SCENE.truth.lines, strict=True):
        assert error(line, true) < 0.4
        assert moved.shape == (len(line), 3)
