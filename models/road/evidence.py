"""Cues as the numbers that the road course is computed from, checked once."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.program import InputError
from models.road.cues import CueKind, Cues

Floats = NDArray[np.float64]


class RoadEvidence(NamedTuple):
    """N cues in G groups that share an offset: static ones by kind and side, vehicles each on its own.

    cues         (N, 3) x, y [m] and direction of motion [rad], 0 where there is none; None simulates
    group        (N,)
    offset_loc   (G,) prior mean of the offset [m]
    offset_std   (G,) its standard deviation [m]
    covariance   (N, 2, 2) of the measured position [m^2]
    spread       (N,) of single cues about the offset, std / sqrt(confidence) [m]
    flow_spread  (N,) the same of the direction of motion [rad], inf where none was measured
    flow_std     (N,) of the measurement of that direction [rad]
    turn         (N,) pi for oncoming traffic, 0 for all others
    moves        (N,) whether it is a vehicle
    names        (G,) of the groups
    flags        what makes this evidence poor, one sentence each
    arc          (N,) where along the course cues are simulated [m]; only the simulator reads it
    """

    cues: Tensor | None
    group: NDArray[np.int64]
    offset_loc: Floats
    offset_std: Floats
    covariance: Floats
    spread: Floats
    flow_spread: Floats
    flow_std: Floats
    turn: Floats
    moves: NDArray[np.bool_]
    names: tuple[str, ...]
    flags: tuple[str, ...]
    arc: Floats | None = None


COURSE_LABELS = tuple(f"{end} {what}" for end in ("start", "end") for what in ("x [m]", "y [m]", "heading [rad]"))
ROAD_LABELS = ("start y [m]", "start heading [rad]", "start curvature [1/m]", "curvature rate [1/m²]")


def offset_labels(evidence: RoadEvidence) -> tuple[str, ...]:
    """What the offsets (G,) are, for reports."""
    return tuple(f"offset of {name} [m]" for name in evidence.names)


def road_evidence(cues: Cues, kinds: Sequence[CueKind]) -> RoadEvidence:
    """The evidence of cues whose kinds are known by name.

    Raises InputError for no cues, for numbers that are not finite, for covariances that are not positive definite, for
    an unknown kind and for the same cue twice."""
    known = {kind.name: kind for kind in kinds}
    check_cues(cues, known)
    kind = [known[str(name)] for name in cues.kind]
    moves = np.array([k.moves for k in kind])
    keys = [
        (k.name, "oncoming" if left else "ahead", int(track)) if k.moves else (k.name, "left" if left else "right", -1)
        for k, left, track in zip(kind, cues.left, cues.track, strict=True)
    ]
    order = sorted(set(keys), key=lambda key: (key[2] >= 0, key))
    priors = [known[name].left if side in ("left", "oncoming") else known[name].right for name, side, _ in order]
    measured = moves & ~np.isnan(cues.flow)
    root = np.sqrt(cues.confidence)
    flow_std = np.array([k.flow_std or math.inf for k in kind])
    return RoadEvidence(
        cues=torch.from_numpy(np.column_stack([cues.position, np.where(measured, cues.flow, 0.0)])),
        group=np.array([order.index(key) for key in keys]),
        offset_loc=np.array([loc for loc, _ in priors]),
        offset_std=np.array([std for _, std in priors]),
        covariance=np.ascontiguousarray(cues.covariance),
        spread=np.array([k.std for k in kind]) / root,
        flow_spread=np.where(measured, flow_std / root, math.inf),
        flow_std=np.where(measured, cues.flow_std, 0.0),
        turn=np.where(moves & cues.left, math.pi, 0.0),
        moves=moves,
        names=tuple(f"{name} {track}" if track >= 0 else f"{name} {side}" for name, side, track in order),
        flags=flags(cues, moves),
    )


def check_cues(cues: Cues, known: dict[str, CueKind]) -> None:
    """Raise InputError for the first cue that no course can be computed from."""
    if len(cues.kind) == 0:
        raise InputError("there are no cues; a road course needs at least one, so wait for a detection")
    for name in np.unique(cues.kind):
        if str(name) not in known:
            close = difflib.get_close_matches(str(name), known, n=1)
            hint = f"did you mean '{close[0]}'" if close else f"there are {', '.join(known)}"
            raise InputError(f"no kind of cue is called '{name}'; {hint}, or add a CueKind to extra_kinds")
    for what, bad, remedy in (
        ("position", ~np.isfinite(cues.position).all(-1), "drop the cue or give metres"),
        ("covariance", ~positive_definite(cues.covariance), "give a symmetric positive definite matrix"),
        ("flow", np.isinf(cues.flow), "give radians, or nan where none was measured"),
        ("flow_std", ~(np.isnan(cues.flow) | ((cues.flow_std > 0) & np.isfinite(cues.flow_std))), "make it positive"),
        ("confidence", ~((cues.confidence > 0) & (cues.confidence <= 1)), "give a number in (0, 1]"),
    ):
        if bad.any():
            i = int(np.flatnonzero(bad)[0])
            value = np.asarray(getattr(cues, what))[i].tolist()
            raise InputError(f"cue {i} ({cues.kind[i]}) has the {what} {value}; {remedy}")
    seen: dict[tuple[object, ...], int] = {}
    for i in range(len(cues.kind)):
        name, track = str(cues.kind[i]), int(cues.track[i])
        place = tuple(cues.position[i].tolist()) if known[name].moves else None
        first = seen.setdefault((name, track, place), i)
        if first != i:
            again = "at the same place" if place else "though it stands still"
            raise InputError(
                f"cues {first} and {i} are both {name} {track} {again}; "
                f"{'drop one' if place else 'join them with models.road.ego.fuse, or drop one'}"
            )


def positive_definite(covariance: Floats) -> NDArray[np.bool_]:
    """Which of (N, 2, 2) matrices are covariances."""
    (a, b), (c, d) = covariance[:, 0].T, covariance[:, 1].T
    with np.errstate(invalid="ignore"):
        return np.isfinite(covariance).all((1, 2)) & (np.abs(b - c) <= 1e-9 * (a + d)) & (a > 0) & (a * d - b * c > 0)


def flags(cues: Cues, moves: NDArray[np.bool_]) -> tuple[str, ...]:
    """Why the posterior of such cues is wide, in words."""
    found, num = [], len(cues.kind)
    if num == 1:
        found.append("there is only one cue: the course is little more than its prior")
    elif not moves.any() and (cues.left.all() or not cues.left.any()):
        side = "left" if cues.left[0] else "right"
        found.append(f"all cues are on the {side}: where the road is across itself rests on the prior of their offset")
    behind = int((cues.position[:, 0] < 0).sum())
    if behind == num:
        found.append("all cues are behind the car: the road ahead is its prior")
    elif 2 * behind > num:
        found.append(f"{behind} of {num} cues are behind the car: they say little about the road ahead")
    return tuple(found)
