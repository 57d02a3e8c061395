"""A scan as a random set: what one sensor reports of objects that it detects, misses, or takes for others.

Of S objects, each detected with probability p_i and then measured as z ~ g_i, and false alarms, a Poisson process of
intensity lambda_c, an association theta gives each object its measurement or none, no two the same:

    log p(Z, theta | X) = -int lambda_c + sum_clutter log lambda_c(z) + sum_detected log p_i g_i(z_theta(i))
                          + sum_missed log(1 - p_i)

    p(Z | X) = sum_theta p(Z, theta | X)

This is a density of the *set* Z = {z_1, ..., z_M}: that of the list in any one order is p(Z) / M!, and the set integral
sum_M 1/M! int p({z_1, ..., z_M}) dz_1 ... dz_M is one (Mahler 2007, 11.3). Lists are simulated shuffled.

What else a measurement shows (its looks, a score) has a density relative to that of false alarms.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from models.program import InputError

LARGEST = 12  # of the smaller of objects and measurements, whose subsets are counted
NEVER = -1e9  # log of nothing, with a gradient


class FalseAlarms(NamedTuple):
    """Independent of each other and in each entry.

    expected  number in a scan
    low, high (d,) where they are, uniformly
    quantile  of uniform numbers (*, d), where they are not uniform
    """

    expected: float
    low: Tensor
    high: Tensor
    quantile: Callable[[Tensor], Tensor] | None = None


class Looks(NamedTuple):
    """p(looks l | kind) (C, L), and of false alarms (L,)."""

    of_kind: Tensor
    of_clutter: Tensor


class ScanSet(TorchDistribution):
    """Scans of R rows (present, z (d,), features (C,)): p(feature | kind) / p(feature | false alarm). Rows that are not
    present hold anything.

    predicted    (*B, S, d) h(x)
    noise        (*B, S, K, d, d) covariances of an object's measurement as each of them; S and K may be 1
    detection    (*B, S), zero where no object is
    kind         (*B, S)
    clutter      intensity (*, M) of measurements (*, M, d)
    period       (d,) of angles, inf else

    Raises InputError where both objects and measurements are too many for their associations to be summed over."""

    arg_constraints: dict[str, Any] = {}  # noqa: RUF012
    support = constraints.independent(constraints.real, 2)
    has_rsample = False

    def __init__(
        self,
        predicted: Tensor,
        noise: Tensor,
        detection: Tensor,
        kind: Tensor,
        false_alarms: FalseAlarms,
        clutter: Any,
        period: Tensor,
        num_kinds: int,
        looks: Looks | None = None,
        rows: int | None = None,
    ) -> None:
        self.predicted, self.noise, self.detection, self.kind = predicted, noise, detection, kind
        self.false_alarms, self.clutter, self.period, self.looks = false_alarms, clutter, period, looks
        self.num_kinds, self.num_objects = num_kinds, predicted.shape[-2]
        self.rows = capacity(self.num_objects, false_alarms.expected) if rows is None else rows
        super().__init__(detection.shape[:-1], torch.Size([self.rows, 1 + predicted.shape[-1] + num_kinds]))

    def expand(self, batch_shape: Any, _instance: Any = None) -> ScanSet:
        own = self.predicted.shape[-2:]
        return ScanSet(
            self.predicted.expand(*batch_shape, *own),
            self.noise.expand(*batch_shape, *self.noise.shape[-4:]),
            self.detection.expand(*batch_shape, own[0]),
            self.kind.expand(*batch_shape, own[0]),
            *(self.false_alarms, self.clutter, self.period, self.num_kinds, self.looks, self.rows),
        )

    def sample(self, sample_shape: Any = ()) -> Tensor:
        return self.sample_sources(sample_shape)[0]

    def sample_sources(self, sample_shape: Any = ()) -> tuple[Tensor, Tensor]:
        """Scans (*sample, *B, R, 1 + d + C), and which object each measurement is of (*sample, *B, R), -1 none."""
        shape = torch.Size(sample_shape) + self.detection.shape[:-1]
        num, d = self.num_objects, self.predicted.shape[-1]
        seen = torch.rand(*shape, num) < self.detection
        error = torch.linalg.cholesky(self.noise[..., 0, :, :]) @ torch.randn(*shape, num, d, 1)
        measured = self.predicted + error[..., 0]
        alarms = capacity(num, self.false_alarms.expected) - num
        count = torch.poisson(torch.full(shape, float(self.false_alarms.expected))).clamp(max=alarms)
        _, low, high, quantile = self.false_alarms
        uniform = torch.rand(*shape, alarms, d)
        false = low + (high - low) * uniform if quantile is None else quantile(uniform)
        present = torch.cat([seen, torch.arange(alarms) < count[..., None]], -1)
        values = wrapped(torch.cat([measured, false], -2), self.period)
        source = torch.cat([torch.arange(num), torch.full((alarms,), -1)]).expand(present.shape)
        features = self._draw_features(source)
        order = (torch.rand(present.shape) + 2.0 * ~present).argsort(-1)[..., : self.rows]  # those present first
        scan = torch.cat([present[..., None].double(), values, features], -1) * present[..., None]
        rows = order[..., None].expand(*order.shape, scan.shape[-1])
        return scan.gather(-2, rows), torch.where(present, source, -1).gather(-1, order)

    def _draw_features(self, source: Tensor) -> Tensor:
        """(*, C) of measurements of objects `source`."""
        if self.looks is None:
            return torch.ones(*source.shape, self.num_kinds)
        of_kind, of_clutter = self.looks
        kind = self.kind.expand(*source.shape[:-1], self.num_objects).gather(-1, source.clamp(min=0))
        probability = torch.where((source < 0)[..., None], of_clutter, of_kind[kind])
        seen = torch.distributions.Categorical(probability).sample()
        return (of_kind / of_clutter).T[seen]

    def tables(self, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log weights of an association: of objects detected as measurements (*B, S, M), of objects missed (*B, S),
        and of measurements that are false alarms (*B, M)."""
        present, feature = value[..., 0] > 0.5, value[..., -self.num_kinds :]
        z = torch.where(present[..., None], value[..., 1 : 1 + len(self.period)], 0.0)
        residual = wrapped(z[..., None, :, :] - self.predicted[..., :, None, :], self.period)  # (*B, S, M, d)
        factor = torch.linalg.cholesky(self.noise)
        white = torch.linalg.solve_triangular(factor, residual[..., None], upper=False)[..., 0]
        log_volume = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) + 0.5 * z.shape[-1] * math.log(2 * math.pi)
        kind = self.kind[..., None].expand(*residual.shape[:-1])
        shown = feature[..., None, :, :].expand(*residual.shape[:-1], self.num_kinds).gather(-1, kind[..., None])
        detected = -0.5 * white.square().sum(-1) - log_volume + log(shown[..., 0]) + log(self.detection)[..., None]
        detected = torch.where(present[..., None, :], detected.clamp(min=NEVER), NEVER)
        clutter = torch.where(present, log(self.clutter(z)), 0.0)
        return detected, log(1.0 - self.detection).expand(detected.shape[:-1]), clutter

    def log_prob(self, value: Tensor) -> Tensor:
        """log p(Z | X), (*B)."""
        detected, missed, clutter = self.tables(self._trimmed(value))
        possible = self.detection.reshape(math.prod(self.detection.shape[:-1]), self.num_objects) > 0.0
        may = possible.any(0)  # the others are missed, with log 1
        total = log_sum_associations(detected[..., may, :], missed[..., may], clutter)
        return total - self.false_alarms.expected

    def log_prob_of(self, value: Tensor, theta: Tensor) -> Tensor:
        """log p(Z, theta | X) (*B) of one association theta (*B, S): the row of an object's measurement, -1 where it is
        missed. -inf where two objects share a row, or a row is not present."""
        detected, missed, clutter = self.tables(value)
        theta = theta.expand(missed.shape)
        taken = (theta[..., None] == torch.arange(value.shape[-2])).sum(-2)  # (*B, R)
        chosen = detected.gather(-1, theta.clamp(min=0)[..., None])[..., 0]
        total = torch.where(theta < 0, missed, chosen).sum(-1) + torch.where(taken > 0, 0.0, clutter).sum(-1)
        found = total - self.false_alarms.expected
        return torch.where((taken > 1).any(-1) | (found < 0.5 * NEVER), -torch.inf, found)

    def _trimmed(self, value: Tensor) -> Tensor:
        """Without the last rows that are present in no scan of the batch."""
        some = (value[..., 0] > 0.5).reshape(math.prod(value.shape[:-2]), value.shape[-2]).any(0)
        return value[..., : int(some.nonzero().max()) + 1 if bool(some.any()) else 0, :]


