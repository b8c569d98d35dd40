"""Contact-free fast path: many transitions at once, in the engine's arithmetic.

Bodies that touch nothing need no collision search: positions, forces and the solver's clipped
impulses are a few lines, which the compiler vectorises over transitions. They are those of
Chipmunk's ``cpSpaceStep``, in its order, so that the results agree to rounding.

States, wrenches and obstacles refer to a body's origin; a substep moves its centre of mass.
``body`` is the row of a body in a block of transitions, and ``i`` the number of one of them.

Bodies with joints, or with friction under them, are a :mod:`tree <pbrl_ppl.physics.tree>`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pbrl_ppl.physics.calls import compiled, copy, from_place, inlined, inner, rotated, start_of
from pbrl_ppl.physics.laws import (
    ACTED,
    MORE,
    WRENCHES,
    act,
    begin_held,
    remember,
    set_memory,
    states_before,
)
from pbrl_ppl.physics.solids import reaches, segment
from pbrl_ppl.physics.world import COLUMN, World, columns
from pbrl_ppl.state import Bools, Floats, Ints

#: Number of transitions in a block, which are computed side by side.
BLOCK = 32

#: Where the values of each field of a body begin in a row: those of a block follow each other. All
#: are in one array: the compiler then knows that they do not overlap. The state of the centre of
#: mass, which is at ``com`` in the body's frame, and by how much it turned in a substep; the place
#: of its origin; the wrench on it and the weight beside the scene's gravity. Then those of its
#: wheel: place and axis in its frame, greatest and stored impulses of both rods; the axis in the
#: world, levers and effective masses in a substep.
BODY = columns(
    """
    x y angle turned vx vy omega cos sin com_x com_y inverse_mass inverse_moment
    origin_x origin_y force_x force_y torque weight_x weight_y
    wheel_x wheel_y wheel_cos wheel_sin most_along most_across impulse_along impulse_across
    axis_x axis_y lever_along lever_across mass_along mass_across
    """,
    BLOCK,
)
#: Coefficients of the series of cosine and sine.
_C1, _C2, _C3, _C4, _C5, _C6, _C7 = ((-1) ** k / math.factorial(2 * k) for k in range(1, 8))
_S1, _S2, _S3, _S4, _S5, _S6, _S7 = ((-1) ** k / math.factorial(2 * k + 1) for k in range(1, 8))


@inner
def set_body(body, i, row, wheel, normal_gravity, step):  # type: ignore[no-untyped-def]
    """Set a body's properties for an interval; keep stored impulses."""
    mass, com_x, com_y = row[COLUMN.mass], row[COLUMN.com_x], row[COLUMN.com_y]
    body[BODY.inverse_mass + i] = 1.0 / mass
    body[BODY.inverse_moment + i] = 1.0 / row[COLUMN.moment]
    body[BODY.weight_x + i] = mass * row[COLUMN.extra_gravity_x]
    body[BODY.weight_y + i] = mass * row[COLUMN.extra_gravity_y]
    body[BODY.com_x + i], body[BODY.com_y + i] = com_x, com_y
    if wheel:
        load, angle = mass * normal_gravity, row[COLUMN.w_theta]
        body[BODY.wheel_x + i] = row[COLUMN.w_x] - com_x
        body[BODY.wheel_y + i] = row[COLUMN.w_y] - com_y
        body[BODY.wheel_cos + i], body[BODY.wheel_sin + i] = math.cos(angle), math.sin(angle)
        body[BODY.most_along + i] = row[COLUMN.mu_x] * load * step
        body[BODY.most_across + i] = row[COLUMN.mu_y] * load * step


@inner
def align(body, i):  # type: ignore[no-untyped-def]
    """Set the heading from the angle, which removes accumulated rounding."""
    angle = body[BODY.angle + i]
    body[BODY.cos + i], body[BODY.sin + i] = math.cos(angle), math.sin(angle)


@inner
def _arm(body, i):  # type: ignore[no-untyped-def]
    """Return the arm from the origin to the centre of mass, in the world's frame."""
    c, s = body[BODY.cos + i], body[BODY.sin + i]
    return rotated(c, s, body[BODY.com_x + i], body[BODY.com_y + i])


