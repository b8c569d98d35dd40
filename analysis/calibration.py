"""Simulation-based calibration of the whole pipeline (Talts et al., 2018; Modrák et al., 2023).

    python analysis/calibration.py scene.toml train.csv --simulations 100 --jobs 2

Parameters are drawn from the model's prior, measurements are simulated with them from the history's
initial states, and the whole fit is run on these. If prior, engine, likelihood and sampler belong
together, the true values' ranks among the posterior draws are uniform: the script prints the tests,
and exits with 1 if one failed.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from rich.console import Console
from rich.progress import track
from scipy.signal import lfilter
from scipy.stats import binom, chisquare
from simulated_data import simulated_trajectories, with_measurements

import pbrl_ppl as pp
from pbrl_ppl import likelihood as likelihoods
from pbrl_ppl.errors import FitError, PbrlWarning
from pbrl_ppl.history import from_segments
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.model import build_model, problem_in
from pbrl_ppl.parameters import by_prior
from pbrl_ppl.posterior import convergence, from_groups, group
from pbrl_ppl.sampling import sample
from pbrl_ppl.sampling.fitting import joined_at
from pbrl_ppl.state import STATE, Floats

#: Draws among which a true value is ranked, so that there are 100 ranks.
MOST_DRAWS = 99
#: How often a right sampler fails the uniformity tests of one calibration; its coverages likewise.
FALSE_ALARM = 0.01


def calibrate(
    model: pm.Model,
    *,
    simulations: int = 100,
    seed: int = 1,
    run: Callable[..., Iterable[xr.Dataset]] = map,
    colour: float = 0.0,
    **settings: Any,
) -> xr.Dataset:
    """Return the ranks of true values among the draws of fits to simulated data.

    Initial states, actions and which cells are measured are the model's; what was measured counts
    only for the prior of sigma, which stays that of the recording. A wheel's equal descriptions are
    folded into one. The log-likelihood is ranked too: the parameters' ranks alone cannot see a fit
    that ignores its data.

    Parameters
    ----------
    model : pymc.Model
        As made by :func:`pbrl_ppl.physics_model`: the prior, and the design.
    simulations : int
        Fewer than 100 find gross faults alone.
    seed : int
        The same seed gives the same answer.
    run : callable
        Runs the fits: ``map``, or that of a pool of processes.
    colour : float
        Correlation of neighbouring rows' errors (AR(1)), of ``likelihood="simulation"``. That
        likelihood is divided by the errors' autocorrelation time, so that the parameters alone are
        judged.
    **settings
        Arguments of :func:`pbrl_ppl.fit`.

    Returns
    -------
    xarray.Dataset
        Over ``simulation`` and ``parameter``: ``rank``, ``size`` (draws ranked among), ``truth``,
        ``ess`` and ``r_hat``; over ``parameter``: ``judged``. ``attrs["redrawn"]`` counts draws
        from the prior that the engine could not simulate; the posterior excludes them too.
    """
    design = problem_in(model)
    if colour and not (likelihoods.is_simulated(design) and 0.0 < colour < 1.0):
        raise ValueError(f"colour is {colour}, expected below 1, of the likelihood 'simulation'")
    if design.layout.discrete.any():
        raise FitError("which bodies a joint joins is unknown, which has no rank")
    # taken from simulated data, it would not be the prior of sigma that they were drawn from
    median, spread = design.noise_prior
    design = design.with_likelihood(prior=(tuple(median.tolist()), spread))
    truths, redrawn = draw_truths(design, simulations, seed, colour)
    seeds = np.random.SeedSequence(seed).generate_state(simulations).tolist()
    results = run(partial(replicate, design, {"cores": 1, **settings}), truths, seeds)
    shown = track(results, "calibrating", simulations, console=Console(stderr=True))
    data = xr.concat(list(shown), "simulation").assign_attrs(redrawn=redrawn)
    judged = [not colour or name in design.layout.labels for name in data["parameter"].values]
    return data.assign(judged=("parameter", judged))


class Truth(NamedTuple):
    """True parameters, and what was simulated with them.

    Attributes
    ----------
    phi, sigma : ndarray
        Shapes (p,), SI units, and (noise parameter,).
    values : ndarray
        Next states, shape (transition, H, body, state); measured states of trajectories, shape
        (trajectory, time, body, 6).
    """

    phi: Floats
    sigma: Floats
    values: Floats


def draw_truths(design: Problem, n: int, seed: int, colour: float = 0.0) -> tuple[list[Truth], int]:
    """Return draws from the prior that the engine can simulate, and how many others came up.

    Next states are drawn by Eq. 13, and whole trajectories with process noise; simulations from the
    design's initial states have errors of measurement alone.
    """
    model, whole = build_model(design), not likelihoods.is_independent(design)
    names = [*(block.name for block in design.layout.blocks), *design.noise_variables]
    variables = [model[name] for name in (names if whole else [*names, "next_state"])]
    # compiling would take longer than drawing
    every = pm.draw(variables, draws=2 * n, random_seed=seed, mode="FAST_COMPILE")
    drawn = dict(zip(names, every, strict=False))
    phi = design.layout.to_vectors(drawn, 2 * n)
    sigma = np.hstack([drawn[name].reshape(2 * n, -1) for name in design.noise_variables])
    values = trajectories(design, phi, sigma, seed, colour) if whole else every[-1]
    possible = np.flatnonzero(np.isfinite(values).reshape(2 * n, -1).all(axis=1))
    if len(possible) < n:
        raise FitError(f"{len(possible)} of {2 * n} draws can be simulated; make priors narrower")
    return [Truth(phi[i], sigma[i], values[i]) for i in possible[:n]], int(possible[n - 1]) + 1 - n


def trajectories(design: Problem, phi: Floats, sigma: Floats, seed: int, colour: float) -> Floats:
    """Return measured states of whole trajectories, one set a draw; 0 where nothing is measured."""
    rngs = [np.random.default_rng([seed, i]) for i in range(len(phi))]
    if likelihoods.is_filtered(design):
        drawn = zip(phi, sigma, rngs, strict=True)
        every = np.array([simulated_trajectories(design, *draw) for draw in drawn])
    else:
        every = np.repeat(design.data.smoothed_states[None], len(phi), axis=0)
        # without process noise; each piece of the design is a whole trajectory
        states = design.physics.one_world(phi, design.segments.start, design.inputs)
        every[:, design.segments.trajectory, 1:] = states
        columns = list(design.observations.columns)
        for states, noise, rng in zip(every, sigma, rngs, strict=True):
            errors = rng.standard_normal((*states.shape[:3], len(columns)))
            errors[:, 1:] *= np.sqrt(1.0 - colour**2)
            states[..., columns] += noise * lfilter([1.0], [1.0, -colour], errors, axis=1)
    measured = np.isfinite(design.data.history.dataset["observed"].to_numpy())
    return np.where(measured, every, 0.0)


def simulated(design: Problem, values: Floats) -> Problem:
    """Return the problem with the values of a `Truth` in place of the design's measurements.

    Of single transitions its history has one trajectory a segment, so that each starts from the
    design's state.
    """
    if not likelihoods.is_independent(design):
        measured = np.isfinite(design.data.history.dataset["observed"].to_numpy())
        return with_measurements(design, np.where(measured, values, np.nan))
    segments, observations = design.segments, design.observations
    observed = np.full((*segments.actions.shape[:3], len(STATE)), np.nan)
    observed[..., list(observations.columns)] = np.where(observations.measured, values, np.nan)
    history = from_segments(design.scene, segments.start, segments.inputs, observed)
    return design.with_data(history=history)


def replicate(design: Problem, settings: dict[str, Any], truth: Truth, seed: int) -> xr.Dataset:
    """Fit what was simulated and rank the truth among the posterior draws."""
    # bodies that met in the simulation are simulated in one world
    problem = joined_at(simulated(design, truth.values), truth.phi[None], truth.sigma[None])
    with warnings.catch_warnings():
        # convergence is in the result; the other warnings are about simulated data
        warnings.simplefilter("ignore", PbrlWarning)
        fit = sample(problem, seed=seed, progress=False, **settings)
    log_likelihood = group(fit.posterior, "log_likelihood")["next_state"].sum("transition")
    drawn = quantities(problem, *fit.draws, log_likelihood.values.ravel())
    of_truth = fit.problem.log_density(fit.problem.residual(truth.phi), truth.sigma, truth.phi)
    true = quantities(problem, truth.phi[None], truth.sigma[None], of_truth.sum(keepdims=True))[0]
    names = [*problem.layout.labels, *problem.noise_labels, "log_likelihood"]
    columns = drawn.T.reshape(-1, *log_likelihood.shape)
    chains = xr.DataArray(columns, {"name": names}, ("name", "chain", "draw"))
    # of folded draws: a change between equal descriptions of a wheel is no failure to mix
    r_hat, ess = convergence(from_groups({"posterior": chains.to_dataset("name")}, {}))
    rows = pd.DataFrame({"truth": true, "ess": pd.Series(ess), "r_hat": pd.Series(r_hat)}, names)
    rows["rank"], rows["size"] = zip(*map(rank, drawn.T, true, rows["ess"]), strict=True)
    return rows.rename_axis("parameter").to_xarray()


def quantities(problem: Problem, phi: Floats, sigma: Floats, likelihood: Floats) -> Floats:
    """Return the ranked quantities: folded phi, sigma, log-likelihood, shape (draw, quantity)."""
    sigma = problem.likelihood.free(sigma)
    return np.hstack([by_prior(problem.layout, phi, equal_alone=True), sigma, likelihood[:, None]])


def rank(draws: Floats, truth: float, effective: float) -> tuple[int, int]:
    """Return the rank of a true value among draws, thinned to about independent ones.

    Returns
    -------
    rank, size : int
        How many of the kept draws are below the truth, and how many were kept: at most 99.

    Examples
    --------
    >>> rank(np.arange(1000.0), 250.0, 800.0)
    (25, 99)
    >>> rank(np.arange(1000.0), 250.0, 9.7)
    (2, 9)
    """
    size = int(np.clip(effective, 1, min(MOST_DRAWS, len(draws))))
    # the middles of equal parts
    kept = draws[((np.arange(size) + 0.5) * len(draws) / size).astype(int)]
    return int((kept < truth).sum()), size


def table(data: xr.Dataset) -> pd.DataFrame:
    """Return one row a parameter: chi-squared tests of uniform ranks, coverages, convergence.

    A right sampler passes all rows in at least 98 % of calibrations: there is 1 % of false alarms
    for the p-values, which are corrected for their number, and 1 % for coverages by
    their binomial limits.
    """
    n, m = data["rank"].shape
    # ranks among fewer draws than 99 are spread over (0, 1) evenly
    spread = np.random.default_rng(1).random((n, m))
    position = (data["rank"].values + spread) / (data["size"].values + 1)
    bins = next((b for b in (20, 10, 5, 4) if n >= 5 * b), 2)  # divisors of 100
    counts = [np.histogram(column, bins, (0.0, 1.0))[0] for column in position.T]
    rows = pd.DataFrame({"p": chisquare(counts, axis=1).pvalue}, index=data["parameter"].values)
    rows["p_corrected"] = np.minimum(m * rows["p"], 1.0)
    passed = rows["p_corrected"] >= FALSE_ALARM
    for level in (50, 90):
        rows[f"coverage_{level}"] = (abs(position - 0.5) < level / 200).mean(axis=0)
        limits = binom.interval(1.0 - FALSE_ALARM / (2 * m), n, level / 100)
        passed &= (n * rows[f"coverage_{level}"]).round().between(*limits)
    rows["ess"], rows["r_hat"] = data["ess"].values.min(axis=0), data["r_hat"].values.max(axis=0)
    return rows.assign(passed=passed, judged=data["judged"].values)


def main() -> None:
    """Calibrate the fit of a scene and a history, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene")
    parser.add_argument("history")
    counts = {"simulations": 100, "jobs": 2, "seed": 1, "draws": 1500}
    models = {"likelihood": "transitions", "colour": 0.0, "method": "importance"}
    for name, usual in (counts | models).items():
        parser.add_argument(f"--{name}", type=type(usual), default=usual)
    asked = vars(parser.parse_args())
    scene = pp.Scene.load(asked.pop("scene"))
    history = pp.History.load(asked.pop("history"), scene)
    model = pp.physics_model(scene, history, likelihood=asked.pop("likelihood"))
    # fresh processes: PyMC's threads do not survive a fork
    with ProcessPoolExecutor(asked.pop("jobs"), get_context("spawn")) as pool:
        rows = table(calibrate(model, run=pool.map, **asked))
    print(rows.to_string(float_format="{:.3g}".format))
    raise SystemExit(int(not rows.loc[rows["judged"], "passed"].all()))


if __name__ == "__main__":
    main()
