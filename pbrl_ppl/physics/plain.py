"""The slow reference rollout in plain Python: a new engine world for each transition."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pymunk

from pbrl_ppl.effects import Attached, Command, Force, at_stage
from pbrl_ppl.physics.properties import COLUMN, EngineInput
from pbrl_ppl.physics.setters import glide, iterations, patch_point, wheel_ends
from pbrl_ppl.physics.solids import near_contact
from pbrl_ppl.physics.world import RING, World
from pbrl_ppl.state import Floats

_EXTRA = [COLUMN.extra_gravity_x, COLUMN.extra_gravity_y]


def rollout(
    world: World,
    effects: tuple[Attached, ...],
    numbers: EngineInput,
    proposal: int,
    item: int,
    start: Floats,
    inputs: Floats,
    substeps: int,
) -> tuple[Floats, bool]:
    """Step one transition of horizon H through a new world.

    Parameters
    ----------
    world : World
        A new one.
    effects : tuple of Attached
        Effects, whose command and force laws act every substep.
    numbers : EngineInput
        The engine's numbers of all proposals.
    proposal, item : int
        Indices of the proposal and of the transition.
    start : ndarray
        Start state, shape (body, 6), SI units.
    inputs : ndarray
        Inputs of each interval, shape (H, body, 3 or 9): wrenches in N and N m (of a kinematic
        body, velocities in m/s and rad/s), and the rest as in :data:`pbrl_ppl.state.INPUT`.
    substeps : int
        Engine steps in an interval.

    Returns
    -------
    states : ndarray
        State at the end of each interval, shape (H, body, 6).
    touched : bool
        Whether shapes came into contact.
    """
    world.check_steps()
    properties, joints = numbers.bodies[proposal], numbers.joints[proposal]
    timed = len(properties) > 1
    bodies = properties[item * len(inputs) if timed else 0]
    set_properties(world, bodies, joints)
    set_discs(world, numbers.discs[proposal])
    _place_bodies(world, start)
    names = [body.name for body in world.scene.moving]
    commands = list(_laws(effects, Command, numbers.commands[proposal], names))
    forces = list(_laws(effects, Force, numbers.forces[proposal], names))
    step = world.scene.time_step / substeps
    states = np.empty((len(inputs), len(names), 6))
    touched, nearness = False, (world.radii, world.obstacles, world.can_touch)
    for h, interval in enumerate(inputs):
        if timed and h > 0:
            bodies = properties[item * len(inputs) + h]
            set_properties(world, bodies, joints)
            _place_bodies(world, states[h - 1])
        for i, body in enumerate(world.bodies):
            if world.kinematic[i]:
                body.velocity, body.angular_velocity = tuple(interval[i, :2]), interval[i, 2]
        now = _states(world)
        for s in range(substeps):
            command = interval[:, :3].copy()
            previous = interval[:, 3:6].copy() if interval.shape[1] > 3 else None
            phase = s / substeps, (s + 1) / substeps
            for i, stage, parameters in commands:
                before = np.zeros(3) if previous is None else previous[i]
                stage.law(now[i], np.array([*command[i], *before, *phase]), parameters, command[i])
                if previous is not None and not stage.memory:
                    signal = np.array([*before, *before, *phase])
                    stage.law(now[i], signal, parameters, previous[i])
            wrench = command.copy()
            for i, stage, parameters in forces:
                stage.law(now[i], command[i], parameters, wrench[i])
            for i, body in enumerate(world.bodies):
                if world.kinematic[i]:
                    continue
                weight = bodies[i, COLUMN.mass] * bodies[i, _EXTRA]
                x, y = _arm(body)
                body.force = tuple(wrench[i, :2] + weight)
                body.torque = wrench[i, 2] - (x * wrench[i, 1] - y * wrench[i, 0])
            _place_constraints(world, bodies, now, step)
            world.space.step(step)
            now = _states(world)
            touched = touched or bool(near_contact(now, *nearness))
            speeds = np.abs(now[:, 3:])
            if not (speeds @ (1.0, 1.0, world.size) < world.fastest).all():  # also true of NaN
                states[:] = np.nan
                return states, True
        states[h] = now
    return states, touched


def _laws(
    effects: tuple[Attached, ...], kind: type, parameters: Floats, names: list[str]
) -> Iterator[tuple[int, Any, Floats]]:
    """Yield body, stage and parameters of each law of a kind of stage."""
    first = 0
    for attached in at_stage(effects, kind):
        last = first + len(attached.effect.parameters)
        yield names.index(attached.body), attached.effect.stage, parameters[first:last]
        first = last


def _place_bodies(world: World, states: Floats) -> None:
    """Set the bodies' states; the engine's velocity is that of the centre of mass."""
    for body, state in zip(world.bodies, states, strict=True):
        body.angle = state[2]  # first: the centre's place depends on it
        body.position = tuple(state[:2])
        x, y = _arm(body)
        body.velocity = state[3] - state[5] * y, state[4] + state[5] * x
        body.angular_velocity = state[5]


def _arm(body: pymunk.Body) -> tuple[float, float]:
    """Return the arm from a body's origin to its centre of mass, in the world's frame."""
    x, y = body.center_of_gravity
    c, s = math.cos(body.angle), math.sin(body.angle)
    return c * x - s * y, s * x + c * y


def _states(world: World) -> Floats:
    """Return the states of the bodies' origins, shape (body, 6)."""
    states = np.empty((len(world.bodies), 6))
    for body, state in zip(world.bodies, states, strict=True):
        (x, y), turn, velocity = _arm(body), body.angular_velocity, body.velocity
        state[:3] = *body.position, body.angle
        state[3:] = velocity.x + turn * y, velocity.y - turn * x, turn
    return states


