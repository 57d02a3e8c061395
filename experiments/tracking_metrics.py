"""Scores of tracks of many objects against who really was where: (posterior, scene) -> {name: value}.

An object counts as estimated where its existence is above a threshold; an estimate farther than the cut-off from a true
object is not one of it. experiments.set_distances defines the distances."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.scenarios.scene import Scene, TrafficTruth
from experiments.set_distances import Gospa, gospa, ospa, ospa2
from inference.posterior import Posterior
from inference.tracks import Tracks
from models.program import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
BAND = (0.05, 0.95)
SAME_TIME = 1e-6  # [s]


class Judged(NamedTuple):
    """How tracks fare at each of T scans.

    ospa, ospa2, gospa  (T,) each
    true_count          (T,) objects that there were
    pairs               (K, 2) rows of the truth and rows of the estimate, assigned to each other by GOSPA
    """

    ospa: Floats
    ospa2: Floats
    gospa: list[Gospa]
    true_count: Ints
    pairs: Ints


def metrics(
    posterior: Posterior,
    scene: Scene,
    *,
    cutoff: float = 10.0,
    order: float = 1.0,
    gospa_order: float = 2.0,
    window: int = 10,
    threshold: float = 0.5,
) -> dict[str, float]:
    """Means over the scans; nothing without tracks and a truth of traffic.

    ospa_m                OSPA distance of the positions
    ospa2_m               OSPA(2) distance of the paths in a window: identities count, too
    gospa_m               GOSPA distance of the positions
    gospa_localisation_m  its part of the assigned pairs
    missed                true objects without an estimate nearer than the cut-off, in a scan
    false                 estimates without such a true object, in a scan
    count_error           absolute error of the expected number of objects
    count_covered         share of the scans whose 90 % band of the number of objects holds the true one
    position_error_m      root mean square over the assigned pairs
    nees                  (x - mean)' covariance^-1 (x - mean) of their positions, 2 where the covariances are right
    label_switches        how often in all an object changes the label it is tracked by (CLEAR)
    fragmentations        how often in all an object is lost and found again (CLEAR)
    lost                  share of the true objects tracked in less than a fifth of their scans (CLEAR, mostly lost)

    cutoff     [m] of all of them
    order      of OSPA and OSPA(2), as gospa_order is of GOSPA
    window     of OSPA(2), in scans
    threshold  existence above which an object is estimated
    """
    if not isinstance(posterior, Tracks) or not isinstance(scene.truth, TrafficTruth):
        return {}
    truth, sure = scene.truth, posterior.confirmed(threshold)
    found = judge(sure, truth, cutoff=cutoff, order=order, gospa_order=gospa_order, window=window)
    low, high = (posterior.count_quantile(q) for q in BAND)
    error, nees = position_errors(sure, truth, found.pairs)
    return {
        "ospa_m": float(found.ospa.mean()),
        "ospa2_m": float(found.ospa2.mean()),
        "gospa_m": float(np.mean([scan.distance for scan in found.gospa])),
        "gospa_localisation_m": float(np.mean([scan.localisation for scan in found.gospa])),
        "missed": float(np.mean([scan.missed for scan in found.gospa])),
        "false": float(np.mean([scan.false for scan in found.gospa])),
        "count_error": float(np.abs(posterior.count_mean() - found.true_count).mean()),
        "count_covered": float(((low <= found.true_count) & (found.true_count <= high)).mean()),
        "position_error_m": float(np.sqrt(np.square(error).mean())) if len(error) else float("nan"),
        "nees": float(nees.mean()) if len(nees) else float("nan"),
        **clear(sure, truth, cutoff=cutoff),
    }


def timing(posterior: Posterior, scene: Scene) -> dict[str, float]:
    """How long a scan takes; nothing where the engine does not tell.

    step_ms      median over the scans
    step_p99_ms  exceeded by one scan of a hundred
    """
    seconds = posterior.info.get("step_seconds", ())
    if not len(seconds):
        return {}
    middle, long = 1e3 * np.quantile(seconds, (0.5, 0.99))
    return {"step_ms": float(middle), "step_p99_ms": float(long)}


def counts(posterior: Posterior, *, scans: int = 10) -> dict[str, NDArray[np.int64]]:
    """Functional: the number of objects after so many scans, evenly over time, {"count[t]": (chain, draw)}. Nothing
    for what is not tracks."""
    if not isinstance(posterior, Tracks):
        return {}
    draws = posterior.draws["count"]
    chosen = np.unique(np.linspace(0, draws.shape[2] - 1, scans).round().astype(int))
    return {f"count[{t}]": draws[:, :, t] for t in chosen}


def judge(
    estimate: Tracks,
    truth: TrafficTruth,
    *,
    cutoff: float,
    order: float = 1.0,
    gospa_order: float = 2.0,
    window: int = 10,
) -> Judged:
    """All rows of the estimate, taken as objects that exist, against the truth at the times of its scans.

    Raises InputError for a scan at a time that the truth does not know."""
    when = times_of(truth, estimate.time)
    single, general, pairs = list[float](), list[Gospa](), list[Ints]()
    here = estimate.position
    for t, true in enumerate(when):
        began = np.array([truth.offset[true], estimate.offset[t]])
        real = truth.position[began[0] : truth.offset[true + 1]]
        seen = here[began[1] : estimate.offset[t + 1]]
        single.append(ospa(real, seen, cutoff=cutoff, order=order))
        general.append(gospa(real, seen, cutoff=cutoff, order=gospa_order))
        pairs.append(general[-1].pairs + began)
    real_paths = paths(truth.label, truth.offset, truth.position)[:, when]
    seen_paths = paths(estimate.label, estimate.offset, here)
    over_time = ospa2(real_paths, seen_paths, cutoff=cutoff, order=order, window=window)
    return Judged(np.array(single), over_time, general, np.diff(truth.offset)[when], np.concatenate(pairs))


def times_of(truth: TrafficTruth, time: Floats) -> Ints:
    """(T,) which times of the truth those of scans are."""
    after = np.clip(np.searchsorted(truth.time, time), 1, max(len(truth.time) - 1, 1))
    near = np.stack([after - 1, np.minimum(after, len(truth.time) - 1)])
    nearest = np.where(np.abs(truth.time[near[0]] - time) <= np.abs(truth.time[near[1]] - time), *near)
    if len(apart := np.flatnonzero(np.abs(truth.time[nearest] - time) > SAME_TIME)):
        raise InputError(
            f"the truth knows no traffic at {time[apart[0]]} s, when scan {apart[0]} was taken; "
            "give the truth at the times of the scans"
        )
    return nearest


def paths(label: Ints, offset: Ints, position: Floats) -> Floats:
    """(L, T, 2) where each label was, NaN where it was not, labels in rising order."""
    names, which = np.unique(label, return_inverse=True)
    out = np.full((len(names), len(offset) - 1, 2), np.nan)
    out[which, np.repeat(np.arange(len(offset) - 1), np.diff(offset))] = position
    return out


def position_errors(estimate: Tracks, truth: TrafficTruth, pairs: Ints) -> tuple[Floats, Floats]:
    """Distances (K,) [m] of assigned pairs, and their squares by the covariances of the estimates (NEES)."""
    index = estimate.entries("x", "y")
    gap = truth.position[pairs[:, 0]] - estimate.position[pairs[:, 1]]
    covariance = estimate.covariance[pairs[:, 1]][:, index][:, :, index]
    nees = (gap * np.linalg.solve(covariance, gap[..., None])[..., 0]).sum(-1)
    return np.hypot(*gap.T), nees


def clear(estimate: Tracks, truth: TrafficTruth, *, cutoff: float) -> dict[str, float]:
    """label_switches, fragmentations and lost of `metrics`, by trackeval's CLEAR with similarity 1 - d / (2 c), of
    which half is enough. It keeps partners while it can, so that a crossing alone makes no switch."""
    from trackeval.metrics import CLEAR

    when, here = times_of(truth, estimate.time), estimate.position
    people, person = np.unique(truth.label, return_inverse=True)
    labels, label = np.unique(estimate.label, return_inverse=True)
    real = [slice(truth.offset[true], truth.offset[true + 1]) for true in when]
    seen = [slice(*estimate.offset[t : t + 2]) for t in range(len(when))]
    gaps = [np.linalg.norm(truth.position[a][:, None] - here[b], axis=-1) for a, b in zip(real, seen, strict=True)]
    found = CLEAR({"PRINT_CONFIG": False}).eval_sequence(
        {
            "num_timesteps": len(when),
            "num_gt_ids": len(people),
            "num_tracker_ids": len(labels),
            "num_gt_dets": sum(part.stop - part.start for part in real),
            "num_tracker_dets": len(label),
            "gt_ids": [person[part] for part in real],
            "tracker_ids": [label[part] for part in seen],
            "similarity_scores": [np.maximum(1.0 - gap / (2.0 * cutoff), 0.0) for gap in gaps],
        }
    )
    lost = found["ML"] / len(people) if len(people) else 0.0
    return {"label_switches": float(found["IDSW"]), "fragmentations": float(found["Frag"]), "lost": float(lost)}
