"""The benchmark of the road: what it reports, and that it runs."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from benchmarks import road
from benchmarks.plain_road import PlainRoad
from benchmarks.road_robust import quarters
from benchmarks.road_trials import MODEL, Effort, frozen, paired_loss
from benchmarks.timing import THREADS
from models.program import log_joint

TINY = Effort(scenes=3, some=2, timed=2)
SITES = ("course", "offset")
PROMISED = {
    "tpr_mid": ">= 0.95",
    "fpr_mid": "<= 0.04",
    "abstain_mid": "",
    "range_m": ">= 125",
    "tpr_wide_140": ">= 0.94",
    "reference_tpr_wide_140": "",
    "reference_gap_wide_140": "<= 0.02",
    "lat_m_40": "<= 0.2",
    "lat_m_80": "<= 0.25",
    "lat_m_140": "<= 0.8",
    "tpr_loss_25": "<= 0.02",
    "tpr_loss_25_prior": "",
    "tpr_loss_clutter15": "<= 0.04",
    "cover90_40": "0.87 to 0.93",
    "cover90_80": "0.87 to 0.93",
    "cover90_140": "0.87 to 0.93",
    "ms_lm": "<= 1",
    "ms_bbvi": "<= 10",
    "ms_ais": "<= 15",
    "ms_obbvi": "<= 40",
    "range_gain": ">= 0.8",
    "g1_us_batch": "",
    "pyclothoids_us": "",
    "sample_ratio": ">= 50",
    "pyro_step_ratio": ">= 20",
}


@pytest.fixture(autouse=True)
def own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command pins threads by the environment: give the other tests theirs back."""
    for name in THREADS:
        monkeypatch.setenv(name, "1")


def test_every_promised_figure_is_there_once_with_its_target_and_definition() -> None:
    figures = [figure for measurement in road.measurements() for figure in measurement.figures]
    targets = {figure.key: figure.target for figure in figures}
    assert len(targets) == len(figures)
    assert {key: targets[key] for key in PROMISED} == PROMISED
    assert all(len(figure.definition) > 13 for figure in figures)


def test_json_holds_shares_that_add_up_and_times(capsys: pytest.CaptureFixture[str]) -> None:
    assert road.main(["--json", "--only", "tpr_mid,cover90_140,ms_lm"], effort=TINY) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["tpr_mid"] + found["fpr_mid"] + found["abstain_mid"] == pytest.approx(1.0)
    assert found["cover90_140"] in (0.0, pytest.approx(1 / 3), pytest.approx(2 / 3), 1.0)
    assert "n = 3, s.e." in found["definitions"]["cover90_140"]["detail"]
    assert 0.0 < found["lat_m_40"] < 10.0 and 0.0 < found["ms_lm"] < 1000.0


def test_all_iterations_are_the_first_count_within_half_a_point_of_the_last() -> None:
    full, at = quarters(np.array([0.1, 0.3, 0.5, 0.7, 0.896, 0.9, 0.9]))
    assert full == 4
    assert at == pytest.approx({"25 %": 0.3, "50 %": 0.5, "75 %": 0.7, "100 %": 0.896})
    assert quarters(np.array([0.9, 0.8, 0.9]))[0] == 0  # at its end from the start: nothing to lose


def test_a_loss_is_counted_scene_by_scene() -> None:
    loss, told = paired_loss([True, True, True, False], [True, False, False, True])
    assert loss == 0.25 and told == f"n = 4, s.e. {np.std([0, 1, 1, -1]) / 2:.3f}"


def test_the_program_of_torch_alone_has_the_density_and_gradient_of_the_compiled_one() -> None:
    plain = PlainRoad(MODEL)
    for scene in frozen(3):
        evidence, rng = MODEL.prepare(scene.data), np.random.default_rng(0)
        near = {site: scene.truth[site] + 0.02 * rng.standard_normal((8, len(scene.truth[site]))) for site in SITES}
        latents = {site: torch.from_numpy(value).requires_grad_() for site, value in near.items()}
        ours, theirs = (log_joint(model, latents, evidence) for model in (MODEL, plain))
        torch.testing.assert_close(theirs, ours, rtol=1e-10, atol=1e-9)
        slopes = (torch.autograd.grad(height.sum(), list(latents.values())) for height in (ours, theirs))
        for a, b in zip(*slopes, strict=True):
            torch.testing.assert_close(b, a, rtol=1e-8, atol=1e-7)


def test_a_course_whose_ends_no_clothoid_joins_has_the_same_height_in_both_programs() -> None:
    evidence, scene = MODEL.prepare(frozen(1)[0].data), frozen(1)[0]
    latents = {site: torch.from_numpy(scene.truth[site].copy()) for site in SITES}
    latents["course"][3:] = torch.tensor([-100.0, 0.0, 0.0])
    ours, theirs = (log_joint(model, latents, evidence) for model in (MODEL, PlainRoad(MODEL)))
    assert torch.isfinite(ours) and ours < -1e8
    torch.testing.assert_close(theirs, ours)


def test_ranges_gained_are_told_against_all_baselines(capsys: pytest.CaptureFixture[str]) -> None:
    assert road.main(["--json", "--only", "range_gain"], effort=TINY) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["range_gain"] <= found["range_gain_seen"]  # trusting markings less leaves more to gain
    assert 0.0 < found["range_gain_near"] < 3.0
