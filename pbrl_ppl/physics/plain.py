"""The slow reference rollout in plain Python: a new engine world for each transition."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pymunk

from pbrl_ppl.effects import Attached, Command, Force, at_stage
from pbrl_ppl.physics.properties import COLUMN, EngineInput
from pbrl_ppl.physics.world import RING, STICKING, World
from pbrl_ppl.state import Floats

_EXTRA = [COLUMN.extra_gravity_x, COLUMN.extra_gravity_y]


def rollout(
    world: World,
    effects: tuple[Attached, ...],
    given: EngineInput,
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
    given : EngineInput
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
    properties, joints = given.bodies[proposal], given.joints[proposal]
    timed = len(properties) > 1
    bodies = properties[item * len(inputs) if timed else 0]
    world.set_properties(bodies, joints)
    world.set_discs(given.discs[proposal])
    _place_bodies(world, start)
    names = [body.name for body in world.scene.moving]
    commands = list(_laws(effects, Command, given.commands[proposal], names))
    forces = list(_laws(effects, Force, given.forces[proposal], names))
    step = world.scene.time_step / substeps
    states = np.empty((len(inputs), len(names), 6))
    touched = False
    for h, interval in enumerate(inputs):
        if timed and h > 0:
            bodies = properties[item * len(inputs) + h]
            world.set_properties(bodies, joints)
            _place_bodies(world, states[h - 1])
        for i, body in enumerate(world.bodies):
            if world.kinematic[i]:
                body.velocity, body.angular_velocity = tuple(interval[i, :2]), interval[i, 2]
        for s in range(substeps):
            command = interval[:, :3].copy()
            previous = interval[:, 3:6].copy() if interval.shape[1] > 3 else None
            phase = s / substeps, (s + 1) / substeps
            for i, stage, parameters in commands:
                state = _state(world, i)
                before = np.zeros(3) if previous is None else previous[i]
                stage.law(state, np.array([*command[i], *before, *phase]), parameters, command[i])
                if previous is not None and not stage.memory:
                    signal = np.array([*before, *before, *phase])
                    stage.law(state, signal, parameters, previous[i])
            wrench = command.copy()
            for i, stage, parameters in forces:
                stage.law(_state(world, i), command[i], parameters, wrench[i])
            for i, body in enumerate(world.bodies):
                if world.kinematic[i]:
                    continue
                weight = bodies[i, COLUMN.mass] * bodies[i, _EXTRA]
                x, y = _arm(body)
                body.force = tuple(wrench[i, :2] + weight)
                body.torque = wrench[i, 2] - (x * wrench[i, 1] - y * wrench[i, 0])
            _place_wheels(world, bodies, step)
            _place_patches(world, bodies, step)
            world.space.step(step)
            touched = touched or near_contact(world)
            speeds = np.abs([_state(world, i)[3:] for i in range(len(names))])
            if not (speeds @ (1.0, 1.0, world.size) < world.fastest).all():  # also true of NaN
                states[:] = np.nan
                return states, True
        for i in range(len(names)):
            states[h, i] = _state(world, i)
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


def _state(world: World, i: int) -> Floats:
    """Return the state of a body's origin, shape (6,)."""
    body = world.bodies[i]
    x, y = _arm(body)
    turn = body.angular_velocity
    velocity = body.velocity.x + turn * y, body.velocity.y - turn * x
    return np.array([*body.position, body.angle, *velocity, turn], dtype=float)


def _centre(world: World, i: int) -> Floats:
    """Return the state of the centre of mass, which moves straight in a substep."""
    body = world.bodies[i]
    place = body.local_to_world(body.center_of_gravity)
    return np.array([*place, body.angle, *body.velocity, body.angular_velocity], dtype=float)


def _place_wheels(world: World, bodies: Floats, step: float) -> None:
    """Put the rods' ends on the wheels' axes as predicted for the end of the substep."""
    for wheel in world.wheels:
        row = bodies[wheel.body]
        at_x, at_y, angle, v_x, v_y, omega = _centre(world, wheel.body)
        theta = angle + omega * step
        c, s = math.cos(theta), math.sin(theta)
        x, y = row[COLUMN.w_x] - row[COLUMN.com_x], row[COLUMN.w_y] - row[COLUMN.com_y]
        at_x, at_y = at_x + v_x * step + c * x - s * y, at_y + v_y * step + s * x + c * y
        c, s = math.cos(theta + row[COLUMN.w_theta]), math.sin(theta + row[COLUMN.w_theta])
        wheel.along_x.anchor_b, wheel.along_y.anchor_b = (at_x + c, at_y + s), (at_x - s, at_y + c)


def _place_patches(world: World, bodies: Floats, step: float) -> None:
    """Put each point's rod along its velocity; split its friction with the pivot joint."""
    for patch in world.patches:
        row = bodies[patch.body]
        at_x, at_y, angle, v_x, v_y, omega = _centre(world, patch.body)
        radius = row[COLUMN.patch_radius]
        slowing = row[COLUMN.patch_mu] * world.scene.normal_gravity
        most = slowing * row[COLUMN.mass] / len(RING)
        theta = angle + omega * step
        c, s = math.cos(theta), math.sin(theta)
        for (x, y), hold, rod in zip(RING, patch.holds, patch.rods, strict=True):
            x, y = x * radius - row[COLUMN.com_x], y * radius - row[COLUMN.com_y]
            x, y = c * x - s * y, s * x + c * y
            along_x, along_y = v_x - omega * y, v_y + omega * x
            speed = math.sqrt(along_x * along_x + along_y * along_y)
            slow = STICKING * slowing * step
            share = 1.0 if speed >= slow else speed / slow
            if speed == 0.0:  # at rest any direction will do
                along_x, speed = 1.0, 1.0
            rod.anchor_b = (
                at_x + v_x * step + x + along_x / speed,
                at_y + v_y * step + y + along_y / speed,
            )
            hold.max_force, rod.max_force = (1.0 - share) * most, share * most


def near_contact(world: World) -> bool:
    """Return whether bounding circles reach a wall or each other, as the compiled path does."""
    for i, body in enumerate(world.bodies):
        x, y = body.position
        for segment in world.obstacles:
            ax, ay, bx, by, radius = segment
            dx, dy = bx - ax, by - ay
            length = dx * dx + dy * dy
            t = min(1.0, max(0.0, ((x - ax) * dx + (y - ay) * dy) / length)) if length else 0.0
            reach = world.radii[i] + radius
            if (x - ax - t * dx) ** 2 + (y - ay - t * dy) ** 2 <= reach * reach:
                return True
        for j in range(i):
            if world.can_touch[i, j]:
                ox, oy = world.bodies[j].position
                reach = world.radii[i] + world.radii[j]
                if (x - ox) ** 2 + (y - oy) ** 2 <= reach * reach:
                    return True
    return False
