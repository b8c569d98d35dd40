"""Rollouts of MuJoCo to a history: arrays of qpos, qvel and ctrl, of bodies that move in a plane.

MuJoCo itself is not imported: a model's arrays say all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.history import History
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, WRENCH

Floats = npt.NDArray[np.float64]

#: A plane's axes in MuJoCo's world, and its normal: a top view, and a side view.
_PLANES = {"xy": np.eye(3), "xz": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}
#: mjtJoint, mjtTrn, mjtGain, mjtBias, mjtDyn as numbers, as mjmodel.h has them.
_FREE, _SLIDE, _HINGE = 0, 2, 3
_TO_JOINT, _FIXED, _NONE = 0, 0, 0
#: How far out of the plane is out of it (of a unit vector, or m).
_FLAT = 1e-3


@dataclass(frozen=True)
class _Joint:
    """A joint's number, kind, axis in the plane's coordinates, and places in qpos and qvel."""

    number: int
    kind: int
    axis: Floats
    position: int
    velocity: int
    reference: float


def from_mujoco(
    model: Any,
    scene: Scene,
    qpos: npt.ArrayLike,
    qvel: npt.ArrayLike,
    *,
    ctrl: npt.ArrayLike | None = None,
    wrench: npt.ArrayLike | None = None,
    plane: str = "xy",
    time_step: float | None = None,
    estimate_velocities: bool = False,
) -> History:
    """Make a history of MuJoCo rollouts of bodies that move in a plane.

    Bodies go by their names in the model. A body has slide joints along the plane's axes, a hinge
    about its normal, or a free joint; of what has no joint of its own nothing is measured, so a
    pendulum's hinge gives its angle and rate. A scene's body has its origin where MuJoCo's body
    frame is: put that at the shape's centroid, unless a hinge alone holds it.

    Parameters
    ----------
    model : mujoco.MjModel
        Its joints, and its actuators where ``ctrl`` is given.
    scene : Scene
        The bodies to read, and the time step: a whole number of rows' time steps.
    qpos : array
        Shape (trajectory, row, nq), or (row, nq) of one, as ``mujoco.rollout`` gives them with the
        first state before them; m and rad.
    qvel : array
        Shape (..., row, nv); m/s and rad/s.
    ctrl : array, optional
        Of motors (gain, no bias, no dynamics) at those joints, shape (..., row, nu), or with one
        row less: what acts from a row to the next.
    wrench : array, optional
        In place of ``ctrl``: force and torque at each body's origin, shape (..., row, body, 3), or
        one row less, in the order of ``scene.moving``; N, N, N m. Without either, nothing pushes.
    plane : str
        ``xy``, a top view, or ``xz``, a side view, whose angle turns from x to z.
    time_step : float, optional
        Between rows (s); ``model.opt.timestep`` by default.
    estimate_velocities : bool
        As of :meth:`History.load`.

    Raises
    ------
    HistoryError
        If shapes do not fit the model, a body leaves the plane, or an actuator is no motor of a
        body's joint.

    Examples
    --------
    ::

        state, _ = mujoco.rollout.rollout(model, data, start, ctrl)
        # the first column is time
        qpos, qvel = state[..., 1 : 1 + model.nq], state[..., 1 + model.nq :]
        history = pp.from_mujoco(model, scene, qpos[:, :-1], qvel[:, :-1], ctrl=ctrl[:, 1:])
    """
    if plane not in _PLANES:
        raise HistoryError(f"plane is {plane!r}, expected xy (a top view) or xz (a side view)")
    positions = _batched(qpos, model.nq, "qpos", "nq")
    velocities = _batched(qvel, model.nv, "qvel", "nv")
    if positions.shape[:2] != velocities.shape[:2]:
        raise HistoryError(
            f"qpos has {positions.shape[:2]} trajectories and rows, qvel {velocities.shape[:2]};"
            " expected the same"
        )
    n, rows = positions.shape[:2]
    step = float(model.opt.timestep if time_step is None else time_step)
    every = round(scene.time_step / step)
    if every < 1 or abs(every * step - scene.time_step) > 1e-6 * scene.time_step:
        raise HistoryError(
            f"rows are {step:g} s apart and the scene's time_step is {scene.time_step:g} s;"
            " expected a whole number of rows a step; change the scene's, or give time_step"
        )
    bodies = [body.name for body in scene.moving]
    joints = {name: _joints(model, name, _PLANES[plane]) for name in bodies}
    state = np.full((n, rows, len(bodies), len(STATE)), np.nan)
    for place, name in enumerate(bodies):
        base = _PLANES[plane][:2] @ np.asarray(model.body(name).pos)
        _fill(state[:, :, place], joints[name], positions, velocities, base, _PLANES[plane], name)
    if ctrl is not None and wrench is not None:
        raise HistoryError("ctrl and wrench are both given; expected one of them")
    acts = np.zeros((n, rows, len(bodies), len(WRENCH)))
    if ctrl is not None:
        acts = _pushes(model, joints, _batched(ctrl, model.nu, "ctrl", "nu"))
    elif wrench is not None:
        flat = np.asarray(wrench, dtype=float)
        flat = flat.reshape(*flat.shape[:-2], -1) if flat.ndim > 2 else flat
        acts = _batched(flat, len(bodies) * len(WRENCH), "wrench", "3 a body")
        acts = acts.reshape(*acts.shape[:2], len(bodies), len(WRENCH))
    if acts.shape[0] != n or acts.shape[1] not in (rows, rows - 1):
        raise HistoryError(
            f"ctrl or wrench has {acts.shape[:2]} trajectories and rows, expected {(n, rows)}, as"
            " qpos, or one row less"
        )
    kept = (rows - 1) // every
    if kept < 1:
        raise HistoryError(f"{rows} rows are less than a step of {every} rows and its end")
    # the mean keeps the impulse where the command changes within a step
    mean = acts[:, : kept * every].reshape(n, kept, every, len(bodies), len(WRENCH)).mean(axis=2)
    mean = np.concatenate([mean, np.full((n, 1, *mean.shape[2:]), np.nan)], axis=1)
    state = state[:, : kept * every + 1 : every]
    trajectory, row, body = np.indices(state.shape[:3]).reshape(3, -1)
    table = {
        "trajectory": trajectory,
        "step": row,
        "time": row * scene.time_step,
        "body": np.array(bodies)[body],
        **dict(zip(STATE, state.reshape(-1, len(STATE)).T, strict=True)),
        **dict(zip(WRENCH, mean.reshape(-1, len(WRENCH)).T, strict=True)),
    }
    return History.from_dataframe(
        pd.DataFrame(table), scene, estimate_velocities=estimate_velocities, source="MuJoCo rollout"
    )


def _batched(values: npt.ArrayLike, width: int, name: str, of: str) -> Floats:
    """An array as (trajectory, row, width)."""
    array = np.asarray(values, dtype=float)
    array = array[None] if array.ndim == 2 else array
    if array.ndim != 3 or array.shape[-1] != width:
        raise HistoryError(
            f"{name} has shape {np.shape(values)}, expected (trajectory, row, {width}): {of} of the"
            " model"
        )
    return array


def _joints(model: Any, name: str, axes: Floats) -> list[_Joint]:
    """A body's own joints, each along one of the plane's axes."""
    try:
        body = model.body(name)
    except KeyError:
        raise HistoryError(
            f'the MuJoCo model has no body "{name}"; name its bodies as the scene does'
        ) from None
    first, count = int(np.ravel(body.jntadr)[0]), int(np.ravel(body.jntnum)[0])
    found = []
    for number in range(first, first + count):
        kind = int(model.jnt_type[number])
        axis = axes @ np.asarray(model.jnt_axis[number])
        along = np.abs(axis[2]) if kind == _HINGE else np.linalg.norm(axis[:2])
        if kind not in (_FREE, _SLIDE, _HINGE) or (kind != _FREE and along < 1 - _FLAT):
            raise HistoryError(
                f'body "{name}": its joint {number} leads out of the plane; expected slides in it,'
                " a hinge about its normal, or a free joint"
            )
        if count > 1 and kind == _HINGE and np.abs(model.jnt_pos[number]).max() > _FLAT:
            raise HistoryError(
                f'body "{name}": its hinge is not at its frame\'s origin, as a body that slides'
                " needs; put the frame there"
            )
        place, rate = int(model.jnt_qposadr[number]), int(model.jnt_dofadr[number])
        reference = float(model.qpos0[place])
        found.append(_Joint(number, kind, axis, place, rate, reference))
    slides = [joint for joint in found if joint.kind == _SLIDE]
    turns = np.abs(np.asarray(model.body(name).quat)[1:]).max()
    if len(slides) == 1 or (found and found[0].kind != _FREE and turns > _FLAT):
        raise HistoryError(
            f'body "{name}": expected slides along both axes or none, and a body that is not'
            " turned in the model; a free joint has all"
        )
    if slides and int(np.ravel(model.body(name).parentid)[0]) != 0:
        raise HistoryError(
            f'body "{name}" slides on another body; expected one that slides in the world'
        )
    return found


def _fill(
    state: Floats,
    joints: list[_Joint],
    qpos: Floats,
    qvel: Floats,
    base: Floats,
    axes: Floats,
    name: str,
) -> None:
    """Fill one body's states (trajectory, row, 6) in place with what its joints say."""
    if any(joint.kind == _SLIDE for joint in joints):
        state[..., :2], state[..., 3:5] = base, 0.0
    for joint in joints:
        at, rate = joint.position, joint.velocity
        if joint.kind == _FREE:
            place = qpos[..., at : at + 3] @ axes.T
            quat, spin = qpos[..., at + 3 : at + 7], qvel[..., rate + 3 : rate + 6] @ axes.T
            turn = quat[..., 1:] @ axes.T
            drift = np.ptp(place[..., 2], axis=1).max() if place.size else 0.0
            if np.abs(turn[..., :2]).max() > _FLAT or drift > _FLAT:
                raise HistoryError(
                    f'body "{name}" leaves the plane; expected one that moves in it alone'
                )
            state[..., :2] = place[..., :2]
            state[..., 2] = 2 * np.arctan2(turn[..., 2], quat[..., 0])
            state[..., 3:5] = (qvel[..., rate : rate + 3] @ axes.T)[..., :2]
            state[..., 5] = spin[..., 2]
        elif joint.kind == _SLIDE:
            moved = qpos[..., at] - joint.reference
            state[..., :2] += moved[..., None] * joint.axis[:2]
            state[..., 3:5] += qvel[..., rate, None] * joint.axis[:2]
        else:
            state[..., 2] = (qpos[..., at] - joint.reference) * joint.axis[2]
            state[..., 5] = qvel[..., rate] * joint.axis[2]


