"""The command that learns settings from scenes, and what it leaves for others to use."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_module

from experiments import store
from experiments.command import guarded, plain
from experiments.learn import Held, compared, difference, learn, node_of, plan, sentence, table_of, task_of
from experiments.schema import build
from inference.empirical_bayes import Learnt
from models.capability import Hyper
from models.road.course import RoadCourse
from models.road.hyper import changed

WORDS = ["experiment=night_road", "scenes=4", "held_out=3", "learn=[clutter,delineator.right]"]


def test_what_was_learnt_runs_as_an_experiment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = [*WORDS, "engine.num_draws=100", "engine.num_rounds=3", "num_draws=50"]
    learn(words)
    said = capsys.readouterr().out
    (folder,) = Path("runs").glob("learn-night_road-road_course-importance-*")
    rows = {row["setting"]: row for row in store.read_rows(folder / "learnt.csv")}
    assert list(rows) == ["clutter", "delineator.right.mean", "delineator.right.std"]
    assert float(rows["clutter"]["configured"]) == pytest.approx(0.05)
    assert "delineator.right.mean" in said and "log evidence of a held-out scene" in said
    assert "change ± s.e." in said
    assert len(store.read_json(folder / "held_out.json")["gain"]) == 3
    assert (folder / "figures" / "settings.png").exists() and "<img" in (folder / "report.html").read_text()

    path = f"hydra.searchpath=[file://{folder.absolute()}/conf]"
    assert path in said
    with initialize_config_module("configs", version_base="1.3"):
        config = plain(compose("run", ["experiment=night_road_learnt", path]))
    model = build(config["model"], "model")
    values = {name: float(row["learnt"]) for name, row in rows.items()}
    wanted = changed(RoadCourse(), values)
    assert model.clutter == pytest.approx(wanted.clutter, rel=1e-4)
    (kind,), (other,) = model.extra_kinds, wanted.extra_kinds
    assert kind.right == pytest.approx(other.right, rel=1e-4) and (kind.left, kind.std) == (other.left, other.std)

    learn(words)
    again = capsys.readouterr().out
    assert again.startswith("done already") and again.splitlines()[2:] == said.splitlines()[3:]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["scenes=1"], "scenes is '1'; give a whole number, 2 or more"),
        (["held_out=none"], "held_out is 'none'; give a whole number"),
        (["num_draws=5"], "num_draws is 5; learning needs 20 or more"),
        (["learn=[]"], "learn is empty"),
        (["learn=[clutter"], "cannot read the setting 'learn=[clutter'"),
        (["learn=clutter,bicycle"], "'bicycle' cannot be learnt"),
        (["learn=[delineatr.std]"], "did you mean 'delineator.std'?"),
        (["learn=bicycle"], "'bicycle' cannot be learnt: no scene has a bicycle"),
        (["scenario.seed=3"], "learning numbers its scenes itself"),
        (["held_out.scenario.seed=3"], "learning numbers its scenes itself"),
        (["held_out.model.clutter=.1"], "held-out scenes differ by held_out.scenario alone"),
        (["held_out.scenario.cluter=.1"], "scenario has no knob 'cluter'; did you mean 'clutter'?"),
        (["engine=rjmcm"], "there is no engine called 'rjmcm'; did you mean 'rjmcmc'?"),
        (["engine=bbvi_pap"], "there is no engine called 'bbvi_pap'"),
    ],
)
def test_a_mistake_is_one_sentence_and_exit_code_2(
    words: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert guarded(lambda: learn(["experiment=night_road", "scenes=3", "held_out=2", *words])) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.count("\n") == 1
    assert not list(tmp_path.glob("runs/*"))


def test_other_models_and_scenarios_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert guarded(lambda: learn(["scenario=line", "model=gaussian", "scenes=2", "held_out=2"])) == 2
    assert "ConjugateGaussian has no settings to learn (hyper())" in capsys.readouterr().err
    assert guarded(lambda: learn([*WORDS, "scenario=line"])) == 2
    assert "reads Cues" in capsys.readouterr().err


def test_values_after_commas_take_turns_and_held_out_words_count_there_only() -> None:
    words = ["experiment=night_road", "scenario.clutter=0,.1", "held_out.scenario.clutter=.2", "scenes=5", "held_out=2"]
    task = task_of(plan(words))
    assert [(s["clutter"], s["seed"]) for s in task.scenes] == [(0.0, 0), (0.1, 0), (0.0, 1), (0.1, 1), (0.0, 2)]
    assert [(s["clutter"], s["seed"]) for s in task.held_out] == [(0.2, 3), (0.2, 4)]
    assert task.choices["engine"] == "importance"  # though the experiment asks for another
    assert task_of(plan([*words, "engine=smc"])).choices["engine"] == "smc"


def test_held_out_scenes_are_like_the_others_unless_told() -> None:
    words = ["scenario.clutter=0,0.1", "scenario.yaw=0.01"]
    found = plan(words)
    assert found.held_words == found.words and len(found.words) == 2
    found = plan([*words, "held_out.scenario.yaw=0.02,0.03"])
    assert [sorted(w[-2:]) for w in found.held_words] == [
        [f"scenario.clutter={c}", f"scenario.yaw={y}"] for c in ("0", "0.1") for y in ("0.02", "0.03")
    ]
    found = plan([*words, "held_out.scenario.clutter=0.3"])
    assert found.held_words == [["engine=importance", "scenario.yaw=0.01", "scenario.clutter=0.3"]]


def test_only_what_was_learnt_is_written() -> None:
    model = RoadCourse(clutter_width=20.0)
    assert difference(model, model) == {}
    found = difference(model, changed(model, {"clutter": 0.123456789, "car.flow_std": 0.08}))
    assert found["clutter"] == 0.12346 and list(found) == ["clutter", "extra_kinds"]
    (car,) = build(found["extra_kinds"])
    assert car == changed(model, {"car.flow_std": 0.08}).extra_kinds[0]
    assert node_of((1, "a", None, 2.0)) == [1, "a", None, 2.0]


def test_errors_are_told_in_natural_numbers() -> None:
    family = Hyper(
        ("a", "b"), np.zeros(2), np.ones(2), lambda h: np.r_[h[0], np.exp(h[1])], lambda h: h, lambda d, z: len
    )
    learnt = Learnt(np.array([2.0, 1.0]), np.array([0.3, 0.2]), np.array([0.1, 0.1]), np.eye(2), *[np.empty(0)] * 2, [])
    first, second = table_of(family, learnt)
    assert first[1:] == pytest.approx((0.0, 2.0, 0.3, 0.1))
    assert second[1:] == pytest.approx((1.0, np.e, 0.2 * np.e, 0.1 * np.e))


def test_a_score_has_the_standard_error_of_its_change_over_the_same_scenes() -> None:
    """What scenes have in common cancels. 1000 resamples tell a standard error to 2 %; four of these."""
    rng = np.random.default_rng(1)
    scene, change = rng.normal(0.0, 10.0, 200), rng.normal(0.5, 0.3, 200)
    found = compared(scene, scene + change, np.nanmean)
    assert found.after - found.before == pytest.approx(change.mean())
    assert found.error == pytest.approx(change.std(ddof=1) / 200**0.5, rel=0.09)
    assert compared(scene, scene, np.nanmedian).error == 0.0
    gaps = np.where(np.arange(200) < 199, np.nan, 1.0)  # one scene alone has the score
    assert compared(gaps, gaps + 1.0, np.nanmean)[:2] == (1.0, 2.0)


def test_the_gain_is_told_with_its_standard_error() -> None:
    assert "+2.00 ± 0.58 nats" in sentence(Held([1.0, 2.0, 3.0], {}))
