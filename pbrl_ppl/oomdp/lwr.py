"""LWR and OO-LWR, the baselines of the paper (section 3.1), and their regressions (Eqs. 3 to 5)."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, Self, final

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from pbrl_ppl.errors import FitError, HistoryError, SimulationError
from pbrl_ppl.history import History, check_start
from pbrl_ppl.oomdp.relations import Attributes, Condition, Relation, SectorContacts, condition
from pbrl_ppl.scene import Scene, body_sizes, checks
from pbrl_ppl.state import STATE, THETA, WRENCH, Bools, Floats, Ints, turned, wrapped

#: Predicates of a condition, one flag each.
Key = tuple[bool, ...]


class LocalRegression:
    """Weighted least squares about each query: ``beta = (X' W X)^-1 X' W y`` (Eqs. 4 and 5).

    The kernel is ``exp(-d^2 / bandwidth)`` of the distance d in units of each column's scale. As in
    the paper, there is no constant term: the prediction at zero is zero.

    A ridge determines beta where the weighted data do not, as far from the data or where they are
    few. It shrinks beta to the unweighted fit of all data, not to zero: that would stop bodies that
    move faster than any in the data. A linear system is reproduced with any ridge.

    Parameters
    ----------
    x : ndarray
        Training inputs, shape (n, p).
    y : ndarray
        Training outputs, shape (n, q).
    neighbours : int
        Number of nearest inputs used, k.
    bandwidth : float
        Lambda, squared units of distance.
    ridge : float
        Share of the trace of ``X' W X``; 0 is Eq. 4. Where ``X' W X`` is then singular, beta is the
        least-norm solution, with columns in units of ``scale``: directions in which the weighted
        data do not vary predict zero.
    scale : ndarray, optional
        Unit of distance of each column, shape (p,); 1 by default.
    singular : float
        Share of the largest eigenvalue of ``X' W X`` below which eigenvalues are rounding errors.

    Examples
    --------
    >>> x = np.random.default_rng(1).normal(size=(50, 2))
    >>> regression = LocalRegression(x, x @ [[2.0], [-1.0]])
    >>> regression(np.array([[1.0, 1.0]])).round(9)
    array([[1.]])
    """

    def __init__(
        self,
        x: Floats,
        y: Floats,
        *,
        neighbours: int = 1000,
        bandwidth: float = 1.5,
        ridge: float = 1e-3,
        scale: Floats | None = None,
        singular: float = 1e-13,
    ) -> None:
        self.scale = np.ones(x.shape[1]) if scale is None else scale
        self.neighbours, self.bandwidth, self.ridge = neighbours, bandwidth, ridge
        self.singular = singular
        self._x = x / self.scale
        self._tree = cKDTree(self._x) if len(x) > neighbours else None
        # a ridge is added to the squares of the singular values
        self._everywhere = np.linalg.lstsq(self._x, y, rcond=max(ridge, singular) ** 0.5)[0]
        # X' W X and X' W y are weighted sums of these rows, one per training input
        columns = np.concatenate([self._x, y], axis=1)
        self._products = np.einsum("ni,nj->nij", self._x, columns).reshape(len(x), -1)

    def __call__(self, queries: Floats, *, weights: int = 4_000_000) -> Floats:
        """Return predictions, shape (m, q), at queries of shape (m, p).

        ``weights``: weights computed at a time, to limit memory.
        """
        size = max(1, weights // len(self._x))
        parts = np.array_split(queries / self.scale, max(1, -(-len(queries) // size)))
        return np.concatenate([self._predict(part) for part in parts])

    def _predict(self, at: Floats) -> Floats:
        n, p = at.shape
        products = (self._weights(at) @ self._products).reshape(n, p, self._products.shape[1] // p)
        square, cross = products[..., :p], products[..., p:]
        if not self.ridge:
            beta = np.linalg.pinv(square, rcond=self.singular, hermitian=True) @ cross
            return np.asarray(np.einsum("mp,mpq->mq", at, beta))
        size = np.trace(square, axis1=1, axis2=2) + np.finfo(float).tiny ** 0.5
        added = self.ridge * size[:, None, None]
        beta = np.linalg.solve(square + added * np.eye(p), cross + added * self._everywhere)
        return np.asarray(np.einsum("mp,mpq->mq", at, beta))

    def _weights(self, at: Floats) -> Floats | csr_array:
        """Return weights of the training inputs relative to the nearest's, shape (m, n).

        The factor cancels; without it all weights vanish for a query far from the data.
        """
        if self._tree is None:
            square = cdist(at, self._x, "sqeuclidean")
            nearest = square.min(axis=1, keepdims=True)
            return np.asarray(np.exp(-(square - nearest) / self.bandwidth))
        distance, which = self._tree.query(at, k=np.arange(1, self.neighbours + 1))
        weights = np.exp(-(distance**2 - distance[:, :1] ** 2) / self.bandwidth)
        ends = self.neighbours * np.arange(len(at) + 1)
        return csr_array((weights.ravel(), which.ravel(), ends), shape=(len(at), len(self._x)))


class Experience:
    """Observed transitions of a body or a class, with one regression per condition.

    See section 3.1.3 of the paper. Distances are in units of each input's standard deviation over
    all conditions. Inputs are triples of two planar components and an angular one,
    the last of them the wrench.

    Parameters
    ----------
    reach : float
        Bounding radius of the body (m).
    **options
        Of :class:`LocalRegression`.
    """

    def __init__(self, reach: float, **options: Any) -> None:
        self._reach, self._options = reach, options
        self._x: list[Floats] = []
        self._y: list[Floats] = []
        #: Observed transitions of each condition.
        self.rows: dict[Key, list[int]] = {}
        self._count = 0
        self._models: dict[Key, LocalRegression] = {}

    def add(self, x: Floats, y: Floats, flags: Bools) -> None:
        """Add inputs (n, p), outputs (n, q) and predicates (n, ...)."""
        for key, rows in grouped(flags).items():
            self.rows.setdefault(key, []).extend((rows + self._count).tolist())
        self._x.append(x)
        self._y.append(y)
        self._count += len(x)
        self._models.clear()

    def predict(self, x: Floats, flags: Bools) -> Floats:
        """Return predictions (n, q) at inputs (n, p), predicates (n, ...); NaN if unobserved."""
        out = np.full((len(x), self._y[0].shape[1]), np.nan)
        for key, rows in grouped(flags).items():
            if key in self.rows:
                out[rows] = self._model(key)(x[rows])
        return out

    def gains(self) -> Floats:
        """Return the linear fit of outputs by inputs in the commonest condition, shape (p, q)."""
        x, y = self._joined()
        most = max(self.rows.values(), key=len)
        size = self._sizes(x[most])
        return np.asarray(np.linalg.lstsq(x[most] / size, y[most])[0] / size[:, None])

    def _model(self, key: Key) -> LocalRegression:
        if key not in self._models:
            x, y = self._joined()
            # a column that is constant, up to rounding errors, by its size
            scale, size = x.std(axis=0), self._sizes(x)
            scale = np.where(scale > 1e-9 * size, scale, size)
            rows = self.rows[key]
            self._models[key] = LocalRegression(x[rows], y[rows], scale=scale, **self._options)
        return self._models[key]

    def _sizes(self, x: Floats) -> Floats:
        """Return the largest size of the triple that each column is of, in the column's unit."""
        largest = abs(x).max(axis=0).reshape(-1, 3)
        lever = np.full(len(largest), self._reach)
        lever[-1] = 1 / self._reach  # a torque is a force at the rim
        size = np.maximum(largest[:, :2].max(axis=1), lever * largest[:, 2])
        size = np.where(size > 0, size, 1.0)
        return np.stack([size, size, size / lever], axis=1).ravel()

    def _joined(self) -> tuple[Floats, Floats]:
        self._x, self._y = [np.concatenate(self._x)], [np.concatenate(self._y)]
        return self._x[0], self._y[0]


def grouped(flags: Bools) -> dict[Key, Ints]:
    """Return the rows of predicates (n, ...) that agree, by their flags.

    Examples
    --------
    >>> list(grouped(np.array([[True], [False], [True]])).values())
    [array([0, 2]), array([1])]
    """
    groups: dict[Key, list[int]] = defaultdict(list)
    rows = flags.reshape(len(flags), math.prod(flags.shape[1:])).tolist()
    for i, row in enumerate(rows):
        groups[tuple(row)].append(i)
    return {key: np.array(rows) for key, rows in groups.items()}


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
        Bandwidth of the kernel, lambda; without a unit, as in the paper.
    ridge : float
        See :class:`pbrl_ppl.oomdp.LocalRegression`.
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

    #: Number of draws of a point estimate.
    draws: int = 1

    def __init__(
        self,
        scene: Scene,
        *,
        neighbours: int = 1000,
        bandwidth: float = 1.5,
        ridge: float = 1e-3,
        pose_invariant: bool = True,
        share_classes: bool = False,
        relations: Sequence[Relation] = (),
    ) -> None:
        with checks.located("LWR", FitError):
            checks.whole(neighbours, "neighbours")
            checks.positive(bandwidth, "bandwidth")
            checks.not_negative(ridge, "ridge")
        self.scene, self.pose_invariant, self.relations = scene, pose_invariant, tuple(relations)
        #: Wrenches before the first interval, shape (body, 3): the model does not remember any.
        self.before: Floats = np.zeros((len(scene.moving), len(WRENCH)))
        options = {"neighbours": neighbours, "bandwidth": bandwidth, "ridge": ridge}
        self._experience: dict[int, Experience] = {}
        of_class: dict[str, Experience] = {}
        for i, body in enumerate(scene.moving):
            if not body.kinematic:
                experience = Experience(body.shape.bounding_radius, **options)
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
        k, arrays = len(self.scene.moving), []
        given = {"state": (state, 6), "action": (action, 3), "next_state": (next_state, 6)}
        for name, (array, width) in given.items():
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

    def single(self) -> Self:
        """Return itself."""
        return self

    def after(self, before: Floats) -> Self:
        """Return itself: the model has no memory of wrenches."""
        return self

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

    def step(self, states: Floats, wrenches: Floats, previous: Floats | None = None) -> Floats:
        """Return the states after one sampling interval (Eqs. 5 and 6).

        Parameters
        ----------
        states : ndarray
            Shape (1, n, body, 6), SI units.
        wrenches : ndarray
            Shape (n, body, 3), world frame, N and N m.
        previous : ndarray, optional
            Ignored.

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
        out[abs(out) > 1e6 * self._largest] = np.nan  # an extrapolation has diverged
        return np.asarray(out[None])

    def experience(self, body: str) -> Experience:
        """Return the observed transitions of a body, or of its class if they share models.

        Raises
        ------
        FitError
            If the scene has no such dynamic body.
        """
        names = [mover.name for mover in self.scene.dynamic]
        with checks.located(kind=FitError):
            checks.known(body, names, "LWR: the scene has no moving body")
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
        See :class:`pbrl_ppl.oomdp.LocalRegression`; 0 is Eq. 4.
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
    **options
        Of :class:`LWR`.

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
        **options: Any,
    ) -> None:
        if relations is None:
            attributes = (Attributes(),) * any(body.attributes for body in scene.moving)
            relations = (SectorContacts(), *attributes)
        super().__init__(scene, share_classes=share_classes, relations=relations, **options)
        for relation in self.relations:
            if not isinstance(relation, Relation):
                raise FitError(
                    f"OO-LWR: relations has {relation!r}, expected objects with labels() and of(),"
                    " such as SectorContacts()"
                )
        self.labels = tuple(name for one in self.relations for name in one.labels(scene))
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
        every = self.experience(body).rows.items()
        return {condition(key, self.labels): len(rows) for key, rows in every}


def _turned(triples: Floats, angle: Floats) -> Floats:
    """Return planar vectors, each followed by a value that stays, (n, 3 k), turned by angles."""
    split = triples.reshape(len(triples), triples.shape[1] // 3, 3)
    planar = turned(split[..., :2], angle[:, None])
    return np.concatenate([planar, split[..., 2:]], axis=-1).reshape(triples.shape)
