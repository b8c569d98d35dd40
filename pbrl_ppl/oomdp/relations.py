"""Relations of an OO-MDP: named predicates of bodies, and the condition that they make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, final, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import FitError
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Cond(s, a) of a body: the labels of its predicates that hold.
Condition = frozenset[str]


@runtime_checkable
class Relation(Protocol):
    """Predicates of every moving body in a state under an action."""

    def labels(self, scene: Scene) -> tuple[str, ...]:
        """Names of the predicates of one body, in the order of the flags."""

    def of(self, scene: Scene, states: Array, wrenches: Array) -> Flags:
        """Which predicates hold.

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
            Shape (n, body, ...): as many flags a body as there are labels, in any shape.
        """


@final
@dataclass(frozen=True)
class Pushed:
    """Predicate that the action acts on the body: its wrench is not zero.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Shape
    >>> pucks = tuple(Body(name, Shape.circle(0.2)) for name in "ab")
    >>> scene = Scene(time_step=0.1, bodies=pucks)
    >>> Pushed().of(scene, np.zeros((1, 2, 6)), np.array([[[0, 2.0, 0], [0, 0, 0]]]))[..., 0]
    array([[ True, False]])
    """

    def labels(self, scene: Scene) -> tuple[str, ...]:
        """``pushed``."""
        return ("pushed",)

    def of(self, scene: Scene, states: Array, wrenches: Array) -> Flags:
        """Whether each body is pushed, shape (n, body, 1); see :class:`Relation`."""
        return np.asarray(wrenches.any(axis=-1, keepdims=True))


@final
@dataclass(frozen=True)
class Attributes:
    """Predicates that the body has an attribute: one for each attribute of the scene.

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
        """Attributes of the moving bodies, sorted."""
        return tuple(sorted({name for body in scene.moving for name in body.attributes}))

    def of(self, scene: Scene, states: Array, wrenches: Array) -> Flags:
        """Which attributes each body has, shape (n, body, attribute); see :class:`Relation`."""
        labels = self.labels(scene)
        has = [[name in body.attributes for name in labels] for body in scene.moving]
        flags = np.array(has, dtype=bool).reshape(len(scene.moving), len(labels))
        return np.repeat(flags[None], len(states), axis=0)


def flat(flags: Flags) -> Flags:
    """Flags (n, body, ...) with one axis over a body's predicates, shape (n, body, predicate)."""
    return flags.reshape(*flags.shape[:2], int(np.prod(flags.shape[2:])))


def condition(flags: Flags, labels: Sequence[str]) -> Condition:
    """A body's condition, from as many flags as labels, in any shape."""
    return frozenset(label for label, holds in zip(labels, flags.ravel(), strict=True) if holds)


def all_labels(relations: Sequence[Relation], scene: Scene) -> tuple[str, ...]:
    """Labels of the predicates of all relations, in their order.

    Raises
    ------
    FitError
        If one is no relation, or two predicates have one name.
    """
    for relation in relations:
        if not isinstance(relation, Relation):
            raise FitError(
                f"OO-LWR: relations has {relation!r}, expected objects with labels() and of(), such"
                " as SectorContacts()"
            )
    labels = tuple(label for relation in relations for label in relation.labels(scene))
    for label in labels:
        if labels.count(label) > 1:
            raise FitError(
                f'OO-LWR: {labels.count(label)} predicates are called "{label}"; drop a relation,'
                " or rename the attribute"
            )
    return labels
