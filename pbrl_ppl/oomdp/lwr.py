"""LWR and OO-LWR, the baselines of the paper (section 3.1), and what they have in common."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Self, final

import numpy as np
from numpy.typing import ArrayLike

from pbrl_ppl.errors import FitError, HistoryError, SimulationError
from pbrl_ppl.history import History, check_start
from pbrl_ppl.oomdp.regression import Experience, Regression
from pbrl_ppl.oomdp.relations import Attributes, Condition, Relation, SectorContacts, condition
from pbrl_ppl.scene import Scene, body_sizes, nearest
from pbrl_ppl.state import STATE, THETA, WRENCH, Bools, Floats, turned, wrapped


class Learner:
    """Independent models of transitions of single bodies, learned as they are observed.

    A :class:`pbrl_ppl.planning.TransitionModel`: :func:`pbrl_ppl.plan` plans with it.

    Parameters
    ----------
    scene : Scene
        Orders the bodies. The action of a kinematic body is its velocity.
    neighbours : int
        Number of nearest transitions used, k.
    bandwidth : float
        Bandwidth of the kernel, lambda.
    ridge : float
        See :class:`pbrl_ppl.oomdp.Regression`.
    standardise : bool
        Whether distances between inputs are in units of each input's standard deviation in the
        data, so that lambda has no unit, as in the paper; otherwise in SI units.
    pose_invariant : bool
        Whether a body's transitions are learned in its own frame, without its pose.
    share_classes : bool
        Whether bodies of one class share their models.
    relations : sequence of Relation
        Predicates that make the conditions; without any there is one condition.

    Raises
    ------
    FitError
        If ``neighbours`` is below 1, ``bandwidth`` not positive or ``ridge`` negative.

    Attributes
    ----------
    transitions : int
        Number of observed transitions.
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
        share_classes: bool = False,
        relations: Sequence[Relation] = (),
    ) -> None:
        if isinstance(neighbours, bool) or not isinstance(neighbours, int) or neighbours < 1:
            raise FitError(f"LWR: neighbours is {neighbours!r}, expected a whole number from 1 up")
        if not 0 < bandwidth < np.inf:
            raise FitError(f"LWR: bandwidth is {bandwidth!r}, expected a number above 0")
        if not 0 <= ridge < np.inf:
            raise FitError(f"LWR: ridge is {ridge!r}, expected a number from 0 (Eq. 4) up")
        self.scene, self.pose_invariant, self.relations = scene, pose_invariant, tuple(relations)
        regression = partial(Regression, neighbours=neighbours, bandwidth=bandwidth, ridge=ridge)
        self._experience: dict[int, Experience] = {}
        of_class: dict[str, Experience] = {}
        for i, body in enumerate(scene.moving):
            if not body.kinematic:
                reach = body.shape.bounding_radius
                experience = Experience(reach, standardise=standardise, regression=regression)
                if share_classes and body.object_class is not None:
                    experience = of_class.setdefault(body.object_class, experience)
                self._experience[i] = experience
        self.transitions = 0
        self._largest = body_sizes(scene).max(axis=0)  # in each dimension

    def predicates(self, states: Floats, wrenches: Floats) -> Bools:
        """Return predicates of moving bodies in states (n, body, 6) under wrenches (n, body, 3).

        In the order of the relations' labels, shape (n, body, predicate).
        """
        lead = states.shape[:2]
        flags = [np.zeros((*lead, 0), dtype=bool)]
        for relation in self.relations:
            truths = relation.of(self.scene, states, wrenches)
            flags.append(truths.reshape(*lead, math.prod(truths.shape[2:])))
        return np.concatenate(flags, axis=-1)

    # -- learning ----------------------------------------------------------------------------------

    def observe(self, state: ArrayLike, action: ArrayLike, next_state: ArrayLike) -> None:
        """Learn from a transition, or from many.

        Parameters
        ----------
        state, next_state : array_like
            States at the ends of one sampling interval, shape (body, 6) or (n, body, 6), SI units.
        action : array_like
            Wrenches held in between, shape (body, 3) or (n, body, 3), world frame, N and N m; for a
            kinematic body its velocity.

        Raises
        ------
        HistoryError
            If shapes do not fit together, or a value is not finite.
        """
        k = len(self.scene.moving)
        arrays = []
        for name, array, width in (
            ("state", state, len(STATE)),
            ("action", action, len(WRENCH)),
            ("next_state", next_state, len(STATE)),
        ):
            values = np.asarray(array, dtype=float)
            if values.ndim not in (2, 3) or values.shape[-2:] != (k, width):
                raise HistoryError(
                    f"observe: {name} has shape {values.shape}, expected ({k}, {width}) or"
                    f" (n, {k}, {width}): {', '.join(body.name for body in self.scene.moving)}"
                )
            arrays.append(values.reshape(-1, k, width))
            lost = ~np.isfinite(arrays[-1]).all(axis=-1)
            lost[:, [i for i in range(k) if i not in self._experience]] = False
            if lost.any():
                row, body = np.argwhere(lost)[0]
                raise HistoryError(
                    f"observe: {name} of {self.scene.moving[body].name} in transition {row} is not"
                    " finite; leave out transitions that were not measured whole"
                )
        if len({len(values) for values in arrays}) > 1:
            raise HistoryError(
                f"observe: got {', '.join(str(len(values)) for values in arrays)} states, actions"
                " and next states, expected equal numbers"
            )
        begin, wrench, after = arrays
        flags = self.predicates(begin, wrench)
        for i, experience in self._experience.items():
            displacement = after[:, i] - begin[:, i]
            displacement[:, THETA] = wrapped(displacement[:, THETA])
            if self.pose_invariant:
                displacement = _turned(displacement, -begin[:, i, THETA])
            experience.add(self._inputs(begin[:, i], wrench[:, i]), displacement, flags[:, i])
        self.transitions += len(begin)
        seen = np.concatenate([begin, after])[:, list(self._experience)]
        self._largest = np.maximum(self._largest, abs(seen).max(axis=(0, 1)))

    def learn(self, history: History) -> None:
        """Learn from the completely measured transitions of a history.

        Raises
        ------
        HistoryError
            If its bodies are others, or no transition was measured completely.
        """
        names = tuple(body.name for body in self.scene.moving)
        if history.bodies != names:
            raise HistoryError(
                f"learn: the history is of {', '.join(history.bodies)}, expected"
                f" {', '.join(names)}; load it with the learner's scene"
            )
        check_start(history, self.scene)
        every = history.transitions(history.dataset["start"].to_numpy())
        state, action, after = every.start, every.actions[:, 0], every.observed[:, 0]
        moved = np.concatenate([action, after], axis=-1)[:, list(self._experience)]
        whole = np.isfinite(state).all(axis=(1, 2)) & np.isfinite(moved).all(axis=(1, 2))
        if not whole.any():
            raise HistoryError(
                f"learn: none of {len(whole)} transitions was measured whole; have velocities"
                " estimated (estimate_velocities) if they are missing"
            )
        self.observe(state[whole], action[whole], after[whole])

    # -- planning ----------------------------------------------------------------------------------

    @property
    def draws(self) -> int:
        """Return the number of draws: 1, a point estimate."""
        return 1

    @property
    def before(self) -> Floats:
        """Return the wrench before the first interval: zeros, shape (body, 3)."""
        return np.zeros((len(self.scene.moving), len(WRENCH)))

    def single(self) -> Self:
        """Return itself."""
        return self

    def after(self, before: Floats) -> Self:
        """Return itself: the model has no memory of wrenches."""
        return self

    def noisy(self, states: Floats, rng: np.random.Generator) -> Floats:
        """Raise an error: the regression has no noise model.

        Raises
        ------
        FitError
            Always.
        """
        raise FitError("noise: LWR predicts a mean alone; plan without noise")

    def acceleration(self, body: str, force: float, torque: float) -> tuple[Floats, Floats]:
        """Return the acceleration of a body under a push, shape (1,) each, m/s^2 and rad/s^2.

        From a linear fit to the transitions in its commonest condition, at the heading with the
        largest acceleration.

        Raises
        ------
        FitError
            If nothing was observed yet.
        """
        self._check_data()
        gains = self.experience(body).gains()[-len(WRENCH) :, 3:] / self.scene.time_step
        linear = force * np.linalg.norm(gains[:2, :2], 2) + torque * np.hypot(*gains[2, :2])
        angular = force * np.hypot(*gains[:2, 2]) + torque * abs(gains[2, 2])
        return np.array([linear]), np.array([angular])

    def step(
        self,
        states: Floats,
        wrenches: Floats,
        previous: Floats | None = None,
        *,
        diverged: float = 1e6,
    ) -> Floats:
        """Return the states after one sampling interval (Eqs. 5 and 6).

        Parameters
        ----------
        states : ndarray
            Shape (1, n, body, 6), SI units.
        wrenches : ndarray
            Shape (n, body, 3), world frame, N and N m.
        previous : ndarray, optional
            Ignored.
        diverged : float
            States beyond this many times the largest learned are of extrapolations that have
            diverged.

        Returns
        -------
        ndarray
            Shape (1, n, body, 6); NaN for a body in an unobserved condition, which has no model,
            and where extrapolations have diverged.

        Raises
        ------
        FitError
            If nothing was observed yet.
        SimulationError
            If shapes do not fit together.
        """
        self._check_data()
        k = len(self.scene.moving)
        n = states.shape[1] if states.ndim == 4 else 0
        if states.shape != (1, n, k, len(STATE)) or wrenches.shape != (n, k, len(WRENCH)):
            raise SimulationError(
                f"step: states have shape {states.shape} and wrenches {wrenches.shape}, expected"
                f" (1, n, {k}, {len(STATE)}) and (n, {k}, {len(WRENCH)})"
            )
        rows = np.flatnonzero(np.asarray(np.isfinite(states[0]).all(axis=(1, 2))))
        begin, pushes = states[0, rows], wrenches[rows]
        flags = self.predicates(begin, pushes)
        out = np.full_like(states[0], np.nan)
        for i in range(k):
            state, push = begin[:, i], pushes[:, i]
            if i not in self._experience:  # kinematic: the push is its velocity
                out[rows, i] = np.hstack([state[:, :3] + self.scene.time_step * push, push])
                continue
            added = self._experience[i].predict(self._inputs(state, push), flags[:, i])
            if self.pose_invariant:
                added = _turned(added, state[:, THETA])
            out[rows, i] = state + added
        out[abs(out) > diverged * self._largest] = np.nan
        return np.asarray(out[None])

    def experience(self, body: str) -> Experience:
        """Return the observed transitions of a body, or of its class if they share models.

        Raises
        ------
        FitError
            If the scene has no such dynamic body.
        """
        names = [mover.name for mover in self.scene.dynamic]
        if body not in names:
            raise FitError(
                f'LWR: the scene has no moving body "{body}" that can be pushed'
                f"{nearest(body, names)}"
            )
        return dict(zip(names, self._experience.values(), strict=True))[body]

    def _inputs(self, states: Floats, wrenches: Floats) -> Floats:
        """Return regression inputs X of states (n, 6) and wrenches (n, 3) of one body.

        Velocity and wrench in the body's frame, shape (n, 6), if pose-invariant (Eq. 6); otherwise
        pose, velocity and wrench, shape (n, 9) (Eq. 3).
        """
        if self.pose_invariant:
            return _turned(np.concatenate([states[:, 3:], wrenches], axis=1), -states[:, THETA])
        inputs = np.concatenate([states, wrenches], axis=1)
        inputs[:, THETA] = wrapped(inputs[:, THETA])
        return inputs

    def _check_data(self) -> None:
        if not self.transitions:
            raise FitError("LWR: nothing was observed yet; observe() a transition, or learn() some")


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


def _turned(triples: Floats, angle: Floats) -> Floats:
    """Return planar vectors, each followed by a value that stays, (n, 3 k), turned by angles."""
    split = triples.reshape(len(triples), triples.shape[1] // 3, 3)
    planar = turned(split[..., :2], angle[:, None])
    return np.concatenate([planar, split[..., 2:]], axis=-1).reshape(triples.shape)
