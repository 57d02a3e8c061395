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

See models.intersection.course_nodes for the curve and models.intersection.course_kernel for the residuals. [M20]
fits one B-spline to every lane and ties neighbours on an arm together by their distance; here they share their arm.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from models.capability import Squares
from models.intersection.borders import BEYOND, FARTHEST, interior_radius
from models.intersection.course_kernel import centre_line, normal_equations
from models.intersection.course_nodes import ARM_WAVE, END, HEAD, INNER_WAVE, LOCAL, RIPPLED, WAVY
from models.intersection.routes import RoutedTracks
from models.program import InputError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
ARM_SITES = ("angle", "gap", "width", "bend", "shift", "onset")
PLAIN = ("centre", "lane_width", *ARM_SITES, "offset", "advance", "handle")
SITES = (*PLAIN, "inner_wave", "arm_wave", "lane_wave")
WIDTHS = {len(PLAIN): LOCAL, len(PLAIN) + 1: RIPPLED, len(SITES): WAVY}  # numbers of a lane, by how many sites


class CourseEvidence(NamedTuple):
    """Points of all tracks on routes, and what the structure says about the lanes.

    points       (3, N) x, y about the origin [m], heading [rad]
    offsets      (T + 1,) of the tracks
    tracks       indices of tracks, lane by lane; starts (L + 1,)
    connections  (L, 4) as in Routes
    stubs        (L, 2) which of the S driven lanes of arms each lane begins and ends on
    loc          {site: value}, the middle of each prior
    reach        (L, 2) distance from the centre to which each lane was driven on either arm [m]
    counts       (L, 3) nodes on the entry arm, pieces of the interior, nodes on the exit arm
    origin       (2,) [m]
    heading      whether headings were measured
    first        {site: value} where the structure itself is another than loc
    """

    points: Tensor
    offsets: Ints
    tracks: Ints
    starts: Ints
    connections: Ints
    stubs: Ints
    loc: dict[str, Array]
    reach: Array
    counts: Ints
    origin: Array
    heading: bool
    first: dict[str, Array]


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
    spacing: float = 1.0  # of the nodes [m]

    def __call__(self, evidence: CourseEvidence) -> None:
        latents = {}
        for name in SITES:
            loc, std = torch.from_numpy(evidence.loc[name]), getattr(self, f"{name}_std")
            latents[name] = pyro.sample(name, dist.Normal(loc, std).to_event(loc.dim())) if std > 0 else loc
        pyro.sample("points", PointsOnCourses(self, evidence, latents), obs=evidence.points)

    @property
    def sites(self) -> tuple[str, ...]:
        """The sites that lanes are computed from: waves only as far as any is latent, which is quicker."""
        return needed(name for name in SITES if getattr(self, f"{name}_std") > 0)

    def prepare(self, routed: RoutedTracks) -> CourseEvidence:
        """Evidence of this model. Raises InputError where no track is on a route."""
        return course_evidence(routed, self)

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
        scale = [np.full(part.stop - part.start, getattr(self, f"{name}_std")) for name, part in sites.items()]
        loc = np.concatenate([evidence.loc[name].reshape(-1) for name in sites])
        held = {name: value for name, value in evidence.loc.items() if name not in sites}
        whole = Layout(evidence, self.sites)
        index = np.concatenate([np.arange(whole.sites[name].start, whole.sites[name].stop) for name in sites])
        base = whole.pack(held | evidence.loc)
        data = evidence_arrays(self, evidence)
        slots = np.full(whole.size, -1)
        slots[index] = np.arange(len(index))
        evaluate = partial(_evaluate, base, index, (whole.where, slots[whole.where], *data))
        return Squares(loc, np.concatenate(scale), sites, shapes, evaluate, log_constant(self, evidence))


def needed(latent: Iterable[str]) -> tuple[str, ...]:
    """The sites that lanes are computed from where these are latent: the first ones, in blocks."""
    last = max((SITES.index(name) for name in latent), default=0)
    return SITES[: next(num for num in WIDTHS if num > last)]


