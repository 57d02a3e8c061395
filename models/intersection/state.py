"""Lane-level intersections as a probabilistic program (Meyer, Walter, Lauer 2020, section III).

    I = (c, A),   a = (alpha, g, E, O, w) and here also bend and shift

An arm leaves the centre c in direction alpha; looking outward, E entry lanes lie left of the gap g
and O exit lanes right of it (right-hand traffic), each w wide. Departures from the paper: w may differ
by arm (there 2.7 m), an arm may be bent (chord direction alpha, curvature `bend`) and lie `shift` beside
the centre, and an arm may be one-way (E = 0 or O = 0): real junctions need all of these.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray

from models.capability import Kernel, Move
from models.intersection.angles import HardCoreAngles
from models.intersection.moments import CHORD, Noise
from models.intersection.packing import MAX_ARMS, MIN_ARMS
from models.intersection.tracks import Tracks
from models.program import InputError


@dataclass(frozen=True)
class Junction:
    """An intersection seen through the tracks of the vehicles that cross it.

    Prior: num_arms uniform on 2..7; angles uniform, 25 degrees apart; gap U(0, gap_max); entries and exits
    uniform on 1..max_lanes (0 too with one_way, but not both); width log-normal; bend, shift normal.

    likelihood  'exact' sums over lane labels of half tracks with fixed positions along the lane: a normalised
                density. 'half' and 'point' are [M20]'s closest lane with multinomial counts, split at the
                current centre, for each half track or for each point: scores for straight arms, not densities.
                Where headings were not measured these two take them from the smoothed path, the exact one has none.
    steps       'm20' are the moves of Algorithm 1; 'extended' adds small steps, lane toggles and the moves of
                width, bend and shift.
    begin       'tracks' starts from the data: arms where half tracks point, lanes where they lie; 'm20' as [M20] might
                (the paper gives no start): the mean of all points, three arms 120 degrees apart, one lane each way.
    """

    dimension: ClassVar[str] = "num_arms"

    likelihood: Literal["exact", "half", "point"] = "exact"
    steps: Literal["extended", "m20"] = "extended"
    begin: Literal["tracks", "m20"] = "tracks"
    one_way: bool = True
    max_lanes: int = 6
    gap_max: float = 8.0  # [m]
    centre_std: float = 10.0  # about where the tracks meet [m]
    width: float = 3.0  # median lane width [m]
    width_spread: float = 0.15  # of its logarithm; 0 fixes it
    bend_std: float = 0.003  # curvature of an arm [1/m]; 0: straight arms
    shift_std: float = 0.0  # of an arm beside the centre [m]; 0: all meet in it
    position_std: float = 1.0  # of a point across its lane [m]
    along_std: float = 3.0  # of a point along its lane [m]
    offset_std: float = 0.3  # of a whole half track across its lane [m]
    phase_std: float = 20.0  # of a whole half track along its lane [m]
    heading_std: float = 0.3  # of a measured heading about the arm [rad]
    clutter: float = 0.02  # share of half tracks on no lane
    clutter_std: float = 40.0  # of their points about where the tracks meet [m]
    inner_radius: float = 30.0  # points closer to the crossing are on no arm [m]

    def __post_init__(self) -> None:
        words = {"likelihood": ("exact", "half", "point"), "steps": ("extended", "m20"), "begin": ("tracks", "m20")}
        for name, known in words.items():
            if getattr(self, name) not in known:
                raise InputError(f"{name} must be one of {', '.join(known)}, but is '{getattr(self, name)}'")
        scales = ("gap_max", "centre_std", "width", "position_std", "along_std", "phase_std", "heading_std")
        for name in (*scales, "clutter_std", "inner_radius"):
            self._check(name, may_be_zero=False)
        for name in ("width_spread", "bend_std", "shift_std", "offset_std", "clutter"):
            self._check(name, may_be_zero=True)
        if self.clutter >= 1:
            raise InputError(f"clutter is a share below 1, but is {self.clutter}")
        if not 1 <= self.max_lanes <= 8:
            raise InputError(f"max_lanes must be 1 to 8, but is {self.max_lanes}")
        if self.likelihood != "exact" and self.bend_std > 0:
            raise InputError(
                f"likelihood '{self.likelihood}' knows the straight arms of [M20] only, but bend_std is "
                f"{self.bend_std}; set bend_std=0 or likelihood=exact"
            )

    def _check(self, name: str, *, may_be_zero: bool) -> None:
        value = getattr(self, name)
        if not math.isfinite(value) or value < 0 or (value == 0 and not may_be_zero):
            least = "zero or positive" if may_be_zero else "positive"
            raise InputError(f"{name} must be finite and {least}, but is {value}")

    @property
    def noise(self) -> Noise:
        """How points scatter about their lane; [M20] has no common offset and nothing along the lane."""
        if self.likelihood == "exact":
            return Noise(self.position_std, self.along_std, self.offset_std, self.phase_std, self.heading_std)
        return Noise(self.position_std, math.inf, 0.0, math.inf, self.heading_std)

    @property
    def constants(self) -> dict[str, float]:
        """Fields of an arm that are no latents."""
        fixed = {"width": self.width, "bend": 0.0, "shift": 0.0}
        spread = {"width": self.width_spread, "bend": self.bend_std, "shift": self.shift_std}
        return {name: value for name, value in fixed.items() if spread[name] == 0}

    def __call__(self, evidence: Any) -> None:
        from models.intersection.observation import TracksOnLanes

        slots = [MAX_ARMS]
        counts = torch.arange(MAX_ARMS + 1.0)
        arms_logits = torch.where(counts >= MIN_ARMS, 0.0, -torch.inf)
        num_arms = pyro.sample("num_arms", dist.Categorical(logits=arms_logits))
        origin = torch.as_tensor(evidence.origin)
        centre = pyro.sample("centre", dist.Normal(origin, self.centre_std).to_event(1))
        arms: dict[str, Any] = {}
        arms["angle"] = pyro.sample("angle", HardCoreAngles(num_arms, MAX_ARMS))
        arms["gap"] = pyro.sample("gap", dist.Uniform(0.0, self.gap_max).expand(slots).to_event(1))
        lanes = torch.arange(self.max_lanes + 1.0)
        some = torch.where(lanes >= 1, 0.0, -torch.inf)
        entries = torch.where(lanes >= (0 if self.one_way else 1), 0.0, -torch.inf)
        arms["entries"] = pyro.sample("entries", dist.Categorical(logits=entries.expand(MAX_ARMS, -1)).to_event(1))
        exits = torch.where((arms["entries"] == 0)[..., None], some, entries)  # (*B, A, L + 1): never neither
        arms["exits"] = pyro.sample("exits", dist.Categorical(logits=exits).to_event(1))
        if self.width_spread > 0:
            width = dist.LogNormal(math.log(self.width), self.width_spread)
            arms["width"] = pyro.sample("width", width.expand(slots).to_event(1))
        for name, std in (("bend", self.bend_std), ("shift", self.shift_std)):
            if std > 0:
                arms[name] = pyro.sample(name, dist.Normal(0.0, std).expand(slots).to_event(1))
        pyro.sample("points", TracksOnLanes(self, evidence, num_arms, centre, arms), obs=evidence.points)

    def prepare(self, tracks: Tracks) -> Any:
        """Evidence of this model from tracks. Raises InputError where nothing crosses."""
        from models.intersection.evidence import junction_evidence

        return junction_evidence(tracks, self)

    def moves(self) -> tuple[Move, ...]:
        """Algorithm 1 of [M20], batched over chains; the compiled chain calls the same function."""
        from models.intersection.kernel import batched_moves

        return batched_moves(self)

    def start(self, evidence: Any) -> dict[str, Any]:
        """A first state from the data, see `begin`."""
        from models.intersection.start import m20_start, start_from_halves

        return (start_from_halves if self.begin == "tracks" else m20_start)(self, evidence)

    def kernel(self, evidence: Any) -> Kernel:
        """The same density as a compiled kernel over packed states."""
        from models.intersection.kernel import junction_kernel

        return junction_kernel(self, evidence)


def lane_points(
    estimate: Mapping[str, NDArray[Any]],
    arm: Any,
    lane: Any,
    side: Literal[1, -1],
    s: NDArray[np.float64],
    width: float = 2.7,
) -> NDArray[np.float64]:
    """Centre line (n, 2) of a lane at distances s (n,) from the centre; side 1: entry, -1: exit. Of several lanes, arm
    and lane (L,), the lines (L, n, 2).

    c + s d + (offset + bend s (s - CHORD) / 2) n,  offset = shift + side (gap / 2 + (lane + 1/2) width)

    `width` is used where the estimate has none."""
    field = lambda name, default: np.asarray(estimate[name])[arm] if name in estimate else default  # noqa: E731
    angle, w = field("angle", 0.0), field("width", width)
    d = np.stack([np.cos(angle), np.sin(angle)], -1)[..., None, :]
    n = np.stack([-np.sin(angle), np.cos(angle)], -1)[..., None, :]
    offset = field("shift", 0.0) + side * (field("gap", 0.0) / 2 + (lane + 0.5) * w)
    across = np.asarray(offset)[..., None] + np.asarray(field("bend", 0.0))[..., None] * s * (s - CHORD) / 2
    return np.asarray(estimate["centre"] + s[:, None] * d + across[..., None] * n)
