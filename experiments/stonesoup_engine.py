"""Trackers of Stone Soup on a model of traffic, for comparison (extra `peers`).

    gnn    a Kalman filter a target, global nearest neighbours by Mahalanobis distance
    jpda   the same, joint probabilistic data association (efficient hypothesis management, EHM2)
    phd    Gaussian-mixture probability hypothesis density filter; newcomers from the model's places alone

Targets of gnn and jpda begin at measurements that no target explains: held back until `hits` measurements came,
dropped after `held` scans without one, later after `misses`. Stone Soup's k-d tree leaves out measurements farther than
`near` from where a target is predicted before anything is computed of them: without it the same comes out later.

What moves and what is seen is the model's: one kind of constant velocity, one sensor of positions.
"""

from __future__ import annotations

import datetime
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from inference.progress import Progress
from inference.refusal import accept, answers_first
from inference.tracks import Objects, Tracks
from models.objects.motion import ConstantVelocity
from models.objects.scans import Scan
from models.objects.scene import ScanFrame
from models.objects.sensors import Position
from models.objects.traffic import Traffic
from models.program import InputError

Floats = NDArray[np.float64]
START = datetime.datetime(2000, 1, 1)
ORDER = [0, 2, 1, 3]  # x, y, vx, vy from x, vx, y, vy, and back
Step = Callable[[datetime.datetime, set[Any]], list[tuple[str, float, Any]]]  # -> name, existence, Gaussian state


class Parts(NamedTuple):
    """A model as Stone Soup has it."""

    predictor: Any
    updater: Any
    measurement: Any
    detection: float
    clutter: float  # [1/m^2]
    survival: float
    drift: float  # [m/s]


@answers_first
def run(
    model: Traffic,
    scans: Sequence[Scan | ScanFrame],
    *,
    seed: int = 0,
    tracker: Literal["gnn", "jpda", "phd"] = "gnn",
    gate: float = 4.0,
    hits: int = 3,
    held: int = 1,
    misses: int = 2,
    near: float = 200.0,
    prune: float = 1e-4,
    merge: float = 4.0,
    progress: bool = False,
) -> Tracks:
    """Targets after each scan; those of gnn and jpda exist for sure, those of phd by the weight of their component.

    gate    Mahalanobis distance beyond which a measurement is not of a target
    hits    measurements that confirm a target (gnn, jpda)
    held    scans in a row without a measurement that end one not confirmed yet (gnn, jpda)
    misses  the same of a confirmed one (gnn, jpda)
    near    [m] (gnn, jpda)
    prune   components lighter than this are left out (phd)
    merge   squared Mahalanobis distance within which components are one (phd)

    Nothing is random but the names of targets: `seed` is not read. Raises InputError where Stone Soup is missing, and
    for a model or scans that these trackers cannot use."""
    try:
        import stonesoup  # noqa: F401
    except ImportError as error:
        raise InputError("Stone Soup is not installed; install the extra 'peers'") from error
    if not isinstance(model, Traffic):
        raise InputError(f"Stone Soup's trackers need a model of traffic; {type(model).__name__} is none")
    found = model.check(scans)
    when = np.array([scan.time for scan in found])
    if not len(when) or (np.diff(when) <= 0.0).any():
        raise InputError("Stone Soup's trackers need scans of rising times; leave out late ones")
    parts = parts_of(model, float(np.median(np.diff(when))) if len(when) > 1 else 1.0)
    if tracker == "phd":
        step = density_filter(model, parts, gate, prune, merge)
    else:
        step = target_filter(parts, tracker == "jpda", gate, hits, held, misses, near)
    accept()
    return _tracks(model, found, step, progress, tracker)


def parts_of(model: Traffic, period: float) -> Parts:
    """What Stone Soup needs, with the survival of `period` seconds. Raises InputError for other models."""
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel as Both
    from stonesoup.models.transition.linear import ConstantVelocity as Straight
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.updater.kalman import KalmanUpdater

    alone = len(model.kinds) == len(model.sensors) == 1
    if not alone or type(model.motion) is not ConstantVelocity or model.motion.extras:
        raise InputError(
            f"Stone Soup's trackers know one kind of constant velocity and one sensor here; the model has "
            f"{len(model.kinds)} of {type(model.motion).__name__}, and {len(model.sensors)} sensors"
        )
    (kind,), (sensor,) = model.kinds, model.sensors
    if not isinstance(sensor, Position):
        raise InputError(f"Stone Soup's trackers know sensors of positions here; {sensor.name} is of another sort")
    measurement = LinearGaussian(4, (0, 2), np.diag(np.square(sensor.noise_std)))
    motion = Both([Straight(q**2) for q in kind.noise])
    return Parts(
        KalmanPredictor(motion),
        KalmanUpdater(measurement),
        measurement,
        sensor.detection,
        sensor.clutter / (2 * sensor.extent) ** 2,
        float(np.exp(-period / kind.lifetime)),
        float(np.hypot(*kind.speed)),
    )


