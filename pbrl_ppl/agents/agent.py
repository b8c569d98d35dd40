"""Tasks, agents that plan with a transition model, the baselines, and control of a real world."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, final

import numpy as np
from numpy.typing import ArrayLike

from pbrl_ppl.effects import Attached, Effect
from pbrl_ppl.errors import GoalError
from pbrl_ppl.history import History, from_segments
from pbrl_ppl.oomdp import LWR, OOLWR
from pbrl_ppl.planning import (
    PAST,
    ActionSet,
    Dynamics,
    Goal,
    TransitionModel,
    plan,
    predicted_path,
    remembered,
    start_state,
)
from pbrl_ppl.posterior import Idata, scene_of
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import WRENCH, Floats


@dataclass(frozen=True)
class Revision:
    """Effect that an agent added to its model during an episode.

    Parameters
    ----------
    attached : Attached
        The effect, and the body that it acts on.
    transitions : int
        Number of transitions observed when it was first added.
    nats : float
        Log-evidence that is lost without it, less its price.
    share : float
        Share of the prediction error (root mean square) that it takes away.
    not_separable_from : tuple of str
        Effects that the data cannot separate from it.
    """

    attached: Attached
    transitions: int
    nats: float
    share: float
    not_separable_from: tuple[str, ...] = ()

    @property
    def effect(self) -> str:
        """Return the name of the effect."""
        return self.attached.effect.name

    @property
    def body(self) -> str:
        """Return the name of the body."""
        return self.attached.body


@dataclass(frozen=True)
class Task:
    """Scene, goal and actions of an agent; the dynamics are unknown to it.

    Attributes
    ----------
    scene : Scene
        Known geometry. Its bodies start at rest at their ``pose``.
    goal : Goal
        An episode ends when it is reached.
    actions : ActionSet
        One is held over each sampling interval: one duration, the scene's ``time_step``.

    Raises
    ------
    GoalError
        If the goal or the actions do not fit the scene, an action is longer than an interval, or a
        body has no pose.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Scene, Shape
    >>> scene = Scene(time_step=0.2, bodies=(Body("puck", Shape.circle(0.2), pose=(0, 0, 0)),))
    >>> pushes = ActionSet.box("puck", forces=(-4.0, 0.0, 4.0))
    >>> task = Task(scene, Goal.of({"puck": (2.0, 0.0, None)}), pushes)
    >>> task.reward(task.start)
    -2.0
    """

    scene: Scene
    goal: Goal
    actions: ActionSet

    def __post_init__(self) -> None:
        self.goal.check(self.scene)
        self.actions.check(self.scene)
        if self.actions.intervals(self.scene) != (1,):
            raise GoalError(
                f"task: actions last {self.actions.durations} s, expected one sampling interval of"
                f" {self.scene.time_step:g} s; an agent chooses an action for each"
            )
        start_state(self.scene, {})

    @property
    def start(self) -> Floats:
        """Return the state at which an episode begins, shape (body, 6), SI units."""
        return start_state(self.scene, {})

    def reward(self, state: Floats) -> float:
        """Return minus the L2 distance of the bodies from their goal (m), as in section 5."""
        return -float(self.goal.distance(self.scene, state))

    def reached(self, state: Floats) -> bool:
        """Return whether a state (body, 6) is within the goal's tolerances."""
        return bool(self.goal.shortfall(self.scene, state) <= 1.0)

    def wrenches(self, state: Floats) -> Floats:
        """Return all actions in a state (body, 6), shape (action, body, 3), world frame, N, N m."""
        count = len(self.actions.actions)
        heading = np.repeat(state[None, :, 2], count, axis=0)
        return self.actions.wrenches(self.scene, np.arange(count), heading)


