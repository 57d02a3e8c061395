"""Steps over intersections, in machine code: Algorithm 1 of [M20] and our additions.

`propose` is the involution (z, u) -> (z', u') of every move; the batched path and the compiled chain
both call it. log_q = (log q(z -> z'), log q(z' -> z), log Jacobian) in natural units [rad, m].

[M20]: rotate an arm by U[-6, 6] deg, shift the centre by U[0, 6] m in a uniform direction, change a gap
by U[-1.8, 1.8] m, add or remove an arm, add or remove a lane. A new arm is uniform on the free angles and
takes its other numbers from the prior. Slots are labelled: a new arm's slot is uniform, so both
directions of an arm move carry 1 / K, and the set factor of the paper's notation is gone.

Ours: with small steps, a step is shortened by exp(-3.5 U[0, 1]) in seven cases of ten (the scale is kept by
the reverse step). Toggles give or take an inner lane and move gap and axis so that all other lanes stay
(volume preserving). A pivot shifts the centre and turns the arms about their points. Width scales by
exp(U[-0.15, 0.15]), with Jacobian w'/w, bare or with the gap moved so that the middle of the lanes stays.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from models.intersection.angles import MIN_SEPARATION
from models.intersection.packing import ANGLE, ARM, BEND, ENTRIES, EXITS, GAP, HEAD, MAX_ARMS, MIN_ARMS, SHIFT, WIDTH
from models.intersection.prior import (
    BEND_STD,
    GAP_MAX,
    LOG_WIDTH,
    MAX_LANES,
    MIN_LANES,
    NUM_PRIOR,
    SHIFT_STD,
    WIDTH_SPREAD,
    apart,
    lanes_fit,
    log_slot,
)
from models.intersection.wrap import wrap
from models.overwrite import overwrite

ROTATE, CENTRE, CHANGE_GAP, ARMS, LANES, TOGGLE, SCALE_WIDTH, CHANGE_BEND, CHANGE_SHIFT, PIVOT = range(10)
NAMES = ("rotate", "centre", "gap", "arms", "lanes", "toggle", "width", "bend", "shift", "pivot")
NUM_UNIFORMS = 10
SMALL_STEPS = NUM_PRIOR  # position in the kernel's floats: 1 mixes in small steps
NUM_SETTINGS = NUM_PRIOR + 1

MAX_CENTRE = 6.0  # [m]
MAX_LOG_WIDTH = 0.15
# fields that walk by themselves, by kind, and their longest steps: 6 degrees, 1.8 m, 0.004 / m, 1 m
WALK_FIELD = np.array([ANGLE, 0, GAP, 0, 0, 0, 0, BEND, SHIFT, 0])
WALK_SIZE = np.array([math.radians(6.0), 0.0, 1.8, 0.0, 0.0, 0.0, 0.0, 0.004, 1.0, 0.0])
LEVER = 45.0  # [m] mean distance of the points from the centre: turns a lateral step into a rotation


@nb.njit
def split_choice(u, n):  # type: ignore[no-untyped-def]
    """u = (k + r) / n: the choice k of n and the uniform remainder r."""
    k = min(int(u * n), n - 1)
    return k, u * n - k


@nb.njit
def step_scale(u, settings):  # type: ignore[no-untyped-def]
    """Length of a step relative to [M20]'s."""
    if settings[SMALL_STEPS] == 0.0 or u < 0.3:
        return 1.0
    return math.exp(-3.5 * (u - 0.3) / 0.7)


@nb.njit
def normal_cdf(x):  # type: ignore[no-untyped-def]
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


@nb.njit
def normal_quantile(u):  # type: ignore[no-untyped-def]
    """x with normal_cdf(x) = u, by Halley's iteration from the logistic approximation."""
    if u > 0.5:
        return -normal_quantile_low(1.0 - u)
    return normal_quantile_low(u)


@nb.njit
def normal_quantile_low(u):  # type: ignore[no-untyped-def]
    u = max(u, 1e-300)
    x = math.log(u / (1.0 - u)) / 1.702 if u > 1e-3 else -math.sqrt(-2.0 * math.log(u))
    for _ in range(12):
        e = (normal_cdf(x) - u) * math.sqrt(2.0 * math.pi) * math.exp(0.5 * x * x)
        step = e / (1.0 + 0.5 * x * e)
        x -= step
        if abs(step) < 1e-14 * max(1.0, abs(x)):
            break
    return x


