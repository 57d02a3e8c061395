"""How far to trust a course: outcomes for cuts and prices of its range: python -m benchmarks.road_cut [scenes]

Seeds from FIRST on, which no figure of benchmarks.road counts; the engine is the same."""

from __future__ import annotations

import sys

import numpy as np

from benchmarks.timing import single_thread

FIRST = 5000
CUTS, PRICES = (0.7, 0.8, 0.9, 0.95), (0.0, 150.0, 250.0, 400.0)


def main(num: int = 300) -> None:
    single_thread()
    from benchmarks.road_trials import MODEL, best
    from experiments import road_metrics as rm
    from experiments.scenarios.road import night_road

    counts = np.zeros((len(CUTS), len(PRICES), 4))  # true, false, none, metres
    for seed in range(FIRST, FIRST + num):
        scene = night_road(seed)
        posterior = best()(MODEL, MODEL.prepare(scene.data), seed=seed)
        check = rm.check_course(posterior, scene.truth["line"])
        guess = rm.course_points(posterior.mean("course"))
        apart = rm.lateral_offsets(rm.drawn_courses(posterior), guess)
        for i, cut in enumerate(CUTS):
            for j, price in enumerate(PRICES):
                reach = rm.trusted_range(apart, cut, price)
                outcome = check._replace(reach=reach).outcome
                counts[i, j, ("true", "false", "none").index(outcome)] += 1.0
                counts[i, j, 3] += reach * (outcome != "none")
    print(" cut  price [m]   true  false   none  range [m]")
    for cut, row in zip(CUTS, counts / num, strict=True):
        for price, (true, false, none, metres) in zip(PRICES, row, strict=True):
            print(f"{cut:4.2f} {price:10.0f} {true:6.3f} {false:6.3f} {none:6.3f} {metres:10.1f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
