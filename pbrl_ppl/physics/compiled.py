"""The compiled rollout: what a world gets in a substep, and the loop, in machine code."""

from __future__ import annotations

import math

import numpy as np

from pbrl_ppl.physics.calls import (
    call1,
    call2,
    call_int,
    call_pointer,
    compiled,
    copy,
    from_place,
    get1,
    get2,
    inlined,
    inner,
    rotated,
    start_of,
)
from pbrl_ppl.physics.laws import (
    ACTED,
    COMMAND,
    MORE,
    WRENCHES,
    act,
    begin_held,
    bound,
    remember,
    set_memory,
    states_before,
)
from pbrl_ppl.physics.solids import near_contact, place_discs
from pbrl_ppl.physics.world import COLUMN, FINER, TINY

_FREE, _TOUCHED, _LOST = 0, 1, 2


@compiled
def iterations(fewest, chained, bodies, a_ratio=2, most=2000):  # type: ignore[no-untyped-def]
    """Return the solver iterations for the masses of these bodies: in proportion to their ratio.

    With fewer, a heavy link below a light one gains energy.
    """
    lightest, heaviest = np.inf, 0.0
    for i in range(len(chained)):
        if chained[i]:
            lightest = min(lightest, bodies[i, COLUMN.mass])
            heaviest = max(heaviest, bodies[i, COLUMN.mass])
    enough = min(a_ratio * (heaviest / lightest), most)
    return max(fewest, int(enough))


@inner
def _apply(settings, rows, normal_gravity):  # type: ignore[no-untyped-def]
    """Set properties of constraints by their rows of numbers."""
    for j in range(len(settings)):
        setting = settings[j]
        row, column = rows[setting.row], setting.column
        if setting.vector:
            x, y = row[column] * setting.scale_x, row[setting.column_y] * setting.scale_y
            call2(setting.function, setting.constraint, x, y)
        else:
            weight = row[COLUMN.mass] * normal_gravity if setting.weighted else 1.0
            call1(setting.function, setting.constraint, row[column] * weight)


@inner
def set_properties(fn, world, bodies, joints):  # type: ignore[no-untyped-def]
    """Set masses, moments, surfaces and anchors, but no strengths of constraints."""
    for i in range(len(world.bodies)):
        if world.kinematic[i]:
            continue
        body, row = world.bodies[i], bodies[i]
        call1(fn.cpBodySetMass, body, row[COLUMN.mass])
        call1(fn.cpBodySetMoment, body, row[COLUMN.moment])
        call2(fn.cpBodySetCenterOfGravity, body, row[COLUMN.com_x], row[COLUMN.com_y])
    for j in range(len(world.shapes)):
        row = bodies[world.shape_body[j]]
        call1(fn.cpShapeSetElasticity, world.shapes[j], row[COLUMN.r])
        call1(fn.cpShapeSetFriction, world.shapes[j], row[COLUMN.mu_c])
    _apply(world.body_settings, bodies, world.still.normal_gravity)
    _apply(world.joint_settings, joints, world.still.normal_gravity)


@inner
def set_solver(fn, world, bodies, on):  # type: ignore[no-untyped-def]
    """Set the solver's iterations and the constraints' greatest forces, or one and none.

    Patches get their forces as placed.
    """
    enough = iterations(world.iterations, world.chained, bodies)
    call_int(fn.cpSpaceSetIterations, world.space, enough if on else 1)
    for constraint in world.unlimited:
        call1(fn.cpConstraintSetMaxForce, constraint, np.inf if on else 0.0)
    for constraint in world.limited:
        call1(fn.cpConstraintSetMaxForce, constraint, 0.0)
    if on:
        _apply(world.strengths, bodies, world.still.normal_gravity)


@inner
def arm(row, theta):  # type: ignore[no-untyped-def]
    """Return the arm from a body's origin to its centre of mass, in the world's frame."""
    x, y = row[COLUMN.com_x], row[COLUMN.com_y]
    if x == 0.0 and y == 0.0:
        return 0.0, 0.0
    return rotated(math.cos(theta), math.sin(theta), x, y)


