"""Catalogue of all effects, and their attachment to the bodies of a scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from pbrl_ppl.effects import actuators, drag, forces, friction, obstacles, sensors, springs
from pbrl_ppl.effects.actuation import actuation, laws_of_actuators
from pbrl_ppl.effects.effect import Attached, Command, Effect, Noise, is_pivoted
from pbrl_ppl.errors import EffectError
from pbrl_ppl.history import History
from pbrl_ppl.scene import Scene, nearest
from pbrl_ppl.state import STATE, THETA, Floats

#: Of effects that the data cannot separate, the earlier one is named: friction of a joint before
#: drag on a body, which looks the same on a single pendulum, and the simpler before the richer.
catalogue: tuple[Effect, ...] = (
    friction.pivot_damping, friction.pivot_friction, friction.pivot_load_friction,
    friction.pivot_stribeck, friction.slider_damping, friction.slider_friction,
    friction.slider_stribeck, drag.linear_drag, drag.quadratic_drag, drag.angular_drag,
    drag.quadratic_angular_drag, drag.drag_by_axis, drag.quadratic_drag_by_axis,
    forces.gravity_tilt, forces.constant_force, forces.body_force, forces.constant_torque,
    forces.push_offset, actuators.actuator_rotation, forces.inertia_scale, forces.com_offset,
    actuators.force_gain, actuators.torque_gain, actuators.anisotropic_gain,
    friction.sliding_friction, friction.turning_friction, friction.sliding_stribeck,
    friction.pivot_hysteresis, friction.wheel, actuators.actuator_delay, actuators.first_order_lag,
    actuators.dead_zone, actuators.torque_dead_zone, actuators.force_cutoff, actuators.saturation,
    actuators.torque_saturation, actuators.rate_limit, actuators.torque_rate_limit,
    actuators.actuator_backlash, actuators.torque_backlash, drag.magnus_force, drag.wind,
    springs.spring, springs.torsion_spring, springs.upper_stop, springs.lower_stop, forces.cogging,
    forces.mass_change, obstacles.hidden_obstacle, springs.distance_joint, sensors.sensor_bias,
    sensors.sensor_scale, sensors.askew_camera, sensors.encoder_eccentricity,
    sensors.frame_rotation, sensors.heavy_tails,
)  # fmt: skip


def attach(
    scene: Scene, extra: Iterable[Effect | Attached] = (), effects: Iterable[Effect] = catalogue
) -> tuple[Attached, ...]:
    """Return all effects of a model: those that the scene declares, then the extra ones.

    What its actuators do is an effect, too, and the turning of forces that its recording gives
    along the bodies' axes.

    Their priors are in SI units; see :func:`pbrl_ppl.scene.units_of`.

    Parameters
    ----------
    scene : Scene
        Its bodies name declared effects.
    extra : iterable of Effect or Attached
        More effects; a bare Effect acts on every dynamic body it applies to.
    effects : iterable of Effect
        Where declared names are looked up.

    Raises
    ------
    EffectError
        If a name is unknown, a body is not in the scene, an effect does not apply to its body, an
        effect would be attached twice, or one has the name of another in the catalogue.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> cart = Body("cart", Shape.box(1.0, 0.6), effects=("linear_drag",))
    >>> [a.effect.name for a in attach(Scene(time_step=0.1, bodies=(cart,)))]
    ['linear_drag']
    """
    bodies, given = {body.name: body for body in scene.dynamic}, list[Attached]()
    for item in extra:
        given += item.over(scene)
    # a user's effect that is given may also be declared by name, as in a saved scene
    every = (*effects, *(one.effect for one in given))
    check_names(every)
    by_name, result = {effect.name: effect for effect in every}, list[Attached]()
    stated = {(one.effect.name, one.body) for one in given}
    for body in scene.dynamic:
        acting = actuation(scene, body.name)
        if acting is not None:
            own = laws_of_actuators(scene, body.name)
            by_name |= {acting.name: acting} | {effect.name: effect for _, effect in own}
            if acting.name not in body.effects and (acting.name, body.name) not in stated:
                result.append(acting.on(body.name))
        for name in body.effects:
            if name not in by_name:
                hint = nearest(name, by_name)
                raise EffectError(
                    f"body {body.name!r} declares the effect {name!r}, which is not in the"
                    f" catalogue{hint}; give an effect of your own as an argument, or with"
                    f" --effect-file (known: {', '.join(by_name)})"
                )
            result.append(by_name[name].on(body.name))
    seen: set[tuple[str, str]] = set()
    for attached in (*result, *given):
        name, on_body = attached.effect.name, attached.body
        if on_body not in bodies:
            raise EffectError(
                f"effect {name} is put on {on_body!r}, which is not a moving body of the scene, or"
                f" is kinematic (effects may be put on {', '.join(bodies)})"
            )
        if not attached.effect.applies(scene, bodies[on_body]):
            raise EffectError(f"effect {name} does not apply to body {on_body!r}")
        if (name, on_body) in seen:
            raise EffectError(f"effect {name} is put on body {on_body!r} twice")
        seen.add((name, on_body))
    return tuple(attached.in_si(scene) for attached in (*result, *given))


def check_names(effects: Iterable[Effect]) -> None:
    """Raise if an effect has the name of a catalogue effect, but another law.

    Raises
    ------
    EffectError
        Names the effect.

    Examples
    --------
    >>> check_names(catalogue)
    """
    stages = {effect.name: effect.stage for effect in catalogue}
    for effect in effects:
        if effect.stage != stages.get(effect.name, effect.stage):
            raise EffectError(
                f"effect {effect.name}: the catalogue has another effect of this name; choose"
                " another name for yours"
            )


def candidates(
    scene: Scene,
    declared: Iterable[Attached],
    effects: Iterable[Effect] = catalogue,
    history: History | None = None,
) -> tuple[Attached, ...]:
    """Return every applicable effect on every body that the model does not have yet.

    The noise's shape is declared, and no candidate.

    Their priors are in SI units; see :func:`pbrl_ppl.scene.units_of`. Of a history only those that
    it can show: see ``Effect.needs``.
    """
    present = {(attached.effect.name, attached.body) for attached in declared}
    tried = {effect.name: effect for effect in effects}
    everywhere = [(effect, body) for effect in tried.values() for body in scene.dynamic]
    own = [
        (replace(effect, unusual=getattr(tried.get(of), "unusual", "")), body)
        for body in scene.dynamic
        for of, effect in laws_of_actuators(scene, body.name)
        if not of or of in tried
    ]
    shown = {body.name: _shown(scene, body.name, history) for body in scene.dynamic}
    return tuple(
        effect.on(body.name).in_si(scene)
        for effect, body in (*everywhere, *own)
        if (effect.name, body.name) not in present
        and not isinstance(effect.stage, Noise)
        and effect.applies(scene, body)
        and (history is None or _needed(effect) <= shown[body.name])
    )


def _needed(effect: Effect) -> set[str]:
    """Return what a recording must have to show an effect."""
    return {*effect.needs, *(["commands"] if isinstance(effect.stage, Command) else [])}


def _shown(scene: Scene, body: str, history: History | None) -> set[str]:
    """Return what a recording has of a body, in the words of ``Effect.needs``."""
    if history is None:
        return set()
    of_body = history.dataset.sel(body=body)
    observed = of_body["observed"].to_numpy()
    far = np.fmax.reduce(observed, axis=(0, 1)) - np.fmin.reduce(observed, axis=(0, 1))
    shown = {name for d, name in enumerate(STATE) if (far[[d % 3, d % 3 + 3]] > 0).any()}
    if np.nan_to_num(of_body["action"].to_numpy()).any():
        shown.add("commands")
    camera = scene.recording.camera if scene.recording is not None else None
    if {"x", "y"} <= shown if camera is None else camera:
        shown.add("camera")
    poses = of_body["start"].to_numpy()
    turns = is_pivoted(scene, scene.body(body))
    if not (turns and any(scene.gravity)):
        shown.add("free")
    if _repeats(np.mod(poses[..., [THETA]], 2.0 * np.pi) if turns else poses[..., :2]):
        shown.add("places")
    return shown


def _repeats(poses: Floats, *, cells: int = 5, least: float = 0.25) -> bool:
    """Return whether a body comes back to its places (trajectory, time, coordinate).

    A place is a cell of its range, ``cells`` each way, which it passes twice: after it was
    elsewhere, or in another trajectory. ``least``: share of the cells.
    """
    low, high = np.fmin.reduce(poses, axis=(0, 1)), np.fmax.reduce(poses, axis=(0, 1))
    moves = np.nan_to_num(high - low) > 0
    share = (poses[..., moves] - low[moves]) / (high - low)[moves]
    passed: Counter[tuple[int, ...]] = Counter()
    for one in share:
        rows = one[np.isfinite(one).all(axis=-1)]
        visited = np.minimum((cells * rows).astype(int), cells - 1)
        new = np.append(True, (np.diff(visited, axis=0) != 0).any(axis=1))[: len(visited)]
        passed.update(map(tuple, visited[new].tolist()))
    return sum(n > 1 for n in passed.values()) >= least * max(len(passed), 1)
