"""A* over continuous transitions: the search and its heuristic, a bound on the time to the goal."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from pbrl_ppl.errors import GoalError
from pbrl_ppl.physics import depth_of, overlap
from pbrl_ppl.planning.dynamics import TransitionModel, remembered
from pbrl_ppl.planning.goals import ActionSet, Goal, Target, play
from pbrl_ppl.planning.search import FoundPlan, SearchTask, contact_cost, tail_mean
from pbrl_ppl.scene import Body, Scene, Shape
from pbrl_ppl.state import Bools, Floats


def astar(task: SearchTask, *, weight: float = 3.0, improve: bool = False) -> FoundPlan:
    """Search for the quickest actions that bring bodies to the goal.

    The cost of a plan is its time and the penalties for contact. A node holds the states under all
    draws, to machine precision; of nodes in one cell of the closed set (the mean state, finer near
    the goal, in proportion to its tolerance) the cheapest is kept. When the queue is empty, the
    cells are halved and the search starts again. Under many draws, a plan for one of them is found
    first, and the search starts with the nodes along it: that costs little, and leads around
    obstacles.

    Parameters
    ----------
    task : SearchTask
        Model, start, goal, actions and limits.
    weight : float
        Of the heuristic: 1 is A*, which goes on until no node of the queue can lead to a cheaper
        plan. A larger weight is quicker, ends at the first plan and, as far as the heuristic is
        admissible and cells hold one state, costs at most this many times the least. See
        :class:`pbrl_ppl.planning.astar.TimeToGo` for where it is.
    improve : bool
        Whether to go on for a cheaper plan until a limit, or until there is none.

    Returns
    -------
    FoundPlan
        If the goal is not reached, the plan that ends nearest to it in L2 distance. An empty plan
        counts only where bodies are at rest: others do not stay where they are.

    Raises
    ------
    GoalError
        If the weight is below 1, or ``nodes`` below 1.
    """
    nodes = task.nodes
    if weight < 1 or nodes < 1:
        raise GoalError(f"A*: weight is {weight} and nodes {nodes}, expected at least 1 of each")
    search = _Search(task, weight)
    begin = reported = time.monotonic()
    stopped, share = "exhausted", 0.5  # of the limits, for the search that guides the other
    try:
        if task.dynamics.draws > 1:
            guide = _Search(replace(task, dynamics=task.dynamics.single()), weight)
            while not guide.best and guide.generated < share * nodes and guide.open():
                if time.monotonic() - begin > share * task.seconds:
                    break
                guide.expand()
            search.follow(guide.path(guide.best or guide.nearest))
            search.generated += guide.generated
        while search.open():
            now = time.monotonic()
            # with the weight 1, until no node in the queue can lead to a cheaper plan
            enough = weight > 1 or search.queue[0][0] >= search.least_cost
            if search.best and enough and not improve:
                break
            if search.generated >= nodes or now - begin > task.seconds:
                stopped = "nodes" if search.generated >= nodes else "time"
                break
            search.expand()
            if now - reported > 0.5:
                reported = now
                task.progress(
                    f"{search.generated} states, nearest to the goal {search.least_distance:.3g} m"
                )
    except KeyboardInterrupt:
        stopped = "interrupted"
    reached = search.best is not None
    if reached and stopped == "exhausted":
        stopped = "goal"
    path = search.path(search.best or search.nearest)
    which = np.array([[action for action, n in path for _ in range(n)]], dtype=np.intp)
    wrenches = play(task.dynamics, task.start, task.actions, which, mean_angle)[0]
    return FoundPlan(wrenches, reached, stopped, search.generated, time.monotonic() - begin)


class Edge(NamedTuple):
    """Edge of the tree: the node it starts from, the action, and for how many intervals."""

    node: int
    action: int
    intervals: int


class Node(NamedTuple):
    """Node of the tree: states (draw, body, 6), wrenches before, cost, and the edge to it."""

    states: Floats
    last: Floats
    cost: float
    edge: Edge


class _Search:
    """State of the search: the tree, the open queue and the closed set."""

    def __init__(self, task: SearchTask, weight: float) -> None:
        self.dynamics, self.goal, self.actions = task.dynamics, task.goal, task.actions
        self.tail, self.weight = task.tail, weight
        self.scene = task.dynamics.scene
        self.counts = task.actions.intervals(self.scene)
        self.to_go = TimeToGo(task.dynamics, task.goal, task.actions, task.start)
        root = np.repeat(task.start[None], task.dynamics.draws, axis=0)
        self.root = Node(root, task.dynamics.before, 0.0, Edge(0, -1, 0))
        self.generated = 1
        reach = [self.scene.body(target.body).shape.bounding_radius for target in self.goal.targets]
        # cells of the closed set ten tolerances from the goal, in tolerances and, for speeds,
        # tolerances a sampling interval; of wide tolerances a part of the radius, or 0.1 rad
        self.near = min(0.2 * min(reach), *self.goal.tolerances(self.scene))
        turn = min(0.1, *(target.angle_tolerance for target in self.goal.targets))
        sizes = np.array([self.near, self.near, turn] * 2)
        self.cells = sizes * (4.0, 4.0, 5.0, 2.0, 2.0, 2.5)
        self.cells[3:] /= self.scene.time_step
        self.refined = 0
        self.begin()

    def open(self, *, most_refined: int = 8) -> bool:
        """Return whether the queue holds a node; start again with finer cells where it does not.

        ``most_refined``: times that the cells are halved where the search runs out of nodes.
        """
        if not self.queue and self.best is None and self.refined < most_refined:
            self.refined += 1
            self.begin()
        return bool(self.queue)

    def begin(self) -> None:
        """Reset tree, queue and closed set to the root."""
        self.tree = [self.root]
        self.queue: list[tuple[float, int]] = [(0.0, 0)]
        self.closed: dict[bytes, float] = {}
        self.best: Edge | None = None
        self.least_cost = np.inf
        self.nearest, self.least_distance = self.root.edge, np.inf
        self._note(self.root.states[:, None], np.zeros(1), [self.root.edge])
        if self.root.states[..., 3:].any():
            self.least_distance = np.inf

    def expand(self, *, at_once: int = 32) -> None:
        """Expand the most promising nodes by all actions, in one engine call each.

        ``at_once``: nodes expanded in one engine call; fewer under many draws, whose calls are
        large anyway.
        """
        size = min(max(1, at_once // self.dynamics.draws), len(self.queue))
        batch = [heapq.heappop(self.queue)[1] for _ in range(size)]
        self._try(list(product(batch, range(len(self.actions.actions)))))

    def follow(self, steps: list[tuple[int, int]]) -> None:
        """Add the nodes along a path from the root, as far as they are in new cells."""
        for action, intervals in steps:
            last = len(self.tree) - 1
            self._try([(last, action)], intervals)
            if len(self.tree) == last + 1:
                break

    def _try(self, tried: list[tuple[int, int]], only: int | None = None) -> None:
        """Play an action from each of some nodes, for every duration or one alone (intervals)."""
        nodes, which = [self.tree[node] for node, _ in tried], np.array([a for _, a in tried])
        states = np.moveaxis(np.stack([node.states for node in nodes]), 0, 1)
        cost = np.array([node.cost for node in nodes])
        last = np.stack([node.last for node in nodes])
        for interval in range(1, (only or self.counts[-1]) + 1):
            wrenches = self.actions.wrenches(self.scene, which, mean_angle(states[..., 2]))
            states = self.dynamics.step(states, wrenches, last)
            last = remembered(wrenches, last)
            self.generated += len(tried) * self.dynamics.draws
            cost = cost + self.scene.time_step * (1.0 + contact_cost(self.goal, self.scene, states))
            edges = [Edge(*each, interval) for each in tried]
            far = self._note(states, cost, edges)
            if interval == only or (only is None and interval in self.counts):
                self._add(states, last, cost, far, edges)

    def _note(self, states: Floats, cost: Floats, edges: list[Edge]) -> Floats:
        """Keep the cheapest edge to the goal and the nearest one; return L2 distances."""
        possible = np.isfinite(states).all(axis=(0, 2, 3)) & np.isfinite(cost)
        there = tail_mean(self.goal.shortfall(self.scene, states), self.tail) <= 1.0
        there &= possible & (cost < self.least_cost)
        far = tail_mean(self.goal.distance(self.scene, states), self.tail)
        far = np.where(possible, far, np.inf)
        if there.any():
            row = int(np.argmin(np.where(there, cost, np.inf)))
            self.best, self.least_cost = edges[row], float(cost[row])
        row = int(np.argmin(far))
        if far[row] < self.least_distance:
            self.nearest, self.least_distance = edges[row], float(far[row])
        return far

    def _add(
        self, states: Floats, last: Floats, cost: Floats, far: Floats, edges: list[Edge]
    ) -> None:
        """Add nodes that are in a new cell, or are cheaper than the one in it."""
        ahead = tail_mean(self.to_go(states), self.tail)
        keys = self._cells(states, far)
        for row in np.flatnonzero(np.isfinite(far) & (cost + ahead < self.least_cost)):
            key = keys[row].tobytes()
            if cost[row] < self.closed.get(key, np.inf):
                self.closed[key] = cost[row]
                priority = float(cost[row] + self.weight * ahead[row])
                heapq.heappush(self.queue, (priority, len(self.tree)))
                # copies: a view would keep the states of all rows
                self.tree.append(
                    Node(states[:, row].copy(), last[row].copy(), float(cost[row]), edges[row])
                )

    def _cells(self, states: Floats, far: Floats) -> NDArray[np.int32]:
        """Return the cell of the closed set of each node, shape (n, number)."""
        mean = np.nan_to_num(states.mean(axis=0))
        mean[..., 2] = mean_angle(np.nan_to_num(states[..., 2]))
        # cells have their usual size ten tolerances from the goal; a quarter nearer, or twice it
        level = np.floor(np.log2(np.clip(far / (10.0 * self.near), 0.25, 2.0)))
        size = self.cells * 2.0 ** (level[:, None, None] - self.refined)
        cell = np.floor(mean / size).reshape(len(mean), -1)
        return np.concatenate([level[:, None], cell], axis=1).astype(np.int32)

    def path(self, last: Edge) -> list[tuple[int, int]]:
        """Return actions and intervals from the root to the end of an edge."""
        steps, edge = [], last
        while edge.intervals:
            steps.append((edge.action, edge.intervals))
            edge = self.tree[edge.node].edge
        return steps[::-1]


def mean_angle(angle: Floats) -> Floats:
    """Return the mean direction over the first axis (rad)."""
    return np.asarray(np.arctan2(np.sin(angle).mean(axis=0), np.cos(angle).mean(axis=0)))


class TimeToGo:
    """Lower bound on the time to the goal, for pushes up to the strongest of the action set.

    A pushed body is bounded by its speed and the strongest push without friction. Distances go
    around walls and static bodies on a grid. The bound is admissible for pushed bodies that move
    towards the goal, as far as the grid is fine enough. It is not for a body that moves away, which
    friction or a wall may turn back sooner; for a body that is hit by others; or where an effect
    drives bodies.

    Parameters
    ----------
    dynamics : TransitionModel
        Bounds what a push can do.
    goal : Goal
        Targets.
    actions : ActionSet
        Says the strongest pushes.
    start : ndarray
        Shape (body, 6); the grid covers it.
    """

    def __init__(
        self, dynamics: TransitionModel, goal: Goal, actions: ActionSet, start: Floats
    ) -> None:
        self.goal, self.scene = goal, dynamics.scene
        scene = self.scene
        anyone = max(actions.strongest(body.name)[0] for body in scene.dynamic)
        self._bounds = []
        places, tolerances = goal.places(scene), goal.tolerances(scene)
        for target, i, tolerance in zip(goal.targets, places, tolerances, strict=True):
            force, torque = actions.strongest(target.body)
            push, turn = dynamics.acceleration(target.body, force or anyone, torque)
            # least acceleration, in radii (or rad) an interval squared: without a push the time is
            # long but finite, because others may hit the body
            body, slow = scene.body(target.body), 1e-6 / scene.time_step**2
            push = np.maximum(push, slow * body.shape.bounding_radius)[:, None]
            turn = np.maximum(turn, slow)[:, None]
            around = _distances(scene, body, target, start[i])
            self._bounds.append((target, i, tolerance, push, turn, around))

    def __call__(self, states: Floats) -> Floats:
        """Return seconds, shape (draw, n), from states of shape (draw, n, body, 6)."""
        offset = self.goal.errors(self.scene, states)
        least = np.zeros(states.shape[:2])
        for j, (target, i, tolerance, push, turn, around) in enumerate(self._bounds):
            body = states[:, :, i]
            far = np.hypot(offset[..., j, 0], offset[..., j, 1])
            towards = -(offset[..., j, :2] * body[..., 3:5]).sum(axis=-1)
            towards = towards / np.maximum(far, np.finfo(float).tiny)
            time = _time(far - tolerance, towards, push)
            if around is not None:
                speed = np.hypot(body[..., 3], body[..., 4])
                time = np.maximum(time, _time(around(body[..., :2]) - tolerance, speed, push))
            angle = offset[..., j, 2]
            towards = -np.sign(angle) * body[..., 5]
            # either way round
            turned = np.minimum(
                _time(abs(angle) - target.angle_tolerance, towards, turn),
                _time(2 * np.pi - abs(angle) - target.angle_tolerance, -towards, turn),
            )
            least = np.maximum(least, np.maximum(time, turned))
        return least


def _time(way: Floats, speed: Floats, push: Floats) -> Floats:
    """Return the least time for a distance at a speed and a largest acceleration."""
    way = np.maximum(way, 0.0)
    return np.asarray(np.where(way > 0, np.sqrt(speed**2 + 2 * push * way) - speed, 0.0) / push)


def _distances(
    scene: Scene, body: Body, target: Target, start: Floats
) -> Callable[[Floats], Floats] | None:
    """Return distances of a body's origin from its target around obstacles; None without any."""
    static = tuple(obstacle for obstacle in scene.bodies if obstacle.static)
    if (not scene.walls and not static) or target.x is None or target.y is None:
        return None
    points = np.array([start[:2], [target.x, target.y]])
    if scene.extent is not None:
        points = np.vstack([points, np.reshape(scene.extent, (2, 2)).T])
    room = 4.0 * body.shape.bounding_radius  # a body can go around the end of a wall
    low, high = points.min(axis=0) - room, points.max(axis=0) + room
    cell = float((high - low).max()) / 160  # along the longer side
    shape = tuple(int(n) + 1 for n in np.ceil((high - low) / cell))
    centres = low + cell * np.indices(shape).reshape(2, -1).T
    # a circle that fits into the body wherever it turns, about its origin
    probe = Body(body.name, Shape.circle(max(_inner(body.shape), 0.5 * cell)))
    alone = scene.replace(bodies=(probe, *static), joints=(), actuators=())
    poses = np.concatenate([centres, np.zeros((len(centres), 1))], axis=1)[:, None]
    free = (overlap(alone, poses) <= 0).reshape(shape)
    last = tuple(((points[1] - low) / cell).round().astype(int))
    free[last] = True
    steps = dijkstra(_graph(free), directed=False, indices=np.ravel_multi_index(last, shape))
    values = cell * steps.reshape(shape)
    # eight directions and the knight's moves overestimate a straight line by 2.8 % at most
    values = values / 1.028
    # inside obstacles, where the body's rim may be, the distance is the nearest free cell's
    reached = np.isfinite(values)
    if not reached.all():
        nearest = distance_transform_edt(~reached, return_distances=False, return_indices=True)
        values = values[tuple(nearest)]

    def distance(places: Floats) -> Floats:
        """Return the distances between the centres of the grid's cells, shape (...)."""
        at = np.moveaxis((places - low) / cell, -1, 0)
        return np.asarray(map_coordinates(values, at, order=1, mode="nearest"))

    return distance


