"""The contact-free rollout of a world whose bodies are joined: its transitions side by side.

As `lockstep`, for all bodies at once. A solver that has not converged hangs on the order of its
constraints and on their iterations: the engine's order is kept, and each lane has the iterations
that the engine takes for its masses.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics import lockstep_bodies as lanes
from pbrl_ppl.physics import lockstep_joints as solver
from pbrl_ppl.physics.compiled import act
from pbrl_ppl.physics.lockstep_joints import A1X, A1Y, JOINT_ROWS, M_MAX, MJ, SHARE
from pbrl_ppl.physics.lockstep_solver import (
    AX,
    AY,
    II,
    LANES,
    OX,
    OY,
    POINT_ROWS,
    PX,
    PY,
    ROWS,
    X0,
    Y0,
    L,
)
from pbrl_ppl.physics.properties import COLUMN
from pbrl_ppl.physics.scene_joints import JOINT_COLUMNS
from pbrl_ppl.physics.setters import iterations
from pbrl_ppl.physics.world import RING, World

_TORQUE, _DAMPING, _MU, _RADIUS = (
    COLUMN[name] for name in ("pivot_torque", "pivot_damping", "patch_mu", "patch_radius")
)
_A_X, _A_Y, _B_X, _B_Y, _LENGTH = range(len(JOINT_COLUMNS))


class Chain(NamedTuple):
    """What the contact-free rollout must know of a world with joined bodies."""

    chained: NDArray[np.bool_]  # (body,)
    iterations: int  # the least
    gravity: NDArray[np.float64]  # (2,)
    wheel: NDArray[np.bool_]  # (body,)
    link_joint: NDArray[np.int64]
    link_rod: NDArray[np.bool_]
    link_ends: NDArray[np.int64]  # (link, 2): bodies; the first is -1 if it does not move
    link_turned: NDArray[np.bool_]  # whether these are the joint's second and first
    link_pose: NDArray[np.float64]  # (link, 4): x, y, cos and sin of what does not move
    link_pivot: NDArray[np.int64]  # the body whose friction is in it; -1 for none
    patch_body: NDArray[np.int64]
    ring: NDArray[np.float64]  # (point, 2)
    radii: NDArray[np.float64]  # (body,)
    can_touch: NDArray[np.bool_]  # (body, body)
    obstacles: NDArray[np.float64]  # (obstacle, 5), without the discs


def chain_of(world: World) -> Chain | None:
    """Describe a world; None where no bodies are joined to each other, or one follows a path."""
    if world.kinematic.any() or not world.chained.any():
        return None
    ends, poses, hung = [], [], []
    pivots = iter(world.pivots)
    for link in world.links:
        pair = link.constraint.a, link.constraint.b
        ends.append([world.bodies.index(body) if body in world.bodies else -1 for body in pair])
        holder = pair[ends[-1].index(-1)] if -1 in ends[-1] else world.space.static_body
        poses.append((*holder.position, math.cos(holder.angle), math.sin(holder.angle)))
        declared = world.scene.joints[link.joint : link.joint + 1]  # none of a rod of an effect
        has_pivot = any(joint.kind == "hinge" and joint.bodies is not None for joint in declared)
        hung.append(next(pivots).body if has_pivot else -1)
    pairs = np.array(ends, dtype=np.int64).reshape(-1, 2)
    turned = pairs[:, 1] < 0
    wheels = [wheel.body for wheel in world.wheels]
    return Chain(
        chained=world.chained,
        iterations=world.iterations,
        gravity=np.array(world.space.gravity, dtype=float),
        wheel=np.isin(np.arange(len(world.bodies)), wheels),
        link_joint=np.array([link.joint for link in world.links], dtype=np.int64),
        link_rod=np.array([link.rod for link in world.links], dtype=bool),
        link_ends=np.where(turned[:, None], pairs[:, ::-1], pairs),
        link_turned=turned,
        link_pose=np.array(poses, dtype=float).reshape(-1, 4),
        link_pivot=np.array(hung, dtype=np.int64),
        patch_body=np.array([patch.body for patch in world.patches], dtype=np.int64),
        ring=np.array(RING),
        radii=world.radii,
        can_touch=world.can_touch,
        obstacles=world.obstacles[: len(world.obstacles) - len(world.discs)].copy(),
    )


@numba.njit(nogil=True, cache=True)
def _set_joint(own, i, bodies, chain, j, joint, row, step):  # type: ignore[no-untyped-def]
    """Give lane ``i`` of link ``j`` its numbers for an interval."""
    a, b, pose = bodies[chain.link_ends[j, 0]], bodies[chain.link_ends[j, 1]], chain.link_pose[j]
    first, second = (joint[_A_X], joint[_A_Y]), (joint[_B_X], joint[_B_Y])
    if chain.link_turned[j]:
        first, second = second, first
    own[A1X + i], own[A1Y + i] = first[0] - a[OX + i], first[1] - a[OY + i]
    own[AX + i], own[AY + i] = second[0] - b[OX + i], second[1] - b[OY + i]
    own[PX + i] = pose[0] + pose[2] * first[0] - pose[3] * first[1]
    own[PY + i] = pose[1] + pose[3] * first[0] + pose[2] * first[1]
    own[L + i] = joint[_LENGTH]
    if chain.link_pivot[j] >= 0:
        own[M_MAX + i] = row[_TORQUE] * step
        damping = row[_DAMPING] * (a[II + i] + b[II + i])
        own[SHARE + i] = 1.0 - math.exp(-damping * step) if damping else 0.0


@numba.njit(nogil=True, cache=True)
def _watch(bodies, chain, discs, touched):  # type: ignore[no-untyped-def]
    """Mark the lanes in which a body comes near an obstacle or another that it may touch."""
    for k in range(len(chain.radii)):
        lanes.locate(bodies[k])
        lanes.watch(bodies[k], chain.radii[k], chain.obstacles, discs, touched)
        for j in range(k):
            if chain.can_touch[k, j]:
                reach = chain.radii[k] + chain.radii[j]
                for i in range(LANES):
                    x = bodies[k, X0 + i] - bodies[j, X0 + i]
                    y = bodies[k, Y0 + i] - bodies[j, Y0 + i]
                    touched[i] |= x * x + y * y <= reach * reach


@numba.njit(nogil=True, cache=True)
def rollout(  # type: ignore[no-untyped-def]
    chain, given, commands, forces, start, inputs, time_step, normal_gravity, counts, weights,
    items, out, left,
):  # fmt: skip
    """Predict ``items`` as `compiled.rollout` does, and mark those that it is for.

    ``left``, shape (item,), says which come near something or are lost. Lanes wait for the one of
    the most iterations: items of about as many go side by side, if they can.
    """
    rows, joint_rows, discs, command_parameters, force_parameters = given
    n, horizon, moving = len(inputs), inputs.shape[1], len(chain.radii)
    timed = rows.shape[1] > 1
    acting = len(commands[0]) + len(forces[0]) > 0
    watch = len(chain.obstacles) + discs.shape[1] > 0 or chain.can_touch.sum() > moving
    bodies = np.zeros((moving + 1, ROWS))  # the last is what does not move
    joints = np.zeros((len(chain.link_joint), JOINT_ROWS))
    patches = np.zeros((len(chain.patch_body), len(chain.ring), POINT_ROWS))
    slowing, patch_radius = np.zeros((2, len(patches), LANES))
    own_discs = np.zeros((LANES, discs.shape[1], 3))
    touched, most = np.zeros(LANES, dtype=np.bool_), np.zeros(LANES, dtype=np.int64)
    rough = np.zeros(len(joints), dtype=np.bool_)
    states, signal = np.empty((LANES, moving, 6)), np.empty(8)
    previous, command, wrench = np.empty((3, moving, 3))
    for begin in range(0, len(items), LANES):
        width = min(LANES, len(items) - begin)
        touched[:] = False
        for level in range(len(counts)):
            substeps, step = counts[level], time_step / counts[level]
            bodies[:], joints[:], patches[:] = 0.0, 0.0, 0.0
            shifted = False
            for h in range(horizon):
                for i in range(LANES):
                    item = items[begin + min(i, width - 1)]  # lanes to spare repeat the last
                    p, t = item // n, item % n
                    if h == 0:
                        states[i] = start[p if len(start) > 1 else 0, t]
                        own_discs[i] = discs[p]
                    if timed or h == 0:
                        own = rows[p, t * horizon + h if timed else 0]
                        most[i] = iterations(chain, own)
                        for k in range(moving):
                            shifted |= lanes.set_body(
                                bodies[k], i, own[k], chain.wheel[k], normal_gravity, step
                            )
                            lanes.set_state(bodies[k], i, states[i, k])
                        for j in range(len(joints)):
                            _set_joint(
                                joints[j], i, bodies, chain, j,
                                joint_rows[p, chain.link_joint[j]], own[chain.link_pivot[j]], step,
                            )  # fmt: skip
                        for j in range(len(patches)):
                            row = own[chain.patch_body[j]]
                            slowing[j, i] = row[_MU] * normal_gravity
                            patch_radius[j, i] = row[_RADIUS]
                    for k in range(moving):
                        if not timed and h > 0:
                            lanes.align(bodies[k], i)
                        lanes.set_wrench(bodies[k], i, inputs[t, h, k])
                for j in range(len(joints)):  # friction that is none changes no number
                    rough[j] = False
                    for row in (M_MAX, MJ, SHARE):
                        rough[j] |= joints[j, row : row + LANES].any()
                for s in range(substeps):
                    if acting:
                        for i in range(width):
                            item = items[begin + i]
                            p, t = item // n, item % n
                            for k in range(moving):
                                lanes.get_state(bodies[k], i, states[i, k])
                            act(
                                states[i], inputs[t, h], commands, command_parameters[p], forces,
                                force_parameters[p], s / substeps, (s + 1) / substeps, signal,
                                previous, command, wrench,
                            )  # fmt: skip
                            for k in range(moving):
                                lanes.set_wrench(bodies[k], i, wrench[k])
                    if shifted:
                        for k in range(moving):
                            lanes.lever(bodies[k])
                    solver.substep(
                        bodies, joints, patches, chain, rough, slowing, patch_radius, step, most,
                    )  # fmt: skip
                    for k in range(moving):
                        lanes.lose(bodies[k], touched)
                    if watch:
                        _watch(bodies, chain, own_discs, touched)
                for i in range(LANES):
                    for k in range(moving):
                        lanes.get_state(bodies[k], i, states[i, k])
                        if i < width:
                            at = out[items[begin + i], h, k]
                            lanes.add(at, states[i, k], weights[level], level, len(counts))
        left[begin : begin + width] = touched[:width]
