"""A linear Gaussian state-space model: filters and smoothers must be exact on it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.capability import GaussianStep, State
from models.unroll import unroll

Floats = NDArray[np.float64]


class Fix(NamedTuple):
    """One frame.

    position  () what was read [m]; None simulates
    seconds   since the frame before
    """

    position: Tensor | None
    seconds: float = 1.0


class Smoothed(NamedTuple):
    """Means (T, 2) and covariances (T, 2, 2) given the frames so far (filtered) and all frames (smoothed), and
    log p(y)."""

    filtered_mean: Floats
    filtered_covariance: Floats
    smoothed_mean: Floats
    smoothed_covariance: Floats
    log_evidence: float


@dataclass(frozen=True)
class LinearWalk:
    """A point that drifts, of which the position is read.

    z = (position, speed),   z_0 ~ N(0, diag(start_std^2))
    z_t = F z_(t-1) + N(0, Q),   F = [[1, dt], [0, 1]],   Q = q^2 [[dt^3 / 3, dt^2 / 2], [dt^2 / 2, dt]]
    y_t ~ N(position_t, noise_std^2)
    """

    start_std: tuple[float, float] = (2.0, 1.0)
    jolt: float = 0.5  # q [m / s^1.5]
    noise_std: float = 0.5  # [m]

    def __call__(self, frames: Sequence[Fix]) -> None:
        unroll(self)(frames)

    def initial(self, frame: Fix) -> State:
        std = torch.tensor(self.start_std)
        return {"walk": pyro.sample("walk", dist.Normal(torch.zeros(2), std).to_event(1))}

    def transition(self, state: State, frame: Fix) -> State:
        F, Q = (torch.from_numpy(matrix) for matrix in self._step(frame))
        step = dist.MultivariateNormal(state["walk"] @ F.T, scale_tril=torch.linalg.cholesky(Q))
        return {"walk": pyro.sample("walk", step)}

    def observe(self, state: State, frame: Fix) -> None:
        pyro.sample("position", dist.Normal(state["walk"][..., 0], self.noise_std), obs=frame.position)

    def gaussian_step(self, state: State | None, frame: Fix) -> GaussianStep:
        """See models.capability; here the guide is the likelihood itself."""
        read, precision = float(frame.position), self.noise_std**-2  # type: ignore[arg-type]
        const = -math.log(self.noise_std) - 0.5 * math.log(2 * math.pi)

        def density(z: Floats) -> Floats:
            return const - 0.5 * precision * np.square(z[:, 0] - read)

        def slopes(z: Floats) -> tuple[float, Floats, Floats]:
            pull = np.array([precision * (read - z[0]), 0.0])
            return float(density(z[None])[0]), pull, np.diag([precision, 0.0])

        if state is None:
            mean, tril = np.zeros((1, 2)), np.diag(self.start_std)
        else:
            F, Q = self._step(frame)
            mean, tril = state["walk"].numpy() @ F.T, np.linalg.cholesky(Q)
        return GaussianStep(mean, tril, density, slopes, lambda z: {"walk": torch.from_numpy(z)})

    def exact(self, frames: Sequence[Fix]) -> Smoothed:
        """Kalman's filter and the smoother of Rauch, Tung and Striebel."""
        H, mean, P, log_evidence = np.array([1.0, 0.0]), np.zeros(2), np.diag(self.start_std) ** 2, 0.0
        filtered, predicted = list[tuple[Floats, Floats]](), list[tuple[Floats, Floats]]()
        for number, frame in enumerate(frames):
            if number:
                F, Q = self._step(frame)
                mean, P = F @ mean, F @ P @ F.T + Q
            predicted.append((mean, P))
            gap, spread = float(frame.position) - mean[0], P[0, 0] + self.noise_std**2  # type: ignore[arg-type]
            log_evidence -= 0.5 * (gap**2 / spread + math.log(2 * math.pi * spread))
            gain = P @ H / spread
            mean, P = mean + gain * gap, P - np.outer(gain, H @ P)
            filtered.append((mean, P))
        smoothed = [filtered[-1]]
        for t in range(len(frames) - 2, -1, -1):
            F, _ = self._step(frames[t + 1])
            (m, P), (next_mean, next_P) = filtered[t], smoothed[0]
            back = P @ F.T @ np.linalg.inv(predicted[t + 1][1])
            m = m + back @ (next_mean - predicted[t + 1][0])
            smoothed.insert(0, (m, P + back @ (next_P - predicted[t + 1][1]) @ back.T))
        (means, covariances), (late_means, late_covariances) = zip(*filtered, strict=True), zip(*smoothed, strict=True)
        parts = [np.stack(column) for column in (means, covariances, late_means, late_covariances)]
        return Smoothed(parts[0], parts[1], parts[2], parts[3], log_evidence)

    def _step(self, frame: Fix) -> tuple[Floats, Floats]:
        """F and Q."""
        dt = frame.seconds
        Q = self.jolt**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        return np.array([[1.0, dt], [0.0, 1.0]]), Q
