"""Is a stored map outdated? Posterior odds, for the map, for each arm and for each lane, given vehicles' tracks.

    odds = p(changed | tracks) / p(as mapped | tracks) = (n + 1/2) / (N - n + 1/2)

n of N draws of the structure posterior differ from the map; the halves keep odds finite: no odds lie beyond 2N + 1,
nor is anything surer than that. Draws of a chain resemble each other, so that odds near these ends say less than their
size. Shares are worth what the chains are worth: one that never left a wrong structure counts as much as the others, so
that chains replace one another while they anneal (engine=rjmcmc_structure); the run's flags tell where they disagree.
`python -m benchmarks.intersection --only map_right` counts how often the verdict is right.

These are posterior odds under the prior of `Junction`, which knows nothing of the map: lane counts uniform on 0 to
max_lanes, the number of arms uniform on 2 to 7. Multiply them by how much less (or more) often than that a
mapped lane is truly gone. The likelihood lets every half track choose among the lanes of its side alike, so that
a lane nobody drove looks like one that is not there: tracks cannot tell the two apart. The number of tracks
seen on every mapped lane stands beside its odds for that reason.

Which lane is gone: a draw with fewer lanes than the map leaves mapped lanes over, the innermost or the outermost ones,
whichever puts the others closest. A map displaced by half a lane thus loses no lane, for the count decides how many.

    waybayes experiment=verify_map                            a map made wrong on purpose
    waybayes experiment=verify_map scenario.map_path=map.json
    waybayes experiment=verify_map scenario@scenario.scene=csv scenario.scene.path=tracks.csv scenario.map_path=map.json
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.junction_metrics import TOLERANCE_DEG
from experiments.scenarios.paths import wrap
from experiments.scenarios.scene import Floats, Ints, Scene
from experiments.scenarios.stored_map import StoredMap, from_plain
from inference.posterior import Posterior
from models.intersection.moments import CHORD
from models.intersection.tracks import Tracks

Side = Literal[1, -1]
SIDES: dict[Side, str] = {1: "entry", -1: "exit"}
END = 20  # points of a track's end, a metre apart, that tell its lane


class Verdict(NamedTuple):
    """Odds of K mapped arms.

    outdated   that any arm or count differs from the map
    new_arm    that there is an arm farther than 10 degrees from every mapped one
    arm_gone   (K,) that no arm lies within 10 degrees
    lane_gone  {side: K arrays, one value a mapped lane from the middle outwards}, lanes of arms that are gone included
    more       {side: (K,)} that the side has more lanes than mapped
    tracks     {side: K arrays} seen on every mapped lane
    """

    outdated: float
    new_arm: float
    arm_gone: Floats
    lane_gone: dict[Side, list[Floats]]
    more: dict[Side, Floats]
    tracks: dict[Side, list[Ints]]


def verify(posterior: Posterior, stored: StoredMap, tracks: Tracks) -> Verdict:
    """Compare the draws of a structure posterior with a map."""
    draws = {site: v.reshape((-1, *v.shape[2:])) for site, v in posterior.draws.items()}
    weights, number = posterior.weights.reshape(-1), len(draws["num_arms"])
    share = lambda changed: odds(float(weights[changed].sum()), number)  # noqa: E731
    slots, found, new = match_arms(draws, stored)
    same = found.all(1) & ~new
    lane_gone: dict[Side, list[Floats]] = {1: [], -1: []}
    more: dict[Side, Floats] = {}
    for side in SIDES:
        excess = np.zeros(len(stored.angle))
        for arm, mapped in enumerate(stored.lanes(side)):
            count, first = align(draws, slots[:, arm], stored, arm, side)
            there = (np.arange(mapped) >= first[:, None]) & (np.arange(mapped) < (first + count)[:, None])  # (D, lanes)
            lane_gone[side].append(np.array([share(~(there[:, i] & found[:, arm])) for i in range(mapped)]))
            excess[arm] = share(found[:, arm] & (count > mapped))
            same &= count == mapped
        more[side] = excess
    arm_gone = np.array([share(~column) for column in found.T])
    seen = {side: lanes_seen(stored, tracks, side) for side in SIDES}
    return Verdict(share(~same), share(new), arm_gone, lane_gone, more, seen)


def odds(probability: float, number: int) -> float:
    """(n + 1/2) / (N - n + 1/2) of n = probability N draws out of N."""
    n = number * probability
    return (n + 0.5) / (number - n + 0.5)


def match_arms(
    draws: Mapping[str, NDArray[Any]], stored: StoredMap
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
    """The slot (D, K) closest to every mapped arm, whether it lies within 10 degrees (D, K), and whether a draw has
    an arm that is on no mapped one (D,)."""
    active = np.arange(draws["angle"].shape[1]) < draws["num_arms"][:, None]  # (D, A)
    apart = np.abs(wrap(draws["angle"][:, :, None] - stored.angle))  # (D, A, K)
    near = (apart <= np.radians(TOLERANCE_DEG)) & active[:, :, None]
    slots = np.where(active[:, :, None], apart, np.inf).argmin(1)
    return slots, near.any(1), (active & ~near.any(2)).any(1)


def align(
    draws: Mapping[str, NDArray[Any]], slot: NDArray[np.int64], stored: StoredMap, arm: int, side: Side
) -> tuple[Ints, Ints]:
    """Lanes of every draw on one side of a mapped arm, (D,), and the mapped lane where their innermost one lies, (D,).

    n drawn lanes lie on m mapped ones, `first` from 0 to m - n, or the mapped ones on them, from m - n to 0; of these
    the one that minimises the sum of squared distances CHORD metres from the centre. slot (D,) is the arm in the draws.
    """
    rows = np.arange(len(slot))
    own = {site: draws[site][rows, slot] for site in ("angle", "gap", "width", "shift") if site in draws}
    width = own.get("width", np.full(len(slot), stored.width[arm]))
    count = np.asarray(draws["entries" if side == 1 else "exits"])[rows, slot].astype(np.int64)
    mapped = int(stored.lanes(side)[arm])
    axis = np.array([np.cos(stored.angle[arm]), np.sin(stored.angle[arm])])
    left = np.array([-axis[1], axis[0]])
    turn = own["angle"] - stored.angle[arm]
    drawn_axis = (draws["centre"] - stored.centre) @ left + CHORD * np.sin(turn) + own.get("shift", 0.0) * np.cos(turn)
    apart = side * drawn_axis + own["gap"] / 2 - stored.gap[arm] / 2  # of the inner borders, outwards
    middle = np.minimum(count, mapped) / 2
    step = np.where(count > mapped, width, stored.width[arm])
    nearest = np.rint((apart + middle * (width - stored.width[arm])) / step)
    first = np.clip(nearest, np.minimum(mapped - count, 0), np.maximum(mapped - count, 0))
    return count, first.astype(np.int64)


def lanes_seen(stored: StoredMap, tracks: Tracks, side: Side) -> list[Ints]:
    """Tracks on every mapped lane of a side, K arrays (lanes,): the arm that the first (last) 20 points of a track
    point along, the lane within whose borders their mean lies. Tracks without 20 points beside the centre are left out.
    """
    seen = [np.zeros(count, dtype=np.int64) for count in stored.lanes(side)]
    for first, last in zip(tracks.offsets[:-1], tracks.offsets[1:], strict=True):
        points = tracks.points[first:last] - stored.centre
        closest = int(np.hypot(*points.T).argmin())
        outwards = points[closest::-1] if side == 1 else points[closest:]
        if len(outwards) < END:
            continue
        end = outwards[-END:]
        course = end[END // 2 :].mean(0) - end[: END // 2].mean(0)
        arm = int(np.abs(wrap(np.arctan2(course[1], course[0]) - stored.angle)).argmin())
        left = np.array([-np.sin(stored.angle[arm]), np.cos(stored.angle[arm])])
        lane = int((side * (end.mean(0) @ left) - stored.gap[arm] / 2) // stored.width[arm])
        if 0 <= lane < len(seen[arm]):
            seen[arm][lane] += 1
    return seen


def metrics(posterior: Posterior, scene: Scene) -> dict[str, float]:
    """The verdict on the map of the scene by name; arms and lanes are counted from 1, in the order of the map.

    odds_...         see `Verdict`
    tracks_...       seen on a mapped lane
    lanes_gone       mapped lanes whose odds of being gone exceed 1
    lanes_unseen     mapped lanes without a track: whether they are there cannot be known
    sides_with_more  sides of arms whose odds of having more lanes than mapped exceed 1

    Nothing for a scene without a map."""
    if "map" not in scene.info:
        return {}
    verdict = verify(posterior, from_plain(scene.info["map"]), scene.data)
    out = {"odds_map_outdated": verdict.outdated, "odds_new_arm": verdict.new_arm}
    gone = np.concatenate([lane for side in SIDES for lane in verdict.lane_gone[side]])
    seen = np.concatenate([lane for side in SIDES for lane in verdict.tracks[side]])
    more = np.concatenate(list(verdict.more.values()))
    out |= {"lanes_gone": float((gone > 1).sum()), "lanes_unseen": float((seen == 0).sum())}
    out["sides_with_more"] = float((more > 1).sum())
    for arm, arm_gone in enumerate(verdict.arm_gone):
        out[f"odds_arm_{arm + 1}_gone"] = float(arm_gone)
        for side, word in SIDES.items():
            for lane, (value, tracks) in enumerate(
                zip(verdict.lane_gone[side][arm], verdict.tracks[side][arm], strict=True), start=1
            ):
                out[f"odds_arm_{arm + 1}_{word}_{lane}_gone"] = float(value)
                out[f"tracks_arm_{arm + 1}_{word}_{lane}"] = float(tracks)
            out[f"odds_arm_{arm + 1}_another_{word}"] = float(verdict.more[side][arm])
    return out
