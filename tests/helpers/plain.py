"""The slow reference of the engine's loops, in plain Python: a new world for each transition.

It is written apart from the compiled code, and takes what is placed in a substep alone from there.
"""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
import pymunk

from pbrl_ppl.effects import Attached, Command, Force, Friction, at_stage, holder
from pbrl_ppl.effects.effect import INTERVAL, MEMORY, MOST_MEMORY, TIME
from pbrl_ppl.physics import Simulator
from pbrl_ppl.physics.compiled import (
    glide,
    hinge_signal,
    iterations,
    patch_point,
    patch_signal,
    wheel_ends,
)
from pbrl_ppl.physics.laws import WINDOW
from pbrl_ppl.physics.properties import EngineInput
from pbrl_ppl.physics.settings import PhysicsSettings
from pbrl_ppl.physics.simulator import Choice, continues_previous
from pbrl_ppl.physics.solids import near_contact
from pbrl_ppl.physics.world import COLUMN, FINER, RING, World
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import WRENCH, Floats

Stage = TypeVar("Stage", Command, Force, Friction)
_EXTRA = [COLUMN.extra_gravity_x, COLUMN.extra_gravity_y]


class PlainSimulator(Simulator):
    """A simulator whose worlds are stepped in Python, one transition after the other."""

    def _run(
        self, choice: Choice, numbers: EngineInput, starts: Floats, inputs: Floats, out: Floats
    ) -> None:
        follows = continues_previous(inputs)
        if not any(getattr(one.effect.stage, "remember", None) for one in self.physics.effects):
            follows[:] = False  # nothing remembers the intervals before
        for item in range(len(out)):
            p, t = divmod(item, len(inputs))
            start = starts[p if len(starts) > 1 else 0, t]
            total = np.zeros_like(out[item])
            first = t
            while follows[first]:
                first -= 1
            earlier = np.concatenate([*inputs[first:t], inputs[t, :1]])
            stepped = partial(
                rollout, effects=self.physics.effects, numbers=numbers, proposal=p, item=t,
                start=start, inputs=inputs[t], earlier=earlier,
            )  # fmt: skip
            for level, (count, weight) in enumerate(zip(*self.levels, strict=True)):
                states, touched = stepped(self._new_world(choice), substeps=int(count))
                lost = np.isnan(states).any()
                if touched and not lost and (numbers.discs[p, :, 2] > 0).any():
                    states, _ = stepped(self._new_world(choice), substeps=int(count) * FINER)
                if level == 0 or np.isnan(states).any():  # diverged
                    out[item] = states
                if touched:
                    break
                total += weight * states
            else:
                given_path = [body.kinematic for body in self.physics.scene.moving]
                total[:, given_path] = out[item][:, given_path]  # but for rounding it is so
                out[item] = total


def simulator_of(physics: PhysicsSettings, engine: str = "auto", **changes: Any) -> Simulator:
    """Return a simulator of the physics on an engine of `Physics`, or on "python": this one."""
    if engine == "python":
        return PlainSimulator(physics.changed(**changes))
    return Simulator(physics.changed(engine=engine, **changes))


