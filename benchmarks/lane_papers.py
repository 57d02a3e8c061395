"""The papers' own ways from routed tracks to centre lines, timed, for comparison with ours."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from inference import rjmcmc
from inference.squares import minimise
from models.intersection import offset_courses, spline_courses
from models.intersection.routes import RoutedTracks

Lines = list[NDArray[np.float64]]
ITERATIONS = 10  # of either stage, [M20] section IV-D
TOLERANCE = 1e-6  # [nats]: the first stage is linear and ends early
STEPS, WARMUP, THIN = 50_000, 20_000, 10  # about as long as [M19] took


def m20_refine(routed: RoutedTracks) -> tuple[Lines, float]:
    """B-splines of [M20]: 10 iterations with the points alone, 10 with neighbours too. Returns lines and seconds.

    Raises InputError where no track is on a route."""
    began, model = time.perf_counter(), spline_courses.SplineCourses()
    evidence = model.prepare(routed)
    x = np.zeros(evidence.first.size)
    for stage in spline_courses.stages(model):
        squares = stage.squares(evidence)
        x = minimise(squares, x, num_steps=ITERATIONS, damping=1e-3, tolerance=TOLERANCE).state.x
    lines = spline_courses.centre_lines(evidence, squares.unpack(squares.loc + squares.scale * x))
    return lines, time.perf_counter() - began


def m19_refine(routed: RoutedTracks, seed: int) -> tuple[Lines, float]:
    """Polylines of [M19]: a chain of single-site steps, whose mean after the warm-up is the estimate.

    Returns lines and seconds. Raises InputError where no track is on a route."""
    began, model = time.perf_counter(), offset_courses.OffsetCourses()
    evidence = model.prepare(routed)
    knobs = {"num_chains": 1, "num_steps": STEPS, "warmup": WARMUP, "thin": THIN}
    posterior = rjmcmc.run(model, evidence, seed=seed, start="data", **knobs)
    return offset_courses.centre_lines(evidence, {"offsets": posterior.mean("offsets")}), time.perf_counter() - began
