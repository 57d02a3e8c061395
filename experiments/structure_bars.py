"""The structures that several engines find probable at one junction, beside one another."""

from __future__ import annotations

from collections import Counter

import numpy as np
from matplotlib.figure import Figure

from experiments.junction_figures import INK
from experiments.junction_metrics import driven_arms
from experiments.scenarios.paths import wrap
from experiments.scenarios.scene import JunctionTruth, Scene
from inference.posterior import Posterior

Structure = tuple[tuple[int, int], ...]  # (entries, exits) of each arm, counter-clockwise
COLOURS = ("#2a6fbb", "#d9722e", "#3b8a5a", "#7b3f9e", "#8a5a2b", "#444c55")
MOST = 6  # structures that are shown ...
SHOWN = 0.005  # ... of at least this probability


def figures(posteriors: dict[str, Posterior], scene: Scene) -> dict[str, Figure]:
    """A bar for each engine at the structures with the largest probabilities of all; the true one is named.

    Nothing without a junction."""
    shares = {engine: shares_of(one) for engine, one in posteriors.items() if "entries" in one.draws}
    if not shares:
        return {}
    most = Counter[Structure]()
    for share in shares.values():
        most |= share
    shown = [structure for structure, share in most.most_common(MOST) if share >= SHOWN]
    truth = scene.truth if isinstance(scene.truth, JunctionTruth) else None
    true = None if truth is None else true_structure(truth)
    height = 0.8 / len(shares)
    figure = Figure(figsize=(9.0, 1.4 + 0.8 * height * len(shares) * len(shown)), layout="constrained")
    axes = figure.subplots()
    for number, (engine, share) in enumerate(shares.items()):
        place = np.arange(len(shown)) + (number - 0.5 * (len(shares) - 1)) * height
        values = [share[structure] for structure in shown]
        bars = axes.barh(place, values, 0.9 * height, color=COLOURS[number % len(COLOURS)], label=engine)
        axes.bar_label(bars, [f"{v:.2f}" if v >= SHOWN else "" for v in values], fontsize=8, padding=2, color=INK)
    axes.set_yticks(range(len(shown)), [named(s) + (" (true)" if s == true else "") for s in shown])
    axes.invert_yaxis()
    axes.set(xlim=(0, 1.12), xlabel="posterior probability", xticks=[0, 0.5, 1])
    axes.set_title(f"{scene.name}: entries + exits of each arm, counter-clockwise", loc="left", color=INK, fontsize=11)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9)
    return {"structures": figure}


def shares_of(posterior: Posterior) -> Counter[Structure]:
    """Posterior probability of each structure among the draws."""
    draws = {n: posterior.draws[n] for n in ("num_arms", "angle", "entries", "exits")}
    flat = {n: v.reshape((-1, *v.shape[2:])) for n, v in draws.items()}
    out = Counter[Structure]()
    for i, weight in enumerate(posterior.weights.reshape(-1)):
        arms = int(flat["num_arms"][i])
        out[structure_of(*(flat[n][i, :arms] for n in ("angle", "entries", "exits")))] += float(weight)  # type: ignore[assignment]
    return out


def structure_of(angle: np.ndarray, entries: np.ndarray, exits: np.ndarray) -> Structure:
    """Lane counts of the arms in their order round the centre, whichever comes first."""
    order = np.argsort(wrap(angle))
    arms = [(int(entries[i]), int(exits[i])) for i in order]
    return max((tuple(arms[k:] + arms[:k]) for k in range(len(arms))), default=())


def true_structure(truth: JunctionTruth) -> Structure:
    """That of the arms that vehicles used."""
    driven = driven_arms(truth)
    return structure_of(truth.angle[driven], truth.entries[driven], truth.exits[driven])


def named(structure: Structure) -> str:
    """'3 arms: 2+1 1+1 1+2'."""
    return f"{len(structure)} arms: {' '.join(f'{a}+{b}' for a, b in structure)}"
