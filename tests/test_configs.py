"""Every config composes, its targets exist, and a signature is its schema."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_module
from hydra.errors import ConfigCompositionException
from omegaconf import MISSING, OmegaConf

import experiments.command  # noqa: F401  (installs the schemas)
from experiments.closed_loop import Loop
from experiments.command import in_words, plain
from experiments.scenarios.driving import DriveScene
from experiments.schema import build, check_values, expand
from experiments.signatures import ConfigError, knobs, locate
from planning.behaviour import Manners
from planning.decision import Rules
from planning.planner import Planner
from planning.situation import Situation

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
OPTIONS = [
    (group.name, file.stem)
    for group in sorted(CONFIGS.iterdir())
    if group.is_dir() and not group.name.startswith("_")
    for file in sorted(group.glob("*.yaml"))
]


@pytest.fixture(autouse=True)
def hydra_context() -> Iterator[None]:
    with initialize_config_module("configs", version_base="1.3"):
        yield


DRIVES = ("driver", "planner")  # groups of the drive command alone
DRIVEN = [("experiment", "commonroad")]  # experiments of the drive command


@pytest.mark.parametrize(
    ("group", "name"), [option for option in OPTIONS if option[0] not in DRIVES and option not in DRIVEN]
)
def test_every_config_composes_and_its_targets_take_the_keys(group: str, name: str) -> None:
    config = plain(compose("run", [f"{group}={name}"]))
    check_targets(config)
    build(config["model"], "model")
    build({key: config[key] for key in ("engine", "functionals", "metrics", "figures")})


@pytest.mark.parametrize(
    ("group", "name"), [(g, n) for g, n in OPTIONS if g in DRIVES or (g == "scenario" and n.startswith("drive_"))]
)
def test_every_config_of_a_drive_composes_and_builds_what_the_code_has_as_defaults(group: str, name: str) -> None:
    config = plain(compose("drive", [f"{group}={name}"]))
    check_targets(config)
    parts = build({key: config[key] for key in ("driver", "planner", "loop", "metrics", "figures")})
    if config["scenario"].get("file") != MISSING:  # a reader has no default
        assert isinstance(build(config["scenario"], "scenario"), DriveScene)
    assert (parts["planner"], parts["loop"]) == (Planner(), Loop())
    assert parts["driver"].keywords == {"situation": Situation(), "rules": Rules(), "manners": Manners()}


def test_a_driver_without_manners_leaves_the_metrics_their_defaults(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "outside_driver.py").write_text("def idle(scene, route, planner, *, speed: float = 3.0): ...\n")
    (tmp_path / "driver").mkdir()
    (tmp_path / "driver" / "idle.yaml").write_text("_target_: outside_driver.idle\n_partial_: true\n")
    monkeypatch.syspath_prepend(tmp_path)
    search = [f"hydra.searchpath=[file://{tmp_path}]", "driver=idle"]
    for words in ([], ["experiment=commonroad", "scenario.file=some.xml"]):
        config = plain(compose("drive", [*search, *words]))
        assert config["driver"]["speed"] == 3.0
        signature = inspect.signature(locate(config["metrics"][0]["_target_"])).parameters
        told = {key: config["metrics"][0][key] for key in ("gap", "headway")}
        assert told == {key: signature[key].default for key in told}
    assert plain(compose("drive", ["driver.manners.gap=7"]))["metrics"][0]["gap"] == 7.0


@pytest.mark.parametrize(("group", "name"), DRIVEN)
def test_every_experiment_of_a_drive_composes_and_builds(group: str, name: str) -> None:
    config = plain(compose("drive", [f"{group}={name}", "scenario.file=some.xml"]))
    check_targets(config)
    parts = build({key: config[key] for key in ("driver", "planner", "loop", "metrics", "figures")})
    assert isinstance(parts["planner"], Planner) and config["scenario"]["vehicle"] == config["planner"]["vehicle"]


def check_targets(config: Any) -> None:
    for target in targets_of(config):
        function = locate(target["_target_"])
        keys = {key: 0 for key in target if not key.startswith("_")}
        inspect.signature(function).bind_partial(**keys)  # raises TypeError for a key it does not take


def targets_of(node: Any) -> Iterator[dict[str, Any]]:
    if isinstance(node, dict) and "_target_" in node:
        yield node
    for child in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        yield from targets_of(child)


def test_a_config_shows_the_defaults_of_the_signature() -> None:
    config = compose("run", ["model=gaussian"])
    function = locate(config.engine._target_)
    parameter = inspect.signature(function).parameters["num_steps"]
    assert config.engine.num_steps == parameter.default
    assert list(config.model.prior_std) == list(locate(config.model._target_)().prior_std)


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("engine.num_step=5", "engine has no knob 'num_step'; did you mean 'num_steps'?"),
        ("+engine.num_step=5", "engine has no knob 'num_step'; did you mean 'num_steps'?"),
        ("engine.num_steps=many", "engine.num_steps: Value 'many' of type 'str' could not be converted to Integer"),
        ("scenario.num=2.5", "scenario.num: Value '2.5' of type 'float' could not be converted to Integer"),
        ("sed=1", "a run has no key 'sed'; did you mean 'seed'?"),
        ("seed=one", "seed: Value 'one' of type 'str' could not be converted to Integer"),
        ("engine=rjmcm", "there is no engine called 'rjmcm'; did you mean 'rjmcmc'?"),
        ("force=5", "force is a switch, but is 5; give true or false"),
        ("engine.polish=1", "engine.polish is a switch, but is 1; give true or false"),
        ("models=gaussian", "a run has no key 'models'; did you mean 'model'?"),
        (
            "model.prior_std=three",
            "model.prior_std: it is a list; write model.prior_std=[...], quoted for the shell",
        ),
    ],
)
def test_a_mistake_is_one_sentence_with_a_suggestion(word: str, sentence: str) -> None:
    with pytest.raises((ConfigError, ConfigCompositionException)) as caught:
        compose("run", [word])
    assert in_words(caught.value) == sentence


SOURCE = """
from __future__ import annotations
import math
from dataclasses import dataclass, field
from typing import ClassVar, Literal

