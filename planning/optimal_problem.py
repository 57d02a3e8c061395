"""The optimal-control problem of a plan, as a nonlinear programme built once and solved with parameters.

N stages of a few of the planner's steps each; state x = (s, s', s'', d, d', d''), control u = (s''', d'''), constant
over a stage:

    min  k_lon [k_j sum_k pi_k h u_s^2 + V_s(x_N)] + k_lat [k_j sum_k pi'_k h u_d^2 + V_d(x_N)]
    s.t. x_{k+1} = F(x_k, u_k), and at each step of the planner within the stages:
         MARGINS of the limits, curvature rate, OUTLINE of obstacles, circles between lines, s <= its largest

Costs are those of planning.candidates for a motion that arrives at the time T that the candidate arrives at: the price
pi of jerk is 1 before T and DEAR after it, so that a motion at rest after T costs what the candidate's polynomial does.
V is the least cost of what lies beyond the horizon: the jerk-optimal polynomial from x_N to the end that costs least.

Formulas are those of planning.kinematics, planning.shapes and planning.polynomials, traced with the problem's symbols.
The line is told to each stage by polynomials in z = (s - centre) / width.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

from planning.candidates import Weights
from planning.kinematics import GUARDED, LIMITS, MARGINS, PLACED, path
from planning.polynomials import QUARTIC, QUINTIC, SQUARED_JERK
from planning.shapes import OUTLINE

CURVATURE, PLACE = 6, 7  # coefficients of the line's curvature, and of its x and y, in z
KEPT, SETTLED = 0.005, 0.5  # a share of each limit is kept free, from that time on [s]: the line is told with errors
STEADY = 0.02  # of the curvature's rate, kept free: it varies within a stage
SLOWEST, AT_REST = 0.5, 0.2  # [m/s] s' at least, for directions are undefined at rest; beside v in the curvature
TOLERANCE = 1e-4  # of optimality
MOST = {"fatrop": 60, "ipopt": 40}  # iterations
ACROSS, TO_SPEED, TO_PLACE = "across", "to a speed", "to a place"


class Shape(NamedTuple):
    """What a problem is built for.

    num_stages, per_stage, step  per_stage steps [s] in each stage
    circles                      of the vehicle, ahead of the rear axle [m]; radius [m]
    kind                         TO_SPEED or TO_PLACE, of the goal
    num_obstacles, walled        whether there are boundary lines
    fine                         constraints within the stages too, and the curvature's rate
    """

    num_stages: int
    per_stage: int
    step: float
    circles: tuple[float, ...]
    weights: Weights
    kind: str
    num_obstacles: int
    walled: bool
    fine: bool

    @property
    def stage(self) -> float:
        """[s]"""
        return self.per_stage * self.step


SOLVERS = ("fatrop", "ipopt")  # the second where the first fails


class Problem(NamedTuple):
    """programme {x, p, f, g}: decision variables (x_0, u_0, x_1, ..., x_N), parameters, cost and constraints, which are
    equalities or not and lie between lower and upper; parameters {name: (rows, columns)} in their order."""

    programme: dict[str, Any]
    parameters: dict[str, tuple[int, int]]
    equality: list[bool]
    lower: list[float]
    upper: list[float]


def advance(x: Any, u: Any, h: float) -> list[Any]:
    """F: the state after h under constant jerk, entries of anything that can be added and multiplied."""
    moved = list[Any]()
    for i, jerk in enumerate(u):
        q, v, a = x[3 * i : 3 * i + 3]
        moved += [q + h * (v + h * (a / 2 + h * jerk / 6)), v + h * (a + h * jerk / 2), a + h * jerk]
    return moved


@lru_cache
def closing(kind: str, weights: Weights) -> Any:
    """The casadi.Function (q, q', q''; wanted, pace, T, price) -> (V, e): the least cost of going on for T to an end,
    and that end.

        V = min_e k_j price int(jerk^2) + k (e - wanted)^2

    over end offsets e (ACROSS), end speeds e (TO_SPEED), or end places e at the speed `pace` (TO_PLACE). A quadratic
    in e, so that its derivative's root is the minimum."""
    import casadi as ca

    x, given, e = ca.SX.sym("x", 3), ca.SX.sym("given", 4), ca.SX.sym("e")
    wanted, pace, time, price = ca.vertsplit(given)
    if kind == TO_SPEED:
        c = QUARTIC.casadi()(ca.vertcat(x, e, 0, time), [])
    else:
        c = QUINTIC.casadi()(ca.vertcat(x, e, pace if kind == TO_PLACE else 0, 0, time), [])
    weight = weights.across if kind == ACROSS else weights.along
    cost = weights.jerk * price * SQUARED_JERK.casadi()(ca.vertcat(c, time), []) + weight * (e - wanted) ** 2
    slope = ca.gradient(cost, e)
    best = -ca.substitute(slope, e, 0) / ca.gradient(slope, e)
    return ca.Function("closing", [x, given], [ca.substitute(cost, e, best), best])


@lru_cache
def problem(shape: Shape) -> Problem:
    """The programme of a shape."""
    import casadi as ca

    parameters = {
        "start": (6, 1),
        "bent": (1, 1),  # curvature of the path at the start
        "limits": (len(LIMITS), 1),
        "rate": (1, 1),
        "last": (3, 1),  # largest s; where standing must be possible beyond the horizon, by which braking
        "ends": (8, 1),  # of `closing`, along then across
        "price": (2, shape.num_stages),
        "line": (2 + CURVATURE + 2 * PLACE, shape.num_stages),  # centre, width, coefficients of rising powers
        "walls": (2 * len(shape.circles) * shape.walled, shape.num_stages),  # least, largest offset of each circle
        "outlines": (OUTLINE.num_p * shape.num_obstacles, shape.num_stages * shape.per_stage),
    }
    p = {name: ca.SX.sym(name, *size) for name, size in parameters.items()}
    states = [ca.SX.sym(f"x{k}", 6) for k in range(shape.num_stages + 1)]
    controls = [ca.SX.sym(f"u{k}", 2) for k in range(shape.num_stages)]
    weights, cost = shape.weights, ca.SX(0)
    constraints, equal = list[Any](), list[bool]()

    def add(value: Any, equality: bool) -> None:
        constraints.append(value)
        equal.extend([equality] * value.shape[0])

    for k, control in enumerate(controls):
        x, u = ca.vertsplit(states[k]), ca.vertsplit(control)
        add(states[k + 1] - ca.vertcat(*advance(x, u, shape.stage)), True)
        if k == 0:
            add(states[0] - p["start"], True)
        else:
            add(ca.vertcat(*_kept(shape, p, k, x)), False)
        if shape.fine:
            add(ca.vertcat(*_kept_within(shape, p, k, x, u)), False)
        cost += weights.longitudinal * weights.jerk * p["price"][0, k] * shape.stage * u[0] ** 2
        cost += weights.lateral * weights.jerk * p["price"][1, k] * shape.stage * u[1] ** 2
    add(ca.vertcat(*_kept(shape, p, shape.num_stages, ca.vertsplit(states[-1]))), False)
    final = states[-1]
    add(p["last"][1] - final[0] - final[1] ** 2 / (2 * p["last"][2]), False)
    cost += weights.longitudinal * closing(shape.kind, weights)(final[:3], p["ends"][:4])[0]
    cost += weights.lateral * closing(ACROSS, weights)(final[3:], p["ends"][4:])[0]

    w = ca.vertcat(*(part for pair in zip(states, controls, strict=False) for part in pair), final)
    g, vector = ca.vertcat(*constraints), ca.vertcat(*(ca.vec(p[name]) for name in parameters))
    upper = [0.0 if same else ca.inf for same in equal]
    programme = {"x": w, "p": vector, "f": cost, "g": g}
    return Problem(programme, parameters, equal, [0.0] * len(equal), upper)


@lru_cache
def solver(shape: Shape, name: str) -> Any:
    """The casadi.Function that solves it: "fatrop" or "ipopt". It takes about a second, once."""
    import casadi as ca

    built = problem(shape)
    own: dict[str, Any] = {"print_level": 0, "mu_init": 1e-2, "max_iter": MOST[name], "tol": TOLERANCE}
    options: dict[str, Any] = {"print_time": False, "error_on_fail": False}
    if name == "fatrop":
        options |= {"structure_detection": "auto", "equality": built.equality}
    else:
        own |= {"sb": "yes"}
    return ca.nlpsol(name, name, built.programme, options | {name: own})


def _kept(shape: Shape, p: dict[str, Any], k: int, x: list[Any]) -> list[Any]:
    """What must not be negative at the end of stage k - 1, which is the start of stage k."""
    line = _line(p["line"][:, k - 1], x[0])
    share = 1.0 - KEPT * min(k * shape.stage / SETTLED, 1.0)
    margins = _margins(p, x, line, share)[: len(GUARDED)]
    clear = _clear(shape, p, k - 1, shape.per_stage * k - 1, x, line)
    return [*margins, x[1] - SLOWEST, 1 - line.z, 1 + line.z, p["last"][0] - x[0], *clear]


def _kept_within(shape: Shape, p: dict[str, Any], k: int, x: list[Any], u: list[Any]) -> list[Any]:
    """What must not be negative between: the obstacles' outlines, and how far the curvature changes within stage k."""
    told = list[Any]()
    for i in range(shape.per_stage - 1):
        y = advance(x, u, (i + 1) * shape.step)
        told += _clear(shape, p, k, shape.per_stage * k + i, y, _line(p["line"][:, k], y[0]))
    y = advance(x, u, shape.stage)
    before = _curvature(x, _line(p["line"][:, k], x[0])) if k else p["bent"]
    turned = (_curvature(y, _line(p["line"][:, k], y[0])) - before) / shape.stage
    allowed = (1.0 - STEADY) * p["rate"]
    return [*told, allowed - turned, allowed + turned]


class _Line(NamedTuple):
    z: Any
    kappa: Any
    slope: Any
    x: Any
    y: Any
    cos: Any
    sin: Any


def _line(told: Any, s: Any) -> _Line:
    """At s, by a stage's polynomials; its direction is that of the derivative of its place."""
    import casadi as ca

    centre, width, *c = ca.vertsplit(told)
    z = (s - centre) / width
    (kappa, slope), (x, cos), (y, sin) = (_horner(part, z) for part in (c[:CURVATURE], c[CURVATURE:-PLACE], c[-PLACE:]))
    return _Line(z, kappa, slope / width, x, y, cos / width, sin / width)


def _horner(coefficients: list[Any], z: Any) -> tuple[Any, Any]:
    """A polynomial and its derivative."""
    value, slope = 0, 0
    for c in reversed(coefficients):
        value, slope = value * z + c, slope * z + value
    return value, slope


def _margins(p: dict[str, Any], y: list[Any], line: _Line, share: float) -> list[Any]:
    """MARGINS of a state, with a share of the limits."""
    import casadi as ca

    x = ca.vertcat(y[1], y[2], line.kappa, line.slope, *y[3:])
    return list(ca.vertsplit(MARGINS.casadi()(x, share * p["limits"])))


def _curvature(y: list[Any], line: _Line) -> Any:
    """Of the path; too small near rest, where it would be infinite (and where solvers do not come back from)."""
    import casadi as ca

    v, _, cross, _ = path([y[1], y[2], line.kappa, line.slope, *y[3:]], ca)
    return cross / (v**3 + AT_REST**3)


def _clear(shape: Shape, p: dict[str, Any], k: int, at: int, y: list[Any], line: _Line) -> list[Any]:
    """OUTLINE of each obstacle and circle; how far each circle is from the lines left and right."""
    import casadi as ca

    if not (shape.walled or shape.num_obstacles):
        return []
    placed = PLACED.casadi()(ca.vertcat(y[1], line.kappa, y[3], y[4], *line[3:]), [])
    px, py, cos, sin = ca.vertsplit(placed)
    told = list[Any]()
    for n, ahead in enumerate(shape.circles):
        centre = ca.vertcat(px + ahead * cos, py + ahead * sin)
        for m in range(shape.num_obstacles):
            row = p["outlines"][m * OUTLINE.num_p : (m + 1) * OUTLINE.num_p, at]
            told.append(OUTLINE.casadi()(centre, row))
        if shape.walled:
            along, left = (cos * line.cos + sin * line.sin, sin * line.cos - cos * line.sin)
            offset = y[3] + ahead * left - line.kappa * (ahead * along) ** 2 / 2  # errs by kappa' ahead^3 / 6
            told += [offset - p["walls"][2 * n, k], p["walls"][2 * n + 1, k] - offset]
    return told