class Layout:
    """Sites in one vector of numbers, constants included, and the part of it that each lane depends on."""

    def __init__(self, evidence: CourseEvidence, sites: tuple[str, ...]) -> None:
        sizes = [evidence.loc[name].size for name in sites]
        ends = np.cumsum([0, *sizes])
        self.size = int(ends[-1])
        self.sites = {name: slice(ends[i], ends[i + 1]) for i, name in enumerate(sites)}
        num = len(evidence.connections)
        self.where = np.zeros((num, WIDTHS[len(sites)]), np.int64)
        self.where[:, 1], self.where[:, 2] = 1, self.sites["lane_width"].start
        for end in range(2):
            first, arm = HEAD + END * end, evidence.connections[:, 2 * end]
            for field, name in enumerate(ARM_SITES):
                self.where[:, first + field] = self.sites[name].start + arm
            own = [self.sites["offset"].start + evidence.stubs[:, end]]
            own += [self.sites[name].start + 2 * np.arange(num) + end for name in ("advance", "handle")]
            self.where[:, first + len(ARM_SITES) : first + END] = np.stack(own, 1)
            if "arm_wave" in sites:
                first = RIPPLED + 2 * ARM_WAVE * end
                self.where[:, first : first + ARM_WAVE] = self._rows("arm_wave", arm, ARM_WAVE)
                first += ARM_WAVE
                self.where[:, first : first + ARM_WAVE] = self._rows("lane_wave", evidence.stubs[:, end], ARM_WAVE)
        if "inner_wave" in sites:
            self.where[:, LOCAL:RIPPLED] = self._rows("inner_wave", np.arange(num), INNER_WAVE)

    def _rows(self, name: str, rows: Ints, width: int) -> Ints:
        return np.asarray(self.sites[name].start + width * rows[:, None] + np.arange(width))

    def pack(self, latents: Mapping[str, Any]) -> Array:
        """{site: (*event)} to (D,)."""
        return np.concatenate([np.asarray(latents[name], dtype=np.float64).reshape(-1) for name in self.sites])


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


def _evaluate(base: Array, index: Ints, data: tuple[Any, ...], z: Array, hessian: Array, gradient: Array) -> float:
    """`normal_equations` in the numbers that are latent."""
    full = base.copy()
    full[index] = z
    return float(normal_equations(full, *data, hessian, gradient))  # type: ignore[call-arg]


