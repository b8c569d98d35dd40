"""Goals of a plan, and actions that lead there: target poses, wrenches, and their files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import GoalError
from pbrl_ppl.planning.dynamics import TransitionModel, remembered
from pbrl_ppl.scene import Scene, checks, nearest
from pbrl_ppl.state import POSE, THETA, WRENCH, Floats, turned

if TYPE_CHECKING:
    from pbrl_ppl.posterior import Idata


@dataclass(frozen=True)
class Target:
    """Target pose of one body; a coordinate that is None is free.

    Attributes
    ----------
    body : str
        A moving body of the scene.
    x, y, theta : float, optional
        m, m, rad.
    weight : float
        Weight of the body in the L2 distance.
    tolerance : float, optional
        Largest error of the position at the goal (m); by default a fifth of the radius of the
        body's bounding circle.
    angle_tolerance : float
        Largest error of the angle at the goal (rad).
    speed : float, optional
        Largest speed at the goal, that of the rim included (m/s); any speed by default.

    Raises
    ------
    GoalError
        If a number is not finite, a weight or tolerance not positive, or nothing is asked for.
    """

    body: str
    x: float | None = None
    y: float | None = None
    theta: float | None = None
    weight: float = 1.0
    tolerance: float | None = None
    angle_tolerance: float = 0.1
    speed: float | None = None

    def __post_init__(self) -> None:
        with checks.located(kind=GoalError):
            checks.label(self.body, "goal: body")
            for field in fields(self)[1:]:
                check = checks.finite if field.name in POSE else checks.positive
                checks.settle(self, f"goal of {self.body}", **{field.name: check})
        if self.x is None and self.y is None and self.theta is None:
            raise GoalError(f"goal of {self.body}: x, y and theta are all free; give one")


@dataclass(frozen=True)
class Goal:
    """Targets of a plan and its penalty for contact.

    Attributes
    ----------
    targets : tuple of Target
        One or more bodies, each once.
    contact_penalty : float
        Cost of a second in contact, in addition to the second; infinite if nothing may touch.
        Contacts are checked at the ends of the sampling intervals.

    Raises
    ------
    GoalError
        If there is no target, a body has two, or the penalty is negative.

    Examples
    --------
    >>> goal = Goal.of({"cart": (3.0, 1.0, None)})  # any heading
    >>> goal.targets[0].angle_tolerance
    0.1
    """

    targets: tuple[Target, ...]
    contact_penalty: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "targets", tuple(self.targets))
        if not self.targets:
            raise GoalError("goal: it has no target; say where a body should be")
        names = [target.body for target in self.targets]
        for name in names:
            if names.count(name) > 1:
                raise GoalError(f"goal: {name} has {names.count(name)} targets; keep one")
        if self.contact_penalty != math.inf:
            with checks.located(kind=GoalError):
                checks.settle(self, "goal", contact_penalty=checks.not_negative)

    @classmethod
    def of(
        cls,
        targets: Goal | Mapping[str, Sequence[float | None]],
        contact_penalty: float = 0.0,
        **options: float,
    ) -> Goal:
        """Return a goal from poses by body name: ``{"cart": (x, y, theta)}``, None where free.

        Parameters
        ----------
        targets : mapping or Goal
            Pose of each body, m and rad; a goal as it is.
        contact_penalty : float
            Of the goal.
        **options
            Options of every target.

        Raises
        ------
        GoalError
            If a pose has not three values, or an option is unknown.
        """
        if isinstance(targets, Goal):
            return targets
        known = [field.name for field in fields(Target)][4:]
        with checks.located(kind=GoalError):
            checks.keyed(options, "goal", (), known)
        for name, pose in targets.items():
            if len(pose) != 3:
                raise GoalError(f"goal of {name}: got {len(pose)} values, expected x, y, theta")
        read = (Target(name, x, y, turn, **options) for name, (x, y, turn) in targets.items())
        return cls(tuple(read), contact_penalty)

    @classmethod
    def load(cls, path: str | Path) -> Goal:
        """Read a TOML file: ``contact_penalty``, and a ``[[target]]`` for each body.

        Raises
        ------
        GoalError
            If it is missing, is not TOML, or has an unknown key.
        """
        targets, options = read_tables(path, "goal", Target, ("contact_penalty",))
        return cls(tuple(targets), **options)

    def check(self, scene: Scene) -> None:
        """Check that the scene has the bodies, and that they can be pushed.

        Raises
        ------
        GoalError
            If one cannot; it names the body.
        """
        check_pushed(scene, (target.body for target in self.targets), "goal")

    def places(self, scene: Scene) -> list[int]:
        """Return the indices of the targets' bodies among the scene's moving bodies."""
        moving = [body.name for body in scene.moving]
        return [moving.index(target.body) for target in self.targets]

    def tolerances(self, scene: Scene) -> list[float]:
        """Return the position tolerance of each target (m): by default a fifth of its radius."""
        radii = (scene.body(target.body).shape.bounding_radius for target in self.targets)
        return [t.tolerance or 0.2 * r for t, r in zip(self.targets, radii, strict=True)]

    def errors(self, scene: Scene, states: Floats) -> Floats:
        """Return offsets from the targets, 0 where free, shape (..., target, 3): m, m, rad.

        Parameters
        ----------
        scene : Scene
            Orders the bodies.
        states : ndarray
            Shape (..., body, 6).
        """
        poses = states[..., self.places(scene), :3]
        wanted = np.array([(t.x, t.y, t.theta) for t in self.targets], dtype=float)  # None: NaN
        offset = poses - wanted
        offset[..., 2] = np.mod(offset[..., 2] + np.pi, 2 * np.pi) - np.pi
        return np.where(np.isnan(wanted), 0.0, offset)

    def distance(self, scene: Scene, states: Floats) -> Floats:
        """Return the weighted L2 distance from the targets (m), angles at the rims, shape (...)."""
        lever = np.array([scene.body(t.body).shape.bounding_radius for t in self.targets])
        weight = np.array([t.weight for t in self.targets])
        offset = self.errors(scene, states)
        offset[..., 2] *= lever
        return np.asarray(np.sqrt((weight[:, None] * offset**2).sum(axis=(-2, -1))))

    def shortfall(self, scene: Scene, states: Floats) -> Floats:
        """Return the error of the worst target in units of its tolerances; 1 or less is reached."""
        offset = self.errors(scene, states)
        worst = np.zeros(offset.shape[:-2])
        targets = zip(self.targets, self.places(scene), self.tolerances(scene), strict=True)
        for i, (t, place, tolerance) in enumerate(targets):
            far = np.hypot(offset[..., i, 0], offset[..., i, 1]) / tolerance
            worst = np.maximum(worst, np.maximum(far, abs(offset[..., i, 2]) / t.angle_tolerance))
            if t.speed is not None:
                body = states[..., place, :]
                rim = scene.body(t.body).shape.bounding_radius * abs(body[..., 5])
                worst = np.maximum(worst, (np.hypot(body[..., 3], body[..., 4]) + rim) / t.speed)
        return worst


def check_pushed(scene: Scene, names: Iterable[str], where: str, hint: str = "") -> None:
    """Check that the scene has bodies that can be pushed.

    Raises
    ------
    GoalError
        If not; it names the body.
    """
    free = [body.name for body in scene.dynamic]
    for name in names:
        if name not in free:
            raise GoalError(
                f'{where}: the scene has no moving body "{name}" that can be pushed'
                f"{nearest(name, free)}{hint}"
            )


def read_tables(
    path: str | Path, what: str, kind: type[Any], options: Iterable[str]
) -> tuple[list[Any], dict[str, Any]]:
    """Read a TOML file: a Target or Action for each of its tables, and options.

    Raises
    ------
    GoalError
        If it is missing, is not TOML, has another key, or a table names no body.
    """
    key = kind.__name__.lower()
    with checks.located(kind=GoalError):
        text = checks.read_file(path, what)
    with checks.located(f"{what} {path}", GoalError):
        document = checks.document(text)
        checks.keyed(document, "the file", (), (*options, key))
        tables = [checks.fields_of(kind, table, at) for at, table in checks.tables(document, key)]
    document.pop(key, None)
    return [kind(**table) for table in tables], document


@dataclass(frozen=True)
class Action:
    """A wrench at the origin of one body.

    Attributes
    ----------
    body : str
        Name of the body that is pushed.
    force : tuple of float
        N.
    torque : float
        N m.
    frame : str
        ``body``: the force turns with the body from interval to interval; ``world``: it does not.

    Raises
    ------
    GoalError
        If a number is not finite, or the frame is neither.
    """

    body: str
    force: tuple[float, float] = (0.0, 0.0)
    torque: float = 0.0
    frame: str = "body"

    def __post_init__(self) -> None:
        where = f"action on {self.body}"
        with checks.located(kind=GoalError):
            checks.label(self.body, "action: body")
            checks.settle(self, where, force=checks.vector, torque=checks.finite)
            checks.settle(self, where, frame=checks.choice(("body", "world")))


@dataclass(frozen=True)
class ActionSet:
    """Wrenches, one of which acts at a time, and their durations.

    Attributes
    ----------
    actions : tuple of Action
        At least one.
    durations : tuple of float
        s; whole numbers of sampling intervals. None: one interval.

    Raises
    ------
    GoalError
        If it is empty, or a duration is not positive.

    Examples
    --------
    >>> pushes = ActionSet.box("cart", forces=(0.0, 15.0), torques=(-3.0, 0.0, 3.0))
    >>> len(pushes.actions)
    6
    """

    actions: tuple[Action, ...]
    durations: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "actions", tuple(self.actions))
        if not self.actions:
            raise GoalError("actions: the set is empty; give at least one wrench on a body")
        with checks.located(kind=GoalError):
            checks.settle(self, "actions", durations=checks.each(checks.positive))
        if self.durations == ():
            raise GoalError("actions: there is no duration; give one (s)")

    @classmethod
    def box(
        cls,
        body: str,
        *,
        forces: Sequence[float] = (0.0,),
        lateral: Sequence[float] = (0.0,),
        torques: Sequence[float] = (0.0,),
        frame: str = "body",
        durations: Sequence[float] | None = None,
    ) -> ActionSet:
        """Return all combinations of forces along x and y, and torques on a body (N, N, N m)."""
        wrenches = product(forces, lateral, torques)
        return cls(
            tuple(Action(body, (fx, fy), torque, frame) for fx, fy, torque in wrenches),
            None if durations is None else tuple(durations),
        )

    @classmethod
    def load(cls, path: str | Path) -> ActionSet:
        """Read a TOML file: ``durations``, and an ``[[action]]`` for each wrench.

        Raises
        ------
        GoalError
            If it is missing, is not TOML, has an unknown key, or no action.
        """
        actions, options = read_tables(path, "actions", Action, ("durations",))
        return cls(tuple(actions), **options)

    @classmethod
    def recorded(cls, idata: Idata) -> ActionSet:
        """Return actions like those in the posterior's data, whose effects the model knows.

        For each body that was pushed: forces along x and y and torques, in both directions, alone
        and together, of a size that a tenth of the recorded ones exceed, for two intervals or five.

        Parameters
        ----------
        idata : InferenceData or DataTree
            A posterior.

        Raises
        ------
        GoalError
            If nothing was pushed.
        """
        from pbrl_ppl.posterior import group, scene_of  # not for given actions

        scene = scene_of(idata)
        pushes = group(idata, "constant_data")["actions"].to_numpy()[..., :3]
        actions: list[Action] = []
        for i, body in enumerate(scene.moving):
            if body.kinematic:  # its path was the action, not a push
                continue
            sizes = np.hypot(pushes[..., i, 0], pushes[..., i, 1]).ravel(), abs(pushes[..., i, 2])
            force, torque = (
                float(np.quantile(s[s > 0], 0.9)) if (s > 0).any() else 0.0 for s in sizes
            )
            if not (force or torque):
                continue
            ways = [(0.0, 0.0), (force, 0.0), (-force, 0.0), (0.0, force), (0.0, -force)]
            turns = (0.0, torque, -torque) if torque else (0.0,)
            actions += [
                Action(body.name, way, turn)
                for way, turn in product(ways if force else ways[:1], turns)
            ]
        if not actions:
            raise GoalError("actions: nothing was pushed in the posterior's data; give actions")
        return cls(tuple(actions), (scene.time_step * 2, scene.time_step * 5))

    def check(self, scene: Scene) -> None:
        """Check that the scene has the bodies, and that durations are whole sampling intervals.

        Raises
        ------
        GoalError
            If not; it names the body or the duration.
        """
        hint = (
            " (a kinematic body stays where it starts in a plan; Transition.predict takes its path)"
        )
        check_pushed(scene, (action.body for action in self.actions), "actions", hint)
        self.intervals(scene)

    def intervals(self, scene: Scene) -> tuple[int, ...]:
        """Return the durations as numbers of sampling intervals, in increasing order."""
        counts = set()
        for duration in self.durations or (scene.time_step,):
            count = duration / scene.time_step
            if not math.isfinite(count) or round(count) < 1 or abs(count - round(count)) > 1e-6:
                raise GoalError(
                    f"actions: a duration is {duration:g} s, expected a whole number of sampling"
                    f" intervals of {scene.time_step:g} s"
                )
            counts.add(round(count))
        return tuple(sorted(counts))

    def wrenches(self, scene: Scene, which: NDArray[np.intp], heading: Floats) -> Floats:
        """Return world-frame wrenches of chosen actions, shape (n, body, 3).

        Parameters
        ----------
        scene : Scene
            Orders the bodies.
        which : ndarray
            Number of each action, shape (n,).
        heading : ndarray
            The bodies' angles, shape (n, body), rad.
        """
        names = [body.name for body in scene.moving]
        body = np.array([names.index(action.body) for action in self.actions])[which]
        pushes = np.array([(*action.force, action.torque) for action in self.actions])[which]
        turns = np.array([action.frame == "body" for action in self.actions])[which]
        rows = np.arange(len(which))
        angle = np.where(turns, heading[rows, body], 0.0)
        out = np.zeros((len(which), len(names), 3))
        out[rows, body, :2] = turned(pushes[:, :2], angle)
        out[rows, body, 2] = pushes[:, 2]
        return out

    def strongest(self, body: str) -> tuple[float, float]:
        """Return the largest force (N) and torque (N m) on a body."""
        chosen = [action for action in self.actions if action.body == body]
        force = max((math.hypot(*action.force) for action in chosen), default=0.0)
        return force, max((abs(action.torque) for action in chosen), default=0.0)


def play(
    dynamics: TransitionModel,
    start: Floats,
    actions: ActionSet,
    which: NDArray[np.intp],
    heading: Callable[[Floats], Floats],
) -> Floats:
    """Return world-frame wrenches of sequences of actions, shape (n, time, body, 3).

    Parameters
    ----------
    dynamics : TransitionModel
        Predicts the path, on which wrenches of the body frame depend.
    start : ndarray
        Shape (body, 6).
    actions : ActionSet
        Actions that are played.
    which : ndarray
        Number of the action in each interval, shape (n, time).
    heading : callable
        Heading of each body, shape (n, body), from its angles under all draws.
    """
    n, steps = which.shape
    states = np.tile(start, (dynamics.draws, n, 1, 1))
    last = np.tile(dynamics.before, (n, 1, 1))
    out = np.zeros((n, steps, len(start), len(WRENCH)))
    for t in range(steps):
        out[:, t] = actions.wrenches(dynamics.scene, which[:, t], heading(states[..., THETA]))
        states = dynamics.step(states, out[:, t], last)
        last = remembered(out[:, t], last)
    return out


#: Lowest and highest value of components of the wrench, by body.
Bounds = Mapping[str, Mapping[str, Sequence[float]]]


def allowed_wrenches(scene: Scene, actions: ActionSet | Bounds, steps: int) -> Allowed:
    """Return the sequences that an action set or bounds allow.

    Raises
    ------
    GoalError
        If a body or a component is unknown, or a bound is not two numbers.
    """
    if isinstance(actions, ActionSet):
        actions.check(scene)
        return _OfActions(scene, actions, steps)
    names = [body.name for body in scene.moving]
    low, high = np.zeros((2, len(names), len(WRENCH)))
    check_pushed(scene, actions, "bounds")
    for body, bounds in actions.items():
        with checks.located(kind=GoalError):
            pairs = checks.table(bounds, f"bounds of {body}", dict.fromkeys(WRENCH, checks.vector))
        for component, ends in pairs:
            at = names.index(body), WRENCH.index(component)
            low[at], high[at] = ends
            if ends[0] > ends[1]:
                raise GoalError(
                    f"bounds of {component} on {body} are {ends}, expected the lowest and the"
                    " highest value"
                )
    if not (high > low).any():
        raise GoalError("bounds: nothing may vary; give a lowest and a higher highest value")
    return _Within(low, high, steps, max(1, round(steps / 8)))


@dataclass(frozen=True, eq=False)
class _Within:
    """Wrenches within bounds (body, 3), each held for some intervals."""

    low: Floats
    high: Floats
    steps: int
    hold: int

    @property
    def pieces(self) -> int:
        """Number of pieces of a sequence."""
        return math.ceil(self.steps / self.hold)

    def random(self, rng: np.random.Generator, n: int) -> Floats:
        """Draw sequences, shape (n, piece, ...)."""
        share = rng.random((n, self.pieces, *self.low.shape))
        return np.asarray(self.low + share * (self.high - self.low))

    def extreme(self, rng: np.random.Generator, n: int) -> Floats:
        """Draw sequences with more values at the bounds."""
        inner = self.random(rng, n)
        ends = np.where(rng.random(inner.shape) < 0.5, self.low, self.high)
        nothing = np.clip(0.0, self.low, self.high)
        kind = rng.integers(3, size=inner.shape)
        return np.where(kind == 0, inner, np.where(kind == 1, nothing, ends))

    def wrenches(self, genes: Floats, dynamics: TransitionModel, start: Floats) -> Floats:
        """Return world-frame wrenches of sequences, shape (n, time, body, 3)."""
        return np.repeat(genes, self.hold, axis=1)[:, : self.steps]


@dataclass(frozen=True, eq=False)
class _OfActions:
    """Actions of a set, each for one of its durations; a piece has the numbers of both."""

    scene: Scene
    actions: ActionSet
    steps: int

    @property
    def pieces(self) -> int:
        return math.ceil(self.steps / min(self.actions.intervals(self.scene)))

    def random(self, rng: np.random.Generator, n: int) -> Floats:
        kinds = len(self.actions.actions), len(self.actions.intervals(self.scene))
        return rng.integers(kinds, size=(n, self.pieces, 2)).astype(float)

    extreme = random

    def wrenches(self, genes: Floats, dynamics: TransitionModel, start: Floats) -> Floats:
        number, length = genes.astype(np.intp).transpose(2, 0, 1)
        ends = np.cumsum(np.array(self.actions.intervals(self.scene))[length], axis=1)
        time = np.arange(self.steps)
        piece = (time[None, :, None] >= ends[:, None, :]).sum(axis=2)
        which = np.take_along_axis(number, piece, axis=1)
        return play(dynamics, start, self.actions, which, lambda angles: np.nan_to_num(angles[0]))


#: A set of sequences, each made of pieces.
Allowed = _Within | _OfActions