@inner
def set_state(body, i, states, k):  # type: ignore[no-untyped-def]
    """Set the state of the centre of mass from that of the origin, row ``k`` of the states."""
    omega = states[k, 5]
    body[BODY.angle + i], body[BODY.omega + i] = states[k, 2], omega
    align(body, i)
    x, y = _arm(body, i)
    body[BODY.x + i], body[BODY.y + i] = states[k, 0] + x, states[k, 1] + y
    body[BODY.vx + i], body[BODY.vy + i] = states[k, 3] - omega * y, states[k, 4] + omega * x


@inner
def get_state(body, i, states, k):  # type: ignore[no-untyped-def]
    """Write the state of the origin into row ``k`` of the states."""
    (x, y), omega = _arm(body, i), body[BODY.omega + i]
    states[k, 0], states[k, 1] = body[BODY.x + i] - x, body[BODY.y + i] - y
    states[k, 2] = body[BODY.angle + i]
    states[k, 3], states[k, 4] = body[BODY.vx + i] + omega * y, body[BODY.vy + i] - omega * x
    states[k, 5] = omega


@inner
def set_wrench(body, i, force_x, force_y, torque):  # type: ignore[no-untyped-def]
    """Set the wrench at the origin."""
    body[BODY.force_x + i], body[BODY.force_y + i], body[BODY.torque + i] = force_x, force_y, torque


@inner
def move(body, gravity, step, small=0.5):  # type: ignore[no-untyped-def]
    """Move a body and rotate its heading; then add what gravity and the wrench change.

    Rotations by less than ``small`` (rad) are computed by a series, exact to rounding.
    """
    fast, (g_x, g_y) = False, gravity
    for i in range(BLOCK):
        heading, slope = body[BODY.cos + i], body[BODY.sin + i]
        f_x, f_y = body[BODY.force_x + i], body[BODY.force_y + i]
        x, y = rotated(heading, slope, body[BODY.com_x + i], body[BODY.com_y + i])
        torque = body[BODY.torque + i] - (x * f_y - y * f_x)
        body[BODY.x + i] += body[BODY.vx + i] * step
        body[BODY.y + i] += body[BODY.vy + i] * step
        a = body[BODY.turned + i] = body[BODY.omega + i] * step
        body[BODY.angle + i] += a
        fast |= not abs(a) < small
        d = a * a
        c = 1.0 + d * (_C1 + d * (_C2 + d * (_C3 + d * (_C4 + d * (_C5 + d * (_C6 + d * _C7))))))
        s = _S1 + d * (_S2 + d * (_S3 + d * (_S4 + d * (_S5 + d * (_S6 + d * _S7)))))
        s = a * (1.0 + d * s)
        body[BODY.cos + i], body[BODY.sin + i] = rotated(c, s, heading, slope)
        mass = body[BODY.inverse_mass + i]
        body[BODY.vx + i] += (g_x + (f_x + body[BODY.weight_x + i]) * mass) * step
        body[BODY.vy + i] += (g_y + (f_y + body[BODY.weight_y + i]) * mass) * step
        body[BODY.omega + i] += torque * body[BODY.inverse_moment + i] * step
    if fast:
        for i in range(BLOCK):
            if not abs(body[BODY.turned + i]) < small:
                align(body, i)


@inner
def lose(body, still, touched):  # type: ignore[no-untyped-def]
    """Mark the transitions that have diverged."""
    for i in range(BLOCK):
        speed = abs(body[BODY.vx + i]) + abs(body[BODY.vy + i])
        speed += still.length * abs(body[BODY.omega + i])
        touched[i] |= not speed < still.fastest  # also true of NaN


