"""The contact-free rollout: transitions of a body side by side, in the engine's own arithmetic.

A body that touches nothing needs no collision search: positions, forces and the solver's clamped
impulses are a few lines, which the compiler vectorises over transitions. They are those of
Chipmunk's ``cpSpaceStep``, in its order, so that the results agree to rounding.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics import lockstep_bodies as lanes
from pbrl_ppl.physics import lockstep_solver as solver
from pbrl_ppl.physics.compiled import act
from pbrl_ppl.physics.lockstep_solver import (
    AX,
    AY,
    COEF,
    II,
    LANES,
    LINK_ROWS,
    OX,
    OY,
    POINT_ROWS,
    PX,
    PY,
    ROWS,
    T_MAX,
    X0,
    Y0,
    L,
)
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.scene_joints import JOINT_COLUMNS
from pbrl_ppl.physics.world import RING, World

_TORQUE, _DAMPING, _MU, _RADIUS = (
    COLUMN[name] for name in ("pivot_torque", "pivot_damping", "patch_mu", "patch_radius")
)
_A_X, _A_Y, _B_X, _B_Y, _LENGTH = range(len(JOINT_COLUMNS))


class FreeBody(NamedTuple):
    """What the contact-free rollout must know of a moving body and its world."""

    wheel: bool
    pivot: bool
    iterations: int
    gravity: NDArray[np.float64]  # (2,)
    link_joint: NDArray[np.int64]
    link_rod: NDArray[np.bool_]
    link_first: NDArray[np.bool_]  # whether the body is the joint's first
    link_pose: NDArray[np.float64]  # (link, 4): x, y, cos and sin of what holds it
    ring: NDArray[np.float64]  # (point, 2): none without friction under the body
    radius: float
    obstacles: NDArray[np.float64]  # (obstacle, 5), without the discs


def free_bodies(world: World) -> tuple[FreeBody, ...]:
    """Describe each moving body of a world; none where joints or paths tie them to each other."""
    if world.chained.any() or world.kinematic.any():
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
        link_joint=np.array([link.joint for link in links], dtype=np.int64),
        link_rod=np.array([link.rod for link in links], dtype=bool),
        link_first=np.array([link.constraint.a is body for link in links], dtype=bool),
        link_pose=np.array(poses, dtype=float).reshape(-1, 4),
        ring=np.array(RING if patched else (), dtype=float).reshape(-1, 2),
        radius=float(world.radii[index]),
        obstacles=world.obstacles[: len(world.obstacles) - len(world.discs)].copy(),
    )


@numba.njit(nogil=True, cache=True)
def _set_properties(z, links, free, i, row, joints, normal_gravity, step):  # type: ignore[no-untyped-def]
    """Give lane ``i`` its numbers for an interval, and say whether its centre is off its origin."""
    shifted = lanes.set_body(z, i, row, free.wheel, normal_gravity, step)
    if free.pivot:
        z[T_MAX + i] = row[_TORQUE] * step
        z[COEF + i] = 1.0 - math.exp(-row[_DAMPING] * step * z[II + i])
    for j in range(len(free.link_joint)):
        own, joint, pose = links[j], joints[free.link_joint[j]], free.link_pose[j]
        near, far = (joint[_A_X], joint[_A_Y]), (joint[_B_X], joint[_B_Y])
        if not free.link_first[j]:
            near, far = far, near
        own[AX + i], own[AY + i] = near[0] - z[OX + i], near[1] - z[OY + i]
        own[PX + i] = pose[0] + pose[2] * far[0] - pose[3] * far[1]
        own[PY + i] = pose[1] + pose[3] * far[0] + pose[2] * far[1]
        own[L + i] = joint[_LENGTH]
    return shifted


@numba.njit(nogil=True, cache=True)
def _substep(z, links, points, free, slowing, patch_radius, step):  # type: ignore[no-untyped-def]
    """One step of the engine."""
    sliding = len(free.ring) > 0
    patch_alone = not (free.wheel or free.pivot or len(links))
    solver.turn(z, step)
    if sliding:  # by the velocities before, at the heading after
        solver.place_patch(z, points, free.ring, slowing, patch_radius, step)
    for j in range(len(links)):
        solver.place_link(z, links[j], free.link_rod[j], step)
    solver.accelerate(z, free.gravity, step)
    if free.wheel:
        solver.begin_wheel(z)
    for j in range(len(links)):
        solver.begin_link(z, links[j], free.link_rod[j])
    if free.pivot:
        solver.begin_pivot(z)
    if sliding:
        solver.begin_patch(z, points)
    for _ in range(free.iterations):
        if free.wheel:
            solver.solve_wheel(z)
        for j in range(len(links)):
            solver.solve_link(z, links[j], free.link_rod[j])
        if free.pivot:
            solver.solve_pivot(z)
        if sliding and not solver.solve_patch(z, points) and patch_alone:
            break


@numba.njit(nogil=True, cache=True)
def rollout(  # type: ignore[no-untyped-def]
    free, given, commands, forces, start, inputs, time_step, normal_gravity, counts, weights,
    first, last, out, left, trail,
):  # fmt: skip
    """Predict items ``first`` to ``last`` as `compiled.rollout` does, and mark those it cannot.

    All arrays are of one body, and ``out``, shape (last - first, H, 1, 6), of these items.
    ``trail``, if it has rows, is given x and y after every step of every number of substeps, shape
    (last - first, step, 2). ``left``, shape (last - first,), is set for items that come near
    something or are lost: the engine is for them.
    """
    bodies, joints, discs, command_parameters, force_parameters = given
    n, horizon = len(inputs), inputs.shape[1]
    timed = bodies.shape[1] > 1
    acting = len(commands[0]) + len(forces[0]) > 0
    watch = len(free.obstacles) + discs.shape[1] > 0
    z = np.zeros(ROWS)
    links = np.zeros((len(free.link_joint), LINK_ROWS))
    points = np.zeros((len(free.ring), POINT_ROWS))
    slowing, patch_radius = np.zeros(LANES), np.zeros(LANES)
    own_discs = np.zeros((LANES, discs.shape[1], 3))
    touched = np.zeros(LANES, dtype=np.bool_)
    state, signal = np.empty((1, 6)), np.empty(8)
    own = state[0]  # once: a view costs as much as what is done with it
    previous, command, wrench = np.empty((1, 3)), np.empty((1, 3)), np.empty((1, 3))
    for begin in range(first, last, LANES):
        width = min(LANES, last - begin)
        touched[:] = False
        steps = 0
        for level in range(len(counts)):
            substeps, weight = counts[level], weights[level]
            step = time_step / substeps
            z[:], links[:], points[:] = 0.0, 0.0, 0.0
            shifted = False
            for h in range(horizon):
                for i in range(LANES):
                    item = begin + min(i, width - 1)  # lanes to spare repeat the last
                    p, t = item // n, item % n
                    if timed or h == 0:
                        row = bodies[p, t * horizon + h if timed else 0, 0]
                        if h == 0:
                            for d in range(6):
                                own[d] = start[p if len(start) > 1 else 0, t, 0, d]
                            own_discs[i] = discs[p]
                        else:
                            lanes.get_state(z, i, own)
                        shifted |= _set_properties(
                            z, links, free, i, row, joints[p], normal_gravity, step
                        )
                        lanes.set_state(z, i, own)
                        slowing[i], patch_radius[i] = row[_MU] * normal_gravity, row[_RADIUS]
                    else:
                        lanes.align(z, i)
                    lanes.set_wrench(z, i, inputs[t, h, 0])
                for s in range(substeps):
                    if acting:
                        for i in range(width):
                            p, t = (begin + i) // n, (begin + i) % n
                            lanes.get_state(z, i, own)
                            act(
                                state, inputs[t, h], commands, command_parameters[p], forces,
                                force_parameters[p], s / substeps, (s + 1) / substeps, signal,
                                previous, command, wrench,
                            )  # fmt: skip
                            lanes.set_wrench(z, i, wrench[0])
                    if shifted:
                        lanes.lever(z)
                    _substep(z, links, points, free, slowing, patch_radius, step)
                    lanes.lose(z, touched)
                    if watch or len(trail):
                        lanes.locate(z)
                    if len(trail):
                        for i in range(width):
                            trail[begin - first + i, steps, 0] = z[X0 + i]
                            trail[begin - first + i, steps, 1] = z[Y0 + i]
                        steps += 1
                    if watch:
                        lanes.watch(z, free.radius, free.obstacles, own_discs, touched)
                for i in range(width):
                    lanes.get_state(z, i, own)
                    lanes.add(out[begin - first + i, h, 0], own, weight, level, len(counts))
        for i in range(width):  # it has what other bodies came near, too
            left[begin - first + i] |= touched[i]


@numba.njit(nogil=True, cache=True)
def meet(trail, other, reach, left):  # type: ignore[no-untyped-def]
    """Mark the items in which two bodies come within reach of each other."""
    for item in range(len(trail)):
        for step in range(trail.shape[1]):
            x = trail[item, step, 0] - other[item, step, 0]
            y = trail[item, step, 1] - other[item, step, 1]
            left[item] |= x * x + y * y <= reach * reach
