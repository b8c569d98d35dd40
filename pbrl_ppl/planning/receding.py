"""Model predictive path integral control: a receding horizon for tasks that are all dynamics."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import GoalError
from pbrl_ppl.planning.actions import ActionSet
from pbrl_ppl.planning.contact import contact_cost
from pbrl_ppl.planning.goals import Goal
from pbrl_ppl.planning.risk import tail_mean
from pbrl_ppl.planning.search import NODES, Found
from pbrl_ppl.planning.transition_model import TransitionModel
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]

#: Share of the noise that goes on from one interval to the next: pushes last longer than one.
_PERSISTENCE = 0.7
#: Spread of the wrenches that are tried, as a share of the strongest.
_SPREAD = 0.5
#: The best of so many samples have about as much weight as all others.
_ELITE = 0.05
#: What a speed of 1 m/s costs at the horizon's end (m): who arrives fast does not stay.
_ARRIVAL = 0.2


class Horizon:
    """Receding horizon: wrenches for the next intervals, improved and moved on at every step.

    Parameters
    ----------
    dynamics : TransitionModel
        One draw or many.
    goal, actions
        As of :func:`pbrl_ppl.plan`; wrenches may be anything up to the strongest of the set, on
        all of its bodies at once.
    horizon : int
        Intervals looked ahead.
    samples : int
        Sequences tried at a time.
    iterations : int
        Times they are drawn anew about the best mean.
    tail : float
        Share of the worst draws that count.
    noise : bool
        Whether Eq. 13's noise is added.
    rng : Generator
        Of the samples.

    References
    ----------
    Williams, Wagener, Goldfain, Drews, Rehg, Boots, Theodorou, "Information theoretic MPC for
    model-based reinforcement learning", ICRA 2017.
    """

    def __init__(
        self,
        dynamics: TransitionModel,
        goal: Goal,
        actions: ActionSet,
        *,
        horizon: int,
        samples: int,
        iterations: int,
        tail: float,
        noise: bool,
        rng: np.random.Generator,
    ) -> None:
        self.dynamics, self.goal, self.rng = dynamics, goal, rng
        self.samples, self.iterations = samples, iterations
        self.tail, self.noise = tail, noise
        self.most = _strongest(dynamics.scene, actions)
        self.mean = np.zeros((horizon, *self.most.shape))
        self._own = goal.places(dynamics.scene)
        self.generated = 0

    def improve(self, start: Array, before: Array) -> None:
        """Draw sequences about the mean; weigh them by their cost.

        Parameters
        ----------
        start : ndarray
            States that they begin from, shape (draw, body, 6).
        before : ndarray
            Wrenches in the interval before, shape (body, 3).
        """
        size = (self.samples, *self.mean.shape)
        for iteration in range(self.iterations):
            spread = _SPREAD * self.most * 0.7**iteration
            noise = self.rng.standard_normal(size)
            for t in range(1, size[1]):
                noise[:, t] = (
                    _PERSISTENCE * noise[:, t - 1] + np.sqrt(1 - _PERSISTENCE**2) * noise[:, t]
                )
            tried = np.clip(self.mean + spread * noise, -self.most, self.most)
            tried[0] = self.mean
            cost = self._cost(start, tried, before)
            worst = np.max(cost[np.isfinite(cost)], initial=0.0)
            cost = np.where(np.isfinite(cost), cost, worst + 1e3)
            few = np.sort(cost)[: max(2, int(_ELITE * self.samples))]
            weight = np.exp(-(cost - few[0]) / max(few[-1] - few[0], 1e-9))
            self.mean = np.tensordot(weight / weight.sum(), tried, axes=1)

    def advance(self) -> Array:
        """The first wrench, shape (body, 3); the others move up."""
        first: Array = self.mean[0].copy()
        self.mean = np.concatenate([self.mean[1:], self.mean[-1:]])
        return first

    def _cost(self, start: Array, tried: Array, before: Array) -> Array:
        """L2 distance from the goal, its mean on the way and at the end, speed there, contacts."""
        scene, horizon = self.dynamics.scene, tried.shape[1]
        states = np.repeat(start[:, None], len(tried), axis=1)
        cost = np.zeros(len(tried))
        for t in range(horizon):
            last = tried[:, t - 1] if t else np.broadcast_to(before, tried[:, 0].shape)
            states = self.dynamics.step(states, tried[:, t], last)
            if self.noise:
                states = self.dynamics.noisy(states, self.rng)
            self.generated += len(tried) * self.dynamics.draws
            far = tail_mean(self.goal.distance(scene, states), self.tail)
            cost += far / horizon + scene.time_step * contact_cost(self.goal, scene, states)
        speed = np.sqrt((states[..., self._own, 3:5] ** 2).sum(axis=(-2, -1)))
        return np.asarray(cost + far + _ARRIVAL * tail_mean(speed, self.tail))


def mppi(
    dynamics: TransitionModel,
    start: Array,
    goal: Goal,
    actions: ActionSet,
    *,
    tail: float = 1.0,
    horizon: int = 15,
    samples: int = 256,
    iterations: int = 3,
    intervals: int = 200,
    nodes: int = NODES,
    seconds: float | None = None,
    noise: bool = False,
    rng: np.random.Generator | None = None,
    progress: Callable[[str], None] | None = None,
) -> Found:
    """Go towards the goal by a receding horizon, in the model, until it is reached.

    Parameters
    ----------
    dynamics, start, goal, actions, tail, noise, rng, progress
        As of :func:`pbrl_ppl.planning.astar.astar`.
    horizon, samples, iterations : int
        As of :class:`Horizon`.
    intervals : int
        The longest plan.
    nodes : int
        States to generate at most, each draw's own.
    seconds : float, optional
        Where to stop, too; then the plan depends on how busy the machine is.

    Returns
    -------
    Found
        If the goal is not reached, up to where it was nearest; a start in motion does not count.

    Raises
    ------
    GoalError
        If a number is below 1.
    """
    if min(horizon, samples, iterations, intervals, nodes) < 1:
        raise GoalError(
            "MPPI: horizon, samples, iterations, intervals and nodes must be at least 1"
        )
    scene, begin = dynamics.scene, time.monotonic()
    limit = np.inf if seconds is None else seconds
    ahead = Horizon(
        dynamics, goal, actions, horizon=horizon, samples=samples, iterations=iterations,
        tail=tail, noise=noise, rng=rng or np.random.default_rng(0),
    )  # fmt: skip
    states = np.repeat(start[None, None], dynamics.draws, axis=0)
    wrenches: list[Array] = []
    nearest, best, stopped = np.inf, 0, "exhausted"

    try:
        while True:
            if float(tail_mean(goal.shortfall(scene, states), tail)[0]) <= 1.0:
                stopped, best = "goal", len(wrenches)
                break
            far = float(tail_mean(goal.distance(scene, states), tail)[0])
            if far < nearest and (wrenches or not start[:, 3:].any()):
                nearest, best = far, len(wrenches)
            if len(wrenches) >= intervals:
                break
            if ahead.generated >= nodes or time.monotonic() - begin > limit:
                stopped = "nodes" if ahead.generated >= nodes else "time"
                break
            if progress is not None:
                progress(f"interval {len(wrenches)}, {far:.2f} m from the goal")
            last = wrenches[-1] if wrenches else dynamics.before
            ahead.improve(states[:, 0], last)
            wrenches.append(ahead.advance())
            states = dynamics.step(states, wrenches[-1][None], last[None])
    except KeyboardInterrupt:
        stopped = "interrupted"
    chosen = np.array(wrenches[:best]).reshape(-1, len(start), 3)
    took = time.monotonic() - begin
    return Found(chosen, stopped == "goal", stopped, ahead.generated, took)


def _strongest(scene: Scene, actions: ActionSet) -> Array:
    """The strongest wrench on each body, shape (body, 3), N, N, N m."""
    most = np.zeros((len(scene.moving), 3))
    for i, body in enumerate(scene.moving):
        force, torque = actions.strongest(body.name)
        most[i] = force, force, torque
    return most
