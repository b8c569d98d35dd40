"""Engine substeps, chosen from the data: numerical error is the first suspect."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.unexplained import unexplained_acceleration
from pbrl_ppl.modes import Mode, nearby_mode, trajectory_mode

#: A doubling of the substeps may move innovations by this share of their noise.
SMALL_SHIFT = 0.1
MOST_SUBSTEPS = 640
#: Linearised elsewhere, the same mode's log-posterior differs by less.
_BETTER = 5.0
#: An unexplained acceleration of more than this share of the bodies' is no numerical error, and one
#: that a doubling moves by less than this share of itself neither.
_LARGE, _STILL = 0.1, 0.1


def with_enough_substeps(
    mode: Mode,
    say: Callable[[str], None],
    criteria: Criteria = DEFAULT,
) -> Mode:
    """Double the substeps until neither predictions nor the acceleration test move, and refit.

    The engine's error is all but the same at neighbouring parameters, so it is looked at where the
    model was fitted with fewer. At the end smoothing begins anew: where a climb took up too large a
    noise, states smoothed with that noise confirm it.
    """
    confirmed = 0  # substeps with which smoothing began anew
    while True:  # a better engine leaves less noise, against which its own error shows again
        begin = substeps = mode.problem.physics.substeps
        while shift(mode, substeps) > SMALL_SHIFT and substeps < MOST_SUBSTEPS:
            substeps *= 2
        if substeps > begin:
            mode = _refined(mode, substeps, say)
            continue
        if confirmed < substeps:
            fresh, confirmed = trajectory_mode(mode.problem, mode.phi), substeps
            if fresh.log_posterior > mode.log_posterior + _BETTER:
                mode = fresh
                continue
        left = unexplained_acceleration(mode, criteria)
        if not left.matters.any() or left.worst > _LARGE or substeps >= MOST_SUBSTEPS:
            return mode
        finer = _refined(mode, 2 * substeps, say)
        moved = left.relative - unexplained_acceleration(finer, criteria).relative
        if (np.abs(moved[left.matters]) < _STILL * left.relative[left.matters]).all():
            return mode
        mode = finer


def _refined(mode: Mode, substeps: int, say: Callable[[str], None]) -> Mode:
    say(f"using {substeps} engine steps an interval")
    return nearby_mode(mode.problem.with_physics(substeps=substeps), mode.phi, mode.sigma)


def shift(mode: Mode, substeps: int | None = None) -> float:
    """Root mean square change of the innovations, in units of noise, if substeps are doubled.

    Parameters
    ----------
    mode : Mode
        Of whole trajectories.
    substeps : int, optional
        To double; the mode's by default.
    """
    problem = mode.problem
    substeps = problem.physics.substeps if substeps is None else substeps
    coarse, fine = (problem.with_physics(substeps=n) for n in (substeps, 2 * substeps))
    change = coarse.whitened(mode.phi, mode.sigma) - fine.whitened(mode.phi, mode.sigma)
    return float(np.sqrt(np.nanmean(change**2, axis=0).max()))
