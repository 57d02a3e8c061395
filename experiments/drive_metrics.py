"""Scores and pictures of a road course that is followed over the frames of a drive.

Each frame is measured by itself, as in experiments.road_metrics: draws of a frame are given the frames up to it."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.junction_figures import INK
from experiments.metrics import known
from experiments.road_figures import ESTIMATE, FAINT, TRUTH, road
from experiments.road_metrics import (
    BAND,
    TOLD,
    RoadCheck,
    at_ranges,
    check_course,
    drawn_courses,
    lateral_offsets,
)
from experiments.scenarios.scene import Scene
from inference.posterior import Posterior
from models.road.drive import RoadDrive

Floats = NDArray[np.float64]
SHOWN = 80.0  # the range whose error is drawn over the frames [m]


def in_frame(posterior: Posterior, frame: int) -> Posterior:
    """The course of one frame."""
    return Posterior({"course": posterior.draws["course"][:, :, frame]}, posterior.log_weights)


def check_frames(posterior: Posterior, lines: Floats) -> list[RoadCheck]:
    """Every frame against its true line, lines (F, M, 3)."""
    return [check_course(in_frame(posterior, frame), line) for frame, line in enumerate(lines)]


def metrics(posterior: Posterior, scene: Scene) -> dict[str, float]:
    """Means over the frames of a drive; nothing without a course in each, and a true one.

    error_40_m ..       distance of the true course from the estimate at 40, 80 and 140 m
    spread_40_m ..      its posterior standard deviation
    covered_40 ..       share of the frames whose 90 % band holds the truth there
    first_80_m, last_80_m   error in the first and in the last frame
    range_m             calibrated range
    """
    if not is_followed(posterior, scene) or "lines" not in known(scene):
        return {}
    found = check_frames(posterior, known(scene)["lines"])
    out: dict[str, float] = {}
    for distance in TOLD:
        i, name = found[0].at(distance), f"{distance:.0f}"
        out[f"error_{name}_m"] = float(np.mean([abs(check.error[i]) for check in found]))
        out[f"spread_{name}_m"] = float(np.mean([check.spread[i] for check in found]))
        out[f"covered_{name}"] = float(np.mean([check.covered[i] for check in found]))
    middle = found[0].at(SHOWN)
    out |= {"first_80_m": abs(float(found[0].error[middle])), "last_80_m": abs(float(found[-1].error[middle]))}
    return out | {"range_m": float(np.mean([check.reach for check in found]))}


def figures(posterior: Posterior, scene: Scene) -> dict[str, Figure]:
    """The last frame from above, and the error over the frames; nothing without a course in each."""
    if not is_followed(posterior, scene):
        return {}
    lines, last = known(scene).get("lines"), len(scene.data.cues) - 1
    truth = {} if lines is None else {"line": lines[-1]}
    drawn = {
        "road": road(in_frame(posterior, last), Scene(scene.data.cues[-1], truth, f"{scene.name}, last frame", {}))
    }
    return drawn if lines is None else drawn | {"frames": over_frames(posterior, lines)}


def over_frames(posterior: Posterior, lines: Floats) -> Figure:
    """How far left of the estimate the truth is at 80 m, with the 90 % band of the draws."""
    error, bands = list[float](), list[Floats]()
    for frame, line in enumerate(lines):
        each = in_frame(posterior, frame)
        check, there = check_course(each, line), at_ranges(line)
        offsets = lateral_offsets(drawn_courses(each), there)[:, check.at(SHOWN)]
        error.append(float(check.error[check.at(SHOWN)]))
        bands.append(error[-1] - np.quantile(offsets, BAND[::-1]))
    figure, number = Figure(figsize=(8.0, 3.2), layout="constrained"), np.arange(len(lines))
    axes = figure.subplots()
    axes.fill_between(number, *np.array(bands).T, color=ESTIMATE, alpha=0.25, lw=0, label="90 % band")
    axes.axhline(0.0, color=ESTIMATE, lw=1.6, label="estimate")
    axes.plot(number, error, ls=(0, (5, 3)), marker="o", ms=3, lw=1.1, color=TRUTH, label="true course")
    axes.set(xlabel="frame", ylabel=f"left of the estimate at {SHOWN:.0f} m [m]")
    axes.set_title("each frame, given the frames so far", loc="left", color=INK, fontsize=11)
    axes.grid(color=FAINT, lw=0.4)
    axes.legend(frameon=False, fontsize=9)
    return figure


def is_followed(posterior: Posterior, scene: Scene) -> bool:
    """Whether there is a course in every frame of a drive."""
    if not isinstance(scene.data, RoadDrive) or "course" not in posterior.draws:
        return False
    return posterior.draws["course"].shape[2:] == (len(scene.data.cues), 6)
