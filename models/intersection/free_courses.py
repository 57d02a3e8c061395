"""The course of every lane as a curve of its own: no width, no straightness, turns of any sharpness.

A lane is a reference curve from its tracks and a displacement f(s) across it, a cubic B-spline with knots every few
metres along the curve: a P-spline with third differences (Eilers and Marx 1996) in the form of a mixed model, so that
curvature is a random walk from knot to knot. Lanes that begin or end as one (the same arm, side and number in
`connections`) share their spline there, as far in as the tracks show no difference; lanes of one arm share most of it.
Sites, each one vector [m]:

    offset     of every stub across the axis of its arm, from the middle of its tracks
    arm_bow    slope and bow of every arm beside its axis; stub_bow what a stub has besides
    arm_jerk   third differences of the spline of an arm: knots^2 times changes of curvature; stub_jerk of a stub
    inner      the same of each lane between its stubs, whitened (models.intersection.free_splines)

The middle of every third difference is that of the reference: the prior is about the course itself, wherever the
reference lies. Learning scales (inference.squares) is the choice of smoothing parameters by marginal likelihood; how
rough lanes are compared with one another is chosen before, from the tracks of each alone.

The structure is not read: a lane whose entry or exit arm is -1 has no stub there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from models.capability import Squares
from models.intersection.first_fit import Scales
from models.intersection.free_evidence import FreeEvidence, free_evidence
from models.intersection.free_kernel import free_equations
from models.intersection.routes import RoutedTracks
from models.program import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FreeCourses:
    """Standard deviations of the priors and of the measurements."""

    offset_std: float = 1.0  # [m]
    arm_bow_std: float = 1.0  # [m]
    stub_bow_std: float = 0.2  # [m]
    arm_jerk_std: float = 0.1  # [m]
    stub_jerk_std: float = 0.03  # [m]
    inner_std: float = 0.3  # of a lane as rough as most [m]
    position_std: float = 1.0  # of a point, on each axis [m]
    heading_std: float = 0.1  # of a measured heading [rad]
    spacing: float = 1.0  # of the nodes [m]
    knots: float = 4.0  # from one to the next [m]
    shared: bool = True  # whether lanes of an arm are, or each is estimated by itself

    def __post_init__(self) -> None:
        for field in fields(self):
            if field.name == "shared":
                continue
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"{field.name} must be finite and positive, but is {value}")

    def __call__(self, evidence: FreeEvidence) -> None:
        latents = {}
        for name, middle in evidence.loc.items():
            scale = getattr(self, f"{name}_std") * torch.from_numpy(evidence.scale[name])
            latents[name] = pyro.sample(name, dist.Normal(torch.from_numpy(middle), scale).to_event(1))
        pyro.sample("points", PointsOnCurves(self, evidence, latents), obs=evidence.points)

    def prepare(self, routed: RoutedTracks) -> FreeEvidence:
        """Evidence of this model. Raises InputError where no track is on a route."""
        return free_evidence(
            routed, self.spacing, self.knots, Scales(self.offset_std, self.inner_std, self.position_std), self.shared
        )

    def start(self, evidence: FreeEvidence) -> dict[str, Array]:
        """The reference curves themselves."""
        return {name: np.zeros_like(value) for name, value in evidence.loc.items()}

    def squares(self, evidence: FreeEvidence) -> Squares:
        """The same density as a compiled sum of squares."""
        ends = np.cumsum([0, *(loc.size for loc in evidence.loc.values())])
        sites = {name: slice(ends[i], ends[i + 1]) for i, name in enumerate(evidence.loc)}
        loc = np.concatenate([value.reshape(-1) for value in evidence.loc.values()])
        scale = np.concatenate([getattr(self, f"{name}_std") * value for name, value in evidence.scale.items()])
        shapes = {name: value.shape for name, value in evidence.loc.items()}
        evaluate = partial(_evaluate, evidence_arrays(self, evidence))
        return Squares(loc, scale, sites, shapes, evaluate, log_constant(self, evidence))


def evidence_arrays(model: FreeCourses, evidence: FreeEvidence) -> tuple[Any, ...]:
    """What `free_equations` reads besides the numbers."""
    noise = np.array([model.position_std, model.heading_std if evidence.heading else np.inf])
    design = np.concatenate([own.reshape(-1) for own in evidence.design])
    sizes, counts = np.array([own.shape[::-1] for own in evidence.design]).T.copy()
    curves = (np.concatenate(evidence.where), design, sizes, np.concatenate(evidence.reference), counts)
    points = np.ascontiguousarray(evidence.points.numpy())
    return curves, (evidence.tracks, evidence.starts, evidence.offsets, points, noise)


def log_constant(model: FreeCourses, evidence: FreeEvidence) -> float:
    """log p(points | courses) plus the cost: normalisers of the lateral and of the heading residuals."""
    num = int(np.diff(evidence.offsets)[evidence.tracks].sum())
    each = -math.log(model.position_std) - 0.5 * math.log(2 * math.pi)
    if evidence.heading:
        each += -math.log(model.heading_std) - 0.5 * math.log(2 * math.pi)
    return num * each


def _evaluate(data: tuple[Any, ...], z: Array, hessian: Array, gradient: Array) -> float:
    return float(free_equations(z, *data, hessian, gradient))  # type: ignore[call-arg]


class PointsOnCurves(TorchDistribution):
    """Points (3, N) about the courses of their lanes: across a lane normal, along it anywhere, as PointsOnCourses.

    It cannot simulate."""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.real, 2)

    def __init__(self, model: FreeCourses, evidence: FreeEvidence, latents: dict[str, Tensor]) -> None:
        self.model, self.evidence = model, evidence
        shapes = {name: latents[name].shape for name in evidence.loc}
        batch = torch.broadcast_shapes(*(s[: len(s) - evidence.loc[n].ndim] for n, s in shapes.items()))
        flat = [latents[n].reshape((*s[: len(s) - evidence.loc[n].ndim], -1)) for n, s in shapes.items()]
        self.numbers = torch.cat([values.expand((*batch, values.shape[-1])) for values in flat], -1)
        super().__init__(batch, torch.Size([3, evidence.points.shape[-1]]), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        if value is not self.evidence.points:
            raise InputError("lane courses score the tracks that their evidence was prepared from; prepare() others")
        data, nothing = evidence_arrays(self.model, self.evidence), (np.empty((0, 0)), np.empty(0))
        rows = self.numbers.detach().reshape(-1, self.numbers.shape[-1]).numpy()
        costs = [free_equations(np.ascontiguousarray(z), *data, *nothing) for z in rows]  # type: ignore[call-arg]
        constant = log_constant(self.model, self.evidence)
        return constant - torch.tensor(costs, dtype=torch.float64).reshape(self.batch_shape)
