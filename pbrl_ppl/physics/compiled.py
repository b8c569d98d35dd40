"""The compiled rollout: numba code that steps the engine's C functions, without the GIL."""

from __future__ import annotations

import math

import numba
import numpy as np

from pbrl_ppl.physics.calls import call1, call2, call_int, call_law, call_pointer, get1, get2
from pbrl_ppl.physics.setters import (
    EXTRA_X,
    EXTRA_Y,
    MASS,
    W_THETA,
    arm,
    drive,
    iterations,
    place_bodies,
    place_patches,
    place_wheels,
    set_discs,
    set_properties,
    set_strengths,
)
from pbrl_ppl.physics.world import DIVERGED, FAR, FINER, TINY

_FREE, _TOUCHED, _LOST = 0, 1, 2


@numba.njit(inline="always")
def _forget(fn, world, bodies, normal_gravity, touched):  # type: ignore[no-untyped-def]
    """Clear what the engine remembers of the last transition.

    Contacts go with their shapes, which are taken out and put back as in a new world: far from each
    other, and numbered alike. Where nothing has touched, and nothing will, that is left out. A
    joint's stored impulse is clipped to its greatest force, here zero.
    """
    if touched == _FREE and len(world.wheel_body) + len(world.links) + len(world.patch_body) == 0:
        return  # nothing to forget
    if touched:
        for i in range(len(world.bodies)):
            call2(fn.cpBodySetPosition, world.bodies[i], FAR * (i + 1.0), FAR)
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
    set_strengths(fn, world, bodies, normal_gravity, 0.0)
    call_int(fn.cpSpaceSetIterations, world.space, 1)
    call1(fn.cpSpaceStep, world.space, TINY)
    call_int(fn.cpSpaceSetIterations, world.space, iterations(world, bodies))
    set_strengths(fn, world, bodies, normal_gravity, 1.0)


@numba.njit(nogil=True, cache=True)
def _near_contact(i, state, radii, obstacles, can_touch):  # type: ignore[no-untyped-def]
    """Whether body ``i`` may touch an obstacle or a body before it: as in plain.py."""
    x, y = state[i, 0], state[i, 1]
    for j in range(len(obstacles)):
        ax, ay = obstacles[j, 0], obstacles[j, 1]
        dx, dy = obstacles[j, 2] - ax, obstacles[j, 3] - ay
        length = dx * dx + dy * dy
        t = 0.0
        if length > 0.0:
            t = min(1.0, max(0.0, ((x - ax) * dx + (y - ay) * dy) / length))
        reach = radii[i] + obstacles[j, 4]
        ex, ey = x - ax - t * dx, y - ay - t * dy
        if ex * ex + ey * ey <= reach * reach:
            return True
    for j in range(i):
        if can_touch[i, j]:
            reach = radii[i] + radii[j]
            ex, ey = x - state[j, 0], y - state[j, 1]
            if ex * ex + ey * ey <= reach * reach:
                return True
    return False


@numba.njit(nogil=True, cache=True)
def _meeting(discs):  # type: ignore[no-untyped-def]
    """How many times finer to step what comes near something."""
    for i in range(len(discs)):
        if discs[i, 2] > 0.0:
            return FINER
    return 1


@numba.njit(nogil=True, cache=True)
def act(  # type: ignore[no-untyped-def]
    state, interval, commands, command_parameters, forces, force_parameters, begin, end, signal,
    previous, command, wrench,
):  # fmt: skip
    """The wrench on each body in a substep: the command stage, then the force stage."""
    k = len(state)
    addresses, owners, first, memory = commands
    known = interval.shape[1] > 3
    for i in range(k):
        for w in range(3):
            command[i, w] = interval[i, w]
            previous[i, w] = interval[i, 3 + w] if known else 0.0
    signal[6], signal[7] = begin, end
    for e in range(len(addresses)):
        i = owners[e]
        state_at = state.ctypes.data + 48 * i
        parameters_at = command_parameters.ctypes.data + 8 * first[e]
        for w in range(3):
            signal[w], signal[3 + w] = command[i, w], previous[i, w]
        call_law(
            addresses[e], state_at, signal.ctypes.data, parameters_at, command.ctypes.data + 24 * i
        )
        if known and not memory[e]:
            for w in range(3):
                signal[w] = previous[i, w]
            call_law(
                addresses[e], state_at, signal.ctypes.data, parameters_at,
                previous.ctypes.data + 24 * i,
            )  # fmt: skip
    addresses, owners, first = forces
    for i in range(k):
        for w in range(3):
            wrench[i, w] = command[i, w]
    for e in range(len(addresses)):
        i = owners[e]
        call_law(
            addresses[e],
            state.ctypes.data + 48 * i,
            command.ctypes.data + 24 * i,
            force_parameters.ctypes.data + 8 * first[e],
            wrench.ctypes.data + 24 * i,
        )