HALF = 0.5

@dataclass(frozen=True)
class Base:
    kind: ClassVar[str] = "base"
    width: float = 4 * HALF  # [m]

@dataclass(frozen=True)
class Model(Base):
    needed: int
    angle: float = math.pi / 2
    pair: tuple[float, float] = (1.0, 2.0)
    colour: Literal["red", "green"] = "red"
    limit: int | None = None
    inner: Base = Base()
    made: Base = field(default_factory=Base)
    other: Base = field(default_factory=lambda: Base(width=3.0))
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    """A module outside the tree, under a name no other test uses."""
    name = f"outside_{request.node.name}"
    (tmp_path / f"{name}.py").write_text(SOURCE.replace("needed: int", "needed: int = 0"))
    monkeypatch.syspath_prepend(tmp_path)
    return name


def test_a_signature_outside_the_tree_is_read_with_its_base_class(package: str) -> None:
    read = knobs(f"{package}.Model")
    assert {name: knob.default for name, knob in read.items()} == {
        "width": 2.0, "needed": 0, "angle": 1.5707963267948966, "pair": (1.0, 2.0),
        "colour": "red", "limit": None, "inner": MISSING, "made": MISSING, "other": MISSING,
    }  # fmt: skip
    assert read["colour"].choices == ("red", "green")
    assert not any(knob.required for knob in read.values())
    assert package not in sys.modules, "it is read without an import"


def test_a_tuple_stays_a_tuple_and_an_unshown_default_stays_the_targets_own(package: str) -> None:
    config = OmegaConf.create({"model": {"_target_": f"{package}.Model", "pair": [3, 4]}})
    expand(config)
    model = build(plain(config))["model"]
    assert model.pair == (3.0, 4.0)
    assert model.inner.width == 2.0


def test_whole_numbers_are_floats_in_lists_of_lists_too(package: str, tmp_path: Path) -> None:
    (tmp_path / f"{package}.py").write_text("def pairs(of: tuple[tuple[float, float], ...] = ()): return of\n")
    config = OmegaConf.create({"scenario": {"_target_": f"{package}.pairs", "of": [[0, 2], [1.5, 3]]}})
    expand(config)
    (first, _) = found = build(plain(config))["scenario"]
    assert found == ((0.0, 2.0), (1.5, 3.0)) and isinstance(first[0], float)


def test_a_value_outside_its_literal_is_refused(package: str) -> None:
    config = OmegaConf.create({"model": {"_target_": f"{package}.Model", "colour": "gren"}})
    expand(config)
    with pytest.raises(ConfigError, match=r"model.colour is 'gren'; did you mean 'green'\?"):
        check_values(config)


def test_a_number_for_a_switch_is_refused_in_a_file_too() -> None:
    config = OmegaConf.create({"engine": {"_target_": "inference.rjmcmc.run", "_partial_": True, "polish": 2}})
    with pytest.raises(ConfigError, match=r"engine.polish is a switch, but is 2"):
        expand(config)


def test_a_missing_value_is_asked_for_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "outside_needed.py").write_text("def load(path: str, rows: int = 3): return path, rows\n")
    monkeypatch.syspath_prepend(tmp_path)
    config = OmegaConf.create({"scenario": {"_target_": "outside_needed.load"}})
    expand(config)
    with pytest.raises(ConfigError, match=r"scenario.path has no value; give one with scenario.path=..."):
        build(plain(config))
    config.scenario.path = "x.csv"
    assert build(plain(config))["scenario"] == ("x.csv", 3)


def test_what_the_command_gives_is_asked_for_with_the_word_that_was_forgotten() -> None:
    config = OmegaConf.create({"driver": {"_target_": "experiments.driver.by_the_rules"}})
    expand(config)
    with pytest.raises(
        ConfigError, match=r"driver.scene has no value; .*, or _partial_: true in driver if the command"
    ):
        build(plain(config))


def test_a_target_that_does_not_exist_is_named() -> None:
    with pytest.raises(ConfigError, match=r"_target_ 'models.nowhere.Model' does not exist"):
        knobs("models.nowhere.Model")
