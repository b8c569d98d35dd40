"""Effects put on the bodies of a scene: those declared, those given, and those it lacks."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from pbrl_ppl.effects.catalogue import catalogue
from pbrl_ppl.effects.effect import Attached, Effect
from pbrl_ppl.errors import EffectError
from pbrl_ppl.scene import Scene


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
    >>> from pbrl_ppl.scene import Body, Scene, Shape
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
    result: list[Attached] = []
    for body in scene.dynamic:
        for name in body.effects:
            if name not in by_name:
                near = difflib.get_close_matches(name, by_name, n=1)
                hint = f"; did you mean {near[0]!r}?" if near else ""
                raise EffectError(
                    f"body {body.name!r} declares the effect {name!r}, which is not in the"
                    f" catalogue{hint} (known: {', '.join(by_name)})"
                )
            result.append(by_name[name].on(body.name))
    for item in extra:
        if isinstance(item, Attached):
            result.append(item)
        else:
            on = [item.on(body.name) for body in scene.dynamic if item.applies(scene, body)]
            if not on:
                raise EffectError(f"effect {item.name} applies to no body of this scene")
            result.extend(on)
    bodies = {body.name: body for body in scene.dynamic}
    names = [(attached.effect.name, attached.body) for attached in result]
    for attached in result:
        if attached.body not in bodies:
            raise EffectError(
                f"effect {attached.effect.name} is put on {attached.body!r}, which is not a moving"
                f" body of the scene, or is kinematic (effects may be put on {', '.join(bodies)})"
            )
        if not attached.effect.applies(scene, bodies[attached.body]):
            raise EffectError(
                f"effect {attached.effect.name} does not apply to body {attached.body!r}"
            )
        if names.count((attached.effect.name, attached.body)) > 1:
            raise EffectError(
                f"effect {attached.effect.name} is put on body {attached.body!r} twice"
            )
    return tuple(result)


def candidates(
    scene: Scene, declared: Iterable[Attached], effects: Iterable[Effect] = catalogue
) -> tuple[Attached, ...]:
    """Every effect on every body that the model does not have yet and that applies."""
    present = {(attached.effect.name, attached.body) for attached in declared}
    return tuple(
        effect.on(body.name)
        for effect in effects
        for body in scene.dynamic
        if (effect.name, body.name) not in present and effect.applies(scene, body)
    )
