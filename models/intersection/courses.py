"""The course of every lane across an intersection of known structure, [M20] section IV and beyond.

The structure tells which arms there are and which lanes the tracks drove. Arms, interiors and lanes are then
estimated together from all points, with normal priors about what the structure says:

    centre, angle, gap, bend, shift   of the arms, as in `Junction`
    lane_width   () that arms have in common; width (K,) what an arm's lanes are wider [m]
    onset    (K,) distance from the centre where the interior begins on an arm [m]
    offset   (S,) of a lane of an arm across it [m], S lanes that were driven
    advance  (L, 2) of a lane's own onset before the arm's, at its entry and its exit [m]
    handle   (L, 2) lengths of its Bezier handles over those of a circular arc
    arm_wave (K, .), lane_wave (S, .), inner_wave (L, .)   control points across an arm, a lane of an arm and an
             interior [m]: what real lanes do besides

Points on the borders of lanes, where any were seen, are a cue of their own (models.intersection.course_borders).

See models.intersection.course_nodes for the curve and models.intersection.course_kernel for the residuals. [M20]
fits one B-spline to every lane and ties neighbours on an arm together by their distance; here they share their arm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
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
from models.intersection.course_borders import PointsOnBorders, border_arrays, border_equations, log_border_constant
from models.intersection.course_evidence import CourseEvidence, course_evidence
from models.intersection.course_kernel import normal_equations
from models.intersection.course_lines import SITES, Layout, needed
from models.intersection.routes import RoutedTracks
from models.program import InputError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class LaneCourses:
    """Standard deviations of the priors and of the measurements; 0 makes a constant of a site."""

    centre_std: float = 1.0  # [m]
    lane_width_std: float = 0.3  # [m]
    angle_std: float = 0.03  # [rad]
    gap_std: float = 0.3  # [m]
    width_std: float = 0.01  # [m]
    bend_std: float = 0.00003  # [1/m]
    shift_std: float = 0.0  # [m]
    onset_std: float = 4.0  # [m]
    offset_std: float = 0.0  # [m]
    advance_std: float = 0.5  # [m]
    handle_std: float = 0.15
    arm_wave_std: float = 0.0  # [m]
    lane_wave_std: float = 0.0  # [m]
    inner_wave_std: float = 0.15  # [m]
    position_std: float = 1.0  # of a point, on each axis [m]
    heading_std: float = 0.1  # of a measured heading [rad]
    border_std: float = 0.2  # of a point on a border of a lane, on each axis [m]
    spacing: float = 1.0  # of the nodes [m]

    def __post_init__(self) -> None:
        for name in (*(f"{site}_std" for site in SITES), "position_std", "heading_std", "border_std", "spacing"):
            value, may_be_zero = getattr(self, name), name.removesuffix("_std") in SITES
            if not math.isfinite(value) or value < 0 or (value == 0 and not may_be_zero):
                least = "zero or positive" if may_be_zero else "positive"
                raise InputError(f"{name} must be finite and {least}, but is {value}")

    def __call__(self, evidence: CourseEvidence) -> None:
        latents = {}
        for name in SITES:
            loc, std = torch.from_numpy(evidence.loc[name]), getattr(self, f"{name}_std")
            latents[name] = pyro.sample(name, dist.Normal(loc, std).to_event(loc.dim())) if std > 0 else loc
        layout = Layout(evidence, self.sites)
        numbers = in_one_row(evidence, layout, latents)
        pyro.sample("points", PointsOnCourses(self, evidence, layout, numbers), obs=evidence.points)
        if evidence.borders is not None:
            on_borders = PointsOnBorders(evidence.borders, self.border_std, numbers, layout.sides)
            pyro.sample("borders", on_borders, obs=evidence.borders.points)

    @property
    def sites(self) -> tuple[str, ...]:
        """The sites that lanes are computed from: waves only as far as any is latent, which is quicker."""
        return needed(name for name in SITES if getattr(self, f"{name}_std") > 0)

    def prepare(self, routed: RoutedTracks) -> CourseEvidence:
        """Evidence of this model. Raises InputError where no track is on a route."""
        return course_evidence(routed, self.spacing)

    def start(self, evidence: CourseEvidence) -> dict[str, Array]:
        """A first state: widths and bends of the structure as far as the prior likes them, all else at its middle."""
        near = {n: np.clip(v, *(getattr(self, f"{n}_std") * np.array([-2.0, 2.0]))) for n, v in evidence.first.items()}
        return {n: near.get(n, evidence.loc[n]) for n in SITES if getattr(self, f"{n}_std") > 0}

    def squares(self, evidence: CourseEvidence) -> Squares:
        """The same density as a compiled sum of squares."""
        sites, shapes, end = {}, {}, 0
        for name in SITES:
            if getattr(self, f"{name}_std") > 0:
                shapes[name] = evidence.loc[name].shape
                sites[name] = slice(end, end + evidence.loc[name].size)
                end = sites[name].stop
        stds = [np.full(part.stop - part.start, getattr(self, f"{name}_std")) for name, part in sites.items()]
        loc, scale = np.concatenate([evidence.loc[name].reshape(-1) for name in sites]), np.concatenate(stds)
        whole = Layout(evidence, self.sites)
        index = np.concatenate([np.arange(whole.sites[name].start, whole.sites[name].stop) for name in sites])
        base = whole.pack(evidence.loc)
        slots = np.full(whole.size + 1, -1)  # the last one for rows without a number
        slots[index] = np.arange(len(index))
        latent = np.flatnonzero(slots[whole.where[0]] >= 0)  # the same numbers of all lanes
        blocks = np.ascontiguousarray(slots[whole.where[:, latent]])
        data, marks = (whole.where, latent, blocks, *evidence_arrays(self, evidence)), None
        log_const = log_constant(self, evidence)
        if evidence.borders is not None:
            beside = np.ascontiguousarray(slots[whole.sides[:, latent]])
            marks = (whole.sides, latent, beside, *border_arrays(evidence.borders, self.border_std))
            log_const += log_border_constant(evidence.borders, self.border_std)
            blocks = np.concatenate([blocks, beside])
        evaluate = partial(_evaluate, base, index, data, marks)
        return Squares(loc, scale, sites, shapes, evaluate, log_const, blocks=blocks)


def evidence_arrays(model: LaneCourses, evidence: CourseEvidence) -> tuple[Any, ...]:
    """What `normal_equations` reads besides the numbers."""
    noise = np.array([model.position_std, model.heading_std if evidence.heading else np.inf])
    points = np.ascontiguousarray(evidence.points.numpy())
    lanes = np.ascontiguousarray(evidence.connections[:, 1::2])
    tables = (evidence.tracks, evidence.starts, evidence.offsets)
    return (lanes, evidence.reach, evidence.counts, *tables, points, noise)


def log_constant(model: LaneCourses, evidence: CourseEvidence) -> float:
    """log p(points | courses) plus the cost: normalisers of the lateral and of the heading residuals."""
    num = int(np.diff(evidence.offsets)[evidence.tracks].sum())
    each = -math.log(model.position_std) - 0.5 * math.log(2 * math.pi)
    if evidence.heading:
        each += -math.log(model.heading_std) - 0.5 * math.log(2 * math.pi)
    return num * each


def _evaluate(
    base: Array,
    index: Ints,
    data: tuple[Any, ...],
    marks: tuple[Any, ...] | None,
    z: Array,
    hessian: Array,
    gradient: Array,
) -> float:
    """`normal_equations` in the numbers that are latent; `border_equations` in the blocks behind those of the lanes."""
    full, lanes = base.copy(), len(data[0])
    full[index] = z
    cost = normal_equations(full, *data, hessian[:lanes], gradient)  # type: ignore[call-arg]
    if marks is not None:
        cost += border_equations(full, *marks, hessian[lanes:], gradient)  # type: ignore[call-arg]
    return float(cost)


def in_one_row(evidence: CourseEvidence, layout: Layout, latents: dict[str, Tensor]) -> Tensor:
    """{site: (*batch or nothing, *event)} as the numbers (*batch, D') of a layout."""
    events = {name: evidence.loc[name].ndim for name in layout.sites}
    values = {name: latents[name] for name in events}
    batch = torch.broadcast_shapes(*(v.shape[: v.dim() - events[n]] for n, v in values.items()))
    flat = [v.expand(batch + v.shape[v.dim() - events[n] :]).reshape((*batch, -1)) for n, v in values.items()]
    return torch.cat(flat, -1)


class PointsOnCourses(TorchDistribution):
    """Points (3, N) about the courses of their lanes.

    Across its lane a point is normal; along it, it may be anywhere: a density of the lateral positions and headings
    given where along the lanes they are. It cannot simulate.

    numbers  (*batch, D') of the layout"""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.real, 2)

    def __init__(self, model: LaneCourses, evidence: CourseEvidence, layout: Layout, numbers: Tensor) -> None:
        self.model, self.evidence, self.layout, self.numbers = model, evidence, layout, numbers
        super().__init__(numbers.shape[:-1], torch.Size([3, evidence.points.shape[-1]]), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        if value is not self.evidence.points:
            raise InputError("lane courses score the tracks that their evidence was prepared from; prepare() others")
        data, constant = evidence_arrays(self.model, self.evidence), log_constant(self.model, self.evidence)
        size = self.layout.size
        lanes, none = len(self.layout.where), np.zeros(0, np.int64)
        hessian, gradient = np.empty((lanes, 0, 0)), np.empty(0)
        rows = self.numbers.detach().reshape(-1, size).numpy()
        rest = (self.layout.where, none, np.empty((lanes, 0), np.int64), *data, hessian, gradient)
        costs = [normal_equations(z, *rest) for z in rows]  # type: ignore[call-arg]
        return constant - torch.tensor(costs, dtype=torch.float64).reshape(self.batch_shape)
