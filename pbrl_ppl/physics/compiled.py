"""The compiled rollout: a loop in machine code that steps the engine without the GIL."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics.calls import call1, call2, call_int, call_pointer, get1, get2
from pbrl_ppl.physics.compilation import compiled, copy
from pbrl_ppl.physics.laws import (
    ACTED,
    COMMAND,
    LATE,
    MORE,
    WRENCHES,
    act,
    begin_held,
    laws_of,
    set_memory,
)
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.setters import (
    arm,
    drive,
    iterations,
    place_bodies,
    place_patches,
    place_wheels,
    set_brakes,
    set_discs,
    set_properties,
    set_strengths,
)
from pbrl_ppl.physics.solids import near_contact
from pbrl_ppl.physics.world import FINER, TINY

_FREE, _TOUCHED, _LOST = 0, 1, 2


class Scratch(NamedTuple):
    """Arrays of a transition."""

    state: NDArray[np.float64]  # (body, 6)
    axes: NDArray[np.float64]  # (wheel, 2): cos and sin of the wheel's angle on the body
    acted: NDArray[np.float64]  # (body + 4, 12), see `act`
    memory: NDArray[np.float64]  # (2, slot), see `set_memory`
    at: NDArray[np.int64]  # (2,), the same
    held: NDArray[np.float64]  # (2, slot), see `act`


@numba.njit(inline="always")
def _forget(fn, world, bodies, batch, touched):  # type: ignore[no-untyped-def]
    """Clear the contacts and impulses that the engine keeps of the last transition.

    Contacts go with their shapes, which are removed and added as in a new world: far from each
    other, and in the same numbering. That is needed only after a contact. A joint's stored impulse
    is limited to its greatest force, here zero.
    """
    if touched == _FREE and len(world.unlimited) + len(world.limited) == 0:
        return  # nothing to forget
    if touched:
        for i in range(len(world.bodies)):
            call2(fn.cpBodySetPosition, world.bodies[i], world.far * (i + 1.0), world.far)
            call1(fn.cpBodySetAngle, world.bodies[i], 0.0)
            call2(fn.cpBodySetVelocity, world.bodies[i], 0.0, 0.0)
            call1(fn.cpBodySetAngularVelocity, world.bodies[i], 0.0)
        for shape in world.shapes:
            call_pointer(fn.cpSpaceRemoveShape, world.space, shape)
        for _ in range(world.padding):  # see World._add_shapes
            call_pointer(fn.cpSpaceAddShape, world.space, world.shapes[0])
            call_pointer(fn.cpSpaceRemoveShape, world.space, world.shapes[0])
        for shape in world.shapes:
            call_pointer(fn.cpSpaceAddShape, world.space, shape)
    set_strengths(fn, world, bodies, False)
    call_int(fn.cpSpaceSetIterations, world.space, 1)
    call1(fn.cpSpaceStep, world.space, TINY * batch.time_step)
    enough = iterations(world.iterations, world.chained, bodies)
    call_int(fn.cpSpaceSetIterations, world.space, enough)
    set_strengths(fn, world, bodies, True)


@compiled
def intervals(bodies, p, t, horizon):  # type: ignore[no-untyped-def]
    """Return the properties in a transition's intervals; one row if they do not change."""
    if bodies.shape[1] > 1:
        return bodies[p, t * horizon : (t + 1) * horizon]
    return bodies[p]


@numba.njit(inline="always")  # a call costs as much as a substep: the world is many arrays
def _transition(  # type: ignore[no-untyped-def]
    fn, world, batch, laws, p, t, substeps, scratch, first, begin, whole, out
):
    """Step one transition into ``out`` (H, body, 6), from the states ``first`` on.

    They are those before the interval ``begin``. One that is not ``whole`` ends where no body is
    near another. Returns how it ended, and the interval after its last.
    """
    k = len(world.bodies)
    step = batch.time_step / substeps
    state, axes, acted, memory, at, held = scratch
    inputs, end = batch.inputs[t], begin
    properties, joints = intervals(batch.given[0], p, t, len(inputs)), batch.given[1][p]
    copy(first, state)
    bodies = properties[begin if len(properties) > 1 else 0]
    for j in range(len(axes)):
        turn = bodies[world.wheel_body[j], COLUMN.w_theta]
        axes[j, 0], axes[j, 1] = math.cos(turn), math.sin(turn)
    touched, near = _FREE, False
    driven = world.kinematic.any()
    acting = len(laws.commands) + len(laws.forces) > 0
    sliding = len(world.patch_body) > 0
    braked = len(laws.frictions) > 0
    still = world.still
    watch = len(still.obstacles) > 0 or k > 1
    place_bodies(fn, world, bodies, state)
    set_memory(batch, laws, p, t, begin, first, acted, memory, held, at)
    begin_held(state, laws, acted, held)
    while end < len(inputs) and (whole or near or end == begin):
        h = end
        if h > begin and len(properties) > 1:
            bodies = properties[h]
            set_properties(fn, world, bodies, joints)
            place_bodies(fn, world, bodies, state)
            set_strengths(fn, world, bodies, True)
            enough = iterations(world.iterations, world.chained, bodies)
            call_int(fn.cpSpaceSetIterations, world.space, enough)
        if driven:
            drive(fn, world, state, inputs[h])
        for i in range(k):
            for w in range(3):
                acted[i, COMMAND + w] = acted[i, WRENCHES + w] = inputs[h, i, w]
        for s in range(substeps):
            near = False
            if acting:
                act(
                    state, inputs[h], laws, s / substeps, (s + 1) / substeps, acted, memory[1], held
                )
                for slot in range(held.shape[1]):
                    held[0, slot] += step * held[1, slot]
            if braked:
                set_brakes(world, laws, bodies, joints, state, acted)
            for i in range(k):
                if driven and world.kinematic[i]:
                    continue
                weight_x = bodies[i, COLUMN.mass] * bodies[i, COLUMN.extra_gravity_x]
                weight_y = bodies[i, COLUMN.mass] * bodies[i, COLUMN.extra_gravity_y]
                f_x, f_y = acted[i, WRENCHES], acted[i, WRENCHES + 1]
                call2(fn.cpBodySetForce, world.bodies[i], f_x + weight_x, f_y + weight_y)
                x, y = arm(bodies[i], state[i, 2])
                torque = acted[i, WRENCHES + 2] - (x * f_y - y * f_x)
                call1(fn.cpBodySetTorque, world.bodies[i], torque)
            place_wheels(fn, world, bodies, state, axes, step)
            if sliding:
                place_patches(fn, world, laws, bodies, state, step, acted)
            call1(fn.cpSpaceStep, world.space, step)
            for i in range(k):
                body = world.bodies[i]
                state[i, 0], state[i, 1] = get2(fn.cpBodyGetPosition, body)
                state[i, 2] = get1(fn.cpBodyGetAngle, body)
                turn = get1(fn.cpBodyGetAngularVelocity, body)
                x, y = arm(bodies[i], state[i, 2])
                v_x, v_y = get2(fn.cpBodyGetVelocity, body)
                state[i, 3], state[i, 4], state[i, 5] = v_x + turn * y, v_y - turn * x, turn
                speed = abs(state[i, 3]) + abs(state[i, 4]) + still.length * abs(turn)
                if not speed < still.fastest:  # also true of NaN
                    return _LOST, end
            if watch and (touched == _FREE or not whole):
                near = near_contact(state, still.radii, still.obstacles, still.can_touch)
                touched = _TOUCHED if near else touched
        copy(state, out[h])
        if memory.shape[1] > 0:
            act(state, inputs[h], laws, LATE, 1.0, acted, memory[1], held, True)
        end += 1
    return touched, end