def target_filter(
    parts: Parts, probabilistic: bool, gate: float, hits: int, held: int, misses: int, near: float
) -> Step:
    """gnn, or jpda where `probabilistic`."""
    from scipy.stats import chi2
    from stonesoup.dataassociator.probability import JPDAwithEHM2
    from stonesoup.dataassociator.tree import DetectionKDTreeGNN2D, DetectionKDTreeMixIn
    from stonesoup.deleter.time import UpdateTimeStepsDeleter
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.initiator.simple import MultiMeasurementInitiator
    from stonesoup.measures import Mahalanobis
    from stonesoup.tracker.simple import MultiTargetMixtureTracker, MultiTargetTracker
    from stonesoup.types.state import GaussianState

    class Probabilistic(DetectionKDTreeMixIn, JPDAwithEHM2):  # type: ignore[misc]
        """JPDAwithEHM2 behind the tree."""

    common = (parts.predictor, parts.updater)
    nearest = DetectionKDTreeGNN2D(
        DistanceHypothesiser(*common, Mahalanobis(), missed_distance=gate), *common, max_distance=near
    )
    prior = GaussianState([[0.0]] * 4, np.diag([0.0, parts.drift**2] * 2))
    initiator = MultiMeasurementInitiator(
        prior, UpdateTimeStepsDeleter(held), nearest, parts.updater, parts.measurement, min_points=hits
    )
    associator, tracker = nearest, MultiTargetTracker
    if probabilistic:
        share = float(chi2.cdf(gate**2, 2))
        likely = PDAHypothesiser(*common, parts.clutter, parts.detection, share)
        associator, tracker = Probabilistic(likely, *common, max_distance=near), MultiTargetMixtureTracker
    arrived: list[tuple[datetime.datetime, set[Any]]] = []

    def feed() -> Iterator[tuple[datetime.datetime, set[Any]]]:
        while True:
            yield arrived.pop()

    whole = tracker(initiator, UpdateTimeStepsDeleter(misses), feed(), associator, parts.updater)
    iterator = iter(whole)

    def step(now: datetime.datetime, detections: set[Any]) -> list[tuple[str, float, Any]]:
        arrived.append((now, detections))
        _, targets = next(iterator)
        return [(target.id, 1.0, target.state) for target in targets]

    return step


def density_filter(model: Traffic, parts: Parts, gate: float, prune: float, merge: float) -> Step:
    """phd. Stone Soup's own tracker has one place for newcomers; here are those of the model."""
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser
    from stonesoup.measures import Mahalanobis
    from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
    from stonesoup.types.state import TaggedWeightedGaussianState as Component
    from stonesoup.updater.pointprocess import PHDUpdater

    if not model.places:
        raise InputError("Stone Soup's phd needs places that newcomers come from; give the model places")
    hypothesiser = GaussianMixtureHypothesiser(
        DistanceHypothesiser(parts.predictor, parts.updater, Mahalanobis(), missed_distance=gate),
        order_by_detection=True,
    )
    updater = PHDUpdater(
        parts.updater,
        clutter_spatial_density=parts.clutter,
        prob_detection=parts.detection,
        prob_survival=parts.survival,
    )
    reducer = GaussianMixtureReducer(prune_threshold=prune, merge_threshold=merge)
    components: list[Any] = []

    def newcomers(now: datetime.datetime) -> list[Any]:
        return [
            Component(
                [[place.position[0]], [0.0], [place.position[1]], [0.0]],
                np.diag([place.std**2, parts.drift**2] * 2),
                timestamp=now,
                weight=place.rate,
                tag=Component.BIRTH,
            )
            for place in model.places
        ]

    def step(now: datetime.datetime, detections: set[Any]) -> list[tuple[str, float, Any]]:
        hypotheses = hypothesiser.hypothesise(components + newcomers(now), detections, now)
        components[:] = reducer.reduce(updater.update(hypotheses).components)
        return [(c.tag, min(float(c.weight), 1.0), c) for c in components if c.weight > 0.01]

    return step


def _tracks(model: Traffic, scans: Sequence[Scan], step: Step, progress: bool, tracker: str) -> Tracks:
    """What a step says after each scan; names are numbered in the order in which they appear."""
    from stonesoup.types.detection import Detection

    told, seconds, numbers = list[Objects](), list[float](), dict[str, int]()
    with Progress("stone soup", len(scans), progress) as bar:
        for scan in scans:
            now = START + datetime.timedelta(seconds=scan.time)
            detections = {Detection(z[:, None], timestamp=now) for z in scan.values}
            began = time.perf_counter()
            found = step(now, detections)
            seconds.append(time.perf_counter() - began)
            label = [numbers.setdefault(name, len(numbers)) for name, _, _ in found]
            mean = np.array([np.asarray(s.state_vector, float).ravel()[ORDER] for *_, s in found]).reshape(-1, 4)
            spread = np.array([np.asarray(s.covar, float)[np.ix_(ORDER, ORDER)] for *_, s in found]).reshape(-1, 4, 4)
            existence = np.array([r for _, r, _ in found], dtype=float)
            told.append(Objects(np.array(label, dtype=np.int64), existence, mean, spread, np.ones((len(found), 1))))
            bar.advance(1)
    rows = [np.concatenate(columns) for columns in zip(*(objects[:5] for objects in told), strict=True)]
    return Tracks(
        time=np.array([scan.time for scan in scans]),
        offset=np.cumsum([0, *(len(objects.label) for objects in told)]),
        label=rows[0],
        existence=rows[1],
        mean=rows[2],
        covariance=rows[3],
        kind=rows[4],
        names=model.names,
        kind_names=model.kind_names,
        sensor=tuple(scan.sensor for scan in scans),
        info={"step_seconds": seconds, "scans": len(scans), "tracker": tracker, "flags": []},
    )
