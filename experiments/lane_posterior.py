"""Posterior of lanes: centre lines with bands, how probable each is, and what else there may be; its files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.lanelet_osm import write_osm
from experiments.lanelets import lanelet_map
from experiments.store import write_rows
from inference.posterior import Posterior
from models.intersection.routes import Routes

Array = NDArray[np.float64]
State = Mapping[str, NDArray[Any]]


class Lanes(NamedTuple):
    """The centre lines of L lanes.

    lines   L arrays (n, 2) in driving order [m]
    left    L arrays (n,): the centre line lies at most this far to the left of `lines` ...
    right   ... and this far to the right, with 90 % posterior probability at each point [m]; one of them is negative
            where most readings see the lane on one side of the best one's line
    routes  their entries and exits, and which track drove which lane
    """

    lines: list[Array]
    left: list[Array]
    right: list[Array]
    routes: Routes


class OtherLane(NamedTuple):
    """A lane that the best structure has not.

    probability  of it
    line         (n, 2) [m]
    connection   (4,) as in Routes, arms counted as in `structure`
    structure    {site: (*event)} of the most probable reading that has it
    tracks       on it
    """

    probability: float
    line: Array
    connection: NDArray[np.int64]
    structure: State
    tracks: int


@dataclass(frozen=True)
class LanePosterior(Posterior):
    """The posterior of the structure, with the lanes on its best state.

    lanes         centre lines with bands, over all readings of the tracks
    probability   (L,) that they exist: share of the readings that have them; None where one alone was refined
    alternatives  lanes of other readings only, most probable first
    first         the same lanes where their refinement began
    lane_width    that arms have in common [m]
    courses       posterior of the refinement, given the best structure and its routes
    """

    lanes: Lanes | None = None
    probability: Array | None = None
    alternatives: list[OtherLane] = field(default_factory=list)
    first: list[Array] | None = None
    lane_width: float = 2.7
    courses: Posterior | None = None

    def table(self) -> list[dict[str, float]]:
        """A row for every lane, the alternatives last, arms by their directions as in arms.csv."""
        assert self.lanes is not None
        routes, rows = self.lanes.routes, []
        probability = np.full(len(routes.connections), math.nan) if self.probability is None else self.probability
        for lane, connection in enumerate(routes.connections):
            half = 50.0 * float(np.mean(self.lanes.left[lane] + self.lanes.right[lane]))
            tracks = int((routes.track_route == lane).sum())
            rows.append(_row(self.estimate, connection, float(probability[lane]), half, tracks))
        for other in self.alternatives:
            rows.append(_row(other.structure, other.connection, other.probability, math.nan, other.tracks))
        return rows

    def save(self, folder: Path) -> None:
        """posterior.npz and .json as ever; the lanes in lanes.npz, one array per lane: x, y, left, right, their
        probabilities, and the alternatives' x, y and probabilities; in lanes.csv a row each; and as a Lanelet2 map in
        lanes.osm, without alternatives."""
        super().save(folder)
        assert self.lanes is not None
        arrays = {
            f"lane_{i}": np.column_stack([line, self.lanes.left[i], self.lanes.right[i]])
            for i, line in enumerate(self.lanes.lines)
        }
        arrays |= {f"alternative_{i}": other.line for i, other in enumerate(self.alternatives)}
        arrays |= {} if self.probability is None else {"probability": self.probability}
        arrays |= {"alternative_probability": np.array([other.probability for other in self.alternatives])}
        routes = self.lanes.routes._asdict()
        np.savez_compressed(folder / "lanes.npz", allow_pickle=False, **arrays, **routes)
        write_rows(folder / "lanes.csv", self.table())
        lanelets = lanelet_map(self.lanes.lines, self.lanes.routes.connections, self.lane_width)
        write_osm(folder / "lanes.osm", lanelets)


def _row(structure: State, connection: Any, probability: float, half: float, tracks: int) -> dict[str, float]:
    """One lane of the table; lanes of an arm are counted from 1, from its middle outwards; nan where no arm is."""
    ends = {}
    for end, (arm, lane) in {"entry": connection[:2], "exit": connection[2:]}.items():
        known = arm >= 0
        angle = math.remainder(float(structure["angle"][arm]), math.tau) if known else math.nan
        ends[f"{end}_arm_deg"] = round(math.degrees(angle), 1)
        ends[f"{end}_lane"] = int(lane) + 1 if known else math.nan
    return ends | {"tracks": tracks, "probability": round(probability, 3), "half_band_cm": round(half, 1)}