def _graph(free: Bools) -> coo_array:
    """Return the moves between free cells; a knight's passes two others."""
    # in a margin of two cells, which are not free, every move stays on the grid
    open_, number = (np.pad(a, 2) for a in (free, np.arange(free.size).reshape(free.shape)))
    cells, width = np.flatnonzero(open_), open_.shape[1]
    # to neighbours, and as a knight does, which cuts the error of eight directions
    moves = [(1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)]
    rows, columns, lengths = [], [], []
    for dx, dy in moves:
        passed = np.ones(len(cells), dtype=bool)
        for t in np.linspace(0, 1, 2 * max(dx, abs(dy)) + 1):
            passed &= open_.flat[cells + round(dx * t) * width + round(dy * t)]
        rows.append(number.flat[cells[passed]])
        columns.append(number.flat[cells[passed] + dx * width + dy])
        lengths.append(np.full(len(rows[-1]), np.hypot(dx, dy)))
    data = np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))
    return coo_array(data, shape=(free.size, free.size)).tocsr()


def _inner(shape: Shape) -> float:
    """Return the radius of the largest circle about the origin inside the shape, or 0."""
    if shape.kind == "circle":
        return float(shape.radius or 0.0)
    here = np.zeros((1, 3))
    inside = depth_of((here[:, :2], 0.0), here, (np.array(shape.outline), 0.0), here)
    return max(float(inside[0]), 0.0)
