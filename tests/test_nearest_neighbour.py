"""Kalman filters fed with nearest neighbours: equal to Kalman's, where nothing is in doubt; swapped, where it is."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from inference import lmb, nearest_neighbour
from inference.nearest_neighbour import run
from models.objects.motion import ConstantTurn, ConstantVelocity
from models.objects.scans import Scan
from models.objects.sensors import Position, RangeBearing
from models.objects.traffic import Kind, Place, Traffic
from models.program import InputError

PLOTS = Position(name="plots", noise_std=(1.0, 2.0), detection=1.0, clutter=1e-9, extent=1000.0)
MODEL = Traffic((PLOTS,), ConstantVelocity(), (Kind(noise=(0.5, 0.5), lifetime=1e9, speed=(0.0, 10.0)),))


def plots(*scans: list[tuple[float, float]], period: float = 1.0) -> list[Scan]:
    values = (np.array(scan, dtype=float).reshape(-1, 2) for scan in scans)
    return [Scan("plots", period * i, z, np.zeros(3)) for i, z in enumerate(values)]


def test_one_object_without_doubt_has_the_state_and_covariance_of_a_kalman_filter() -> None:
    rng = np.random.default_rng(0)
    place = np.stack([5.0 * np.arange(30), -3.0 * np.arange(30)], -1) + rng.standard_normal((30, 2))
    tracks = run(MODEL, plots(*([tuple(z)] for z in place)), hits=1, looks=1)
    R, H = np.diag([1.0, 4.0]), np.eye(2, 4)
    mean, P = np.zeros(4), np.diag([0.0, 0.0, 100.0, 100.0])
    mean[:2], P[:2, :2] = place[0], 1e4 * R  # the model's flat prior, at the measurement
    F = np.eye(4) + np.eye(4, k=2)
    Q = 0.25 * np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2))
    for t, z in enumerate(place):
        if t:
            mean, P = F @ mean, F @ P @ F.T + Q
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        mean, P = mean + K @ (z - H @ mean), P - K @ S @ K.T
        np.testing.assert_allclose(tracks.at(t).mean, mean[None], rtol=0, atol=1e-9)
        np.testing.assert_allclose(tracks.at(t).covariance, P[None], rtol=0, atol=1e-9)
    assert set(tracks.label) == {0} and (tracks.existence == 1.0).all()


def test_it_keeps_the_labels_of_the_lmb_filter_where_objects_are_far_apart() -> None:
    steps = [[(4.0 * t, 0.0), (300.0 - 2.0 * t, 200.0)] for t in range(12)]
    steps[6] = steps[6][:1]  # one is missed once
    scans = plots(*steps)
    model = replace(MODEL, sensors=(replace(PLOTS, detection=0.9),))
    ours, filtered = run(model, scans), lmb.run(model, scans).confirmed()
    for t in range(4, 12):
        a, b = ours.at(t), filtered.at(t)
        assert len(a.label) == len(b.label) == 2
        order = np.argsort(a.mean[:, 1]), np.argsort(b.mean[:, 1])
        np.testing.assert_allclose(a.mean[order[0]], b.mean[order[1]], atol=1e-3)
    assert len(set(ours.label)) == 2


def test_the_nearest_measurements_swap_two_objects_that_pass_each_other() -> None:
    """They turn back where they meet, but the association that is most probable at each scan lets them go on."""
    gap = np.abs(np.linspace(-20.0, 20.0, 21))
    tracks = run(MODEL, plots(*([(0.0, y), (0.0, -y)] for y in gap)), hits=2, looks=2)
    upper = [int(tracks.at(t).label[np.argmax(tracks.at(t).mean[:, 1])]) for t in (2, 20)]
    assert upper[0] != upper[1]
    assert set(tracks.label) == {0, 1}


def test_an_object_is_confirmed_by_its_hits_and_ended_by_its_misses() -> None:
    here, gone = [(0.0, 0.0)], list[tuple[float, float]]()
    model = replace(MODEL, sensors=(replace(PLOTS, detection=0.9),))
    scans = plots(here, gone, here, here, here, gone, here, gone, gone, gone, here)
    counts = np.diff(run(model, scans, hits=3, looks=4, misses=3, gone=100.0).offset)
    assert counts.tolist() == [0, 0, 0, 1, 1, 1, 1, 1, 1, 0, 0]
    assert np.diff(run(model, plots(here, gone, gone, here, here), hits=3, looks=4).offset).sum() == 0


def test_an_object_out_of_view_is_not_missed_but_gone_after_a_while() -> None:
    beam = RangeBearing(name="beam", angle=0.5, noise_std=(0.5, 0.01), detection=0.95, clutter=0.1)
    model = Traffic((beam,), ConstantVelocity(), (Kind(noise=(0.1, 0.1), speed=(0.0, 5.0)),))
    ahead, away = np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, np.pi])
    scans = [Scan("beam", 0.1 * t, np.array([[50.0, 0.0]]), ahead) for t in range(5)]
    scans += [Scan("beam", 0.1 * t, np.zeros((0, 2)), away) for t in range(5, 20)]
    counts = np.diff(run(model, scans, misses=2, gone=1.0).offset)
    assert counts[4] == 1 and counts[12] == 1 and counts[-1] == 0


def test_headings_that_do_not_foretell_what_comes_end() -> None:
    model = Traffic(
        (Position(name="plots", noise_std=(0.2, 0.2), extent=500.0, clutter=0.01, detection=0.98),),
        ConstantTurn(),
        (Kind(speed=(8.0, 2.0)),),
    )
    belief, knobs = nearest_neighbour.nobody(len(model.names)), nearest_neighbour.Knobs()
    sizes = []
    for number, scan in enumerate(plots(*([(0.0, 8.0 * 0.1 * t)] for t in range(20)), period=0.1)):
        belief, _ = nearest_neighbour.step(model, belief, scan, number, knobs)
        sizes.append(len(belief.objects.components.weight))
    assert sizes[0] == 4 and sizes[-1] == 1
    assert belief.objects.components.mean[0, 2] == pytest.approx(np.pi / 2, abs=0.1)
    assert belief.objects.components.weight.sum() == pytest.approx(1.0)


def test_objects_begin_at_known_places_alone_where_the_sensor_begins_none() -> None:
    sensor = replace(PLOTS, detection=0.9, clutter=1.0, births=False)
    model = replace(MODEL, sensors=(sensor,), places=(Place((0.0, 0.0), 5.0, 0.1),))
    both = [[(3.0 * t, 0.0), (400.0 + t, 0.0)] for t in range(8)]
    tracks = run(model, plots([], *both))
    assert set(tracks.label) == {0} and (np.abs(tracks.position[:, 0]) < 100.0).all()


def test_what_it_cannot_use_is_refused() -> None:
    with pytest.raises(InputError, match="hits is 3 and looks 2"):
        run(MODEL, plots([(0.0, 0.0)]), hits=3, looks=2)
    with pytest.raises(InputError, match="nearest_neighbour needs a model of many objects"):
        run(object(), plots([(0.0, 0.0)]))  # type: ignore[arg-type]


def test_evidence_is_that_of_the_association_chosen() -> None:
    """Of the first scan log(clutter + unseen), of the second p_D g where the measurement is the object's."""
    sensor = replace(PLOTS, detection=0.9, clutter=1.0)
    model = replace(MODEL, sensors=(sensor,), unseen_density=1e-9)
    found = run(model, plots([(0.0, 0.0)], [(1.0, 1.0)])).log_evidence
    kappa = 1.0 / 2000.0**2 + 0.9 * 1e-9
    S = np.diag([1.0, 4.0]) + np.diag([1.0, 4.0]) + (100.0 + 0.25 / 3) * np.eye(2)
    z = np.ones(2)
    hit = -0.5 * z @ np.linalg.solve(S, z) - 0.5 * np.log(np.linalg.det(2 * np.pi * S)) + np.log(0.9)
    assert found == pytest.approx(np.log(kappa) + hit, abs=1e-3)


def test_memory_is_that_of_a_table_of_objects_and_measurements() -> None:
    """Many false alarms, each of which begins an object: no more than numbers are kept of a pair (measured: 4 of 8
    bytes), no states."""
    rng, num = np.random.default_rng(0), 1000
    model = replace(MODEL, sensors=(replace(PLOTS, detection=0.9, clutter=float(num)),))
    scans = plots(*(list(map(tuple, rng.uniform(-1000.0, 1000.0, (num, 2)))) for _ in range(2)), period=0.1)
    run(model, plots([(0.0, 0.0)], [(0.0, 0.0)]))  # compiles
    tracemalloc.start()
    found = run(model, scans, hits=1, looks=1)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert np.diff(found.offset)[0] == num
    assert peak < 20 * 8 * num**2