@nb.njit
def insertion_sort(values):  # type: ignore[no-untyped-def]
    """Sort in place; for a handful, and quick to compile."""
    for i in range(1, len(values)):
        value, j = values[i], i - 1
        while j >= 0 and values[j] > value:
            values[j + 1] = values[j]
            j -= 1
        values[j + 1] = value


@nb.njit
def free_angles(z, num, out):  # type: ignore[no-untyped-def]
    """Angles at least MIN_SEPARATION from all `num` active arms: their measure; `out` the sorted arms."""
    for a in range(num):
        out[a] = z[HEAD + a * ARM + ANGLE]
    insertion_sort(out[:num])
    total = 0.0
    for a in range(num):
        following = out[a + 1] if a < num - 1 else out[0] + 2.0 * math.pi
        total += max(0.0, following - out[a] - 2.0 * MIN_SEPARATION)
    return total


@nb.njit
def free_angle(u, total, num, arms):  # type: ignore[no-untyped-def]
    """The free angle below which a share u of the free angles lies."""
    left = u * total
    for a in range(num):
        following = arms[a + 1] if a < num - 1 else arms[0] + 2.0 * math.pi
        room = max(0.0, following - arms[a] - 2.0 * MIN_SEPARATION)
        if left < room or a == num - 1:
            return wrap(arms[a] + MIN_SEPARATION + min(left, room))
        left -= room
    return 0.0


@nb.njit
def free_share(angle, total, num, arms):  # type: ignore[no-untyped-def]
    """The share of the free angles that lies below a free angle: the inverse of `free_angle`."""
    below = 0.0
    for a in range(num):
        following = arms[a + 1] if a < num - 1 else arms[0] + 2.0 * math.pi
        room = max(0.0, following - arms[a] - 2.0 * MIN_SEPARATION)
        beyond = (angle - arms[a]) % (2.0 * math.pi)
        if beyond < following - arms[a]:
            return (below + beyond - MIN_SEPARATION) / total
        below += room
    return 1.0


@nb.njit
def swap_slots(z, a, b):  # type: ignore[no-untyped-def]
    for j in range(ARM):
        i, k = HEAD + a * ARM + j, HEAD + b * ARM + j
        z[i], z[k] = z[k], z[i]


@nb.njit
def redraw_slot(z, a, settings, u, u_new):  # type: ignore[no-untyped-def]
    """Swap a slot's numbers but its angle with fresh ones from the prior; the old ones travel in u_new.

    u[3:] carries gap, entries, exits, width, bend, shift."""
    o = HEAD + a * ARM
    gap_max, low = settings[GAP_MAX], settings[MIN_LANES]
    old_entries, old_exits = z[o + ENTRIES], z[o + EXITS]
    u_new[3] = z[o + GAP] / gap_max
    z[o + GAP] = u[3] * gap_max
    n = int(settings[MAX_LANES] - low) + 1
    k, r = split_choice(u[4], n)
    z[o + ENTRIES] = low + k
    u_new[4] = (old_entries - low + r) / n
    new_low = 1.0 if z[o + ENTRIES] < 0.5 else low
    old_low = 1.0 if old_entries < 0.5 else low
    k, r = split_choice(u[5], int(settings[MAX_LANES] - new_low) + 1)
    z[o + EXITS] = new_low + k
    u_new[5] = (old_exits - old_low + r) / (settings[MAX_LANES] - old_low + 1.0)
    if settings[WIDTH_SPREAD] > 0.0:
        u_new[6] = normal_cdf((math.log(z[o + WIDTH]) - settings[LOG_WIDTH]) / settings[WIDTH_SPREAD])
        z[o + WIDTH] = math.exp(settings[LOG_WIDTH] + settings[WIDTH_SPREAD] * normal_quantile(u[6]))
    if settings[BEND_STD] > 0.0:
        u_new[7] = normal_cdf(z[o + BEND] / settings[BEND_STD])
        z[o + BEND] = settings[BEND_STD] * normal_quantile(u[7])
    if settings[SHIFT_STD] > 0.0:
        u_new[8] = normal_cdf(z[o + SHIFT] / settings[SHIFT_STD])
        z[o + SHIFT] = settings[SHIFT_STD] * normal_quantile(u[8])