class Agent(ABC):
    """Agent that plans with a transition model; subclasses define how the model is learned.

    A plan is kept as long as the current model predicts that it leads from the current state to the
    goal; otherwise a new one is made. Of a plan that does not reach the goal, only the first action
    is taken. Without a plan, because nothing was observed yet, the model has no prediction, or no
    state nearer to the goal was found, an action is taken at random.

    Parameters
    ----------
    task : Task
        Scene, goal and actions.
    seed : int
        Seed of the random actions.
    nodes : int
        Largest number of states that a search generates.
    **options
        Options of :func:`pbrl_ppl.plan`.

    Attributes
    ----------
    model : TransitionModel or None
        What it plans with; None before anything was learned.
    planned : bool
        Whether the last action was planned rather than random.
    posterior : InferenceData or DataTree or None
        Current posterior, as made by :func:`pbrl_ppl.fit`, or None.
    added : tuple of Revision
        Effects added to the model.
    """

    #: Name in episodes and figures.
    name: ClassVar[str]
    model: TransitionModel | None = None
    posterior: Idata | None = None
    added: tuple[Revision, ...] = ()

    def __init__(self, task: Task, *, seed: int = 0, nodes: int = 20_000, **options: Any) -> None:
        self.task, self.seed, self._nodes, self._options = task, seed, nodes, options
        self._rng = np.random.default_rng([seed, 0])  # [seed, 1] is the world's
        self._ahead = np.empty((0, len(task.scene.moving), 3))
        # what was played, which an actuator may remember
        self._last = np.zeros((len(task.scene.moving), PAST * len(WRENCH)))
        self.planned = False

    @abstractmethod
    def observe(self, state: Floats, action: Floats, next_state: Floats) -> None:
        """Observe a transition.

        Parameters
        ----------
        state, next_state : ndarray
            States at the ends of one sampling interval, shape (body, 6), SI units.
        action : ndarray
            Held in between, shape (body, 3), world frame, N and N m.
        """

    def update(self) -> None:  # noqa: B027 - regression learns as it observes
        """Update the model with the observed transitions."""

    @property
    def estimates(self) -> Mapping[str, float]:
        """Return current estimates of physical parameters by label; none by default."""
        return {}

    def act(self, state: Floats) -> Floats:
        """Return the next action: planned, or random without a plan.

        Parameters
        ----------
        state : ndarray
            Shape (body, 6), SI units.

        Returns
        -------
        ndarray
            One of the task's actions, shape (body, 3), world frame, N and N m.

        Raises
        ------
        KeyboardInterrupt
            If the search was interrupted.
        """
        wrenches, model = self.task.wrenches(state), self.model
        self._ahead = self._ahead[:0] if model is None else self._planned(model, state)
        self.planned = len(self._ahead) > 0
        if self.planned:
            wanted, self._ahead = self._ahead[0], self._ahead[1:]
            # the heading, and with it the wrench, differs a little from the plan's
            off = wrenches - wanted
            off[..., 2] /= [body.shape.bounding_radius for body in self.task.scene.moving]
            chosen = int(np.argmin((off**2).sum(axis=(1, 2))))
        else:
            chosen = int(self._rng.integers(len(wrenches)))
        self._last = remembered(wrenches[chosen], self._last)
        return np.array(wrenches[chosen])

    def _planned(self, model: TransitionModel, state: Floats) -> Floats:
        """Return wrenches (time, body, 3): the last plan's if it reaches the goal."""
        task = self.task
        if len(self._ahead):
            end = predicted_path(model.after(self._last), state, self._ahead)[:, -1]
            if float(task.goal.shortfall(task.scene, end).mean()) <= 1.0:  # false for NaN
                return self._ahead
        planned = plan(
            model, state, task.goal, task.actions,
            before=self._last, nodes=self._nodes, **self._options,
        )  # fmt: skip
        if planned.stopped == "interrupted":  # the search catches it
            raise KeyboardInterrupt
        return planned.wrenches if planned.reached else planned.wrenches[:1]


class _RegressionAgent(Agent):
    """Agent that learns a regression as it observes."""

    _regression: ClassVar[type[LWR] | type[OOLWR]]

    def __init__(
        self, task: Task, *, learner: Mapping[str, Any] | None = None, **options: Any
    ) -> None:
        super().__init__(task, **options)
        self._learner = self._regression(task.scene, **(learner or {}))

    def observe(self, state: Floats, action: Floats, next_state: Floats) -> None:
        """Learn from a transition; arguments as for :meth:`Agent.observe`."""
        self._learner.observe(state, action, next_state)
        self.model = self._learner


@final
class OOLWRAgent(_RegressionAgent):
    """Agent with object-oriented LWR (section 3.1).

    As in the paper, bodies of one class share their models, and a condition is the set of sectors
    in contact. ``learner={"relations": (SectorContacts(by_object=True),)}`` distinguishes the
    objects in contact, and ``learner={"share_classes": False}`` learns each body separately.

    Parameters
    ----------
    task : Task
        Scene, goal and actions.
    learner : mapping, optional
        Options of :class:`pbrl_ppl.OOLWR`; Table 2's by default.
    **options
        Options of :class:`Agent`.

    Raises
    ------
    FitError
        If an option of the learner is invalid.
    """

    name: ClassVar[str] = "OO-LWR"
    _regression = OOLWR


@final
class LWRAgent(_RegressionAgent):
    """Agent with LWR (section 3.1.2): it does not perceive walls.

    Parameters
    ----------
    task : Task
        Scene, goal and actions.
    learner : mapping, optional
        Options of :class:`pbrl_ppl.LWR`; Table 2's by default.
    **options
        Options of :class:`Agent`.

    Raises
    ------
    FitError
        If an option of the learner is invalid.
    """

    name: ClassVar[str] = "LWR"
    _regression = LWR


