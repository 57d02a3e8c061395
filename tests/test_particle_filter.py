"""The particle filter against Kalman's: moments, evidence without bias, and every term that is taken away is missed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

from inference import guide, particle_filter, weights
from inference.posterior import Posterior
from models.capability import State
from models.program import InputError, log_joint, simulate
from models.toys.gaussian import ConjugateGaussian, Readings
from models.toys.linear_walk import Fix, LinearWalk
from models.unroll import observe_frames, stack_frames

MODEL = LinearWalk()
BLANK = tuple(Fix(None, seconds) for seconds in (1.0, 1.0, 0.3, 2.0, 1.0, 0.5))
FRAMES, _ = observe_frames(BLANK, {n: v[0] for n, v in simulate(MODEL, BLANK, num=1, seed=4).items()})
EXACT = MODEL.exact(FRAMES)
PROPOSALS = pytest.mark.parametrize("proposal", ["bootstrap", "guided"])


def run(seed: int, proposal: str, num: int = 400, frames: Sequence[Fix] = FRAMES, **knobs: Any) -> Posterior:
    return particle_filter.run(MODEL, frames, seed=seed, proposal=proposal, num_particles=num, **knobs)  # type: ignore[arg-type]


def scores(values: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """z-scores of the mean over independent runs (axis 0)."""
    return np.abs(values.mean(0) - exact) / (values.std(0, ddof=1) / math.sqrt(len(values)))


@PROPOSALS
def test_filtering_moments_are_kalmans(proposal: str) -> None:
    """24 z-scores from 40 runs, whose own bias of order 1 / N is far below; 4.5 is passed once in thousands."""
    draws = [run(seed, proposal).draws["walk"][0] for seed in range(40)]
    means = np.stack([d.mean(0) for d in draws])
    squares = np.stack([np.square(d - EXACT.filtered_mean).mean(0) for d in draws])
    variance = np.diagonal(EXACT.filtered_covariance, axis1=1, axis2=2)
    assert scores(means, EXACT.filtered_mean).max() < 4.5
    assert scores(squares, variance).max() < 4.5


@PROPOSALS
def test_evidence_is_unbiased(proposal: str) -> None:
    """The mean of p / exact over 150 runs of few particles, within four standard errors."""
    ratio = np.array([math.exp(evidence(seed, proposal) - EXACT.log_evidence) for seed in range(150)])
    error = ratio.std() / math.sqrt(len(ratio))
    assert error < 0.08
    assert ratio.mean() == pytest.approx(1.0, abs=4 * error)


def evidence(seed: int, proposal: str, **knobs: Any) -> float:
    found = run(seed, proposal, num=60, **knobs).log_evidence
    assert found is not None
    return found


def test_resampling_at_every_frame_or_never_changes_no_mean() -> None:
    for ess in (1e-6, 1.0):
        ratio = np.array([math.exp(evidence(s, "bootstrap", ess=ess) - EXACT.log_evidence) for s in range(80)])
        assert ratio.mean() == pytest.approx(1.0, abs=4 * ratio.std() / math.sqrt(len(ratio)))


def test_a_perfect_guide_leaves_nothing_to_weigh() -> None:
    """Without unguided moves the evidence of the first frame is exact, and that of others as good as their parents."""
    assert run(1, "guided", defence=0.0).info["ess"] == pytest.approx([400.0] * len(FRAMES))
    first = run(1, "guided", num=5, frames=FRAMES[:1], defence=0.0)
    assert first.log_evidence == pytest.approx(MODEL.exact(FRAMES[:1]).log_evidence, abs=1e-10)


@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_a_wrong_guide_costs_particles_but_no_truth(factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Guides of a third or three times the information, one metre off: what they get wrong is weighed."""
    right = guide.climb

    def wrong(whole: Any, x: np.ndarray) -> guide.Guide:
        found = right(whole, x)
        return found._replace(at=found.at + np.array([1.0, 0.0]), information=factor * found.information)

    monkeypatch.setattr(guide, "climb", wrong)
    assert max(run(1, "guided").info["ess"]) < 0.9 * 400
    ratio = np.array([math.exp(evidence(seed, "guided") - EXACT.log_evidence) for seed in range(120)])
    assert ratio.mean() == pytest.approx(1.0, abs=4 * ratio.std() / math.sqrt(len(ratio)))