@nb.njit
def change_arms(z, u, settings, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """Add an arm at a free angle (u[0] < 1/2) or remove a uniform one."""
    num, birth = int(z[0]), u[0] < 0.5
    if (birth and num >= MAX_ARMS) or (not birth and num <= MIN_ARMS):
        return False
    last = num if birth else num - 1  # the slot that changes
    place, _ = split_choice(u[1], last + 1)
    o = HEAD + last * ARM
    arms = z[:MAX_ARMS].copy()  # room for the sorted angles
    u_new[0] = u[0] + 0.5 if birth else u[0] - 0.5
    log_q[0] = log_q[1] = math.log(0.5) - math.log(last + 1.0)
    if birth:
        free = free_angles(z_new, num, arms)
        if free <= 0.0:
            return False
        log_q[1] += log_slot(z_new, last, settings) - math.log(2.0 * math.pi)
        u_new[2] = (z_new[o + ANGLE] + math.pi) / (2.0 * math.pi)
        z_new[o + ANGLE] = free_angle(u[2], free, num, arms)
        redraw_slot(z_new, last, settings, u, u_new)
        log_q[0] += log_slot(z_new, last, settings) - math.log(free)
        swap_slots(z_new, last, place)
        z_new[0] = num + 1.0
    else:
        swap_slots(z_new, last, place)
        free = free_angles(z_new, last, arms)
        log_q[1] += log_slot(z_new, last, settings) - math.log(free)
        u_new[2] = free_share(z_new[o + ANGLE], free, last, arms)
        z_new[o + ANGLE] = wrap(2.0 * math.pi * u[2] - math.pi)
        redraw_slot(z_new, last, settings, u, u_new)
        log_q[0] += log_slot(z_new, last, settings) - math.log(2.0 * math.pi)
        z_new[0] = num - 1.0
    return True


@nb.njit
def change_lanes(z, u, settings, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """Add an outer lane on a side of a uniform arm (u[0] < 1/2), or remove one of all lanes.

    q(add) = 1/2 1/2 1/K, q(remove one entry of arm a) = 1/2 E_a / sum(E + O)"""
    num = int(z[0])
    lanes = 0
    for a in range(num):
        lanes += int(z[HEAD + a * ARM + ENTRIES] + z[HEAD + a * ARM + EXITS])
    if u[0] < 0.5:
        arm, keep_arm = split_choice(u[1], num)
        side, keep_side = split_choice(u[2], 2)
        field = HEAD + arm * ARM + ENTRIES + side
        z_new[field] += 1.0
        same = int(z_new[field])
        index, keep_index = split_choice(u[3], same)  # which of the arm's lanes the reverse would name
        before = 0
        for a in range(arm):
            before += int(z[HEAD + a * ARM + ENTRIES] + z[HEAD + a * ARM + EXITS])
        before += int(z[HEAD + arm * ARM + ENTRIES]) if side == 1 else 0
        u_new[0] = u[0] + 0.5
        u_new[1] = (before + index + keep_arm) / (lanes + 1.0)
        u_new[2], u_new[3] = keep_side, keep_index
        log_q[0] = math.log(0.25 / num)
        log_q[1] = math.log(0.5 * same / (lanes + 1.0))
    else:
        lane, keep = split_choice(u[1], lanes)
        arm = 0
        while lane >= int(z[HEAD + arm * ARM + ENTRIES] + z[HEAD + arm * ARM + EXITS]):
            lane -= int(z[HEAD + arm * ARM + ENTRIES] + z[HEAD + arm * ARM + EXITS])
            arm += 1
        entries = int(z[HEAD + arm * ARM + ENTRIES])
        side = 0 if lane < entries else 1
        lane -= entries if side == 1 else 0
        field = HEAD + arm * ARM + ENTRIES + side
        same = int(z[field])
        z_new[field] -= 1.0
        u_new[0] = u[0] - 0.5
        u_new[1] = (arm + keep) / num
        u_new[2], u_new[3] = (side + u[2]) / 2.0, (lane + u[3]) / same
        log_q[0] = math.log(0.5 * same / lanes)
        log_q[1] = math.log(0.25 / num)
    return lanes_fit(z_new[HEAD + arm * ARM + ENTRIES], z_new[HEAD + arm * ARM + EXITS], settings)


@nb.njit
def toggle(z, u, settings, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """Give or take inner lanes of a uniform arm; the other lanes stay where they are.

    kind 0: an entry and an exit with 2 w of gap; 1, 2: an entry or an exit with w of gap and w / 2 of the
    axis; 3: an entry for an exit with w of the axis. The axis moves by its shift where that is a latent and
    u[4] < 1/2, else by a rotation. Then angle and gap move a little by themselves."""
    arm, _ = split_choice(u[0], int(z[0]))
    kind, keep_kind = split_choice(u[1], 4)
    up, keep_up = split_choice(u[2], 2)
    sign = 1.0 if up == 1 else -1.0
    o = HEAD + arm * ARM
    width = z[o + WIDTH]
    gap, axis, entries, exits = 2.0 * width, 0.0, -1.0, -1.0
    if kind == 1:
        gap, axis, exits = width, 0.5 * width, 0.0
    elif kind == 2:
        gap, axis, entries = width, -0.5 * width, 0.0
    elif kind == 3:
        gap, axis, exits = 0.0, width, 1.0
    by_shift = settings[SHIFT_STD] > 0.0 and u[4] < 0.5
    z_new[o + ENTRIES] += sign * entries
    z_new[o + EXITS] += sign * exits
    z_new[o + GAP] += sign * gap + 0.3 * (2.0 * u[5] - 1.0)
    if by_shift:
        z_new[o + SHIFT] += sign * axis
    turn = 0.0 if by_shift else sign * axis / LEVER
    z_new[o + ANGLE] = wrap(z[o + ANGLE] + turn + math.radians(1.0) * (2.0 * u[3] - 1.0))
    u_new[1], u_new[2] = (kind + keep_kind) / 4.0, (1 - up + keep_up) / 2.0
    u_new[3], u_new[5] = 1.0 - u[3], 1.0 - u[5]
    fits = lanes_fit(z_new[o + ENTRIES], z_new[o + EXITS], settings)
    inside = 0.0 <= z_new[o + GAP] <= settings[GAP_MAX]
    log_q[0] = log_q[1] = -math.log(int(z[0]) * 8.0 * 0.6 * math.radians(2.0))
    return fits and inside and apart(z_new, int(z[0]), z_new[o + ANGLE], arm)


@nb.njit
def scale_width(z, u, settings, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """Scale the lane width of a uniform arm: w' = w exp(t); Jacobian w' / w."""
    arm, _ = split_choice(u[0], int(z[0]))
    size = MAX_LOG_WIDTH * step_scale(u[1], settings)
    log_scale = size * (2.0 * u[2] - 1.0)
    o = HEAD + arm * ARM
    z_new[o + WIDTH] = z[o + WIDTH] * math.exp(log_scale)
    if u[3] < 0.5:
        z_new[o + GAP] -= 0.5 * (z[o + ENTRIES] + z[o + EXITS]) * (z_new[o + WIDTH] - z[o + WIDTH])
    u_new[2] = 1.0 - u[2]
    log_q[0] = log_q[1] = -math.log(int(z[0]) * 2.0 * size)
    log_q[2] = log_scale
    return 0.0 <= z_new[o + GAP] <= settings[GAP_MAX]


@nb.njit
def walk_field(kind, z, u, settings, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """Uniform walk of one field of a uniform arm, within what the field may be."""
    arm, _ = split_choice(u[0], int(z[0]))
    field, size = WALK_FIELD[kind], WALK_SIZE[kind] * step_scale(u[1], settings)
    o = HEAD + arm * ARM + field
    z_new[o] += size * (2.0 * u[2] - 1.0)
    u_new[2] = 1.0 - u[2]
    log_q[0] = log_q[1] = -math.log(int(z[0]) * 2.0 * size)
    if field == ANGLE:
        z_new[o] = wrap(z_new[o])
        return apart(z_new, int(z[0]), z_new[o], arm)
    return field != GAP or 0.0 <= z_new[o] <= settings[GAP_MAX]


@nb.njit
def shift_centre(z, u, settings, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """Shift the centre by a uniform radius in a uniform direction; the reverse points back."""
    size = MAX_CENTRE * step_scale(u[1], settings)
    z_new[1] += size * u[2] * math.cos(2.0 * math.pi * u[3])
    z_new[2] += size * u[2] * math.sin(2.0 * math.pi * u[3])
    u_new[3] = (u[3] + 0.5) % 1.0
    log_q[0] = log_q[1] = -math.log(size * 2.0 * math.pi)


@nb.njit
def pivot(z, u, settings, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """Shift the centre by delta while the arms stay where their points are.

    With u[4] < 1/2 and shifts that are latent, shift' = shift - n . delta: the lanes do not move at all. Else every
    arm turns about a point LEVER away, by the implicit midpoint rule, which its reverse undoes exactly:

        alpha' = alpha - n(m) . delta / LEVER,  m = (alpha + alpha') / 2,
        d alpha' / d alpha = (1 + d(m) . delta / (2 LEVER)) / (1 - d(m) . delta / (2 LEVER))"""
    shift_centre(z, u, settings, z_new, u_new, log_q)
    dx, dy = z_new[1] - z[1], z_new[2] - z[2]
    num = int(z[0])
    for a in range(num):
        o = HEAD + a * ARM
        angle = z[o + ANGLE]
        if settings[SHIFT_STD] > 0.0 and u[4] < 0.5:
            z_new[o + SHIFT] -= -math.sin(angle) * dx + math.cos(angle) * dy
            continue
        turned = angle
        for _ in range(20):  # a step of 6 m gains a digit each time
            middle, before = 0.5 * (angle + turned), turned
            turned = angle - (-math.sin(middle) * dx + math.cos(middle) * dy) / LEVER
            if abs(turned - before) < 1e-15:
                break
        middle = 0.5 * (angle + turned)
        lean = (math.cos(middle) * dx + math.sin(middle) * dy) / (2.0 * LEVER)
        log_q[2] += math.log((1.0 + lean) / (1.0 - lean))
        z_new[o + ANGLE] = wrap(turned)
    for a in range(1, num):
        if not apart(z_new, a, z_new[HEAD + a * ARM + ANGLE], a):
            return False
    return True


def propose(kind, z, u, floats, ints, z_new, u_new, log_q):  # type: ignore[no-untyped-def]
    """One involution; returns False where the step leaves the state space."""
    overwrite(z_new, z)
    overwrite(u_new, u)
    log_q[:] = 0.0
    if kind == CENTRE:
        shift_centre(z, u, floats, z_new, u_new, log_q)
        return True
    if kind == ARMS:
        return change_arms(z, u, floats, z_new, u_new, log_q)
    if kind == LANES:
        return change_lanes(z, u, floats, z_new, u_new, log_q)
    if kind == TOGGLE:
        return toggle(z, u, floats, z_new, u_new, log_q)
    if kind == PIVOT:
        return pivot(z, u, floats, z_new, u_new, log_q)
    if kind == SCALE_WIDTH:
        return scale_width(z, u, floats, z_new, u_new, log_q)
    return walk_field(kind, z, u, floats, z_new, u_new, log_q)


def probabilities(steps: str, latent: dict[str, bool]) -> dict[int, float]:
    """How often each move is tried: Algorithm 1 of [M20], or ours with the moves the latents need."""
    if steps == "m20":
        table = {ROTATE: 0.30, CENTRE: 0.22, CHANGE_GAP: 0.16, ARMS: 0.05, LANES: 0.27}
    else:
        table = {ROTATE: 0.25, CENTRE: 0.07, PIVOT: 0.05, CHANGE_GAP: 0.16, ARMS: 0.05, LANES: 0.22, TOGGLE: 0.20}
    table |= {SCALE_WIDTH: 0.10} if latent["width"] else {}
    table |= {CHANGE_BEND: 0.06} if latent["bend"] else {}
    table |= {CHANGE_SHIFT: 0.06} if latent["shift"] else {}
    total = sum(table.values())
    return {kind: value / total for kind, value in table.items()}
