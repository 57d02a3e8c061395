"""What an anytime user would have had: outcomes along the iterations, and the command that tabulates them."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.anytime import anytime, draw, entries, jobs_of, tabulate
from experiments.anytime_rates import (
    LEAST_RANGE,
    PAPER,
    Outcomes,
    at_quarters,
    inside_along,
    outcomes,
    quarters,
    rows,
)
from experiments.road_metrics import check_course
from experiments.scenarios.road import night_road
from experiments.scenarios.scene import Scene
from experiments.signatures import ConfigError
from inference.posterior import Posterior, Snapshots
from models.program import InputError
from models.road.course import RoadCourse

MODEL = RoadCourse()
SCENES = [night_road(seed) for seed in range(3)]


def test_all_iterations_are_the_first_count_within_half_a_point_of_the_last() -> None:
    full, at = quarters(np.array([0.1, 0.3, 0.5, 0.89, 0.896, 0.9, 0.9]))
    assert full == 4
    assert at == pytest.approx({"25 %": 0.3, "50 %": 0.5, "75 %": 0.89, "100 %": 0.896})
    assert quarters(np.array([0.9, 0.8, 0.9]))[0] == 0  # at its end from the start: nothing to lose
    assert at_quarters(np.array([0.0, 10.0, 20.0]), 2) == pytest.approx([5.0, 10.0, 15.0, 20.0])


def test_the_three_outcomes_are_shares_of_all_scenes() -> None:
    inside = np.array([[0, 1, 1], [0, 0, 1], [1, 0, 1], [0, 0, 0]], dtype=bool)
    found = Outcomes(np.array([0.0, 5.0, 10.0]), inside, np.array([True, True, False, True]))
    assert found.abstain == 0.25
    assert found.tpr.tolist() == [0.0, 0.25, 0.5] and found.fpr.tolist() == [0.75, 0.5, 0.25]
    told = rows(found)
    assert [row["share"] for row in told] == [0.25, 0.5, 0.75, 1.0]
    assert [row["steps"] for row in told] == [2.5, 5.0, 7.5, 10.0]
    assert [row["tpr"] for row in told] == pytest.approx([0.125, 0.25, 0.375, 0.5])
    assert all(row["tpr"] + row["fpr"] + row["abstain"] == pytest.approx(1.0) for row in told)
    assert told[-1]["tpr:se"] == pytest.approx((0.5 * 0.5 / 4) ** 0.5)


def course_of(scene: Scene, *aside: float) -> Posterior:
    """Snapshots of the true course moved aside [m], one after the other, and draws about the last."""
    course = np.repeat(scene.truth["course"][None], len(aside), 0)
    course[:, [1, 4]] += np.array(aside)[:, None]
    spread = 0.01 * np.random.default_rng(0).standard_normal((1, 200, 6)) * [0, 1, 0, 0, 1, 0]
    shots = Snapshots(np.arange(len(aside)), np.arange(len(aside)), np.zeros(len(aside)), {"course": course})
    return Posterior({"course": course[-1] + spread}, snapshots=shots)


def test_a_course_is_inside_its_tube_as_long_as_all_of_it_is() -> None:
    """The wide tube is .875 m wide where it begins, five metres ahead."""
    posterior = course_of(SCENES[0], 0.0, 0.7, 1.5, -0.7, -1.5)
    assert inside_along(posterior, SCENES[0].truth["line"]).tolist() == [True, True, False, True, False]


def test_a_course_that_the_final_draws_do_not_trust_is_not_offered() -> None:
    engine: Callable[..., Any]

    def engine(model: Any, evidence: Any, *, seed: int) -> Posterior:
        posterior = course_of(SCENES[seed], 1.5, 0.0)
        if seed == 1:  # draws far to both sides
            posterior.draws["course"][0, ::2, [1, 4]] += 5.0
            assert check_course(posterior, SCENES[1].truth["line"]).reach < LEAST_RANGE
        return posterior

    found = outcomes(engine, MODEL, SCENES, 3, "test", show=False)
    assert found.offered.tolist() == [True, False, True] and found.step.tolist() == [0.0, 1.0]
    assert found.tpr == pytest.approx([0.0, 2 / 3]) and found.abstain == pytest.approx(1 / 3)


def test_what_keeps_no_course_along_the_iterations_is_refused() -> None:
    bare = lambda model, evidence, *, seed: Posterior({"course": np.zeros((1, 4, 6))})  # noqa: E731
    with pytest.raises(InputError, match="keeps none; set num_snapshots"):
        outcomes(bare, MODEL, SCENES, 3, "test", show=False)
    uneven = lambda model, evidence, *, seed: course_of(SCENES[seed], *[0.0] * (1 + seed))  # noqa: E731
    with pytest.raises(InputError, match="the same on every scene"):
        outcomes(uneven, MODEL, SCENES, 3, "test", show=False)
    unknown = [SCENES[0]._replace(truth=None)]
    with pytest.raises(InputError, match="night_road 0 has no true road course"):
        outcomes(bare, MODEL, unknown, 1, "test", show=False)


def test_the_table_ends_with_the_papers_row() -> None:
    found = Outcomes(np.array([0.0, 8.0]), np.array([[False, True]]), np.array([True]))
    records = tabulate({"bbvi": found}, {"bbvi": {"transform": "prior"}})
    heads, lines = entries(records)
    assert heads[-4:] == ("25 %", "50 %", "75 %", "100 %")
    assert [line[3] for line in lines] == [
        *("TPR [%]", "FPR [%]", "abstain, at the end [%]"),
        *("TPR [%]", "FPR [%]", "abstain [%]"),
    ]
    assert lines[0][:3] == ("bbvi", "the prior", "8") and lines[0][-1].startswith("100.0 ± ")
    assert lines[3][4:] == ("61.5", "74.5", "81.8", "92.2") and lines[5][-1] == "3.1"
    assert PAPER["fpr"][0] == 0.364


def test_a_start_that_is_there_already_needs_no_iterations() -> None:
    found = Outcomes(np.array([0.0, 8.0]), np.array([[True, True]]), np.array([True]))
    _, lines = entries(tabulate({"bbvi": found}, {"bbvi": {"transform": "laplace"}}))
    assert lines[0][2] == "none: there from the start"
    (drawn,) = draw(tabulate({"bbvi": found}, {"bbvi": {}}), {"bbvi": found}).texts
    assert "bbvi abstains on 0.0% of the scenes" in drawn.get_text()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["seeds=3"], "anytime takes scenes=N, not seeds"),
        (["reference=bbvi"], "anytime takes scenes=N, not reference"),
        (["scenes=none"], "scenes is 'none'"),
        (["scenario.seed=3"], "scenes or scenario.seed, not both"),
        (["engines=[]"], "engines is empty"),
        (["engines=[nuts]"], "engine=nuts takes no num_steps; choose one such as bbvi"),
        (["engines=[bbvi"], "cannot read the setting 'engines=\\[bbvi'"),
    ],
)
def test_words_that_the_sweep_does_not_take_are_refused(words: list[str], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        jobs_of(words)


def test_the_command_stores_a_table_a_figure_and_a_page_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["engine=[bbvi]", "scenes=2", "bbvi.num_steps=4", "bbvi.num_snapshots=4"]
    anytime(words)
    assert "TPR [%]" in capsys.readouterr().out
    (folder,) = (file.parent for file in tmp_path.glob("runs/*/anytime.json"))
    with (folder / "anytime.csv").open() as file:
        told = list(csv.DictReader(file))
    assert [row["engine"] for row in told] == ["bbvi"] * 4 + ["paper"] * 4
    along = json.loads((folder / "anytime.json").read_text())["along"]["bbvi"]
    assert along["step"] == [0, 1, 2, 3, 4] and len(along["tpr"]) == 5
    assert (folder / "report.html").read_text().count("data:image/png;base64,") == 1
    anytime(words)
    assert "done already" in capsys.readouterr().out


def test_help_is_quick_and_a_mistake_is_one_sentence() -> None:
    begin = time.perf_counter()
    told = subprocess.run([sys.executable, "-m", "experiments.anytime", "--help"], capture_output=True, text=True)
    assert "TPR" in told.stdout and time.perf_counter() - begin < 10.0  # torch alone takes longer under load
    done = subprocess.run(
        [sys.executable, "-m", "experiments.anytime", "scenario=line", "model=gaussian", "scenes=1"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
