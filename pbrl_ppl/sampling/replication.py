"""One replication of a simulation-based calibration: draw from the prior, simulate, fit, rank."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.signal import lfilter

from pbrl_ppl.errors import FitError, PbrlWarning
from pbrl_ppl.history import History, from_segments
from pbrl_ppl.likelihood import (
    Problem,
    along_trajectories,
    in_pieces,
    simulated_trajectories,
    with_measurements,
)
from pbrl_ppl.parameters import by_prior
from pbrl_ppl.posterior import (
    PosteriorRecord,
    convergence,
    from_groups,
    group,
    parameter_draws,
    problem_of,
)
from pbrl_ppl.sampling.fitting import joined_at, sample
from pbrl_ppl.sampling.ranks import MOST_DRAWS, rank
from pbrl_ppl.state import STATE, Floats

#: One replication's numbers, by name, each a list over the parameters.
Record = dict[str, list[float]]


class Truth(NamedTuple):
    """True parameters of a replication, and what was simulated with them.

    Attributes
    ----------
    phi : ndarray
        Shape (p,), SI units.
    sigma : ndarray
        Shape (state,).
    values : ndarray
        Next states, shape (transition, H, body, state); measured states of trajectories, shape
        (trajectory, time, body, 6).
    """

    phi: Floats
    sigma: Floats
    values: Floats


def draw_truths(
    design: Problem, n: int, seed: int, colour: float = 0.0, *, most_redrawn: int = 50
) -> tuple[list[Truth], int]:
    """Draw parameters from the model's prior with PyMC, and what is measured with them.

    Next states are drawn by Eq. 13, and whole trajectories with process noise; simulations from the
    design's initial states have errors of measurement alone.

    Parameters
    ----------
    design : Problem
        Says the prior, initial states and actions.
    n : int
        How many; the first of more are the same.
    seed : int
        Of the draws.
    colour : float
        Correlation of neighbouring rows' errors, of simulations.
    most_redrawn : int
        Most draws from the prior for each one that the engine can simulate.

    Returns
    -------
    truths : list of Truth
        Such as the engine can simulate.
    redrawn : int
        How many others came up between them.

    Raises
    ------
    FitError
        If too few draws can be simulated.
    """
    from pbrl_ppl.model import build_model, prior_predictive_draws  # PyMC takes seconds to load

    model = build_model(design)
    whole = not design.likelihood.independent
    names = [*(block.name for block in design.layout.blocks), *design.noise_variables]
    names += [] if whole else ["next_state"]
    total = n
    while total <= most_redrawn * n:
        drawn = prior_predictive_draws(model, names, total, seed)
        phi = design.layout.to_vectors(drawn, total)
        sigma = np.hstack([drawn[name].reshape(total, -1) for name in design.noise_variables])
        sigma = np.broadcast_to(sigma, (total, len(design.noise_prior[0])))
        values = _trajectories(design, phi, sigma, seed, colour) if whole else drawn["next_state"]
        possible = np.asarray(np.isfinite(values).reshape(total, -1).all(axis=1))
        chosen = np.flatnonzero(possible)[:n]
        if len(chosen) == n:
            truths = [Truth(phi[i], sigma[i], values[i]) for i in chosen]
            return truths, int(chosen[-1]) + 1 - n
        total *= 2
    raise FitError(
        f"calibrate: {possible.sum()} of {len(possible)} draws from the prior can be simulated,"
        f" expected at least 1 in {most_redrawn}; make the scene's prior narrower"
    )


def _trajectories(design: Problem, phi: Floats, sigma: Floats, seed: int, colour: float) -> Floats:
    """Return measured states of whole trajectories, one set a draw; 0 where nothing is measured."""
    rngs = [np.random.default_rng([seed, i]) for i in range(len(phi))]
    if design.likelihood.simulated:
        every = np.repeat(design.data.smoothed_states[None], len(phi), axis=0)
        # without process noise; each piece of the design is a whole trajectory
        simulated_states = design.physics.one_world(phi, design.segments.start, design.inputs)
        every[:, design.segments.trajectory, 1:] = simulated_states
        columns = list(design.observations.columns)
        for states, noise, rng in zip(every, sigma, rngs, strict=True):
            states[..., columns] += noise * coloured((*states.shape[:3], len(columns)), colour, rng)
    else:
        drawn = zip(phi, sigma, rngs, strict=True)
        every = np.array([simulated_trajectories(design, *draw) for draw in drawn])
    measured = np.isfinite(design.data.history.dataset["observed"].to_numpy())
    return np.where(measured, every, 0.0)


def coloured(shape: tuple[int, ...], colour: float, rng: np.random.Generator) -> Floats:
    """Return standard normal errors that are autoregressive along the second axis, AR(1).

    Parameters
    ----------
    shape : tuple of int
        Of the errors: (trajectory, time, ...).
    colour : float
        Correlation of neighbouring rows' errors, at least 0 and below 1.
    rng : Generator
        Of the errors.
    """
    errors = rng.standard_normal(shape)
    errors[:, 1:] *= np.sqrt(1.0 - colour**2)
    return np.asarray(lfilter([1.0], [1.0, -colour], errors, axis=1))


def simulated(design: Problem, values: Floats) -> Problem:
    """Return the problem with other measurements in place of the design's.

    Of single transitions its history has one trajectory a segment, so that each starts from the
    design's state.

    Parameters
    ----------
    design : Problem
        Initial states, actions and which cells are measured.
    values : ndarray
        Next states, shape (transition, H, body, state), SI units; of whole trajectories all
        measured states, shape (trajectory, time, body, 6).
    """
    if not design.likelihood.independent:
        measured = np.isfinite(design.data.history.dataset["observed"].to_numpy())
        values = np.where(measured, values, np.nan)
        simulation = design.likelihood.simulated
        return (_remeasured if simulation else with_measurements)(design, values)
    segments, observations = design.segments, design.observations
    observed = np.full((*segments.actions.shape[:3], len(STATE)), np.nan)
    observed[..., list(observations.columns)] = np.where(observations.measured, values, np.nan)
    history = from_segments(design.scene, segments.start, segments.inputs, observed)
    return design.with_data(history=history)


def _remeasured(design: Problem, observed: Floats) -> Problem:
    """Return the problem of simulations with other measurements, its noise prior the design's."""
    dataset = design.data.history.dataset
    start = np.where(np.isfinite(observed), observed, dataset["start"])
    copies = {"observed": observed, "start": start}
    history = History(
        dataset.assign({key: dataset[key].copy(data=value) for key, value in copies.items()})
    )
    centre = np.array([prior.centre for prior in design.layout.priors])
    problem = along_trajectories(design.with_data(history=history, states=None), centre)
    problem = in_pieces(problem, design.data.horizon, problem.data.smoothed_states)
    return problem.with_likelihood(prior=design.likelihood.prior)


