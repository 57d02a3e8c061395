"""The check every move of every model must pass: it is an involution, and its terms are its Jacobian.

    (z, u) -> (z', u') -> (z, u),   log |d(z', u') / d(z, u)| = log_backward - log_forward + log_jacobian

with u on the unit cube (models.capability). The Jacobian is taken by central differences, over the
float sites of z and all of u; inactive slots keep values, so the map is square on all of them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from models.capability import Move, Proposal
from models.program import Latents, quiet_doubles

NUDGE = 1e-6  # of each coordinate, relative: truncation 1e-12, rounding 1e-10
SMALLEST = 1e-3  # coordinates nearer to zero are nudged as if they were this large


def assert_involution(
    move: Move,
    z: Latents,
    u: Tensor,
    *,
    periods: dict[str, float] | None = None,
    relative: float = 1e-9,
    tolerance: float = 1e-5,
    num_jacobians: int = 20,
) -> None:
    """Check a move at z {site: (B, *event)}, u (B, U); Jacobians at the first valid rows.

    periods  {site: period} of sites that wrap, such as angles"""
    with quiet_doubles():
        there = move.propose(z, u)
        back = move.propose(there.latents, there.uniforms)
        rows = there.valid.nonzero()[:, 0]
        assert len(rows) > 0, f"no proposal of '{move.name}' is valid: nothing was checked"
        _assert_round_trip(move.name, z, u, there, back, rows, periods or {}, relative)
        for row in rows[:num_jacobians].tolist():
            reported = (there.log_backward - there.log_forward + there.log_jacobian)[row]
            numeric = numeric_log_jacobian(move, _row(z, row), u[row : row + 1], periods=periods)
            assert abs(float(reported) - numeric) < tolerance, (
                f"'{move.name}' reports a log Jacobian of {float(reported):.6f}, numerically it is {numeric:.6f}"
            )


def _assert_round_trip(
    name: str,
    z: Latents,
    u: Tensor,
    there: Proposal,
    back: Proposal,
    rows: Tensor,
    periods: dict[str, float],
    relative: float,
) -> None:
    assert bool(back.valid[rows].all()), f"'{name}' leads where its own reverse is not valid"
    inside = (there.uniforms[rows] >= 0) & (there.uniforms[rows] <= 1)
    assert bool(inside.all()), f"'{name}' returns uniforms outside the unit cube"
    for site, before in (z | {"u": u}).items():
        after = back.uniforms if site == "u" else back.latents[site]
        gap = _wrap((after - before)[rows].double(), periods.get(site))
        limit = relative * torch.clamp(before[rows].abs().double(), min=SMALLEST)
        assert bool((gap.abs() <= limit).all()), f"'{name}' does not return '{site}': off by {gap.abs().max():.3g}"
    for one, other, term in (
        (there.log_forward, back.log_backward, "log_forward is not the reverse's log_backward"),
        (there.log_backward, back.log_forward, "log_backward is not the reverse's log_forward"),
        (there.log_jacobian, -back.log_jacobian, "log_jacobian does not change sign on the way back"),
    ):
        torch.testing.assert_close(one[rows], other[rows], atol=1e-7, rtol=1e-7, msg=f"'{name}': {term}")


def numeric_log_jacobian(move: Move, z: Latents, u: Tensor, *, periods: dict[str, float] | None = None) -> float:
    """log |det d(z', u') / d(z, u)| at one point, z {site: (1, *event)} and u (1, U)."""
    sites = [name for name, value in z.items() if value.is_floating_point()]
    point = torch.cat([z[name].reshape(-1) for name in sites] + [u[0]])  # (n,)
    size = torch.cat([point[: -len(u[0])].abs().clamp(min=SMALLEST), torch.minimum(u[0], 1 - u[0])])
    nudge = NUDGE * size
    batch = torch.cat([point + torch.diag(nudge), point - torch.diag(nudge)])  # (2n, n)
    moved = {name: value.expand(len(batch), *value.shape[1:]) for name, value in z.items()}
    start = 0
    for name in sites:
        moved[name] = batch[:, start : start + z[name].numel()].reshape(moved[name].shape).clone()
        start += z[name].numel()
    result = move.propose(moved, batch[:, start:].clone())
    for name, value in result.latents.items():
        if not value.is_floating_point():
            assert bool((value == value[0]).all()), f"'{move.name}' changes '{name}' under a small nudge"
    assert {n for n, v in result.latents.items() if v.is_floating_point()} == set(sites), "the map is not square"
    gaps = []
    for name in sites:
        plus, minus = result.latents[name].reshape(len(batch), -1).chunk(2)
        gaps.append(_wrap(plus - minus, (periods or {}).get(name)))
    plus, minus = result.uniforms.chunk(2)
    columns = torch.cat([*gaps, plus - minus], 1) / (2 * nudge[:, None])  # (n inputs, n outputs)
    assert columns.shape[0] == columns.shape[1], f"the map of '{move.name}' is not square: {tuple(columns.shape)}"
    scaled = columns * size[:, None] / size  # the same determinant, nearer to one unit
    return float(torch.linalg.slogdet(scaled).logabsdet)


def _row(z: Latents, row: int) -> Latents:
    return {name: value[row : row + 1] for name, value in z.items()}


def _wrap(gap: Tensor, period: float | None) -> Tensor:
    """The short way round."""
    return gap if period is None else torch.remainder(gap + period / 2, period) - period / 2


def uniforms(move: Move, num: int, *, seed: int) -> Tensor:
    """(num, U) points of the open unit cube."""
    generator = torch.Generator().manual_seed(seed)
    number = torch.rand(num, move.num_uniforms, generator=generator, dtype=torch.float64)
    return number.clamp(math.ulp(1.0), 1 - math.ulp(1.0))