@compiled
def glide(row, state, step):  # type: ignore[no-untyped-def]
    """Return where a substep without forces takes a body: heading, centre of mass, its velocity."""
    x, y = arm(row, state[2])
    v_x, v_y = state[3] - state[5] * y, state[4] + state[5] * x
    theta = state[2] + state[5] * step
    x, y = state[0] + x + v_x * step, state[1] + y + v_y * step
    return math.cos(theta), math.sin(theta), x, y, v_x, v_y


@compiled
def wheel_ends(row, after, axis_cos, axis_sin):  # type: ignore[no-untyped-def]
    """Return the far ends of a wheel's rods: x and y of the one along it, of the one across."""
    c, s, x, y, _, _ = after
    w_x, w_y = row[COLUMN.w_x] - row[COLUMN.com_x], row[COLUMN.w_y] - row[COLUMN.com_y]
    w_x, w_y = rotated(c, s, w_x, w_y)
    c, s = rotated(c, s, axis_cos, axis_sin)
    x, y = x + w_x, y + w_y
    return x + c, y + s, x - s, y + c


@compiled
def patch_point(row, after, omega, point, step, most):  # type: ignore[no-untyped-def]
    """Return the far end of a point's rod, along its velocity, and the rod's share of the friction.

    ``point`` is in units of the ring's radius; ``most`` is the deceleration by friction (m/s^2). A
    point may stick if its speed is below what friction takes away in a substep.
    """
    c, s, at_x, at_y, v_x, v_y = after
    x = point[0] * row[COLUMN.patch_radius] - row[COLUMN.com_x]
    y = point[1] * row[COLUMN.patch_radius] - row[COLUMN.com_y]
    x, y = rotated(c, s, x, y)
    along_x, along_y = v_x - omega * y, v_y + omega * x
    speed = math.sqrt(along_x * along_x + along_y * along_y)
    # with a tenth of it, slow points would stick across their direction now and then
    slow = most * step
    share = 1.0 if speed >= slow else speed / slow
    if speed == 0.0:  # at rest any direction will do
        along_x, speed = 1.0, 1.0
    return at_x + x + along_x / speed, at_y + y + along_y / speed, share


@compiled
def hinge_signal(pivots, gravity, row, joints, state, command, i):  # type: ignore[no-untyped-def]
    """Return what laws of friction see in the hinge or slider of body ``i``, by its row and state.

    The commanded torque, that of the weight, and the speed. Of a slider the commanded force and the
    speed alone. ``pivots`` have a hinge's body, its joint and the column of its anchor on the body.
    """
    torque, rest = math.sqrt(command[0] ** 2 + command[1] ** 2), 0.0
    speed = math.sqrt(state[3] ** 2 + state[4] ** 2)
    for hinge in pivots:
        if hinge[0] == i:
            x = row[COLUMN.com_x] - joints[hinge[1], hinge[2]]
            y = row[COLUMN.com_y] - joints[hinge[1], hinge[2] + 1]
            x, y = rotated(math.cos(state[2]), math.sin(state[2]), x, y)
            weight_x = gravity[0] + row[COLUMN.extra_gravity_x]
            weight_y = gravity[1] + row[COLUMN.extra_gravity_y]
            rest = row[COLUMN.mass] * (x * weight_y - y * weight_x)
            torque, speed = command[2], abs(state[5])
    return torque, rest, speed


@compiled
def patch_signal(row, state, normal_gravity):  # type: ignore[no-untyped-def]
    """Return the greatest friction under a body but for laws, and the speed that they see."""
    turned = state[5] * row[COLUMN.patch_radius]
    speed = math.sqrt(state[3] ** 2 + state[4] ** 2 + turned**2)
    return row[COLUMN.patch_mu] * row[COLUMN.mass] * normal_gravity, speed


