"""The record of a fit: predictions, likelihoods, prior, units, origin and convergence."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pbrl_ppl.errors import (
    BoundWarning,
    ConvergenceWarning,
    LinearisationWarning,
    UninformedWarning,
)
from pbrl_ppl.likelihood import ACCELERATION, DRIFT, JOLT, Problem, TrajectoryLikelihood
from pbrl_ppl.modes import ATTRIBUTE, doubts
from pbrl_ppl.parameters import fold_draws, redescribed
from pbrl_ppl.posterior.identifiability import uninformed
from pbrl_ppl.posterior.linearisation import LINEARISATION, doubt, linearisation
from pbrl_ppl.posterior.origin import origin
from pbrl_ppl.posterior.places import placed, places
from pbrl_ppl.posterior.predictions import predictive_rows
from pbrl_ppl.posterior.prior_groups import prior_groups
from pbrl_ppl.posterior.recording import recording
from pbrl_ppl.posterior.store import (
    convergence,
    draws,
    from_groups,
    group,
    groups,
)
from pbrl_ppl.posterior.stored_mode import MODE, Point, mode_text

Array = NDArray[np.float64]

#: What a posterior needs before its summaries can be relied on (Vehtari et al., 2021).
MAX_RHAT, MIN_ESS = 1.01, 400
#: Draws are simulated in groups: of so many, or more if that makes fewer transitions.
_DRAWS_AT_ONCE, _TRANSITIONS_AT_ONCE = 64, 20_000
#: With fewer, nothing can be said of convergence.
_LEAST_DRAWS = 4
#: A parameter is stuck if this share of its draws is within this share of its support's end.
_STUCK, _NEAR = 0.5, 0.01


def complete(
    problem: Problem,
    trace: Any,
    *,
    seed: int,
    method: str,
    asked: tuple[int, int] | None = None,
    mode: Point | None = None,
) -> Any:
    """Add to a trace what the posterior file must hold: likelihood, predictions, prior, origin.

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
    asked : tuple of int, optional
        Draws a chain, and chains, that were asked for, where an interrupt left fewer.
    mode : Point, optional
        The posterior's mode, to be stored.

    Returns
    -------
    InferenceData or DataTree
        The posterior.
    """
    posterior = _folded(problem, trace, None if method == "map" else seed)
    phi, sigma = parameter_draws(problem, from_groups({"posterior": posterior}, {}))
    chains, n = posterior.sizes["chain"], posterior.sizes["draw"]
    rng = np.random.default_rng(seed)
    rows = predictive_rows(chains, n, problem.measured.size)
    likelihood, predictive = evaluate(problem, phi, sigma, rows.ravel(), rng)
    data = groups(trace)
    posterior = _with_units(problem, posterior)
    dims = ("transition", "step", "body", "state")
    coords = {dim: data["observed_data"][dim].values for dim in dims}
    result = {
        "posterior": posterior,
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
            {
                "next_state": (
                    ("chain", "draw", *dims),
                    predictive.reshape(*rows.shape, *predictive.shape[1:]),
                )
            },
            {"chain": posterior["chain"], "draw": posterior["draw"][rows[0]], **coords},
        ),
        **prior_groups(problem, posterior, phi, sigma, seed),
        "observed_data": xr.Dataset({"next_state": (dims, problem.measured)}, coords),
        "constant_data": data["constant_data"].merge(recording(problem)),
    }
    idata = from_groups(result, origin(problem, seed) | {"method": method})
    idata = placed(idata, places(problem.segments))
    if ATTRIBUTE in trace.attrs:
        idata.attrs[ATTRIBUTE] = trace.attrs[ATTRIBUTE]
    if mode is not None:
        idata.attrs[MODE] = mode_text(problem, mode, phi, sigma, likelihood.sum(axis=1))
    if isinstance(problem.likelihood, TrajectoryLikelihood) and len(phi) > 1:
        idata.attrs[LINEARISATION] = json.dumps(linearisation(problem, phi, sigma))
    return checked(problem, idata, asked)


def evaluate(
    problem: Problem, phi: Array, sigma: Array, rows: Any, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Log-likelihoods of the transitions at draws, and next states drawn from some of them.

    Parameters
    ----------
    problem : Problem
        Says which transitions.
    phi, sigma : ndarray
        Shapes (draw, p) and (draw, state).
    rows : sequence of int
        Draws to predict with, in increasing order.
    rng : Generator
        Of the predictions.

    Returns
    -------
    likelihood : ndarray
        Shape (draw, transition).
    predictive : ndarray
        Shape (row, transition, H, body, state).
    """
    likelihood = np.empty((len(phi), problem.segments.n))
    predictive = []
    wide = problem.with_physics(threads=max(problem.physics.threads, 2))
    rows = np.asarray(rows, dtype=int)
    size = max(_DRAWS_AT_ONCE, _TRANSITIONS_AT_ONCE // problem.segments.n)
    for begin in range(0, len(phi), size):
        part = slice(begin, begin + size)
        own, which = np.unique(phi[part], axis=0, return_inverse=True)  # a chain stays put at times
        states = wide.predict(own)[which.ravel()]
        residual = problem.observations.residual(states)
        likelihood[part] = problem.log_density(residual, sigma[part], phi[part])
        for i in rows[(begin <= rows) & (rows < begin + size)]:
            foreseen = wide.predict(phi[i], wide.one_world)
            predictive.append(problem.next_states(foreseen, sigma[i], rng, phi[i]))
    return likelihood, np.stack(predictive)


def parameter_draws(problem: Problem, trace: Any) -> tuple[Array, Array]:
    """Draws as vectors: phi, shape (draw, p), and sigma, shape (draw, state)."""
    named = draws(trace)
    n = len(next(iter(named.values())))
    phi = problem.layout.to_vectors(named, n)
    sigma = np.hstack([named[name].reshape(n, -1) for name in problem.noise_variables])
    return phi, np.broadcast_to(sigma, (len(phi), len(problem.noise_prior[0])))


def _folded(problem: Problem, trace: Any, seed: int | None) -> xr.Dataset:
    """The posterior with each wheel in one of the descriptions that its prior cannot tell apart.

    The same in all chains. Between those that it can, each draw is shared out by the prior.
    """
    posterior = group(trace, "posterior").copy(deep=True)
    if problem.library is not None:  # the draws are the library's own
        return posterior
    layout = problem.layout
    phi, _ = parameter_draws(problem, trace)
    if seed is not None:
        phi = redescribed(layout, phi, np.random.default_rng([seed, len(phi)]))
    folded = fold_draws(layout, dict(zip(layout.labels, phi.T, strict=True)))
    for block in layout.blocks:
        for i, owner in enumerate(block.owners):
            values = posterior[block.name].values
            values[..., i] = folded[f"{block.name}[{owner}]"].reshape(values.shape[:2])
    return posterior


def _with_units(problem: Problem, posterior: xr.Dataset) -> xr.Dataset:
    posterior = posterior.copy()
    for block in problem.layout.blocks:
        posterior[block.name].attrs["units"] = block.unit
    if "sigma" in posterior:  # it is not where the errors of measuring are all stated
        posterior["sigma"].attrs["units"] = "the unit of each state dimension"
    if isinstance(problem.likelihood, TrajectoryLikelihood):
        for name in {ACCELERATION, JOLT} & set(problem.noise_variables):
            posterior[name].attrs["units"] = "m/s^2, of omega rad/s^2"
        if DRIFT in problem.noise_variables:
            posterior[DRIFT].attrs["units"] = "the unit of each position"
    return posterior


def checked(problem: Problem, idata: Any, asked: tuple[int, int] | None = None) -> Any:
    """Store a posterior's warnings, and issue them."""
    found = list(_trouble(problem, idata, asked))
    idata.attrs["warnings"] = json.dumps([message for _, message in found])
    for kind, message in found:
        warnings.warn(message, kind, stacklevel=4)
    return idata


def _trouble(
    problem: Problem, idata: Any, asked: tuple[int, int] | None
) -> Iterator[tuple[type[Warning], str]]:
    """Category and message of each warning, with the cure."""
    on = "go on with resume= this posterior"
    if problem.layout.discrete.any():  # fit does not go on over joints of unknown bodies
        on = "name the bodies that were found in the scene, fit that and go on with resume="
    more = f"raise draws= or thin=, or {on}"
    if "updates" in idata.attrs:  # resampled draws are no chain that could go on
        more = "these draws were reweighted by update; fit all data anew"
    if LINEARISATION in idata.attrs:
        doubted = doubt(json.loads(str(idata.attrs[LINEARISATION])))
        if doubted is not None:
            yield LinearisationWarning, doubted
    sizes = group(idata, "posterior").sizes
    if asked is not None:
        idata.attrs["interrupted"] = 1
        yield (
            ConvergenceWarning,
            f"sampling was interrupted after {sizes['draw']} of {asked[0]} draws in"
            f" {sizes['chain']} of {asked[1]} chains, which are kept; for more, {on}",
        )
    rough = doubts(idata)
    if rough is not None:
        yield ConvergenceWarning, rough
    if sizes["draw"] < _LEAST_DRAWS:
        if idata.attrs.get("method") != "map":  # a mode alone is one draw
            yield (
                ConvergenceWarning,
                f"with {sizes['draw']} draws a chain there is no R-hat (it takes at least"
                f" {_LEAST_DRAWS}), so whether the chains have converged is not known; {more}",
            )
        return
    r_hat, ess = convergence(idata)
    worst_hat, worst_ess = max(r_hat, key=lambda k: r_hat[k]), min(ess, key=lambda k: ess[k])
    idata.attrs["max_rhat"], idata.attrs["min_ess"] = r_hat[worst_hat], ess[worst_ess]
    if sizes["chain"] == 1:
        yield (
            ConvergenceWarning,
            "one chain alone cannot show whether it has converged: R-hat compares chains; raise"
            " chains= to 4",
        )
    else:
        short = []
        # judged as it is written: 1.0104 is no failure to reach 1.01
        if not round(r_hat[worst_hat], 3) <= MAX_RHAT:
            short.append(f"R-hat is {r_hat[worst_hat]:.3f} for {worst_hat} (want <= {MAX_RHAT})")
        if not ess[worst_ess] >= MIN_ESS:
            size = f"{np.floor(ess[worst_ess]):.0f} for {worst_ess} (want >= {MIN_ESS})"
            short.append(f"effective sample size is {size}")
        if short:
            said = f"the chains have not converged: {', '.join(short)}; {more}"
            yield ConvergenceWarning, said
    if problem.library is not None:  # what follows compares with Table 1
        return
    phi, _ = parameter_draws(problem, idata)
    ends = problem.layout.supports(phi)
    margin = _NEAR * (ends[1] - ends[0])
    watched = np.isfinite(margin).all(axis=0) & ~problem.layout.discrete
    for bound in ends:
        share = (np.abs(phi - bound) < margin).mean(axis=0)
        for i in np.flatnonzero(watched & (share > _STUCK)):
            yield (
                BoundWarning,
                f"{problem.layout.labels[i]} is pressed against the end of its support,"
                f" {np.median(bound[:, i]):g}: {share[i]:.0%} of the draws are there; check the"
                " shape and the frame of the body; an effect that the model lacks may press too",
            )
    silent = uninformed(idata, effects={attached.effect for attached in problem.physics.effects})
    if silent:
        yield (
            UninformedWarning,
            f"the data say nothing about {', '.join(silent)}: the posterior is the prior; record"
            " motions that depend on it, or give it in the scene (known = ...)",
        )
