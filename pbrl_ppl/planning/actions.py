"""Actions of a planner: wrenches on bodies, their durations, and sequences of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import GoalError
from pbrl_ppl.planning.dynamics import TransitionModel, remembered
from pbrl_ppl.planning.goals import check_pushed, read_tables
from pbrl_ppl.scene import Scene, checks
from pbrl_ppl.state import THETA, WRENCH, Floats, turned

if TYPE_CHECKING:
    from pbrl_ppl.posterior import Idata


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
        if self.durations is None:
            return
        with checks.located(kind=GoalError):
            given = checks.listed(self.durations, "actions: durations", "a list of them (s)")
            durations = tuple(checks.positive(one, "actions: a duration (s)") for one in given)
        object.__setattr__(self, "durations", durations)
        if not durations:
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
    def recorded(
        cls, idata: Idata, *, quantile: float = 0.9, intervals: tuple[int, ...] = (2, 5)
    ) -> ActionSet:
        """Return actions like those in the posterior's data, whose effects the model knows.

        For each body that was pushed: forces along x and y and torques, in both directions, alone
        and together, of a size that a tenth of the recorded ones exceed.

        Parameters
        ----------
        idata : InferenceData or DataTree
            A posterior.
        quantile : float
            Quantile of the recorded pushes that a plan pushes with.
        intervals : tuple of float
            For how many intervals a plan pushes.

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
                float(np.quantile(s[s > 0], quantile)) if (s > 0).any() else 0.0 for s in sizes
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
        return cls(tuple(actions), tuple(scene.time_step * n for n in intervals))

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


def allowed_wrenches(
    scene: Scene, actions: ActionSet | Bounds, steps: int, hold: int | None, *, pieces: int = 8
) -> Allowed:
    """Return the sequences that an action set or bounds allow.

    ``pieces``: pieces of a sequence by default.

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
                    f"bounds of {component} on {body} are {ends}, expected the lowest value and"
                    " then the highest"
                )
    if not (high > low).any():
        raise GoalError("bounds: nothing may vary; give a lowest and a higher highest value")
    return _Within(low, high, steps, hold or max(1, round(steps / pieces)))


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
        return np.select(
            [kind == 0, kind == 1], [inner, np.broadcast_to(nothing, inner.shape)], ends
        )

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

    def extreme(self, rng: np.random.Generator, n: int) -> Floats:
        return self.random(rng, n)

    def wrenches(self, genes: Floats, dynamics: TransitionModel, start: Floats) -> Floats:
        number, length = genes.astype(np.intp).transpose(2, 0, 1)
        ends = np.cumsum(np.array(self.actions.intervals(self.scene))[length], axis=1)
        time = np.arange(self.steps)
        piece = (time[None, :, None] >= ends[:, None, :]).sum(axis=2)
        which = np.take_along_axis(number, piece, axis=1)
        return play(dynamics, start, self.actions, which, lambda angles: np.nan_to_num(angles[0]))


#: A set of sequences, each made of pieces.
Allowed = _Within | _OfActions
