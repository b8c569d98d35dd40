"""Recordings of the drawn bodies: MuJoCo and Box2D, engines that pbrl_ppl does not use."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import Box2D
import mujoco
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from attribution.bodies import MUJOCO, PAIR, Body, Hidden, Rng, mh
from pbrl_ppl.state import STATE, WRENCH

Array = NDArray[np.float64]
#: Steps of MuJoCo (s): of fourth order, and where dry friction holds.
_SMOOTH, _DRY = 0.002, 0.0005
#: MuJoCo's dry friction as hard as it can be.
_HARD = 'solreffriction="0.001 1" solimpfriction="0.99 0.9999 0.0001"'
#: Box2D's position and velocity iterations.
_ROUNDS = (20, 10)


@dataclass(frozen=True)
class Effects(mh.Effects):
    """Undeclared physics of MuJoCo and Box2D."""

    com_offset: tuple[float, float] = (0.0, 0.0)  # m, body frame


def simulate(
    seed: int, body: Body, on: str | None, hidden: Mapping[str, Hidden], coarse: bool = False
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return (train, test) in the history format, as `make_history.simulate` does.

    Parameters
    ----------
    seed : int
        Of the starts, the pushes and the noise.
    body : Body
        What moves.
    on : str, optional
        The body that has the hidden effects.
    hidden : dict of str to Hidden
        Their values.
    coarse : bool
        Whether a wheel's steps are four times as long and the test is one trajectory.
    """
    first = body.setups[0]
    if coarse:
        first = replace(first, n_test=1, step=4 * first.step if first.wheel else first.step)
    if body.sort not in (*MUJOCO, PAIR):
        return mh.simulate(seed, first, **dict(body.base), **hidden)
    base: dict[str, Any] = dict(body.base)
    effects = [Effects(**base, **(hidden if name == on else {})) for name in body.names]
    rng = np.random.default_rng(seed)
    recordings = [
        [_trajectory(rng, body, effects, k, before) for k in range(count)]
        for count, before in ((first.n_train, 0), (first.n_test, first.n_train))
    ]
    train, test = (pd.concat(frames, ignore_index=True) for frames in recordings)
    return train, test


def _trajectory(
    rng: Rng, body: Body, effects: list[Effects], number: int, before: int
) -> pd.DataFrame:
    """Return one trajectory, recorded after a number of others."""
    first = body.setups[0]
    n, count = first.n_intervals, len(body.setups)
    starts = _apart(rng, body) if body.sort == PAIR else _starts(rng, body)
    sizes = [setup.wrench_sd for setup in body.setups]
    held = rng.normal(0.0, sizes, (math.ceil(n / first.hold), count, 3))
    wrenches = np.repeat(held, first.hold, axis=0)[:n].round(6)
    play = collide if body.sort == PAIR else integrate
    states = play(body, starts, wrenches, effects, before + number)
    frames = []
    for i, name in enumerate(body.names):
        noise = rng.standard_normal((n + 1, 6)) * np.array(first.noise)
        frame = pd.DataFrame({"trajectory": number, "step": range(n + 1)})
        frame["time"] = (frame["step"] * first.time_step).round(6)
        frame["body"] = name
        frame[list(STATE)] = (mh.sensed(effects[i], states[:, i]) + noise).round(6)
        frame[list(WRENCH)] = np.vstack([wrenches[:, i], np.full(3, np.nan)])
        frames.append(frame)
    return pd.concat(frames).sort_values("step", kind="stable")


def _starts(rng: Rng, body: Body) -> Array:
    limits, spreads = (
        [getattr(s, key) for s in body.setups] for key in ("start_range", "start_sd")
    )
    limits = np.array(limits)
    return np.concatenate([rng.uniform(-limits, limits), rng.normal(0.0, spreads)], axis=-1)


def _apart(rng: Rng, body: Body) -> Array:
    """Draw two discs near each other that mostly move towards each other."""
    starts = _starts(rng, body)
    way = cmath.exp(1j * rng.uniform(-math.pi, math.pi))
    gap = 0.5 * sum(setup.size[0] for setup in body.setups) * rng.uniform(1.05, 1.6)
    for state, setup, sign in zip(starts, body.setups, (-0.5, 0.5), strict=True):
        along = way * -2 * sign * abs(rng.normal(0.0, setup.start_sd[0]))
        state[:2] = sign * gap * way.real, sign * gap * way.imag
        state[3:5] = 0.5 * state[3:5] + (along.real, along.imag)
    return starts


