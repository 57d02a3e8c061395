"""What tracks weigh: dense Gaussian algebra, ends summed over one by one, arrivals, permutations, going on."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from inference.track_mcmc import Library
from inference.track_weight import Track, Window, follow, window_of
from models.objects.traffic import Kind, Place, Traffic
from models.program import InputError
from tests.small_windows import KINDS, existence, posterior, small_model, small_scans


def log_normal(x: np.ndarray, covariance: np.ndarray) -> float:
    return float(-0.5 * x @ np.linalg.solve(covariance, x) - 0.5 * np.linalg.slogdet(2 * math.pi * covariance)[1])


def dense(model: Traffic, window: Window, track: Track) -> float:
    """The weight of a track of a linear model, all of its measurements in one Gaussian, every end by itself."""
    first, z = int(window.scan[track[0]]), np.concatenate([scan.values for scan in window.scans])
    prior, detected, total = window.prior[first], {int(window.scan[g]): g for g in track}, 0.0
    group = track[0] - window.offset[first]
    H, R, p = np.eye(2, 4), np.diag([1.0, 1.5**2]), 0.7
    for c in range(prior.offset[group], prior.offset[group + 1]):
        kind = model.kinds[prior.kind[c]]
        means, blocks = [prior.mean[c]], [[prior.covariance[c]]]
        for s in range(first + 1, len(window.scans)):
            dt = window.seconds[s]
            F = np.eye(4) + dt * np.eye(4, k=2)
            step = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            Q = np.kron(step, np.diag(np.square(kind.noise)))
            means.append(F @ means[-1])
            row = [F @ block for block in blocks[-1]]
            blocks.append([*row, row[-1] @ F.T + Q])  # cov(x_s, x_r), r <= s
        at = [s - first for s in sorted(detected)]
        joint = np.block([[H @ (blocks[a][b] if b <= a else blocks[b][a].T) @ H.T for b in at] for a in at])
        joint += np.kron(np.eye(len(at)), R)
        residual = np.concatenate([z[detected[a + first]] - H @ means[a] for a in at])
        stay = [math.exp(-window.seconds[s] / kind.lifetime) for s in range(len(window.scans))]
        life, weight = 1.0, 0.0
        for end in range(first, len(window.scans)):  # the last scan at which it is there
            life *= (1.0 if end == first else stay[end]) * (p if end in detected else 1.0 - p)
            goes = 1.0 - stay[end + 1] if end + 1 < len(window.scans) else 1.0
            weight += life * goes if end >= max(detected) else 0.0
        total += prior.weight[c] * weight * math.exp(log_normal(residual, joint))
    return math.log(total) - float(window.log_clutter[list(track)].sum())


@pytest.mark.parametrize("track", [(0,), (0, 2), (1, 4, 6), (3,), (5,), (0, 5), (2, 6)])
def test_a_track_weighs_what_dense_gaussian_algebra_says(track: Track) -> None:
    model = small_model()
    window = window_of(model, small_scans())
    (trail,) = follow(model, window, [track], [None], gate=np.inf)
    assert trail.log_weight == pytest.approx(dense(model, window, track), abs=1e-9)


def test_looks_weigh_by_kind() -> None:
    model, scans = small_model(), small_scans()
    shown = tuple(scan._replace(likeness=np.array([[2.0, 0.5]] * len(scan.values))) for scan in scans)
    plain, window = window_of(model, scans), window_of(model, shown)
    track = (0, 3, 5)
    total = 0.0
    for k, kind in enumerate(KINDS):
        alone = small_model((Kind(**{**vars(kind), "share": 1.0}),), unseen_density=1.5e-3 * kind.share)
        own = window_of(alone, scans)
        (trail,) = follow(alone, own, [track], [None], gate=np.inf)
        total += math.exp(trail.log_weight) * (2.0, 0.5)[k] ** 3
    (found,) = follow(model, window, [track], [None], gate=np.inf)
    assert math.exp(found.log_weight) == pytest.approx(total, rel=1e-9)
    assert plain.log_clutter == pytest.approx(window.log_clutter)


def test_ends_have_the_probabilities_of_bayes() -> None:
    model = small_model((Kind(noise=(0.5, 0.5), lifetime=4.0, speed=(0.0, 2.0)),))
    window = window_of(model, small_scans((1, 1, 1, 1)))
    (trail,) = follow(model, window, [(0,)], [None], gate=np.inf)
    stay, miss = np.exp(-window.seconds / 4.0), 0.3
    life = np.cumprod([1.0, *(stay[1:] * miss)])
    end = np.array([life[k] * (1.0 - stay[k + 1] if k < 3 else 1.0) for k in range(4)])
    np.testing.assert_allclose(trail.alive, end[::-1].cumsum()[::-1] / end.sum(), atol=1e-12)


def test_objects_of_known_places_wait_until_they_are_shown() -> None:
    place = Place(position=(1.0, 2.0), std=2.0, rate=0.4)
    kind = Kind(noise=(0.5, 0.5), lifetime=4.0, speed=(0.0, 2.0))
    model = small_model((kind,), unseen_density=1e-30, places=(place,))
    window = window_of(model, small_scans((1, 1, 1)))
    assert window.log_first[0] < -50.0  # nobody has arrived at the first scan
    z, R = window.scans[2].values[0], np.diag([1.0, 1.5**2])
    intensity = 0.0
    for arrived in (1, 2):
        P = np.diag([4.0, 4.0, 4.0, 4.0])
        waits, dt = arrived < 2, window.seconds[2]
        if waits:
            F = np.eye(4) + dt * np.eye(4, k=2)
            P = F @ P @ F.T + np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), 0.25 * np.eye(2))
        number = model.arrived(float(window.seconds[arrived]))[1:].sum() * (0.3 * math.exp(-dt / 4.0) if waits else 1.0)
        intensity += number * 0.7 * math.exp(log_normal(z - np.array(place.position), P[:2, :2] + R))
    assert window.log_first[2] == pytest.approx(math.log(intensity), abs=1e-9)


def test_a_permutation_of_the_measurements_changes_nothing() -> None:
    model, scans = small_model(), small_scans()
    window = window_of(model, scans)
    order = [np.array([1, 0]), np.array([2, 0, 1]), np.array([1, 0])]
    turned = window_of(model, [scan._replace(values=scan.values[o]) for scan, o in zip(scans, order, strict=True)])
    place = np.empty(7, dtype=np.int64)
    for t, o in enumerate(order):
        place[window.offset[t] + o] = window.offset[t] + np.arange(len(o))
    after = posterior(model, turned)
    for tracks, probability in posterior(model, window).items():
        same = tuple(sorted(tuple(int(place[g]) for g in track) for track in tracks))
        assert after[same] == pytest.approx(probability, rel=1e-10)


def test_scans_are_taken_by_time() -> None:
    model, scans = small_model(), small_scans()
    turned = window_of(model, scans[::-1])
    np.testing.assert_array_equal(existence(model, turned), existence(model, window_of(model, scans)))


def test_going_on_from_a_parent_gives_the_same_bits() -> None:
    model = small_model()
    window = window_of(model, small_scans((1, 2, 0, 2, 1, 2)))
    tracks = [t for k in range(1, 5) for t in itertools.combinations(range(8), k) if len({*window.scan[list(t)]}) == k]
    for parent in tracks[::5]:
        library = Library(model, window, math.inf)
        library.learn([(parent, ())])
        library.learn([(track, (parent,)) for track in tracks])
        for track, alone in zip(
            tracks, follow(model, window, tracks, [None] * len(tracks), gate=math.inf), strict=True
        ):
            assert library.weights[track].log_weight == alone.log_weight
            np.testing.assert_array_equal(library.weights[track].alive, alone.alive)


def test_beyond_the_gate_a_track_is_impossible() -> None:
    model, scans = small_model(), small_scans((1, 1))
    far = (scans[0], scans[1]._replace(values=scans[0].values + 100.0))
    window = window_of(model, far)
    (near,) = follow(model, window, [(0, 1)], [None], gate=36.0)
    assert near.log_weight == -math.inf
    with pytest.raises(InputError, match="at least one scan"):
        window_of(model, ())


def test_who_is_surely_gone_stays_gone() -> None:
    """After 400 s at most e^-44 of an object is left, less than is followed: no later scan says more."""
    scans = list(small_scans((1, 0, 0, 0)))
    scans[2:] = [scan._replace(time=scan.time + 400.0) for scan in scans[2:]]
    window = window_of(small_model(), scans)
    (trail,) = follow(small_model(), window, [(0,)], [None], gate=np.inf)
    assert len(trail.alive) == 2 and trail.alive[0] == 1.0 and 0.0 < trail.alive[1] < 1.0
