"""The road courses of several engines on one scene, beside one another."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from experiments.metrics import known
from experiments.road_figures import ESTIMATE, TRUTH
from experiments.road_metrics import (
    BAND,
    RANGES,
    TUBES,
    at_ranges,
    course_points,
    drawn_courses,
    half_width,
    lateral_offsets,
    trusted_range,
)
from experiments.scenarios.scene import Scene
from inference.posterior import Posterior

LIMIT = 1.5  # times the half width of the wide tube that is drawn


def figures(posteriors: dict[str, Posterior], scene: Scene) -> dict[str, Figure]:
    """Across the road, a panel for each engine: estimate and 90 % band to the left of the true course, else of the
    first engine's estimate, by the distance from the car. Nothing without a road course."""
    courses = {engine: one for engine, one in posteriors.items() if "course" in one.draws}
    if not courses:
        return {}
    line = known(scene).get("line")
    zero = at_ranges(line) if line is not None else course_points(next(iter(courses.values())).mean("course"))
    figure = Figure(figsize=(10.5, 0.8 + 1.5 * len(courses)), layout="constrained")
    panels = figure.subplots(len(courses), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, (engine, posterior) in zip(panels, courses.items(), strict=True):
        draws, mean = drawn_courses(posterior), posterior.mean("course")
        low, high = np.quantile(-lateral_offsets(draws, zero), BAND, axis=0)
        reach = trusted_range(lateral_offsets(draws, course_points(mean)))
        axes.fill_between(RANGES, low, high, color=ESTIMATE, alpha=0.25, lw=0, label="90 % band")
        axes.plot(RANGES, -lateral_offsets(mean[None], zero)[0], color=ESTIMATE, lw=2.0, label="estimate")
        for name, style in (("mid", "-"), ("wide", "--")):
            width, (near, growth) = half_width(name), TUBES[name]
            axes.plot(RANGES, width, color="#9aa3ab", lw=0.9, ls=style, label=f"{name} tube, {near:g} + {growth:g} r")
            axes.plot(RANGES, -width, color="#9aa3ab", lw=0.9, ls=style)
        axes.axhline(0.0, color=TRUTH, lw=1.0, ls=(0, (5, 3)), label="true course" if line is not None else None)
        if reach:
            axes.axvline(reach, color=ESTIMATE, lw=0.9, ls="-.", label="calibrated range")
        axes.set_title(f"{engine}, on {scene.name}", loc="left", fontsize=10)
    most = LIMIT * half_width("wide")[-1]
    panels[-1].set(xlabel="distance from the car [m]", ylim=(-most, most))
    of = "the true course" if line is not None else f"{next(iter(courses))}'s estimate"
    figure.supylabel(f"left of {of} [m]", fontsize=10)
    panels[0].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=9)
    return {"courses": figure}
