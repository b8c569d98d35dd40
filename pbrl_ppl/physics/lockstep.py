"""Contact-free fast path: many transitions at once, in the engine's arithmetic.

Bodies that touch nothing need no collision search: positions, forces and the solver's clipped
impulses are a few lines, which the compiler vectorises over transitions. They are those of
Chipmunk's ``cpSpaceStep``, in its order, so that the results agree to rounding.

A solver that has not converged depends on the order of its constraints and on the number of
iterations: the engine's order is kept, and each transition has the iterations that the engine takes
for its masses.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics.compilation import compiled
from pbrl_ppl.physics.compiled import act
from pbrl_ppl.physics.joints import ROD
from pbrl_ppl.physics.lockstep_bodies import (
    BLOCK,
    BODY,
    align,
    get_state,
    lever,
    lose,
    set_body,
    set_state,
    set_wrench,
    watch,
)
from pbrl_ppl.physics.lockstep_friction import POINT
from pbrl_ppl.physics.lockstep_joints import (
    JOINT,
    Block,
    Joints,
    set_constraints,
    set_joints,
    substep,
)
from pbrl_ppl.physics.world import RING, World


class FreeWorld(NamedTuple):
    """A world whose bodies touch nothing, for the contact-free fast path."""

    chained: NDArray[np.bool_]  # (body,)
    iterations: int  # the fewest
    gravity: NDArray[np.float64]  # (2,)
    normal_gravity: float
    size: float  # of the smallest moving body (m)
    fastest: float  # speed of divergence (m/s)
    wheel: NDArray[np.bool_]  # (body,)
    patch_body: NDArray[np.int64]
    ring: NDArray[np.float64]  # (point, 2)
    radii: NDArray[np.float64]  # (body,)
    can_touch: NDArray[np.bool_]  # (body, body)
    obstacles: NDArray[np.float64]  # (obstacle, 5), without the discs


def free_world(world: World) -> FreeWorld | None:
    """Describe a world; None where a body follows a path, or a joint has no such arithmetic."""
    if world.kinematic.any() or not all(link.kind.contact_free for link in world.links):
        return None
    wheels = [wheel.body for wheel in world.wheels]
    return FreeWorld(
        chained=world.chained,
        iterations=world.iterations,
        gravity=np.array(world.space.gravity, dtype=float),
        normal_gravity=world.scene.normal_gravity,
        size=world.size,
        fastest=world.fastest,
        wheel=np.isin(np.arange(len(world.bodies)), wheels),
        patch_body=np.array([patch.body for patch in world.patches], dtype=np.int64),
        ring=np.array(RING),
        radii=world.radii,
        can_touch=world.can_touch,
        obstacles=world.obstacles[: len(world.obstacles) - len(world.discs)].copy(),
    )


def joints_of(world: World) -> Joints | None:
    """Describe the joints of a world; None where it has none."""
    if not world.links:
        return None
    ends, poses = [], []
    for link in world.links:
        pair = link.constraint.a, link.constraint.b
        ends.append([world.bodies.index(body) if body in world.bodies else -1 for body in pair])
        holder = pair[ends[-1].index(-1)] if -1 in ends[-1] else world.space.static_body
        poses.append((*holder.position, math.cos(holder.angle), math.sin(holder.angle)))
    pairs = np.array(ends, dtype=np.int64)
    turned = pairs[:, 1] < 0
    return Joints(
        values=np.zeros((len(pairs), BLOCK * len(JOINT))),
        rough=np.zeros(len(pairs), dtype=bool),
        row=np.array([link.joint for link in world.links], dtype=np.int64),
        rod=np.array([link.kind is ROD for link in world.links], dtype=bool),
        ends=np.where(turned[:, None], pairs[:, ::-1], pairs),
        turned=turned,
        pose=np.array(poses, dtype=float),
        pivot=np.array([link.pivot for link in world.links], dtype=np.int64),
    )


@compiled
def rollout(world, joints, batch, items, out, left):  # type: ignore[no-untyped-def]
    """Predict ``items`` as `compiled.rollout` does, and mark those that the engine must predict.

    ``left``, shape (item,), is set for items that come near an obstacle or diverge. A block takes
    as long as the transition of the most iterations: items of similar numbers should be neighbours.
    ``joints`` is None where there are none: their arithmetic takes most of the compilation.
    """
    rows, _, discs, command_parameters, force_parameters = batch.given
    start, inputs = batch.start, batch.inputs
    n, horizon, moving = len(inputs), inputs.shape[1], len(world.radii)
    timed = rows.shape[1] > 1
    commands, forces = batch.commands, batch.forces
    acting = len(commands[0]) + len(forces[0]) > 0
    watched = len(world.obstacles) + discs.shape[1] > 0 or world.can_touch.sum() > moving
    bodies = np.zeros((moving + 1, BLOCK * len(BODY)))  # the last is fixed
    patches = np.zeros((len(world.patch_body), len(world.ring), BLOCK * len(POINT)))
    slowing, radius = np.zeros((2, len(patches), BLOCK))
    block = Block(bodies, patches, slowing, radius, np.full(BLOCK, world.iterations))
    own_discs = np.zeros((BLOCK, discs.shape[1], 3))
    touched = np.zeros(BLOCK, dtype=np.bool_)
    proposal, transition, interval = np.zeros((3, BLOCK), dtype=np.int64)
    states, signal = np.empty((moving, 6)), np.empty(8)
    previous, command, wrench = np.empty((3, moving, 3))
    for begin in range(0, len(items), BLOCK):
        width = min(BLOCK, len(items) - begin)
        touched[:] = False
        for i in range(BLOCK):
            item = items[begin + min(i, width - 1)]  # the rest of a block repeats the last
            proposal[i], transition[i] = item // n, item % n
            for j in range(discs.shape[1]):
                for d in range(3):
                    own_discs[i, j, d] = discs[proposal[i], j, d]
        for level in range(len(batch.counts)):
            substeps, weight = batch.counts[level], batch.weights[level]
            step = batch.time_step / substeps
            bodies[:], patches[:] = 0.0, 0.0
            if joints is not None:
                joints.values[:] = 0.0
            shifted = False
            for h in range(horizon):
                if timed:
                    interval[:] = transition * horizon + h
                for k in range(moving):
                    body, wheel = bodies[k], world.wheel[k]
                    for i in range(BLOCK):
                        p, t = proposal[i], transition[i]
                        if timed or h == 0:
                            row = rows[p, interval[i], k]
                            if h == 0:
                                for d in range(6):
                                    states[k, d] = start[p if len(start) > 1 else 0, t, k, d]
                            else:
                                get_state(body, i, states, k)
                            shifted |= set_body(body, i, row, wheel, world.normal_gravity, step)
                            set_state(body, i, states, k)
                        else:
                            align(body, i)
                        force_x, force_y = inputs[t, h, k, 0], inputs[t, h, k, 1]
                        set_wrench(body, i, force_x, force_y, inputs[t, h, k, 2])
                if timed or h == 0:
                    set_constraints(block, world, batch, proposal, interval)
                    if joints is not None:
                        set_joints(block, joints, batch, proposal, interval, step)
                for s in range(substeps):
                    if acting:
                        for i in range(width):
                            p, t = proposal[i], transition[i]
                            for k in range(moving):
                                get_state(bodies[k], i, states, k)
                            act(
                                states, inputs[t, h], commands, command_parameters[p], forces,
                                force_parameters[p], s / substeps, (s + 1) / substeps, signal,
                                previous, command, wrench,
                            )  # fmt: skip
                            for k in range(moving):
                                set_wrench(bodies[k], i, wrench[k, 0], wrench[k, 1], wrench[k, 2])
                    if shifted:
                        for k in range(moving):
                            lever(bodies[k])
                    substep(block, joints, world, step)
                    for k in range(moving):
                        lose(bodies[k], world, touched)
                    if watched:
                        watch(bodies, world, own_discs, touched)
                for k in range(moving):
                    body = bodies[k]
                    for i in range(width):
                        item = items[begin + i]
                        get_state(body, i, states, k)
                        for d in range(6):
                            total = out[item, h, k, d] if level else 0.0
                            out[item, h, k, d] = total + weight * states[k, d]
        for i in range(width):
            left[begin + i] = touched[i]
