"""Routes: every track on the entry and the exit lane that it drove."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from experiments.scenarios.protocol import protocol
from experiments.scenarios.scene import JunctionTruth, Scene, join_tracks
from models.intersection.routes import Routes, Routing, distinct, find_routes
from models.intersection.state import Junction
from models.intersection.tracks import Tracks
from models.program import InputError
from tests.test_junction_metrics import SLOTS, perfect

MODEL = Junction()


def estimate(truth: JunctionTruth) -> dict[str, NDArray[Any]]:
    return perfect(truth) | {"bend": np.zeros(SLOTS)}


def routes(scene: Scene, tracks: Tracks) -> Routes:
    return find_routes(MODEL, MODEL.prepare(tracks), estimate(scene.truth))


def lanes_of(found: Routes) -> NDArray[np.int64]:
    """(T, 4) entry arm, entry lane, exit arm, exit lane of every track, -1 without a route."""
    return np.where(found.track_route[:, None] >= 0, found.connections[found.track_route], -1)


def singles(tracks: Tracks) -> list[NDArray[np.float64]]:
    return np.split(tracks.points, tracks.offsets[1:-1])


def direction(angle: float) -> NDArray[np.float64]:
    return np.array([math.cos(angle), math.sin(angle)])


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(6))
def test_every_track_is_on_its_true_connection(seed: int, noise: float) -> None:
    scene = protocol(seed, position_std=noise)
    found = routes(scene, scene.data)
    np.testing.assert_array_equal(lanes_of(found), scene.truth.connections[scene.truth.track_lane])
    np.testing.assert_array_equal(found.connections, np.unique(scene.truth.connections, axis=0))


def test_the_numbering_of_the_arms_is_that_of_the_estimate() -> None:
    scene = protocol(0, position_std=0.0)
    arms = len(scene.truth.angle)
    order = np.random.default_rng(0).permutation(arms)
    shuffled = {
        name: value if value.ndim != 1 or len(value) != SLOTS else np.r_[value[order], value[arms:]]
        for name, value in estimate(scene.truth).items()
    }
    found = lanes_of(find_routes(MODEL, MODEL.prepare(scene.data), shuffled))
    true = scene.truth.connections[scene.truth.track_lane]
    np.testing.assert_array_equal(order[found[:, [0, 2]]], true[:, [0, 2]])
    np.testing.assert_array_equal(found[:, [1, 3]], true[:, [1, 3]])


def test_a_track_beside_all_arms_is_on_no_route() -> None:
    """It crosses from the middle of one gap between arms to that of another, and changes no other route."""
    scene = protocol(0, position_std=0.0)
    angle = np.sort(scene.truth.angle)
    between = np.diff(angle, append=angle[0] + 2 * math.pi)
    entry, exit = (angle + between / 2)[np.argsort(between)[-2:]]
    s = np.arange(2.0, 60.0)[:, None]
    stray = scene.truth.centre + np.concatenate([s[::-1] * direction(entry), s * direction(exit)])
    found = routes(scene, join_tracks([*singles(scene.data), stray], None))
    assert found.track_route[-1] == -1
    true = scene.truth.connections[scene.truth.track_lane]
    np.testing.assert_array_equal(lanes_of(found)[:-1], true)


def test_a_track_that_stays_on_its_entry_is_on_no_route() -> None:
    """Its half on the arm is well known, but where it went nobody saw."""
    scene = protocol(0, position_std=0.0)
    pieces = singles(scene.data)
    found = routes(scene, join_tracks([pieces[0][:25], *pieces[1:]], None))
    assert found.track_route[0] == -1
    assert np.all(found.track_route[1:] >= 0)


def test_a_track_seen_from_the_last_metres_of_its_entry_goes_by_these() -> None:
    """Too little for a half track, but on its lane and in its direction."""
    scene = protocol(0, position_std=0.0)
    pieces, true = singles(scene.data), scene.truth.connections[scene.truth.track_lane]
    radius = scene.truth.radius[true[0, 0]]
    near = np.linalg.norm(pieces[0] - scene.truth.centre, axis=1) < radius + 6.0
    cut = pieces[0][near.argmax() :]
    found = routes(scene, join_tracks([cut, *pieces[1:]], None))
    np.testing.assert_array_equal(lanes_of(found), true)


@pytest.mark.parametrize("num", [0, 1, 200])
def test_distinct_rows_are_those_of_numpy(num: int) -> None:
    rows = np.random.default_rng(num).integers(-1, 4, (num, 4))
    expected, which = np.unique(rows, axis=0, return_inverse=True)
    found = distinct(rows)
    np.testing.assert_array_equal(found[0], expected)
    np.testing.assert_array_equal(found[1], which.reshape(-1))


def test_an_unnormalised_likelihood_is_refused() -> None:
    scene = protocol(0)
    model = Junction(likelihood="half", bend_std=0.0)
    with pytest.raises(ValueError, match=r"^routes need likelihood 'exact', but this model has 'half'$"):
        find_routes(model, model.prepare(scene.data), estimate(scene.truth))


def test_thresholds_act_and_must_be_positive() -> None:
    """Vehicles that begin short of a half on their entry arm: ends count where a lane is close enough."""
    scene = protocol(0, position_std=0.0)
    short = [line[len(line) // 2 - 12 :] for line in singles(scene.data)]
    tracks = join_tracks(short, None)
    evidence = MODEL.prepare(tracks)
    near, far = (find_routes(MODEL, evidence, estimate(scene.truth), Routing(close=close)) for close in (0.05, 4.0))
    assert (near.track_route >= 0).sum() < (far.track_route >= 0).sum()
    with pytest.raises(InputError, match="close of the routes must be positive, but is 0"):
        Routing(close=0.0)