@final
class TrueModelAgent(Agent):
    """Agent with the true parameters: the upper bound.

    Parameters
    ----------
    task : Task
        Scene, goal and actions.
    parameters : mapping
        True parameters by name, as for :meth:`pbrl_ppl.Dynamics.known`.
    effects : iterable of Effect or Attached
        True effects in addition to those that the scene declares.
    **options
        Options of :class:`Agent`.

    Raises
    ------
    ParameterError
        If a parameter is missing, unknown or invalid.
    """

    name: ClassVar[str] = "true model"

    def __init__(
        self,
        task: Task,
        parameters: Mapping[str, object],
        effects: Iterable[Effect | Attached] = (),
        **options: Any,
    ) -> None:
        super().__init__(task, **options)
        self.model = Dynamics.known(task.scene, parameters, effects, threads=1)

    def observe(self, state: Floats, action: Floats, next_state: Floats) -> None:
        """Do nothing: there is nothing to learn."""


@dataclass(frozen=True, eq=False)
class Acted:
    """Record of :func:`act`: measured states, wrenches played, and distance from the goal.

    Attributes
    ----------
    scene : Scene
        Orders the bodies.
    states : ndarray
        Measured states, the start first, shape (time + 1, body, 6), SI units.
    wrenches : ndarray
        Wrenches played, shape (time, body, 3), N and N m.
    reached : bool
        Whether the last state is within the goal's tolerances.
    distance : float
        L2 distance of the last state from the goal (m).
    plans : int
        Number of plans made.
    """

    scene: Scene
    states: Floats
    wrenches: Floats
    reached: bool
    distance: float
    plans: int

    def history(self) -> History:
        """Return a history of one trajectory, for example for :func:`pbrl_ppl.update`."""
        return from_segments(
            self.scene, self.states[:1], self.wrenches[None], self.states[None, 1:]
        )


def act(
    world: Callable[[Floats], Floats],
    idata: Idata,
    start: Mapping[str, Sequence[float]] | ArrayLike,
    goal: Goal | Mapping[str, Sequence[float | None]],
    actions: ActionSet | None = None,
    *,
    every: int | None = None,
    intervals: int = 200,
    **options: Any,
) -> Acted:
    """Plan, play the start of the plan, measure and replan until the goal is reached.

    Parameters
    ----------
    world : callable
        Plays one sampling interval: takes wrenches, shape (body, 3), world frame, N and N m, and
        returns the measured states after it, shape (body, 6), SI units.
    idata, start, goal, actions
        See :func:`pbrl_ppl.plan`.
    every : int, optional
        Intervals to play before the next plan; by default one plan is played to its end.
    intervals : int
        Largest number of intervals to play.
    **options
        Options of :func:`pbrl_ppl.plan`.

    Returns
    -------
    Acted
        States, wrenches, and whether the goal is reached.

    Raises
    ------
    GoalError
        As :func:`pbrl_ppl.plan`; if ``every`` or ``intervals`` is below 1, or the world returns
        states of another shape.

    Examples
    --------
    ::

        done = act(robot.push_and_observe, idata, start, goal, every=10, draws=16)
        idata = pp.update(idata, done.history())
    """
    if intervals < 1 or (every is not None and every < 1):
        raise GoalError(f"act: every is {every} and intervals {intervals}, expected 1 or more")
    scene = idata.scene if isinstance(idata, TransitionModel) else scene_of(idata)
    target = Goal.of(goal)
    target.check(scene)

    def is_reached(state: Floats) -> bool:
        return bool(target.shortfall(scene, state) <= 1.0)

    states, plans = [start_state(scene, start)], 0
    played: list[Floats] = []
    while len(played) < intervals and not is_reached(states[-1]):
        last = played[-1] if played else None
        ahead = plan(idata, states[-1], target, actions, before=last, **options)
        plans += 1
        for wrench in ahead.wrenches[: intervals - len(played)][:every]:
            state = np.asarray(world(wrench), dtype=float)
            if state.shape != states[0].shape or not np.isfinite(state).all():
                raise GoalError(
                    f"act: the world returned states of shape {state.shape}, expected finite ones"
                    f" of shape {states[0].shape}"
                )
            states.append(state)
            played.append(wrench)
            if every is not None and is_reached(state):
                break
        if every is None or not len(ahead.wrenches):
            break
    wrenches = np.array(played).reshape(-1, len(states[0]), 3)
    distance = float(target.distance(scene, states[-1]))
    return Acted(scene, np.array(states), wrenches, is_reached(states[-1]), distance, plans)
