"""LWR and OO-LWR, the baselines of the paper (section 3.1)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import final

from pbrl_ppl.errors import FitError
from pbrl_ppl.oomdp.contacts import SectorContacts
from pbrl_ppl.oomdp.learner import Learner
from pbrl_ppl.oomdp.relations import Attributes, Condition, Relation, condition
from pbrl_ppl.scene import Scene


@final
class LWR(Learner):
    """Locally weighted regression: one model per body, without predicates (Eqs. 3 to 6).

    The paper's LWR agent uses the pose-invariant model, and so cannot predict collisions with
    walls. ``pose_invariant=False`` is Eq. 3 with the pose among the inputs: it can learn where
    walls are, and must learn free motion again at each place.

    Parameters
    ----------
    scene : Scene
        Orders the bodies.
    neighbours : int
        Number of nearest transitions used, k.
    bandwidth : float
        Bandwidth of the kernel, lambda.
    ridge : float
        See :class:`pbrl_ppl.oomdp.Regression`; 0 is Eq. 4.
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
    >>> import numpy as np
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> scene = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.2)),))
    >>> model = LWR(scene)
    >>> model.observe([[0, 0, 0, 1, 0, 0]], [[0, 0, 0]], [[0.1, 0, 0, 1, 0, 0]])  # moved by 0.1 m
    >>> elsewhere = np.array([[[[5.0, 3.0, np.pi / 2, 0.0, 2.0, 0.0]]]])  # along its x axis, too
    >>> model.step(elsewhere, np.zeros((1, 1, 3))).round(3)
    array([[[[5.   , 3.2  , 1.571, 0.   , 2.   , 0.   ]]]])
    """


@final
class OOLWR(Learner):
    """Object-oriented LWR: a pose-invariant model for each class in each condition (section 3.1).

    A body without a class has its own models. A condition, Cond(s, a), is the set of the predicates
    that hold for the body.

    In a condition that was never observed there is no model: :meth:`step` returns NaN, and plans
    avoid such states. The paper does not describe this case; it says that its agent had to learn
    each contact again, and that with too many conditions it has no valid plan.

    Parameters
    ----------
    scene : Scene
        Orders the bodies, and has their classes, their attributes and the objects they may touch.
    relations : sequence of Relation, optional
        Predicates that make the conditions: :class:`SectorContacts`, :class:`Pushed`,
        :class:`Attributes`, or a user's. By default the paper's sector contacts, and the attributes
        if bodies of the scene have any.
    share_classes : bool
        Whether bodies of one class share their models.
    neighbours, bandwidth, ridge, standardise
        See :class:`LWR`.

    Raises
    ------
    FitError
        As :class:`LWR`, or if an object is no relation, or two predicates have one name.

    References
    ----------
    Scholz et al. (2014), section 3.1; Table 2 has the defaults of ``neighbours`` and ``bandwidth``.

    Examples
    --------
    >>> import numpy as np
    >>> from pbrl_ppl.scene import Body, Scene, Shape, Wall
    >>> wall = Wall((0.25, -1.0), (0.25, 1.0))
    >>> scene = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.2)),), walls=(wall,))
    >>> model = OOLWR(scene)
    >>> model.observe([[0, 0, 0, 1, 0, 0]], [[0, 0, 0]], [[0.05, 0, 0, 0, 0, 0]])  # stopped
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
        if relations is None:
            attributes = (Attributes(),) * any(body.attributes for body in scene.moving)
            relations = (SectorContacts(), *attributes)
        super().__init__(
            scene, neighbours=neighbours, bandwidth=bandwidth, ridge=ridge,
            standardise=standardise, share_classes=share_classes, relations=relations,
        )  # fmt: skip
        for relation in self.relations:
            if not isinstance(relation, Relation):
                raise FitError(
                    f"OO-LWR: relations has {relation!r}, expected objects with labels() and of(),"
                    " such as SectorContacts()"
                )
        self.labels = tuple(
            label for predicate in self.relations for label in predicate.labels(scene)
        )
        for label, count in Counter(self.labels).items():
            if count > 1:
                raise FitError(
                    f'OO-LWR: {count} predicates are called "{label}"; drop a relation, or rename'
                    " the attribute"
                )

    def conditions(self, body: str) -> Mapping[Condition, int]:
        """Return the observed conditions of a body or its class, and their numbers of transitions.

        Each condition has a model.

        Raises
        ------
        FitError
            If the scene has no such dynamic body.
        """
        counts = self.experience(body).counts
        return {condition(key, self.labels): count for key, count in counts.items()}
