"""Histories of MuJoCo rollouts: arrays of qpos, qvel and ctrl, of bodies that move in a plane.

MuJoCo itself is not imported: a model's arrays are enough.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, WRENCH, Floats

if TYPE_CHECKING:
    import mujoco

#: A plane's axes in MuJoCo's world, and its normal: a top view, and a side view.
PLANES = {"xy": np.eye(3), "xz": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}
#: mjtJoint as numbers, as in mjmodel.h.
FREE, SLIDE, HINGE = 0, 2, 3
#: How far out of the plane is out of it, of a unit vector or in bounding radii.
FLAT = 1e-3


@dataclass(frozen=True)
class _Joint:
    """A joint's number, kind, direction in the plane, and places in qpos and qvel.

    ``direction`` is the change of x, y and theta by which the joint moves, and the force_x, force_y
    and torque of a motor, each for one unit. ``parent`` is the moving body that holds its body, if
    any.
    """

    number: int
    kind: int
    direction: Floats
    position: int
    velocity: int
    reference: float
    parent: str | None


def from_mujoco(
    model: mujoco.MjModel,
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
    """Return a history of MuJoCo rollouts of bodies that move in a plane.

    Bodies go by their names in the model. A body has slide joints along the plane's axes, a hinge
    about its normal, or a free joint; a coordinate without a joint is not measured, so a
    pendulum's hinge gives its angle and rate. Angles in a chain of hinges are added up, and a motor
    between two bodies acts on both. A scene's body has its origin where MuJoCo's body
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
        history = from_mujoco(model, scene, qpos[:, :-1], qvel[:, :-1], ctrl=ctrl[:, 1:])
    """
    if plane not in PLANES:
        raise HistoryError(f"plane is {plane!r}, expected xy (a top view) or xz (a side view)")
    positions = _batched(qpos, model.nq, "qpos", "nq")
    velocities = _batched(qvel, model.nv, "qvel", "nv")
    if positions.shape[:2] != velocities.shape[:2]:
        raise HistoryError(
            f"qpos has {positions.shape[:2]} trajectories and rows, qvel {velocities.shape[:2]};"
            " expected the same"
        )
    (n, rows), axes = positions.shape[:2], PLANES[plane]
    every = _rows_in_a_step(model, scene, time_step)
    reach = {body.name: body.shape.bounding_radius for body in scene.moving}
    joints = {name: _joints(model, name, axes, size) for name, size in reach.items()}
    k = len(joints)
    state = np.full((n, rows, k, len(STATE)), np.nan)
    for i, (name, body_joints) in enumerate(joints.items()):
        origin = axes[:2] @ np.asarray(model.body(name).pos)
        if not _fill(state[:, :, i], body_joints, positions, velocities, origin, axes, reach[name]):
            raise HistoryError(
                f'body "{name}" leaves the plane; expected one that moves in it alone'
            )
    _add_parents_angles(model, state, joints)
    action = _wrenches(model, joints, ctrl, wrench, (n, rows))
    if action.shape[0] != n or action.shape[1] not in (rows, rows - 1):
        raise HistoryError(
            f"ctrl or wrench has {action.shape[:2]} trajectories and rows, expected {(n, rows)}, as"
            " qpos, or one row less"
        )
    kept = (rows - 1) // every
    if kept < 1:
        raise HistoryError(f"{rows} rows are less than a step of {every} rows and its end")
    # the mean keeps the impulse where the command changes within a step
    mean = action[:, : kept * every].reshape(n, kept, every, k, len(WRENCH)).mean(axis=2)
    return History.of_arrays(
        state[:, : kept * every + 1 : every], scene, mean, estimate_velocities=estimate_velocities
    )


def _wrenches(
    model: mujoco.MjModel,
    joints: dict[str, list[_Joint]],
    ctrl: npt.ArrayLike | None,
    wrench: npt.ArrayLike | None,
    shape: tuple[int, int],
) -> Floats:
    """Return what acts on each body, shape (trajectory, row, body, 3); zero where nothing is given.

    Parameters and errors are those of :func:`from_mujoco`.
    """
    k = len(joints)
    if ctrl is not None and wrench is not None:
        raise HistoryError("ctrl and wrench are both given; expected one of them")
    if ctrl is not None:
        return _motor_wrenches(model, joints, _batched(ctrl, model.nu, "ctrl", "nu"))
    if wrench is None:
        return np.zeros((*shape, k, len(WRENCH)))
    flat = np.asarray(wrench, dtype=float)
    flat = flat.reshape(*flat.shape[:-2], -1) if flat.ndim > 2 else flat
    action = _batched(flat, k * len(WRENCH), "wrench", "3 a body")
    return action.reshape(*action.shape[:2], k, len(WRENCH))


def _rows_in_a_step(model: mujoco.MjModel, scene: Scene, time_step: float | None) -> int:
    """Return the number of rows in a time step of the scene."""
    step = float(model.opt.timestep if time_step is None else time_step)
    every = round(scene.time_step / step)
    if every < 1 or abs(every * step - scene.time_step) > 1e-6 * scene.time_step:
        raise HistoryError(
            f"rows are {step:g} s apart and the scene's time_step is {scene.time_step:g} s;"
            " expected a whole number of rows a step; change the scene's, or give time_step"
        )
    return every


def _batched(values: npt.ArrayLike, width: int, name: str, symbol: str) -> Floats:
    """Return an array as (trajectory, row, width)."""
    array = np.asarray(values, dtype=float)
    array = array[None] if array.ndim == 2 else array
    if array.ndim != 3 or array.shape[-1] != width:
        raise HistoryError(
            f"{name} has shape {np.shape(values)}, expected (trajectory, row, {width}): {symbol} of"
            " the model"
        )
    return array


def _joints(model: mujoco.MjModel, name: str, axes: Floats, reach: float) -> list[_Joint]:
    """Return a body's joints, each along one of the plane's axes."""
    try:
        body = model.body(name)
    except KeyError:
        raise HistoryError(
            f'the MuJoCo model has no body "{name}"; name its bodies as the scene does'
        ) from None
    numbers = (body.jntadr, body.jntnum, body.parentid)
    first, count, parent = (int(np.ravel(number)[0]) for number in numbers)
    holder = int(model.body_weldid[parent])
    above = str(model.body(holder).name) if holder else None
    joints = []
    for number in range(first, first + count):
        kind = int(model.jnt_type[number])
        axis = axes @ np.asarray(model.jnt_axis[number])
        along = np.abs(axis[2]) if kind == HINGE else np.linalg.norm(axis[:2])
        if kind not in (FREE, SLIDE, HINGE) or (kind != FREE and along < 1 - FLAT):
            raise HistoryError(
                f'body "{name}": its joint {number} leads out of the plane; expected slides in it,'
                " a hinge about its normal, or a free joint"
            )
        if count > 1 and kind == HINGE and np.abs(model.jnt_pos[number]).max() > FLAT * reach:
            raise HistoryError(
                f'body "{name}": its hinge is not at its frame\'s origin, as a body that slides'
                " needs; put the frame there"
            )
        place, rate = int(model.jnt_qposadr[number]), int(model.jnt_dofadr[number])
        direction = axis * ([0.0, 0.0, 1.0] if kind == HINGE else [1.0, 1.0, 0.0])
        reference = float(model.qpos0[place])
        joints.append(_Joint(number, kind, direction, place, rate, reference, above))
    slides = [joint for joint in joints if joint.kind == SLIDE]
    turns = np.abs(np.asarray(body.quat)[1:]).max()
    if (len(slides) == 1 and len(joints) > 1) or (
        joints and joints[0].kind != FREE and turns > FLAT
    ):
        raise HistoryError(
            f'body "{name}": expected slides along both axes, one slide alone or none, and a body'
            " that is not turned in the model; a free joint has all"
        )
    if slides and parent != 0:
        raise HistoryError(
            f'body "{name}" slides on another body; expected one that slides in the world'
        )
    return joints


def _fill(
    state: Floats,
    joints: list[_Joint],
    qpos: Floats,
    qvel: Floats,
    origin: Floats,
    axes: Floats,
    reach: float,
) -> bool:
    """Fill a body's states (trajectory, row, 6) in place; return whether it stays in the plane."""
    kinds = [joint.kind for joint in joints]
    if SLIDE in kinds:
        state[..., :2], state[..., 3:5] = origin, 0.0
    if HINGE in kinds or kinds == [SLIDE]:  # a slider alone does not turn
        state[..., [2, 5]] = 0.0
    for joint in joints:
        at, rate = joint.position, joint.velocity
        if joint.kind == FREE:
            place = qpos[..., at : at + 3] @ axes.T
            turn = qpos[..., at + 4 : at + 7] @ axes.T
            drift = np.ptp(place[..., 2], axis=1).max() if place.size else 0.0
            if np.abs(turn[..., :2]).max() > FLAT or drift > FLAT * reach:
                return False
            state[..., :2] = place[..., :2]
            state[..., 2] = 2 * np.arctan2(turn[..., 2], qpos[..., at + 3])
            state[..., 3:5] = (qvel[..., rate : rate + 3] @ axes.T)[..., :2]
            state[..., 5] = (qvel[..., rate + 3 : rate + 6] @ axes.T)[..., 2]
        else:
            state[..., :3] += (qpos[..., at, None] - joint.reference) * joint.direction
            state[..., 3:] += qvel[..., rate, None] * joint.direction
    return True


