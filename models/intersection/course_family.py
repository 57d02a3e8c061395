"""Lane courses of either family: what evidence of which model it is, lines and displacements.

LaneCourses  arms with lanes of a width, and interiors that join them; few numbers
FreeCourses  every lane a curve of its own, sharing what it shares with others; many numbers
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.intersection import course_lines, free_lines
from models.intersection.course_evidence import CourseEvidence
from models.intersection.courses import LaneCourses
from models.intersection.free_courses import FreeCourses
from models.intersection.free_evidence import FreeEvidence

Array = NDArray[np.float64]
Courses = LaneCourses | FreeCourses
AnyEvidence = CourseEvidence | FreeEvidence


def centre_lines(evidence: AnyEvidence, latents: Mapping[str, Any]) -> list[Array]:
    """Centre lines of all lanes in driving order, L arrays (n, 2), for one state {site: (*event)}."""
    if isinstance(evidence, FreeEvidence):
        return free_lines.centre_lines(evidence, latents)
    return course_lines.centre_lines(evidence, latents)


def lane_displacements(evidence: AnyEvidence, estimate: Mapping[str, Any], draws: Mapping[str, Array]) -> list[Array]:
    """How far to the left of the estimate's centre lines the draws' lines lie, L arrays (n, D) [m]."""
    if isinstance(evidence, FreeEvidence):
        return free_lines.lane_displacements(evidence, estimate, draws)
    return course_lines.lane_displacements(evidence, estimate, draws)
