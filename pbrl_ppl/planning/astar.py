"""A* over continuous transitions, with a discretised closed set; many actions per engine call."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics import overlap
from pbrl_ppl.planning.actions import ActionSet
from pbrl_ppl.planning.bound import TimeToGo
from pbrl_ppl.planning.dynamics import Dynamics
from pbrl_ppl.planning.goals import Goal

Array = NDArray[np.float64]

#: Nodes expanded in one engine call, and cells of the closed set: m, rad, m/s, rad/s at one metre
#: from the goal, in proportion to the distance between these limits.
_BATCH = 32
_CELLS = np.array([0.4, 0.4, 0.5, 0.8, 0.8, 1.0])
_NEAR, _FAR = 0.25, 2.0
#: Shapes this near touch (m): the engine lets bodies that rest on each other sink in a little.
_TOUCH = 0.005
#: Seconds between reports of progress.
_REPORT = 0.5


@dataclass(frozen=True, eq=False)
class Found:
    """What a search came to.

    Attributes
    ----------
    wrenches : ndarray
        World frame, one an interval, shape (time, body, 3), N and N m.
    reached : bool
        Whether the goal is reached, by the model.
    stopped : str
        ``goal``, ``nodes``, ``time``, ``exhausted`` or ``interrupted``.
    nodes : int
        States that were generated.
    seconds : float
        How long it took.
    """

    wrenches: Array
    reached: bool
    stopped: str
    nodes: int
    seconds: float


def tail_mean(values: Array, tail: float) -> Array:
    """Mean of the worst share ``tail`` of values over the first axis; 1 is the expectation."""
    n = len(values)
    worst = max(1, int(np.ceil(tail * n - 1e-9)))
    if worst == n:
        return np.asarray(values.mean(axis=0))
    return np.asarray(np.partition(values, n - worst, axis=0)[n - worst :].mean(axis=0))


class _Tree:
    """States, parents, actions and costs of all nodes, in arrays that grow."""

    def __init__(self, root: Array) -> None:
        self.states = root[None]
        self.parent = np.full(1, -1)
        self.action = np.full(1, -1)
        self.intervals = np.zeros(1, dtype=int)
        self.cost = np.zeros(1)
        self.n = 1

    def add(
        self, states: Array, parent: Array, action: Array, intervals: Array, cost: Array
    ) -> range:
        first, self.n = self.n, self.n + len(states)
        for name, new in (
            ("states", states), ("parent", parent), ("action", action),
            ("intervals", intervals), ("cost", cost),
        ):  # fmt: skip
            old = getattr(self, name)
            if len(old) < self.n:
                room = np.empty((2 * self.n, *old.shape[1:]), old.dtype)
                room[:first] = old[:first]
                setattr(self, name, old := room)
            old[first : self.n] = new
        return range(first, self.n)

    def path(self, node: int) -> list[tuple[int, int]]:
        """Actions and intervals from the root to a node."""
        steps = []
        while self.parent[node] >= 0:
            steps.append((int(self.action[node]), int(self.intervals[node])))
            node = int(self.parent[node])
        return steps[::-1]


def astar(
    dynamics: Dynamics,
    start: Array,
    goal: Goal,
    actions: ActionSet,
    *,
    tail: float = 1.0,
    weight: float = 3.0,
    nodes: int = 1_000_000,
    seconds: float = 60.0,
    improve: bool = False,
    rng: np.random.Generator | None = None,
    progress: Callable[[str], None] | None = None,
) -> Found:
    """Search for the quickest actions that bring bodies to the goal.

    The cost of a plan is its time and the penalties for contact. A node holds the states under all
    draws, to machine precision; of nodes in one cell of the closed set (the mean state, finer near
    the goal) the cheapest is kept.

    Parameters
    ----------
    dynamics : Dynamics
        One draw or many.
    start : ndarray
        Shape (body, 6).
    goal, actions
        As of :func:`pbrl_ppl.plan`.
    tail : float
        The goal is reached where the mean of the worst share of draws is within the tolerances: 1
        for the expectation, less for conditional value at risk.
    weight : float
        Of the heuristic; 1 is A*, more is quicker and costs at most so many times the least, as
        far as the heuristic is admissible (see :class:`TimeToGo`).
    nodes, seconds : int, float
        Where to stop.
    improve : bool
        Whether to go on for a cheaper plan until a limit, or until there is none.
    rng : Generator, optional
        Adds Eq. 13's noise to every transition.
    progress : callable, optional
        Told how far the search is.

    Returns
    -------
    Found
        If the goal is not reached, the plan that ends nearest to it in L2 distance.
    """
    scene = dynamics.scene
    begin = told = time.monotonic()
    tree = _Tree(np.repeat(start[None], dynamics.draws, axis=0))
    to_go = TimeToGo(dynamics, goal, actions, start)
    root = tree.states.transpose(1, 0, 2, 3)[:, :1] if False else tree.states[0][:, None]
    best_distance = float(tail_mean(goal.distance(scene, root), tail)[0])
    best, nearest, best_cost = None, ((0, 0)), np.inf
    counts = actions.intervals(scene)
    n_actions = len(actions.actions)
    closed: dict[bytes, float] = {}
    queue: list[tuple[float, int]] = [(0.0, 0)]
    near_node: tuple[int, int, int] = (0, -1, 0)  # node, action, intervals
    stopped = "exhausted"
    if float(tail_mean(goal.shortfall(scene, root), tail)[0]) <= 1.0:
        return Found(np.zeros((0, len(start), 3)), True, "goal", 1, time.monotonic() - begin)
    generated = 1
    try:
        while queue:
            if best is not None and not improve:
                stopped = "goal"
                break
            if generated >= nodes:
                stopped = "nodes"
                break
            now = time.monotonic()
            if now - begin > seconds:
                stopped = "time"
                break
            if progress is not None and now - told > _REPORT:
                progress(f"{generated} states, nearest {best_distance:.2f} m from the goal")
                told = now
            batch = []
            while queue and len(batch) < _BATCH:
                priority, node = heapq.heappop(queue)
                batch.append(node)
            parents = np.repeat(batch, n_actions)
            which = np.tile(np.arange(n_actions), len(batch))
            states = np.moveaxis(tree.states[parents], 0, 1)
            cost = tree.cost[parents]
            for interval in range(1, counts[-1] + 1):
                heading = _mean_angle(states[..., 2])
                states = dynamics.step(states, actions.wrenches(scene, which, heading))
                if rng is not None:
                    states = dynamics.noisy(states, rng)
                generated += len(parents)
                cost = cost + scene.time_step
                if goal.contact_penalty:
                    cost = cost + scene.time_step * _contact(goal, dynamics, states)
                there = tail_mean(goal.shortfall(scene, states), tail) <= 1.0
                there &= cost < best_cost
                if there.any():
                    row = int(np.flatnonzero(there)[np.argmin(cost[there])])
                    best_cost = float(cost[row])
                    best = (int(parents[row]), int(which[row]), interval)
                far = tail_mean(goal.distance(scene, states), tail)
                far = np.where(np.isfinite(far) & np.isfinite(cost), far, np.inf)
                row = int(np.argmin(far))
                if far[row] < best_distance:
                    best_distance = float(far[row])
                    near_node = (int(parents[row]), int(which[row]), interval)
                if interval not in counts:
                    continue
                ahead = tail_mean(to_go(states), tail)
                total = cost + ahead
                keep = np.isfinite(total) & (total < best_cost)
                keys = _cells(states, far)
                chosen = []
                for row in np.flatnonzero(keep):
                    key = keys[row].tobytes()
                    if cost[row] < closed.get(key, np.inf) - 1e-9:
                        closed[key] = cost[row]
                        chosen.append(row)
                if not chosen:
                    continue
                rows = np.array(chosen)
                added = tree.add(
                    np.moveaxis(states[:, rows], 1, 0), parents[rows], which[rows],
                    np.full(len(rows), interval), cost[rows],
                )  # fmt: skip
                for node, priority in zip(added, cost[rows] + weight * ahead[rows], strict=True):
                    heapq.heappush(queue, (float(priority), node))
    except KeyboardInterrupt:
        stopped = "interrupted"
    if best is not None and stopped == "exhausted":
        stopped = "goal"
    last = best or near_node
    steps = [*tree.path(last[0]), *([last[1:]] if last[2] else [])]
    wrenches = _played(dynamics, start, actions, steps)
    return Found(wrenches, best is not None, stopped, generated, time.monotonic() - begin)


def _contact(goal: Goal, dynamics: Dynamics, states: Array) -> Array:
    """Penalty of a second in contact, as a mean over the draws, shape (n,)."""
    poses = states[..., :3].reshape(-1, *states.shape[2:3], 3)
    touch = overlap(dynamics.scene, np.nan_to_num(poses)) > -_TOUCH
    share = touch.reshape(states.shape[:2]).mean(axis=0)
    return np.where(share > 0, goal.contact_penalty * np.maximum(share, 1e-300), 0.0)


def _mean_angle(angle: Array) -> Array:
    """Mean direction over the first axis."""
    return np.asarray(np.arctan2(np.sin(angle).mean(axis=0), np.cos(angle).mean(axis=0)))


def _cells(states: Array, far: Array) -> NDArray[np.int32]:
    """Cell of the closed set of each node, shape (n, numbers)."""
    mean = np.nan_to_num(states.mean(axis=0))
    mean[..., 2] = _mean_angle(np.nan_to_num(states[..., 2]))
    # powers of two, so that cells of one size meet
    level = np.floor(np.log2(np.clip(np.nan_to_num(far, posinf=_FAR), _NEAR, _FAR)))
    size = _CELLS * 2.0 ** level[:, None, None]
    cell = np.floor(mean / size).reshape(len(mean), -1)
    return np.concatenate([level[:, None], cell], axis=1).astype(np.int32)


def _played(
    dynamics: Dynamics, start: Array, actions: ActionSet, steps: list[tuple[int, int]]
) -> Array:
    """World-frame wrenches of actions from the start, one an interval."""
    states = np.repeat(start[None, None], dynamics.draws, axis=0)
    wrenches = []
    for action, intervals in steps:
        for _ in range(intervals):
            wrench = actions.wrenches(
                dynamics.scene, np.array([action]), _mean_angle(states[..., 2])
            )
            states = dynamics.step(states, wrench)
            wrenches.append(wrench[0])
    return np.array(wrenches).reshape(-1, *start.shape[:1], 3)
