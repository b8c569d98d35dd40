"""LWR and OO-LWR, the paper's baselines (section 3.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import final

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.oomdp.contacts import SectorContacts
from pbrl_ppl.oomdp.experience import ungrouped
from pbrl_ppl.oomdp.learner import Learner
from pbrl_ppl.oomdp.relations import Attributes, Condition, Relation, all_labels, condition, flat
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@final
class LWR(Learner):
    """Locally weighted regression alone: one model a body, whatever touches it (Eqs. 3 to 6).

    The paper's LWR agent uses the pose-invariant model, and so cannot foresee collisions: it sees
    no walls. With ``pose_invariant=False`` there is Eq. 3 with the pose among the inputs, which can
    know walls by their place, and has to learn free motion anew at each.

    Parameters
    ----------
    scene : Scene
        Orders the bodies.
    neighbours : int
        Nearest transitions that count, k.
    bandwidth : float
        Of the kernel, lambda.
    ridge : float
        As of :class:`pbrl_ppl.oomdp.Regression`; 0 is Eq. 4 as it stands.
    standardise : bool
        Whether distances are in units of each input's standard deviation; otherwise in SI units.
    pose_invariant : bool
        Whether a body's transitions are learned in its own frame, without its pose.

    Raises
    ------
    FitError
        If ``neighbours`` is below 1, ``bandwidth`` not positive or ``ridge`` negative.

    References
    ----------
    Scholz et al. (2014), section 3.1.2; Table 2 has the defaults of ``neighbours`` and
    ``bandwidth``.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> scene = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.2)),))
    >>> model = LWR(scene)
    >>> model.observe([[0, 0, 0, 1, 0, 0]], [[0, 0, 0]], [[0.1, 0, 0, 1, 0, 0]])  # moved by 0.1 m
    >>> elsewhere = np.array([[[[5.0, 3.0, np.pi / 2, 0.0, 2.0, 0.0]]]])  # along its x axis, too
    >>> model.step(elsewhere, np.zeros((1, 1, 3))).round(3)
    array([[[[5.   , 3.2  , 1.571, 0.   , 2.   , 0.   ]]]])
    """

    def __init__(
        self,
        scene: Scene,
        *,
        neighbours: int = 1000,
        bandwidth: float = 1.5,
        ridge: float = 1e-3,
        standardise: bool = True,
        pose_invariant: bool = True,
    ) -> None:
        super().__init__(
            scene, neighbours=neighbours, bandwidth=bandwidth, ridge=ridge,
            standardise=standardise, pose_invariant=pose_invariant, share_classes=False,
        )  # fmt: skip

    def predicates(self, states: Array, wrenches: Array) -> Flags:
        """None, shape (n, body, 0)."""
        return np.zeros((*states.shape[:2], 0), dtype=bool)


@final
class OOLWR(Learner):
    """Object-oriented LWR: a pose-invariant model for each class in each condition (section 3.1).

    A body without a class is one by itself. A condition, Cond(s, a), is the set of the predicates
    that hold for the body.

    Where a condition was never observed there is no model, and :meth:`step` gives NaN, through
    which no plan leads. The paper does not say what its agent does there; it says that it had to
    learn each contact anew, and that where conditions are too many it has no valid plan.

    Parameters
    ----------
    scene : Scene
        Orders the bodies; says their classes and attributes, and what they may touch.
    relations : sequence of Relation, optional
        Predicates that make the conditions: :class:`SectorContacts`, :class:`Pushed`,
        :class:`Attributes`, or your own. By default the paper's sector contacts, and the attributes
        if bodies of the scene have any.
    share_classes : bool
        Whether bodies of one class share their models; otherwise each has its own.
    neighbours, bandwidth, ridge, standardise
        As of :class:`LWR`.

    Raises
    ------
    FitError
        As :class:`LWR`, or if one of the relations is none, or two predicates have one name.

    References
    ----------
    Scholz et al. (2014), section 3.1; Table 2 has the defaults of ``neighbours`` and ``bandwidth``.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Scene, Shape, Wall
    >>> wall = Wall((0.3, -1.0), (0.3, 1.0))
    >>> scene = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.2)),), walls=(wall,))
    >>> model = OOLWR(scene)
    >>> model.observe([[0, 0, 0, 1, 0, 0]], [[0, 0, 0]], [[0.1, 0, 0, 0, 0, 0]])  # stopped
    >>> model.conditions("puck")
    {frozenset({'contact_0'}): 1}
    >>> bool(np.isnan(model.step(np.full((1, 1, 1, 6), -5.0), np.zeros((1, 1, 3)))).all())
    True
    """

    def __init__(
        self,
        scene: Scene,
        *,
        relations: Sequence[Relation] | None = None,
        share_classes: bool = True,
        neighbours: int = 1000,
        bandwidth: float = 1.5,
        ridge: float = 1e-3,
        standardise: bool = True,
    ) -> None:
        super().__init__(
            scene, neighbours=neighbours, bandwidth=bandwidth, ridge=ridge,
            standardise=standardise, pose_invariant=True, share_classes=share_classes,
        )  # fmt: skip
        if relations is None:
            attributes = (Attributes(),) * any(body.attributes for body in scene.moving)
            relations = (SectorContacts(), *attributes)
        self.relations = tuple(relations)
        self.labels = all_labels(self.relations, scene)

    def predicates(self, states: Array, wrenches: Array) -> Flags:
        """Predicates as :attr:`labels` names them, shape (n, body, predicate)."""
        every = [flat(relation.of(self.scene, states, wrenches)) for relation in self.relations]
        none = np.zeros((*states.shape[:2], 0), dtype=bool)
        return np.concatenate([none, *every], axis=-1)

    def conditions(self, body: str) -> Mapping[Condition, int]:
        """Conditions in which a body, or one of its class, was observed, and how often.

        Each has a model.

        Raises
        ------
        FitError
            If the scene has no such body that forces move.
        """
        return {
            condition(ungrouped(key, len(self.labels)), self.labels): count
            for key, count in self.experience(body).counts.items()
        }
