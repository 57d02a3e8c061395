"""Processor time of clothoids against pyclothoids, one thread: python -m benchmarks.clothoid [--json]

Needs the extra `peers` for the comparison. Both are timed in turn, BATCH clothoids at a time."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from statistics import median
from typing import TYPE_CHECKING

from benchmarks.figure import Figure, Value, Values, as_json, machine, print_table
from benchmarks.timing import single_thread

if TYPE_CHECKING:
    from torch import Tensor

BATCH, SAMPLES, REPEATS = 1000, 71, 30  # 71 samples are 2 m apart on 140 m of road
ROADS = "roads with chords of 140 m and headings of N(0, 0.3 rad) off them"
FIGURES = (
    Figure(
        "g1_us_batch",
        "us",
        f"processor time of the G1 Hermite fit in torch, per clothoid of a batch of {BATCH} {ROADS}",
    ),
    Figure("pyclothoids_us", "us", "the same fits by pyclothoids, one after the other"),
    Figure("g1_ratio", "", "pyclothoids_us over g1_us_batch", at_least=3.0),
    Figure(
        "sample_ratio",
        "",
        f"processor time per sampled point of pyclothoids (SampleXY) over ours (sample, with headings and curvatures), "
        f"{SAMPLES} points on each clothoid",
        at_least=50.0,
    ),
)


def roads() -> tuple[Tensor, Tensor]:
    """Ends of the roads, (BATCH, 3) each."""
    import torch

    generator = torch.Generator().manual_seed(0)
    heading, other, along = torch.randn(3, BATCH, generator=generator, dtype=torch.float64) * 0.3
    zero = torch.zeros_like(heading)
    start = torch.stack((zero, zero, along + heading), 1)
    return start, torch.stack((140 * torch.cos(along), 140 * torch.sin(along), along + other), 1)


def microseconds(*jobs: Callable[[], object]) -> list[float]:
    """Median processor time of each job per clothoid [us]; they take turns. Waiting for other work does not count: it
    would hide the short job."""
    times: list[list[float]] = [[] for _ in jobs]
    for _ in range(REPEATS + 1):
        for job, kept in zip(jobs, times, strict=True):
            began = time.process_time()
            job()
            kept.append(1e6 * (time.process_time() - began) / BATCH)
    return [median(kept[1:]) for kept in times]  # the first warms up


def measure() -> Values:
    from models.clothoid import hermite, sample

    start, end = roads()
    found = hermite(start, end)
    try:
        from pyclothoids import Clothoid as Peer
    except ImportError:
        (fit_us,) = microseconds(lambda: hermite(start, end))
        missing = Value(None, "the extra 'peers' is not installed")
        return {figure.key: missing for figure in FIGURES} | {"g1_us_batch": Value(fit_us)}
    ends = list(zip(start.tolist(), end.tolist(), strict=True))
    peers = [Peer.G1Hermite(*a, *b) for a, b in ends]
    worst = max(abs(peer.length / float(length) - 1.0) for peer, length in zip(peers, found.length, strict=True))
    if not worst < 1e-8:
        raise ArithmeticError(f"lengths differ by {worst:g} from those of pyclothoids; times would compare nothing")
    fit_us, peer_us, sample_us, peer_sample_us = microseconds(
        lambda: hermite(start, end),
        lambda: [Peer.G1Hermite(*a, *b) for a, b in ends],
        lambda: sample(found, SAMPLES),
        lambda: [peer.SampleXY(SAMPLES) for peer in peers],
    )
    each = f"{1e3 * peer_sample_us / SAMPLES:.0f} ns / {1e3 * sample_us / SAMPLES:.1f} ns a point"
    return {
        "g1_us_batch": Value(fit_us, f"lengths differ by {worst:.0e} at most"),
        "pyclothoids_us": Value(peer_us),
        "g1_ratio": Value(peer_us / fit_us),
        "sample_ratio": Value(peer_sample_us / sample_us, each),
    }


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.clothoid", description="Clothoids against pyclothoids.")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    options = parser.parse_args(words)
    single_thread()
    values = measure()
    if options.json:
        print(as_json(FIGURES, values, machine()))
    else:
        print_table("Clothoids against pyclothoids", FIGURES, values, machine())
    return 0


if __name__ == "__main__":
    sys.exit(main())
