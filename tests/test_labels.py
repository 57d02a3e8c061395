"""Numbers of roads are told by what they are, with units."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.figures import marginals
from experiments.scenarios.night_drive import night_drive
from experiments.scenarios.road import night_road
from experiments.scenarios.scene import Scene
from inference import particle_filter
from inference.posterior import Posterior
from models.program import simulate
from models.road.course import RoadCourse
from models.road.fork import ForkedRoad
from models.road.frames import RoadFrames
from models.road.segments import SegmentedRoad


@pytest.mark.parametrize("model", [RoadCourse(), SegmentedRoad(), ForkedRoad()])
def test_each_number_of_a_labelled_site_has_a_name_of_its_own(model: Any) -> None:
    evidence = model.prepare(night_road(seed=1).data)
    draws, labels = simulate(model, evidence, num=1, seed=0), model.labels(evidence)
    for site, names in labels.items():
        assert len(set(names)) == draws[site][0].numel(), site


def test_numbers_of_a_drive_are_named_by_frame() -> None:
    model = RoadFrames()
    frames = model.prepare(night_drive(seed=0).data)[:3]
    posterior = particle_filter.run(model, frames, seed=0, num_particles=20)
    labelled = Posterior(posterior.draws, labels=model.labels(frames))
    assert labelled.title("course", (2, 3)) == "frame 2: end x [m]"
    assert labelled.title("road", (0, 3)) == "frame 0: curvature rate [1/m²]"
    for site, names in labelled.labels.items():
        assert len(names) == np.prod(labelled.draws[site].shape[2:])


def test_marginals_are_titled_by_the_labels(tmp_path: Path) -> None:
    index = np.array([[0, 1, 1, 0]])
    draws = {"rate": np.arange(4.0)[None], "num_knots": index}
    labels = {"rate": ("rate [1/m²]",), "num_knots": ("number of knots",)}
    posterior = Posterior(draws, model_index=index, labels=labels)
    posterior.save(tmp_path)
    axes = marginals(Posterior.load(tmp_path), Scene(None, None, "none", {}))["marginals"].axes
    assert [axes[i].get_ylabel() for i in (0, 2)] == ["rate [1/m²]", "number of knots"]
    bare = marginals(Posterior({"z": np.zeros((1, 4, 2))}), Scene(None, None, "none", {}))["marginals"].axes
    assert [bare[i].get_ylabel() for i in (0, 2)] == ["z[0]", "z[1]"]
