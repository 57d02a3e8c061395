"""The benchmark of the intersection: what it reports, and that it runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import intersection, junction_structure
from benchmarks.figure import Figure, Measurement, Value, Values, share
from benchmarks.junction import Effort, m20
from benchmarks.timing import THREADS
from experiments.scenarios.protocol import protocol
from models.program import log_joint

TINY = Effort(scenes=2, few=1, timed=2, repeats=1, real_seeds=1)
PROMISED = {
    "us_per_sample": "<= 2.5",
    "structure_5000": ">= 0.995",
    "structure_chain_5000": "",
    "ms_structure_5000": "<= 12",
    "structure_real": "",
    "structure_real_names": "",
    "pointwise_gap_nats": "",
    "cold_compile_s": "<= 30",
    "warm_start_s": "<= 3",
    "torch_population_ratio": "",
    "lane_cm_5000": "<= 4.7",
    "lane_cm_10000": "<= 4.7",
    "lane_cm_heading_5000": "<= 4.1",
    "lane_cm_mismatch": "<= 6.2",
    "lane_cm_mismatch_heading": "<= 5",
    "crlb_cm": "",
    "crlb_heading_cm": "",
    "ms_total_5000": "<= 18",
    "ms_refine": "<= 6",
    "m20_lane_cm": "",
    "m20_ms": "",
    "m19_lane_cm": "",
    "m19_ms": "",
    "real_lane_cm": "<= 10.5",
    "real_lane_cm_heading": "<= 9",
    "real_lane_cm_each": "",
    "real_ms": "<= 40",
    "band_coverage_90_given": "",
    "band_coverage_90": "",
    "lanelet_routes_ok": ">= 1",
    "traffic_m": "<= 0.2",
    "traffic_p90_m": "<= 0.75",
    "traffic_precision_1m": ">= 0.95",
    "traffic_arms_precision_1m": ">= 0.95",
    "traffic_recall_driven": ">= 0.75",
    "traffic_raw_m": "",
    "traffic_m_each": "",
    "traffic_nll": "",
    "traffic_nll_splines": "",
    "traffic_lanes_right": ">= 0.95",
    "traffic_sim_cm": "<= 15",
    "map_right": ">= 0.95",
    "map_added": ">= 0.95",
    "map_lacking": ">= 0.95",
}


@pytest.fixture(autouse=True)
def own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command pins threads by the environment: give the other tests theirs back."""
    for name in THREADS:
        monkeypatch.setenv(name, "1")


def test_every_promised_figure_is_there_once_with_its_target_and_definition() -> None:
    figures = [figure for measurement in intersection.measurements() for figure in measurement.figures]
    targets = {figure.key: figure.target for figure in figures}
    assert len(targets) == len(figures)
    assert {key: targets[key] for key in PROMISED} == PROMISED
    assert all(len(figure.definition) > 20 for figure in figures)


def test_json_is_one_object_with_the_figures_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert intersection.main(["--json", "--only", "us_per_sample,structure_5000"], effort=TINY) == 0
    found = json.loads(capsys.readouterr().out)
    keys = found.keys() - {"definitions", "run"}
    assert {"reference_loop_ns", "us_per_sample", "invalid_share", "structure_5000", "ms_structure_5000"} <= keys
    assert keys == found["definitions"].keys()
    assert 0.05 < found["us_per_sample"] < 1000.0 and 0.0 < found["invalid_share"] < 1.0
    parts = sum(found[key] for key in ("ms_prepare", "ms_chain", "ms_polish"))
    assert 0.0 < parts < 2.0 * found["ms_structure_5000"]  # medians of parts need not add up to the median
    assert found["definitions"]["us_per_sample"]["met"] is (found["us_per_sample"] <= 2.5)


def test_the_table_shows_value_target_and_paper(capsys: pytest.CaptureFixture[str]) -> None:
    assert intersection.main(["--only", "us_per_sample"], effort=TINY) == 0
    row = next(
        line for line in capsys.readouterr().out.splitlines() if "us_per_sample " in line
    )  # the row's first line
    assert "<= 2.5" in row and "9.8" in row and ("ok" in row or "miss" in row)


def test_an_unknown_figure_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert intersection.main(["--only", "us_per_smaple"], effort=TINY) == 2
    error = capsys.readouterr().err
    assert "us_per_smaple" in error and "us_per_sample" in error


def test_a_failing_measurement_loses_no_other(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(effort: Effort) -> Values:
        raise RuntimeError("no such luck")

    figures = [Figure(key, "", "made up for this test") for key in ("lost", "kept")]
    made_up = (
        Measurement(tuple(figures[:1]), broken),
        Measurement(tuple(figures[1:]), lambda effort: {"kept": Value(1.0)}),
    )
    monkeypatch.setattr(intersection, "measurements", lambda: made_up)
    assert intersection.main(["--json"], effort=TINY) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["kept"] == 1.0 and found["lost"] is None
    assert found["definitions"]["lost"]["detail"] == "failed: no such luck"


def test_real_junctions_are_skipped_with_a_reason_where_there_are_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(junction_structure, "DATA", str(tmp_path))
    for key, value in junction_structure.real(TINY).items():
        assert value.value is None and "data_root" in value.detail, key


@pytest.mark.parametrize(("value", "met"), [(2.0, True), (2.5, True), (2.6, False), (None, None)])
def test_a_target_is_met_at_its_limit(value: float | None, met: bool | None) -> None:
    assert Figure("speed", "us", "any", at_most=2.5).met(value) is met
    assert Figure("speed", "us", "any").met(value) is None


def test_a_share_without_failures_still_has_an_error() -> None:
    assert share([1.0] * 10) == Value(1.0, "n = 10, s.e. 0.066")  # sqrt(p (1 - p) / 10) at p = 10.5 / 11


def test_the_papers_start_lies_in_the_support_of_its_model() -> None:
    tracks, setting = protocol(0).data, m20()
    start = setting.model.start(setting.model.prepare(tracks))
    arms = np.sort(start["angle"][:3].numpy())
    assert np.allclose(np.diff(arms), np.radians(120.0)) and np.allclose(start["centre"], tracks.points.mean(0))
    latents = {name: torch.as_tensor(value)[None] for name, value in start.items()}
    assert torch.isfinite(log_joint(setting.model, latents, setting.model.prepare(tracks))).all()
