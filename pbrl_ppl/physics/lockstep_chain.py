"""Contact-free fast path of joined bodies: as `lockstep`, for all bodies of a transition at once.

A solver that has not converged depends on the order of its constraints and on the number of
iterations: the engine's order is kept, and each transition has the iterations that the engine takes
for its masses.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics import lockstep_joints as joined
from pbrl_ppl.physics import lockstep_solver as solver
from pbrl_ppl.physics.compilation import compiled, copy
from pbrl_ppl.physics.compiled import act
from pbrl_ppl.physics.joints import ROD
from pbrl_ppl.physics.lockstep_joints import JOINT_ROWS, M_MAX, MJ, SHARE, Block
from pbrl_ppl.physics.lockstep_solver import BLOCK, POINT_ROWS, ROWS, X0, Y0
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.setters import iterations
from pbrl_ppl.physics.world import RING, World


class Chain(NamedTuple):
    """A world with joined bodies, for the contact-free fast path."""

    chained: NDArray[np.bool_]  # (body,)
    iterations: int  # the fewest
    gravity: NDArray[np.float64]  # (2,)
    size: float  # of the smallest moving body (m)
    fastest: float  # speed of divergence (m/s)
    wheel: NDArray[np.bool_]  # (body,)
    link_joint: NDArray[np.int64]
    link_rod: NDArray[np.bool_]
    link_ends: NDArray[np.int64]  # (link, 2): bodies; the first is -1 if it is fixed
    link_turned: NDArray[np.bool_]  # whether these are the joint's second and first
    link_pose: NDArray[np.float64]  # (link, 4): x, y, cos and sin of the fixed body
    link_pivot: NDArray[np.int64]  # the body whose friction acts in it; -1 for none
    patch_body: NDArray[np.int64]
    ring: NDArray[np.float64]  # (point, 2)
    radii: NDArray[np.float64]  # (body,)
    can_touch: NDArray[np.bool_]  # (body, body)
    obstacles: NDArray[np.float64]  # (obstacle, 5), without the discs


def chain_of(world: World) -> Chain | None:
    """Describe a world.

    Returns None where no bodies are joined to each other, one follows a path, or a joint has no
    contact-free arithmetic.
    """
    known = all(link.kind.contact_free for link in world.links)
    if not known or world.kinematic.any() or not world.chained.any():
        return None
    ends, poses = [], []
    for link in world.links:
        pair = link.constraint.a, link.constraint.b
        ends.append([world.bodies.index(body) if body in world.bodies else -1 for body in pair])
        holder = pair[ends[-1].index(-1)] if -1 in ends[-1] else world.space.static_body
        poses.append((*holder.position, math.cos(holder.angle), math.sin(holder.angle)))
    pairs = np.array(ends, dtype=np.int64).reshape(-1, 2)
    turned = pairs[:, 1] < 0
    wheels = [wheel.body for wheel in world.wheels]
    return Chain(
        chained=world.chained,
        iterations=world.iterations,
        gravity=np.array(world.space.gravity, dtype=float),
        size=world.size,
        fastest=world.fastest,
        wheel=np.isin(np.arange(len(world.bodies)), wheels),
        link_joint=np.array([link.joint for link in world.links], dtype=np.int64),
        link_rod=np.array([link.kind is ROD for link in world.links], dtype=bool),
        link_ends=np.where(turned[:, None], pairs[:, ::-1], pairs),
        link_turned=turned,
        link_pose=np.array(poses, dtype=float).reshape(-1, 4),
        link_pivot=np.array(
            [link.pivot.body if link.pivot else -1 for link in world.links], dtype=np.int64
        ),
        patch_body=np.array([patch.body for patch in world.patches], dtype=np.int64),
        ring=np.array(RING),
        radii=world.radii,
        can_touch=world.can_touch,
        obstacles=world.obstacles[: len(world.obstacles) - len(world.discs)].copy(),
    )


@compiled
def _watch(bodies, chain, discs, touched):  # type: ignore[no-untyped-def]
    """Mark the transitions in which a body is near an obstacle or another that it may touch."""
    for k in range(len(chain.radii)):
        solver.locate(bodies[k])
        solver.watch(bodies[k], chain.radii[k], chain.obstacles, discs, touched)
        for j in range(k):
            if chain.can_touch[k, j]:
                reach = chain.radii[k] + chain.radii[j]
                for i in range(BLOCK):
                    x = bodies[k, X0 + i] - bodies[j, X0 + i]
                    y = bodies[k, Y0 + i] - bodies[j, Y0 + i]
                    touched[i] |= x * x + y * y <= reach * reach


@compiled
def rollout(chain, batch, items, out, left):  # type: ignore[no-untyped-def]
    """Predict ``items`` as `compiled.rollout` does, and mark those that the engine must predict.

    ``left``, shape (item,), is set for items that come near an obstacle or diverge. A block takes
    as long as the transition of the most iterations: items of similar numbers should be neighbours.
    """
    rows, joint_rows, discs, command_parameters, force_parameters = batch.given
    start, inputs, normal_gravity = batch.start, batch.inputs, batch.normal_gravity
    n, horizon, moving, levels = len(inputs), inputs.shape[1], len(chain.radii), len(batch.counts)
    timed = rows.shape[1] > 1
    commands, forces = batch.commands, batch.forces
    acting = len(commands[0]) + len(forces[0]) > 0
    watch = len(chain.obstacles) + discs.shape[1] > 0 or chain.can_touch.sum() > moving
    bodies = np.zeros((moving + 1, ROWS))  # the last is fixed
    joints = np.zeros((len(chain.link_joint), JOINT_ROWS))
    patches = np.zeros((len(chain.patch_body), len(chain.ring), POINT_ROWS))
    slowing, patch_radius = np.zeros((2, len(patches), BLOCK))
    rough, most = np.zeros(len(joints), dtype=np.bool_), np.zeros(BLOCK, dtype=np.int64)
    block = Block(bodies, joints, patches, slowing, patch_radius, rough, most)
    own_discs = np.zeros((BLOCK, discs.shape[1], 3))
    touched = np.zeros(BLOCK, dtype=np.bool_)
    states, signal = np.empty((BLOCK, moving, 6)), np.empty(8)
    previous, command, wrench = np.empty((3, moving, 3))
    for begin in range(0, len(items), BLOCK):
        width = min(BLOCK, len(items) - begin)
        touched[:] = False
        for level in range(levels):
            substeps, step = batch.counts[level], batch.time_step / batch.counts[level]
            bodies[:], joints[:], patches[:] = 0.0, 0.0, 0.0
            shifted = False
            for h in range(horizon):
                for i in range(BLOCK):
                    item = items[begin + min(i, width - 1)]  # the rest of a block repeats the last
                    p, t = item // n, item % n
                    if h == 0:
                        copy(start[p if len(start) > 1 else 0, t], states[i])
                        copy(discs[p], own_discs[i])
                    if timed or h == 0:
                        own = rows[p, t * horizon + h if timed else 0]
                        most[i] = iterations(chain, own)
                        for k in range(moving):
                            shifted |= solver.set_body(
                                bodies[k], i, own[k], chain.wheel[k], normal_gravity, step
                            )
                            solver.set_state(bodies[k], i, states[i, k])
                        for j in range(len(joints)):
                            joined.set_joint(
                                joints[j], i, bodies, chain, j,
                                joint_rows[p, chain.link_joint[j]], own[chain.link_pivot[j]], step,
                            )  # fmt: skip
                        for j in range(len(patches)):
                            row = own[chain.patch_body[j]]
                            slowing[j, i] = row[COLUMN.patch_mu] * normal_gravity
                            patch_radius[j, i] = row[COLUMN.patch_radius]
                    for k in range(moving):
                        if not timed and h > 0:
                            solver.align(bodies[k], i)
                        solver.set_wrench(bodies[k], i, inputs[t, h, k])
                for j in range(len(joints)):  # zero friction changes no number
                    rough[j] = False
                    for row in (M_MAX, MJ, SHARE):
                        rough[j] |= joints[j, row : row + BLOCK].any()
                for s in range(substeps):
                    if acting:
                        for i in range(width):
                            item = items[begin + i]
                            p, t = item // n, item % n
                            for k in range(moving):
                                solver.get_state(bodies[k], i, states[i, k])
                            act(
                                states[i], inputs[t, h], commands, command_parameters[p], forces,
                                force_parameters[p], s / substeps, (s + 1) / substeps, signal,
                                previous, command, wrench,
                            )  # fmt: skip
                            for k in range(moving):
                                solver.set_wrench(bodies[k], i, wrench[k])
                    if shifted:
                        for k in range(moving):
                            solver.lever(bodies[k])
                    joined.substep(block, chain, step)
                    for k in range(moving):
                        solver.lose(bodies[k], chain, touched)
                    if watch:
                        _watch(bodies, chain, own_discs, touched)
                for i in range(BLOCK):
                    for k in range(moving):
                        solver.get_state(bodies[k], i, states[i, k])
                        if i < width:
                            at = out[items[begin + i], h, k]
                            solver.add(at, states[i, k], batch.weights[level], level, levels)
        for i in range(width):
            left[begin + i] = touched[i]