def capacity(num_objects: int, expected: float) -> int:
    """Rows that hold any scan, but for more false alarms than come once in 1e12 scans: their tail is below
    exp(-t^2 / (2 (expected + t / 3))) at expected + t (Bernstein)."""
    limit = 12 * math.log(10.0)
    return num_objects + math.ceil(expected + limit / 3 + math.sqrt(limit**2 / 9 + 2 * limit * expected))


def wrapped(value: Tensor, period: Tensor) -> Tensor:
    """Angles within half a period of zero."""
    finite = period.isfinite()
    turn = torch.where(finite, period, 1.0)
    return torch.where(finite, value - turn * torch.floor(value / turn + 0.5), value)


def log(value: Tensor) -> Tensor:
    """The logarithm, and NEVER of zero; gradients stay finite."""
    return torch.where(value > 0.0, value.clamp(min=1e-300).log(), NEVER)


def log_sum_associations(detected: Tensor, missed: Tensor, clutter: Tensor) -> Tensor:
    """log sum_theta prod of weights (*B), theta partial and injective: pairs (*B, S, M), alone (*B, S) and (*B, M).

    The smaller side is held as a set of who is taken yet: 2^min(S, M) sums, a step for each of the other side. Raises
    InputError where that is more than 2^LARGEST."""
    num_objects, num_measurements = detected.shape[-2:]
    if num_objects > num_measurements:
        return log_sum_associations(detected.transpose(-1, -2), clutter, missed)
    if num_objects > LARGEST:
        raise InputError(
            f"{num_objects} objects and {num_measurements} measurements have too many associations to sum over; "
            f"give the model at most {LARGEST} slots, or evaluate one association (log_prob_of)"
        )
    masks = torch.arange(2**num_objects)
    has = (masks >> torch.arange(num_objects)[:, None] & 1).bool()  # (S, 2^S)
    before = torch.where(has, masks ^ (1 << torch.arange(num_objects))[:, None], 0)
    found = torch.where(masks == 0, 0.0, NEVER).expand(*detected.shape[:-2], -1)
    for j in range(num_measurements):
        one = torch.where(has, found[..., before] + detected[..., :, j, None], NEVER)  # (*B, S, 2^S)
        found = torch.cat([(found + clutter[..., j, None])[..., None, :], one], -2).logsumexp(-2)
    rest = torch.where(has, 0.0, missed[..., None]).sum(-2)
    total = (found + rest).logsumexp(-1)
    return torch.where(total < 0.5 * NEVER, -torch.inf, total)