@inner
def watch(bodies, still, discs, touched):  # type: ignore[no-untyped-def]
    """Mark the transitions in which a body is near an obstacle or another that it may touch."""
    for k in range(len(still.radii)):
        body, radius = bodies[k], still.radii[k]
        for i in range(BLOCK):
            c, s = body[BODY.cos + i], body[BODY.sin + i]
            x, y = rotated(c, s, body[BODY.com_x + i], body[BODY.com_y + i])
            body[BODY.origin_x + i] = body[BODY.x + i] - x
            body[BODY.origin_y + i] = body[BODY.y + i] - y
        for j in range(len(still.obstacles) - discs.shape[1]):
            a_x, a_y, d_x, d_y, scale, size = segment(still.obstacles[j])
            for i in range(BLOCK):
                x, y = body[BODY.origin_x + i] - a_x, body[BODY.origin_y + i] - a_y
                touched[i] |= reaches(x, y, d_x, d_y, scale, radius + size)
        for j in range(discs.shape[1]):
            for i in range(BLOCK):
                x = body[BODY.origin_x + i] - discs[i, j, 0]
                y = body[BODY.origin_y + i] - discs[i, j, 1]
                near = reaches(x, y, 0.0, 0.0, 0.0, radius + discs[i, j, 2])
                touched[i] |= near & (discs[i, j, 2] > 0.0)
        for j in range(k):
            if still.can_touch[k, j]:
                other = bodies[j]
                for i in range(BLOCK):
                    x = body[BODY.origin_x + i] - other[BODY.origin_x + i]
                    y = body[BODY.origin_y + i] - other[BODY.origin_y + i]
                    touched[i] |= reaches(x, y, 0.0, 0.0, 0.0, radius + still.radii[j])


@inner
def limited(impulse, most):  # type: ignore[no-untyped-def]
    """Return an impulse clipped to ``most`` in both directions."""
    impulse = most if impulse > most else impulse
    return -most if impulse < -most else impulse


@inner
def begin_wheel(body):  # type: ignore[no-untyped-def]
    """Place a wheel's two rods and apply their impulses of the substep before."""
    for i in range(BLOCK):
        c, s = body[BODY.cos + i], body[BODY.sin + i]
        r_x, r_y = rotated(c, s, body[BODY.wheel_x + i], body[BODY.wheel_y + i])
        n_x, n_y = rotated(c, s, body[BODY.wheel_cos + i], body[BODY.wheel_sin + i])
        along, across = r_x * n_y - r_y * n_x, r_x * n_x + r_y * n_y
        mass, moment = body[BODY.inverse_mass + i], body[BODY.inverse_moment + i]
        body[BODY.axis_x + i], body[BODY.axis_y + i] = n_x, n_y
        body[BODY.lever_along + i], body[BODY.lever_across + i] = along, across
        body[BODY.mass_along + i] = 1.0 / (mass + moment * along * along)
        body[BODY.mass_across + i] = 1.0 / (mass + moment * across * across)
        j_x, j_y = body[BODY.impulse_along + i], body[BODY.impulse_across + i]
        body[BODY.vx + i] -= (n_x * j_x - n_y * j_y) * mass
        body[BODY.vy + i] -= (n_y * j_x + n_x * j_y) * mass
        body[BODY.omega + i] -= moment * (along * j_x + across * j_y)


@inner
def solve_wheel(body):  # type: ignore[no-untyped-def]
    """Do one iteration of a wheel's rods, whose impulses friction limits."""
    for i in range(BLOCK):
        n_x, n_y = body[BODY.axis_x + i], body[BODY.axis_y + i]
        along, across = body[BODY.lever_along + i], body[BODY.lever_across + i]
        mass, moment = body[BODY.inverse_mass + i], body[BODY.inverse_moment + i]
        v_x, v_y, w = body[BODY.vx + i], body[BODY.vy + i], body[BODY.omega + i]
        old = body[BODY.impulse_along + i]
        new = old + (n_x * v_x + n_y * v_y + along * w) * body[BODY.mass_along + i]
        new = limited(new, body[BODY.most_along + i])
        body[BODY.impulse_along + i] = new
        j = new - old
        v_x -= n_x * j * mass
        v_y -= n_y * j * mass
        w -= moment * along * j
        old = body[BODY.impulse_across + i]
        new = old + (n_x * v_y - n_y * v_x + across * w) * body[BODY.mass_across + i]
        new = limited(new, body[BODY.most_across + i])
        body[BODY.impulse_across + i] = new
        j = new - old
        body[BODY.vx + i] = v_x + n_y * j * mass
        body[BODY.vy + i] = v_y - n_x * j * mass
        body[BODY.omega + i] = w - moment * across * j


class Wheels(NamedTuple):
    """Which bodies have a wheel, and the solver's iterations."""

    under: Bools  # (body,)
    iterations: int


def free_wheels(world: World) -> Wheels | None:
    """Return a world's wheels; None where a body follows a path, is joined, or is on friction."""
    if world.kinematic.any() or world.links or world.patches or world.turners:
        return None
    wheels = [wheel.body for wheel in world.wheels]
    return Wheels(np.isin(np.arange(len(world.bodies)), wheels), world.iterations)