class _Held:
    """Wrenches of the motors: the held wrench, delayed or lagging."""

    def __init__(self, effects: list[Effects], wrenches: Array) -> None:
        self.effects = effects
        self.now, self.reached = np.zeros((2, *wrenches.shape[1:]))
        self.before = np.concatenate([np.zeros((1, *wrenches.shape[1:])), wrenches])

    def at(self, i: int, share: float, step: float) -> Array:
        """Return the wrenches in the middle of a step (s) that starts at a share of interval i."""
        for k, effects in enumerate(self.effects):
            wanted = self.before[i if share < effects.actuator_delay else i + 1][k]
            half = math.exp(-0.5 * step / effects.actuator_lag) if effects.actuator_lag else 0.0
            self.now[k] = wanted + half * (self.reached[k] - wanted)
            self.reached[k] = wanted + half * (self.now[k] - wanted)
        return self.now


def integrate(
    body: Body, starts: Array, wrenches: Array, effects: list[Effects], number: int = 0
) -> Array:
    """Return MuJoCo's states (n + 1, body, 6) at the samples, noise-free."""
    first, held = body.setups[0], _Held(effects, wrenches)
    dry = any(each.pivot_friction for each in effects)
    model = mujoco.MjModel.from_xml_string(_model(body, effects, dry))
    data = mujoco.MjData(model)
    hung = first.hinge is not None
    data.qpos[:] = np.diff(starts[:, 2], prepend=0.0) if hung else starts[0, :3]
    data.qvel[:] = np.diff(starts[:, 5], prepend=0.0) if hung else starts[0, 3:]
    masses, moments = model.body_mass.copy(), model.body_inertia.copy()
    # a hinge's own damping is MuJoCo's: it is of the relative speed
    laws = [replace(each, pivot_damping=0.0) for each in effects]
    six, now = np.zeros(6), held.now
    scratch, loads = mujoco.MjData(model), [1.0] * len(effects)

    def act(model: Any, data: Any) -> None:
        for k, law in enumerate(laws):
            at, turn, velocity = _pose(model, data, k + 1, six)
            force, torque = mh.total_wrench(law, now[k], at, turn, *velocity, data.time)
            torque += mh.cross(at - complex(*data.xipos[k + 1, :2]), force)
            data.xfrc_applied[k + 1] = force.real, force.imag, 0.0, 0.0, 0.0, torque

    def state() -> Array:
        mujoco.mj_forward(model, data)
        angles = np.cumsum(data.qpos) if hung else data.qpos[2:]
        found = []
        for k, angle in enumerate(angles):
            at, _, (v, omega) = _pose(model, data, k + 1, six)
            found.append((at.real, at.imag, angle, v.real, v.imag, omega))
        return np.array(found)

    step = float(model.opt.timestep)
    steps = round(first.time_step / step)
    mujoco.set_mjcb_control(act)
    try:
        states = [state()]
        for i in range(len(wrenches)):
            for j in range(steps):
                held.at(i, j / steps, step)
                wanted = [_load(each, number, (i * steps + j) * step) for each in effects]
                if wanted != loads:
                    model.body_mass[1:] = masses[1:] * wanted
                    model.body_inertia[1:] = moments[1:] * np.array(wanted)[:, None]
                    mujoco.mj_setConst(model, scratch)
                    loads = wanted
                mujoco.mj_step(model, data)
            states.append(state())
    finally:
        mujoco.set_mjcb_control(None)
    return np.array(states)


def _load(effects: Effects, number: int, time: float) -> float:
    """Return the factor of the mass in a trajectory at a time."""
    factor, since, when = effects.mass_change
    return factor if number >= since and time >= when else 1.0


def _pose(
    model: Any, data: Any, k: int, six: Array
) -> tuple[complex, complex, tuple[complex, float]]:
    """Return place, heading (as a turn) and velocity of a body's origin."""
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, k, six, 0)
    turn = complex(data.xmat[k, 0], data.xmat[k, 3])
    return complex(*data.xpos[k, :2]), turn, (complex(six[3], six[4]), float(six[2]))


