"""What an effect is: a name, parameters with priors and units, and a piece of physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import EffectError
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import WORLD, Body, Joint, Scene

#: ``force(state, command, parameters, wrench)``: adds to ``wrench`` (force_x, force_y, torque) in
#: place, given one body's state (6,), the commanded wrench (3,) and the effect's parameters (q,).
#: It runs inside the compiled substep loop: plain arithmetic and ``math`` only.
Force = Callable[[Any, Any, Any, Any], None]

#: ``modify(properties, parameters)``: changes the engine's properties of one body in place, both
#: dicts of arrays with one entry a proposal; keys as in ``pbrl_ppl.physics.properties``.
Modify = Callable[[dict[str, NDArray[np.float64]], dict[str, NDArray[np.float64]]], None]


def always(scene: Scene, body: Body) -> bool:
    """Whether the effect makes sense on a body: here, on every one."""
    return True


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    Parameters
    ----------
    name : str
        Its name within the effect.
    unit : str
        SI unit.
    prior : Prior
        What is believed of its size once the effect is in the model.
    null : float
        The value at which the effect vanishes.
    """

    name: str
    unit: str
    prior: Prior
    null: float = 0.0


@dataclass(frozen=True)
class Effect:
    """A physical effect that a model may declare or lack.

    Parameters
    ----------
    name : str
        Its name in the catalogue, in scene files and in reports.
    parameters : tuple of EffectParameter
        Its parameters.
    sentence : str
        What it means, for a reader who knows no statistics.
    reference : str
        Where the law is from.
    force : callable, optional
        ``force(state, command, parameters, wrench)``; see :data:`Force`.
    modify : callable, optional
        ``modify(properties, parameters)``; see :data:`Modify`.
    applies : callable
        ``applies(scene, body) -> bool``.

    Examples
    --------
    >>> from pbrl_ppl.parameters.priors import Prior
    >>> def force(state, command, parameters, wrench):
    ...     wrench[0] -= parameters[0] * state[3] ** 3
    >>> cubic_drag = Effect(
    ...     "cubic_drag_x",
    ...     (EffectParameter("coefficient", "N s^3/m^3", Prior("half_normal", sigma=10.0)),),
    ...     "a force against the motion along x that grows with the cube of the speed",
    ...     "an example",
    ...     force=force,
    ... )
    >>> cubic_drag.on("cart").body
    'cart'
    """

    name: str
    parameters: tuple[EffectParameter, ...]
    sentence: str
    reference: str
    force: Force | None = None
    modify: Modify | None = None
    applies: Callable[[Scene, Body], bool] = always

    def __post_init__(self) -> None:
        """Refuse an effect that cannot do anything."""
        if not self.name.isidentifier():
            raise EffectError(f"effect name {self.name!r} is not an identifier; use letters and _")
        if not self.parameters:
            raise EffectError(f"effect {self.name} has no parameters; give it at least one")
        if self.force is None and self.modify is None:
            raise EffectError(f"effect {self.name} has no physics; give it force= or modify=")
        for parameter in self.parameters:
            lower, upper = parameter.prior.support
            if not lower <= parameter.null <= upper:
                raise EffectError(
                    f"effect {self.name}: the null value {parameter.null} of {parameter.name} is"
                    f" outside its prior's support [{lower}, {upper}]"
                )

    def on(self, body: str) -> Attached:
        """Attach the effect to a body by its name."""
        return Attached(self, body)

    @property
    def null(self) -> tuple[float, ...]:
        """The parameters' values at which the effect vanishes."""
        return tuple(parameter.null for parameter in self.parameters)

    def variable(self, parameter: EffectParameter) -> str:
        """Name of a parameter's random variable in a model."""
        return f"{self.name}_{parameter.name}"


@dataclass(frozen=True)
class Attached:
    """An effect on one body."""

    effect: Effect
    body: str

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of its parameters' random variables in a model."""
        return tuple(self.effect.variable(each) for each in self.effect.parameters)


def is_pivoted(scene: Scene, body: Body) -> bool:
    """Whether the body hangs in a hinge; the friction of a hinge belongs to the body that does."""
    return any(hanging_body(scene, joint) == body.name for joint in _hinges(scene))


def _hinges(scene: Scene) -> list[Joint]:
    return [joint for joint in scene.joints if joint.kind == "hinge" and joint.bodies]


def hanging_body(scene: Scene, joint: Joint) -> str:
    """Name of the body that hangs in a hinge: the one farther from the world along the hinges.

    Raises
    ------
    EffectError
        If which bodies the hinge joins is not known.
    """
    if joint.bodies is None:
        raise EffectError("which bodies the hinge joins is to be inferred; none hangs in it yet")
    fixed = {WORLD, *(body.name for body in scene.bodies if body.static or body.kinematic)}
    depth = dict.fromkeys(fixed, 0)
    pairs = [each.bodies for each in _hinges(scene) if each.bodies]
    for _ in pairs:
        for pair in pairs:
            for near, far in (pair, pair[::-1]):
                if near in depth and far not in depth:
                    depth[far] = depth[near] + 1
    # of two bodies that nothing ties to the world, the second hangs on the first
    first, second = joint.bodies
    return first if depth.get(first, 0) > depth.get(second, 1) else second
