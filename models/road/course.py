"""The course of a road as a clothoid, seen through cues that follow it, Trusheim, Condurache and Mertins [T17].

    course ~ N(mean, covariance)         C = (x, y, heading) of start and end, [T17] eq. 1 and 3
    offset_g ~ N(mu_g, std_g^2)          one for each kind and side of static cues, one for each vehicle
    cues ~ CuesAlongRoad(course, offset) [T17] eq. 4 and 5, or ours

`likelihood` chooses between two:

    paper  as printed: N(errorPos; 0, sigma / sqrt(beta)) N(errorFlow; 0, sigma / sqrt(beta)), where errorPos is the
           distance from the predicted point on the nearest of samples every `spacing` metres, errorFlow one less the
           cosine between flow and tangent, sigma = std of the kind / sqrt(confidence). The last and errorFlow are ours:
           the paper says "related to the specific confidences" and "anti-correlation".
    exact  departs from it so that it is a density: residuals across the road, corrected to second order for the foot
           between two samples, with the measured covariance propagated, an end of the sight, and mixtures with clutter
           and with vehicles that change lanes.

Both take the prior's full covariance; the paper leaves it open. See models.road.cue_kernel for the equations.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv
from scipy.special import ndtri
from scipy.stats import binom

from models.capability import Chart, Factors, Hyper, Squares
from models.program import InputError
from models.road.along_road import CuesAlongRoad, cue_arrays, kernel_settings
from models.road.cue_kernel import CHANGES, SPREADS
from models.road.cues import KINDS, CueKind, Cues
from models.road.evidence import COURSE_LABELS, RoadEvidence, offset_labels, road_evidence
from models.road.hyper import hyper
from models.road.kernel import density_slopes, group_densities, normal_equations
from models.road.numbers import log_volumes, number_moments, prior_root, to_courses, to_numbers
from models.road.prior import USUAL_ROADS, CoursePrior, course_moments

Floats = NDArray[np.float64]
FIRST_ROADS = (8, 2)  # places and directions of the end that a start is the best of
IMPLAUSIBLE = 2e-3  # chance of so much clutter
SUSPECT = 0.5  # a vehicle that rather leaves the road than follows it
FOGS = (3.0, 1.0, 0.4)  # [m]


@dataclass(frozen=True)
class RoadCourse:
    """Which likelihood, with what settings; kinds beside those of models.road.cues."""

    likelihood: Literal["exact", "paper"] = "exact"
    clutter: float = 0.05  # share of cues that do not follow the road; of `exact`
    clutter_width: float = 30.0  # across the road, where clutter is [m]
    reach: float = 125.0  # of the camera along the road: half the cues there are seen; inf for no end [m]; of `exact`
    reach_std: float = 14.0  # over which it ends [m]
    lane_changes: float = 0.05  # share of vehicles that change lanes while they are seen; of `exact`
    change_std: float = 2.0  # how far aside their detections are then [m]
    change_turn: float = 0.1  # and how much they turn [rad]
    beta_static: float = 1.0  # weights of the paper's likelihood
    beta_vehicle: float = 1.0
    beta_flow: float = 1.0
    spacing: float = 4.0  # of the samples of the course, about [m]
    prior: CoursePrior = USUAL_ROADS
    extra_kinds: tuple[CueKind, ...] = ()  # new kinds of cues; those of a known name replace it

    def __post_init__(self) -> None:
        if self.likelihood not in ("exact", "paper"):
            raise InputError(f"likelihood is '{self.likelihood}'; choose 'exact' or 'paper'")
        for kind in self.extra_kinds:
            if not isinstance(kind, CueKind):
                raise InputError(f"extra_kinds holds {kind!r}; give each kind as a models.road.cues.CueKind")
        if not 0 <= self.clutter < 1:
            raise InputError(f"clutter is {self.clutter}; give a share in [0, 1)")
        if not 0 <= self.lane_changes < 1:
            raise InputError(f"lane_changes is {self.lane_changes}; give a share in [0, 1)")
        if not self.reach > 0:
            raise InputError(f"reach is {self.reach}; give the metres that the camera sees, or inf")
        for name in (
            "clutter_width",
            "reach_std",
            "change_std",
            "change_turn",
            "beta_static",
            "beta_vehicle",
            "beta_flow",
            "spacing",
        ):
            value = getattr(self, name)
            if not math.isfinite(value) or value <= 0:
                raise InputError(f"{name} must be finite and positive, but is {value}")

    def __call__(self, evidence: RoadEvidence) -> None:
        mean, tril = (torch.from_numpy(v) for v in course_moments(self.prior))
        loc, std = torch.from_numpy(evidence.offset_loc), torch.from_numpy(evidence.offset_std)
        course = pyro.sample("course", dist.MultivariateNormal(mean, scale_tril=tril))
        offset = pyro.sample("offset", dist.Normal(loc, std).to_event(1))
        pyro.sample("cues", CuesAlongRoad(self, evidence, course, offset), obs=evidence.cues)

    def labels(self, evidence: RoadEvidence) -> dict[str, tuple[str, ...]]:
        """What the numbers of each site are."""
        return {"course": COURSE_LABELS, "offset": offset_labels(evidence)}

    @property
    def num_samples(self) -> int:
        """Samples of a course, about `spacing` apart."""
        return max(2, 1 + math.ceil(self.prior.length / self.spacing))

    def prepare(self, cues: Cues) -> RoadEvidence:
        """Evidence of this model. Raises InputError for cues that no course can be computed from."""
        kinds = {kind.name: kind for kind in (*KINDS, *self.extra_kinds)}
        return road_evidence(cues, tuple(kinds.values()))

    def start(self, evidence: RoadEvidence) -> dict[str, Floats]:
        """The best of some roads of the prior, improved by a Gauss-Newton step each as the fog lifts.

        The posterior has modes where rows of cues are taken for clutter or for the other side of a bend, and descent
        from the prior's middle often ends in them. Fog is spread added to that of the cues (`FOGS`)."""
        loc, std = evidence.offset_loc, evidence.offset_std
        course, num, paper, cues, group = self._kernel(evidence)
        centre, scale = np.r_[np.zeros(6), loc], np.r_[np.ones(6), std]
        roads, sharp = first_roads(self.prior), cues[:, SPREADS].copy()
        chance = cues[:, CHANGES].copy()
        cues[:, CHANGES] = 0.0  # in thick fog a vehicle that changes lanes looks like one that does not
        x = np.concatenate([roads, np.zeros((len(roads), len(loc)))], 1)
        cues[:, SPREADS] = sharp + FOGS[0] ** 2
        heights = np.empty((len(x), 1 + len(loc)))
        group_densities(x, course, num, paper, cues, group, loc, std, heights)  # type: ignore[call-arg]
        best = x[np.argmax(heights[:, 1:].sum(-1))]
        hessian, gradient = np.zeros((len(best), len(best))), np.empty(len(best))
        for fog in FOGS:
            cues[:, SPREADS] = sharp + fog**2
            if fog == FOGS[-1]:
                cues[:, CHANGES] = chance
            normal_equations(centre + scale * best, course, num, paper, cues, group, hessian, gradient)  # type: ignore[call-arg]
            whole = np.eye(len(best)) + scale[:, None] * hessian * scale
            best = best - dposv(whole, best + scale * gradient, lower=1)[1]
        return {"course": to_courses(best[:6], self.prior), "offset": loc + std * best[6:]}

    def factors(self, evidence: RoadEvidence) -> Factors:
        """One factor of the course, and one for each group of cues, which reads the course and its own offset."""
        loc, std = evidence.offset_loc, evidence.offset_std
        arguments = (*self._kernel(evidence), loc, std)
        num = len(loc)

        def evaluate(x: Floats) -> Floats:
            out = np.empty((len(x), 1 + num))
            group_densities(np.ascontiguousarray(x), *arguments, out)  # type: ignore[call-arg]
            return out

        def gradient(x: Floats) -> tuple[Floats, Floats]:
            height, slope = np.empty(len(x)), np.empty_like(x)
            density_slopes(np.ascontiguousarray(x), *arguments, height, slope)  # type: ignore[call-arg]
            return height, slope

        def latents(x: Floats) -> dict[str, Floats]:
            return {"course": to_courses(x[..., :6], self.prior), "offset": loc + std * x[..., 6:]}

        def whiten(state: dict[str, Any]) -> Floats:
            offset = np.asarray(state["offset"], dtype=np.float64)
            return np.concatenate([to_numbers(state["course"], self.prior), (offset - loc) / std])

        groups = np.eye(1 + num, dtype=bool)[:, 1:]
        depends = np.concatenate([np.ones((1 + num, 6), dtype=bool), groups], 1)
        sites = {"course": slice(0, 6), "offset": slice(6, 6 + num)}
        return Factors(evaluate, gradient, depends, sites, latents, whiten)

    def squares(self, evidence: RoadEvidence) -> Squares:
        """The same density for least squares. Clutter weighs residuals down; the gradient is exact all the same."""
        num = len(evidence.offset_loc)
        loc, scale = np.r_[np.zeros(6), evidence.offset_loc], np.r_[np.ones(6), evidence.offset_std]
        sites = {"course": slice(0, 6), "offset": slice(6, 6 + num)}
        evaluate = partial(_evaluate, self._kernel(evidence))
        chart = Chart(*(partial(part, prior=self.prior) for part in (to_courses, to_numbers, log_volumes)))
        return Squares(loc, scale, sites, {"course": (6,), "offset": (num,)}, evaluate, 0.0, {"course": chart})

    def hyper(self, scenes: Sequence[Cues], names: Sequence[str] = ()) -> Hyper:
        """Settings by these names, or all that scenes teach: see models.road.hyper."""
        return hyper(self, scenes, names)

    def follows(self, evidence: RoadEvidence, draws: dict[str, Floats]) -> Floats:
        """Probability (N,) of each cue to follow the road, the mean over draws of course (S, 6) and offset (S, G) that
        are roads."""
        course, offset = (torch.from_numpy(np.ascontiguousarray(draws[site])) for site in ("course", "offset"))
        assert evidence.cues is not None
        return CuesAlongRoad(self, evidence, course, offset).whitened(evidence.cues)[..., 2].nanmean(0).numpy()

    def remarks(self, evidence: RoadEvidence, draws: dict[str, Floats]) -> list[str]:
        """What speaks against the draws, in words: vehicles that rather change lanes, or turn off, than follow the
        road; and more cues taken for clutter than there can be, which tells of a wrong mode.

        m of n cues are too many where Binomial(n, clutter) has m or more with a probability below IMPLAUSIBLE."""
        follows = self.follows(evidence, draws)
        shares = {int(g): follows[evidence.group == g].mean() for g in np.unique(evidence.group[evidence.moves])}
        rest = follows[~np.isin(evidence.group, [g for g, share in shares.items() if share < SUSPECT])]
        lost = int(np.nansum(1.0 - rest))
        found = []
        if binom.sf(lost - 1, len(rest), self.clutter) < IMPLAUSIBLE:
            found.append(
                f"{lost} of {len(rest)} cues are taken for clutter, where {self.clutter:.0%} are expected: another "
                "road may explain them; compare with engine=importance_prior, or raise clutter"
            )
        return found + [
            f"{evidence.names[g]} changes lanes or turns off (it follows the road with a probability of {share:.2g}) "
            "and counts for little"
            for g, share in shares.items()
            if share < SUSPECT
        ]

    def _kernel(self, evidence: RoadEvidence) -> tuple[Any, ...]:
        """What every kernel reads of the model and its evidence."""
        if evidence.cues is None:
            raise InputError("this evidence has no cues (they await simulation); give them before inference")
        course = (*number_moments(self.prior), *prior_root(self.prior))
        return course, *kernel_settings(self), *cue_arrays(self, evidence, evidence.cues.numpy())


def _evaluate(arguments: tuple[Any, ...], z: Floats, hessian: Floats, gradient: Floats) -> float:
    return float(normal_equations(z, *arguments, hessian, gradient))  # type: ignore[call-arg]


@functools.lru_cache
def first_roads(prior: CoursePrior) -> Floats:
    """Whitened numbers (S, 6) of roads that end at evenly probable places, in evenly probable directions there."""
    mean, tril = course_moments(prior)
    ends = list(itertools.product(*(ndtri((np.arange(num) + 0.5) / num) for num in FIRST_ROADS)))
    return np.stack([to_numbers(mean + tril[:, 4:] @ end, prior) for end in ends])
