"""The catalogue of effects; where two cannot be told apart, the earlier one is named."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from pbrl_ppl.effects.actuator_rotation import actuator_rotation
from pbrl_ppl.effects.angular_drag import angular_drag
from pbrl_ppl.effects.base import Attached, Effect, EffectParameter
from pbrl_ppl.effects.body_force import body_force
from pbrl_ppl.effects.constant_force import constant_force
from pbrl_ppl.effects.constant_torque import constant_torque
from pbrl_ppl.effects.inertia_scale import inertia_scale
from pbrl_ppl.effects.linear_drag import linear_drag
from pbrl_ppl.effects.pivot_damping import pivot_damping
from pbrl_ppl.effects.pivot_friction import pivot_friction
from pbrl_ppl.effects.push_offset import push_offset
from pbrl_ppl.effects.quadratic_drag import quadratic_drag
from pbrl_ppl.effects.sliding_friction import sliding_friction
from pbrl_ppl.errors import EffectError
from pbrl_ppl.scene import Scene

__all__ = ["Attached", "Effect", "EffectParameter", "attach", "candidates", "catalogue"]

#: A hinge's own friction stands before drag on a body, which looks the same on a single pendulum.
catalogue: tuple[Effect, ...] = (
    pivot_damping,
    pivot_friction,
    linear_drag,
    quadratic_drag,
    angular_drag,
    constant_force,
    body_force,
    constant_torque,
    push_offset,
    actuator_rotation,
    inertia_scale,
    sliding_friction,
)


def attach(
    scene: Scene,
    extra: Iterable[Effect | Attached] = (),
    effects: Iterable[Effect] = catalogue,
) -> tuple[Attached, ...]:
    """All effects of a model: those that the scene declares, then the extra ones.

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
        If a name is unknown, a body is not in the scene, an effect does not apply to its body, or
        an effect would be attached twice.

    Examples
    --------
    >>> from pbrl_ppl.scene.scene import Body, Scene, Shape
    >>> cart = Body("cart", Shape.box(1.0, 0.6), effects=("linear_drag",))
    >>> [a.effect.name for a in attach(Scene(time_step=0.1, bodies=(cart,)))]
    ['linear_drag']
    """
    extra = tuple(extra)
    # an effect that a model is given may be declared by name too: a user's own, in a saved scene
    by_name = {effect.name: effect for effect in effects}
    by_name |= {
        effect.name: effect
        for item in extra
        for effect in (item.effect if isinstance(item, Attached) else item,)
    }
    attached: list[Attached] = []
    for body in scene.dynamic:
        for name in body.effects:
            if name not in by_name:
                near = difflib.get_close_matches(name, by_name, n=1)
                hint = f"; did you mean {near[0]!r}?" if near else ""
                raise EffectError(
                    f"body {body.name!r} declares the effect {name!r}, which is not in the"
                    f" catalogue{hint} (known: {', '.join(by_name)})"
                )
            attached.append(by_name[name].on(body.name))
    for item in extra:
        if isinstance(item, Attached):
            attached.append(item)
        else:
            on = [item.on(body.name) for body in scene.dynamic if item.applies(scene, body)]
            if not on:
                raise EffectError(f"effect {item.name} applies to no body of this scene")
            attached.extend(on)
    bodies = {body.name: body for body in scene.dynamic}
    names = [(one.effect.name, one.body) for one in attached]
    for one in attached:
        if one.body not in bodies:
            raise EffectError(
                f"effect {one.effect.name} is put on {one.body!r}, which is not a moving body of"
                f" the scene, or is kinematic (effects may be put on {', '.join(bodies)})"
            )
        if not one.effect.applies(scene, bodies[one.body]):
            raise EffectError(f"effect {one.effect.name} does not apply to body {one.body!r}")
        if names.count((one.effect.name, one.body)) > 1:
            raise EffectError(f"effect {one.effect.name} is put on body {one.body!r} twice")
    return tuple(attached)


def candidates(
    scene: Scene, declared: Iterable[Attached], effects: Iterable[Effect] = catalogue
) -> tuple[Attached, ...]:
    """Every effect on every body that the model does not have yet and that applies."""
    present = {(one.effect.name, one.body) for one in declared}
    return tuple(
        effect.on(body.name)
        for effect in effects
        for body in scene.dynamic
        if (effect.name, body.name) not in present and effect.applies(scene, body)
    )