def replicate(
    design: Problem,
    truth: Truth,
    seed: int,
    settings: Mapping[str, Any],
    *,
    most_repeats: int = 2,
    longer: int = 4,
) -> Record:
    """Fit what was simulated and rank the truth among the posterior draws.

    Parameters
    ----------
    design : Problem
        As for :func:`simulated`, with a prior of sigma.
    truth : Truth
        From :func:`draw_truths`.
    seed : int
        Of the fit.
    settings : mapping
        Arguments of :func:`pbrl_ppl.fit`.
    most_repeats : int
        Most repetitions of a fit with fewer than 99 effective draws.
    longer : int
        The factor of its draws.

    Returns
    -------
    dict of str to list
        ``rank``, ``size``, ``truth``, ``ess`` and ``r_hat``, over the parameters.
    """
    # bodies that met in the simulation are simulated in one world
    problem = joined_at(simulated(design, truth.values), truth.phi[None], truth.sigma[None])
    settings = {"cores": 1, **settings}
    for again in range(most_repeats + 1):
        with warnings.catch_warnings():
            # convergence is in the result; the other warnings are about simulated data
            warnings.simplefilter("ignore", PbrlWarning)
            idata = sample(problem, seed=seed, **settings).posterior
        if PosteriorRecord.of(idata).interrupted:
            raise KeyboardInterrupt
        sizes = group(idata, "posterior").sizes
        likelihood = group(idata, "log_likelihood")["next_state"].sum("transition").values
        drawn = quantities(problem, *parameter_draws(problem, idata), likelihood.ravel())
        columns = drawn.T.reshape(-1, sizes["chain"], sizes["draw"])
        data = xr.DataArray(columns, {"name": list(labels(problem))}, ("name", "chain", "draw"))
        # of folded draws: a change between equal descriptions of a wheel is no failure to mix
        r_hat, ess = convergence(from_groups({"posterior": data.to_dataset("name")}, {}))
        if min(ess.values()) >= MOST_DRAWS or again == most_repeats:
            break
        settings |= {key: longer * settings[key] for key in ("draws", "tune")}
    problem = problem_of(idata, {attached.effect for attached in problem.physics.effects})
    residual = problem.residual(truth.phi)
    of_truth = problem.log_density(residual, truth.sigma, truth.phi).sum(keepdims=True)
    true = quantities(problem, truth.phi[None], truth.sigma[None], of_truth)[0]
    ranks, counts = zip(*map(rank, drawn.T, true, ess.values()), strict=True)
    found = {"truth": true.tolist(), "ess": list(ess.values()), "r_hat": list(r_hat.values())}
    return {"rank": list(ranks), "size": list(counts), **found}


def quantities(problem: Problem, phi: Floats, sigma: Floats, likelihood: Floats) -> Floats:
    """Return the ranked quantities: folded phi, sigma, log-likelihood, shape (draw, quantity)."""
    sigma = problem.likelihood.free(sigma)
    return np.hstack([by_prior(problem.layout, phi, equal_alone=True), sigma, likelihood[:, None]])


def labels(problem: Problem) -> tuple[str, ...]:
    """Return the names of the ranked quantities, such as ``mass[cart]``."""
    return (*problem.layout.labels, *problem.noise_labels, "log_likelihood")
