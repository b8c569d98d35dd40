"""A model's posterior: MAP, Laplace-preconditioned Metropolis, convergence and the whole record."""

from __future__ import annotations

import importlib.metadata
import os
import sys
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from pbrl_ppl.errors import ConvergenceWarning, FitError
from pbrl_ppl.likelihood import log_density, next_state_random
from pbrl_ppl.metropolis import AdaptiveMetropolis
from pbrl_ppl.model import Problem
from pbrl_ppl.modes import Mode, find_mode, inside
from pbrl_ppl.parameters import Prior
from pbrl_ppl.posterior import attributes, convergence, draws, from_groups, group, groups

Array = NDArray[np.float64]

#: What a posterior needs before its summaries can be relied on (Vehtari et al., 2021).
MAX_RHAT, MIN_ESS = 1.01, 400
_PREDICTIVE_DRAWS = 50
PACKAGES = ("pbrl_ppl", "pymc", "pytensor", "arviz", "pymunk", "numpy", "numba", "xarray")


def fit(
    model: pm.Model,
    *,
    seed: int = 0,
    draws: int = 1000,
    tune: int = 500,
    chains: int = 4,
    thin: int = 2,
    cores: int | None = None,
    start: Mode | None = None,
    progress: bool = True,
) -> Any:
    """Sample the posterior of a model of :func:`pbrl_ppl.physics_model`.

    Multi-start least squares finds the mode; its Laplace covariance preconditions a blocked
    multivariate Metropolis sampler, from over-dispersed starts.

    Parameters
    ----------
    model : pymc.Model
        As made by ``physics_model``.
    seed : int
        The same seed gives the same posterior.
    draws, tune, chains : int
        Draws kept and tuning draws of each chain, and chains.
    thin : int
        Metropolis steps a draw.
    cores : int, optional
        Processes; as many as there are processors by default, at most one a chain.
    start : Mode, optional
        A mode found before.
    progress : bool
        Whether to show PyMC's progress bar.

    Returns
    -------
    InferenceData or DataTree
        Posterior, sample_stats, log_likelihood, posterior_predictive, observed_data and
        constant_data, with units, and in ``attrs`` the scene, effects, versions, seed, the hash of
        the data and the convergence.

    Raises
    ------
    FitError
        If the model was not made by ``physics_model``.

    Warns
    -----
    ConvergenceWarning
        If an R-hat is over 1.01 or an effective sample size under 400.
    """
    problem = getattr(model, "problem", None)
    if not isinstance(problem, Problem):
        raise FitError("fit: this pm.Model was not made by physics_model; use pm.sample for others")
    mode = find_mode(problem, seed=seed) if start is None else start
    rng = np.random.default_rng(seed)
    blocks = _blocks(model, problem)
    with model:
        steps = [
            AdaptiveMetropolis(variables, mean=mean, covariance=covariance, thin=thin)
            for variables, (mean, covariance) in (
                (blocks["phi"], _laplace(problem, mode)),
                (blocks["sigma"], _sigma_laplace(problem, mode)),
            )
            if variables
        ]
        with warnings.catch_warnings():
            # convergence is checked and reported below, in this package's own words
            warnings.filterwarnings("ignore", message=".*fork.*", category=DeprecationWarning)
            try:
                trace = pm.sample(
                    draws=draws,
                    tune=tune,
                    chains=chains,
                    cores=min(chains, os.cpu_count() or 1) if cores is None else cores,
                    step=steps,
                    initvals=[_dispersed(problem, mode, rng) for _ in range(chains)],
                    random_seed=int(rng.integers(2**31)),
                    progressbar=progress,
                    quiet=not progress,
                    compute_convergence_checks=False,
                    discard_tuned_samples=True,
                )
            except ValueError as error:
                if "Not enough samples" in str(error):  # PyMC's answer to an early interrupt
                    raise KeyboardInterrupt from error
                raise
    done = group(trace, "posterior").sizes
    if done["draw"] < draws or done["chain"] < chains:
        # PyMC ends an interrupted run quietly, with the draws so far
        raise KeyboardInterrupt(f"sampling was interrupted after {done['draw']} of {draws} draws")
    return complete(problem, trace, seed=seed)


