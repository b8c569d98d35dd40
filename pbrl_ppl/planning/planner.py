"""Plans from a posterior, a start and a goal, and their files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike

from pbrl_ppl.effects import Effect, catalogue
from pbrl_ppl.errors import GoalError
from pbrl_ppl.history import table_of_arrays, with_paths
from pbrl_ppl.physics import check_placement, overlap
from pbrl_ppl.planning.astar import astar
from pbrl_ppl.planning.dynamics import Dynamics, TransitionModel, predicted_path
from pbrl_ppl.planning.goals import ActionSet, Goal
from pbrl_ppl.planning.search import FoundPlan, SearchTask, mppi, tail_mean
from pbrl_ppl.scene import Scene, checks, nearest
from pbrl_ppl.state import STATE, WRENCH, Floats
from pbrl_ppl.system.files import write_atomically
from pbrl_ppl.system.threads import Say, silent

if TYPE_CHECKING:
    from pbrl_ppl.posterior import Idata

METHODS: dict[str, Callable[..., FoundPlan]] = {"astar": astar, "mppi": mppi}


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Plan(FoundPlan):
    """Wrenches that lead to a goal, and where the model says they lead.

    Attributes
    ----------
    scene : Scene
        As the posterior has it.
    goal : Goal
        What it is for.
    start : ndarray
        State it starts from, shape (body, 6), SI units.
    wrenches : ndarray
        World frame, one a sampling interval, shape (time, body, 3), N and N m.
    predicted : xarray.Dataset
        Variable ``predicted`` of dims (draw, time, body, state): what each draw predicts.
    reached : bool
        Whether the goal is reached by the model.
    stopped : str
        Why the search ended: ``goal``, ``nodes``, ``time``, ``exhausted`` or ``interrupted``.
    distance : float
        L2 distance from the goal at the end (m), as the mean of the worst ``tail`` of draws.
    nodes : int
        States that were generated, counting each draw's.
    seconds : float
        How long the search took.
    """

    scene: Scene
    goal: Goal
    start: Floats
    predicted: xr.Dataset
    distance: float

    @property
    def duration(self) -> float:
        """Duration of the plan (s)."""
        return len(self.wrenches) * self.scene.time_step

    def to_dataframe(self) -> pd.DataFrame:
        """Return the plan as rows of a history without measurements after the start.

        Returns
        -------
        DataFrame
            Columns as of :meth:`History.to_dataframe`; state cells after the start are missing.
        """
        return table_of_plan(self.scene, self.start, self.wrenches)

    def save(self, path: str | Path) -> None:
        """Write the plan as a CSV file, whole or not at all.

        Raises
        ------
        OutputError
            If it cannot be written there.
        """
        write_atomically(Path(path), lambda to: self.to_dataframe().to_csv(to, index=False))

    def __repr__(self) -> str:
        reached = "reached" if self.reached else "not reached"
        return f"Plan({len(self.wrenches)} intervals, {self.duration:.3g} s, goal {reached})"

    def __str__(self) -> str:
        return self.in_words()

    def in_words(self) -> str:
        """Return a sentence: whether the plan reaches the goal, how, and how far off it ends."""
        why = {
            "nodes": "the limit of nodes was reached",
            "time": "the limit of time was reached",
            "exhausted": "there was nothing left to try: the actions do not lead there",
            "interrupted": "it was interrupted",
        }
        size = f"{len(self.wrenches)} intervals, {self.duration:.3g} s"
        if self.reached:
            return f"the goal is reached: {size}, {self.distance:.3g} m from it at the end"
        return (
            f"the goal is not reached: {why.get(self.stopped, self.stopped)}; the best plan found"
            f" ({size}) ends {self.distance:.3g} m from it"
        )


def table_of_plan(scene: Scene, start: Floats, wrenches: Floats) -> pd.DataFrame:
    """Return wrenches (time, body, 3) as rows of a history that has the start (body, 6) alone."""
    n, bodies = len(wrenches), [body.name for body in scene.moving]
    states = np.full((1, n + 1, *start.shape), np.nan)
    states[0, 0] = start
    states, played = with_paths(scene, states, wrenches[None])
    played = np.pad(played, ((0, 0), (0, 1), (0, 0), (0, 0)), constant_values=np.nan)
    clock = scene.time_step * np.arange(n + 1.0)[None]
    return table_of_arrays(np.zeros(1, int), clock, bodies, states, played)


def plan(
    idata: Idata | TransitionModel,
    start: Mapping[str, Sequence[float]] | ArrayLike,
    goal: Goal | Mapping[str, Sequence[float | None]],
    actions: ActionSet | None = None,
    *,
    method: str = "astar",
    draws: int | None = None,
    tail: float = 1.0,
    seed: int = 0,
    nodes: int = SearchTask.nodes,
    seconds: float | None = None,
    before: ArrayLike | None = None,
    effects: Iterable[Effect] = catalogue,
    progress: Say | None = None,
    **options: object,
) -> Plan:
    """Plan from a start to a goal with what a posterior knows, and nothing else.

    Parameters
    ----------
    idata : InferenceData, DataTree or TransitionModel
        A posterior, as :func:`pbrl_ppl.load_posterior` gives it; or a model of transitions:
        parameters that are known, or what LWR has learned.
    start : mapping or array_like
        State of each body: ``{"cart": (x, y, theta)}`` at rest, or with ``vx, vy, omega``; a body
        that is left out is at rest at its pose in the scene. Or an array, shape (body, 6). SI.
    goal : Goal or mapping
        Or poses: ``{"cart": (x, y, theta)}``, None where free.
    actions : ActionSet, optional
        By default, pushes as in the data; see :meth:`ActionSet.recorded`.
    method : str
        ``astar``: a whole plan, over the action set; ``mppi``: a receding horizon for dynamic
        tasks, with any wrench up to the strongest of the set.
    draws : int, optional
        Posterior draws to plan with; without it, the posterior's mode (MAP).
    tail : float
        Share of the worst draws that count: 1 for the expectation, less for conditional value at
        risk.
    seed : int
        Of the choice of draws and of all else that is random.
    nodes : int
        States that the search generates at most, counting each draw's. The same start and seed
        give the same plan, however busy the machine is.
    seconds : float, optional
        Another limit of the search; with it, the plan depends on how busy the machine is.
    before : array_like, optional
        Wrenches in the interval before the start, shape (body, 3), N and N m, for an actuator that
        is late; none by default.
    effects : iterable of Effect
        Where the names of the posterior's effects are looked up.
    progress : callable, optional
        Called with a text on the progress of the search.
    **options
        Of :func:`pbrl_ppl.planning.astar.astar`, such as ``weight=1`` for A* without a weight, or
        of :func:`pbrl_ppl.planning.search.mppi`.

    Returns
    -------
    Plan
        With ``reached`` false if a limit was met before the goal: then the best found.

    Raises
    ------
    GoalError
        If the start, the goal or the actions cannot be.
    PosteriorError
        If it is no posterior, or holds fewer draws.

    Examples
    --------
    ::

        idata = pp.load_posterior("cart.nc")
        plan = pp.plan(idata, {"cart": (0, 0, 0)}, {"cart": (3, 1, None)}, draws=16)
        plan.save("plan.csv")
    """
    if method not in METHODS:
        raise GoalError(f'plan: method is "{method}"{nearest(method, METHODS)}')
    if not 0 < tail <= 1:
        raise GoalError(f"plan: tail is {tail}, expected a share above 0 and at most 1")
    if seconds is not None and not seconds > 0:
        raise GoalError(f"plan: seconds is {seconds}, expected more than 0")
    dynamics: TransitionModel
    if isinstance(idata, TransitionModel):
        dynamics = idata
        if actions is None:
            raise GoalError("plan: a model alone does not say how to push; give actions")
    else:
        dynamics = Dynamics.of(idata, draws, seed=seed, effects=effects)
        actions = ActionSet.recorded(idata) if actions is None else actions
    scene = dynamics.scene
    goal = Goal.of(goal)
    _check_goal(scene, goal)
    actions.check(scene)
    first = start_state(scene, start)
    if before is not None:
        dynamics = dynamics.after(np.asarray(before, dtype=float))
    limit, said = np.inf if seconds is None else seconds, progress or silent
    task = SearchTask(dynamics, first, goal, actions, tail, nodes, limit, seed, said)
    result = METHODS[method](task, **options)
    states = predicted_path(dynamics, first, result.wrenches)
    distance = float(tail_mean(goal.distance(scene, states[:, -1]), tail))
    values = labelled(scene, states, ("draw", "time", "body", "state"))
    predicted = values.to_dataset(name="predicted")
    return Plan(
        **vars(result), scene=scene, goal=goal, start=first, predicted=predicted, distance=distance
    )


def labelled(scene: Scene, values: Floats, dims: Sequence[str]) -> xr.DataArray:
    """Return values with coordinates for their dimensions: draw, time, body, state or wrench."""
    times = scene.time_step * np.arange(values.shape[dims.index("time")])
    coords = {
        "draw": np.arange(len(values)),
        "time": ("time", times, {"units": "s"}),
        "body": [body.name for body in scene.moving],
        "state": list(STATE),
        "wrench": list(WRENCH),
    }
    return xr.DataArray(values, {dim: coords[dim] for dim in dims}, dims)


def start_state(scene: Scene, start: Mapping[str, Sequence[float]] | ArrayLike) -> Floats:
    """Return the bodies' states, shape (body, 6), from the states given for some of them.

    Parameters
    ----------
    scene : Scene
        Orders the bodies; a body that is not given is at its pose there.
    start : mapping or array_like
        As of :func:`plan`.

    Raises
    ------
    GoalError
        If a body is unknown or its state incomplete, or bodies lie inside each other.
    """
    names = [body.name for body in scene.moving]
    if isinstance(start, Mapping):
        with checks.located(kind=GoalError):
            checks.keyed(start, "start, which is of moving bodies", (), names)
        states = np.zeros((len(names), len(STATE)))
        for i, body in enumerate(scene.moving):
            if body.name not in start and body.pose is None:
                raise GoalError(
                    f"start: nothing says where {body.name} is; give {body.name} = x, y, theta"
                )
            pose = np.asarray(start.get(body.name, body.pose), dtype=float).ravel()
            if len(pose) not in (3, 6):
                raise GoalError(
                    f"start of {body.name}: got {len(pose)} values, expected x, y, theta or these"
                    " and vx, vy, omega"
                )
            states[i, : len(pose)] = pose
    else:
        states = np.array(start, dtype=float)
        if states.shape != (len(names), len(STATE)):
            raise GoalError(
                f"start has shape {states.shape}, expected ({len(names)}, 6): {', '.join(names)}"
            )
    if not np.isfinite(states).all():
        raise GoalError("start: a value is not a finite number")
    check_placement(scene, states[None], lambda _: "start")
    return states


def _check_goal(scene: Scene, goal: Goal) -> None:
    """Refuse targets of no body, or inside walls or static bodies by more than their tolerance."""
    goal.check(scene)
    for target, tolerance in zip(goal.targets, goal.tolerances(scene), strict=True):
        if target.x is None or target.y is None or target.theta is None:
            continue
        alone = scene.subset([target.body]).replace(joints=())
        pose = np.array([[[target.x, target.y, target.theta]]])
        depth = float(overlap(alone, pose)[0])
        if depth > tolerance:
            raise GoalError(
                f"goal of {target.body}: there it is {depth:.2g} m inside a wall or a static body;"
                " choose a free place"
            )