@inner
def place_bodies(fn, world, bodies, state):  # type: ignore[no-untyped-def]
    """Set the bodies' states; the engine's velocity is that of the centre of mass."""
    for i in range(len(world.bodies)):
        body, (x, y) = world.bodies[i], arm(bodies[i], state[i, 2])
        call1(fn.cpBodySetAngle, body, state[i, 2])  # first: the centre's place depends on it
        call2(fn.cpBodySetPosition, body, state[i, 0], state[i, 1])
        turn = state[i, 5]
        call2(fn.cpBodySetVelocity, body, state[i, 3] - turn * y, state[i, 4] + turn * x)
        call1(fn.cpBodySetAngularVelocity, body, turn)


@inner
def set_discs(fn, world, discs):  # type: ignore[no-untyped-def]
    """Place the hidden discs.

    They are removed and added again, since the order of contacts depends on their earlier places.
    """
    for j in range(len(world.discs)):
        call_pointer(fn.cpSpaceRemoveShape, world.space, world.discs[j])
    if len(world.discs):
        for _ in range(-len(world.discs) % (world.padding + len(world.shapes))):
            # the numbers of the moving shapes go on from a multiple: see World._add_shapes
            call_pointer(fn.cpSpaceAddShape, world.space, world.discs[0])
            call_pointer(fn.cpSpaceRemoveShape, world.space, world.discs[0])
    for j in range(len(world.discs)):
        x, y, radius = discs[j, 0], discs[j, 1], discs[j, 2]
        if not radius > 0.0:
            x, y, radius = -world.far, -world.far * (j + 1.0), 0.0
        call2(fn.cpCircleShapeSetOffset, world.discs[j], x, y)
        call1(fn.cpCircleShapeSetRadius, world.discs[j], radius)
        call_pointer(fn.cpSpaceAddShape, world.space, world.discs[j])
    place_discs(world.still, discs)


@inner
def place_wheels(fn, world, bodies, state, axes, step):  # type: ignore[no-untyped-def]
    """Put the rods' ends on the wheels' axes as predicted for the end of the substep."""
    for j in range(len(world.wheel_body)):
        row, body = bodies[world.wheel_body[j]], state[world.wheel_body[j]]
        x_1, y_1, x_2, y_2 = wheel_ends(row, glide(row, body, step), axes[j, 0], axes[j, 1])
        call2(fn.cpPinJointSetAnchorB, world.wheels[0, j], x_1, y_1)
        call2(fn.cpPinJointSetAnchorB, world.wheels[1, j], x_2, y_2)


@inner
def place_patches(fn, world, laws, bodies, state, step, acted):  # type: ignore[no-untyped-def]
    """Put each point's rod along its velocity; split its friction with the pivot joint."""
    for j in range(len(world.patch_body)):
        k = world.patch_body[j]
        row, body = bodies[k], state[k]
        after = glide(row, body, step)
        most, speed = patch_signal(row, body, world.still.normal_gravity)
        most = bound(most, laws, k, 1, state, 0.0, 0.0, speed, acted)
        slowing, most = most / row[COLUMN.mass], most / len(world.still.ring)
        for i in range(len(world.still.ring)):
            x, y, share = patch_point(row, after, body[5], world.still.ring[i], step, slowing)
            call2(fn.cpPinJointSetAnchorB, world.patches[1, j, i], x, y)
            call1(fn.cpConstraintSetMaxForce, world.patches[0, j, i], (1.0 - share) * most)
            call1(fn.cpConstraintSetMaxForce, world.patches[1, j, i], share * most)


@inner
def set_brakes(world, laws, bodies, joints, state, acted):  # type: ignore[no-untyped-def]
    """Set the greatest torque of friction in hinges where laws change it."""
    for j in range(len(world.strengths)):
        setting = world.strengths[j]
        i = setting.row
        if setting.column == COLUMN.pivot_torque:
            torque, rest, speed = hinge_signal(
                world.pivots, world.still.gravity, bodies[i], joints, state[i], acted[i], i
            )
            base = bodies[i, COLUMN.pivot_torque]
            most = bound(base, laws, i, 0, state, torque, rest, speed, acted)
            call1(setting.function, setting.constraint, most)


