"""Task and result of a search for a plan, its risk over draws and its contact penalty."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pbrl_ppl.physics import overlap
from pbrl_ppl.planning.actions import ActionSet
from pbrl_ppl.planning.dynamics import TransitionModel
from pbrl_ppl.planning.goals import Goal
from pbrl_ppl.scene import Scene, smallest_radius
from pbrl_ppl.state import Floats

#: States that a search generates at most by default: 15 s or so for one body.
NODES = 2_000_000


@dataclass(frozen=True, eq=False)
class Task:
    """Task of a search.

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
        States to generate at most, counting each draw's.
    seconds : float
        Limit of time; with it, the plan depends on how busy the machine is.
    noise : bool
        Whether Eq. 13's noise is added to every transition.
    rng : Generator
        Source of randomness.
    progress : callable
        Called with a text on how far the search is.
    """

    dynamics: TransitionModel
    start: Floats
    goal: Goal
    actions: ActionSet
    tail: float = 1.0
    nodes: int = NODES
    seconds: float = np.inf
    noise: bool = False
    rng: np.random.Generator | None = None
    progress: Callable[[str], None] = lambda text: None


@dataclass(frozen=True, eq=False)
class SearchResult:
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
