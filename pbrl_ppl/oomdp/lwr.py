"""LWR and OO-LWR, the paper's baselines (section 3.1)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.oomdp.contacts import Condition, SectorContacts, condition
from pbrl_ppl.oomdp.experience import ungrouped
from pbrl_ppl.oomdp.learner import Learner
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
        As of :class:`pbrl_ppl.oomdp.Regression`.
    standardise : bool
        Whether distances are in units of each input's standard deviation; otherwise in SI units.
    pose_invariant : bool
        Whether a body's transitions are learned in its own frame, without its pose.

    Raises
    ------
    FitError
        If ``neighbours`` is below 1, or ``bandwidth`` or ``ridge`` not positive.

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
            standardise=standardise, pose_invariant=pose_invariant,
        )  # fmt: skip

    def predicates(self, states: Array) -> Flags:
        """None, shape (n, body, 0)."""
        return np.zeros((*states.shape[:2], 0), dtype=bool)


@final
class OOLWR(Learner):
    """Object-oriented LWR: a pose-invariant model for each body in each condition (section 3.1).

    Where a condition was never observed there is no model, and :meth:`step` gives NaN, through
    which no plan leads. The paper does not say what its agent does there; it says that it had to
    learn each contact anew, and that where conditions are too many it has no valid plan.

    Parameters
    ----------
    scene : Scene
        Orders the bodies, and says what they may touch.
    contacts : SectorContacts, optional
        Predicates that make the conditions; Table 2's by default.
    neighbours, bandwidth, ridge, standardise
        As of :class:`LWR`.

    Raises
    ------
    FitError
        As :class:`LWR`.

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
    {frozenset({('world', 0)}): 1}
    >>> bool(np.isnan(model.step(np.full((1, 1, 1, 6), -5.0), np.zeros((1, 1, 3)))).all())
    True
    """

    def __init__(
        self,
        scene: Scene,
        *,
        contacts: SectorContacts | None = None,
        neighbours: int = 1000,
        bandwidth: float = 1.5,
        ridge: float = 1e-3,
        standardise: bool = True,
    ) -> None:
        super().__init__(
            scene, neighbours=neighbours, bandwidth=bandwidth, ridge=ridge,
            standardise=standardise, pose_invariant=True,
        )  # fmt: skip
        self.contacts = SectorContacts() if contacts is None else contacts

    def predicates(self, states: Array) -> Flags:
        """Contact predicates, shape (n, body, object, sector)."""
        return self.contacts.of(self.scene, states)

    def conditions(self, body: str) -> Mapping[Condition, int]:
        """Conditions in which a body was observed, and how often: each has a model.

        Raises
        ------
        FitError
            If the scene has no such body that forces move.
        """
        names = self.contacts.objects(self.scene)
        size = len(names) * self.contacts.sectors
        return {
            condition(ungrouped(key, size).reshape(len(names), -1), names): count
            for key, count in self.experience(body).counts.items()
        }
