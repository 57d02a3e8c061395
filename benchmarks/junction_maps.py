"""How often the check of a stored map is right: on maps that are right, and on maps with a lane too many and one too
few."""

from __future__ import annotations

import numpy as np

from benchmarks.figure import Figure, Measurement, Values, share
from benchmarks.junction import Effort, configured_engine
from experiments.scenarios.protocol import protocol
from experiments.scenarios.stored_map import map_of, outdated
from experiments.verify_map import SIDES, verify
from inference.progress import Progress
from models.intersection.state import Junction


def maps(effort: Effort) -> Values:
    """Three maps of each junction against the same draws."""
    engine, model, num = configured_engine("rjmcmc_structure"), Junction(), max(3 * effort.few // 10, 1)
    right, added, lacking = [], [], []
    with Progress("map_right", num, effort.show) as bar:
        for seed in range(num):
            scene = protocol(seed)
            posterior = engine(model, model.prepare(scene.data), seed=seed)
            stored = map_of(scene.truth)
            right.append(float(verify(posterior, stored, scene.data).outdated < 1))
            wrong, _ = outdated(stored, seed)
            verdict = verify(posterior, wrong, scene.data)
            gone = {side: [int((odds > 1).sum()) for odds in verdict.lane_gone[side]] for side in SIDES}
            more = {side: (verdict.more[side] > 1).astype(int) for side in SIDES}
            one_too_many, one_too_few = wrong.entries - stored.entries, stored.exits - wrong.exits
            added.append(float(np.array_equal(gone[1], one_too_many) and sum(gone[-1]) == 0))
            lacking.append(float(np.array_equal(more[-1], one_too_few) and more[1].sum() == 0))
            bar.advance(1)
    return {"map_right": share(right), "map_added": share(added), "map_lacking": share(lacking)}


MEASUREMENTS = (
    Measurement(
        (
            Figure("map_right", "share", "of right maps whose odds of being outdated are below 1", at_least=0.95),
            Figure(
                "map_added",
                "share",
                "of maps with an entry too many and an exit too few where one lane of that entry's side, and no other, "
                "has odds of being gone above 1",
                at_least=0.95,
            ),
            Figure(
                "map_lacking",
                "share",
                "of the same maps where that exit's side, and no other, has odds of another lane above 1",
                at_least=0.95,
            ),
        ),
        maps,
    ),
)