@numba.njit(inline="always")  # a call costs as much as a substep: the world is many arrays
def _transition(  # type: ignore[no-untyped-def]
    fn, world, properties, joints, commands, command_parameters, forces, force_parameters, start,
    inputs, time_step, normal_gravity, substeps, room, out,
):  # fmt: skip
    """One transition of horizon H into ``out`` (H, body, 6); says what became of it."""
    k = len(world.bodies)
    step = time_step / substeps
    state, signal, previous, command, wrench, axes = room
    for i in range(k):
        for d in range(6):
            state[i, d] = start[i, d]
    bodies = properties[0]
    for j in range(len(axes)):
        turn = bodies[world.wheel_body[j], W_THETA]
        axes[j, 0], axes[j, 1] = math.cos(turn), math.sin(turn)
    touched = _FREE
    driven = world.kinematic.any()
    acting = len(commands[0]) + len(forces[0]) > 0
    sliding = len(world.patch_body) > 0
    watch = len(world.obstacles) > 0 or k > 1
    place_bodies(fn, world, bodies, state)
    for h in range(len(inputs)):
        if h > 0 and len(properties) > 1:
            bodies = properties[h]
            set_properties(fn, world, bodies, joints)
            place_bodies(fn, world, bodies, state)
            set_strengths(fn, world, bodies, normal_gravity, 1.0)
            call_int(fn.cpSpaceSetIterations, world.space, iterations(world, bodies))
        if driven:
            drive(fn, world, state, inputs[h])
        for i in range(k):
            for w in range(3):
                wrench[i, w] = inputs[h, i, w]
        for s in range(substeps):
            if acting:
                act(
                    state, inputs[h], commands, command_parameters, forces, force_parameters,
                    s / substeps, (s + 1) / substeps, signal, previous, command, wrench,
                )  # fmt: skip
            for i in range(k):
                if driven and world.kinematic[i]:
                    continue
                weight_x = bodies[i, MASS] * bodies[i, EXTRA_X]
                weight_y = bodies[i, MASS] * bodies[i, EXTRA_Y]
                call2(
                    fn.cpBodySetForce, world.bodies[i], wrench[i, 0] + weight_x,
                    wrench[i, 1] + weight_y,
                )  # fmt: skip
                x, y = arm(bodies[i], state[i, 2])
                torque = wrench[i, 2] - (x * wrench[i, 1] - y * wrench[i, 0])
                call1(fn.cpBodySetTorque, world.bodies[i], torque)
            place_wheels(fn, world, bodies, state, axes, step)
            if sliding:
                place_patches(fn, world, bodies, state, step, normal_gravity)
            call1(fn.cpSpaceStep, world.space, step)
            for i in range(k):
                body = world.bodies[i]
                state[i, 0], state[i, 1] = get2(fn.cpBodyGetPosition, body)
                state[i, 2] = get1(fn.cpBodyGetAngle, body)
                turn = get1(fn.cpBodyGetAngularVelocity, body)
                x, y = arm(bodies[i], state[i, 2])
                v_x, v_y = get2(fn.cpBodyGetVelocity, body)
                state[i, 3], state[i, 4], state[i, 5] = v_x + turn * y, v_y - turn * x, turn
                speed = abs(state[i, 3]) + abs(state[i, 4]) + abs(state[i, 5])
                if not speed < DIVERGED:  # also true of NaN
                    return _LOST
                if watch and touched == _FREE:
                    near = _near_contact(i, state, world.radii, world.obstacles, world.can_touch)
                    touched = _TOUCHED if near else _FREE
        out[h] = state
    return touched


@numba.njit(nogil=True, cache=True)
def rollout(  # type: ignore[no-untyped-def]
    fn, world, given, commands, forces, start, inputs, time_step, normal_gravity, counts, weights,
    items, out,
):  # fmt: skip
    """Predict ``items``, of proposals x transitions, into ``out``.

    ``given`` holds the arrays of an `EngineInput` but the indices; ``start`` is (1 or proposal,
    transition, body, 6). ``out`` has shape (proposal * transition, H, body, 6). The transition is
    run with each number of substeps in ``counts``, the finest first, and the weighted sum taken,
    which cancels the leading errors; where shapes came close the finest run stands alone: a
    collision's time is no smooth function of the substep. With hidden discs it is finer still.

    Returns the place among the items at which the engine diverged (its world is then of no more
    use), or their number.
    """
    bodies, joints, discs, command_parameters, force_parameters = given
    n, horizon = len(inputs), inputs.shape[1]
    scratch = np.empty((horizon, inputs.shape[2], 6))
    total = np.empty_like(scratch)
    timed = bodies.shape[1] > 1
    k = len(world.bodies)
    room = (
        np.empty((k, 6)), np.empty(8), np.empty((k, 3)), np.empty((k, 3)), np.empty((k, 3)),
        np.empty((len(world.wheel_body), 2)),
    )  # fmt: skip
    proposal, finer = -1, 1
    state = _TOUCHED  # what an earlier call left behind is unknown
    for place in range(len(items)):
        item = items[place]
        p, t = item // n, item % n
        properties = bodies[p, t * horizon : (t + 1) * horizon] if timed else bodies[p]
        if p != proposal:
            proposal = p
            set_properties(fn, world, properties[0], joints[p])
            set_discs(fn, world, discs[p])
            finer = _meeting(discs[p])
        total[:] = 0.0
        for level in range(len(counts)):
            before, substeps = state, counts[level]
            for _ in range(2):
                if timed:
                    set_properties(fn, world, properties[0], joints[p])
                _forget(fn, world, properties[0], normal_gravity, before)
                state = _transition(
                    fn, world, properties, joints[p], commands, command_parameters[p], forces,
                    force_parameters[p], start[p if len(start) > 1 else 0, t], inputs[t],
                    time_step, normal_gravity, substeps, room, scratch,
                )  # fmt: skip
                if substeps > counts[level] and state == _FREE:
                    state = _TOUCHED  # by a hair not: what stands alone is the same for all
                fine = substeps == counts[level] * finer
                if state != _TOUCHED or (before == _TOUCHED and fine):
                    break
                # contacts in the order of a new world: once more from there
                before, substeps = _TOUCHED, counts[level] * finer
            if state == _LOST:
                return place
            if level == 0:
                out[item] = scratch
            if state == _TOUCHED:
                break
            total += weights[level] * scratch
        if state == _FREE and len(counts) > 1:
            for i in range(k):
                if world.kinematic[i]:  # the weights' sum is 1 but for rounding
                    total[:, i] = out[item, :, i]
            out[item] = total
    return len(items)
