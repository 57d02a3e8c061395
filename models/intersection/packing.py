"""A state of the intersection as one row of numbers, for machine code.

    z = (num_arms, centre x, centre y, then for every slot
         angle, gap, entries, exits, width, bend, shift)

Slots 0 .. num_arms - 1 are active. The order of the slots means nothing: the prior is exchangeable
over labelled slots, so no factorial appears; reports order arms by angle. The centre is relative to
the origin of the evidence."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_ARMS = 7
MIN_ARMS = 2
FIELDS = ("angle", "gap", "entries", "exits", "width", "bend", "shift")
ANGLE, GAP, ENTRIES, EXITS, WIDTH, BEND, SHIFT = range(7)
ARM = len(FIELDS)
HEAD = 3
SIZE = HEAD + MAX_ARMS * ARM
WHOLE = ("entries", "exits")


def pack(latents: dict[str, Any], constants: dict[str, float], origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """{site: (B, *event)} to (B, SIZE); sites the program does not have come from `constants`; angles are
    brought to [-pi, pi)."""
    num = np.asarray(latents["num_arms"], dtype=np.float64).reshape(-1)
    z = np.empty((len(num), SIZE))
    z[:, 0] = num
    z[:, 1:HEAD] = np.asarray(latents["centre"]) - origin
    slots = z[:, HEAD:].reshape(len(num), MAX_ARMS, ARM)
    for j, name in enumerate(FIELDS):
        slots[:, :, j] = np.asarray(latents[name]) if name in latents else constants[name]
    turned = np.abs(slots[:, :, ANGLE]) > np.pi
    slots[turned, ANGLE] = np.remainder(slots[turned, ANGLE] + np.pi, 2 * np.pi) - np.pi
    return z


def unpack(z: NDArray[np.float64], constants: dict[str, float], origin: NDArray[np.float64]) -> dict[str, Any]:
    """(*batch, SIZE) to {site: (*batch, *event)}, the inverse of `pack`."""
    slots = z[..., HEAD:].reshape((*z.shape[:-1], MAX_ARMS, ARM))
    latents: dict[str, Any] = {"centre": z[..., 1:HEAD] + origin, "num_arms": np.rint(z[..., 0]).astype(np.int64)}
    for j, name in enumerate(FIELDS):
        if name not in constants:
            values = slots[..., j]
            latents[name] = np.rint(values).astype(np.int64) if name in WHOLE else np.ascontiguousarray(values)
    return latents
