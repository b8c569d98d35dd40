"""Heuristic of A*: a lower bound on the time to the goal."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from pbrl_ppl.physics import overlap
from pbrl_ppl.planning.actions import ActionSet
from pbrl_ppl.planning.dynamics import TransitionModel
from pbrl_ppl.planning.goals import Goal, Target
from pbrl_ppl.scene import Body, Scene, Shape
from pbrl_ppl.state import Bools, Floats

#: Cells along the longer side of the grid on which distances around walls are found, and the margin
#: of the grid (m): a body can go around the end of a wall.
_CELLS, _ROOM = 160, 2.0
#: Moves on the grid: to neighbours, and as a knight does, which cuts the error of eight directions.
_MOVES = [(1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)]


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
        scene = dynamics.scene
        self.goal, self.scene = goal, scene
        anyone = max(actions.strongest(body.name)[0] for body in scene.dynamic)
        self._bodies = goal.places(scene)
        self._fields, self._push, self._turn = [], [], []
        for target, i in zip(goal.targets, self._bodies, strict=True):
            force, torque = actions.strongest(target.body)
            push, turn = dynamics.acceleration(target.body, force or anyone, torque)
            self._push.append(push)
            self._turn.append(turn)
            self._fields.append(_distances(scene, scene.body(target.body), target, start[i]))

    def __call__(self, states: Floats) -> Floats:
        """Return seconds, shape (draw, n), from states of shape (draw, n, body, 6)."""
        offset = self.goal.errors(self.scene, states)
        least = np.zeros(states.shape[:2])
        for j, (target, i) in enumerate(zip(self.goal.targets, self._bodies, strict=True)):
            body = states[:, :, i]
            push, turn = self._push[j][:, None], self._turn[j][:, None]
            far = np.hypot(offset[..., j, 0], offset[..., j, 1])
            towards = -(offset[..., j, :2] * body[..., 3:5]).sum(axis=-1) / np.maximum(far, 1e-9)
            time = _time(far - target.tolerance, towards, push)
            field = self._fields[j]
            if field is not None:
                around = field(body[..., :2]) - target.tolerance
                time = np.maximum(time, _time(around, np.hypot(body[..., 3], body[..., 4]), push))
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
    # without a push, at constant speed
    push = np.maximum(push, 1e-6)
    return np.asarray(np.where(way > 0, np.sqrt(speed**2 + 2 * push * way) - speed, 0.0) / push)


class _Field:
    """Distance to a target around obstacles, between the centres of a grid's cells."""

    def __init__(self, values: Floats, origin: Floats, cell: float) -> None:
        self.values, self.origin, self.cell = values, origin, cell

    def __call__(self, places: Floats) -> Floats:
        at = (places - self.origin) / self.cell
        return np.asarray(
            map_coordinates(self.values, np.moveaxis(at, -1, 0), order=1, mode="nearest")
        )


def _distances(scene: Scene, body: Body, target: Target, start: Floats) -> _Field | None:
    """Return distances of a body's origin from its target around obstacles; None without any."""
    static = tuple(obstacle for obstacle in scene.bodies if obstacle.static)
    if (not scene.walls and not static) or target.x is None or target.y is None:
        return None
    points = np.array([start[:2], [target.x, target.y]])
    if scene.extent is not None:
        corners = np.reshape(scene.extent, (2, 2)).T
        points = np.vstack([points, corners])
    low, high = points.min(axis=0) - _ROOM, points.max(axis=0) + _ROOM
    cell = float((high - low).max()) / _CELLS
    shape = tuple(int(n) + 1 for n in np.ceil((high - low) / cell))
    centres = low + cell * np.indices(shape).reshape(2, -1).T
    # a circle that fits into the body wherever it turns, about its origin
    probe = Body("probe", Shape.circle(max(_inner(body.shape), 0.5 * cell)))
    alone = scene.replace(bodies=(probe, *static), joints=())
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
    return _Field(values, low, cell)


def _graph(free: Bools) -> coo_array:
    """Return the moves between free cells; a knight's passes two others."""
    number = np.arange(free.size).reshape(free.shape)
    rows, columns, lengths = [], [], []
    for dx, dy in _MOVES:
        between = {
            (round(dx * t), round(dy * t)) for t in np.linspace(0, 1, 2 * max(dx, abs(dy)) + 1)
        }
        # cells from which the move stays on the grid
        x, y = slice(0, free.shape[0] - dx), slice(max(-dy, 0), free.shape[1] - max(dy, 0))
        passed = [free[_shift(x, i), _shift(y, j)] for i, j in between]
        possible = np.logical_and.reduce(passed)
        rows.append(number[x, y][possible])
        columns.append(number[_shift(x, dx), _shift(y, dy)][possible])
        lengths.append(np.full(int(possible.sum()), np.hypot(dx, dy)))
    data = np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))
    return coo_array(data, shape=(free.size, free.size)).tocsr()


def _shift(span: slice, by: int) -> slice:
    return slice(span.start + by, span.stop + by)


def _inner(shape: Shape) -> float:
    """Return the radius of the largest circle about the origin inside the shape, or 0."""
    if shape.kind == "circle":
        return float(shape.radius or 0.0)
    corners = np.array(shape.outline)
    after = np.roll(corners, -1, axis=0)
    edge, arm = after - corners, -corners
    share = np.clip((arm * edge).sum(1) / (edge**2).sum(1), 0, 1)
    if (edge[:, 0] * arm[:, 1] - edge[:, 1] * arm[:, 0] < 0).any():
        return 0.0
    return float(np.hypot(*(arm - share[:, None] * edge).T).min())
