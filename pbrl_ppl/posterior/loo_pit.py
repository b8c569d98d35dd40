"""LOO-PIT: where measurements lie in predictions that have not seen them."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.posterior.predictions import predicted_rows
from pbrl_ppl.posterior.store import group, groups, smoothed
from pbrl_ppl.state import STATE, THETA, wrapped

_CELLS = ("transition", "step", "body", "state")


def loo_pit(idata: Any) -> xr.DataArray:
    """Leave-one-out probability integral transform of every measured number.

    The probability that the model, fitted without a transition, gives to values below the measured
    one. Uniform between 0 and 1 where the predictions are calibrated; too many at the ends mean
    predictions that are too narrow, too many on one side a bias. It looks at one transition at a
    time, and does not see errors that repeat from one to the next. Of whole
    trajectories it is no leave-one-out: a number is predicted from those before it, and only its
    own factor is taken out of the likelihood; those after it have seen it.

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
        If it lacks a group, or its draws were reweighted by :func:`pbrl_ppl.update`, after which
        the predictions are no longer those of single draws.
    """
    if "before_updates" in groups(idata):
        raise PosteriorError(
            "loo_pit: the draws were reweighted by update and do not belong to single predictions;"
            " fit all data anew"
        )
    predictive = group(idata, "posterior_predictive")
    rows = predicted_rows(group(idata, "posterior"), predictive)
    samples = {"sample": ("chain", "draw")}
    predicted = predictive["next_state"].stack(samples).transpose("sample", *_CELLS)
    likelihood = group(idata, "log_likelihood")["next_state"].stack(samples)
    likelihood = likelihood.transpose("transition", "sample")
    measured = group(idata, "observed_data")["next_state"].transpose(*_CELLS)
    # smoothed with all draws, of which the tail is better known
    weights = np.stack([smoothed(-each)[0][rows] for each in likelihood.to_numpy()], axis=1)
    weights /= weights.sum(axis=0)
    off = predicted.to_numpy() - measured.to_numpy()
    angle = measured["state"].to_numpy() == STATE[THETA]
    off[..., angle] = wrapped(off[..., angle])
    below = np.einsum("rt,rthbs->thbs", weights, off <= 0.0)
    return measured.copy(data=np.where(np.isfinite(measured), below, np.nan))