def _add_parents_angles(
    model: mujoco.MjModel, state: Floats, joints: dict[str, list[_Joint]]
) -> None:
    """Add to angles and rates in a chain of hinges those of the bodies above, in place."""
    order = list(joints)
    hanging = [(name, one.parent) for name, every in joints.items() for one in every if one.parent]
    for name, parent in sorted(hanging, key=lambda pair: int(model.body(pair[0]).id)):
        if parent not in joints:
            raise HistoryError(
                f'body "{name}" hangs on body "{parent}" of the MuJoCo model, which does not move'
                " in the scene; add that body to the scene"
            )
        # parents come first
        state[:, :, order.index(name), 2::3] += state[:, :, order.index(parent), 2::3]


def _motor_wrenches(model: mujoco.MjModel, joints: dict[str, list[_Joint]], ctrl: Floats) -> Floats:
    """Return the wrenches of motors at joints, shape (trajectory, row, body, 3)."""
    every = enumerate(joints.values())
    holder = {joint.number: (i, joint) for i, of_body in every for joint in of_body}
    wrench = np.zeros((*ctrl.shape[:2], len(joints), len(WRENCH)))
    # a motor has a fixed gain, no bias, no dynamics, and acts on a joint
    kinds = (model.actuator_gaintype, model.actuator_biastype, model.actuator_dyntype)
    for number in range(ctrl.shape[-1]):
        is_motor = not any(kind[number] for kind in (*kinds, model.actuator_trntype))
        body, joint = holder.get(int(model.actuator_trnid[number, 0]), (-1, None))
        if not is_motor or joint is None or joint.kind == FREE:
            raise HistoryError(
                f"actuator {number} is no motor of a slide or hinge of the scene's bodies; give"
                " wrench in place of ctrl"
            )
        force = ctrl[..., number]
        for limited, limits, gain in (
            (model.actuator_ctrllimited, model.actuator_ctrlrange, model.actuator_gainprm),
            (model.actuator_forcelimited, model.actuator_forcerange, model.actuator_gear),
        ):
            force = np.clip(force, *limits[number]) if limited[number] else force
            force = force * gain[number, 0]
        acts = force[..., None] * joint.direction
        wrench[:, :, body] += acts
        if joint.parent is not None:  # of a hinge: slides are in the world
            wrench[:, :, list(joints).index(joint.parent)] -= acts
    return wrench
