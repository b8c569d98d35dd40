"""Mode of the likelihood of whole trajectories: parameters and smoothed states in turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.model import Problem, along_trajectories, smoothed
from pbrl_ppl.modes.laplace import Mode
from pbrl_ppl.modes.search import find_mode

Array = NDArray[np.float64]

#: Rounds at most; one that moves phi by less than this, in standard deviations, is the last.
_ROUNDS, _SETTLED = 6, 0.2
#: Rounds of a climb between two linearisations.
_CLIMB = 5


def trajectory_mode(problem: Problem, phi: Array, sigma: Array | None = None) -> Mode:
    """Mode with the transitions of a trajectory whitened together, linearised at smoothed states.

    Parameters
    ----------
    problem : Problem
        Of single transitions, or of trajectories already.
    phi : ndarray
        Where to begin, shape (p,).
    sigma : ndarray, optional
        Noise parameters to begin with where the problem is one of trajectories, smoothed nearby.

    Returns
    -------
    Mode
        Its problem's noise is a :class:`pbrl_ppl.model.TrajectoryNoise`.
    """
    if problem.trajectories is None or sigma is None:
        cells = None if problem.trajectories is None else problem.trajectories.cells
        problem = along_trajectories(problem, phi, cells=cells)
        sigma = None
    noise = problem.trajectories
    if noise is not None and sigma is None:
        sigma = noise.sigma
    for i in range(_ROUNDS):
        if i:
            problem = smoothed(problem, phi, np.asarray(sigma))
        mode = find_mode(problem, initial=phi, rounds=_CLIMB)
        spread = np.sqrt(np.maximum(np.diag(mode.covariance), 1e-300))
        change = float((np.abs(mode.phi - phi) / spread).max(initial=0.0))
        phi, sigma = mode.phi, mode.sigma
        if i and change < _SETTLED:
            break
    return mode