def _model(body: Body, effects: list[Effects], dry: bool) -> str:
    """Return MuJoCo's model: each body hangs in the one before, or slides in the plane."""
    down = -1j * body.setups[0].gravity * cmath.exp(1j * effects[0].gravity_tilt)
    nested, end = "", ""
    held_at = 0j
    for setup, own in zip(body.setups, effects, strict=True):
        hinge = setup.hinge
        at = held_at - (hinge or 0j)
        moment, com = setup.inertia * own.inertia_scale, own.com_offset
        joints = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0"))
        nested += f'<body pos="{at.real} {at.imag} 0">' + joints * (hinge is None)
        place = hinge or 0j
        friction = f'frictionloss="{own.pivot_friction}" {_HARD}' if own.pivot_friction else ""
        nested += (
            f'<joint type="hinge" axis="0 0 1" pos="{place.real} {place.imag} 0"'
            f' damping="{own.pivot_damping}" {friction}/>'
            f'<inertial pos="{com[0]} {com[1]} 0" mass="{setup.mass}"'
            f' diaginertia="{moment} {moment} {moment}"/>'
        )
        end, held_at = end + "</body>", -place
    option = (
        f'<option timestep="{_DRY if dry else _SMOOTH}" gravity="{down.real} {down.imag} 0"'
        f' integrator="{"implicitfast" if dry else "RK4"}"/>'
    )
    return f"<mujoco>{option}<worldbody>{nested}{end}</worldbody></mujoco>"


def collide(
    body: Body, starts: Array, wrenches: Array, effects: list[Effects], number: int = 0
) -> Array:
    """Return Box2D's states (n + 1, body, 6) of discs at the samples, noise-free.

    Half a kick, a step of the engine, half a kick: of second order. Places are added up in double
    precision where nothing touches.
    """
    cm, setups, held = mh.CM, body.setups, _Held(effects, wrenches)
    world = Box2D.b2World(gravity=(0, 0), doSleep=False, continuousPhysics=False)
    # the engine takes the root of the product and the larger of two: alike on both, they are the
    # products that pbrl_ppl takes
    rub, bounce = (math.prod(getattr(s, key) for s in setups) for key in ("mu_c", "r"))
    discs = []
    moments = [
        s.mass * s.size[0] ** 2 / 8 * e.inertia_scale for s, e in zip(setups, effects, strict=True)
    ]
    for setup, state, moment in zip(setups, starts, moments, strict=True):
        disc = world.CreateDynamicBody(
            position=tuple(cm * state[:2]), angle=float(state[2]),
            linearVelocity=tuple(cm * state[3:5]), angularVelocity=float(state[5]),
        )  # fmt: skip
        round_one = Box2D.b2CircleShape(radius=cm * setup.size[0] / 2)
        disc.CreateFixture(shape=round_one, density=1.0, friction=rub, restitution=bounce)
        disc.massData = Box2D.b2MassData(mass=setup.mass, center=(0, 0), I=moment * cm**2)
        discs.append(disc)
    step = setups[0].step
    steps = round(setups[0].time_step / step)
    poses = [[complex(*state[:2]), float(state[2])] for state in starts]

    def kick(wanted: Array, time: float) -> None:
        for k, (disc, own) in enumerate(zip(discs, effects, strict=True)):
            v, omega, mass = (
                complex(*disc.linearVelocity) / cm,
                disc.angularVelocity,
                setups[k].mass,
            )
            at, angle = poses[k]
            force, torque = mh.total_wrench(
                own, wanted[k], at, cmath.exp(1j * angle), v, omega, time
            )
            v, omega = v + force / mass * step / 2, omega + torque / moments[k] * step / 2
            if own.sliding_friction[0]:
                v, omega = mh.rub(*own.sliding_friction, step / 2, mass, moments[k], v, omega)
            disc.linearVelocity, disc.angularVelocity = (v.real * cm, v.imag * cm), omega

    def state() -> Array:
        return np.array(
            [
                (at.real, at.imag, angle, *np.array(disc.linearVelocity) / cm, disc.angularVelocity)
                for (at, angle), disc in zip(poses, discs, strict=True)
            ]
        )

    states = [state()]
    for i in range(len(wrenches)):
        for j in range(steps):
            wanted, time = held.at(i, j / steps, step), (i * steps + j) * step
            kick(wanted, time)
            world.Step(step, *_ROUNDS)
            for k, disc in enumerate(discs):
                shown = complex(*disc.position) / cm
                on = poses[k][0] + step * complex(*disc.linearVelocity) / cm
                turned = poses[k][1] + step * disc.angularVelocity
                pushed = max(abs(shown - on), abs(disc.angle - turned)) > mh.SINGLE
                poses[k] = [shown, disc.angle] if pushed else [on, turned]
                at, angle = poses[k]
                disc.transform = ((at.real * cm, at.imag * cm), angle)
            kick(wanted, time + step)
        states.append(state())
    return np.array(states)
