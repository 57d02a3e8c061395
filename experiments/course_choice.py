"""Lane courses of the family that the tracks speak for.

Both families are densities of where the same points lie across their lanes, given where along them: their evidences
differ by the odds of the families, if both are as probable before. Either learns scales of its priors. Border points
are data of LaneCourses alone: with them the evidences are of different data, and there is no choice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

from inference.posterior import Posterior
from models.intersection.course_family import AnyEvidence, Courses
from models.intersection.routes import RoutedTracks
from models.program import InputError

Engine = Callable[..., Posterior]


@dataclass(frozen=True)
class Rival:
    """Courses to compare with the engine's own, and which of their scales are learnt."""

    courses: Courses
    learn: tuple[str, ...] = ()


class Choice(NamedTuple):
    """An engine's own courses and a rival to them."""

    own: Courses
    rival: Rival


class Fitted(NamedTuple):
    """Posterior of courses and what it was learnt from."""

    posterior: Posterior
    evidence: AnyEvidence


def fit(
    refine: Engine, courses: Courses | Choice, routed: RoutedTracks, seed: int, prepared: AnyEvidence | None = None
) -> Fitted:
    """Courses of all lanes; of two families the one with the larger evidence: info tells its name, `family`, the
    `family_log_evidence` of both, and `family_nats` between them.

    prepared  evidence of the courses that are no rival, if there is some already

    Raises InputError where the engine tells no evidence to choose by, or border points are part of one alone."""
    if not isinstance(courses, Choice):
        evidence = courses.prepare(routed) if prepared is None else prepared
        return Fitted(refine(courses, evidence, seed=seed), evidence)
    if routed.tracks.borders is not None:
        raise InputError(
            "border points are data of LaneCourses alone, so evidences do not compare; drop them or the rival"
        )
    own, rival = courses
    engine = partial(refine, learn=tuple(rival.learn))
    both = [fit(refine, own, routed, seed, prepared), fit(engine, rival.courses, routed, seed)]
    scores = [one.posterior.log_evidence for one in both]
    if scores[0] is None or scores[1] is None:
        raise InputError("refine tells no evidence to choose a family by; set refine=least_squares, or drop the rival")
    names = [type(family).__name__ for family in (own, rival.courses)]
    best = int(scores[1] > scores[0])
    info = {
        "family": names[best],
        "family_log_evidence": dict(zip(names, scores, strict=True)),
        "family_nats": abs(scores[1] - scores[0]),
    }
    return both[best]._replace(posterior=replace(both[best].posterior, info=both[best].posterior.info | info))
