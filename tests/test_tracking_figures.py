"""Pictures of tracks: they render, show what they should, and the moving one is a small GIF inside the report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import Image

from experiments.report import listed, save_figures
from experiments.scenarios.scene import Scene
from experiments.tracking_animation import Animation, boxes
from experiments.tracking_figures import colours, ego, figures
from inference.posterior import Posterior
from inference.tracks import Tracks
from models.objects.scans import Recording, Scan
from tests.drawn_tracks import believed, traffic


class Seen(NamedTuple):
    time: float
    points: np.ndarray[Any, Any]
    pose: np.ndarray[Any, Any]


def drive(num: int = 20) -> list[Seen]:
    rng = np.random.default_rng(0)
    return [Seen(0.1 * t, rng.uniform(-40, 40, (5, 2)), np.array([1.0 * t, 0.0, 0.0])) for t in range(num)]


def readings(data: list[Seen]) -> list[tuple[float, np.ndarray[Any, Any]]]:
    return [(scan.time, scan.points) for scan in data]


def empty(tracks: Tracks) -> Tracks:
    names = ("label", "existence", "mean", "covariance", "kind")
    none = {name: getattr(tracks, name)[:0] for name in names}
    return replace(tracks, offset=tracks.offset * 0, draws={}, **none)


def test_all_pictures_are_written_and_embedded(tmp_path: Path) -> None:
    truth = traffic()
    drawn = figures(believed(truth), Scene(drive(), truth, "drawn", {}), readings=readings, frames=5)
    images, failures = save_figures(tmp_path, drawn)
    assert failures == {}
    assert sorted(file.name for file in (tmp_path / "figures").iterdir()) == [
        "animation.gif",
        "over_time.png",
        "tracks.png",
    ]
    assert 'src="data:image/gif;base64,R0lG' in images["animation"]
    assert 'src="data:image/png;base64,' in images["tracks"]


def test_the_moving_picture_is_small_and_shows_its_frames(tmp_path: Path) -> None:
    truth = traffic(num=8, num_scans=40)
    drawn = figures(believed(truth), Scene(None, truth, "drawn", {}), frames=100)["animation"]
    drawn.savefig(tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 40
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(39)
        assert (np.abs(np.asarray(film.convert("RGB")).astype(int) - first) > 60).any()
    assert (tmp_path / "a.gif").stat().st_size < 3_000_000 * 40 / 100


def test_a_flat_scene_is_drawn_without_a_word(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    truth = traffic(num=8, num_scans=3)
    drawn = figures(believed(truth), Scene(None, truth, "drawn", {}), frames=2)["animation"]
    flat = replace(drawn, limits=(np.array([-100.0, -10.0]), np.array([100.0, 10.0])))
    flat.savefig(tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as film:
        assert film.height == pytest.approx(0.4 * film.width, abs=2)
    assert not caplog.records


@pytest.mark.parametrize("what", ["no truth", "no tracks", "neither", "points", "velocity", "unsure"])
def test_pictures_do_without_what_is_missing(what: str, tmp_path: Path) -> None:
    truth = traffic()
    tracks = believed(truth)
    if what in ("no tracks", "neither"):
        tracks = empty(tracks)
    if what == "points":
        tracks = replace(tracks, names=("a", "b", "c", "d", "e", "x", "y"))
    if what == "velocity":
        tracks = replace(tracks, names=("x", "y", "vx", "vy", "turn", "length", "width"))
    if what == "unsure":
        tracks = replace(tracks, existence=np.full(len(truth.label), 0.2), draws={})
    known = None if what in ("no truth", "neither") else truth
    drawn = figures(tracks, Scene(None, known, "drawn", {}), frames=2)
    _, failures = save_figures(tmp_path, drawn)
    assert failures == {}
    assert len(drawn["over_time"].axes) == (2 if known is None else 3)


def test_the_picture_shows_each_path_with_its_gaps() -> None:
    truth = traffic()
    existence = np.full(len(truth.label), 0.9)
    row = np.flatnonzero(truth.label == 10)[7]
    existence[row] = 0.2
    tracks = replace(believed(truth), existence=existence, draws={})
    (axes,) = figures(tracks, Scene(None, truth, "drawn", {}), frames=0)["tracks"].axes
    shown = {tuple(np.isnan(line.get_xdata()).nonzero()[0]) for line in axes.lines if line.get_linewidth() > 2}
    assert shown == {(7,), (0, 1, 2, 3), (15, 16, 17, 18, 19)}
    assert {text.get_text() for text in axes.texts} == {"10", "11", "12"}
    existence = figures(tracks.confirmed(0.5), Scene(None, truth, "drawn", {}), frames=0)["over_time"].axes[0]
    lines = {tuple(np.isnan(line.get_ydata()).nonzero()[0]) for line in existence.lines if line.get_linewidth() == 1.2}
    assert lines == shown


def test_a_track_of_one_scan_is_a_point() -> None:
    truth = traffic()
    existence = np.full(len(truth.label), 0.2)
    row = np.flatnonzero(truth.label == 10)[7]
    existence[row] = 0.9
    tracks = replace(believed(truth), existence=existence, draws={})
    (axes,) = figures(tracks, Scene(None, truth, "drawn", {}), frames=0)["tracks"].axes
    points = np.concatenate([line.get_xydata() for line in axes.lines if line.get_marker() == "."])
    np.testing.assert_array_equal(points, tracks.position[row][None])


def test_the_view_goes_with_the_car_or_else_with_the_objects() -> None:
    truth = traffic()
    tracks, scene = believed(truth), Scene(drive(), truth, "drawn", {})
    low, high = figures(tracks, scene, view=30.0)["animation"].corners()
    np.testing.assert_allclose(0.5 * (low + high), ego(scene.data))
    recorded = Recording(tuple(Scan("s", scan.time, scan.points, scan.pose) for scan in scene.data))
    np.testing.assert_array_equal(ego(recorded), ego(scene.data))
    np.testing.assert_allclose(high - low, 30.0)
    low, high = figures(tracks, Scene(None, truth, "drawn", {}), view=30.0)["animation"].corners()
    middle = 0.5 * (low + high)
    assert (np.abs(np.diff(middle, axis=0)) < 3.0).all()
    assert np.linalg.norm(middle.mean(0) - truth.position.mean(0)) < 3.0
    still = figures(tracks, scene)["animation"].corners()
    assert (still[0] <= truth.position.min(0)).all()
    assert (still[1] >= truth.position.max(0)).all()


def test_boxes_are_where_objects_are() -> None:
    (corners,) = boxes(np.array([[10.0, 5.0]]), np.array([np.pi / 2]), np.array([[4.0, 2.0]]))
    np.testing.assert_allclose(corners, [[9, 7], [11, 7], [11, 3], [9, 3]], atol=1e-12)


def test_labels_keep_their_colours() -> None:
    found = colours(np.array([7, 3, 7, 5]))
    assert list(found) == [7, 3, 5]
    assert len(set(found.values())) == 3


def test_other_posteriors_have_no_tracks_to_draw() -> None:
    assert figures(Posterior({"a": np.zeros((1, 3))}), Scene(None, None, "", {})) == {}
    assert ego({"no": "scans"}) is None
    assert Animation.suffix == ".gif"


def test_long_lists_are_summed_up_in_the_report() -> None:
    assert listed([1.0, 2.0]) == "1, 2"
    assert listed([0.001] * 150 + [0.5]) == "151 values: median 0.001, least 0.001, most 0.5"
    assert listed(["a"] * 150).startswith("a, a, a")
