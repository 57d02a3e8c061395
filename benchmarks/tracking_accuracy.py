"""Are covariances right, where is the car ahead, and who is who among close vehicles?"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.configured import configured, quiet_engine
from benchmarks.figure import Figure, Measurement, Value, Values
from benchmarks.tracking_trials import Effort, lmb, ratio
from experiments import lead_metrics, view_metrics
from experiments.scenarios.close_targets import close_targets
from experiments.scenarios.lead_vehicle import lead_vehicle
from experiments.scenarios.scene import Scene
from experiments.scenarios.urban_sensors import urban_sensors
from experiments.tracking_metrics import judge
from inference.progress import Progress
from inference.tracks import Tracks

Floats = NDArray[np.float64]
PATTERNS = ("meeting", "abreast", "column")
CLOSE = 10.0  # cut-off [m]
SETTLED = 20  # scans (4 s) after which the first vehicles are long confirmed, and the window of OSPA(2) is past them
PAPER = "< .30 m at 30 to 100 m"


def consistency(effort: Effort) -> Values:
    model, engine = configured("model", "traffic_urban"), lmb()
    found, counted = list[float](), min(effort.scenes, 8)
    with Progress("nees", counted, effort.show) as bar:
        for seed in range(counted):
            scene = urban_sensors(seed, 20, effort.seconds)
            found.append(view_metrics.metrics(engine(model, scene.data.scans), scene, traffic=model)["nees"])
            bar.advance(1)
    return {"nees": Value(float(np.mean(found)), f"{counted} scenes, {min(found):.3g} to {max(found):.3g}")}


def lead(effort: Effort) -> Values:
    model, engine, found = configured("model", "traffic_rural"), lmb(), dict[str, list[dict[str, float]]]()
    suites, counted = ("all", "radar_laser", "radar_camera"), min(effort.scenes, 6)
    with Progress("lead", len(suites) * counted, effort.show) as bar:
        for suite in suites:
            for seed in range(counted):
                scene = lead_vehicle(seed, 3 * effort.seconds, suite)  # type: ignore[arg-type]
                found.setdefault(suite, []).append(lead_metrics.metrics(engine(model, scene.data.scans), scene))
                bar.advance(1)

    def mean(suite: str, name: str) -> float:
        return float(np.mean([row.get(name, float("nan")) for row in found[suite]]))

    def told(values: dict[str, float]) -> str:
        return f"{each} each; " + ", ".join(f"{suite} {value:.4f}" for suite, value in values.items())

    each = f"{counted} drives of {3 * effort.seconds:g} s"
    pairs = {suite: mean(suite, "lead_m") for suite in suites[1:]}
    missed = {suite: mean(suite, "lead_miss") for suite in suites}
    return {
        "lead_m_all": Value(mean("all", "lead_m"), f"{each}; 95 % within {mean('all', 'lead_95_m'):.3g} m"),
        "lead_m_two": Value(max(pairs.values()), told(pairs)),
        "lead_miss": Value(max(missed.values()), told(missed)),
    }


def close(effort: Effort) -> Values:
    model = configured("model", "traffic_close")
    ours, theirs = list[Floats](), list[Floats]()
    shares = list[str]()
    with Progress("close vehicles", len(PATTERNS) * effort.scenes, effort.show) as bar:
        for pattern in PATTERNS:
            for seed in range(effort.scenes):
                scene = close_targets(seed, pattern)  # type: ignore[arg-type]
                ours.append(ospa2_m(lmb(), model, scene))
                theirs.append(ospa2_m(quiet_engine("nearest_neighbour"), model, scene))  # type: ignore[arg-type]
                bar.advance(1)
            shares.append(f"{pattern} {mean_ratio(ours[-effort.scenes :], theirs[-effort.scenes :]):.3f}")
    found = ratio([each.mean() for each in ours], [each.mean() for each in theirs])
    parts = slice(SETTLED), slice(SETTLED, None)
    early, late = (mean_ratio([each[part] for each in ours], [each[part] for each in theirs]) for part in parts)
    told = f"{', '.join(shares)}; the first {SETTLED} scans {early:.3f}, then {late:.3f}"
    return {"close_ratio": found._replace(detail=f"{found.detail}; {told}")}


def mean_ratio(ours: Sequence[Floats], theirs: Sequence[Floats]) -> float:
    """Mean of ours over mean of theirs, all scans of all scenes alike."""
    return float(np.mean(ours) / np.mean(theirs))


def ospa2_m(engine: Callable[..., Tracks], model: object, scene: Scene) -> Floats:
    """OSPA(2) distance (T,) after each scan."""
    return judge(engine(model, scene.data.scans).confirmed(), scene.truth, cutoff=CLOSE).ospa2


MEASUREMENTS = (
    Measurement(
        (
            Figure(
                "nees",
                "",
                "(x - mean)' covariance^-1 (x - mean) of positions, mean over scans and the tracks assigned to 20 road "
                "users, in view of a sensor; 2 where covariances are right",
                at_least=1.6,
                at_most=2.4,
            ),
        ),
        consistency,
    ),
    Measurement(
        (
            Figure(
                "lead_m_all",
                "m",
                "mean distance of the nearest estimate to the vehicle ahead, 30 to 100 m away on a winding road, "
                "errors of any size counted; radar, laser and camera",
                PAPER,
                at_most=0.12,
            ),
            Figure("lead_m_two", "m", "the same by two sensors, the worse pair with a radar", PAPER, at_most=0.15),
            Figure(
                "lead_miss",
                "",
                "share of scans without an estimate within 3 m of it, the worst of the three",
                at_most=0.005,
            ),
        ),
        lead,
    ),
    Measurement(
        (
            Figure(
                "close_ratio",
                "",
                "OSPA(2) of four close vehicles in three patterns, 3 m apart at a noise of 1 m, over that of Kalman "
                "instances fed with global nearest neighbours; same model and scans",
                at_most=0.8,
            ),
        ),
        close,
    ),
)
