"""Who drives by the rules: situation analysis, decisions and behaviour in turn, with what they remember."""

from __future__ import annotations

from dataclasses import replace

from experiments.closed_loop import Mind, Thought
from experiments.scenarios.driving import DriveScene
from planning.behaviour import Manners, Memory, behave
from planning.decision import Decided, Rules, decide
from planning.frenet import FrenetState
from planning.planner import Planner
from planning.road import Route, Tracks
from planning.situation import Situation, along, network, predict


def by_the_rules(
    scene: DriveScene,
    route: Route,
    planner: Planner,
    *,
    situation: Situation = Situation(),
    rules: Rules = Rules(),
    manners: Manners = Manners(),
) -> Mind:
    """A mind for one drive (experiments.closed_loop.drive); boundary lines of the scene are seen from the beginning.

    Its words begin with the goal: keep a speed, follow who is ahead, stop before a line, merge into a gap. Then whom it
    passes, by the place among the scene's actors, and why each stop point may be passed or not."""
    roads = network(scene.lanes)
    times = [planner.step * (k + 1) for k in range(planner.num_steps)]
    decided, behaved = Decided(), Memory()
    most = min(planner.comfort.speed, scene.wanted + manners.spare)
    calm = replace(planner, comfort=replace(planner.comfort, speed=most))

    def think(now: float, state: FrenetState, tracks: Tracks) -> Thought:
        nonlocal decided, behaved
        predictions = predict(roads, tracks, times, situation)
        places = along(route, predictions)
        lights = scene.lights_at(now)
        permissions = decide(
            route, state, planner.vehicle, predictions, scene.stops, lights, decided, rules, places=places
        )
        given, behaved = behave(
            calm,
            route,
            state,
            predictions,
            scene.stops,
            permissions,
            behaved,
            manners,
            places=places,
            lines=scene.boundary,
        )
        decided = permissions.memory
        passing = [f"passing road user {behaved.passing.blocker}"] if behaved.passing.going else []
        why = [f"{name}: {reason}" for name, reason in permissions.reasons.items()]
        return Thought(given, "; ".join([behaved.goal, *passing, *why]))

    return think
