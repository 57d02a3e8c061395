"""Stone Soup's trackers behind our interface: the same targets, and clear words where they cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from experiments.scenarios.crossing_targets import crossing_targets
from experiments.stonesoup_engine import run
from experiments.tracking_metrics import metrics
from inference import nearest_neighbour
from models.objects.motion import ConstantVelocity
from models.objects.scans import Scan
from models.objects.sensors import Position, Radar
from models.objects.traffic import Kind, Place, Traffic
from models.program import InputError

pytest.importorskip("stonesoup", reason="the extra 'peers' is not installed")
PLOTS = Position(name="plots", noise_std=(10.0, 10.0), detection=0.98, clutter=1.0, extent=1000.0)
MODEL = Traffic((PLOTS,), ConstantVelocity(), (Kind(noise=(1.0, 1.0), speed=(0.0, 12.0)),))


def straight(num: int = 15) -> list[Scan]:
    rng = np.random.default_rng(0)
    return [
        Scan("plots", float(t), np.array([[7.0 * t, -4.0 * t]]) + 10.0 * rng.standard_normal((1, 2)), np.zeros(3))
        for t in range(num)
    ]


@pytest.mark.parametrize("tracker", ["gnn", "jpda"])
def test_one_target_is_where_a_kalman_filter_of_ours_has_it(tracker: str) -> None:
    theirs = run(MODEL, straight(), tracker=tracker, hits=2)  # type: ignore[arg-type]
    ours = nearest_neighbour.run(MODEL, straight(), hits=2, looks=2)
    assert len(set(theirs.label)) == 1
    a, b = theirs.at(14), ours.at(14)
    # ours begins from a wide but proper prior of its place, 1e-4 of a measurement; jpda doubts a little
    np.testing.assert_allclose(a.mean, b.mean, atol=0.01 if tracker == "gnn" else 0.5)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=0.01 if tracker == "gnn" else 0.1, atol=0.05)


def test_the_tree_leaves_nothing_out_that_matters() -> None:
    scans = crossing_targets(0, 5.0).data.scans[:30]
    near, all_of_them = (run(MODEL, scans, tracker="jpda", near=near) for near in (200.0, 1e9))
    np.testing.assert_allclose(near.count_mean(), all_of_them.count_mean())
    for t in range(30):
        rows = [np.lexsort(tracks.at(t).mean.T) for tracks in (near, all_of_them)]
        np.testing.assert_allclose(near.at(t).mean[rows[0]], all_of_them.at(t).mean[rows[1]], atol=1e-6)


def test_phd_finds_the_targets_that_come_from_the_places_of_the_model() -> None:
    scene = crossing_targets(1, 2.0)
    corners = ((0.0, 0.0), (400.0, -600.0), (-800.0, -200.0), (-200.0, 800.0))
    model = replace(MODEL, places=tuple(Place(at, 10.0, 0.03) for at in corners))
    few = scene.data.scans[:30]
    tracks = run(model, few, tracker="phd", merge=16.0)
    counts = tracks.count_mean()
    assert counts[15] == pytest.approx(3.0, abs=0.3) and counts[-1] == pytest.approx(6.0, abs=0.6)
    assert metrics(tracks, scene, cutoff=100.0)["ospa_m"] < 30.0


def test_what_they_cannot_track_is_refused() -> None:
    radar = Radar(name="plots", noise_std=(1.0, 0.01, 0.1))
    with pytest.raises(InputError, match="know sensors of positions here; plots is of another sort"):
        run(replace(MODEL, sensors=(radar,)), [Scan("plots", 0.0, np.zeros((0, 3)), np.zeros(3))])
    with pytest.raises(InputError, match="one kind of constant velocity"):
        run(replace(MODEL, sensors=(PLOTS, replace(PLOTS, name="more"))), straight())
    with pytest.raises(InputError, match="phd needs places"):
        run(MODEL, straight(), tracker="phd")
    with pytest.raises(InputError, match="rising times"):
        run(MODEL, straight()[::-1])
