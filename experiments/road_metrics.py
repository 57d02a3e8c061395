"""How far an estimated road course runs from the true one, and how far ahead it may be trusted.

Everything is measured at points of the true course, `RANGES` metres from the car. A tube is a half width that grows
with the range r; a course is inside it where no point of the truth is farther from it than that:

    tight .4 + .006 r    mid .6 + .010 r    wide .8 + .015 r   [m]

[T17] section 3 counts an estimate wholly inside its labelled tube as a true positive and any other as a false positive;
it gives no widths, these are ours. Knowing how far to trust an estimate is part of estimating: with P(r) the posterior
probability of being inside the mid tube all the way to r, the calibrated range is

    argmax r - PRICE (1 - P(r))   among r with P(r) >= CUT

A cut alone is worse: it takes as much risk for the last metres of a range as for the first. An estimate whose
calibrated range is below `LEAST_RANGE` abstains, a third outcome. Denominators are all scenes. What other cuts and
prices do shows `python -m benchmarks.road_cut`, on seeds that no figure counts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.scene import Scene
from inference.posterior import Posterior
from models.clothoid_kernel import BEND, COLUMNS, COS, HEADING, LENGTH, SIN, X, Y, hermite_one, sample_one
from models.road.cue_kernel import nearest_sample
from models.road.segment_kernel import road_samples

Floats = NDArray[np.float64]

RANGES = np.arange(5.0, 141.0, 5.0)  # [m]
TOLD = (40.0, 80.0, 140.0)  # ranges whose errors are reported [m]
TUBES = {"tight": (0.4, 0.006), "mid": (0.6, 0.010), "wide": (0.8, 0.015)}
CUT = 0.8
PRICE = 250.0  # of a false course [m]
BAND = (0.05, 0.95)  # quantiles
LEAST_RANGE = 40.0  # [m]
SAMPLES = 41  # of a road, about four metres apart
LAID = 160.0  # of a road that has no end of its own [m]


class RoadCheck(NamedTuple):
    """One estimate against the truth, at R ranges.

    error     (R,) of the truth to the left of the estimated course [m]
    spread    (R,) posterior standard deviation of that [m]
    covered   (R,) whether the truth is inside the central 90 % of the draws
    reach     calibrated range [m]; 0 where even the first point is not trusted
    """

    error: Floats
    spread: Floats
    covered: NDArray[np.bool_]
    reach: float

    def inside(self, tube: str, farthest: float = RANGES[-1]) -> bool:
        """Whether the estimate is in the tube at every range up to `farthest`."""
        return bool((np.abs(self.error) <= half_width(tube))[RANGES <= farthest].all())

    @property
    def outcome(self) -> str:
        """'true' or 'false' up to the calibrated range, in the mid tube; 'none' for an abstention."""
        if self.reach < LEAST_RANGE:
            return "none"
        return "true" if self.inside("mid", self.reach) else "false"

    def at(self, distance: float) -> int:
        """Index of a range."""
        return int(np.flatnonzero(RANGES == distance)[0])


def half_width(tube: str) -> Floats:
    """Half width of a tube at RANGES, (R,) [m]."""
    near, growth = TUBES[tube]
    return near + growth * RANGES


class Roads(NamedTuple):
    """Samples of roads at equal steps of arc length, whatever model they are of.

    table  (D, SAMPLES, 7): x, y, heading, its cosine and sine, curvature, arc length
    step   (D,) [m], inf where there is no road
    """

    table: Floats
    step: Floats


def check_course(posterior: Posterior, line: Floats, num_draws: int = 1000) -> RoadCheck:
    """The estimated road against a true line (M, 3), or (M, 2), that begins behind the car.

    num_draws  of the posterior that spread, coverage and range are counted from"""
    roads, estimate, truth = drawn_roads(posterior, num_draws), estimated_road(posterior, num_draws), at_ranges(line)
    error = offsets_from(estimate, truth)[0]
    offsets = offsets_from(roads, np.concatenate([truth, road_points(estimate)]))
    there, apart = np.split(offsets, 2, axis=1)
    low, high = np.quantile(there, BAND, axis=0)
    return RoadCheck(error, there.std(0), (low <= 0.0) & (high >= 0.0), trusted_range(apart))


def has_road(posterior: Posterior) -> bool:
    """Whether the draws are roads: of one clothoid by its ends (`course`), or of pieces (`knot_curvature`)."""
    return "course" in posterior.draws or "knot_curvature" in posterior.draws


def drawn_roads(posterior: Posterior, num_draws: int = 1000) -> Roads:
    """Equally weighted draws, at most `num_draws` of them."""
    if "course" in posterior.draws:
        return lay_courses(drawn_courses(posterior, num_draws))
    return lay_draws(posterior.resample(num_draws, 0))


def estimated_road(posterior: Posterior, num_draws: int = 1000) -> Roads:
    """One road: the clothoid of the mean numbers (start, curvature, rate, length) where the draws have a `course`; else
    the mean of drawn roads, sample by sample, for numbers of roads with different knots have no mean that is a road.

    The mean of `course` itself would lie inside its bend: cues say little of where the road ends, so that draws end
    here and there along it."""
    if "course" in posterior.draws:
        return lay_mean(posterior)
    roads = drawn_roads(posterior, num_draws)
    table = roads.table.mean(0)
    table[:, COS], table[:, SIN] = np.cos(table[:, HEADING]), np.sin(table[:, HEADING])
    return Roads(table[None], roads.step[:1])


def lay_mean(posterior: Posterior) -> Roads:
    """The clothoid whose numbers are the means of those of the drawn courses, unless no draw has any."""
    numbers = fitted(np.ascontiguousarray(posterior.draws["course"].reshape(-1, 6)))
    there = np.isfinite(numbers[:, LENGTH])
    share = posterior.weights.reshape(-1) * there
    if not share.sum() > 0.0:
        return lay_courses(posterior.mean("course")[None])
    roads = Roads(np.empty((1, SAMPLES, COLUMNS)), np.empty(1))
    mean = share[there] @ numbers[there] / share.sum()
    roads.step[0] = sample_one(mean, roads.table[0])  # type: ignore[call-arg]
    return roads


@nb.njit(cache=True)
def fitted(courses: Floats) -> Floats:
    """Numbers of the clothoids of courses (D, 6), (D, 6); length inf where none joins the ends."""
    out = np.empty(courses.shape)
    for d in range(len(courses)):
        c = courses[d]
        hermite_one(c[0], c[1], c[2], c[3], c[4], c[5], out[d])
    return out


def lay_courses(courses: Floats) -> Roads:
    """Courses (D, 6), by their ends."""
    roads = Roads(np.empty((len(courses), SAMPLES, COLUMNS)), np.empty(len(courses)))
    clothoid = np.empty(6)
    for d, course in enumerate(courses):
        roads.step[d] = lay(course, clothoid, roads.table[d])
    return roads


def lay_draws(draws: dict[str, Floats]) -> Roads:
    """Draws of models.road.segments.SegmentedRoad, {site: (D, *event)}, laid to LAID."""
    table = road_samples(draws, LAID, SAMPLES)
    return Roads(table, np.full(len(table), LAID / (SAMPLES - 1)))


def drawn_courses(posterior: Posterior, num_draws: int = 1000) -> Floats:
    """Equally weighted draws of `course`, at most `num_draws` of them, (D, 6)."""
    courses = posterior.draws["course"].reshape(-1, 6)
    if posterior.log_weights is None and len(courses) <= num_draws:
        return courses
    return posterior.resample(num_draws, 0)["course"]


def trusted_range(apart: Floats, cut: float = CUT, price: float = PRICE) -> float:
    """Calibrated range [m] from how far points of the estimate at RANGES are from drawn courses, (D, R) [m]."""
    stayed = np.logical_and.accumulate(np.abs(apart) <= half_width("mid"), axis=1).mean(0)
    worth = np.where(stayed >= cut, RANGES - price * (1.0 - stayed), -np.inf)
    return float(RANGES[worth.argmax()]) if stayed[0] >= cut else 0.0  # the share falls with the range


def at_ranges(line: Floats) -> Floats:
    """Points (R, 2) of a line (M, 2 or 3) at RANGES from the car, counted ahead of it."""
    distance = np.hypot(line[:, 0], line[:, 1]) * np.sign(line[:, 0])
    return np.stack([np.interp(RANGES, distance, line[:, axis]) for axis in range(2)], -1)


def road_points(road: Roads) -> Floats:
    """Points (R, 2) of the first of roads at RANGES."""
    return at_ranges(road.table[0][:, [X, Y]])


def course_points(course: Floats) -> Floats:
    """Points (R, 2) of a course (6,) at RANGES."""
    return road_points(lay_courses(course[None]))


@nb.njit(cache=True)
def lay(course: Floats, clothoid: Floats, table: Floats) -> float:
    """Samples of a course (6,) into a table; returns their step [m], inf where no clothoid joins its ends."""
    hermite_one(course[0], course[1], course[2], course[3], course[4], course[5], clothoid)
    return sample_one(clothoid, table) if clothoid[LENGTH] < np.inf else np.inf


def lateral_offsets(courses: Floats, points: Floats) -> Floats:
    """How far left of courses (D, 6) points (R, 2) are, (D, R) [m]; inf where no clothoid joins the ends."""
    return offsets_from(lay_courses(courses), points)


def offsets_from(roads: Roads, points: Floats) -> Floats:
    """How far left of roads points (R, 2) are, (D, R) [m]; inf where there is no road.

    The parabola through the nearest sample stands for the road: exact to .1 mm on any road of the prior."""
    out = np.empty((len(roads.table), len(points)))
    lateral(roads.table, roads.step, points, out)  # type: ignore[call-arg]
    return out


@nb.njit(cache=True)
def lateral(tables: Floats, steps: Floats, points: Floats, out: Floats) -> None:
    """`offsets_from` into out (D, R)."""
    for d in range(len(tables)):
        table, step = tables[d], steps[d]
        for r in range(len(points)):
            if step == np.inf:
                out[d, r] = np.inf
                continue
            k = nearest_sample(points, r, table, step)
            dx, dy = points[r, 0] - table[k, X], points[r, 1] - table[k, Y]
            along, across = dx * table[k, COS] + dy * table[k, SIN], dy * table[k, COS] - dx * table[k, SIN]
            out[d, r] = across - 0.5 * table[k, BEND] * along**2


def metrics(posterior: Posterior, scene: Scene) -> dict[str, float]:
    """`check_course` of a posterior of roads, for the report; nothing without a true line.

    error_40_m    distance of the true course from the estimate 40 m ahead
    error_80_m    the same 80 m ahead
    error_140_m   the same 140 m ahead
    spread_40_m   posterior standard deviation of that distance 40 m ahead
    spread_80_m   the same 80 m ahead
    spread_140_m  the same 140 m ahead
    covered_40    1 where the 90 % band holds the truth 40 m ahead, else 0
    covered_80    the same 80 m ahead
    covered_140   the same 140 m ahead
    inside_tight  1 where the estimate is nearer to the truth than .4 m + .006 r at all ranges r to 140 m, else 0
    inside_mid    the same, .6 m + .010 r: the mid tube
    inside_wide   the same, .8 m + .015 r: the wide tube
    range_m       calibrated range: how far the estimate is to be trusted to stay inside the mid tube; 0 for not at all
    trusted_true  1 where it does stay inside up to its calibrated range, 0 where not, none where nothing is offered
    coverage      share of the ranges where the 90 % band holds the truth
    """
    if scene.truth is None or not has_road(posterior):
        return {}
    found = check_course(posterior, scene.truth["line"])
    out: dict[str, float] = {}
    for distance in TOLD:
        i = found.at(distance)
        out |= {f"error_{distance:.0f}_m": abs(found.error[i]), f"spread_{distance:.0f}_m": found.spread[i]}
        out |= {f"covered_{distance:.0f}": float(found.covered[i])}
    out |= {f"inside_{tube}": float(found.inside(tube)) for tube in TUBES}
    right = {"true": 1.0, "false": 0.0, "none": math.nan}[found.outcome]
    return out | {"range_m": found.reach, "trusted_true": right, "coverage": float(found.covered.mean())}


def label_free(posterior: Posterior) -> dict[str, Floats]:
    """Where the drawn roads are, across the estimated one at 40, 80 and 140 m, for the diagnostics of roads of pieces:
    knots have no order. (chain, draw) each [m]; nothing for draws that are no roads."""
    if not has_road(posterior):
        return {}
    num = int(np.prod(posterior.shape))
    flat = {site: values.reshape(num, *values.shape[2:]) for site, values in posterior.draws.items()}
    roads = lay_courses(flat["course"]) if "course" in flat else lay_draws(flat)
    left = -offsets_from(roads, road_points(estimated_road(posterior)))
    return {f"left_{r:.0f}_m": left[:, RANGES == r].reshape(posterior.shape) for r in TOLD}
