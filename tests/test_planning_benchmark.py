"""The benchmark of planning: what it reports, and that it runs."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from benchmarks import planning, planning_drives
from benchmarks.plain_margins import margins
from benchmarks.planning_scene import PLANNER, WIDE, Effort, fan, scene
from benchmarks.timing import THREADS
from planning.kinematics import LIMITS, MARGINS, Limits
from planning.planner import judge
from planning.shapes import boundary, no_obstacles

TINY = Effort(scenes=4, repeats=1)
PROMISED = {
    "ms_3000": "<= 10",
    "ms_10000": "<= 20",
    "ms_lazy_3000": "",
    "ratio_frenetix_kinematics": ">= 10",
    "ratio_frenetix_collision": ">= 20",
    "ratio_reactive": ">= 50",
    "projection_us": "<= 0.5",
    "projection_error_m": "<= 1e-06",
    "emitted_ratio": "<= 1.2",
    "ocp_ms_p95": "<= 15",
    "ocp_solved": ">= 1",
    "ocp_cost_ratio": "<= 1",
    "collisions_at_fault": "<= 0",
    "collisions": "",
    "limit_violations": "<= 0",
    "stops_passed": "<= 0",
    "stop_error_m": "<= 0.15",
    "gap_error_m": "<= 0.3",
    "emergency_share": "",
    "unclear_share": "",
    "goal_share": "",
    "cycle_ms": "",
    "cycle_p99_ms": "",
    "consistency_p95_m": "<= 1e-09",
    "consistency_noisy_lead_m": "",
    "chance_stated": "",
    "chance_rate": "",
    "chance_ratio": "<= 1.2",
}
DRIVES = [figure.key for figure in planning_drives.MEASUREMENTS[0].figures]
OURS = [key for key in PROMISED if not key.startswith("ratio") and key not in DRIVES]


@pytest.fixture(autouse=True)
def own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command pins threads by the environment: give the other tests theirs back."""
    for name in THREADS:
        monkeypatch.setenv(name, "1")


def test_every_promised_figure_is_there_once_with_its_target_and_definition() -> None:
    figures = [figure for measurement in planning.measurements() for figure in measurement.figures]
    targets = {figure.key: figure.target for figure in figures}
    assert len(targets) == len(figures)
    assert {key: targets[key] for key in PROMISED} == PROMISED
    assert all(len(figure.definition) > 13 for figure in figures)


def test_a_tiny_run_measures_every_figure_of_ours(capsys: pytest.CaptureFixture[str]) -> None:
    assert planning.main(["--json", "--only", ",".join(OURS)], effort=TINY) == 0
    found = json.loads(capsys.readouterr().out)
    for key in OURS:
        assert math.isfinite(found[key]) and found[key] >= 0.0, key


def test_the_kernel_written_by_hand_is_the_formula() -> None:
    x = np.random.default_rng(0).normal(0, 1, (20, 7))
    p = [getattr(Limits(), name) for name in LIMITS]
    by_hand = [margins(*map(float, row), *p) for row in x]
    np.testing.assert_allclose(MARGINS(x, np.array([p])), by_hand, rtol=1e-12, atol=1e-12)


def test_timed_candidates_are_all_judged_and_wide_limits_turn_none_down() -> None:
    given = scene(PLANNER)
    everything = judge(PLANNER, given, fan(PLANNER, 3000), PLANNER.comfort, first_good=False)
    assert (everything.reason >= 0).all() and 0 < (everything.reason == 0).sum() < 3000
    empty = given._replace(boundary=boundary([], PLANNER.radius), obstacles=no_obstacles(PLANNER.num_steps))
    assert (judge(PLANNER, empty, fan(PLANNER, 3000), WIDE, first_good=False).reason == 0).all()


def test_drives_are_counted_together(monkeypatch: pytest.MonkeyPatch) -> None:
    one = dict.fromkeys(("collisions_at_fault", "stops_passed"), 0.0) | {"collisions": 1.0, "limit_violations": 3.0}
    one |= {"emergency": 0.5, "cycle_median_ms": 8.0, "cycles": 10.0, "stop_error_m": 0.1, "unclear": 0.6}
    one |= {"goal_reached": 1.0, "cycle_p99_ms": 30.0}
    other = one | {
        "collisions_at_fault": 2.0,
        "emergency": 0.0,
        "cycles": 30.0,
        "stop_error_m": 0.05,
        "goal_reached": 0.0,
        "cycle_p99_ms": 40.0,
    }
    monkeypatch.setattr(planning_drives, "scores", lambda effort: {"follow": one, "recorded": other})
    found = planning_drives.closed_loops(TINY)
    told = {key: found[key].value for key in found}
    assert told == {
        "collisions_at_fault": 2.0, "collisions": 2.0, "limit_violations": 6.0, "stops_passed": 0.0,
        "stop_error_m": 0.1, "gap_error_m": None, "emergency_share": 0.125, "unclear_share": 0.6, "cycle_ms": 8.0,
        "goal_share": 0.5, "cycle_p99_ms": 40.0,
    }  # fmt: skip
    assert "recorded 2" in found["collisions_at_fault"].detail and "follow" in found["stop_error_m"].detail
    assert found["goal_share"].detail == "of 2; not recorded"


def test_every_simulated_scenario_is_driven() -> None:
    files = {path.stem for path in (planning_drives.ROOT / "configs" / "scenario").glob("drive_*.yaml")}
    assert files - {"drive_commonroad"} == {f"drive_{name}" for name in planning_drives.SIMULATED}
    assert list(planning_drives.drives(Effort(scenes=10**6, repeats=1)))[:7] == list(planning_drives.SIMULATED)