class Lanes(NamedTuple):
    """Transitions side by side: which they are, where they are, and what acts in them."""

    proposal: Ints  # (BLOCK,)
    transition: Ints
    first: Ints  # intervals with which they begin
    until: Ints  # intervals in which a body comes near an obstacle
    touched: Bools
    discs: Floats  # (BLOCK, disc, 3)
    bodies: Floats  # (body, BLOCK * field)
    states: Floats  # (body, 6) of one transition
    acted: Floats  # (body + MORE, ACTED), see `laws.act`
    memory: Floats  # (2, slot), see `laws.set_memory`
    at: Ints  # (2,)
    remembered: Floats  # (BLOCK, slot)
    held: Floats  # (BLOCK, 2, number)


@inner
def _lanes_of(batch, moving):  # type: ignore[no-untyped-def]
    """Return the arrays of a block of so many moving bodies."""
    slots, held = batch.laws[0].n_slots, batch.laws[0].n_held
    return Lanes(
        np.zeros(BLOCK, np.int64), np.zeros(BLOCK, np.int64), np.zeros(BLOCK, np.int64),
        np.zeros(BLOCK, np.int64), np.zeros(BLOCK, np.bool_),
        np.zeros((BLOCK, batch.given[2].shape[1], 3)), np.zeros((moving, BLOCK * len(BODY))),
        np.empty((moving, 6)), np.zeros((moving + MORE, ACTED)),
        np.zeros((2, slots)), np.full(2, -1),
        np.zeros((BLOCK, slots)), np.zeros((BLOCK, 2, held)),
    )  # fmt: skip


@inlined
def _choose(lanes, batch, items, begins, begin):  # type: ignore[no-untyped-def]
    """Choose the transitions of the items from ``begin`` on; return the most intervals of one."""
    n, horizon, longest = len(batch.inputs), batch.inputs.shape[1], 0
    for i in range(BLOCK):
        place = min(begin + i, len(items) - 1)  # the rest of a block repeats the last
        lanes.proposal[i], lanes.transition[i] = items[place] // n, items[place] % n
        lanes.first[i], lanes.until[i] = begins[place], horizon
        longest = max(longest, horizon - lanes.first[i])
        copy(batch.given[2][lanes.proposal[i]], lanes.discs[i])
    return longest


@inlined
def _interval(lanes, batch, i, ahead):  # type: ignore[no-untyped-def]
    """Return proposal, transition and interval of one that is so many intervals ahead."""
    h = min(lanes.first[i] + ahead, batch.inputs.shape[1] - 1)
    return lanes.proposal[i], lanes.transition[i], h


@inlined
def _get_states(lanes, i):  # type: ignore[no-untyped-def]
    """Write the states of all bodies of a transition."""
    for k in range(len(lanes.bodies)):
        get_state(lanes.bodies[k], i, lanes.states, k)


@inlined
def _begin_interval(lanes, batch, out, wheels, still, step, ahead):  # type: ignore[no-untyped-def]
    """Set properties, states where transitions begin, and wrenches."""
    rows, states = batch.given[0], lanes.states
    timed, n, horizon = rows.shape[1] > 1, len(batch.inputs), batch.inputs.shape[1]
    for k in range(len(lanes.bodies)):
        body, wheel = lanes.bodies[k], wheels.under[k]
        for i in range(BLOCK):
            p, t, h = _interval(lanes, batch, i, ahead)
            if timed or ahead == 0:
                if ahead > 0:
                    get_state(body, i, states, k)
                else:
                    before = states_before(batch, out, p * n + t, h)
                    for d in range(6):
                        states[k, d] = before[k, d]
                row = rows[p, t * horizon + h if timed else 0, k]
                set_body(body, i, row, wheel, still.normal_gravity, step)
                set_state(body, i, states, k)
            else:
                align(body, i)
            force = batch.inputs[t, h, k]
            set_wrench(body, i, force[0], force[1], force[2])


@inlined
def _begin_laws(lanes, batch, width):  # type: ignore[no-untyped-def]
    """Set what laws remember where transitions begin."""
    for i in range(width):
        p, t, h = _interval(lanes, batch, i, 0)
        laws = batch.laws[p]
        _get_states(lanes, i)
        set_memory(batch, laws, p, t, h, lanes.states, lanes.acted, lanes.memory, lanes.at)
        begin_held(lanes.states, laws, lanes.acted, lanes.held[i])
        for slot in range(laws.n_slots):
            lanes.remembered[i, slot] = lanes.memory[1, slot]


