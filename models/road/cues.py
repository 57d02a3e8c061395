"""Scene cues: what a camera, a radar or a lidar sees that follows the course of a road.

A cue stands or drives beside the course f(l) at an offset o along the normal n, [T17] section 2.1 and 2.2:

    position = f(l) + (o + e) n(l) + noise,    e ~ N(0, std^2 / confidence),  noise ~ N(0, covariance)

A kind of cue is data, not code: its offset to the left and to the right, how far single ones stray from their row, and
whether they move. A new sensor is one more CueKind. The course is the middle of the lane that the car drives on;
traffic keeps right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.program import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class CueKind:
    """One kind of cue. Offsets are priors (mean, standard deviation), positive to the left [m].

    Cues that stand share one offset per side. Cues that move have one each: `right` is traffic that drives as we do,
    `left` is oncoming traffic. [T17] gives no numbers, these are ours."""

    name: str
    right: tuple[float, float]
    left: tuple[float, float]
    std: float  # of a single cue across the road about its offset, confidence 1 [m]
    flow_std: float | None = None  # of the direction of motion about the course [rad]; None: it stands

    def __post_init__(self) -> None:
        for what, std in (("right", self.right[1]), ("left", self.left[1]), ("std", self.std)):
            if not math.isfinite(std) or std <= 0:
                raise InputError(f"{what} of the cue kind '{self.name}' has a standard deviation of {std}; make it > 0")
        if self.flow_std is not None and not 0 < self.flow_std < math.inf:
            raise InputError(f"flow_std of the cue kind '{self.name}' is {self.flow_std}; make it > 0 or null")

    @property
    def moves(self) -> bool:
        """Whether its motion shows where the road leads."""
        return self.flow_std is not None


KINDS = (
    CueKind("guardrail", right=(-5.0, 1.0), left=(7.0, 1.0), std=0.2),  # a post, or the reflector on it
    CueKind("delineator", right=(-3.5, 1.0), left=(5.5, 1.0), std=0.2),
    CueKind("pole", right=(-4.5, 1.5), left=(6.5, 1.5), std=0.4),
    CueKind("lantern", right=(-5.0, 1.0), left=(7.0, 1.0), std=0.2),
    CueKind("reflector", right=(-1.8, 0.3), left=(1.8, 0.3), std=0.1),  # in the surface of the road
    CueKind("marking", right=(-1.75, 0.15), left=(1.75, 0.15), std=0.05),
    CueKind("bicycle", right=(-1.2, 0.5), left=(4.7, 0.5), std=0.3, flow_std=0.1),
    CueKind("car", right=(0.0, 0.4), left=(3.5, 0.4), std=0.25, flow_std=0.05),
    CueKind("motorbike", right=(0.0, 0.6), left=(3.5, 0.6), std=0.3, flow_std=0.07),
    CueKind("truck", right=(0.0, 0.3), left=(3.5, 0.3), std=0.25, flow_std=0.05),
)


class Cues(NamedTuple):
    """N detected cues in the frame of the car: x ahead, y to the left, now.

    kind        (N,) names of kinds
    left        (N,) on the left of the course; of a vehicle: oncoming
    track       (N,) which object: all detections of one vehicle share it, of the same kind and side
    position    (N, 2) [m]
    covariance  (N, 2, 2) of the position [m^2]
    flow        (N,) direction of motion [rad], nan where none was measured
    flow_std    (N,) of its measurement [rad], of no meaning without
    confidence  (N,) of the detector, in (0, 1]
    """

    kind: NDArray[np.str_]
    left: NDArray[np.bool_]
    track: NDArray[np.int64]
    position: Floats
    covariance: Floats
    flow: Floats
    flow_std: Floats
    confidence: Floats

    def take(self, chosen: NDArray[np.bool_]) -> Cues:
        """Only the chosen ones (N,)."""
        return Cues(*(field[chosen] for field in self))  # type: ignore[arg-type]


def line_of_sight(position: Floats, range_std: Floats, lateral_std: Floats) -> Floats:
    """Covariances (N, 2, 2) [m^2] of positions (N, 2) with noise along (N,) and across (N,) the line of sight [m]."""
    distance = np.maximum(np.hypot(*position.T), 1e-6)
    u, v = position.T / distance
    along, across = np.stack([u, v], -1), np.stack([-v, u], -1)
    outer = np.einsum("ni,nj->nij", along, along) * (range_std**2)[:, None, None]
    return outer + np.einsum("ni,nj->nij", across, across) * (lateral_std**2)[:, None, None]
