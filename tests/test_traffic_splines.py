"""Independent splines, the baseline of held-out scores, and the choice between lanes that share and lanes alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from experiments.traffic_lanes import EDGE, choose
from experiments.traffic_splines import dense_basis, spline_lanes
from inference.posterior import Posterior
from models.intersection.traffic_lanes import TrafficLanes
from models.program import InputError
from tests.drawn_traffic import noisy, straight

STD = 0.3
MODEL = TrafficLanes()
EVIDENCE = MODEL.prepare(noisy([straight((-60, 0), (60, 0))] * 20, std=STD))


def test_splines_run_where_their_tracks_do_as_surely_as_they_say() -> None:
    """Of 20 tracks with a point each metre, 120 m share 20 controls: the mean of squared z over the line has about 19
    degrees of freedom, and is within four of its standard deviations, 4 sqrt(2 / 19), of 1."""
    lanes = spline_lanes(EVIDENCE.courses, EVIDENCE.routes, STD, EDGE)
    line, half = lanes.lines[0], lanes.left[0]
    z = (line[:, 1] / (half / EDGE))[3:-3]
    assert abs((z**2).mean() - 1.0) < 4.0 * np.sqrt(2.0 / 19.0)
    assert half[len(half) // 2] < 0.1


def test_the_basis_of_a_spline_sums_to_one() -> None:
    assert dense_basis(np.linspace(0.0, 50.0, 99), 50.0).sum(1) == pytest.approx(np.ones(99), abs=1e-12)


@pytest.mark.parametrize("nats", [3.0, -3.0])
def test_the_larger_evidence_decides_what_lanes_share(nats: float) -> None:
    def refine(model: TrafficLanes, evidence: Any, *, seed: int) -> Posterior:
        return Posterior({"x": np.zeros((1, 1))}, log_evidence=nats if model.courses.shared else 0.0)

    found, used = choose(MODEL, EVIDENCE, refine, 0)
    assert found.info == {"shared": nats > 0, "shared_nats": nats}
    assert (used is EVIDENCE) == (nats > 0)


def test_an_engine_without_evidence_cannot_choose() -> None:
    def refine(model: TrafficLanes, evidence: Any, *, seed: int) -> Posterior:
        return replace(Posterior({"x": np.zeros((1, 1))}), log_evidence=None)

    with pytest.raises(InputError, match="no evidence"):
        choose(MODEL, EVIDENCE, refine, 0)
