"""Crossing targets by our filter and by the trackers of Stone Soup, on identical scans in one process.

Stone Soup's settings were chosen on other scenes (python -m benchmarks.tracking_tune); ours are the configs'."""

from __future__ import annotations

from functools import lru_cache
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.tracking_trials import Effort, lmb, ospa_m, plots, ratio, step_ms
from experiments.scenarios.crossing_targets import crossing_targets
from inference.progress import Progress
from inference.tracks import Tracks

SETTINGS: dict[tuple[str, int], dict[str, Any]] = {
    ("gnn", 30): {"hits": 4, "gate": 3.5, "misses": 2, "held": 1},
    ("jpda", 30): {"hits": 4, "gate": 3.5, "misses": 2, "held": 1},
    ("phd", 30): {"merge": 16.0, "gate": 5.0, "prune": 1e-4},
    ("gnn", 66): {"hits": 5, "gate": 4.0, "misses": 2, "held": 1},  # as jpda's, not searched for itself
    ("jpda", 66): {"hits": 5, "gate": 4.0, "misses": 2, "held": 1},
}
NAMES = {"gnn": "GNN", "jpda": "JPDA-EHM2", "phd": "GM-PHD"}


class Score(NamedTuple):
    """Of one filter: mean OSPA of each scene [m], and the median time of a scan [ms]."""

    ospa: list[float]
    ms: float


@lru_cache
def scores(clutter: int, places: bool, effort: Effort) -> dict[str, Score]:
    """Of our filter, "lmb", and of all trackers with the same knowledge of where targets come from."""
    from experiments.stonesoup_engine import run

    model, runs = plots(float(clutter), places=places), dict[str, list[Tracks]]()
    scenes = [crossing_targets(seed, float(clutter)) for seed in range(effort.peers)]
    trackers = [t for t, c in SETTINGS if c == clutter and (t == "phd") == places]
    lmb()(model, scenes[0].data.scans)  # compiles
    with Progress(f"clutter {clutter}", len(scenes) * len(trackers), effort.show) as bar:
        for scene in scenes:
            runs.setdefault("lmb", []).append(lmb()(model, scene.data.scans))
            for tracker in trackers:
                settings = SETTINGS[tracker, clutter]
                runs.setdefault(tracker, []).append(run(model, scene.data.scans, tracker=tracker, **settings))  # type: ignore[arg-type]
                bar.advance(1)
    return {
        name: Score([ospa_m(*pair) for pair in zip(own, scenes, strict=True)], float(np.median(step_ms(own))))
        for name, own in runs.items()
    }


def best_of(found: dict[str, Score]) -> str:
    """The tracker of Stone Soup with the least OSPA."""
    return min((name for name in found if name != "lmb"), key=lambda name: sum(found[name].ospa))


def told(found: dict[str, Score]) -> str:
    """OSPA and time of each tracker."""
    each = (f"{NAMES[n]} {np.mean(s.ospa):.3g} m, {s.ms:.3g} ms" for n, s in found.items() if n != "lmb")
    return f"{'; '.join(each)}; ours {np.mean(found['lmb'].ospa):.3g} m, {found['lmb'].ms:.3g} ms"


def against_peers(effort: Effort) -> Values:
    found: Values = {}
    for key, clutter, places in (("30", 30, False), ("66", 66, False), ("phd", 30, True)):
        own = scores(clutter, places, effort)
        value = ratio(own["lmb"].ospa, own[best_of(own)].ospa)
        found[f"ospa_ratio_{key}"] = value._replace(detail=f"{value.detail}; {told(own)}")
    own = scores(30, False, effort)
    best = best_of(own)
    quickest = min(s.ms for n, s in own.items() if n != "lmb") / own["lmb"].ms
    busy, known = scores(66, False, effort), scores(30, True, effort)
    others = [f"{n} {s[best_of(s)].ms / s['lmb'].ms:.0f}" for n, s in (("clutter 66", busy), ("known births", known))]
    detail = f"{NAMES[best]}; the quickest {quickest:.0f}, {', '.join(others)}; {told(own)}"
    found["speedup_stonesoup"] = Value(own[best].ms / own["lmb"].ms, detail)
    return found


def measured(effort: Effort) -> Values:
    if find_spec("stonesoup") is None:
        return {f.key: Value(None, "the extra 'peers' is not installed") for f in AGAINST.figures}
    return against_peers(effort)


CROSSING = "of twelve crossing targets, cut-off 100 m, order 1, over that of the best tuned tracker of Stone Soup"
AGAINST = Measurement(
    (
        Figure(
            "ospa_ratio_30",
            "",
            f"OSPA {CROSSING} of GNN and JPDA-EHM2; 30 false alarms a scan, births by measurements",
            at_most=0.92,
        ),
        Figure("ospa_ratio_66", "", "the same with 66 false alarms a scan", at_most=0.85),
        Figure(
            "ospa_ratio_phd",
            "",
            "OSPA over that of Stone Soup's tuned GM-PHD, both knowing where targets come from; 30 false alarms a scan",
            at_most=0.75,
        ),
        Figure(
            "speedup_stonesoup",
            "",
            "median time of a scan of the tracker that is best at 30 false alarms over ours, births by measurements",
            at_least=100.0,
        ),
    ),
    measured,
)
MEASUREMENTS = (AGAINST,)
