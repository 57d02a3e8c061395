"""The comparison: one row for each engine, failures included, against the exact posterior."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from experiments.compare import Cell, Row, against, plan, print_table, tabulate
from experiments.signatures import ConfigError
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
    assert rows["broken"]["seeds"] == "0" and "choose another" in rows["broken"]["error"]
    assert len(json.loads((folder / "compare.json").read_text())["runs"]["fake"]) == 2
    assert "choose another" in (folder / "report.html").read_text()

    calls = Path("calls.txt").read_text()
    launch(*words, module="experiments.compare")
    assert len(Path("calls.txt").read_text().split()) == len(calls.split()) + 1  # the broken one alone


def test_an_engine_nobody_asked_for_may_refuse_the_model(launch: Command) -> None:
    words = ["scenario=slot_road", "model=slot_road", "seeds=1", "rjmcmc.num_steps=60", "rjmcmc.warmup=20"]
    done = launch(*words, module="experiments.compare")
    assert done.returncode == 0, done.stderr
    assert "least_squares: SlotRoad counts with discrete latents" in done.stdout
    assert "choose engine=rjmcmc (from Python: " in done.stdout
    done = launch(*words, "engines=[least_squares,rjmcmc]", module="experiments.compare")
    assert done.returncode == 1
    assert "reference: posterior of rjmcmc" in done.stdout  # of the first that ran


@pytest.mark.parametrize("word", ["engines=[]", "seeds=0", "seeds=two", "engine=rjmcmc", "seed=3"])
def test_words_that_a_comparison_does_not_take_are_refused(word: str) -> None:
    with pytest.raises(ConfigError, match=r"seeds|engines is empty|engines=\[...\]"):
        plan([word])


def test_shares_have_no_spread_and_no_heading_is_cut(capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"a_rather_long_name_of_score_{i}_m" for i in range(20)]
    scores = [{"right": float(i), **dict.fromkeys(names, 0.5 + i)} for i in range(2)]
    cells = [Cell(Path(), score, {}, 1.0, None) for score in scores]
    records = tabulate([Row("fake", cells, None, False)], None)
    assert records[0]["right"] == 0.5 and records[0]["right:sd"] is None
    assert records[0][f"{names[0]}:sd"] == pytest.approx(0.5**0.5)
    print_table(records, "")
    said = capsys.readouterr().out
    assert all(f"a rather long name of score {i} [m]" in said for i in range(20)) and "…" not in said


def test_the_distance_to_the_reference_follows_its_definition() -> None:
    own = {"a": {"mean": 1.0, "sd": 2.0, "mcse": 0.3}, "b": {"mean": 0.0, "sd": 1.0, "mcse": 0.1}}
    reference = {"a": {"mean": 0.0, "sd": 1.0, "mcse": 0.4}, "b": {"mean": 0.0, "sd": 0.5, "mcse": 0.0}}
    distance = against(own, reference, by_position=False)
    assert distance == pytest.approx({"mean_error_sd": 0.5**0.5, "sd_ratio": 2.0, "z_max": 2.0})


def test_the_reference_is_the_engine_named_where_it_ran() -> None:
    summary = {"z": {"mean": 0.0, "sd": 2.0, "mcse": 0.1, "ess_bulk": 300.0}}
    rough = {"z": {"mean": 1.0, "sd": 1.0, "mcse": 0.1, "ess_bulk": 90.0}}
    rows = [Row(n, [Cell(Path(), {}, s, 1.0, None)], None, False) for n, s in (("rough", rough), ("good", summary))]
    records = tabulate(rows, None, "good")
    assert records[0]["sd_ratio"] == 0.5 and records[0]["ess_min"] == 90.0 and "sd_ratio" not in records[1]
    assert tabulate([*rows, Row("lost", [], "no", True)], None, "lost")[1]["sd_ratio"] == 2.0  # of the first that ran
    with pytest.raises(ConfigError, match="reference is 'smc'"):
        plan(["engines=[nuts]", "reference=smc"])
