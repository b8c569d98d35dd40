"""Leave-one-out cross-validation of two posteriors, by `az.loo` and `az.compare`."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from pbrl_ppl.posterior.store import DATATREE, group

#: With fewer draws, the tail that Pareto's law is fitted to has fewer than twenty.
_LEAST_DRAWS = 100


@dataclass(frozen=True)
class LeaveOneOut:
    """One model's expected log predictive density of a transition that it was not fitted to.

    Parameters
    ----------
    elpd_loo, se : float
        Summed over the transitions, and its standard error (nats).
    p_loo : float
        Effective number of parameters.
    high_pareto_k : int
        Transitions whose weights are not to be relied on: Pareto k above ``good_k``.
    good_k : float
        0.7, or less with few draws (Vehtari et al., 2024).
    """

    elpd_loo: float
    se: float
    p_loo: float
    high_pareto_k: int
    good_k: float


@dataclass(frozen=True)
class Comparison:
    """Two models of the same transitions, by leave-one-out cross-validation.

    Parameters
    ----------
    before, after : LeaveOneOut
        Of each model.
    elpd_difference, elpd_difference_se : float
        What the later one gains, and the standard error of that; zero if it is the same model.
    transitions : int
        How many were left out, one at a time.
    """

    before: LeaveOneOut
    after: LeaveOneOut
    elpd_difference: float
    elpd_difference_se: float
    transitions: int

    def to_dict(self) -> dict[str, Any]:
        """The contents of ``loo`` in ``report.json``."""
        return vars(self) | {"before": vars(self.before), "after": vars(self.after)}


def compare(before: Any, after: Any) -> Comparison | None:
    """Compare two posteriors of the same data by leave-one-out cross-validation.

    Parameters
    ----------
    before, after : InferenceData or DataTree
        With a group ``log_likelihood``; the same object twice is one model.

    Returns
    -------
    Comparison or None
        None where ArviZ cannot say: with fewer than 100 draws, or likelihoods that are not finite.
    """
    for posterior in (before, after):
        sizes = group(posterior, "posterior").sizes
        if sizes["chain"] * sizes["draw"] < _LEAST_DRAWS:
            return None
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # of ArviZ 0.23 about 1.0, and of Pareto k, which the result says
        warnings.simplefilter("ignore")
        import arviz as az

        try:
            first = az.loo(before, pointwise=True)
            second = first if after is before else az.loo(after, pointwise=True)
            difference, error = (0.0, 0.0) if after is before else _gain(az, first, second)
        except Exception:  # whatever it is, a report can do without
            return None
    found = Comparison(_summary(first), _summary(second), difference, error, _n(first))
    numbers = (found.before.elpd_loo, found.after.elpd_loo, difference, error)
    return found if np.isfinite(numbers).all() else None


def _gain(az: Any, first: Any, second: Any) -> tuple[float, float]:
    """Difference of elpd, second less first model, and its standard error, by ``az.compare``."""
    exact = {"round_to": "none"} if DATATREE else {}
    table = az.compare({"before": first, "after": second}, **exact)
    worse = table.iloc[-1]
    sign = 1.0 if worse.name == "before" else -1.0
    return sign * abs(float(worse["elpd_diff"])), float(worse["dse"])


def _summary(loo: Any) -> LeaveOneOut:
    """Summary of an ArviZ result, whose names differ between 0.x and 1.x."""
    elpd, p = (loo.elpd, loo.p) if DATATREE else (loo["elpd_loo"], loo["p_loo"])
    good = float(loo.good_k)
    # written so that a shape that is not a number counts as high
    high = int((~(np.asarray(loo.pareto_k) <= good)).sum())
    return LeaveOneOut(float(elpd), float(loo.se), float(p), high, good)


def _n(loo: Any) -> int:
    return int(loo.n_data_points)