def _blocks(model: pm.Model, problem: Problem) -> dict[str, list[Any]]:
    """Physical parameters in one block, noise in another, in the layout's order."""
    names = [block.name for block in problem.layout.blocks]
    return {"phi": [model[name] for name in names], "sigma": [model["sigma"]]}


def unconstrain(prior: Prior, x: float) -> tuple[float, float]:
    """PyMC's unconstraining transform of a prior's variable at x, and its derivative."""
    if prior.family in ("log_normal", "half_normal"):
        return float(np.log(x)), 1.0 / x
    if prior.family == "truncated_normal":
        left, right = x - prior.lower, prior.upper - x
        return float(np.log(left / right)), 1.0 / left + 1.0 / right
    return x, 1.0


def _laplace(problem: Problem, mode: Mode) -> tuple[Array, Array]:
    """Mode and Laplace covariance in the sampler's space, no direction wider than a prior's."""
    pairs = [
        unconstrain(prior, x) for prior, x in zip(problem.layout.priors, mode.phi, strict=True)
    ]
    mean, scale = np.array(pairs).reshape(-1, 2).T
    covariance = scale[:, None] * mode.covariance * scale
    deviation = np.sqrt(np.diag(covariance))
    shrink = np.minimum(deviation, 2.0) / deviation
    return mean, shrink[:, None] * covariance * shrink + 1e-12 * np.eye(len(scale))


def _sigma_laplace(problem: Problem, mode: Mode) -> tuple[Array, Array]:
    """Mean and covariance of log sigma: the latter half the inverse of the measurements."""
    counts = problem.observations.measured.sum((0, 1, 2))
    mean = np.log(mode.sigma)
    if problem.scalar_sigma:
        counts, mean = counts.sum(keepdims=True), mean[:1]
    return mean, np.diag(0.5 / np.maximum(counts, 1))


def _dispersed(problem: Problem, mode: Mode, rng: np.random.Generator) -> dict[str, Array]:
    """A start about two posterior standard deviations from the mode."""
    factor = np.linalg.cholesky(mode.covariance + 1e-15 * np.eye(len(mode.phi)))
    priors = problem.layout.priors
    low = np.array([_quantile(prior, 0.02) for prior in priors])
    high = np.array([_quantile(prior, 0.98) for prior in priors])
    moved = mode.phi + 2.0 * factor @ rng.standard_normal(len(mode.phi))
    moved = np.where((moved < low) | (moved > high), mode.phi, moved)
    values = problem.layout.to_dict(inside(priors, moved))
    sigma = mode.sigma * np.exp(0.1 * rng.standard_normal(len(mode.sigma)))
    return values | {"sigma": sigma[0] if problem.scalar_sigma else sigma}


def _quantile(prior: Prior, q: float) -> float:
    """Quantile of a prior, by simulation: it only limits where chains begin."""
    return float(np.quantile(prior.sample(np.random.default_rng(0), 2000), q))


def complete(problem: Problem, trace: Any, *, seed: int) -> Any:
    """Add to a trace what the posterior file must hold: likelihood, predictions, units, origin."""
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
    idata = from_groups(result, _origin(problem, seed))
    return _checked(idata)


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


def _checked(idata: Any) -> Any:
    """Store the worst R-hat and ESS, and warn where they are not good enough."""
    r_hat, ess = convergence(idata)
    worst_hat, worst_ess = max(r_hat, key=lambda k: r_hat[k]), min(ess, key=lambda k: ess[k])
    idata.attrs["max_rhat"], idata.attrs["min_ess"] = r_hat[worst_hat], ess[worst_ess]
    if not (r_hat[worst_hat] <= MAX_RHAT and ess[worst_ess] >= MIN_ESS):
        warnings.warn(
            f"the chains have not converged: R-hat is {r_hat[worst_hat]:.3f} for {worst_hat}"
            f" (want <= {MAX_RHAT}), effective sample size {ess[worst_ess]:.0f} for {worst_ess}"
            f" (want >= {MIN_ESS}); raise draws= or thin=",
            ConvergenceWarning,
            stacklevel=4,
        )
    return idata