def rollout(
    world: World,
    effects: tuple[Attached, ...],
    numbers: EngineInput,
    proposal: int,
    item: int,
    start: Floats,
    inputs: Floats,
    earlier: Floats,
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
        Initial state, shape (body, 6), SI units.
    inputs : ndarray
        Inputs of each interval, shape (H, body, 3 or 9): wrenches in N and N m (of a kinematic
        body, velocities in m/s and rad/s), and the rest as in :data:`pbrl_ppl.state.INPUT`.
    earlier : ndarray
        Inputs of the intervals of the recording that lead up to the first one and it, shape
        (interval, body, 3 or more).
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
    acting = Acting(world.scene, effects, numbers, proposal, earlier, start)
    step = world.scene.time_step / substeps
    states = np.empty((len(inputs), len(start), 6))
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
            wrench = acting(now, interval, s / substeps, (s + 1) / substeps)
            for i, body in enumerate(world.bodies):
                if world.kinematic[i]:
                    continue
                weight = bodies[i, COLUMN.mass] * bodies[i, _EXTRA]
                x, y = _arm(body)
                body.force = tuple(wrench[i, :2] + weight)
                body.torque = wrench[i, 2] - (x * wrench[i, 1] - y * wrench[i, 0])
            _place_constraints(world, acting, bodies, joints, now, step)
            world.space.step(step)
            now = _states(world)
            touched = touched or bool(near_contact(now, *nearness))
            speeds = np.abs(now[:, 3:])
            if not (speeds @ (1.0, 1.0, world.size) < world.fastest).all():  # also true of NaN
                states[:] = np.nan
                return states, True
        states[h] = now
        acting.remember(now, interval)
    return states, touched


class Acting:
    """Laws of a proposal, and what they remember in one trajectory.

    Parameters
    ----------
    scene : Scene
        Bodies and their joints, and the sampling interval.
    effects : tuple of Attached
        Effects; those with laws act.
    numbers : EngineInput
        The engine's numbers of all proposals.
    proposal : int
        Index of the proposal.
    earlier : ndarray
        Inputs of the intervals of the recording that lead to the first one, (interval, body, 3 or
        more).
    start : ndarray
        Initial state, shape (body, 6).
    """

    def __init__(
        self,
        scene: Scene,
        effects: tuple[Attached, ...],
        numbers: EngineInput,
        proposal: int,
        earlier: Floats,
        start: Floats,
    ) -> None:
        names = [body.name for body in scene.moving]

        def laws(kind: type[Stage], parameters: Floats) -> list[tuple[int, Stage, Floats]]:
            first, rows = 0, []
            for attached in at_stage(effects, kind):
                effect = attached.effect
                last = first + len(effect.parameters) + len(effect.constants)
                if isinstance(effect.stage, kind):
                    rows.append((names.index(attached.body), effect.stage, parameters[first:last]))
                first = last
            return rows

        self._commands = laws(Command, numbers.commands[proposal])
        self._forces = laws(Force, numbers.forces[proposal])
        self._frictions = laws(Friction, numbers.frictions[proposal])
        #: What each body hangs on; -1 for nothing that moves.
        self._others = {names.index(one.body): holder(scene, one) for one in effects}
        self._time_step, self.command = scene.time_step, np.zeros((len(names), 3))
        width = earlier.shape[-1]
        older = [np.arange(j, j + 3) for j in range(9, width, 3)]
        past = earlier[0][:, [np.arange(3, 6), *older][-1]] if width > 3 else self.command
        self._memory = []
        for i, stage, parameters in self._commands:
            last = past[i].copy()
            if stage.begins and earlier[0, 0, 7] < np.inf:
                last += parameters[-1] * (earlier[0, i, :3] - last)
            self._memory.append(np.tile(_alone(last, stage), stage.memory))
        self._held = [np.zeros(stage.memory) for _, stage, _ in self._forces]
        for (i, force, parameters), held in zip(self._forces, self._held, strict=True):
            if force.begin is not None:
                force.begin(start[i], np.zeros(MEMORY), parameters, held)
        for before, now in pairwise([np.arange(3, 6), *older][::-1]):
            self.remember(start, np.hstack([earlier[0][:, now], earlier[0][:, before], 0 * past]))
        for interval in earlier[:-1]:
            self.remember(start, interval)

    def __call__(
        self, states: Floats, interval: Floats, begin: float, end: float, after: bool = False
    ) -> Floats:
        """Return the wrench on each body in a substep, shape (body, 3); see `laws.act`."""
        known = interval.shape[1] > 3
        # and by how much actuators are turned
        work = np.hstack([interval[:, :3], np.zeros((len(interval), 6))])
        signals = np.zeros((len(interval), MEMORY + MOST_MEMORY))
        signals[:, [TIME, INTERVAL]] = np.inf, self._time_step
        if known:
            signals[:, TIME] = interval[:, 7] + begin * self._time_step
        for (i, stage, parameters), memory in zip(self._commands, self._memory, strict=True):
            signal, wrench = signals[i].copy(), work[i]
            if stage.alone:
                wrench = _alone(work[i], stage)
            signal[:3] = wrench[:3]
            signal[3:6] = _alone(interval[i, 3:6] if known else np.zeros(3), stage)
            signal[6:8] = begin, end
            signal[MEMORY : MEMORY + len(memory)] = memory
            seen = states[i]
            if (other := self._others.get(i, -1)) >= 0 and stage.reacts:
                seen = seen - states[other] * np.isin(np.arange(6), (2, 5))
            stage.law(seen, signal, parameters, wrench)
            if stage.alone:
                work[i, WRENCH.index(stage.alone)] = wrench[0]
            if after and stage.remember is not None:
                stage.remember(states[i], signal, parameters, memory)
        self.command = work[:, :3].copy()
        total = self.command.copy()
        for i, stage, _ in self._commands:
            if (other := self._others.get(i, -1)) >= 0 and stage.reacts:
                total[other, 2] -= self.command[i, 2]
        signals[:, :3] = self.command
        for (i, force, parameters), held in zip(self._forces, self._held, strict=True):
            signals[i, MEMORY : MEMORY + len(held)] = held
            change = np.zeros_like(held)
            if force.rate is not None and not after:
                force.rate(states[i], signals[i], parameters, change)
            force.law(states[i], signals[i], parameters, total[i])
            held += (end - begin) * self._time_step * change
        return total

    def remember(self, states: Floats, interval: Floats) -> None:
        """Bring what laws remember up to date at the end of an interval."""
        if any(stage.remember is not None for _, stage, _ in self._commands):
            self(states, interval, 1.0 - WINDOW, 1.0, after=True)

    def bound(self, base: float, i: int, states: Floats, under: bool, *signal: float) -> float:
        """Return the greatest force of dry friction in a body's hinge or under it; see `laws`."""
        most = np.array([base])
        for body, stage, parameters in self._frictions:
            if body == i and stage.under == under:
                stage.law(states[i], np.array(signal), parameters, most)
                most = np.maximum(most, 0.0)
        return float(most[0])


def _alone(wrench: Floats, stage: Command) -> Floats:
    """Return what a command law sees of a wrench."""
    if not stage.alone:
        return wrench.copy()
    return np.array([wrench[WRENCH.index(stage.alone)], 0.0, 0.0])


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


def _place_constraints(
    world: World, acting: Acting, bodies: Floats, joints: Floats, states: Floats, step: float
) -> None:
    """Put the far ends of rods where the substep is predicted to end; set greatest forces."""
    pivots = np.array(world.pivots, dtype=np.int64).reshape(-1, 3)
    gravity = np.array(world.scene.gravity, dtype=float)
    for constraint, setting, i, _ in world.body_settings:
        if setting.attribute == "max_force" and setting.columns == (COLUMN.pivot_torque,):
            signal = hinge_signal(
                pivots, gravity, bodies[i], joints, states[i], acting.command[i], i
            )
            base = bodies[i, COLUMN.pivot_torque]
            constraint.max_force = acting.bound(base, i, states, False, *signal)
    for i, (along_x,), (along_y,) in world.wheels:
        after, turn = glide(bodies[i], states[i], step), bodies[i, COLUMN.w_theta]
        x_1, y_1, x_2, y_2 = wheel_ends(bodies[i], after, math.cos(turn), math.sin(turn))
        along_x.anchor_b, along_y.anchor_b = (x_1, y_1), (x_2, y_2)
    for i, holds, rods in world.patches:
        row, after = bodies[i], glide(bodies[i], states[i], step)
        most, speed = patch_signal(row, states[i], world.scene.normal_gravity)
        most = acting.bound(most, i, states, True, 0.0, 0.0, speed)
        slowing, most = most / row[COLUMN.mass], most / len(RING)
        for point, hold, rod in zip(RING, holds, rods, strict=True):
            x, y, share = patch_point(row, after, states[i, 5], point, step, slowing)
            rod.anchor_b = x, y
            hold.max_force, rod.max_force = (1.0 - share) * most, share * most
