"""The lead vehicle: the nearest road user that is likely on the own path, now or soon.

A hypothesis is on the path where its side reaches into it and it drives along it, stands, or comes towards us; who only
crosses it does not lead. One that reaches the path in t is told as if it drove there already: s(t) - v t.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from planning.frenet import FrenetState
from planning.planner import Planner
from planning.release import extent
from planning.situation import Along, Predictions

SOON = 2.5  # looked ahead [s]
LIKELY, KEPT = 0.3, 0.15  # chance of a lead, and of the one there was [-]
ALIGNED = 0.5  # |cos| of the direction against the route's, for along it
STANDING = 0.5  # slower stands, whichever way it looks [m/s]
STEADY = 0.2  # accelerations below it are none: tracks are noisy [m/s^2]
SPARE = 1.0  # between the front and the lead's rear, both standing in the end [m]


class Lead(NamedTuple):
    """label of the track; rear on the route [m], speed and acceleration along it, std of its place after the
    horizon [m, m/s, m/s^2]."""

    label: int
    rear: float
    speed: float
    acceleration: float
    std: float

    def stands(self, planner: Planner) -> float:
        """s before which one can stand behind it, should it brake all it can after the horizon as it was predicted."""
        t = planner.horizon
        slower = min(self.acceleration, 0.0)
        if slower * t <= -self.speed:
            return self.rear + self.speed**2 / (-2 * slower if slower < 0 else np.inf) - SPARE
        speed = self.speed + slower * t
        return self.rear + (self.speed + speed) / 2 * t + speed**2 / (2 * planner.able.braking) - SPARE - self.std


def lead_of(
    planner: Planner,
    state: FrenetState,
    predictions: Predictions,
    places: Along,
    offset: float,
    before: int = -1,
    waits_for: int = -1,
    skip: Collection[int] = (),
) -> Lead | None:
    """On the path at `offset`; `before` is the label of the last lead, waits_for one that leads in any case, skip those
    that do not."""
    if not len(predictions.track):
        return None
    soon = predictions.times <= SOON
    times = predictions.times[soon]
    s, d, cos, speed = places.s[:, soon], places.d[:, soon], places.ahead[:, soon], predictions.speed[:, soon]
    half = extent(predictions, places)
    labels = predictions.tracks.label[predictions.track]
    meets = places.on[:, soon] & (np.abs(d - offset) < half.across[:, soon] + planner.radius)
    meets |= (labels == waits_for)[:, None] & places.on[:, soon]
    meets &= (np.abs(cos) > ALIGNED) | (speed < STANDING)
    meets &= s > state.s + planner.vehicle.middle
    on = meets.any(1) & ~np.isin(labels, list(skip))
    chance = np.bincount(predictions.track[on], predictions.probability[on], minlength=len(predictions.tracks.label))
    best: Lead | None = None
    for m in np.flatnonzero(on):
        label, k = int(labels[m]), int(meets[m].argmax())
        if chance[predictions.track[m]] < (KEPT if label == before else LIKELY) and label != waits_for:
            continue
        pace = float(speed[m, k] * cos[m, k])
        if s[m, k] - pace * times[k] < state.s + planner.vehicle.middle:
            continue  # it comes from behind
        if pace < 0:  # towards us: it is met half-way
            k, pace = len(times) - 1, 0.0
        rear = float(s[m, k] - half.along[m, k] - pace * times[k])
        if best is None or rear < best.rear:
            told = float(predictions.tracks.acceleration[predictions.track[m]])
            late = int(np.searchsorted(predictions.times, planner.horizon))
            std = float(predictions.std[m, min(late, len(predictions.times) - 1)])
            best = Lead(label, rear, pace, told if abs(told) > STEADY and pace > STANDING else 0.0, std)
    return best
