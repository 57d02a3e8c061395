"""Shared by the tests: the console command in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

# the same examples at every run; `--hypothesis-profile=new` draws others
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("new", deadline=None)
settings.load_profile("same")

Command = Callable[..., subprocess.CompletedProcess[str]]

FAKE_ENGINE = '''
"""An engine outside the tree: instant exact draws of the conjugate Gaussian, and a log of its calls."""
from typing import Literal

import numpy as np

SHIFT = 0.25


def run(model, evidence, *, seed: int, num_draws: int = 200, shift: float = 2 * SHIFT - 0.5,
        style: Literal["calm", "angry"] = "calm", fail_at: int | None = None):
    from inference.posterior import Posterior
    from models.program import InputError

    with open("calls.txt", "a") as file:
        file.write(f"{seed} ")
    if style == "angry":
        raise RuntimeError("the engine blew up")
    if fail_at == num_draws:
        raise InputError(f"num_draws is {num_draws}; choose another")
    mean, covariance, evidence = model.exact(evidence)
    draws = np.random.default_rng(seed).multivariate_normal(mean.numpy(), covariance.numpy(), size=(2, num_draws))
    return Posterior({"beta": draws + shift}, log_evidence=float(evidence), info={"evaluations": num_draws})
'''


@pytest.fixture
def launch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run a module of experiments where the user stands: beside a fake engine outside the tree."""
    (tmp_path / "fake_engine.py").write_text(FAKE_ENGINE)
    (tmp_path / "conf" / "engine").mkdir(parents=True)
    (tmp_path / "conf" / "engine" / "fake.yaml").write_text("_target_: fake_engine.run\n_partial_: true\n")
    monkeypatch.chdir(tmp_path)

    def command(*words: str, module: str = "experiments.run") -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-m", module, *words], capture_output=True, text=True, timeout=120)

    return command
