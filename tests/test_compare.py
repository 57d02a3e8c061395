"""The comparison: one row for each engine, failures included, against the exact posterior."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest

from experiments import run
from experiments.compare import conclude, gather, plan, reference_of, tasks_of
from experiments.compare_cells import Cell, Row, Trail, trail_of
from experiments.compare_report import print_table, rows_of
from experiments.compare_table import (
    against,
    apart,
    approach,
    exact_references,
    own_references,
    tabulate,
    time_to_accuracy,
)
from experiments.signatures import ConfigError
from inference.posterior import Posterior, Snapshots
from tests.conftest import Command


def test_a_biased_engine_stands_out_and_a_broken_one_is_a_row(launch: Command) -> None:
    for name, knob in (("biased", "shift: 0.5"), ("broken", "fail_at: 200")):
        Path(f"conf/engine/{name}.yaml").write_text(f"_target_: fake_engine.run\n_partial_: true\n{knob}\n")
    path = f"hydra.searchpath=[file://{Path.cwd()}/conf]"
    words = ["engines=[fake,biased,broken]", "seeds=2", "fake.num_draws=300", path]
    done = launch(*words, module="experiments.compare")
    assert done.returncode == 1
    assert done.stderr == "broken: num_draws is 200; choose another\n"
    (folder,) = Path("runs").glob("compare-line-gaussian-*")
    with (folder / "compare.csv").open() as file:
        rows = {row["engine"]: row for row in csv.DictReader(file)}
    assert float(rows["fake"]["z_max"]) < 4.0  # the larger of two standard normal numbers
    assert float(rows["biased"]["z_max"]) > 20.0  # 0.5 away, where 400 draws know the mean to less than 0.01
    assert float(rows["fake"]["evaluations"]) == 300 and float(rows["biased"]["evaluations"]) == 200
    assert rows["broken"]["runs"] == "0" and "choose another" in rows["broken"]["error"]
    assert len(json.loads((folder / "compare.json").read_text())["runs"]["fake"]) == 2
    page = (folder / "report.html").read_text()
    assert "choose another" in page
    assert page.count("data:image/png;base64,") == 1 and "http" not in page.replace("http://www.w3.org", "")
    assert float(rows["fake"]["to_accuracy_ms"]) == float(rows["fake"]["time_ms"])  # without snapshots: at its end
    assert float(rows["biased"]["accurate"]) == 0.0 and rows["biased"]["to_accuracy_ms"] == "inf"

    calls = Path("calls.txt").read_text()
    launch(*words, module="experiments.compare")
    assert len(Path("calls.txt").read_text().split()) == len(calls.split()) + 1  # the broken one alone


def test_an_engine_nobody_asked_for_may_refuse_the_model(launch: Command) -> None:
    words = ["scenario=slot_road", "model=slot_road", "seeds=1", "rjmcmc.num_steps=60", "rjmcmc.warmup=20"]
    done = launch(*words, module="experiments.compare")
    assert done.returncode == 0, done.stderr
    assert "least_squares: SlotRoad has an unknown number of parts" in done.stdout
    assert "choose engine=rjmcmc or smc_structure (from Python: " in done.stdout


def test_an_engine_asked_for_that_refuses_the_model_is_noticed_before_any_works(launch: Command) -> None:
    words = ["scenario=slot_road", "model=slot_road", "seeds=1", "engines=[rjmcmc,least_squares]"]
    done = launch(*words, "rjmcmc.num_steps=1000000000", module="experiments.compare")
    assert done.returncode == 2 and not done.stdout and not Path("runs").exists()
    (sentence,) = done.stderr.splitlines()
    assert sentence.startswith("least_squares: SlotRoad has an unknown number of parts")
    assert "choose engine=rjmcmc or smc_structure" in sentence


def test_a_scenario_that_the_model_does_not_read_is_told_once(launch: Command) -> None:
    done = launch("scenario=line", "model=slot_road", "engines=[rjmcmc,smc]", module="experiments.compare")
    assert done.returncode == 2
    (sentence,) = done.stderr.splitlines()
    assert "model SlotRoad reads Markings, but the scenario gives Readings" in sentence
    done = launch("scenario=drive_follow", "engines=[rjmcmc]", module="experiments.compare")
    assert done.returncode == 2
    (sentence,) = done.stderr.splitlines()
    assert "scenario follow is one to drive in, not to learn from" in sentence


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["engines=[]"], "engines is empty"),
        (["engine=[]"], "engine is empty"),
        (["engine=[nuts]", "engines=[smc]"], "named twice"),
        (["engines=[nuts,smc,nuts]"], "names an engine twice"),
        (["engines=nuts,smc"], r"is no list; write 'engines=\[nuts,smc\]'"),
        (["seeds=0"], "seeds is '0'"),
        (["seeds=two"], "seeds is 'two'"),
        (["scenes=0"], "scenes is '0'"),
        (["scenes=true"], "scenes is 'True'"),
        (["scenes=3", "scenario.seed=5"], "scenes or scenario.seed, not both"),
        (["seed=3"], "seeds=N, not seed=3"),
        (["engines=[nuts"], "cannot read the setting 'engines=\\[nuts'"),
        (["engines=[nuts]", "reference=smc"], "reference is 'smc'"),
    ],
)
def test_words_that_a_comparison_does_not_take_are_refused(words: list[str], sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        plan(words)


def test_engines_and_scenes_are_read_in_either_spelling() -> None:
    assert plan(["engine=[nuts,smc]"]).engines == plan(["engines=[nuts,smc]"]).engines == ["nuts", "smc"]
    assert plan(["engine=nuts"]).engines == ["nuts"]
    assert plan([]).seeds == 3 and plan(["scenes=4"]).seeds == 1 and plan(["scenes=4", "seeds=2"]).seeds == 2
    assert plan(["engine=[nuts]", "nuts.spread=2"]).own == {"nuts": ["engine.spread=2"]}


def test_a_scenario_alone_brings_the_experiment_of_its_name() -> None:
    assert plan(["scenario=night_road"]).shared == ["experiment=night_road", "scenario=night_road"]
    assert plan(["scenario=line"]).shared == ["scenario=line"]  # there is no such experiment
    for word in ("model=road_course_paper", "experiment=night_urban"):
        assert plan(["scenario=night_road", word]).shared == ["scenario=night_road", word]


def test_every_engine_runs_on_every_scene_once_warm(launch: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four runs, one more to warm the engine; a run that was stored without a warm-up runs again."""
    monkeypatch.syspath_prepend(Path.cwd())
    monkeypatch.setattr(run, "_warm", set())
    chosen = plan(["engine=fake", "scenes=2", "seeds=2", f"hydra.searchpath=[file://{Path.cwd()}/conf]"])
    tasks = tasks_of(chosen)
    run.execute(tasks[2].job, lambda line: None)
    run._warm.clear()  # as in another process
    said: list[str] = []
    (row,) = gather(tasks, said.append)
    assert len(Path("calls.txt").read_text().split()) == 1 + 1 + 4
    assert said[-1].startswith("[4/4] fake, scene 1, seed 1: ")
    assert [one.scene for one in row.cells] == [0, 0, 1, 1] and all(one.processor_ms is not None for one in row.cells)
    conclude(chosen, tasks, [row])
    (folder,) = Path("runs").glob("compare-line-gaussian-*")
    (record,) = json.loads((folder / "compare.json").read_text())["records"]
    assert record["runs"] == 4 and "beta_error_sd:se" in record and record["accurate"] == 1.0
    gather(tasks, said.append)
    assert len(Path("calls.txt").read_text().split()) == 6 and said[-1].endswith("done already")


