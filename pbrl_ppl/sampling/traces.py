"""Traces in PyMC's form: from draws made without PyMC, or concatenated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from pbrl_ppl.posterior import CELLS, from_groups, group, groups
from pbrl_ppl.state import Floats


def as_trace(model: pm.Model, draws: Mapping[str, Any], stats: Mapping[str, Any]) -> Any:
    """Return a trace in PyMC's form, of draws made without PyMC.

    Parameters
    ----------
    model : pymc.Model
        As made by ``physics_model``; has the dimensions of each variable.
    draws : mapping of str to ndarray
        By the variables' names, shape (chain, draw, ...).
    stats : mapping of str to ndarray
        The sampler's statistics of each draw, shape (chain, draw).
    """
    problem, posterior = model.problem, posterior_dataset(model, draws)
    per_draw = {name: (("chain", "draw"), value) for name, value in stats.items()}
    given = {
        "start": (("transition", "body", "full_state"), problem.segments.start),
        "actions": (("transition", "step", "body", "wrench"), problem.inputs),
    }
    observed = {"next_state": (CELLS, problem.observations.values)}
    return from_groups(
        {
            "posterior": posterior,
            "sample_stats": xr.Dataset(per_draw, {d: posterior[d] for d in ("chain", "draw")}),
            "observed_data": labelled(model, observed),
            "constant_data": labelled(model, given),
        },
        {},
    )


def appended(earlier: Any, trace: Any) -> Any:
    """Concatenate the draws of two runs."""
    data = groups(trace)
    for name in ("posterior", "sample_stats"):
        old, new = group(earlier, name), data[name]
        shared = [str(variable) for variable in new.data_vars if variable in old]
        both = xr.concat([old[shared], new[shared]], dim="draw")
        data[name] = both.assign_coords(draw=np.arange(both.sizes["draw"]))
    return from_groups(data, {})


def posterior_dataset(model: pm.Model, values: Mapping[str, Floats]) -> xr.Dataset:
    """Return draws, shape (chain, draw, ...), with the model's dimensions and coordinates."""
    data = {
        name: (("chain", "draw", *(model.named_vars_to_dims.get(name) or ())), value)
        for name, value in values.items()
    }
    chains, draws = next(iter(values.values())).shape[:2]
    return labelled(model, data).assign_coords(chain=np.arange(chains), draw=np.arange(draws))


def labelled(model: pm.Model, variables: Mapping[str, Any]) -> xr.Dataset:
    """Return variables (dims, values) with the model's coordinates of their dimensions."""
    used = {dim for dims, _ in variables.values() for dim in dims if dim in model.coords}
    return xr.Dataset(variables, {dim: list(model.coords[dim]) for dim in used})
