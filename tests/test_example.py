"""The packages under examples/ run through `waybayes` and the drive command without a change to the tree."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_module

from experiments.command import plain
from experiments.schema import build
from inference import lmb
from models.program import check, simulate
from tests.involution import assert_involution, uniforms

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def launch(folder: Path, runs: Path, *arguments: str, path: str = "") -> dict[str, float]:
    """Scores of a run started in `folder`."""
    command = [sys.executable, "-m", "experiments.run", *arguments, "experiment=driveway", f"runs={runs}"]
    places = os.pathsep.join(filter(None, [str(EXAMPLES.parent), path]))
    done = subprocess.run(
        command, cwd=folder, env=os.environ | {"PYTHONPATH": places}, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    (result,) = runs.glob("driveway-curb_height-rjmcmc-*")
    assert (result / "report.html").is_file()
    return json.loads((result / "scores.json").read_text())


def test_example_finds_the_driveway_from_its_own_folder(tmp_path: Path) -> None:
    scores = launch(EXAMPLES, tmp_path / "runs", "hydra.searchpath=[pkg://curb_height.configs]")
    assert scores["true_model_probability"] > 0.9
    assert scores["begin_error_sd"] < 4.0


def test_example_runs_from_anywhere_by_file_and_python_path(tmp_path: Path) -> None:
    search = f"hydra.searchpath=[file://{EXAMPLES / 'curb_height' / 'configs'}]"
    short = ("engine.num_steps=20", "engine.warmup=10")
    scores = launch(tmp_path, tmp_path / "runs", search, *short, path=str(EXAMPLES))
    assert "true_model_probability" in scores


def test_scans_of_a_sensor_outside_the_tree_are_tracked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three objects among false alarms, with the height that only this sensor tells: within four standard errors."""
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.chdir(EXAMPLES)
    with initialize_config_module("configs", version_base="1.3"):
        config = plain(compose("run", ["hydra.searchpath=[pkg://laser_3d.configs]", "experiment=ramp"]))
    built = build({key: config[key] for key in ("scenario", "model")})
    scene = built["scenario"]
    last = lmb.run(built["model"], scene.data.scans).confirmed(0.5).at(len(scene.data.scans) - 1)
    from laser_3d.made import SCANS, STEP, WAYS

    now = STEP * (SCANS - 1)
    true = [(x + vx * now, y + vy * now, z + rate * now) for x, y, vx, vy, z, rate in WAYS]
    names = built["model"].names
    entries = [names.index(name) for name in ("x", "y", "z")]
    assert len(last.label) == len(true)
    for place in true:
        gap = last.mean[:, entries] - place
        nearest = int(np.abs(gap[:, :2]).sum(1).argmin())
        std = np.sqrt(np.diagonal(last.covariance[nearest])[entries])
        assert (np.abs(gap[nearest]) < 4.0 * std).all()


def test_a_street_and_a_driver_outside_the_tree_are_driven(tmp_path: Path) -> None:
    """He keeps 8 m and 1.5 s at the cyclist's 4 m/s to his metric's zero, and never stops for good."""
    runs = tmp_path / "runs"
    command = [sys.executable, "-m", "experiments.drive", "hydra.searchpath=[pkg://cyclist_ahead.configs]"]
    words = ["experiment=patient_street", "figures=[]", f"runs={runs}"]
    place = os.environ | {"PYTHONPATH": str(EXAMPLES.parent)}
    done = subprocess.run([*command, *words], cwd=EXAMPLES, env=place, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    (result,) = runs.glob("street-frenet-*")
    scores = json.loads((result / "scores.json").read_text())
    assert scores["collisions"] == scores["limit_violations"] == scores["emergency"] == 0.0
    assert scores["gap_error_m"] < 1e-3 and abs(scores["end_speed_mps"] - 4.0) < 1e-3
    assert scores["clearance_m"] == pytest.approx(8.0 + 1.5 * 4.0, abs=1e-3)


def test_one_cycle_from_plain_arrays_passes_the_cyclist_and_stops_at_the_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    from cyclist_ahead.plan_once import LINE, planned

    found, better = planned()
    assert found.clear and found.rejected["other road user"] > 0
    assert better.accepted and better.cost < found.cost
    poses = better.trajectory(np.arange(0.0, 9.0, 0.05))
    front = poses[:, 0] + 1.4 + 4.9 / 2 * np.cos(poses[:, 2])
    assert (front[:61] < LINE).all()  # beyond the horizon the line is a target
    assert front[-1] == pytest.approx(LINE, abs=0.01) and abs(poses[-1, 3]) < 1e-6
    beside = np.abs(poses[:, 0] + 1.4 - 45.0) < 0.9 + 4.9 / 2
    assert (poses[beside, 1] - 1.9 / 2 > -1.5 + 0.6 / 2).all()


def test_example_keeps_to_the_seam_in_forty_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    from curb_height.model import CurbHeight
    from curb_height.scenario import driveway

    model, data = CurbHeight(), driveway().data
    check(model, data)
    latents = simulate(model, data, num=100, seed=0)
    for move in model.moves():
        assert_involution(move, latents, uniforms(move, 100, seed=1))
    lines = (EXAMPLES / "curb_height" / "model.py").read_text().partition("@dataclass")[2].splitlines()
    assert sum(bool(line.strip()) for line in lines) <= 40