@inner
def drive(fn, world, state, action):  # type: ignore[no-untyped-def]
    """Set the velocities of kinematic bodies for the interval that begins."""
    for i in range(len(world.bodies)):
        if world.kinematic[i]:
            for w in range(3):
                state[i, 3 + w] = action[i, w]
            call2(fn.cpBodySetVelocity, world.bodies[i], action[i, 0], action[i, 1])
            call1(fn.cpBodySetAngularVelocity, world.bodies[i], action[i, 2])


@inlined
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
    set_solver(fn, world, bodies, False)
    call1(fn.cpSpaceStep, world.space, TINY * batch.time_step)
    set_solver(fn, world, bodies, True)


@inner
def properties_in(rows, p, t, h, horizon):  # type: ignore[no-untyped-def]
    """Return the bodies' properties in an interval of a transition."""
    return rows[p, t * horizon + h if rows.shape[1] > 1 else 0]


@inlined
def _push(fn, world, bodies, state, acted):  # type: ignore[no-untyped-def]
    """Set the forces and torques of a substep, which act at the bodies' origins."""
    for i in range(len(world.bodies)):
        if world.kinematic[i]:
            continue
        weight_x = bodies[i, COLUMN.mass] * bodies[i, COLUMN.extra_gravity_x]
        weight_y = bodies[i, COLUMN.mass] * bodies[i, COLUMN.extra_gravity_y]
        f_x, f_y = acted[i, WRENCHES], acted[i, WRENCHES + 1]
        call2(fn.cpBodySetForce, world.bodies[i], f_x + weight_x, f_y + weight_y)
        x, y = arm(bodies[i], state[i, 2])
        torque = acted[i, WRENCHES + 2] - (x * f_y - y * f_x)
        call1(fn.cpBodySetTorque, world.bodies[i], torque)


@inlined
def _read(fn, world, bodies, state):  # type: ignore[no-untyped-def]
    """Set the states of the bodies' origins from the engine; return whether one has diverged."""
    lost = False
    for i in range(len(world.bodies)):
        body = world.bodies[i]
        state[i, 0], state[i, 1] = get2(fn.cpBodyGetPosition, body)
        state[i, 2] = get1(fn.cpBodyGetAngle, body)
        turn = get1(fn.cpBodyGetAngularVelocity, body)
        x, y = arm(bodies[i], state[i, 2])
        v_x, v_y = get2(fn.cpBodyGetVelocity, body)
        state[i, 3], state[i, 4], state[i, 5] = v_x + turn * y, v_y - turn * x, turn
        speed = abs(state[i, 3]) + abs(state[i, 4]) + world.still.length * abs(turn)
        lost |= not speed < world.still.fastest  # also true of NaN
    return lost


@inner
def _scratch_of(world, laws):  # type: ignore[no-untyped-def]
    """Return the arrays of a transition.

    They are states (body, 6), cos and sin of the wheels' angles on the bodies (wheel, 2), what acts
    (body + 4, 12), what laws remember (2, slot), where that was last (2,), and their own numbers
    (2, slot): see `act` and `set_memory`.
    """
    k = len(world.bodies)
    return (
        np.empty((k, 6)), np.empty((len(world.wheel_body), 2)), np.zeros((k + MORE, ACTED)),
        np.zeros((2, laws.n_slots)), np.full(2, -1), np.zeros((2, laws.n_held)),
    )  # fmt: skip


