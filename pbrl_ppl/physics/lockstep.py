"""Contact-free fast path of single bodies: many transitions at once, in the engine's arithmetic.

A body that touches nothing needs no collision search: positions, forces and the solver's clipped
impulses are a few lines, which the compiler vectorises over transitions. They are those of
Chipmunk's ``cpSpaceStep``, in its order, so that the results agree to rounding.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics import lockstep_solver as solver
from pbrl_ppl.physics.compilation import compiled, copy
from pbrl_ppl.physics.compiled import act
from pbrl_ppl.physics.joints import ROD
from pbrl_ppl.physics.lockstep_solver import BLOCK, LINK_ROWS, POINT_ROWS, ROWS, X0, Y0
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.world import RING, World


class FreeBody(NamedTuple):
    """A moving body and its surroundings, for the contact-free fast path."""

    wheel: bool
    pivot: bool
    iterations: int
    gravity: NDArray[np.float64]  # (2,)
    size: float  # of the smallest moving body (m)
    fastest: float  # speed of divergence (m/s)
    link_joint: NDArray[np.int64]
    link_rod: NDArray[np.bool_]
    link_first: NDArray[np.bool_]  # whether the body is the joint's first
    link_pose: NDArray[np.float64]  # (link, 4): x, y, cos and sin of the fixed body
    ring: NDArray[np.float64]  # (point, 2): empty without friction under the body
    radius: float
    obstacles: NDArray[np.float64]  # (obstacle, 5), without the discs


def free_bodies(world: World) -> tuple[FreeBody, ...]:
    """Describe each moving body of a world.

    Returns nothing where a body is joined to another one, follows a path, or has a joint without
    contact-free arithmetic.
    """
    fixed = all(link.kind.contact_free for link in world.links)
    if not fixed or world.chained.any() or world.kinematic.any():
        return ()
    return tuple(_free_body(world, i) for i in range(len(world.bodies)))


def _free_body(world: World, index: int) -> FreeBody:
    body = world.bodies[index]
    links = [link for link in world.links if body in (link.constraint.a, link.constraint.b)]
    holders = [
        link.constraint.b if link.constraint.a is body else link.constraint.a for link in links
    ]
    poses = [(*h.position, math.cos(h.angle), math.sin(h.angle)) for h in holders]
    patched = any(patch.body == index for patch in world.patches)
    return FreeBody(
        wheel=any(wheel.body == index for wheel in world.wheels),
        pivot=any(pivot.body == index for pivot in world.pivots),
        iterations=world.iterations,
        gravity=np.array(world.space.gravity, dtype=float),
        size=world.size,
        fastest=world.fastest,
        link_joint=np.array([link.joint for link in links], dtype=np.int64),
        link_rod=np.array([link.kind is ROD for link in links], dtype=bool),
        link_first=np.array([link.constraint.a is body for link in links], dtype=bool),
        link_pose=np.array(poses, dtype=float).reshape(-1, 4),
        ring=np.array(RING if patched else (), dtype=float).reshape(-1, 2),
        radius=float(world.radii[index]),
        obstacles=world.obstacles[: len(world.obstacles) - len(world.discs)].copy(),
    )


@compiled
def rollout(free, batch, first, last, out, left, trail):  # type: ignore[no-untyped-def]
    """Predict items ``first`` to ``last`` as `compiled.rollout` does, and mark those that touch.

    All arrays are of one body; ``out`` has shape (last - first, H, 1, 6). ``trail``, shape (last -
    first, step, 2), gets x and y after every step of every number of substeps, if it has rows.
    ``left``, shape (last - first,), is set for items that come near an obstacle or diverge: the
    engine must predict those.
    """
    bodies, joints, discs, command_parameters, force_parameters = batch.given
    start, inputs, normal_gravity = batch.start, batch.inputs, batch.normal_gravity
    n, horizon = len(inputs), inputs.shape[1]
    timed = bodies.shape[1] > 1
    commands, forces = batch.commands, batch.forces
    acting = len(commands[0]) + len(forces[0]) > 0
    watch = len(free.obstacles) + discs.shape[1] > 0
    z = np.zeros(ROWS)
    links = np.zeros((len(free.link_joint), LINK_ROWS))
    points = np.zeros((len(free.ring), POINT_ROWS))
    slowing, patch_radius = np.zeros(BLOCK), np.zeros(BLOCK)
    own_discs = np.zeros((BLOCK, discs.shape[1], 3))
    touched = np.zeros(BLOCK, dtype=np.bool_)
    state, signal = np.empty((1, 6)), np.empty(8)
    previous, command, wrench = np.empty((1, 3)), np.empty((1, 3)), np.empty((1, 3))
    own = state[0]  # once: a view costs as much as its use
    for begin in range(first, last, BLOCK):
        width = min(BLOCK, last - begin)
        touched[:] = False
        steps = 0
        for level in range(len(batch.counts)):
            substeps, weight = batch.counts[level], batch.weights[level]
            step = batch.time_step / substeps
            z[:], links[:], points[:] = 0.0, 0.0, 0.0
            shifted = False
            for h in range(horizon):
                for i in range(BLOCK):
                    item = begin + min(i, width - 1)  # the rest of a block repeats the last
                    p, t = item // n, item % n
                    if timed or h == 0:
                        row = bodies[p, t * horizon + h if timed else 0, 0]
                        if h == 0:
                            for d in range(6):
                                own[d] = start[p if len(start) > 1 else 0, t, 0, d]
                            copy(discs[p], own_discs[i])
                        else:
                            solver.get_state(z, i, own)
                        shifted |= solver.set_properties(
                            z, links, free, i, row, joints[p], normal_gravity, step
                        )
                        solver.set_state(z, i, own)
                        slowing[i] = row[COLUMN.patch_mu] * normal_gravity
                        patch_radius[i] = row[COLUMN.patch_radius]
                    else:
                        solver.align(z, i)
                    solver.set_wrench(z, i, inputs[t, h, 0])
                for s in range(substeps):
                    if acting:
                        for i in range(width):
                            p, t = (begin + i) // n, (begin + i) % n
                            solver.get_state(z, i, own)
                            act(
                                state, inputs[t, h], commands, command_parameters[p], forces,
                                force_parameters[p], s / substeps, (s + 1) / substeps, signal,
                                previous, command, wrench,
                            )  # fmt: skip
                            solver.set_wrench(z, i, wrench[0])
                    if shifted:
                        solver.lever(z)
                    solver.substep(z, links, points, free, slowing, patch_radius, step)
                    solver.lose(z, free, touched)
                    if watch or len(trail):
                        solver.locate(z)
                    if len(trail):
                        for i in range(width):
                            trail[begin - first + i, steps, 0] = z[X0 + i]
                            trail[begin - first + i, steps, 1] = z[Y0 + i]
                        steps += 1
                    if watch:
                        solver.watch(z, free.radius, free.obstacles, own_discs, touched)
                for i in range(width):
                    solver.get_state(z, i, own)
                    solver.add(out[begin - first + i, h, 0], own, weight, level, len(batch.counts))
        for i in range(width):  # other bodies may have set it already
            left[begin - first + i] |= touched[i]


@compiled
def meet(trail, other, reach, left):  # type: ignore[no-untyped-def]
    """Mark the items in which two bodies come within reach of each other."""
    for item in range(len(trail)):
        for step in range(trail.shape[1]):
            x = trail[item, step, 0] - other[item, step, 0]
            y = trail[item, step, 1] - other[item, step, 1]
            left[item] |= x * x + y * y <= reach * reach