class PointsOnCourses(TorchDistribution):
    """Points (3, N) about the courses of their lanes.

    Across its lane a point is normal; along it, it may be anywhere: a density of the lateral positions and headings
    given where along the lanes they are. It cannot simulate."""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.real, 2)

    def __init__(self, model: LaneCourses, evidence: CourseEvidence, latents: dict[str, Tensor]) -> None:
        self.model, self.evidence, self.layout = model, evidence, Layout(evidence, model.sites)
        events = {name: evidence.loc[name].ndim for name in self.layout.sites}
        latents = {name: latents[name] for name in events}
        batch = torch.broadcast_shapes(*(v.shape[: v.dim() - events[n]] for n, v in latents.items()))
        flat = [v.expand(batch + v.shape[v.dim() - events[n] :]).reshape((*batch, -1)) for n, v in latents.items()]
        self.numbers = torch.cat(flat, -1)
        super().__init__(batch, torch.Size([3, evidence.points.shape[-1]]), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        if value is not self.evidence.points:
            raise InputError("lane courses score the tracks that their evidence was prepared from; prepare() others")
        data, constant = evidence_arrays(self.model, self.evidence), log_constant(self.model, self.evidence)
        size = self.layout.size
        hessian, gradient = np.empty((0, 0)), np.empty(0)
        rows = self.numbers.detach().reshape(-1, size).numpy()
        rest = (self.layout.where, np.full_like(self.layout.where, -1), *data, hessian, gradient)
        costs = [normal_equations(z, *rest) for z in rows]  # type: ignore[call-arg]
        return constant - torch.tensor(costs, dtype=torch.float64).reshape(self.batch_shape)


def course_evidence(routed: RoutedTracks, model: LaneCourses) -> CourseEvidence:
    """Points about the estimated centre, sorted into lanes, with the priors' middles from the structure.

    Raises InputError where no track is on a route."""
    tracks, structure, (connections, track_route) = routed
    on_route = np.flatnonzero(track_route >= 0)
    if len(on_route) == 0:
        raise InputError("no track has both an entry and an exit lane; give tracks that cross the junction")
    order = on_route[np.argsort(track_route[on_route], kind="stable")]
    starts = np.searchsorted(track_route[order], np.arange(len(connections) + 1))
    origin = np.asarray(structure["centre"], dtype=np.float64)
    heading = np.zeros(len(tracks.points)) if tracks.heading is None else tracks.heading
    points = np.vstack([(tracks.points - origin).T, heading])
    ends = np.stack([connections[:, :2], connections[:, 2:]], 1)  # (L, 2, 2)
    keys = np.concatenate([np.insert(ends[:, e], 0, e, axis=1) for e in range(2)])
    stubs = np.unique(keys, axis=0, return_inverse=True)[1].reshape(2, -1).T
    loc = prior_middles(structure, connections, int(stubs.max()) + 1)
    reach = farthest(points, tracks.offsets, order, track_route, connections, loc["angle"])
    counts = node_counts(loc, connections, reach, model.spacing)
    table = (tracks.offsets.astype(np.int64), order, starts, connections.astype(np.int64), stubs.astype(np.int64))
    arms = slice(int(structure["num_arms"]))
    first = {"width": np.asarray(structure["width"], dtype=np.float64)[arms] - loc["lane_width"]}
    if "bend" in structure:
        first["bend"] = np.asarray(structure["bend"], dtype=np.float64)[arms]
    measured = tracks.heading is not None
    return CourseEvidence(torch.from_numpy(points), *table, loc, reach, counts, origin, measured, first)


def prior_middles(structure: Mapping[str, Any], connections: Ints, num_stubs: int) -> dict[str, Array]:
    """The middle of every prior: the structure's estimate; interiors begin where borders meet."""
    num = int(structure["num_arms"])
    field = lambda name: np.asarray(structure[name], dtype=np.float64)[:num]  # noqa: E731
    loc = {"centre": np.zeros(2), "angle": field("angle"), "gap": field("gap")}
    width = field("width")
    loc["lane_width"], loc["width"] = np.asarray(width.mean()), np.zeros(num)
    loc["bend"], loc["shift"] = np.zeros(num), field("shift") if "shift" in structure else np.zeros(num)
    left = loc["gap"] / 2 + field("entries") * width
    right = loc["gap"] / 2 + field("exits") * width
    loc["onset"] = interior_radius(loc["angle"], left, right)
    loc["offset"], loc["advance"] = np.zeros(num_stubs), np.zeros((len(connections), 2))
    loc["handle"] = np.ones((len(connections), 2))
    loc["arm_wave"], loc["lane_wave"] = np.zeros((num, ARM_WAVE)), np.zeros((num_stubs, ARM_WAVE))
    loc["inner_wave"] = np.zeros((len(connections), INNER_WAVE))
    return loc


def farthest(points: Array, offsets: Ints, order: Ints, track_route: Ints, connections: Ints, angle: Array) -> Array:
    """How far out on its entry and its exit arm each lane was driven, (L, 2) [m]."""
    reach = np.zeros((len(connections), 2))
    for end in range(2):
        outermost = offsets[order] if end == 0 else offsets[order + 1] - 1
        arm = angle[connections[track_route[order], 2 * end]]
        along = points[0, outermost] * np.cos(arm) + points[1, outermost] * np.sin(arm)
        np.maximum.at(reach[:, end], track_route[order], along)
    return np.maximum(reach, FARTHEST + 2 * BEYOND)


def node_counts(loc: dict[str, Array], connections: Ints, reach: Array, spacing: float) -> Ints:
    """Nodes of each lane, about `spacing` apart; fixed, so that the density does not jump."""
    onset = loc["onset"][connections[:, ::2]]
    arms = np.maximum(np.ceil((reach - onset) / spacing), 2)
    a, b = loc["angle"][connections[:, 0]], loc["angle"][connections[:, 2]]
    chord = np.hypot(
        onset[:, 1] * np.cos(b) - onset[:, 0] * np.cos(a), onset[:, 1] * np.sin(b) - onset[:, 0] * np.sin(a)
    )
    inside = np.maximum(np.ceil(1.2 * np.maximum(chord, 5.0) / spacing), 4)
    return np.stack([arms[:, 0], inside, arms[:, 1]], 1).astype(np.int64)


def centre_lines(evidence: CourseEvidence, latents: Mapping[str, Any]) -> list[Array]:
    """Centre lines of all lanes in driving order, L arrays (n, 2), for one state {site: (*event)}."""
    return [nodes[:, :2] + evidence.origin for nodes in lane_nodes(evidence, latents)]


def layout_of(evidence: CourseEvidence, latents: Mapping[str, Any]) -> Layout:
    """The layout of a state, with the waves it has."""
    return Layout(evidence, needed(name for name in SITES if name in latents))


def lane_nodes(evidence: CourseEvidence, latents: Mapping[str, Any]) -> list[Array]:
    """Nodes of all lanes, see `course_nodes`."""
    layout = layout_of(evidence, latents)
    z = layout.pack(evidence.loc | dict(latents))
    lanes, out = np.ascontiguousarray(evidence.connections[:, 1::2]), []
    for lane, counts in enumerate(evidence.counts):
        nodes = np.empty((counts.sum() + 1, 5 + layout.where.shape[1]))
        centre_line(z[layout.where[lane]], lanes[lane], evidence.reach[lane], counts, nodes)
        out.append(nodes)
    return out


def lane_bands(
    evidence: CourseEvidence, estimate: Mapping[str, Any], draws: Mapping[str, Array], level: float
) -> tuple[list[Array], list[Array]]:
    """How far left and right of the estimate's centre lines the draws' lines lie, L arrays (n,) each [m].

    draws  {site: (D, *event)}, equally weighted; displacements are linear in what separates a draw from the
    estimate. Between the two edges lies the share `level` of the draws at each point, half of the rest on either
    side."""
    layout = layout_of(evidence, estimate)
    here = layout.pack(evidence.loc | dict(estimate))
    num = len(next(iter(draws.values())))
    there = [draws.get(n, np.broadcast_to(evidence.loc[n], (num, *evidence.loc[n].shape))) for n in layout.sites]
    apart = np.concatenate([values.reshape(num, -1) for values in there], 1) - here
    left, right = [], []
    for nodes, index in zip(lane_nodes(evidence, estimate), layout.where, strict=True):
        across = nodes[:, 5:] @ apart[:, index].T  # (n, D)
        low, high = np.quantile(across, [0.5 - level / 2, 0.5 + level / 2], axis=1)
        left.append(high)
        right.append(-low)
    return left, right
