"""A run's folder is whole or absent, and its name follows what decides the outcome."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from experiments import store


def test_a_folder_appears_whole(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "one"
    with store.writing(folder) as temporary:
        (temporary / "manifest.json").write_text("{}")
        assert not folder.exists()
    assert store.is_done(folder)
    assert [path.name for path in folder.parent.iterdir()] == ["one"]


def test_a_run_with_failures_is_not_done(tmp_path: Path) -> None:
    store.write_json(tmp_path / "manifest.json", {"failures": {}})
    assert store.is_done(tmp_path)
    store.write_json(tmp_path / "manifest.json", {"failures": {"figure fit": "no ink"}})
    assert not store.is_done(tmp_path)
    for damaged in ("", "{", "[1]"):
        (tmp_path / "manifest.json").write_text(damaged)
        assert not store.is_done(tmp_path)


def test_a_failure_leaves_nothing_and_keeps_what_was_there(tmp_path: Path) -> None:
    folder = tmp_path / "one"
    with store.writing(folder) as temporary:
        (temporary / "scores.json").write_text("old")
    with pytest.raises(RuntimeError), store.writing(folder) as temporary:
        (temporary / "scores.json").write_text("new")
        raise RuntimeError
    assert (folder / "scores.json").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["one"]


def test_a_rerun_replaces_the_folder(tmp_path: Path) -> None:
    for text in ("old", "new"):
        with store.writing(tmp_path / "one") as temporary:
            (temporary / f"{text}.txt").write_text(text)
    assert [path.name for path in (tmp_path / "one").iterdir()] == ["new.txt"]


def test_the_identity_follows_config_input_file_and_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "outside_identity.py").write_text("def run(): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    tracks = tmp_path / "tracks.csv"
    tracks.write_text("1,2\n")
    config = {"seed": 0, "scenario": {"path": str(tracks)}, "engine": {"_target_": "outside_identity.run"}}
    seen = [store.identity(config), store.identity(config | {"seed": 1})]
    tracks.write_text("1,3\n")
    seen.append(store.identity(config))
    (tmp_path / "outside_identity.py").write_text("def run(): return 1\n")
    seen.append(store.identity(config))
    assert len(set(seen)) == 4
    assert store.identity(config) == seen[-1]


def test_json_holds_arrays_and_no_nan(tmp_path: Path) -> None:
    store.write_json(tmp_path / "a.json", {"a": np.arange(2), 3: [math.nan, np.float64(1.5), True, None]})
    assert store.read_json(tmp_path / "a.json") == {"a": [0, 1], "3": [None, 1.5, True, None]}
