"""Contact-free fast path: many transitions at once, in the engine's arithmetic.

Bodies that touch nothing need no collision search: positions, forces and the solver's clipped
impulses are a few lines, which the compiler vectorises over transitions. They are those of
Chipmunk's ``cpSpaceStep``, in its order, so that the results agree to rounding.

Bodies with joints, or with friction under them, are a :mod:`tree <pbrl_ppl.physics.tree>`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics.compilation import compiled
from pbrl_ppl.physics.laws import ACTED, LATE, MORE, act, begin_held, laws_of, set_memory
from pbrl_ppl.physics.lockstep_bodies import (
    BLOCK,
    BODY,
    accelerate,
    align,
    begin_wheel,
    get_state,
    lever,
    lose,
    set_body,
    set_state,
    set_wrench,
    solve_wheel,
    turn,
    watch,
)
from pbrl_ppl.physics.world import World


class Wheels(NamedTuple):
    """Which bodies have a wheel, and the solver's iterations."""

    under: NDArray[np.bool_]  # (body,)
    iterations: int


def free_wheels(world: World) -> Wheels | None:
    """Return a world's wheels; None where a body follows a path, is joined, or is on friction."""
    if world.kinematic.any() or world.links or world.patches or world.turners:
        return None
    wheels = [wheel.body for wheel in world.wheels]
    return Wheels(np.isin(np.arange(len(world.bodies)), wheels), world.iterations)


@compiled
def substep(bodies, wheels, gravity, step):  # type: ignore[no-untyped-def]
    """Do one step of the engine."""
    for k in range(len(wheels.under)):
        turn(bodies[k], step)
        accelerate(bodies[k], gravity, step)
        if wheels.under[k]:
            begin_wheel(bodies[k])
            for _ in range(wheels.iterations):
                solve_wheel(bodies[k])


@compiled
def rollout(wheels, still, batch, items, begins, out):  # type: ignore[no-untyped-def]
    """Predict ``items`` as `compiled.rollout` does, but for intervals that the engine must predict.

    ``begins``, shape (item,), are their first intervals; they become those in which a body comes
    near an obstacle or diverges, H where none does.
    """
    rows, discs = batch.given[0], batch.given[2]
    start, inputs = batch.start, batch.inputs
    n, horizon, moving = len(inputs), inputs.shape[1], len(still.radii)
    timed = rows.shape[1] > 1
    acting = len(batch.commands) + len(batch.forces) > 0
    bodies = np.zeros((moving, BLOCK * len(BODY)))
    own_discs = np.zeros((BLOCK, discs.shape[1], 3))
    touched = np.zeros(BLOCK, dtype=np.bool_)
    proposal, transition, first, until = np.zeros((4, BLOCK), dtype=np.int64)
    states, acted = np.empty((moving, 6)), np.zeros((moving + MORE, ACTED))
    memory, at = np.zeros((2, batch.slots)), np.full(2, -1)
    remembered, held = np.zeros((BLOCK, batch.slots)), np.zeros((BLOCK, 2, batch.held))
    for begin in range(0, len(items), BLOCK):
        width = min(BLOCK, len(items) - begin)
        longest = 0
        for i in range(BLOCK):
            place = begin + min(i, width - 1)  # the rest of a block repeats the last
            item, first[i], until[i] = items[place], begins[place], horizon
            proposal[i], transition[i] = item // n, item % n
            longest = max(longest, horizon - first[i])
            for j in range(discs.shape[1]):
                for d in range(3):
                    own_discs[i, j, d] = discs[proposal[i], j, d]
        for level in range(len(batch.counts)):
            substeps, weight = batch.counts[level], batch.weights[level]
            step = batch.time_step / substeps
            bodies[:] = 0.0
            touched[:] = False
            shifted = False
            for ahead in range(longest):
                for k in range(moving):
                    body, wheel = bodies[k], wheels.under[k]
                    for i in range(BLOCK):
                        p, t, h = proposal[i], transition[i], min(first[i] + ahead, horizon - 1)
                        if timed or ahead == 0:
                            row = rows[p, t * horizon + h if timed else 0, k]
                            if ahead == 0:
                                for d in range(6):
                                    states[k, d] = start[p if len(start) > 1 else 0, t, k, d]
                                    if h > 0:
                                        states[k, d] = out[p * n + t, h - 1, k, d]
                            else:
                                get_state(body, i, states, k)
                            shifted |= set_body(body, i, row, wheel, still.normal_gravity, step)
                            set_state(body, i, states, k)
                        else:
                            align(body, i)
                        force_x, force_y = inputs[t, h, k, 0], inputs[t, h, k, 1]
                        set_wrench(body, i, force_x, force_y, inputs[t, h, k, 2])
                for i in range(width if ahead == 0 and batch.slots + batch.held > 0 else 0):
                    p, t = proposal[i], transition[i]
                    for k in range(moving):
                        get_state(bodies[k], i, states, k)
                    laws = laws_of(batch, p)
                    set_memory(batch, laws, p, t, first[i], states, acted, memory, held[i], at)
                    begin_held(states, laws, acted, held[i])
                    remembered[i] = memory[1]
                for s in range(substeps):
                    if acting:
                        for i in range(width):
                            p, t, h = proposal[i], transition[i], min(first[i] + ahead, horizon - 1)
                            for k in range(moving):
                                get_state(bodies[k], i, states, k)
                            act(
                                states, inputs[t, h], laws_of(batch, p), s / substeps,
                                (s + 1) / substeps, acted, remembered[i], held[i],
                            )  # fmt: skip
                            for slot in range(batch.held):
                                held[i, 0, slot] += step * held[i, 1, slot]
                            for k in range(moving):
                                set_wrench(bodies[k], i, acted[k, 6], acted[k, 7], acted[k, 8])
                    if shifted:
                        for k in range(moving):
                            lever(bodies[k])
                    substep(bodies, wheels, still.gravity, step)
                    for k in range(moving):
                        lose(bodies[k], still, touched)
                    if still.watched:
                        watch(bodies, still, own_discs, touched)
                for i in range(width if batch.slots > 0 else 0):
                    p, t, h = proposal[i], transition[i], min(first[i] + ahead, horizon - 1)
                    for k in range(moving):
                        get_state(bodies[k], i, states, k)
                    laws = laws_of(batch, p)
                    act(states, inputs[t, h], laws, LATE, 1.0, acted, remembered[i], held[i], True)
                for i in range(width):
                    item, h = items[begin + i], first[i] + ahead
                    if touched[i]:
                        until[i] = min(until[i], h)
                    for k in range(moving if h < until[i] else 0):
                        get_state(bodies[k], i, states, k)
                        for d in range(6):
                            total = out[item, h, k, d] if level else 0.0
                            out[item, h, k, d] = total + weight * states[k, d]
        for i in range(width):
            begins[begin + i] = until[i]