def cell(scores: dict[str, float], ms: float = 1.0, scene: int = 0, **rest: object) -> Cell:
    return Cell(Path(), scores, SUMMARY, ms, scene=scene, **rest)  # type: ignore[arg-type]


SUMMARY = {"a": {"mean": 1.0, "sd": 2.0, "mcse": 0.1, "ess_bulk": 300.0}}


def test_shares_have_no_spread_and_no_heading_is_cut(capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"a_rather_long_name_of_score_{i}_m" for i in range(20)]
    scores = [{"right": float(i), **dict.fromkeys(names, 0.5 + i)} for i in range(2)]
    records = tabulate([Row("fake", [cell(score) for score in scores], None, False)], {})
    assert records[0]["right"] == 0.5 and records[0]["right:sd"] is None
    assert records[0][f"{names[0]}:sd"] == pytest.approx(0.5**0.5)
    print_table(records, "")
    said = capsys.readouterr().out
    assert all(f"a rather long name of score {i} [m]" in said for i in range(20)) and "…" not in said


def test_over_scenes_a_share_has_the_standard_error_of_their_means() -> None:
    """Seeds of a scene are no further scenes: (0, 1) and (1, 1) are means .5 and 1."""
    cells = [cell({"hit": hit}, scene=scene) for scene, hit in ((0, 0.0), (0, 1.0), (1, 1.0), (1, 1.0))]
    (record,) = tabulate([Row("fake", cells, None, False)], {})
    assert record["hit"] == 0.75
    assert record["hit:se"] == pytest.approx(np.std([0.5, 1.0], ddof=1) / 2**0.5)
    assert ("hit", "0.75 ± 0.25") in rows_of([record])


