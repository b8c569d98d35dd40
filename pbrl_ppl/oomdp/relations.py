"""Relations of an OO-MDP: named predicates of bodies, and the conditions that they form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Protocol, final, runtime_checkable

import numpy as np

from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Bools, Floats

#: Cond(s, a) of a body: the labels of the predicates that hold.
Condition = frozenset[str]


@runtime_checkable
class Relation(Protocol):
    """Predicates of every moving body in a state under an action."""

    def labels(self, scene: Scene) -> tuple[str, ...]:
        """Return the names of the predicates of one body, in the order of the flags."""

    def of(self, scene: Scene, states: Floats, wrenches: Floats) -> Bools:
        """Return which predicates hold.

        Parameters
        ----------
        scene : Scene
            Shapes, walls, static bodies, joints, classes and attributes.
        states : ndarray
            Shape (n, body, 6), SI units, bodies as in ``scene.moving``.
        wrenches : ndarray
            On them, shape (n, body, 3), world frame, N and N m; of a kinematic body its velocity.

        Returns
        -------
        ndarray of bool
            Shape (n, body, ...): one flag per label for each body, in any shape.
        """


@final
@dataclass(frozen=True)
class Pushed:
    """Predicate that the body's wrench is not zero.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Shape
    >>> pucks = tuple(Body(name, Shape.circle(0.2)) for name in "ab")
    >>> scene = Scene(time_step=0.1, bodies=pucks)
    >>> Pushed().of(scene, np.zeros((1, 2, 6)), np.array([[[0, 2.0, 0], [0, 0, 0]]]))[..., 0]
    array([[ True, False]])
    """

    def labels(self, scene: Scene) -> tuple[str, ...]:
        """Return ``pushed``."""
        return ("pushed",)

    def of(self, scene: Scene, states: Floats, wrenches: Floats) -> Bools:
        """Return whether each body is pushed, shape (n, body, 1); see :class:`Relation`."""
        return np.asarray(wrenches.any(axis=-1, keepdims=True))


@final
@dataclass(frozen=True)
class Attributes:
    """Predicates that the body has an attribute: one per attribute in the scene.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Shape
    >>> disc = Shape.circle(0.2)
    >>> chairs = Body("a", disc), Body("b", disc, attributes=("wheels_locked",))
    >>> scene = Scene(time_step=0.1, bodies=chairs)
    >>> Attributes().labels(scene)
    ('wheels_locked',)
    >>> Attributes().of(scene, np.zeros((1, 2, 6)), np.zeros((1, 2, 3)))[..., 0]
    array([[False,  True]])
    """

    def labels(self, scene: Scene) -> tuple[str, ...]:
        """Return the attributes of the moving bodies, sorted."""
        return tuple(sorted({name for body in scene.moving for name in body.attributes}))

    def of(self, scene: Scene, states: Floats, wrenches: Floats) -> Bools:
        """Return the attributes that hold, shape (n, body, attribute); see :class:`Relation`."""
        labels = self.labels(scene)
        has = [[name in body.attributes for name in labels] for body in scene.moving]
        flags = np.array(has, dtype=bool).reshape(len(scene.moving), len(labels))
        return np.repeat(flags[None], len(states), axis=0)


def condition(flags: Sequence[bool] | Bools, labels: Sequence[str]) -> Condition:
    """Return a body's condition, from one flag per label."""
    return frozenset(compress(labels, flags))