def _pushes(model: Any, joints: dict[str, list[_Joint]], ctrl: Floats) -> Floats:
    """Wrenches of motors at joints, shape (trajectory, row, body, 3)."""
    holder = {j.number: (place, j) for place, own in enumerate(joints.values()) for j in own}
    wrench = np.zeros((*ctrl.shape[:2], len(joints), len(WRENCH)))
    for number in range(ctrl.shape[-1]):
        kinds = (model.actuator_gaintype[number], model.actuator_biastype[number],
                 model.actuator_dyntype[number], model.actuator_trntype[number])  # fmt: skip
        place, joint = holder.get(int(model.actuator_trnid[number, 0]), (-1, None))
        if joint is None or joint.kind == _FREE or tuple(map(int, kinds)) != (
            _FIXED, _NONE, _NONE, _TO_JOINT
        ):  # fmt: skip
            raise HistoryError(
                f"actuator {number} is no motor of a slide or hinge of the scene's bodies; give"
                " wrench in place of ctrl"
            )
        value = ctrl[..., number]
        if model.actuator_ctrllimited[number]:
            value = np.clip(value, *model.actuator_ctrlrange[number])
        force = value * model.actuator_gainprm[number, 0]
        if model.actuator_forcelimited[number]:
            force = np.clip(force, *model.actuator_forcerange[number])
        force = force * model.actuator_gear[number, 0]
        if joint.kind == _SLIDE:
            wrench[:, :, place, :2] += force[..., None] * joint.axis[:2]
        else:
            wrench[:, :, place, 2] += force * joint.axis[2]
    return wrench
