"""Searches for a plan: their task, result and cost, and MPPI, a receding horizon for dynamic tasks.

Model predictive path integral control (MPPI) is one search, :func:`pbrl_ppl.planning.astar.astar`
the other.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from pbrl_ppl.errors import GoalError
from pbrl_ppl.physics import overlap
from pbrl_ppl.planning.dynamics import TransitionModel, remembered
from pbrl_ppl.planning.goals import ActionSet, Goal
from pbrl_ppl.scene import Scene, smallest_radius
from pbrl_ppl.state import Floats
from pbrl_ppl.system.threads import Say, silent


@dataclass(frozen=True, eq=False)
class SearchTask:
    """SearchTask of a search.

    Parameters
    ----------
    dynamics : TransitionModel
        One draw or many.
    start : ndarray
        Shape (body, 6).
    goal, actions
        As for :func:`pbrl_ppl.plan`.
    tail : float
        The goal is reached where the mean shortfall of the worst share of draws is within the
        tolerances: 1 for the expectation, less for conditional value at risk.
    nodes : int
        States to generate at most, counting each draw's; by default 15 s or so for one body.
    seconds : float
        Limit of time; with it, the plan depends on how busy the machine is.
    seed : int
        Of the search's random numbers.
    progress : callable
        Called with a text on how far the search is.
    """

    dynamics: TransitionModel
    start: Floats
    goal: Goal
    actions: ActionSet
    tail: float = 1.0
    nodes: int = 2_000_000
    seconds: float = np.inf
    seed: int = 0
    progress: Say = silent


@dataclass(frozen=True, eq=False)
class FoundPlan:
    """Result of a search.

    Attributes
    ----------
    wrenches : ndarray
        World frame, one an interval, shape (time, body, 3), N and N m.
    reached : bool
        Whether the goal is reached, by the model.
    stopped : str
        ``goal``, ``nodes``, ``time``, ``exhausted`` or ``interrupted``.
    nodes : int
        States that were generated, counting each draw's.
    seconds : float
        Duration of the search.
    """

    wrenches: Floats
    reached: bool
    stopped: str
    nodes: int
    seconds: float


def tail_mean(values: Floats, tail: float) -> Floats:
    """Return the mean of the worst share ``tail`` of values over the first axis.

    1 is the expectation, less than 1 the conditional value at risk (Rockafellar and Uryasev, 2000).

    Examples
    --------
    >>> float(tail_mean(np.array([1.0, 2.0, 6.0, 8.0]), 0.5))
    7.0
    """
    n = len(values)
    worst = max(1, int(np.ceil(tail * n - 1e-9)))
    if worst == n:
        return np.asarray(values.mean(axis=0))
    return np.asarray(np.partition(values, n - worst, axis=0)[n - worst :].mean(axis=0))


def contact_cost(goal: Goal, scene: Scene, states: Floats, *, near: float = 0.01) -> Floats:
    """Return the penalty of a second in contact, as a mean over the draws.

    Parameters
    ----------
    goal : Goal
        Says the penalty.
    scene : Scene
        Bodies, walls and shapes.
    states : ndarray
        Shape (draw, n, body, 6), SI units.
    near : float
        Shapes this near touch, as a share of the smallest moving body's bounding radius: the engine
        lets bodies that rest on each other sink in a little.

    Returns
    -------
    ndarray
        Shape (n,); infinite where a forbidden contact occurs under any draw.
    """
    if not goal.contact_penalty:
        return np.zeros(states.shape[1])
    poses = np.nan_to_num(states[..., :3]).reshape(-1, states.shape[2], 3)
    touch = near * smallest_radius(scene)
    share = (overlap(scene, poses) > -touch).reshape(states.shape[:2]).mean(axis=0)
    return np.where(share > 0, goal.contact_penalty * np.maximum(share, 1e-9), 0.0)


@dataclass(eq=False)
class Horizon:
    """Receding horizon: wrenches for the next intervals, improved and shifted at every step.

    Wrenches may be anything up to the strongest of the action set, on all of its bodies at once.

    Parameters
    ----------
    task : SearchTask
        Model, goal, actions and risk.
    horizon : int
        Intervals looked ahead.
    samples : int
        Sequences tried at a time.
    iterations : int
        Times they are drawn about the best mean.

    References
    ----------
    Williams, Wagener, Goldfain, Drews, Rehg, Boots, Theodorou, "Information theoretic MPC for
    model-based reinforcement learning", ICRA 2017.
    """

    task: SearchTask
    horizon: int
    samples: int
    iterations: int

    def __post_init__(self) -> None:
        task, scene = self.task, self.task.dynamics.scene
        self.rng = np.random.default_rng(task.seed)
        strongest = [task.actions.strongest(body.name) for body in scene.moving]
        self.most = np.array([(force, force, torque) for force, torque in strongest])
        self.mean = np.zeros((self.horizon, *self.most.shape))
        self.bodies = task.goal.places(scene)
        # the penalty of contact is in seconds: over the horizon, they count as the way at the start
        reach = min(scene.moving[i].shape.bounding_radius for i in self.bodies)
        self.way = max(float(task.goal.distance(scene, task.start)), reach)
        self.generated = 0

    def improve(self, start: Floats, before: Floats) -> None:
        """Draw sequences about the mean; weigh them by their cost.

        Parameters
        ----------
        start : ndarray
            States that they begin from, shape (draw, body, 6).
        before : ndarray
            Wrenches in the interval before, shape (body, 3).
        """
        persistence = 0.7  # correlation of the noise from one interval to the next
        size = (self.samples, *self.mean.shape)
        for iteration in range(self.iterations):
            # standard deviation of the wrenches that are tried: half of the strongest at first
            spread = 0.5 * self.most * 0.7**iteration
            noise = self.rng.standard_normal(size)
            for t in range(1, size[1]):
                noise[:, t] *= np.sqrt(1 - persistence**2)
                noise[:, t] += persistence * noise[:, t - 1]
            tried = np.clip(self.mean + spread * noise, -self.most, self.most)
            tried[0] = self.mean
            cost = self._cost(start, tried, before)
            worst = np.max(cost[np.isfinite(cost)], initial=0.0)
            cost = np.where(np.isfinite(cost), cost, 1e3 * worst)
            # share of the samples that have about as much weight as all others: a twentieth
            few = np.sort(cost)[: max(2, int(0.05 * self.samples))]
            least = 1e-9 * few[-1] + np.finfo(float).tiny
            weight = np.exp(-(cost - few[0]) / max(few[-1] - few[0], least))
            self.mean = np.tensordot(weight / weight.sum(), tried, axes=1)

    def _cost(self, start: Floats, tried: Floats, before: Floats) -> Floats:
        """Return L2 distance from the goal (mean and last), last speed, and contacts."""
        task = self.task
        scene, goal = task.dynamics.scene, task.goal
        states = np.repeat(start[:, None], len(tried), axis=1)
        cost = np.zeros(len(tried))
        last = np.broadcast_to(before, (len(tried), *before.shape))
        for t in range(self.horizon):
            states = task.dynamics.step(states, tried[:, t], last)
            last = remembered(tried[:, t], last)
            self.generated += len(tried) * task.dynamics.draws
            far = tail_mean(goal.distance(scene, states), task.tail)
            cost += (far + self.way * contact_cost(goal, scene, states)) / self.horizon
        speed = np.sqrt((states[..., self.bodies, 3:5] ** 2).sum(axis=(-2, -1)))
        # cost of the speed at the end, in sampling intervals at it: a fast body does not stay
        arrival = 0.8 * scene.time_step * tail_mean(speed, task.tail)
        return np.asarray(cost + far + arrival)


def mppi(
    task: SearchTask,
    *,
    horizon: int = 15,
    samples: int = 256,
    iterations: int = 3,
    intervals: int = 200,
) -> FoundPlan:
    """Plan with MPPI until the model reaches the goal.

    Parameters
    ----------
    task : SearchTask
        Model, start, goal, actions and limits.
    horizon, samples, iterations : int
        As for :class:`Horizon`.
    intervals : int
        The longest plan.

    Returns
    -------
    FoundPlan
        If the goal is not reached, up to where it was nearest; a start in motion does not count.

    Raises
    ------
    GoalError
        If a number is below 1.
    """
    nodes, dynamics, goal, start = task.nodes, task.dynamics, task.goal, task.start
    if min(horizon, samples, iterations, intervals, nodes) < 1:
        raise GoalError("MPPI: horizon, samples, iterations, intervals, nodes must be at least 1")
    scene, begin = dynamics.scene, time.monotonic()
    ahead = Horizon(task, horizon, samples, iterations)
    states = np.repeat(start[None, None], dynamics.draws, axis=0)
    wrenches, last = list[Floats](), dynamics.before
    nearest, best, stopped = np.inf, 0, "exhausted"

    try:
        while True:
            if float(tail_mean(goal.shortfall(scene, states), task.tail)[0]) <= 1.0:
                stopped, best = "goal", len(wrenches)
                break
            far = float(tail_mean(goal.distance(scene, states), task.tail)[0])
            if far < nearest and (wrenches or not start[:, 3:].any()):
                nearest, best = far, len(wrenches)
            if len(wrenches) >= intervals:
                break
            if ahead.generated >= nodes or time.monotonic() - begin > task.seconds:
                stopped = "nodes" if ahead.generated >= nodes else "time"
                break
            task.progress(f"interval {len(wrenches)}, {far:.3g} m from the goal")
            ahead.improve(states[:, 0], last)
            wrench = ahead.mean[0]
            ahead.mean = np.concatenate([ahead.mean[1:], ahead.mean[-1:]])  # the others move up
            wrenches.append(wrench)
            states = dynamics.step(states, wrench[None], last[None])
            last = remembered(wrench, last)
    except KeyboardInterrupt:
        stopped = "interrupted"
    chosen = np.array(wrenches[:best]).reshape(-1, len(start), 3)
    seconds = time.monotonic() - begin
    return FoundPlan(chosen, stopped == "goal", stopped, ahead.generated, seconds)