def test_a_score_that_a_run_lacks_counts_nowhere() -> None:
    cells = [cell({"right": value}, scene=scene) for scene, value in enumerate((1.0, math.nan, 0.0, None))]
    (record,) = tabulate([Row("fake", cells, None, False)], {})
    assert record["right"] == 0.5 and record["right:se"] == pytest.approx(0.5)


def test_times_are_medians_and_one_that_most_runs_do_not_reach_is_never() -> None:
    reference = {0: SUMMARY}
    far = {"a": SUMMARY["a"] | {"mean": 9.0}}
    near = [cell({}, ms) for ms in (1.0, 2.0, 900.0)]
    (record,) = tabulate([Row("fake", near, None, False)], reference)
    assert record["time_ms"] == record["to_accuracy_ms"] == 2.0 and record["accurate"] == 1.0
    lost = [*near, *(one._replace(summary=far) for one in near)]
    (record,) = tabulate([Row("fake", lost, None, False)], reference)
    assert record["to_accuracy_ms"] == math.inf and record["accurate"] == 0.5
    assert ("to accuracy [ms]", "never") in rows_of([record])


def test_the_distance_to_the_reference_follows_its_definition() -> None:
    own = {"a": {"mean": 1.0, "sd": 2.0, "mcse": 0.3}, "b": {"mean": 0.0, "sd": 1.0, "mcse": 0.1}}
    reference = {"a": {"mean": 0.0, "sd": 1.0, "mcse": 0.4}, "b": {"mean": 0.0, "sd": 0.5, "mcse": 0.0}}
    distance = against([(own, reference)])
    assert distance == pytest.approx({"mean_error_sd": 0.5**0.5, "sd_ratio": 2.0, "z_max": 2.0})
    both = against([(own, reference), (reference, reference)])
    assert both == pytest.approx({"mean_error_sd": 0.25**0.5, "sd_ratio": 2.0**0.5, "z_max": 2.0})


def test_a_constant_scalar_has_no_width_to_compare() -> None:
    """Weighted, its standard deviation is rounding."""
    own = {"n": {"mean": 4.0, "sd": 1e-14, "mcse": 0.0}, "a": {"mean": 1.0, "sd": 2.0, "mcse": 1.0}}
    known = {"n": {"mean": 4.0, "sd": 0.1, "mcse": 0.0}, "a": {"mean": 1.0, "sd": 2.0, "mcse": 1.0}}
    assert against([(own, known)]) == pytest.approx({"mean_error_sd": 0.0, "sd_ratio": 1.0, "z_max": 0.0})
    assert against([({"n": own["n"]}, known)]) == {}


