"""A parameter over robots of one kind: normal-normal partial pooling on a grid of the spread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtr
from scipy.stats import chi2

Array = NDArray[np.float64]

#: The grid of the spread, in units of its prior's scale.
_LEAST, _MOST, _POINTS = 1e-6, 6.0, 800
#: A point of the grid that is less probable changes no quantile.
_NOTHING = 1e-9


@dataclass(frozen=True, eq=False)
class Population:
    """A parameter over robots of one kind, on the scale on which its prior is normal.

    Parameters
    ----------
    weights : ndarray
        Posterior of the spread on its grid, shape (grid,).
    spread : ndarray
        The grid: standard deviations between robots.
    centre, centre_sd : ndarray
        Mean and standard deviation of the kind's mean at each spread, shape (grid,).
    value, value_sd : ndarray
        The same of each robot's parameter, shape (robot, grid).
    p_same : float
        Probability of robots that differ so much if they were the same (Cochran's Q); NaN with
        fewer than two that inform. Called different below 0.05, robots that are the same are in 5 %
        of cases.
    informed : ndarray of bool
        Whose data say something of it, shape (robot,).
    """

    weights: Array
    spread: Array
    centre: Array
    centre_sd: Array
    value: Array
    value_sd: Array
    p_same: float
    informed: NDArray[np.bool_]

    def mean(self, q: float) -> float:
        """Quantile of the kind's mean."""
        return _quantile(self.weights, self.centre, self.centre_sd, q)

    def deviation(self, q: float) -> float:
        """Quantile of the spread between robots."""
        return float(np.interp(q, np.cumsum(self.weights), self.spread))

    def robot(self, number: int, q: float) -> float:
        """Quantile of a robot's parameter, given all robots' data."""
        return _quantile(self.weights, self.value[number], self.value_sd[number], q)

    def next(self, q: float) -> float:
        """Quantile of the parameter of a robot that was not seen."""
        return _quantile(self.weights, self.centre, np.hypot(self.centre_sd, self.spread), q)


def population(
    estimate: Array, sd: Array, *, centre: float, width: float, spread: float
) -> Population:
    """Partial pooling of normal likelihoods, integrated over mean and spread.

    Parameters
    ----------
    estimate, sd : ndarray
        Of each robot's likelihood, shape (robot,); an infinite ``sd`` says nothing.
    centre, width : float
        Of the kind's mean, normal a priori.
    spread : float
        Scale of the half-normal prior of the standard deviation between robots.

    Examples
    --------
    >>> found = population(np.array([1.0, 1.2, 0.9, 1.1]), np.full(4, 0.02), centre=0.0, width=5.0,
    ...                    spread=1.0)
    >>> round(found.mean(0.5), 2), found.p_same < 1e-6
    (1.05, True)
    """
    informed = np.isfinite(sd)
    tau = spread * np.geomspace(_LEAST, _MOST, _POINTS)
    own = np.where(informed, estimate, 0.0)[:, None]
    precision = 1 / (sd[:, None] ** 2 + tau**2)  # zero of those that say nothing
    total = precision.sum(axis=0) + width**-2
    middle = ((precision * own).sum(axis=0) + centre * width**-2) / total
    log_weight = 0.5 * np.log(precision[informed]).sum(axis=0) - 0.5 * np.log(total)
    log_weight -= 0.5 * (precision * (own - middle) ** 2).sum(axis=0)
    log_weight -= 0.5 * ((middle - centre) / width) ** 2 + 0.5 * (tau / spread) ** 2
    log_weight += np.log(tau)  # the grid is even in the logarithm
    weights = np.exp(log_weight - log_weight.max())
    # of each robot given the spread: its own estimate and the mean of the kind, whose error it has
    share = tau**2 * precision
    value = share * own + (1 - share) * middle
    variance = (1 - share) * tau**2 + (1 - share) ** 2 / total
    p_same = np.nan
    if informed.sum() > 1:
        inverse = sd[informed] ** -2.0
        common = (inverse * estimate[informed]).sum() / inverse.sum()
        q = (inverse * (estimate[informed] - common) ** 2).sum()
        p_same = float(chi2.sf(q, informed.sum() - 1))
    weights /= weights.sum()
    deviation = np.sqrt(variance)
    return Population(weights, tau, middle, total**-0.5, value, deviation, p_same, informed)


def _quantile(weights: Array, mean: Array, sd: Array, q: float) -> float:
    """Quantile of a mixture of normals."""
    some = weights > _NOTHING
    weights, mean, sd = weights[some] / weights[some].sum(), mean[some], sd[some]
    low, high = float((mean - 9 * sd).min()), float((mean + 9 * sd).max())

    def excess(x: float) -> float:
        return float(weights @ ndtr((x - mean) / sd)) - q

    return float(brentq(excess, low, high, xtol=1e-9 * (high - low)))
