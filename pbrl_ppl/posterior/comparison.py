"""Leave-one-out cross-validation of two posteriors, by `az.loo` and `az.compare`."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.posterior.leave_out import left_out, separate
from pbrl_ppl.posterior.store import DATATREE, group

#: With fewer draws, the tail that Pareto's law is fitted to has fewer than twenty.
_LEAST_DRAWS = 100


@dataclass(frozen=True)
class LeaveOneOut:
    """One model's expected log predictive density of data that it was not fitted to.

    Parameters
    ----------
    elpd_loo, se : float
        Summed over all that is left out, and its standard error (nats).
    p_loo : float
        Effective number of parameters.
    high_pareto_k : int
        Of how many the weights are not to be relied on: Pareto k above ``good_k``.
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
    """Two models of the same data, by cross-validation.

    Parameters
    ----------
    before, after : LeaveOneOut
        Of each model.
    elpd_difference, elpd_difference_se : float
        What the later one gains, and the standard error of that; zero if it is the same model.
    count : int
        How many were left out, one at a time.
    left_out : str
        ``transition``, or of whole trajectories ``trajectory``.
    """

    before: LeaveOneOut
    after: LeaveOneOut
    elpd_difference: float
    elpd_difference_se: float
    count: int
    left_out: str = "transition"

    @property
    def method(self) -> str:
        """Name of the cross-validation, and what it is over."""
        out = "trajectory-" if self.left_out == "trajectory" else ""
        plural = {"trajectory": "trajectories", "transition": "transitions"}[self.left_out]
        return f"Leave-one-{out}out cross-validation on the {self.count} {plural} of the fit"

    def to_dict(self) -> dict[str, Any]:
        """The contents of ``loo`` in ``report.json``."""
        return vars(self) | {"before": vars(self.before), "after": vars(self.after)}


def compare(before: Any, after: Any) -> Comparison | None:
    """Compare two posteriors of the same data by leave-one-out cross-validation.

    Of whole trajectories one trajectory is left out at a time, see :func:`by_trajectory`.

    Parameters
    ----------
    before, after : InferenceData or DataTree
        With a group ``log_likelihood``; the same object twice is one model.

    Returns
    -------
    Comparison or None
        None where ArviZ cannot say: with fewer than 100 draws, or likelihoods that are not finite.

    Raises
    ------
    PosteriorError
        If one is of whole trajectories and the other of single transitions.
    """
    unit = left_out(before)
    if left_out(after) != unit:
        raise PosteriorError(
            f"compare: one posterior leaves out one {unit} at a time and the other one"
            f" {left_out(after)}; fit both with or both without trajectories=True"
        )
    for posterior in (before, after):
        sizes = group(posterior, "posterior").sizes
        if sizes["chain"] * sizes["draw"] < _LEAST_DRAWS:
            return None
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # of ArviZ 0.23 about 1.0, and of Pareto k, which the result says
        warnings.simplefilter("ignore")
        import arviz as az

        try:
            first = az.loo(separate(before), pointwise=True)
            second = first if after is before else az.loo(separate(after), pointwise=True)
            difference, error = (0.0, 0.0) if after is before else _gain(az, first, second)
        except Exception:  # whatever it is, a report can do without
            return None
    found = Comparison(_summary(first), _summary(second), difference, error, _n(first), unit)
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
