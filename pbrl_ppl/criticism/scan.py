"""Grid scan of effects with a place, a threshold or a time, corrected for the looks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects import Attached
from pbrl_ppl.modes import Mode

Array = NDArray[np.float64]

#: Looks that are simulated in one call.
_AT_ONCE = 8


@dataclass(frozen=True, eq=False)
class Look:
    """An effect tried at one value of what is scanned.

    Parameters
    ----------
    values : ndarray
        The effect's parameters, shape (q,), those that are not scanned at their null value.
    signature : ndarray
        What it does to the whitened prediction, shape (n, columns): the derivative by each
        parameter that is not scanned, or the whole change where all are.
    columns : tuple of int
        The parameter of each column; empty where it is the whole change.
    """

    values: Array
    signature: Array
    columns: tuple[int, ...]


def looks(mode: Mode, candidate: Attached) -> list[Look]:
    """Try a candidate at every value that its scan proposes.

    Parameters
    ----------
    mode : Mode
        Mode of the model that lacks it.
    candidate : Attached
        An effect with a ``scan``.

    Returns
    -------
    list of Look
        Those that change a prediction.
    """
    effect, problem = candidate.effect, mode.problem
    if effect.scan is None:
        return []
    body = problem.scene.body(candidate.body)
    proposed = effect.scan(problem.scene, problem.data.history, body)
    wide = problem.with_physics(effects=(*problem.physics.effects, candidate)).rough
    labels = wide.layout.labels
    declared = [labels.index(label) for label in problem.layout.labels]
    own = [labels.index(label) for label in candidate.labels]  # places in the wider vector
    null = np.array(effect.null)

    def whitened(points: Array) -> Array:
        phi = np.zeros((len(points), wide.layout.size))
        phi[:, declared] = mode.phi
        phi[:, own] = points
        return -np.nan_to_num(wide.whitened(phi, mode.sigma)).reshape(len(points), -1)

    free = np.isnan(proposed)
    steps = np.array([1e-3 * min(p.prior.sigma, 1.0) for p in effect.parameters])
    lower, upper = np.array([p.prior.support for p in effect.parameters]).T
    # one-sided where the null is the least that there can be
    ahead, behind = np.minimum(null + steps, upper) - null, np.maximum(null - steps, lower) - null
    nothing = whitened(null[None])[0]
    found = []
    for begin in range(0, len(proposed), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        points, plan = _points(proposed[part], free[part], null, (ahead, behind))
        states = whitened(points)
        for values, columns, rows in plan:
            if columns:
                ends = states[rows].reshape(len(columns), 2, -1)
                width = (ahead - behind)[list(columns)]
                signature = ((ends[:, 0] - ends[:, 1]) / width[:, None]).T
            else:
                signature = (states[rows] - nothing).T
            if np.any(signature):
                found.append(Look(values, signature, columns))
    return found


def _points(
    proposed: Array, free: Array, null: Array, steps: tuple[Array, Array]
) -> tuple[Array, list[tuple[Array, tuple[int, ...], list[int]]]]:
    """Points to simulate, and each look's values, free columns and rows of the points."""
    points: list[Array] = []
    plan = []
    for row, unknown in zip(proposed, free, strict=True):
        values = np.where(unknown, null, row)
        columns = tuple(int(i) for i in np.flatnonzero(unknown))
        begin = len(points)
        for column in columns:
            for step in steps:
                moved = values.copy()
                moved[column] += step[column]
                points.append(moved)
        if not columns:
            points.append(values)
        plan.append((values, columns, list(range(begin, len(points)))))
    return np.array(points), plan
