"""The command line: what a run leaves behind, what it repeats, and what it says when it fails."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments import store
from experiments.metrics import site_error
from experiments.report import meanings
from experiments.run import engine_seed, run, show
from experiments.scenarios import csv_tracks
from experiments.scenarios.protocol import protocol
from experiments.scenarios.toys import line, slot_road
from inference.posterior import Posterior
from models.intersection.state import Junction
from models.program import InputError
from models.toys.gaussian import ConjugateGaussian
from tests.conftest import Command

FAKE = ["--config-dir", "conf", "engine=fake"]


def test_a_run_leaves_a_complete_folder_and_an_identical_one_is_skipped(launch: Command) -> None:
    first = launch(*FAKE)
    assert first.returncode == 0, first.stderr
    (folder,) = Path("runs").iterdir()
    assert {path.name for path in folder.iterdir()} == {
        "manifest.json", "scores.json", "diagnostics.json", "posterior.npz", "posterior.json", "figures", "report.html",
    }  # fmt: skip
    assert folder.name.startswith("line-gaussian-fake-")
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["seeds"] == {"run": 0, "engine": engine_seed(0)}
    assert manifest["run"] == folder.name
    assert manifest["config"]["engine"]["num_draws"] == 200
    assert {"python", "torch", "numpy"} <= manifest["versions"].keys()
    assert {"date", "git", "hardware", "seconds", "scene"} <= manifest.keys()
    report = (folder / "report.html").read_text()
    assert "data:image/png;base64," in report
    assert '<meta name="viewport"' in report
    for heading in ("R-hat", "effective draws", "standard error of the mean", "<h2>Marginals</h2>"):
        assert heading in report, heading
    assert "http://" not in report and "https://" not in report
    assert Posterior.load(folder).draws["beta"].shape == (2, 200, 2)

    second = launch(*FAKE)
    assert "done already" in second.stdout and "beta error" in second.stdout
    assert Path("calls.txt").read_text().split() == [str(engine_seed(0))]
    third = launch(*FAKE, "force=true")
    assert third.returncode == 0, third.stderr
    assert len(Path("calls.txt").read_text().split()) == 2
    assert [path.name for path in Path("runs").iterdir()] == [folder.name]


def test_scores_are_explained_by_the_docstrings_of_their_metrics() -> None:
    says = meanings(["centre_error_m", "beta_error_sd"], ["experiments.junction_metrics", "experiments.metrics"])
    assert says == {"centre_error_m": "distance of the centres"}
    names = ["error_40_m", "covered_140", "inside_tight", "range_m", "trusted_true", "coverage"]
    roads = meanings(names, ["experiments.road_metrics"])
    assert list(roads) == names and not any('"' in meaning for meaning in roads.values())
    assert meanings(["gospa_m"], ["experiments.view_metrics"]) == {"gospa_m": "GOSPA distance of the positions"}


def test_a_meaning_of_two_lines_is_told_whole() -> None:
    cycles = meanings(["cycle_median_ms", "cycle_p99_ms"], ["experiments.closed_loop_metrics"])
    assert cycles["cycle_median_ms"].endswith("which compiles, and without building problems of optimal control")
    assert cycles["cycle_p99_ms"] == "99 % of cycles take less"
    assert meanings(["goal_distance_m"], ["experiments.goal_metrics"]) == {
        "goal_distance_m": "least distance from the place"
    }


def test_the_arms_of_tracks_without_truth_are_told(launch: Command) -> None:
    csv_tracks.write("tracks.csv", protocol(0).data)
    words = ["engine.num_steps=200", "engine.warmup=100", "engine.thin=1", "engine.polish=false"]
    done = launch("experiment=my_tracks", "scenario.path=tracks.csv", *words)
    assert done.returncode == 0, done.stderr
    assert "arms found" in done.stdout and "direction" in done.stdout
    (folder,) = Path("runs").iterdir()
    rows = store.read_rows(folder / "arms.csv")
    assert len(rows) >= 2 and -180 <= float(rows[0]["direction_deg"]) <= 180
    report = (folder / "report.html").read_text()
    assert "Arms found" in report and "none: the truth of this scene is unknown" in report


@pytest.mark.parametrize(("num", "words"), [(4, "and 1 more flag in"), (5, "and 2 more flags in")])
def test_flags_past_the_third_are_counted(
    num: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store.write_json(tmp_path / "scores.json", {})
    store.write_json(tmp_path / "diagnostics.json", {"flags": ["why"] * num})
    show(tmp_path)
    assert words in capsys.readouterr().out


def test_a_misspelt_key_is_refused_before_anything_is_written(launch: Command) -> None:
    done = launch(*FAKE, "engine.num_draw=5")
    assert done.returncode == 2
    assert done.stderr == "waybayes: engine has no knob 'num_draw'; did you mean 'num_draws'?\n"
    assert not Path("runs").exists() and not Path("calls.txt").exists()


def test_an_experiments_knob_for_another_engine_names_the_experiment(launch: Command) -> None:
    done = launch("experiment=road", "engine=least_squares")
    assert done.returncode == 2
    assert done.stderr.startswith(
        "waybayes: experiment=road sets engine.num_chains, which engine=rjmcmc takes but engine=least_squares "
        "does not; leave engine as experiment=road has it"
    )
    Path("conf/engine/mine.yaml").write_text("_target_: fake_engine.run\n_partial_: true\nnum_draw: 3\n")
    done = launch("--config-dir", "conf", "engine=mine")
    assert (
        done.stderr == "waybayes: engine has no knob 'num_draw'; did you mean 'num_draws'? (set in engine/mine.yaml)\n"
    )


BAD_SETTINGS = {
    "seed=-1": "seed is -1; choose 0 or more",
    "scenario.seed=-1": "scenario.seed is -1; choose 0 or more",
    "metrics=foo": "metrics is 'foo'; give a list of functions",
    "metrics=[foo]": "metrics is '['foo']'; give a list of functions",
    "figures=null": "figures is 'None'; give a list of functions",
    "+foo=1": "no setting is called 'foo'; there are compare_figures, engine,",
    "runs=calls.txt": "runs is 'calls.txt', but nothing can be written in 'calls.txt' (Not a directory)",
    "runs=/proc/absent": "runs is '/proc/absent', but nothing can be written in '/proc'",
}


@pytest.mark.parametrize("word", BAD_SETTINGS)
def test_settings_that_no_run_can_take_are_refused_before_the_engine(word: str, launch: Command) -> None:
    Path("calls.txt").touch()
    done = launch(*FAKE, word)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1 and BAD_SETTINGS[word] in done.stderr
    assert Path("calls.txt").read_text() == ""


def test_bad_input_is_one_sentence_and_leaves_nothing(launch: Command) -> None:
    done = launch(*FAKE, "scenario.num=0")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "num is 0" in done.stderr
    assert not list(Path("runs").iterdir())


def test_a_config_that_is_no_yaml_is_one_sentence(launch: Command) -> None:
    Path("conf/experiment").mkdir()
    Path("conf/experiment/broken.yaml").write_text("a: [1,\n")
    done = launch("--config-dir", "conf", "experiment=broken")
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert "a config file cannot be read" in done.stderr and "broken.yaml" in done.stderr and "line 2" in done.stderr


def test_a_failed_job_does_not_stop_the_sweep(launch: Command) -> None:
    words = [*FAKE, "engine.fail_at=100", "engine.num_draws=100,200", "seed=0,1"]
    done = launch("-m", *words)
    assert done.returncode == 2
    assert done.stderr.count("num_draws is 100; choose another") == 2
    assert len(list(Path("runs").glob("line-gaussian-fake-*"))) == 2
    calls = len(Path("calls.txt").read_text().split())
    assert calls == 4
    launch("-m", *words)  # resumes: only what failed runs again
    assert len(Path("calls.txt").read_text().split()) == calls + 2


def test_what_fails_after_the_engine_loses_nothing_else(launch: Command) -> None:
    Path("fake_scores.py").write_text(FAKE_SCORES)
    Path("conf/experiment").mkdir()
    Path("conf/experiment/broken.yaml").write_text(BROKEN)
    done = launch(*FAKE, "experiment=broken")
    assert done.returncode == 1
    for words in ("metric bad_metric", "no score today", "functional bad_functional", "figure late", "Traceback"):
        assert words in done.stderr, words
    assert "good" in done.stdout  # the scores are printed as ever
    (folder,) = Path("runs").iterdir()
    assert json.loads((folder / "scores.json").read_text()) == {"good_m": 1.0}
    assert Posterior.load(folder).draws["beta"].shape == (2, 200, 2)
    assert "beta[0]" in json.loads((folder / "diagnostics.json").read_text())["summary"]
    assert (folder / "figures" / "fine.png").is_file() and not (folder / "figures" / "late.png").exists()
    report = (folder / "report.html").read_text()
    assert "metric bad_metric failed" in report and "no score today" in report
    failures = json.loads((folder / "manifest.json").read_text())["failures"]
    assert failures.keys() == {"metric bad_metric", "functional bad_functional", "figure late"}
    launch(*FAKE, "experiment=broken")  # what failed is not done: it runs again
    assert len(Path("calls.txt").read_text().split()) == 2


FAKE_SCORES = """
from matplotlib.figure import Figure
from models.intersection.state import Junction
from models.program import InputError

