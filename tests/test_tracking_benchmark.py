"""The benchmark of tracking: what it reports, and that it runs."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest

from benchmarks import tracking, tracking_peers
from benchmarks.timing import THREADS
from benchmarks.tracking_accuracy import close, mean_ratio
from benchmarks.tracking_peers import Score, best_of
from benchmarks.tracking_trials import CUTOFF, Effort, ospa_m, plots, ratio
from experiments.scenarios.crossing_targets import crossing_targets
from inference import lmb

TINY = Effort(scenes=1, peers=1, seconds=3.0, objects=25)
PROMISED = {
    "ms_20": "<= 0.3",
    "ms_100": "<= 0.7",
    "p99_ms_20": "<= 1",
    "ms_20_kinds": "",
    "ms_100_kinds": "",
    "mem_mb_100": "",
    "ospa_ratio_30": "<= 0.92",
    "ospa_ratio_66": "<= 0.85",
    "ospa_ratio_phd": "<= 0.75",
    "speedup_stonesoup": ">= 100",
    "nees": "1.6 to 2.4",
    "lead_m_all": "<= 0.12",
    "lead_m_two": "<= 0.15",
    "lead_miss": "<= 0.005",
    "close_ratio": "<= 0.8",
}
OURS = [key for key in PROMISED if key not in {f.key for f in tracking_peers.AGAINST.figures}]


@pytest.fixture(autouse=True)
def own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command pins threads by the environment: give the other tests theirs back."""
    for name in THREADS:
        monkeypatch.setenv(name, "1")


def test_every_promised_figure_is_there_once_with_its_target_and_definition() -> None:
    figures = [figure for measurement in tracking.measurements() for figure in measurement.figures]
    targets = {figure.key: figure.target for figure in figures}
    assert len(targets) == len(figures)
    assert {key: targets[key] for key in PROMISED} == PROMISED
    assert all(len(figure.definition) > 13 for figure in figures)


def test_a_tiny_run_measures_every_figure_of_ours(capsys: pytest.CaptureFixture[str]) -> None:
    assert tracking.main(["--json", "--only", ",".join(OURS)], effort=TINY) == 0
    found = json.loads(capsys.readouterr().out)
    for key in OURS:
        if key == "mem_mb_100" and found[key] is None:  # no /proc
            continue
        assert math.isfinite(found[key]) and found[key] >= 0.0, key
    assert found["ms_20"] <= found["p99_ms_20"]


def test_stone_soup_is_measured_on_the_same_scans(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("stonesoup")
    monkeypatch.setattr(tracking_peers, "SETTINGS", {("gnn", 5): {"hits": 3, "gate": 3.0, "misses": 2, "held": 1}})
    found = tracking_peers.scores(5, False, TINY)
    scene = crossing_targets(0, 5.0)
    assert found["lmb"].ospa == [ospa_m(lmb.run(plots(5.0), scene.data.scans), scene)]
    assert 0.0 < found["gnn"].ospa[0] < CUTOFF and found["gnn"].ms > found["lmb"].ms > 0.0


def test_the_best_tracker_has_the_least_error_and_a_ratio_is_that_of_means() -> None:
    found = {"lmb": Score([1.0], 0.1), "gnn": Score([3.0, 5.0], 9.0), "jpda": Score([4.0, 3.0], 20.0)}
    assert best_of(found) == "jpda"
    value = ratio([1.0, 2.0], [2.0, 2.0])
    assert value.value == 0.75 and f"s.e. {np.std([-0.5, 0.5], ddof=1) / 2**0.5 / 2:.3f}" in value.detail


def test_company_is_compared_before_and_after_it_has_settled() -> None:
    """All scans alike, whoever is worse in which scene."""
    ours, theirs = [np.array([1.0, 3.0]), np.array([5.0, 3.0])], [np.array([4.0, 4.0]), np.array([1.0, 3.0])]
    assert mean_ratio(ours, theirs) == 1.0
    assert mean_ratio([each[:1] for each in ours], [each[:1] for each in theirs]) == 1.2
    detail = close(TINY)["close_ratio"].detail
    found = re.search(r"3 scenes.*; the first 20 scans (\S+), then (\S+)$", detail)
    assert found and all(0.0 < float(part) < 3.0 for part in found.groups())


def test_without_stone_soup_its_figures_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracking_peers, "find_spec", lambda name: None)
    values = tracking_peers.measured(TINY)
    assert all(value.value is None and "peers" in value.detail for value in values.values())
    assert set(values) == {f.key for f in tracking_peers.AGAINST.figures}