def test_each_scene_has_a_reference_of_its_own() -> None:
    at = lambda mean, scene: cell({}, scene=scene)._replace(summary={"a": SUMMARY["a"] | {"mean": mean}})  # noqa: E731
    best = Row("best", [at(0.0, 0), at(10.0, 1)], None, False)
    other = Row("other", [at(1.0, 0), at(11.0, 1)], None, False)
    known = own_references([best, other], "best")
    assert [known[scene]["a"]["mean"] for scene in (0, 1)] == [0.0, 10.0]
    records = tabulate([best, other], known, "best")
    assert "sd_ratio" not in records[0] and records[1]["mean_error_sd"] == pytest.approx(0.5)
    exact = exact_references([other], {s: [{"mean": 10.0 * s, "sd": 1.0, "mcse": 0.0}] for s in (0, 1)})
    assert tabulate([other], exact)[0]["mean_error_sd"] == pytest.approx(1.0)


def test_the_reference_is_the_engine_named_where_it_ran() -> None:
    rows = [Row(name, [cell({})], None, False) for name in ("rough", "good")]
    assert reference_of(rows, "good") == "good" and reference_of(rows, None) == "rough"
    assert reference_of([*rows, Row("lost", [], "no", True)], "lost") == "rough"  # the first that ran
    assert reference_of([Row("lost", [], "no", True)], None) is None


# Along the way

KNOWN = {"a": {"mean": 1.0, "sd": 2.0}, "n": {"mean": 4.0, "sd": 0.0}}


def test_numbers_are_apart_by_their_root_mean_square_in_reference_sds() -> None:
    both = {"a": np.array([1.0, 3.0, 5.0]), "n": np.array([4.0, 4.0, 5.0]), "unknown": np.zeros(3)}
    found = apart(both, KNOWN)
    assert found is not None
    assert found[:2] == pytest.approx([0.0, 0.5**0.5]) and found[2] == math.inf  # a count that is wrong
    assert apart({"unknown": np.zeros(3)}, KNOWN) is None


@pytest.mark.parametrize(
    ("path", "mean", "reached"),
    [
        ([9.0, 1.0, 1.1], 1.0, 2.0),  # from the second state on
        ([1.0, 9.0, 1.0], 1.0, 3.0),  # it must stay
        ([9.0, 9.0, 9.0], 1.0, 8.0),  # only the posterior mean is right
        ([1.0, 1.0, 1.0], 9.0, math.inf),
        (None, 1.0, 8.0),  # no snapshots
        (None, 9.0, math.inf),
    ],
)
def test_time_to_accuracy_is_that_after_which_a_run_stays(
    path: list[float] | None, mean: float, reached: float
) -> None:
    trail = None if path is None else Trail(np.array([1.0, 2.0, 3.0]), {"a": np.array(path)})
    one = cell({}, 8.0, trail=trail)._replace(summary={"a": {"mean": mean, "sd": 2.0}})
    assert time_to_accuracy(one, {"a": KNOWN["a"]}) == reached
    assert len(approach(one, {"a": KNOWN["a"]})[0]) == (1 if path is None else 4)
    assert time_to_accuracy(one, {}) is None


def test_a_trail_holds_what_diagnostics_look_at() -> None:
    """All elements of known dimension; of an unknown one scalars and what a functional makes of the slots."""
    states = {"x": np.array([1.0, 2.0]), "slot": np.array([[1.0, 2.0], [3.0, 4.0]])}
    shots = Snapshots(np.arange(2), np.array([0.5, 1.0]), np.zeros(2), states)
    draws = {name: value[None] for name, value in states.items()}
    total = lambda posterior: {"total": posterior.draws["slot"].sum(-1)}  # noqa: E731
    known, open_ = Posterior(draws, snapshots=shots), Posterior(draws, snapshots=shots, model_index=np.ones((1, 2)))
    assert trail_of(Posterior(draws), []) is None
    found = trail_of(known, [])
    assert found is not None and found.ms.tolist() == [500.0, 1000.0]
    assert {n: v.tolist() for n, v in found.scalars.items()} == {"x": [1, 2], "slot[0]": [1, 3], "slot[1]": [2, 4]}
    found = trail_of(open_, [total])
    assert found is not None
    assert {n: v.tolist() for n, v in found.scalars.items()} == {"x": [1.0, 2.0], "total": [3.0, 7.0]}
