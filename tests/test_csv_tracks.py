"""Tables of recorded vehicles: even tracks from good ones, one clear sentence for bad ones."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from experiments.scenarios import paths
from experiments.scenarios.csv_tracks import Recorded, csv, even, read, write
from experiments.scenarios.protocol import protocol
from models.intersection.tracks import Tracks
from models.program import InputError


def track(data: Tracks, index: int) -> np.ndarray:
    return data.points[data.offsets[index] : data.offsets[index + 1]]


def table(tmp_path: Path, text: str, name: str = "tracks.csv") -> str:
    path = tmp_path / name
    path.write_text(text)
    return str(path)


def drive_east(vehicle: object, speed: float = 10.0, seconds: float = 6.0, y: float = 0.0) -> list[str]:
    return [f"{vehicle},{t:.1f},{speed * t:.3f},{y}" for t in np.arange(0.0, seconds, 0.1)]


NORTH = [f"north,{t:.1f},30,{10 * t:.3f}" for t in np.arange(0.0, 6.0, 0.1)]  # crosses whoever drives east


def test_a_table_becomes_tracks_with_a_point_every_metre(tmp_path: Path) -> None:
    rows = ["vehicle,t,x,y", *drive_east("a", y=1000.0), *drive_east("b", speed=7.0), *NORTH]
    scene = csv(table(tmp_path, "\n".join(rows)))
    assert scene.truth is None and scene.data.heading is None
    assert scene.info["tracks"] == 3
    first = track(scene.data, 0)
    np.testing.assert_allclose(first[:, 0], np.arange(len(first)), atol=1e-6)
    np.testing.assert_allclose(first[:, 1], 1000.0)  # coordinates as given


def test_columns_in_any_order_recordings_and_compression(tmp_path: Path) -> None:
    lines = ["Colour,Y,x,T,Recording,Vehicle,HEADING"]
    for recording, place in (("one", "0.5,{:.2f}"), ("two", "{:.2f},0.5")):
        lines += [f"red,{place.format(10 * t)},{t:.1f},{recording},7,0.1" for t in np.arange(0.0, 6.0, 0.1)]
    path = tmp_path / "tracks.csv.gz"
    path.write_bytes(gzip.compress("\n".join(lines).encode()))
    scene = csv(str(path))
    assert scene.info["vehicles"] == scene.info["tracks"] == 2
    np.testing.assert_allclose(scene.data.heading, 0.1)


def test_stops_leave_no_points() -> None:
    rng = np.random.default_rng(0)
    x = np.concatenate([np.arange(0, 20, 0.8), np.full(300, 20.0), np.arange(20, 50, 0.8)])
    points = np.stack([x, np.zeros_like(x)], 1)
    points[25:325] += rng.normal(0, 0.05, (300, 2))  # jitter of standing
    path, _ = even(Recorded("a", 2, 0.1 * np.arange(len(points)), points, None))
    assert len(path) == pytest.approx(50, abs=2)
    assert np.abs(path[:, 1]).max() < 0.2
    assert (np.diff(path[:, 0]) > 0.5).all()


def test_smoothing_keeps_ends_and_headings_that_cross_pi() -> None:
    rows = np.stack([np.linspace(0, -60, 121), np.zeros(121)], 1)
    heading = np.pi + 0.05 * np.where(np.arange(121) % 2, 1, -1)
    path, direction = even(Recorded("a", 2, 0.1 * np.arange(121), rows, np.asarray(paths.wrap(heading))))
    np.testing.assert_allclose(path[[0, -1]], [[0, 0], [-60, 0]], atol=1e-9)
    assert direction is not None and np.abs(paths.wrap(direction - np.pi)).max() < 0.06


HEADER = "vehicle,t,x,y\n"
BAD_TABLES = {
    "empty file": ("", r"the file is empty"),
    "header alone": (HEADER, r"has no rows"),
    "missing columns": ("vehicle,time,x,y\na,0,0,0\n", r"no column t, the header has vehicle, time, x, y"),
    "no number": (HEADER + "a,0,0,0\na,0.1,west,0\n", r"row 3, vehicle a: x is 'west'"),
    "nan": (HEADER + "a,0,0,0\na,0.1,1,nan\n", r"row 3, vehicle a: y is 'nan'"),
    "infinite": (HEADER + "a,0,0,0\na,inf,1,0\n", r"row 3, vehicle a: t is 'inf'"),
    "short row": (HEADER + "a,0,0,0\na,0.1,1\n", r"row 3, vehicle a: y is ''"),
    "no vehicle": (HEADER + "a,0,0,0\n,0.1,1,0\n", r"row 3: vehicle is empty"),
    "unsorted times": (HEADER + "a,0,0,0\nb,0,0,0\na,2,1,0\na,1,2,0\n", r"row 5, vehicle a: t = 1 comes after t = 2"),
    "duplicate times": (HEADER + "a,0,0,0\na,1,1,0\na,1,2,0\n", r"row 4, vehicle a: t = 1 comes twice"),
    "one point per vehicle": (HEADER + "a,0,0,0\nb,0,5,0\n", r"each of the 2 vehicles has a single point"),
    "none crosses": (HEADER + "".join(f"a,{t},{t},0\n" for t in range(9)), r"the longest of 1 tracks is 8.0 m"),
    "one road": (HEADER + "".join(f"{v},{t},{40 * t},{3 * v}\n" for v in range(4) for t in range(3)), r"one road"),
    "degrees": (
        HEADER + "".join(f"a,{t},{8.4156 + 1e-5 * t},49.0052\n" for t in range(99)),
        r"row 2: x = 8.4156 and y = 49.0052 .* longitude and latitude",
    ),
    "milliseconds": (HEADER + "".join(f"a,{40 * t},{t},0\n" for t in range(9)), r"40 s apart, .* 1 m, .* milliseconds"),
    "centimetres": (HEADER + "".join(f"a,{t},{1000 * t},0\n" for t in range(9)), r"1000 m a second, .* centimetres"),
    "semicolons": ("vehicle;t;x;y\na;0;0;0\n", r"separated by ';'; separate them by commas"),
    "tabs": ("vehicle\tt\tx\ty\na\t0\t0\t0\n", r"separated by '\\t'; separate them by commas"),
    "headings in degrees": (
        "vehicle,t,x,y,heading\na,0,0,0,0\na,1,40,0,181.5\n",
        r"row 3, vehicle a: heading is 181.5, beyond 2 pi",
    ),
}


@pytest.mark.parametrize("case", BAD_TABLES)
def test_a_bad_table_gets_one_sentence_with_file_place_and_remedy(case: str, tmp_path: Path) -> None:
    text, message = BAD_TABLES[case]
    path = table(tmp_path, text)
    with pytest.raises(InputError, match=message) as error:
        csv(path)
    assert str(error.value).startswith(path)
    assert "\n" not in str(error.value) and "; " in str(error.value)


def test_a_negative_shortest_length_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="min_length is -5; give 0 m or more"):
        csv(str(tmp_path / "tracks.csv"), min_length=-5)


@pytest.mark.parametrize("heading_std", [None, 0.1])
def test_written_tracks_are_read_again(tmp_path: Path, heading_std: float | None) -> None:
    tracks = protocol(0, heading_std=heading_std).data
    path = tmp_path / "a folder to make" / "tracks.csv"
    write(path, tracks)
    vehicles = read(path)
    np.testing.assert_allclose(np.concatenate([v.points for v in vehicles]), tracks.points, atol=1e-6)
    np.testing.assert_array_equal(np.cumsum([len(v.points) for v in vehicles]), tracks.offsets[1:])
    if heading_std:
        np.testing.assert_allclose(np.concatenate([v.heading for v in vehicles]), tracks.heading, atol=1e-6)


def test_no_junction_of_the_protocol_is_taken_for_one_road(tmp_path: Path) -> None:
    for seed in range(20):  # seed 3 has three arms, two of them 35 degrees apart
        write(tmp_path / "tracks.csv", protocol(seed, tracks=1).data)
        csv(str(tmp_path / "tracks.csv"))


def test_a_missing_or_broken_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent\.csv: no such file"):
        csv(str(tmp_path / "absent.csv"))
    with pytest.raises(InputError, match="cannot be read as a table"):
        csv(table(tmp_path, "this is not gzip", "tracks.csv.gz"))
    with pytest.raises(InputError, match="cannot be read as a table"):
        csv(str(tmp_path))


def test_a_short_track_among_long_ones_is_left_out(tmp_path: Path) -> None:
    rows = ["vehicle,t,x,y", *drive_east("a"), *drive_east("b", seconds=1.0), "c,0,3,3", *NORTH]
    scene = csv(table(tmp_path, "\n".join(rows)))
    assert scene.info["vehicles"] == 4 and scene.info["tracks"] == 2
