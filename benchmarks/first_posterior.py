"""The first posterior of a fresh process, for the figures on start-up: python -m benchmarks.first_posterior.

Prints one JSON object: finished, the time of day [s]; compiling, what numba compiled [s]."""

from __future__ import annotations

import json
import time


def main() -> None:
    """Run a small scene as a user would: import, simulate, prepare, sample, polish."""
    from numba.core import event

    compiling = [0.0]

    def add(seconds: float) -> None:
        compiling[0] += seconds

    from benchmarks.junction import DEFAULT, attempt
    from experiments.scenarios.protocol import protocol

    with event.install_timer("numba:compile", add):  # its timer counts nested compilation once
        attempt(DEFAULT, protocol(0, max_lanes=1, tracks=2).data, seed=0)
    print(json.dumps({"finished": time.time(), "compiling": compiling[0]}))


if __name__ == "__main__":
    main()
