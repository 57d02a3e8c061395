"""What filters of many objects return: counts against enumeration, draws against moments, files, and a whole run."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import store
from experiments.run import Job, run, write
from experiments.scenarios.scene import Scene
from experiments.tracking_figures import figures
from experiments.tracking_metrics import counts, metrics
from inference import lmb
from inference.posterior import Posterior
from inference.tracks import ARRAYS, Tracks, rows_by_label
from models.objects.motion import ConstantVelocity
from models.objects.scans import Scan
from models.objects.sensors import Position
from models.objects.traffic import Kind, Traffic
from models.program import InputError
from tests.drawn_tracks import believed, traffic


def unsure(seed: int = 1) -> Tracks:
    """Tracks of any existence, over scans of 0 to 4 objects."""
    sizes = np.array([0, 1, 3, 4, 2])
    rng, rows = np.random.default_rng(seed), int(sizes.sum())
    root = rng.standard_normal((rows, 2, 2))
    return Tracks(
        time=np.arange(5.0),
        offset=np.concatenate([[0], np.cumsum(sizes)]),
        label=np.concatenate([rng.permutation(6)[:size] for size in sizes]),
        existence=rng.random(rows),
        mean=rng.standard_normal((rows, 2)),
        covariance=root @ root.swapaxes(1, 2),
        kind=rng.dirichlet([1.0, 1.0, 1.0], rows),
        names=("x", "y"),
        kind_names=("car", "bicycle", "pedestrian"),
        sensor=("radar",) * 5,
        measurement=rng.integers(-1, 4, rows),
    )


def test_count_probabilities_equal_enumeration() -> None:
    tracks = unsure()
    for t, found in enumerate(tracks.count_probability()):
        r = tracks.at(t).existence
        expected = np.zeros(len(found))
        for there in itertools.product([False, True], repeat=len(r)):
            expected[sum(there)] += np.prod(np.where(there, r, 1.0 - r))
        np.testing.assert_allclose(found, expected, atol=1e-14)


def test_count_moments_and_quantiles_are_those_of_its_distribution() -> None:
    tracks = unsure()
    p = tracks.count_probability()
    np.testing.assert_allclose(tracks.count_mean(), p @ np.arange(p.shape[1]), atol=1e-14)
    for q in (0.05, 0.5, 0.95):
        for row, found in zip(p, tracks.count_quantile(q), strict=True):
            assert row[: found + 1].sum() >= q - 1e-12
            assert row[:found].sum() < q


def test_the_draws_are_those_of_the_number_of_objects() -> None:
    tracks = unsure()
    p, draws = tracks.count_probability(), tracks.draws["count"][0]
    assert tracks.shape == (1, len(draws))
    for count in range(p.shape[1]):
        error = np.sqrt(p[:, count] * (1.0 - p[:, count]) / len(draws))  # of a share; 5 of them for 25 shares
        assert (np.abs((draws == count).mean(0) - p[:, count]) <= 5.0 * error + 1e-12).all()
    np.testing.assert_array_equal(tracks.model_index, tracks.draws["count"][:, :, -1])
    np.testing.assert_array_equal(tracks.draws["count"], unsure().draws["count"])


def test_samples_have_the_existence_states_and_kinds_believed() -> None:
    tracks, num = unsure(), 20_000
    drawn = tracks.sample(num, seed=3)
    r = tracks.existence
    assert (np.abs(drawn.exists.mean(0) - r) < 5.0 * np.sqrt(r * (1 - r) / num)).all()
    assert np.isnan(drawn.state[~drawn.exists]).all()
    assert (drawn.kind[~drawn.exists] == -1).all()
    for row in range(len(r)):
        there = drawn.exists[:, row]
        state, kind, size = drawn.state[there, row], drawn.kind[there, row], there.sum()
        variance = np.diagonal(tracks.covariance[row])
        assert (np.abs(state.mean(0) - tracks.mean[row]) < 5.0 * np.sqrt(variance / size)).all()
        error = np.sqrt((np.outer(variance, variance) + tracks.covariance[row] ** 2) / size)  # Wishart
        assert (np.abs(np.cov(state.T) - tracks.covariance[row]) < 5.0 * error).all()
        for c, p in enumerate(tracks.kind[row]):
            assert abs((kind == c).mean() - p) < 5.0 * np.sqrt(p * (1 - p) / size)
    np.testing.assert_array_equal(drawn.state, tracks.sample(num, seed=3).state)


def test_objects_known_exactly_are_drawn_exactly() -> None:
    tracks = replace(unsure(), covariance=np.zeros((10, 2, 2)), existence=np.ones(10))
    np.testing.assert_array_equal(tracks.sample(3, seed=0).state, np.tile(tracks.mean, (3, 1, 1)))


def test_confirmed_rows_keep_their_scans() -> None:
    tracks = unsure()
    sure = tracks.confirmed(0.4)
    for t in range(5):
        before, after = tracks.at(t), sure.at(t)
        keep = before.existence > 0.4
        for values, kept in zip(before, after, strict=True):
            np.testing.assert_array_equal(values[keep], kept)
    np.testing.assert_allclose(sure.draws["count"][0].mean(0), sure.count_mean(), atol=0.15)


def test_trajectories_follow_labels_over_time() -> None:
    truth = traffic()
    tracks = believed(truth)
    found = tracks.trajectories()
    assert list(found) == [10, 12, 11]  # in the order of first appearance
    for label, (time, mean, covariance) in found.items():
        rows = truth.label == label
        np.testing.assert_array_equal(time, np.repeat(truth.time, np.diff(truth.offset))[rows])
        np.testing.assert_array_equal(mean, tracks.mean[rows])
        np.testing.assert_array_equal(covariance, tracks.covariance[rows])
    assert tracks.trajectories(threshold=0.95) == {}
    assert rows_by_label(np.zeros(0, dtype=np.int64)) == {}


def test_the_table_tells_lifetimes_existence_and_kind() -> None:
    rows = believed(traffic()).table()
    assert [row["label"] for row in rows] == [10, 12, 11]
    assert rows[2] == {
        "label": 11,
        "from_s": 0.4,
        "until_s": 1.9,
        "scans": 16,
        "existence": 0.9,
        "kind": "car",
        "kind_probability": 0.8,
    }


def test_saved_tracks_come_back_equal_and_read_as_a_posterior(tmp_path: Path) -> None:
    before = believed(traffic())
    before.save(tmp_path)
    after = Tracks.load(tmp_path)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    for name in ("names", "kind_names", "sensor", "log_evidence", "info"):
        assert getattr(after, name) == getattr(before, name)
    for posterior in (after, Posterior.load(tmp_path)):
        np.testing.assert_array_equal(posterior.draws["count"], before.draws["count"])
        np.testing.assert_array_equal(posterior.model_index, before.model_index)  # type: ignore[arg-type]
    assert type(Posterior.load(tmp_path)) is Posterior


def test_a_posterior_without_tracks_is_refused_by_name(tmp_path: Path) -> None:
    Posterior({"a": np.zeros((1, 3))}).save(tmp_path)
    with pytest.raises(InputError, match=r"without tracks; read it with Posterior\.load"):
        Tracks.load(tmp_path)


def test_posterior_summaries_of_the_count_work() -> None:
    tracks = unsure()
    draws = tracks.draws["count"][0]
    np.testing.assert_allclose(tracks.sd("count"), draws.std(0))
    np.testing.assert_allclose(Posterior.mean(tracks, "count"), draws.mean(0))
    assert sum(tracks.model_probabilities().values()) == pytest.approx(1.0)
    assert tracks.resample(10, seed=0)["count"].shape == (10, 5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time": np.array([0.0, 1.0, 0.5, 2.0, 3.0])}, r"goes back from 1\.0 to 0\.5 s after scan 1"),
        ({"existence": np.full(10, 1.5)}, r"existence of tracks is 1\.5 in row 0, no probability"),
        ({"existence": np.full(9, 0.5)}, r"10 rows need existence|need existence \(10,\), not \(9,\)"),
        ({"mean": np.full((10, 2), np.nan)}, r"mean of tracks is \[nan nan\] in row 0; it must be finite"),
        ({"offset": np.array([0, 4, 2, 8, 9, 10])}, r"offset of tracks must rise from 0 to the number of rows, 10"),
        ({"label": np.zeros(10, dtype=np.int64)}, r"label 0 stands twice in scan 2"),
        ({"sensor": ("radar",)}, r"5 scans name 1 sensors"),
        ({"names": ("x", "y", "vx")}, r"need mean \(10, 3\), not \(10, 2\)"),
        ({"time": np.zeros(0)}, r"at least one scan"),
    ],
)
def test_arrays_that_do_not_fit_are_refused_in_words(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(unsure(), **changes)


def test_an_entry_that_states_have_not_is_named() -> None:
    with pytest.raises(InputError, match="have no 'speed', only x, y"):
        unsure().entries("speed")


class Blind:
    """A model that nothing is asked of."""

    def __call__(self, evidence: Any) -> None: ...


def test_tracks_pass_through_a_run_and_its_report(tmp_path: Path) -> None:
    truth = traffic()
    tracks = believed(truth)
    scene = Scene([1.0], truth, "drawn", {"seed": 0})
    result = run(
        lambda: scene,
        Blind(),
        lambda *_, seed: tracks,
        functionals=[partial(counts, scans=3)],
        metrics=[metrics],
        figures=[partial(figures, frames=2)],
    )
    assert not result.failures
    assert set(result.diagnostics) == {"count[0]", "count[10]", "count[19]"}
    assert result.flags == []
    job = Job({"seed": 0, "metrics": [{"_target_": "experiments.tracking_metrics.metrics"}]}, tmp_path / "run", False)
    assert write(job, result) == {}
    rows = store.read_rows(tmp_path / "run" / "tracks.csv")
    assert [row["kind"] for row in rows] == ["car"] * 3
    report = (tmp_path / "run" / "report.html").read_text()
    assert "Tracks found" in report
    assert "OSPA(2) distance of the paths in a window" in report
    assert "data:image/gif" in report
    np.testing.assert_array_equal(Tracks.load(tmp_path / "run").mean, tracks.mean)


def test_functionals_of_another_posterior_are_none() -> None:
    assert counts(Posterior({"a": np.zeros((1, 3))})) == {}


def test_a_filter_says_which_measurement_is_of_which_object() -> None:
    """Two objects that stand, seen in changing order, one of them missed, and a false alarm."""
    sensor = Position(name="plots", noise_std=(0.1, 0.1), extent=100.0, clutter=0.1)
    model = Traffic((sensor,), ConstantVelocity(), (Kind(noise=(0.1, 0.1)),), unseen_density=1e-3)
    values = [[[0, 0], [50, 0]], [[50, 0], [0, 0]], [[-70, 30], [50, 0]], [[0, 0], [50, 0]]]
    scans = [Scan("plots", float(t), np.array(z, dtype=float), np.zeros(3)) for t, z in enumerate(values)]
    tracks = lmb.run(model, scans, faint=0.01)
    assert tracks.measurement is not None
    found = [
        dict(zip(np.round(tracks.at(t).mean[:, 0], -1).tolist(), tracks.at(t).measurement.tolist(), strict=True))
        for t in range(4)
    ]
    assert [some[0.0] for some in found] == [0, 1, -1, 0] and [some[50.0] for some in found] == [1, 0, 1, 1]
    assert found[2][-70.0] == 0
    sure = tracks.confirmed(0.5)
    assert sure.measurement is not None and len(sure.measurement) == len(sure.label)