def test_ahead_is_the_product_of_the_move_and_the_guide() -> None:
    """Mass and moments against a grid over both numbers."""
    last = {"walk": torch.tensor([[0.4, -0.2], [1.0, 2.0]], dtype=torch.float64)}
    step = MODEL.gaussian_step(last, FRAMES[1])
    one = guide.Guide(np.array([0.7, 0.1]), -0.3, np.array([0.5, -0.4]), np.array([[2.0, 0.3], [0.3, 0.8]]))
    ahead = guide.look_ahead(one, step)
    axis = np.linspace(-8.0, 8.0, 401)
    u = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    for n in range(2):
        height = one.log_density(step.mean[n] + u @ step.tril.T) - 0.5 * np.square(u).sum(1) - math.log(2 * math.pi)
        density = np.exp(height) * (axis[1] - axis[0]) ** 2
        mass = density.sum()
        assert ahead.log_mass[n] == pytest.approx(math.log(mass), abs=1e-6)
        np.testing.assert_allclose(ahead.centre[n], density @ u / mass, atol=1e-6)
        gap = u - ahead.centre[n]
        np.testing.assert_allclose(ahead.tril @ ahead.tril.T, (gap * density[:, None]).T @ gap / mass, atol=1e-6)


@PROPOSALS
def test_weights_that_are_dropped_are_missed(proposal: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sign that the tests above can fail: no weights, and for guided moves no share of the parents."""
    monkeypatch.setattr(weights, "systematic", lambda log_weights, num, uniform: np.arange(num) % log_weights.size)
    means = np.stack([run(seed, proposal).draws["walk"][0].mean(0) for seed in range(20)])
    assert scores(means, EXACT.filtered_mean).max() > 10.0


@PROPOSALS
def test_the_estimate_is_a_path_with_the_log_joint_of_the_program(proposal: str) -> None:
    found = run(1, proposal)
    path = {f"walk_{t}": torch.from_numpy(z) for t, z in enumerate(found.estimate["walk"])}
    assert found.snapshots is not None
    assert found.snapshots.log_joint[-1] == pytest.approx(float(log_joint(MODEL, path, FRAMES)), rel=1e-9)
    np.testing.assert_array_equal(found.snapshots.states["walk"][-1], found.estimate["walk"][-1])
    assert found.draws["walk"].shape == (1, 400, len(FRAMES), 2)


@PROPOSALS
def test_the_error_of_the_evidence_is_its_spread(proposal: str) -> None:
    """Of 60 runs the spread is known to 9 per cent, and the error told varies by as much; four times that."""
    runs = [run(seed, proposal, num=1000) for seed in range(60)]
    told = np.mean([p.info["log_evidence_error"] for p in runs])
    assert told / np.std([p.log_evidence for p in runs], ddof=1) == pytest.approx(1.0, abs=0.4)


def test_a_point_that_stands_still_is_guided_all_the_same() -> None:
    """Numbers without noise of their own: the covariance of a step is singular."""

    class Still(LinearWalk):
        def gaussian_step(self, state: State | None, frame: Fix) -> Any:
            step = super().gaussian_step(state, frame)
            if state is None:
                return step
            return step._replace(mean=state["walk"].numpy(), tril=np.zeros((2, 2)))

    y = np.array([0.5, 0.9, 0.2, 0.6, 0.4, 0.7])
    frames = tuple(Fix(torch.tensor(v)) for v in y)
    found = particle_filter.run(Still(), frames, seed=1, proposal="guided", num_particles=4000)
    precision = MODEL.start_std[0] ** -2 + len(y) * MODEL.noise_std**-2
    sd, mean = precision**-0.5, y.sum() / MODEL.noise_std**2 / precision
    last = found.draws["walk"][0, :, -1, 0]
    families = found.info["families"]  # distinct points that are left, about
    assert families > 500
    assert last.mean() == pytest.approx(mean, abs=4 * sd / math.sqrt(families))
    assert last.std() == pytest.approx(sd, rel=4 / math.sqrt(2 * families))


@PROPOSALS
def test_same_seed_same_bits_and_no_trace_on_torch(proposal: str) -> None:
    before = torch.random.get_rng_state()
    first, again, other = (run(seed, proposal) for seed in (1, 1, 2))
    assert torch.equal(before, torch.random.get_rng_state())
    np.testing.assert_array_equal(first.draws["walk"], again.draws["walk"])
    assert first.log_evidence == again.log_evidence != other.log_evidence


def test_a_surprise_is_flagged() -> None:
    """A reading a hundred metres off: few bootstrap particles bear its frame."""
    frames = (*FRAMES[:3], FRAMES[3]._replace(position=torch.tensor(100.0, dtype=torch.float64)), *FRAMES[4:])
    flags = run(1, "bootstrap", frames=frames).info["flags"]
    assert flags and all("frame" in flag and "may have lost the truth" in flag for flag in flags)
    assert run(1, "guided").info["flags"] == []


class Choppy:
    """Sites in plates, a state with more than its sites, and a frame without observations."""

    def initial(self, frame: Any) -> State:
        with pyro.plate("points", 3):
            return {"x": pyro.sample("x", dist.Normal(torch.zeros(3), 1.0))}

    def transition(self, state: State, frame: Any) -> State:
        with pyro.plate("points", 3):
            return {"x": pyro.sample("x", dist.Normal(0.5 * state["x"], 1.0))}

    def observe(self, state: State, frame: Any) -> None:
        if frame is not None:
            with pyro.plate("points", 3):
                pyro.sample("y", dist.Normal(state["x"], 1.0), obs=frame)


def test_plates_and_frames_without_observations_are_filtered() -> None:
    """Three independent numbers: posterior variance of one frame after two steps from a unit one."""
    seen = torch.tensor([1.0, 0.0, -2.0], dtype=torch.float64)
    found = particle_filter.run(Choppy(), (None, seen, None), seed=1, num_particles=20000)
    prior = 0.25 + 1.0
    expected = 0.5 * seen.numpy() * prior / (prior + 1.0)
    error = 4.0 * math.sqrt((0.25 * prior / (prior + 1.0) + 1.0) / 5000.0)  # of 20000, a fourth are worth
    np.testing.assert_allclose(found.draws["x"][0, :, 2].mean(0), expected, atol=error)
    spread = math.sqrt(prior + 1.0)
    exact = float(dist.Normal(torch.zeros(3), spread).log_prob(seen).sum())
    assert found.log_evidence == pytest.approx(exact, abs=4 * found.info["log_evidence_error"])


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "particles": ({"num_particles": 1}, "^num_particles is 1; the particle filter needs 2 or more$"),
    "ess": ({"ess": 0.0}, r"^ess is 0.0; choose a share in \(0, 1\]$"),
    "defence": ({"defence": 1.0}, r"^defence is 1.0; choose a share in \[0, 1\)$"),
    "proposal": ({"proposal": "best"}, "^proposal must be one of auto, guided, bootstrap, but is 'best'$"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_knob_is_named_with_its_value(case: str) -> None:
    bad, sentence = BAD[case]
    with pytest.raises(InputError, match=sentence):
        particle_filter.run(MODEL, FRAMES, seed=1, **bad)


def test_models_and_evidence_that_are_not_sequential_are_refused() -> None:
    readings = Readings(torch.zeros(2), torch.zeros(2))
    with pytest.raises(InputError, match="needs a sequential model, but ConjugateGaussian has no initial, transition"):
        particle_filter.run(ConjugateGaussian(), readings, seed=1)
    with pytest.raises(InputError, match=r"needs gaussian_step\(\), but Choppy has none; use proposal=bootstrap"):
        particle_filter.run(Choppy(), (None,), seed=1, proposal="guided")
    with pytest.raises(InputError, match="at least one frame"):
        particle_filter.run(MODEL, (), seed=1)
    with pytest.raises(InputError, match=r"no value for \['position'\]"):
        particle_filter.run(MODEL, BLANK, seed=1, proposal="bootstrap")


def test_one_frame_is_the_smoothed_window() -> None:
    found = stack_frames({"walk_0": run(1, "guided", frames=FRAMES[:1], num=4000).draws["walk"][:, :, 0]}, 2)["walk"]
    exact = MODEL.exact(FRAMES[:1])
    sd = np.sqrt(np.diagonal(exact.smoothed_covariance[0]))
    assert np.all(np.abs(found.mean((0, 1))[0] - exact.smoothed_mean[0]) < 4.0 * sd / math.sqrt(2000.0))
