"""Receding-horizon control of a user's world: plan, play, measure, plan again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pbrl_ppl.errors import GoalError
from pbrl_ppl.history import History, from_segments
from pbrl_ppl.planning import ActionSet, Goal, TransitionModel, plan, start_state
from pbrl_ppl.posterior import Idata, scene_of
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import Floats


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
    target = goal if isinstance(goal, Goal) else Goal.of(goal)
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
