"""Single measurements that a fitted model and all other measurements contradict."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from pbrl_ppl.criticism.unexplained import without_acceleration
from pbrl_ppl.modes import Mode

Array = NDArray[np.float64]

#: Robust standard deviations beyond which a measurement is left out: 1 of 10^14 of Gaussian noise.
_FAR = 8.0
#: ... errors of measuring that it is off the smoothed state, to which it belongs itself,
_OFF = 4.0
#: ... and times as far as its neighbours are: an event that lasts moves those, too.
_ALONE = 2.0
#: Largest share of a cell's measurements that single frames are.
_FEW = 0.05
#: Measurements of a cell, at least, of which one may be called far off.
_ENOUGH = 12


def outliers(mode: Mode) -> Array:
    """How far single measurements are off, NaN elsewhere, shape (trajectory, time, body, 6).

    They are judged by the residual given all others (auxiliary residuals), without any unexplained
    acceleration, which would follow them, and in units of the median residual: where physics is
    missing most residuals are large, and none is far off.

    Parameters
    ----------
    mode : Mode
        Of whole trajectories.
    """
    problem = mode.problem
    noise, segments = problem.trajectory_noise, problem.segments
    residual = noise.cells.of_residual(problem.residual(mode.phi))
    sigma = without_acceleration(mode).sigma
    both, error = noise.auxiliary(residual, sigma), noise.cells.white(sigma)
    size = np.abs(np.concatenate(both))  # of rows that transitions end at, then of first rows
    size[size == 0.0] = np.nan
    off = np.concatenate([noise.measured, noise.begin])
    trajectory = np.tile(segments.trajectory, 2)
    row = np.concatenate([segments.step + 1, segments.step])
    observed = problem.data.history.dataset["observed"]
    found = np.full(observed.shape, np.nan)
    flat = found.reshape(*found.shape[:2], -1)
    for cell, place in enumerate(noise.cells.places):
        own = size[:, cell]
        count = np.isfinite(own).sum()
        if noise.cells.sensor[cell] < 0 or count < _ENOUGH:
            continue
        far = own > _FAR * np.nanmedian(own) / norm.isf(0.25)
        far &= np.abs(off[:, cell]) > _OFF * error[cell]
        far &= own > _ALONE * np.nan_to_num(_beside(own, trajectory, row))
        if 0 < far.sum() <= max(_FEW * count, 1):
            flat[trajectory[far], row[far], place] = off[far, cell]
    return found


def _beside(size: Array, trajectory: NDArray[np.intp], row: NDArray[np.intp]) -> Array:
    """The larger residual of the rows before and after, shape of ``size``; NaN without any."""
    table = np.full((trajectory.max() + 1, row.max() + 3), np.nan)
    some = np.isfinite(size)
    table[trajectory[some], row[some] + 1] = size[some]
    return np.fmax(table[trajectory, row], table[trajectory, row + 2])
