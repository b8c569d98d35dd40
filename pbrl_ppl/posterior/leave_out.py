"""What cross-validation leaves out: a transition, or where these share states a trajectory."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.posterior.predictions import predicted_rows
from pbrl_ppl.posterior.recording import SMOOTHED
from pbrl_ppl.posterior.store import from_groups, group, groups
from pbrl_ppl.state import STATE, THETA, wrapped

_CELLS = ("transition", "step", "body", "state")
#: The dimension over which measured numbers are joined, and what says which number one is.
_NUMBER = "number"


def left_out(idata: Any) -> str:
    """What leave-one-out leaves out: ``trajectory`` of whole trajectories, else ``transition``."""
    return "trajectory" if SMOOTHED in groups(idata).get("constant_data", ()) else "transition"


def by_trajectory(idata: Any) -> Any:
    """A posterior for leave-one-trajectory-out by ``az.loo`` and ``az.compare``.

    A likelihood of whole trajectories gives each transition's measurements given those before it
    in its trajectory. To leave out one transition is no cross-validation there, for the transitions
    after it have seen what it measured.

    Parameters
    ----------
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`, of either likelihood.

    Returns
    -------
    InferenceData or DataTree
        The groups ``posterior`` and ``log_likelihood``, the latter summed over each trajectory,
        dims (chain, draw, trajectory), nats.

    Raises
    ------
    PosteriorError
        If the file does not say which trajectory a transition is of.

    Examples
    --------
    ::

        az.loo(pp.by_trajectory(idata), pointwise=True)
        az.compare({"one": pp.by_trajectory(one), "other": pp.by_trajectory(other)})
    """
    likelihood = group(idata, "log_likelihood")
    if "trajectory" not in likelihood.coords:
        raise PosteriorError(
            "by_trajectory: the posterior does not say which trajectory a transition is of, as no"
            " file of an older version does; fit again"
        )
    summed = likelihood.groupby("trajectory").sum().transpose("chain", "draw", "trajectory")
    data = {"posterior": group(idata, "posterior"), "log_likelihood": summed}
    return from_groups(data, idata.attrs)


def separate(idata: Any) -> Any:
    """A posterior with one log-likelihood for each unit that cross-validation leaves out."""
    return by_trajectory(idata) if left_out(idata) == "trajectory" else idata


def by_number(idata: Any) -> Any:
    """A posterior for ``az.loo_pit``, ``az.plot_loo_pit`` and ``az.plot_ppc_pit`` (ArviZ 1.x).

    These want predictions of all draws and a log-likelihood of every number. Here each measured
    number has the log-likelihood of its transition, which is left out with it, and the draws are
    those that have predictions.

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
        If a group is missing, the draws were reweighted by :func:`pbrl_ppl.update`, or the
        likelihood is of whole trajectories, whose transitions cannot be left out one by one.

    Examples
    --------
    ::

        az.plot_loo_pit(pp.by_number(idata), y="next_state")  # ArviZ 0.x
        az.plot_loo_pit(pp.by_number(idata))  # ArviZ 1.x
    """
    if "before_updates" in groups(idata):
        raise PosteriorError(
            "by_number: the draws were reweighted by update and do not belong to single"
            " predictions; fit all data anew"
        )
    if left_out(idata) == "trajectory":
        raise PosteriorError(
            "by_number: the posterior is of whole trajectories, whose later transitions have seen"
            " the one left out; fit with trajectories=False, or take az.loo of by_trajectory"
        )
    posterior = group(idata, "posterior")
    predictive = group(idata, "posterior_predictive")["next_state"].transpose(
        "chain", "draw", *_CELLS
    )
    chains, draws = predictive.sizes["chain"], predictive.sizes["draw"]
    rows = predicted_rows(posterior, predictive.to_dataset(name="next_state"))
    measured = group(idata, "observed_data")["next_state"].transpose(*_CELLS)
    values = measured.to_numpy()
    seen = np.flatnonzero(np.isfinite(values))
    places = np.unravel_index(seen, values.shape)
    off = predictive.to_numpy() - values
    angle = measured["state"].to_numpy() == STATE[THETA]
    off[..., angle] = wrapped(off[..., angle])
    predicted = (values + off).reshape(chains, draws, -1)[..., seen]

    def chosen(variable: xr.DataArray) -> Any:
        """Dims after chain and draw, and the values at the draws that have predictions."""
        variable = variable.transpose("chain", "draw", ...)
        values = variable.to_numpy().reshape(-1, *variable.shape[2:])[rows]
        return variable.dims[2:], values.reshape(chains, draws, *values.shape[1:])

    thinned = {name: chosen(variable) for name, variable in posterior.data_vars.items()}
    each = chosen(group(idata, "log_likelihood")["next_state"])[1][..., places[0]]
    own = {
        dim: (_NUMBER, np.asarray(measured[dim])[place])
        for dim, place in zip(_CELLS, places, strict=True)
    }
    sampled = ("chain", "draw", _NUMBER)
    return from_groups(
        {
            "posterior": xr.Dataset(
                {name: (("chain", "draw", *dims), value) for name, (dims, value) in thinned.items()}
            ),
            "posterior_predictive": xr.Dataset({"next_state": (sampled, predicted)}, own),
            "log_likelihood": xr.Dataset({"next_state": (sampled, each)}, own),
            "observed_data": xr.Dataset({"next_state": (_NUMBER, values.ravel()[seen])}, own),
        },
        idata.attrs,
    )