def set_discs(world: World, discs: Floats) -> None:
    """Place the hidden discs: x, y and radius, shape (disc, 3). A radius of 0 is no disc.

    They are removed and added again, since the order of contacts depends on the earlier places of
    static shapes.
    """
    first = len(world.obstacles) - len(world.discs)
    world.space.remove(*world.discs)
    for j, (shape, (x, y, radius)) in enumerate(zip(world.discs, discs, strict=True)):
        if not radius > 0:
            x, y, radius = -world.far, -world.far * (j + 1), 0.0
        shape.unsafe_set_offset((x, y))
        shape.unsafe_set_radius(radius)
        world.space.add(shape)
        world.obstacles[first + j] = x, y, x, y, radius


def set_properties(world: World, bodies: Floats, joints: Floats) -> None:
    """Set the engine's properties; shapes (body, column) and (joint, column)."""
    world.space.iterations = iterations(world.iterations, world.chained, bodies)
    for body, row, kinematic in zip(world.bodies, bodies, world.kinematic, strict=True):
        if not kinematic:
            body.mass, body.moment = row[COLUMN.mass], row[COLUMN.moment]
            body.center_of_gravity = row[COLUMN.com_x], row[COLUMN.com_y]
    for i, shape in world.shapes:
        shape.elasticity, shape.friction = bodies[i, COLUMN.r], bodies[i, COLUMN.mu_c]
    for rows, settings in ((bodies, world.body_settings), (joints, world.joint_settings)):
        for constraint, setting, i, scale in settings:
            value = tuple(rows[i, setting.columns])
            if len(value) == 2:
                value = value[0] * scale[0], value[1] * scale[1]
                setattr(constraint, setting.attribute, value)
            else:
                load = (
                    rows[i, COLUMN.mass] * world.scene.normal_gravity if setting.weighted else 1.0
                )
                setattr(constraint, setting.attribute, value[0] * load)


def _place_constraints(world: World, bodies: Floats, states: Floats, step: float) -> None:
    """Put the far ends of rods where the substep is predicted to end; split a patch's friction."""
    for i, (along_x,), (along_y,) in world.wheels:
        after, turn = glide(bodies[i], states[i], step), bodies[i, COLUMN.w_theta]
        x_1, y_1, x_2, y_2 = wheel_ends(bodies[i], after, math.cos(turn), math.sin(turn))
        along_x.anchor_b, along_y.anchor_b = (x_1, y_1), (x_2, y_2)
    for i, holds, rods in world.patches:
        row, after = bodies[i], glide(bodies[i], states[i], step)
        slowing = row[COLUMN.patch_mu] * world.scene.normal_gravity
        most = slowing * row[COLUMN.mass] / len(RING)
        for point, hold, rod in zip(RING, holds, rods, strict=True):
            x, y, share = patch_point(row, after, states[i, 5], point, step, slowing)
            rod.anchor_b = x, y
            hold.max_force, rod.max_force = (1.0 - share) * most, share * most