@inlined
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
    rows, joints = batch.given[0], batch.given[1][p]
    bodies = properties_in(rows, p, t, begin, len(inputs))
    copy(first, state)
    for j in range(len(axes)):
        turn = bodies[world.wheel_body[j], COLUMN.w_theta]
        axes[j, 0], axes[j, 1] = math.cos(turn), math.sin(turn)
    touched, near, driven = _FREE, False, world.kinematic.any()
    acting = laws.n_commands + laws.n_forces > 0
    remembered = from_place(start_of(memory), laws.n_slots)
    state_at, acted_at, held_at = start_of(state), start_of(acted), start_of(held)
    still = world.still
    place_bodies(fn, world, bodies, state)
    set_memory(batch, laws, p, t, begin, state, acted, memory, at)
    begin_held(state, laws, acted, held)
    while end < len(inputs) and (whole or near or end == begin):
        h = end
        if h > begin and rows.shape[1] > 1:
            bodies = properties_in(rows, p, t, h, len(inputs))
            set_properties(fn, world, bodies, joints)
            place_bodies(fn, world, bodies, state)
            set_solver(fn, world, bodies, True)
        inputs_at = start_of(inputs[h])
        if driven:
            drive(fn, world, state, inputs[h])
        for i in range(k):
            for w in range(3):
                acted[i, COMMAND + w] = acted[i, WRENCHES + w] = inputs[h, i, w]
        for s in range(substeps):
            near = False
            if acting:
                act(
                    state_at, inputs_at, laws, s / substeps, (s + 1) / substeps, acted_at,
                    remembered, held_at, from_place(held_at, laws.n_held),
                )  # fmt: skip
                for slot in range(laws.n_held):
                    held[0, slot] += step * held[1, slot]
            if laws.n_frictions > 0:
                set_brakes(world, laws, bodies, joints, state, acted)
            _push(fn, world, bodies, state, acted)
            place_wheels(fn, world, bodies, state, axes, step)
            if len(world.patch_body) > 0:
                place_patches(fn, world, laws, bodies, state, step, acted)
            call1(fn.cpSpaceStep, world.space, step)
            if _read(fn, world, bodies, state):
                return _LOST, end
            if still.watched and (touched == _FREE or not whole):
                near = near_contact(state, still.radii, still.obstacles, still.can_touch)
                touched = _TOUCHED if near else touched
        copy(state, out[h])
        if laws.n_slots > 0:
            remember(state, inputs_at, laws, acted, remembered)
        end += 1
    return touched, end


@inner
def _add(states, weight, first, total):  # type: ignore[no-untyped-def]
    """Add weighted states (H, body, 6) to a total, which the first begin."""
    for h in range(len(total)):
        for i in range(total.shape[1]):
            for d in range(6):
                before = 0.0 if first else total[h, i, d]
                total[h, i, d] = before + weight * states[h, i, d]


@compiled
def rollout_engine(fn, world, batch, items, begins, whole, out):  # type: ignore[no-untyped-def]
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
    scratch = _scratch_of(world, batch.laws[0])
    proposal, finer = -1, 1
    outcome = _TOUCHED  # an earlier call may have left contacts
    for place in range(len(items)):
        item = items[place]
        p, t = item // n, item % n
        begin, laws = begins[place], batch.laws[p]
        first = properties_in(bodies, p, t, begin, horizon)
        before_begin = states_before(batch, out, item, begin)
        if p != proposal:
            proposal = p
            set_properties(fn, world, first, joints[p])
            set_discs(fn, world, discs[p])
            finer = 1
            for disc in discs[p]:
                finer = FINER if disc[2] > 0.0 else finer
        for level in range(len(batch.counts)):
            before, substeps = outcome, batch.counts[level]
            if not whole:  # near others: with the contacts in the order of a new world
                before, substeps = _TOUCHED, substeps * finer
            for _ in range(2):
                if timed:
                    set_properties(fn, world, first, joints[p])
                _forget(fn, world, first, batch, before)
                outcome, end = _transition(
                    fn, world, batch, laws, p, t, substeps, scratch, before_begin, begin, whole,
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
            _add(states, batch.weights[level], level == 0, total)
        if whole and outcome == _FREE and len(batch.counts) > 1:
            for i in range(len(world.bodies)):
                if world.kinematic[i]:  # the weights' sum is 1 but for rounding
                    copy(out[item, :, i], total[:, i])
            for h in range(horizon):
                copy(total[h], out[item, h])
    return len(items)
