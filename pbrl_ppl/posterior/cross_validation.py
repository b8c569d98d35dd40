"""Cross-validation of posteriors: `az.loo`, `az.compare`, what they leave out, and LOO-PIT."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.likelihood import NEXT_STATE_DIMS
from pbrl_ppl.posterior.data import PLACES, SMOOTHED
from pbrl_ppl.posterior.store import (
    Idata,
    arviz,
    elpd_of,
    from_groups,
    gain_of,
    group,
    groups,
    smoothed,
)
from pbrl_ppl.state import STATE, THETA, Floats, Ints, wrapped

#: The dimension over which measured numbers are joined.
_NUMBER = "number"


@dataclass(frozen=True)
class LeaveOneOut:
    """Expected log predictive density of a model for data that it was not fitted to.

    Parameters
    ----------
    elpd_loo, se : float
        Summed over all that is left out, and its standard error (nats).
    p_loo : float
        Effective number of parameters.
    high_pareto_k : int
        Number of units whose weights are unreliable: Pareto k above ``good_k``.
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
        Result for each model.
    elpd_difference, elpd_difference_se : float
        Gain of the later model and its standard error; zero if it is the same model.
    count : int
        Number of units that were left out, one at a time.
    left_out : str
        The unit: ``transition``, or ``trajectory`` for whole trajectories.
    """

    before: LeaveOneOut
    after: LeaveOneOut
    elpd_difference: float
    elpd_difference_se: float
    count: int
    left_out: str = "transition"

    @property
    def method(self) -> str:
        """Name of the cross-validation and of its unit."""
        out = "trajectory-" if self.left_out == "trajectory" else ""
        plural = {"trajectory": "trajectories", "transition": "transitions"}[self.left_out]
        return f"Leave-one-{out}out cross-validation on the {self.count} {plural} of the fit"

    def to_dict(self) -> dict[str, object]:
        """Return the contents of ``loo`` in ``report.json``."""
        return vars(self) | {"before": vars(self.before), "after": vars(self.after)}


def compare(before: Idata, after: Idata, *, least_draws: int = 100) -> Comparison | None:
    """Compare two posteriors of the same data by leave-one-out cross-validation.

    For whole trajectories, one trajectory is left out at a time, see :func:`by_trajectory`.

    Parameters
    ----------
    before, after : InferenceData or DataTree
        With a group ``log_likelihood``; the same object twice is one model.
    least_draws : int
        With fewer, the Pareto distribution is fitted to a tail of fewer than twenty.

    Returns
    -------
    Comparison or None
        None with fewer draws, or where a likelihood is not finite.

    Raises
    ------
    PosteriorError
        If one is of whole trajectories and the other of single transitions.
    """
    unit = left_out(before)
    if left_out(after) != unit:
        raise PosteriorError(
            f"compare: one posterior leaves out one {unit} at a time and the other one"
            f" {left_out(after)}; fit both with the same likelihood"
        )
    for posterior in (before, after):
        sizes = group(posterior, "posterior").sizes
        if sizes["chain"] * sizes["draw"] < least_draws:
            return None
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # warnings about Pareto k, which is in the result
        warnings.simplefilter("ignore")
        az = arviz()
        try:
            first = az.loo(separate(before), pointwise=True)
            second = first if after is before else az.loo(separate(after), pointwise=True)
            difference, error = (0.0, 0.0) if after is before else gain_of(first, second)
        except ValueError:  # of a tail of equal values, or of numbers that are not finite
            return None
    count = int(first.n_data_points)
    comparison = Comparison(_summary(first), _summary(second), difference, error, count, unit)
    numbers = (comparison.before.elpd_loo, comparison.after.elpd_loo, difference, error)
    return comparison if np.isfinite(numbers).all() else None


def _summary(loo: Any) -> LeaveOneOut:
    """Return the summary of an ArviZ result."""
    elpd, p = elpd_of(loo)
    good = float(loo.good_k)
    # NaN counts as high
    high = int((~(np.asarray(loo.pareto_k) <= good)).sum())
    return LeaveOneOut(elpd, float(loo.se), p, high, good)


def left_out(idata: Idata) -> str:
    """Return the unit that leave-one-out leaves out: ``trajectory`` or ``transition``."""
    return "trajectory" if SMOOTHED in groups(idata).get("constant_data", ()) else "transition"


def by_trajectory(idata: Idata) -> Idata:
    """Return a posterior for leave-one-trajectory-out by ``az.loo`` and ``az.compare``.

    In a likelihood of whole trajectories, each transition is conditional on those before it. To
    leave out one transition is no cross-validation there, for later ones have seen its data.

    Parameters
    ----------
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`, of either likelihood.

    Returns
    -------
    InferenceData or DataTree
        The groups ``posterior`` and ``log_likelihood``, the latter summed over each trajectory,
        dims (chain, draw, trajectory), nats.

    Examples
    --------
    ::

        az.loo(pp.by_trajectory(idata), pointwise=True)
        az.compare({"one": pp.by_trajectory(one), "other": pp.by_trajectory(other)})
    """
    likelihood = group(idata, "log_likelihood")
    summed = likelihood.groupby("trajectory").sum().transpose("chain", "draw", "trajectory")
    data = {"posterior": group(idata, "posterior"), "log_likelihood": summed}
    return from_groups(data, idata.attrs)


def separate(idata: Idata) -> Idata:
    """Return a posterior with one log-likelihood for each unit that is left out."""
    return by_trajectory(idata) if left_out(idata) == "trajectory" else idata


def by_number(idata: Idata) -> Idata:
    """Return a posterior for ``az.loo_pit`` and ``az.plot_loo_pit``.

    These, and ``az.plot_ppc_pit`` of ArviZ 1.x, want predictions of all draws and a log-likelihood
    of every number. Here each measured number has the log-likelihood of its transition, which is
    left out with it, and the draws are those that have predictions.

    Parameters
    ----------
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`, of single transitions (Eq. 11).

    Returns
    -------
    InferenceData or DataTree
        The groups ``posterior``, ``posterior_predictive``, ``log_likelihood`` and
        ``observed_data``; ``next_state`` has the dims (chain, draw, number). Coordinates of
        ``number`` say ``transition``, ``step``, ``body`` and ``state``. Predicted angles are within
        half a turn of the measured ones.

    Raises
    ------
    PosteriorError
        If a group is missing, or the likelihood is of whole trajectories, whose transitions cannot
        be left out one by one.

    Examples
    --------
    ::

        az.plot_loo_pit(pp.by_number(idata), y="next_state")  # ArviZ 0.x
        az.plot_loo_pit(pp.by_number(idata))  # ArviZ 1.x
    """
    if left_out(idata) == "trajectory":
        raise PosteriorError(
            "by_number: the posterior is of whole trajectories, whose later transitions have seen"
            " the one left out; fit single transitions, or take az.loo of by_trajectory"
        )
    predictive = group(idata, "posterior_predictive")["next_state"]
    predictive = predictive.transpose("chain", "draw", *NEXT_STATE_DIMS)
    some = {"draw": predictive["draw"].to_numpy()}
    measured = group(idata, "observed_data")["next_state"].transpose(*NEXT_STATE_DIMS)
    likelihood = group(idata, "log_likelihood")["next_state"].sel(some)
    data = {
        "posterior_predictive": measured + predictive.copy(data=_deviations(predictive, measured)),
        "log_likelihood": likelihood + xr.zeros_like(measured),
        "observed_data": measured,
    }
    seen = np.isfinite(measured.to_numpy().ravel())
    numbers = {
        name: values.drop_vars(["chain", "draw", *PLACES], errors="ignore")
        .stack({_NUMBER: NEXT_STATE_DIMS})
        .transpose(..., _NUMBER)
        .isel({_NUMBER: seen})
        .reset_index(_NUMBER)
        .to_dataset(name="next_state")
        for name, values in data.items()
    }
    posterior = group(idata, "posterior").sel(some).drop_vars(["chain", "draw"])
    posterior = posterior.transpose("chain", "draw", ...)
    return from_groups({"posterior": posterior, **numbers}, idata.attrs)


def loo_pit(idata: Idata) -> xr.DataArray:
    """Return the leave-one-out probability integral transform of every measured number.

    The probability that the model, fitted without a transition, gives to values below the measured
    one. Uniform between 0 and 1 where the predictions are calibrated; too many at the ends mean
    predictions that are too narrow, too many on one side a bias. It cannot see errors that are
    correlated from transition to transition. For whole trajectories it is no exact leave-one-out:
    later transitions have seen the number that is left out.

    Parameters
    ----------
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`.

    Returns
    -------
    xarray.DataArray
        Dims (transition, step, body, state); NaN where nothing was measured.

    Raises
    ------
    PosteriorError
        If it lacks a group.
    """
    predictive = group(idata, "posterior_predictive")
    rows = predicted_rows(group(idata, "posterior"), predictive)
    samples = {"sample": ("chain", "draw")}
    predicted = predictive["next_state"].stack(samples).transpose("sample", *NEXT_STATE_DIMS)
    likelihood = group(idata, "log_likelihood")["next_state"].stack(samples)
    likelihood = likelihood.transpose("transition", "sample")
    measured = group(idata, "observed_data")["next_state"].transpose(*NEXT_STATE_DIMS)
    weights = np.stack([_weights(-column, rows) for column in likelihood.to_numpy()], axis=1)
    below = np.einsum("rt,rthbs->thbs", weights, _deviations(predicted, measured) <= 0.0)
    return measured.copy(data=np.where(np.isfinite(measured), below, np.nan))


def _weights(log_weights: Floats, rows: Ints) -> Floats:
    """Return the importance weights of some of the draws, which sum to one.

    They are smoothed over all draws, for a better estimate of the tail, unless all weight is on
    other draws.
    """
    weights = smoothed(log_weights)[0][rows]
    total = weights.sum()
    return weights / total if total > 0.0 else smoothed(log_weights[rows])[0]


def _deviations(predicted: xr.DataArray, measured: xr.DataArray) -> Floats:
    """Return predicted minus measured states, angles wrapped, shape of ``predicted``."""
    off = predicted.to_numpy() - measured.to_numpy()
    angle = measured["state"].to_numpy() == STATE[THETA]
    off[..., angle] = wrapped(off[..., angle])
    return np.asarray(off)


def predicted_rows(posterior: xr.Dataset, predictive: xr.Dataset) -> Ints:
    """Return the draws that stored predictions were made with.

    Parameters
    ----------
    posterior, predictive : Dataset
        The two groups of a fit.

    Returns
    -------
    ndarray
        Indices of the draws, chains joined: one a prediction, chains of these joined too.
    """
    chains, draws = posterior.sizes["chain"], posterior.sizes["draw"]
    places = posterior.indexes["draw"].get_indexer(predictive.indexes["draw"])
    return np.asarray((draws * np.arange(chains)[:, None] + places).ravel())
