"""Oracle that knows the law and the noise: a likelihood-ratio test of the effect's coefficient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from recordings.cases import Case, Recording
from recordings.laws import LAWS, Array

#: The effect is detectable at a smaller p-value.
DETECTS = 1e-4
#: Step of the derivatives, in units of the coefficient's size and of the initial states.
_STEP = 1e-6


@dataclass(frozen=True)
class Oracle:
    """Result of a fit of the right law with the right noise.

    Parameters
    ----------
    statistic : float
        Twice the log-likelihood ratio of the fits with and without the coefficient.
    p_value : float
        Of the statistic, chi-squared with one degree of freedom without the effect.
    estimate, sd : float
        The coefficient and its standard deviation, in the effect's unit.
    misfit : float
        Sum of squares of the fit with the coefficient over its degrees of freedom: about 1.
    """

    statistic: float
    p_value: float
    estimate: float
    sd: float
    misfit: float

    @property
    def detects(self) -> bool:
        """Return whether the effect is detectable."""
        return self.p_value < DETECTS


def ask(case: Case, recording: Recording) -> Oracle:
    """Fit the right law with and without the effect, each trajectory's initial state being free.

    Outliers are left out, and quantisation is noise of the variance of a uniform distribution: not
    quite right where a body moves less than a step between samples, as its errors are then
    correlated. As the coefficient is not negative, the p-value is at most twice what it should be.
    """
    # matrices are small: threads of linear algebra only get in each other's way
    with threadpool_limits(1, "blas"):
        return _fitted(case, recording)


def _fitted(case: Case, recording: Recording) -> Oracle:
    """Fit with and without the coefficient, and return the comparison."""
    law, good = LAWS[case.effect], recording.good
    count, states = recording.start.shape
    cell = np.nonzero(good)[0].repeat(recording.measured.shape[2])  # trajectory of each residual

    def residual(vector: Array) -> Array:
        start = vector[1:].reshape(count, states)
        places = law(case.body, case.size * vector[0], start, recording.time, recording.force)
        return ((places - recording.measured)[good] / case.sd).ravel()

    def derivative(vector: Array) -> Array:
        # an initial state moves its trajectory alone: the same one of all trajectories at once
        middle, found = residual(vector), np.zeros((len(cell), len(vector)))
        found[:, 0] = residual(vector + _STEP * np.eye(len(vector))[0]) - middle
        for state in range(states):
            column = 1 + state + states * np.arange(count)
            moved = vector.copy()
            moved[column] += _STEP
            found[np.arange(len(cell)), column[cell]] = residual(moved) - middle
        return found / _STEP

    truth = np.concatenate([[0.0 if case.clean else 1.0], recording.start.ravel()])
    low = np.full(len(truth), -np.inf)
    low[0] = 0.0  # no drag drives
    options = {"x_scale": "jac", "xtol": 1e-12, "ftol": 1e-12, "gtol": 1e-12, "max_nfev": 200}
    without = least_squares(
        lambda start: residual(np.append(0.0, start)),
        truth[1:],
        lambda start: derivative(np.append(0.0, start))[:, 1:],
        **options,
    )
    # the boundary is no place to begin at
    begin = np.append(max(truth[0], 1e-3), without.x if case.clean else truth[1:])
    whole = least_squares(residual, begin, derivative, bounds=(low, np.inf), **options)
    statistic = max(0.0, 2.0 * (without.cost - whole.cost))
    spread = np.linalg.pinv(whole.jac.T @ whole.jac)[0, 0]
    return Oracle(
        statistic=float(statistic),
        p_value=float(chi2.sf(statistic, 1)),
        estimate=float(case.size * whole.x[0]),
        sd=float(case.size * np.sqrt(spread)),
        misfit=float(2.0 * whole.cost / max(1, len(cell) - len(truth))),
    )
