"""The whole record of a fit: predictions, likelihoods, units, origin, convergence."""

from __future__ import annotations

import importlib.metadata
import json
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pbrl_ppl.errors import ConvergenceWarning
from pbrl_ppl.likelihood import log_density, next_state_random
from pbrl_ppl.model import Problem
from pbrl_ppl.posterior import attributes, convergence, draws, from_groups, group, groups

Array = NDArray[np.float64]

#: What a posterior needs before its summaries can be relied on (Vehtari et al., 2021).
MAX_RHAT, MIN_ESS = 1.01, 400
_PREDICTIVE_DRAWS = 50
#: With fewer, nothing can be said of convergence.
_LEAST_DRAWS = 4
PACKAGES = ("pbrl_ppl", "pymc", "pytensor", "arviz", "pymunk", "numpy", "numba", "xarray")


def complete(
    problem: Problem, trace: Any, *, seed: int, method: str, asked: int | None = None
) -> Any:
    """Add to a trace what the posterior file must hold: likelihood, predictions, units, origin.

    Parameters
    ----------
    problem : Problem
        What was fitted.
    trace : InferenceData or DataTree
        As PyMC gives it.
    seed : int
        Of the draws and of the predictions.
    method : str
        The sampler's name.
    asked : int, optional
        Draws a chain that were asked for, where an interrupt left fewer.

    Returns
    -------
    InferenceData or DataTree
        The posterior.
    """
    phi, sigma = parameter_draws(problem, trace)
    posterior = group(trace, "posterior")
    chains, n = posterior.sizes["chain"], posterior.sizes["draw"]
    measured = problem.observations.measured
    likelihood = np.empty((chains * n, problem.segments.n))
    predictive = []
    rng = np.random.default_rng(seed)
    keep = set(np.linspace(0, chains * n - 1, min(_PREDICTIVE_DRAWS, chains * n)).astype(int))
    wide = replace(problem, threads=max(problem.threads, 2))
    for begin in range(0, len(phi), 64):
        part = slice(begin, begin + 64)
        states = wide.predict(phi[part])
        residual = problem.observations.residual(states)
        likelihood[part] = log_density(residual, sigma[part], problem.noise, measured)
        predictive += [
            next_state_random(
                states[i - begin][..., problem.observations.columns], sigma[i], problem.noise, rng
            )
            for i in range(begin, min(begin + 64, len(phi)))
            if i in keep
        ]
    data = groups(trace)
    dims = ("transition", "step", "body", "state")
    coords = {dim: data["observed_data"][dim].values for dim in dims}
    result = {
        "posterior": _with_units(problem, posterior),
        "sample_stats": data["sample_stats"],
        "log_likelihood": xr.Dataset(
            {
                "next_state": (
                    ("chain", "draw", "transition"),
                    likelihood.reshape(chains, n, -1),
                )
            },
            {
                "chain": posterior["chain"],
                "draw": posterior["draw"],
                "transition": coords["transition"],
            },
        ),
        "posterior_predictive": xr.Dataset(
            {"next_state": (("chain", "draw", *dims), np.stack(predictive)[None])},
            {"chain": [0], "draw": np.arange(len(predictive)), **coords},
        ),
        "observed_data": xr.Dataset({"next_state": (dims, problem.observations.values)}, coords),
        "constant_data": data["constant_data"],
    }
    idata = from_groups(result, _origin(problem, seed) | {"method": method})
    return _checked(idata, asked)


def parameter_draws(problem: Problem, trace: Any) -> tuple[Array, Array]:
    """Draws as vectors: phi, shape (draw, p), and sigma, shape (draw, state)."""
    named = draws(trace)
    n = len(named["sigma"])
    phi = np.concatenate(
        [
            np.zeros((n, 0)),
            *(named[block.name].reshape(n, -1) for block in problem.layout.blocks),
        ],
        axis=1,
    )
    sigma = named["sigma"].reshape(n, -1)
    return phi, np.broadcast_to(sigma, (len(phi), len(problem.observations.columns)))


def _with_units(problem: Problem, posterior: xr.Dataset) -> xr.Dataset:
    posterior = posterior.copy()
    for block in problem.layout.blocks:
        posterior[block.name].attrs["units"] = block.unit
    posterior["sigma"].attrs["units"] = "the unit of each state dimension"
    return posterior


def _origin(problem: Problem, seed: int) -> dict[str, Any]:
    scene = problem.scene
    for body in scene.dynamic:
        new = [
            one.effect.name
            for one in problem.effects
            if one.body == body.name and one.effect.name not in body.effects
        ]
        scene = scene.with_effects(body.name, *new)
    return attributes(
        scene,
        effects=[[one.effect.name, one.body] for one in problem.effects],
        seed=seed,
        horizon=problem.horizon,
        substeps=problem.substeps,
        data_sha256=problem.history.data_sha256,
        versions=versions(),
    )


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a posterior depends on."""
    found = {"python": ".".join(map(str, sys.version_info[:3]))}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def _checked(idata: Any, asked: int | None) -> Any:
    """Store how far the chains have converged, and warn where that is not far enough."""
    found = list(_trouble(idata, asked))
    idata.attrs["warnings"] = json.dumps(found)
    for message in found:
        warnings.warn(message, ConvergenceWarning, stacklevel=4)
    return idata


def _trouble(idata: Any, asked: int | None) -> Iterator[str]:
    """What is wrong with the chains, and the cure."""
    sizes = group(idata, "posterior").sizes
    if asked is not None:
        idata.attrs["interrupted"] = 1
        yield (
            f"sampling was interrupted after {sizes['draw']} of {asked} draws a chain, which are"
            " kept; to go on, pass this posterior as start= to fit"
        )
    if sizes["draw"] < _LEAST_DRAWS:  # a mode alone
        return
    r_hat, ess = convergence(idata)
    worst_hat, worst_ess = max(r_hat, key=lambda k: r_hat[k]), min(ess, key=lambda k: ess[k])
    idata.attrs["max_rhat"], idata.attrs["min_ess"] = r_hat[worst_hat], ess[worst_ess]
    if not (r_hat[worst_hat] <= MAX_RHAT and ess[worst_ess] >= MIN_ESS):
        yield (
            f"the chains have not converged: R-hat is {r_hat[worst_hat]:.3f} for {worst_hat}"
            f" (want <= {MAX_RHAT}), effective sample size {ess[worst_ess]:.0f} for {worst_ess}"
            f" (want >= {MIN_ESS}); raise draws= or thin=, or go on with start= this posterior"
        )