@inlined
def _act(lanes, batch, width, ahead, s, substeps):  # type: ignore[no-untyped-def]
    """Set the wrenches of laws in a substep."""
    states, acted = start_of(lanes.states), start_of(lanes.acted)
    for i in range(width):
        p, t, h = _interval(lanes, batch, i, ahead)
        laws = batch.laws[p]
        _get_states(lanes, i)
        memory = from_place(start_of(lanes.remembered), laws.n_slots * i)
        held = from_place(start_of(lanes.held), 2 * laws.n_held * i)
        rates = from_place(held, laws.n_held)
        share, end = s / substeps, (s + 1) / substeps
        act(states, start_of(batch.inputs[t, h]), laws, share, end, acted, memory, held, rates)
        for slot in range(laws.n_held):
            held[slot] += batch.time_step / substeps * rates[slot]
        for k in range(len(lanes.bodies)):
            on = lanes.acted[k]
            set_wrench(lanes.bodies[k], i, on[WRENCHES], on[WRENCHES + 1], on[WRENCHES + 2])


@inlined
def _remember(lanes, batch, width, ahead):  # type: ignore[no-untyped-def]
    """Bring what laws remember up to date after an interval."""
    for i in range(width):
        p, t, h = _interval(lanes, batch, i, ahead)
        _get_states(lanes, i)
        inputs, memory = start_of(batch.inputs[t, h]), start_of(lanes.remembered[i])
        remember(lanes.states, inputs, batch.laws[p], lanes.acted, memory)


@inlined
def _add(lanes, out, items, ahead, weight, first_level):  # type: ignore[no-untyped-def]
    """Add weighted states to ``out``, up to the interval in which a transition touches."""
    for i in range(len(items)):
        h = lanes.first[i] + ahead
        if lanes.touched[i]:
            lanes.until[i] = min(lanes.until[i], h)
        if h < lanes.until[i]:
            _get_states(lanes, i)
            for k in range(len(lanes.bodies)):
                for d in range(6):
                    total = 0.0 if first_level else out[items[i], h, k, d]
                    out[items[i], h, k, d] = total + weight * lanes.states[k, d]


@inner
def substep(bodies, touched, discs, wheels, still, step):  # type: ignore[no-untyped-def]
    """Do one step of the engine, and mark the transitions in which a body touches or diverges."""
    for k in range(len(wheels.under)):
        move(bodies[k], still.gravity, step)
        if wheels.under[k]:
            begin_wheel(bodies[k])
            for _ in range(wheels.iterations):
                solve_wheel(bodies[k])
        lose(bodies[k], still, touched)
    if still.watched:
        watch(bodies, still, discs, touched)


@compiled
def rollout_free(wheels, still, batch, items, begins, out):  # type: ignore[no-untyped-def]
    """Predict ``items`` as the engine's rollout does, but for intervals that it must predict.

    ``begins``, shape (item,), are their first intervals; they become those in which a body comes
    near an obstacle or diverges, H where none does.
    """
    lanes, laws = _lanes_of(batch, len(still.radii)), batch.laws[0]
    bodies, touched, discs = lanes.bodies, lanes.touched, lanes.discs
    for begin in range(0, len(items), BLOCK):
        width = min(BLOCK, len(items) - begin)
        longest = _choose(lanes, batch, items, begins, begin)
        for level in range(len(batch.counts)):
            substeps = batch.counts[level]
            step = batch.time_step / substeps
            bodies[:], touched[:] = 0.0, False
            for ahead in range(longest):
                _begin_interval(lanes, batch, out, wheels, still, step, ahead)
                if ahead == 0 and laws.n_slots + laws.n_held > 0:
                    _begin_laws(lanes, batch, width)
                for s in range(substeps):
                    if laws.n_commands + laws.n_forces > 0:
                        _act(lanes, batch, width, ahead, s, substeps)
                    substep(bodies, touched, discs, wheels, still, step)
                if laws.n_slots > 0:
                    _remember(lanes, batch, width, ahead)
                chosen = items[begin : begin + width]
                _add(lanes, out, chosen, ahead, batch.weights[level], level == 0)
        for i in range(width):
            begins[begin + i] = lanes.until[i]
