"""What a junction and its engine refuse, in words and before any work."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from experiments.scenarios.protocol import protocol
from inference import rjmcmc
from models.intersection.state import Junction
from models.intersection.tracks import Tracks
from models.program import InputError, fix, log_joint, simulate

SCENE = protocol(3, heading_std=0.1)
POINTS, HEADING, OFFSETS = SCENE.data.points, SCENE.data.heading, SCENE.data.offsets
assert HEADING is not None


def spoilt(values: np.ndarray, row: int, value: float) -> np.ndarray:
    out = values.copy()
    out[row] = value
    return out


@pytest.mark.parametrize(
    ("tracks", "words"),
    [
        (Tracks(POINTS, HEADING[:-500], OFFSETS), "one heading a point"),
        (Tracks(POINTS[:-5], None, OFFSETS), "offsets of tracks must rise"),
        (Tracks(np.column_stack([POINTS, HEADING]), None, OFFSETS), "shape"),
        (Tracks(spoilt(POINTS, 7, np.nan), HEADING, OFFSETS), "points of track 0 are not finite at its point 7"),
        (Tracks(POINTS, spoilt(HEADING, 200, np.inf), OFFSETS), "headings of track 1"),
        (Tracks(POINTS, HEADING + 1e6, OFFSETS), "radians"),
        (Tracks(np.tile([[500.0, 3.0]], (9, 1)), None, np.array([0, 9])), "give tracks that cross"),
    ],
)
def test_tracks_that_machine_code_could_not_read_are_refused(tracks: Tracks, words: str) -> None:
    with pytest.raises(InputError, match=words):
        Junction().prepare(tracks)


def test_a_standing_vehicle_is_no_half_track() -> None:
    still = np.tile([[20.0, 3.0]], (40, 1))
    tracks = Tracks(np.vstack([POINTS, still]), None, np.append(OFFSETS, OFFSETS[-1] + 40))
    with_it, without = Junction().prepare(tracks), Junction().prepare(SCENE.data._replace(heading=None))
    assert with_it.num_halves == without.num_halves


@pytest.mark.parametrize(
    "knobs",
    [
        {"likelihood": "exat"},
        {"steps": "m2o"},
        {"clutter": 1.0},
        {"clutter": -0.1},
        {"width_spread": -0.1},
        {"offset_std": float("nan")},
        {"gap_max": float("inf")},
        {"inner_radius": 0.0},
        {"max_lanes": 0},
        {"likelihood": "half"},  # with bends
    ],
)
def test_a_setting_without_meaning_is_refused_by_name(knobs: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(knobs))):
        Junction(**knobs)


@pytest.mark.parametrize(
    ("knobs", "words"),
    [
        ({"num_steps": 0, "warmup": 0}, "num_steps"),
        ({"thin": 900, "num_steps": 600, "warmup": 0}, "thin"),
        ({"acceptance": "exakt"}, "acceptance"),
        ({"num_workers": -1}, "num_workers"),
        ({"polish": True, "path": "batched"}, "polish"),
        ({"resample": True, "warmup": 100}, "resample"),
        ({"init": {"num_arms": torch.tensor(3)}}, "init must give"),
    ],
)
def test_the_engine_refuses_before_any_step(knobs: dict[str, Any], words: str) -> None:
    model = Junction()
    with pytest.raises(InputError, match=words):
        rjmcmc.run(model, model.prepare(SCENE.data), seed=0, **knobs)


def test_polish_needs_a_refit_and_says_so_before_the_chains() -> None:
    model = Junction(likelihood="point", bend_std=0.0)
    with pytest.raises(InputError, match="refit"):
        rjmcmc.run(model, model.prepare(SCENE.data), seed=0, start="data", polish=True)


def test_fixing_the_number_of_arms_keeps_the_batch() -> None:
    model = Junction()
    evidence = model.prepare(SCENE.data)
    draws = simulate(model, evidence, num=5, seed=0)
    draws["num_arms"] = torch.full((5,), 3)
    rest = {name: value for name, value in draws.items() if name != "num_arms"}
    fixed = log_joint(fix(model, num_arms=torch.tensor(3)), rest, evidence)
    torch.testing.assert_close(fixed, log_joint(model, draws, evidence))


@pytest.mark.parametrize("width", [2.7, 0.9])
def test_polish_leaves_constants_alone(width: float) -> None:
    model = Junction(width=width, width_spread=0.0, bend_std=0.0)
    evidence = model.prepare(SCENE.data)
    posterior = rjmcmc.run(model, evidence, seed=0, num_chains=1, num_steps=600, warmup=600, start="data", polish=True)
    state = {name: torch.as_tensor(value) for name, value in posterior.estimate.items()}
    assert float(log_joint(model, state, evidence)) == pytest.approx(posterior.info["log_joint"], rel=1e-9)