@compiled
def rollout(fn, world, batch, items, begins, whole, out):  # type: ignore[no-untyped-def]
    """Predict ``items`` of ``out``, whose shape is (proposal * transition, H, body, 6).

    Those that are not ``whole`` are predicted from the interval in ``begins``, shape (item,), with
    the most substeps, until an interval ends where no body is near another; ``begins`` becomes the
    next one.

    Each whole transition is run with every number of substeps in ``batch.counts``, the finest
    first, and the weighted sum cancels the leading errors. Where shapes came close the finest run
    stands alone, since the time of a collision is no smooth function of the substep; with hidden
    discs it is refined.

    Returns the place among the items at which the engine diverged (its world must then be
    replaced), or the number of items.
    """
    bodies, joints, discs = batch.given[:3]
    n, horizon = len(batch.inputs), batch.inputs.shape[1]
    states = np.empty((horizon, batch.inputs.shape[2], 6))
    total = np.empty_like(states)
    timed = bodies.shape[1] > 1
    k = len(world.bodies)
    axes = np.empty((len(world.wheel_body), 2))
    acted, memory = np.zeros((k + MORE, ACTED)), np.zeros((2, batch.slots))
    scratch = Scratch(
        np.empty((k, 6)), axes, acted, memory, np.full(2, -1), np.zeros((2, batch.held))
    )
    proposal, finer = -1, 1
    start, outcome = batch.start, _TOUCHED  # an earlier call may have left contacts
    for place in range(len(items)):
        item = items[place]
        p, t = item // n, item % n
        begin, laws = begins[place], laws_of(batch, p)
        first = intervals(bodies, p, t, horizon)[begin if timed else 0]
        states_before = start[p if len(start) > 1 else 0, t]
        if begin > 0:
            states_before = out[item, begin - 1]
        if p != proposal:
            proposal = p
            set_properties(fn, world, first, joints[p])
            set_discs(fn, world, discs[p])
            finer = FINER if (discs[p, :, 2] > 0.0).any() else 1
        total[:] = 0.0
        for level in range(len(batch.counts)):
            before, substeps = outcome, batch.counts[level]
            if not whole:  # near others: with the contacts in the order of a new world
                before, substeps = _TOUCHED, substeps * finer
            for _ in range(2):
                if timed:
                    set_properties(fn, world, first, joints[p])
                _forget(fn, world, first, batch, before)
                outcome, end = _transition(
                    fn, world, batch, laws, p, t, substeps, scratch, states_before, begin, whole,
                    states,
                )  # fmt: skip
                if substeps > batch.counts[level] and outcome == _FREE:
                    outcome = _TOUCHED  # the first run touched: a refined one is not extrapolated
                fine = substeps == batch.counts[level] * finer
                if outcome != _TOUCHED or (before == _TOUCHED and fine):
                    break
                # again with the contacts in the order of a new world, and refined
                before, substeps = _TOUCHED, batch.counts[level] * finer
            if outcome == _LOST:
                return place
            if level == 0:
                begins[place] = end
                for h in range(begin, end):
                    copy(states[h], out[item, h])
            if outcome == _TOUCHED or not whole:
                break
            total += batch.weights[level] * states
        if whole and outcome == _FREE and len(batch.counts) > 1:
            for i in range(k):
                if world.kinematic[i]:  # the weights' sum is 1 but for rounding
                    copy(out[item, :, i], total[:, i])
            for h in range(horizon):
                copy(total[h], out[item, h])
    return len(items)
