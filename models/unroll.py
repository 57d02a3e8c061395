"""A sequential model over a window of frames as one program, so that it is written once.

    p(z_0, ..., z_T, y_0, ..., y_T) = p(z_0) p(y_0 | z_0) prod_t p(z_t | z_(t-1)) p(y_t | z_t)

A site `level` of the model becomes the sites `level_0`, `level_1`, ... of the program: any engine runs on it, and what
a filter says is held against it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pyro.poutine.messenger import Messenger

from models.capability import HasSteps
from models.program import InputError, Latents, observe

Frame = TypeVar("Frame", bound=Any)


class _InFrame(Messenger):
    """Add the number of the frame to the names of sites."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number

    def _pyro_sample(self, msg: Any) -> None:
        msg["name"] = f"{msg['name']}_{self.number}"


@dataclass(frozen=True)
class Unrolled:
    """The window program of a sequential model; its evidence is the sequence of frames."""

    model: HasSteps

    def __call__(self, frames: Sequence[Any]) -> None:
        if len(frames) == 0:
            raise InputError("a sequential model needs at least one frame, but got none; wait for the first")
        with _InFrame(0):
            state = self.model.initial(frames[0])
            self.model.observe(state, frames[0])
        for number, frame in enumerate(frames[1:], start=1):
            with _InFrame(number):
                state = self.model.transition(state, frame)
                self.model.observe(state, frame)


def unroll(model: HasSteps) -> Unrolled:
    """The window program. Running it raises InputError for no frames."""
    return Unrolled(model)


def observe_frames(frames: Sequence[Frame], draws: Latents) -> tuple[tuple[Frame, ...], Latents]:
    """Move simulated observations of the window program into the fields of frames that are None; the rest of the draws
    are latents."""
    filled, latents = list[Frame](), dict(draws)
    for number, frame in enumerate(frames):
        own = {name: draws[f"{name}_{number}"] for name in frame._fields if f"{name}_{number}" in draws}
        filled.append(observe(frame, own)[0])
        for name in own:
            if getattr(frame, name) is None:
                del latents[f"{name}_{number}"]
    return tuple(filled), latents


def stack_frames(values: Mapping[str, Any], batch_dims: int) -> dict[str, NDArray[Any]]:
    """{site_0, site_1, ...: (*batch, *event)} to {site: (*batch, frame, *event)}; other names are left out."""
    numbered: dict[str, dict[int, NDArray[Any]]] = {}
    for name, value in values.items():
        if found := re.fullmatch(r"(.+)_(\d+)", name):
            numbered.setdefault(found[1], {})[int(found[2])] = np.asarray(value)
    return {site: np.stack([by[t] for t in sorted(by)], batch_dims) for site, by in numbered.items()}
