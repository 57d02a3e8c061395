"""Settings of Stone Soup's trackers for benchmarks.tracking: python -m benchmarks.tracking_tune [TRACKER CLUTTER]

One setting after the other is moved to where OSPA is least on scenes that are not reported, until none moves or twice
round. It takes half an hour; benchmarks.tracking_peers holds what came out."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

from benchmarks.timing import single_thread

SEEDS = (100, 101)
ROUNDS = 2
GRID: dict[str, dict[str, Sequence[float]]] = {
    "gnn": {"hits": (3, 4, 5), "gate": (3.0, 3.5, 4.0), "misses": (2, 3), "held": (1, 2)},
    "phd": {"merge": (4.0, 16.0, 50.0), "gate": (3.0, 4.0, 5.0), "prune": (1e-5, 1e-4, 1e-3)},
}
GRID["jpda"] = GRID["gnn"]
START: dict[str, dict[str, float]] = {
    "gnn": {"hits": 4, "gate": 3.5, "misses": 2, "held": 1},
    "jpda": {"hits": 4, "gate": 3.5, "misses": 2, "held": 1},
    "phd": {"merge": 16.0, "gate": 4.0, "prune": 1e-4},
}


def tune(tracker: str, clutter: float, seeds: Sequence[int] = SEEDS, rounds: int = ROUNDS) -> dict[str, Any]:
    """The best settings found, printing every one tried."""
    from benchmarks.tracking_trials import ospa_m, plots
    from experiments.scenarios.crossing_targets import crossing_targets
    from experiments.stonesoup_engine import run

    model, scenes = plots(clutter, places=tracker == "phd"), [crossing_targets(seed, clutter) for seed in seeds]
    known: dict[tuple[float, ...], float] = {}

    def score(settings: dict[str, Any]) -> float:
        key = tuple(settings.values())
        if key not in known:
            runs = [run(model, scene.data.scans, tracker=tracker, **settings) for scene in scenes]  # type: ignore[arg-type]
            known[key] = sum(map(ospa_m, runs, scenes)) / len(scenes)
            print(f"{tracker} {clutter:g} {settings}: OSPA {known[key]:.3f} m", flush=True)
        return known[key]

    best: dict[str, Any] = dict(START[tracker])
    for _ in range(rounds):
        before = dict(best)
        for name, values in GRID[tracker].items():
            best = min((best | {name: value} for value in values), key=score)
        if best == before:
            break
    print(f"{tracker} {clutter:g}: best {best}, OSPA {score(best):.3f} m", flush=True)
    return best


def main(words: list[str]) -> int:
    single_thread()
    pairs = [(words[0], float(words[1]))] if words else [(t, c) for c in (30.0, 66.0) for t in GRID]
    for tracker, clutter in pairs:
        tune(tracker, clutter)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
