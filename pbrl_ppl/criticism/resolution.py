"""Engine substeps, chosen from the data: numerical error is the first suspect."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pbrl_ppl.model import smoothed
from pbrl_ppl.modes import Mode, trajectory_mode

#: A doubling of the substeps may move innovations by this share of their noise.
SMALL_SHIFT = 0.1
MOST_SUBSTEPS = 640
#: Linearised elsewhere, the same mode's log-posterior differs by less.
_BETTER = 5.0
#: What a step adds if it is next to nothing, as a share of the prior's median.
_LITTLE = 0.1


def with_enough_substeps(mode: Mode, say: Callable[[str], None]) -> Mode:
    """Double the substeps until that no longer moves predictions, and refit.

    The engine's error is all but the same at neighbouring parameters, so it is looked at where the
    model was fitted with fewer. At the end smoothing begins anew: where a climb took up too large a
    noise, states smoothed with that noise confirm it.
    """
    while True:  # a better engine leaves less noise, against which its own error shows again
        begin = substeps = mode.problem.physics.substeps
        while shift(mode, substeps) > SMALL_SHIFT and substeps < MOST_SUBSTEPS:
            substeps *= 2
        if substeps == begin:
            fresh = _afresh(mode)
            if fresh.log_posterior < mode.log_posterior + _BETTER:
                return mode
            mode = fresh
            continue
        say(f"using {substeps} engine steps an interval")
        finer = mode.problem.with_physics(substeps=substeps)
        mode = trajectory_mode(finer, mode.phi, mode.sigma)


def _afresh(mode: Mode) -> Mode:
    """The better of two modes: smoothed anew, and smoothed as if steps added next to nothing."""
    problem = mode.problem
    sigma = problem.quiet(mode.sigma, _LITTLE)
    quiet = trajectory_mode(smoothed(problem, mode.phi, sigma), mode.phi, sigma)
    return max(trajectory_mode(problem, mode.phi), quiet, key=lambda found: found.log_posterior)


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
