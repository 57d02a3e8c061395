"""How well a sensor perceives, by Dempster and Shafer, after Meissner et al. (2013), reference [33] of [K15].

A condition gives masses on {detects}, {does not} and {either}, its ignorance. Independent conditions are combined by
Dempster's rule; K is their conflict:

    m(detects)  = (a_d b_d + a_d b_u + a_u b_d) / (1 - K),   m(does not) likewise,
    m(either)   = a_u b_u / (1 - K),                         K = a_d b_n + a_n b_d

    p_D = m(detects) + m(either) / 2          (pignistic)

in any order. Conditions in total conflict (K = 1) have no combination by the rule; here such a sensor detects nothing.

Scalars throughout, so that formulas (models.formula) use it.
"""

from __future__ import annotations

from typing import Any, NamedTuple


class Masses(NamedTuple):
    """Of one condition, or several; they sum to one."""

    detects: Any
    misses: Any
    either: Any


def combined(a: Masses, b: Masses, ops: Any) -> Masses:
    """Dempster's rule."""
    detects = a.detects * b.detects + a.detects * b.either + a.either * b.detects
    misses = a.misses * b.misses + a.misses * b.either + a.either * b.misses
    either = a.either * b.either
    left = detects + misses + either  # 1 - K
    some = left > 0.0
    safe = ops.where(some, left, 1.0)
    return Masses(detects / safe, ops.where(some, misses / safe, 1.0), either / safe)


def probability(masses: Masses) -> Any:
    """p_D."""
    return masses.detects + 0.5 * masses.either


def capability(detection: Any, doubt: Any) -> Masses:
    """A sensor that detects with probability `detection`, of which it is known but for the mass `doubt`."""
    return Masses(detection - 0.5 * doubt, 1.0 - detection - 0.5 * doubt, doubt)


def hindrance(share: Any) -> Masses:
    """What speaks against detection, with mass `share`, and never for it: weather, or what stands in between."""
    return Masses(0.0 * share, share, 1.0 - share)


def hidden_share(
    x: tuple[Any, ...], at: tuple[Any, ...], radius: Any, other: tuple[Any, ...], other_radius: Any, ops: Any
) -> Any:
    """How much of a disc about x is behind another, seen from `at`: the share of its angle that both have, softly none
    where the other is not nearer. Positions (x, y), radii [m]."""
    dx, dy, ox, oy = x[0] - at[0], x[1] - at[1], other[0] - at[0], other[1] - at[1]
    distance, nearer = ops.sqrt(dx * dx + dy * dy + 1e-9), ops.sqrt(ox * ox + oy * oy + 1e-9)
    apart = ops.fabs(ops.atan2(dx * oy - dy * ox, dx * ox + dy * oy + 1e-9))
    half, other_half = ops.atan2(radius, distance), ops.atan2(other_radius, nearer)
    both = ops.fmin(half + other_half - apart, 2.0 * ops.fmin(half, other_half))
    return (
        ops.fmax(both, 0.0) / (2.0 * half) * logistic((distance - nearer - other_radius) / (0.25 * other_radius), ops)
    )


def hidden_by_any(share: Any, existence: Any) -> Any:
    """(*, N) how much is hidden by any of J others, independently: shares (*, N, J), existence (*, J). Arrays of numpy
    or torch."""
    return 1.0 - (1.0 - share * existence[..., None, :]).prod(-1)


def logistic(value: Any, ops: Any) -> Any:
    """1 / (1 + exp(-value)), without overflow."""
    return 0.5 + 0.5 * ops.tanh(0.5 * value)