def good_metric(posterior, scene):
    return {"good_m": 1.0}

def bad_metric(posterior, scene):
    raise InputError("no score today")

def bad_functional(posterior):
    return {"x": 1 / 0}

def drawings(posterior, scene):
    fine, late = Figure(), Figure()
    late.add_subplot().set_title(r"$\\nonsense{$")  # fails only where it is drawn
    return {"late": late, "fine": fine}
"""
BROKEN = """# @package _global_
functionals: [{_target_: fake_scores.bad_functional, _partial_: true}]
metrics:
  - {_target_: fake_scores.bad_metric, _partial_: true}
  - {_target_: fake_scores.good_metric, _partial_: true}
figures: [{_target_: fake_scores.drawings, _partial_: true}]
"""


BAD_TABLES = {  # one for each stage that may refuse; test_csv_tracks has the rest
    "vehicle,t,x,y\n1,0,nan,0\n": "x is 'nan', not a number",
    "vehicle,t,x,y\n1,0,0,0\n1,1,90,0\n2,0,45,1\n2,1,45,90\n": "the tracks leave in 0 direction(s) only",
}


@pytest.mark.parametrize(("text", "words"), BAD_TABLES.items())
def test_bad_tracks_are_one_sentence_and_leave_nothing(launch: Command, text: str, words: str) -> None:
    Path("tracks.csv").write_text(text)
    done = launch("experiment=my_tracks", "scenario.path=tracks.csv")
    assert done.returncode == 2, done.stderr
    said = [line for line in done.stderr.splitlines() if not line.startswith("compiling")]
    assert len(said) == 1 and words in said[0]
    assert not list(Path("runs").iterdir())


def test_a_model_that_prepares_names_the_data_it_reads() -> None:
    with pytest.raises(InputError, match="Junction reads Tracks, but the scenario gives Readings"):
        run(line, Junction(), lambda *_, seed: None)  # type: ignore[arg-type,return-value]


def test_any_other_error_shows_its_traceback_and_the_run_it_belongs_to(launch: Command) -> None:
    done = launch(*FAKE, "engine.style=angry")
    assert done.returncode == 1
    assert "Traceback" in done.stderr and "engine.style=angry failed" in done.stderr


def test_a_folder_that_hides_our_packages_is_named(launch: Command) -> None:
    Path("configs").mkdir()
    Path("configs/__init__.py").touch()
    done = launch(*FAKE)
    assert done.returncode == 2
    assert "the package 'configs'" in done.stderr and "hides it" in done.stderr


def test_a_folder_that_hides_the_planner_is_named(launch: Command) -> None:
    Path("planning").mkdir()
    Path("planning/__init__.py").touch()
    done = launch(module="experiments.drive")
    assert done.returncode == 2
    assert "the package 'planning'" in done.stderr and "hides it" in done.stderr


def test_a_scenario_that_does_not_fit_the_model_is_refused() -> None:
    with pytest.raises(InputError, match="ConjugateGaussian reads Readings, but the scenario gives Markings"):
        run(slot_road, ConjugateGaussian(), lambda *_, seed: None)  # type: ignore[arg-type,return-value]


def test_exact_draws_score_one_standard_deviation_on_average() -> None:
    """The squared error of a calibrated posterior has mean 1; over S scenes of two independent
    scores each its standard error is sqrt(2 / (2 S)), which for S = 200 is 0.07: four of them."""
    squares = []
    for seed in range(200):
        scene = line(seed)
        mean, covariance, _ = ConjugateGaussian().exact(scene.data)
        draws = np.random.default_rng(seed).multivariate_normal(mean.numpy(), covariance.numpy(), size=(1, 2000))
        squares.append(site_error(Posterior({"beta": draws}), scene)["beta_error_sd"] ** 2)
    assert abs(np.mean(squares) - 1.0) < 4 * 0.07


def test_the_engine_seed_is_a_child_of_the_runs_seed() -> None:
    assert len({engine_seed(seed) for seed in range(100)} | set(range(100))) == 200
