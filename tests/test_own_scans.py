"""Tables of recorded scans: what was written is read, the truth moves evenly, bad tables get one clear sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from experiments.scenarios.crossing_targets import crossing_targets
from experiments.scenarios.own_scans import own_scans, write, write_truth
from experiments.scenarios.urban_sensors import traffic, urban_sensors
from models.objects.motion import ConstantVelocity
from models.objects.scans import Recording, Scan
from models.objects.sensors import Position, RangeBearing
from models.objects.traffic import Kind, Traffic
from models.program import InputError
from models.toys.gaussian import ConjugateGaussian

URBAN = traffic()
PLOTS = Traffic((Position(name="plots", noise_std=(1.0, 1.0)),), ConstantVelocity(), (Kind(noise=(1.0, 1.0)),))
LASER = Traffic((RangeBearing(name="laser", noise_std=(0.1, 0.01), reach=(0.0, 50.0)),))
DRIVE = "vehicle,t,x,y\na,0,0,0\na,2,20,4\nb,0,100,0\nb,2,100,0\n"


def table(tmp_path: Path, text: str, name: str = "scans.csv") -> str:
    path = tmp_path / name
    path.write_text(text)
    return str(path)


def test_scans_that_were_written_are_read_with_who_was_where(tmp_path: Path) -> None:
    """Two sensors and a camera that tells kinds; late scans stay late."""
    scene = urban_sensors(3, number=6, duration=1.0, latency=0.1)
    write(tmp_path / "new" / "scans.csv", scene.data, URBAN)
    write_truth(tmp_path / "new" / "truth.csv", scene.truth)
    found = own_scans(str(tmp_path / "new" / "scans.csv"), URBAN, str(tmp_path / "new" / "truth.csv"))
    assert len(found.data.scans) == len(scene.data.scans)
    for got, scan in zip(found.data.scans, scene.data.scans, strict=True):
        assert (got.sensor, got.time) == (scan.sensor, scan.time)
        np.testing.assert_array_equal(got.values, scan.values)
        np.testing.assert_array_equal(got.pose, scan.pose)
        assert (got.likeness is None) == (scan.sensor != "camera" or not len(scan.values))
        if got.likeness is not None and scan.likeness is not None:
            np.testing.assert_allclose(got.likeness, scan.likeness, rtol=1e-9)
    times = np.diff([scan.time for scan in found.data.scans])
    assert (times < 0).any()
    np.testing.assert_array_equal(found.truth.offset, scene.truth.offset)
    for name in ("x", "y"):
        np.testing.assert_allclose(getattr(found.truth, name), getattr(scene.truth, name), atol=1e-12)


def test_columns_in_any_order_scores_poses_and_scans_that_saw_nothing(tmp_path: Path) -> None:
    text = "Score,Y,x,SENSOR,t,note,car_heading,car_y,car_x\n,2,1,plots,0.5,hm,.1,6,5\n.9,4,3,plots,0.5,,.1,6,5\n"
    found = own_scans(table(tmp_path, text + ",,,plots,1,,0,6,7\n"), PLOTS)
    first, second = found.data.scans
    np.testing.assert_array_equal(first.values, [[1, 2], [3, 4]])
    np.testing.assert_array_equal(first.score, [0.5, 0.9])
    np.testing.assert_array_equal(first.pose, [5, 6, 0.1])
    assert second.values.shape == (0, 2) and second.time == 1.0
    assert found.truth is None and found.info["measurements"] == 2


def test_the_truth_moves_evenly_between_its_rows_and_ends_where_no_sensor_sees(tmp_path: Path) -> None:
    scans = table(tmp_path, "t,sensor,range,bearing\n0.5,laser,1,0\n1.5,laser,,\n2.5,laser,,\n")
    truth = own_scans(scans, LASER, table(tmp_path, DRIVE, "truth.csv")).truth
    np.testing.assert_array_equal(truth.time, [0.5, 1.5, 2.5])
    np.testing.assert_array_equal(truth.offset, [0, 1, 2, 2])  # b is 100 m away, the laser reaches 50 m
    np.testing.assert_allclose(truth.position, [[5, 1], [15, 3]])


def test_a_vehicle_is_away_where_its_rows_are_far_apart(tmp_path: Path) -> None:
    drive = "vehicle,t,x,y\n" + "".join(f"a,{t},{t},0\n" for t in (0, 1, 2, 9, 10, 11))
    scans = "t,sensor,range,bearing\n" + "".join(f"{t},laser,,\n" for t in (0.5, 2, 5, 9, 10.5, 12))
    truth = own_scans(table(tmp_path, scans), LASER, table(tmp_path, drive, "truth.csv")).truth
    np.testing.assert_array_equal(np.diff(truth.offset), [1, 1, 0, 1, 1, 0])
    np.testing.assert_allclose(truth.x, [0.5, 2, 9, 10.5])


def test_an_empty_scan_survives_the_table(tmp_path: Path) -> None:
    recording = Recording((Scan("plots", 0.0, np.zeros((0, 2)), np.zeros(3)), *crossing_targets(0).data.scans[1:3]))
    write(tmp_path / "scans.csv", recording, PLOTS)
    found = own_scans(str(tmp_path / "scans.csv"), PLOTS).data
    assert [len(scan.values) for scan in found.scans] == [len(scan.values) for scan in recording.scans]


BAD_TABLES = {
    "empty": ("", "the file is empty; give a table with the columns t, sensor"),
    "header alone": ("t,sensor,x,y\n", "has no rows"),
    "no sensor": ("t,x,y\n0,1,1\n", "no column sensor, the header has t, x, y"),
    "unknown sensor": ("t,sensor,x,y\n0,sonar,1,1\n", r"row 2: sensor is 'sonar', but the model has \['plots'\]"),
    "missing column": ("t,sensor,x\n0,plots,1\n", "it measures x, y, but there is no column y"),
    "no number": ("t,sensor,x,y\n0,plots,1,east\n", "row 2, sensor plots: y is 'east', not a number"),
    "NaN": ("t,sensor,x,y\n0,plots,nan,1\n", "row 2, sensor plots: x is 'nan', not a number"),
    "half a measurement": ("t,sensor,x,y\n0,plots,1,\n", "row 2, sensor plots: y is '', not a number"),
    "short row": ("t,sensor,x,y\n0,plots,1\n", "row 2, sensor plots: y is '', not a number"),
    "no time": ("t,sensor,x,y\n,plots,1,1\n", "row 2: t is '', not a number"),
    "time below zero": ("t,sensor,x,y\n-1,plots,1,1\n", "has time -1.0 s; give the seconds since a start"),
    "two pieces": (
        "t,sensor,x,y\n0,plots,1,1\n1,plots,1,1\n0,plots,2,2\n",
        "row 4, sensor plots: its scan at 0 s began in an earlier row",
    ),
    "half a pose": ("t,sensor,x,y,car_x\n0,plots,1,1,0\n", "there is no column car_y; give all of car_x, car_y, car_h"),
    "two poses": (
        "t,sensor,x,y,car_x,car_y,car_heading\n0,plots,1,1,0,0,0\n0,plots,1,2,1,0,0\n",
        r"row 3, sensor plots: the car is at \[1.0, 0.0, 0.0\], but at \[0.0, 0.0, 0.0\]",
    ),
    "score": ("t,sensor,x,y,score\n0,plots,1,1,90\n", "has the score 90, but scores are probabilities"),
    "looks": (
        "t,sensor,x,y,looks\n0,plots,1,1,tank\n",
        r"looks is 'tank'; give one of the model's kinds, \['object'\]",
    ),
    "looks without confusion": ("t,sensor,x,y,looks\n0,plots,1,1,object\n", "give the sensor a confusion"),
}


@pytest.mark.parametrize("case", BAD_TABLES)
def test_a_bad_table_is_one_sentence(tmp_path: Path, case: str) -> None:
    text, sentence = BAD_TABLES[case]
    with pytest.raises(InputError, match=sentence):
        own_scans(table(tmp_path, text), PLOTS)


def test_degrees_other_clocks_absent_files_and_other_models_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="row 2, sensor laser: bearing is 45, beyond 2 pi; give radians"):
        own_scans(table(tmp_path, "t,sensor,range,bearing\n0,laser,20,45\n"), LASER)
    scans = table(tmp_path, "t,sensor,x,y\n0,plots,1,1\n")
    late = table(tmp_path, "vehicle,t,x,y\na,100,0,0\na,101,20,4\n", "truth.csv")
    with pytest.raises(InputError, match="the truth is of 100 to 101 s, the scans are of 0 to 0 s"):
        own_scans(scans, PLOTS, late)
    with pytest.raises(InputError, match=r"absent\.csv: no such file"):
        own_scans(str(tmp_path / "absent.csv"), PLOTS)
    with pytest.raises(InputError, match="which ConjugateGaussian does not have; choose a model of traffic"):
        own_scans(scans, ConjugateGaussian())  # type: ignore[arg-type]
