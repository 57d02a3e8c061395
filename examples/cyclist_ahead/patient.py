"""A driver who only follows: whoever is ahead in the lane is followed and never passed.

A driver is `(scene, route, planner) -> mind`, and a mind `(time, state, tracks) -> Thought`: what the planner plans in,
and what was thought. It is asked in every cycle; what it remembers it keeps itself."""

from __future__ import annotations

import numpy as np

from experiments.closed_loop import Mind, Thought
from experiments.scenarios.driving import DriveScene
from planning.candidates import Goal, Keep, follow
from planning.frenet import FrenetState
from planning.planner import Planner
from planning.road import Route, Tracks
from planning.scene import Scene
from planning.shapes import Obstacles, boundary


def patient(
    scene: DriveScene, route: Route, planner: Planner, *, gap: float = 8.0, headway: float = 1.5, spread: float = 0.3
) -> Mind:
    """gap, headway  to whoever is ahead [m, s]; spread of what is predicted, after a second [m]"""
    lines = boundary(scene.boundary, planner.radius)
    times = planner.step * np.arange(1, planner.num_steps + 1)

    def think(now: float, state: FrenetState, tracks: Tracks) -> Thought:
        goal: Goal = Keep(float(route.limit_at(state.s)))
        words = "nobody is ahead"
        places, _ = route.line.project(tracks.position)
        ahead = np.flatnonzero((places[:, 0] > state.s) & (np.abs(places[:, 1]) < 1.75))
        if len(ahead):
            lead = ahead[places[ahead, 0].argmin()]
            rear = places[lead, 0] - tracks.size[lead, 0] / 2
            speed, acceleration = tracks.speed[lead], tracks.acceleration[lead]
            goal = follow(rear, speed, acceleration, planner.vehicle.front, gap=gap, headway=headway)
            words = f"behind the {tracks.kind[lead]} {rear - state.s - planner.vehicle.front:.1f} m ahead"
        seen = steady(tracks, times, spread)
        return Thought(Scene(route.line, state, goal, np.array([0.0]), 0.0, lines, seen), words)

    return think


def steady(tracks: Tracks, times: np.ndarray, spread: float) -> Obstacles:
    """Everybody keeps heading and speed, less and less surely."""
    way = tracks.speed[:, None] * times
    heading = np.broadcast_to(tracks.heading[:, None], way.shape)
    x = tracks.position[:, :1] + way * np.cos(heading)
    y = tracks.position[:, 1:] + way * np.sin(heading)
    grown = (spread * times[:, None, None]) ** 2 * np.eye(2)
    return Obstacles(np.stack([x, y, heading], -1), tracks.size, tracks.covariance[:, None] + grown, tracks.existence)
