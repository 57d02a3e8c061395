"""When to accept a step: Green's rule, and the two of Meyer, Walter, Lauer (2020).

With q the density of the step and J the Jacobian of its map, both in natural units, and T the temperature,
a step z -> z' is accepted if log u is below

    exact    log p(z')/p(z) + log p(y|z')/p(y|z) / T + log q(z'->z)/q(z->z') + log |J|     Green (1995), eq. 7
    paper    (log p(z')/p(z) + log p(y|z')/p(y|z)) / T + log q(z'->z)/q(z->z')             [M20] without its slip
    printed  log p(z')/p(z) + log p(y|z')/p(y|z) + log q(z->z') / T - log q(z'->z)         [M20] eq. 2

[M20] drops the Jacobian (footnote 2). The probability of choosing the move is part of q."""

from __future__ import annotations

RULES = {"exact": 0, "paper": 1, "printed": 2}


def log_acceptance(rule, temperature, prior, likelihood, forward, backward, jacobian):  # type: ignore[no-untyped-def]
    """Log acceptance ratio; prior and likelihood are log ratios new / old.

    Plain arithmetic: the batched path calls it with tensors, the compiled chain compiles it."""
    if rule == 2:
        return prior + likelihood + forward / temperature - backward
    if rule == 1:
        return (prior + likelihood) / temperature + backward - forward
    return prior + likelihood / temperature + backward - forward + jacobian
