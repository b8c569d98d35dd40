"""Completion of a sampler's trace: likelihood, predictions, prior, record and warnings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from pbrl_ppl.effects import Structure
from pbrl_ppl.errors import (
    BoundWarning,
    ConvergenceWarning,
    LinearisationWarning,
    UninformedWarning,
    warn,
)
from pbrl_ppl.likelihood import (
    ACCELERATION,
    CONTACT,
    NEXT_STATE_DIMS,
    FilteredProblem,
    Problem,
    exponential,
    is_filtered,
    noise_law,
    smoothed,
)
from pbrl_ppl.modes import evidence_warning
from pbrl_ppl.parameters import Prior, by_prior, nearest, prior_draws
from pbrl_ppl.posterior.data import parameter_draws, placed, places, record_of, recording
from pbrl_ppl.posterior.identifiability import uninformed
from pbrl_ppl.posterior.record import (
    LinearisationCheck,
    ParameterPoint,
    PosteriorRecord,
    packed_mode,
)
from pbrl_ppl.posterior.store import SIZE, Idata, convergence, from_groups, group, groups
from pbrl_ppl.state import Floats, Ints

#: Attributes of a trace of weighted proposals: their Pareto k, and log-likelihoods of transitions,
#: shape (draw, transition), chains joined, which need not be evaluated again.
PARETO_K, LIKELIHOOD = "pareto_k", "log_likelihood"
#: Attributes of a trace that are fields of the posterior's record.
SAMPLED = ("configurations", PARETO_K, SIZE, "proposals", "log_evidence", "updates")
#: Pareto k of weights above which they miss a part of the posterior (Vehtari et al., 2024).
MAX_PARETO_K = 0.7
#: Largest R-hat and least effective sample size of reliable summaries (Vehtari et al., 2021).
MAX_RHAT, MIN_ESS = 1.01, 400
#: Standard deviation of the differences (nats) above which the linearisation does not hold:
#: draws weighted by exp(difference) would be worth exp(-4), 2 %, of their number.
MOST = 2.0
#: Category and text of a warning.
_Warned = tuple[type[Warning], str]


def complete(
    problem: Problem,
    trace: Idata,
    *,
    seed: int,
    method: str,
    asked: tuple[int, int] | None = None,
    mode: ParameterPoint | None = None,
) -> Idata:
    """Return a posterior: a trace with likelihood, predictions, prior and the record of the fit.

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
    mode : ParameterPoint, optional
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
    known = trace.attrs.get(LIKELIHOOD)
    likelihood, predictive = evaluate(problem, phi, sigma, rows.ravel(), rng, known)
    data = groups(trace)
    posterior = _with_units(problem, posterior)
    coords: dict[str, object] = {dim: posterior[dim] for dim in ("chain", "draw")}
    coords |= {dim: data["observed_data"][dim].values for dim in NEXT_STATE_DIMS}
    predicted = coords | {"draw": posterior["draw"][rows[0]]}
    likelihoods = likelihood.reshape(chains, n, -1)
    predictions = predictive.reshape(*rows.shape, *predictive.shape[1:])
    result = {
        "posterior": posterior,
        "sample_stats": data["sample_stats"],
        "log_likelihood": _next_state(("chain", "draw", "transition"), likelihoods, coords),
        "posterior_predictive": _next_state(
            ("chain", "draw", *NEXT_STATE_DIMS), predictions, predicted
        ),
        **prior_groups(problem, posterior, phi, sigma, seed),
        "observed_data": _next_state(NEXT_STATE_DIMS, problem.measured, coords),
        "constant_data": data["constant_data"].merge(recording(problem)),
    }
    sampled = {name: trace.attrs[name] for name in SAMPLED if name in trace.attrs}
    record = replace(record_of(problem, seed, method), **sampled)
    if mode is not None:
        stored = packed_mode(problem, mode, phi, sigma, likelihood.sum(axis=1))
        record = replace(record, mode=stored)
    if is_filtered(problem) and len(phi) > 1:
        record = replace(record, linearisation=linearisation(problem, phi, sigma))
    idata = placed(from_groups(result, record.attributes()), places(problem.segments))
    return checked(problem, record, idata, asked)


def _next_state(dims: tuple[str, ...], values: Floats, coords: Mapping[str, object]) -> xr.Dataset:
    return xr.Dataset({"next_state": (dims, values)}, {dim: coords[dim] for dim in dims})


def evaluate(
    problem: Problem,
    phi: Floats,
    sigma: Floats,
    rows: Sequence[int] | Ints,
    rng: np.random.Generator,
    known: Floats | None = None,
) -> tuple[Floats, Floats]:
    """Return log-likelihoods of the transitions at draws, and next states drawn from some of them.

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
    known : ndarray, optional
        Log-likelihoods where the sampler has them already.

    Returns
    -------
    likelihood : ndarray
        Shape (draw, transition).
    predictive : ndarray
        Shape (row, transition, H, body, state).
    """
    likelihood = np.empty((len(phi), problem.segments.n)) if known is None else known
    predictive = []
    parallel = problem.with_physics(threads=max(problem.physics.threads, 2))
    rows = np.asarray(rows, dtype=int)
    size = max(64, 20_000 // problem.segments.n)  # draws that are simulated at once
    for begin in range(0, len(phi), size):
        part = slice(begin, begin + size)
        if known is None:
            # a chain repeats a draw where it rejects a proposal
            different, which = np.unique(phi[part], axis=0, return_inverse=True)
            states = parallel.predict(different)[which.ravel()]
            residual = problem.observations.residual(states)
            likelihood[part] = problem.log_density(residual, sigma[part], phi[part])
        here = rows[(begin <= rows) & (rows < begin + size)]
        if not len(here):
            continue
        if known is None and len(parallel.physics.simulator.parts) == 1:
            drawn = states[here - begin]  # no parts that may meet in one world
        else:
            drawn = parallel.predict(phi[here], parallel.physics.one_world)
        for i, predicted in zip(here, drawn, strict=True):
            predictive.append(problem.next_states(predicted, sigma[i], rng, phi[i]))
    return likelihood, np.array(predictive)


def predictive_rows(chains: int, draws: int, cells: int) -> Ints:
    """Return draws to predict with: equally many of each chain, evenly spread, the last included.

    Parameters
    ----------
    chains, draws : int
        Of the posterior; draws of each chain.
    cells : int
        Numbers that one prediction has: of 50 to 200 draws there are two million in all.

    Returns
    -------
    ndarray
        Shape (chain, draw): indices of the draws, chains joined.
    """
    wanted = int(np.clip(2_000_000 // max(cells, 1), 50, 200))
    a_chain = min(draws, -(-wanted // chains))
    chosen = np.linspace(draws - 1, 0, a_chain).astype(int)[::-1]
    return np.asarray(draws * np.arange(chains)[:, None] + chosen)


def prior_groups(
    problem: Problem, posterior: xr.Dataset, phi: Floats, sigma: Floats, seed: int
) -> dict[str, xr.Dataset]:
    """Return the groups ``prior`` and ``log_prior``, as ArviZ looks for them.

    Both have the posterior's variables, chains and draws. Each wheel is described as in the
    posterior where its prior cannot tell its descriptions apart.

    Parameters
    ----------
    problem : Problem
        Says what the prior is.
    posterior : Dataset
        Its variables have the dims (chain, draw, ...).
    phi, sigma : ndarray
        Its draws as vectors, shapes (draw, p) and (draw, state).
    seed : int
        Of the draws from the prior.

    Returns
    -------
    dict of str to Dataset
        Empty for a library, and where which bodies a joint joins is unknown: their prior is not one
        of independent numbers.
    """
    layout = problem.layout
    if problem.library is not None or layout.discrete.any():
        return {}
    centre, spread = noise_law(problem)
    noise = [Prior("log_normal", mu=float(mu), sigma=spread) for mu in centre]
    steps = exponential(problem)[: len(centre)]
    scale = np.exp(centre) / np.log(2.0)
    # independent of the generator of the predictions
    rng = np.random.default_rng([seed, 1])
    drawn = prior_draws(layout.priors, rng, len(phi))
    noise_drawn = prior_draws(noise, rng, len(phi))
    noise_drawn = np.where(steps, rng.exponential(scale, noise_drawn.shape), noise_drawn)
    density = np.stack([prior.log_density(sigma[:, i]) for i, prior in enumerate(noise)], axis=1)
    density = np.where(steps, -np.log(scale) - sigma[:, : len(scale)] / scale, density)

    def shaped(like: xr.Dataset, of_phi: Floats, of_noise: Floats) -> xr.Dataset:
        named = problem.named(of_phi, of_noise).items()
        return xr.Dataset({x: like[x].copy(data=v.reshape(like[x].shape)) for x, v in named})

    return {
        "prior": shaped(posterior, nearest(layout, drawn, phi), noise_drawn),
        "log_prior": shaped(posterior.drop_attrs(), layout.log_prior(phi), density),
    }


def linearisation_errors(problem: FilteredProblem, phi: Floats, sigma: Floats) -> Floats:
    """Return log-likelihoods with the states smoothed at each draw, less the linearised ones.

    Parameters
    ----------
    problem : Problem
        Of whole trajectories.
    phi, sigma : ndarray
        Draws, shapes (draw, p) and (draw, parameter).

    Returns
    -------
    ndarray
        Of each trajectory, shape (draw, trajectory), nats. A constant does not matter to a
        posterior, a difference between draws does.
    """
    errors = np.zeros((len(phi), problem.data.history.n_trajectories))
    for row, point, noise in zip(errors, phi, sigma, strict=True):
        again, stored = (  # finite where the engine diverges
            np.maximum(other.log_density(other.residual(point), noise, point), -1e100)
            for other in (smoothed(problem, point, noise), problem)
        )
        np.add.at(row, problem.segments.trajectory, again - stored)
    return errors


def linearisation(problem: FilteredProblem, phi: Floats, sigma: Floats) -> LinearisationCheck:
    """Return a summary of :func:`linearisation_errors` at up to 16 of a posterior's draws.

    Parameters
    ----------
    problem : Problem
        Of whole trajectories.
    phi, sigma : ndarray
        All draws, at least two, shapes (draw, p) and (draw, parameter).
    """
    rows = np.unique(np.linspace(0, len(phi) - 1, 16).astype(int))
    errors = linearisation_errors(problem, phi[rows], sigma[rows])
    total = errors.sum(axis=1)
    sd, largest = float(total.std(ddof=1)), float(np.abs(total - total.mean()).max())
    return LinearisationCheck(len(rows), sd, largest, int(errors.std(axis=0).argmax()))


def checked(
    problem: Problem, record: PosteriorRecord, idata: Idata, asked: tuple[int, int] | None = None
) -> Idata:
    """Enter convergence and warnings in a posterior's record, and issue the warnings.

    Parameters
    ----------
    problem : Problem
        What was fitted.
    record : PosteriorRecord
        Of the fit.
    idata : InferenceData or DataTree
        The posterior, with the record in its attributes.
    asked : tuple of int, optional
        Draws a chain, and chains, that were asked for, where an interrupt left fewer.
    """
    sizes = group(idata, "posterior").sizes
    on = "resume this posterior"
    if problem.layout.discrete.any():  # fit does not go on over joints of unknown bodies
        on = "name the bodies that were found in the scene, fit that and resume it"
    weighted = record.importance_ess is not None
    more = f"raise draws, or {on}" if weighted else f"raise draws or thin, or {on}"
    if record.updates is not None:  # resampled draws are no chain that could go on
        more = "these draws were reweighted by update; refit all data"
    warnings: list[_Warned] = []
    if asked is not None:
        record = replace(record, interrupted=True)
        text = (
            f"sampling was interrupted after {sizes['draw']} of {asked[0]} draws in"
            f" {sizes['chain']} of {asked[1]} chains, which are kept; for more, {on}"
        )
        warnings.append((ConvergenceWarning, text))
    warnings += _of_approximations(record)
    if sizes["draw"] >= 4:  # there is an R-hat
        r_hat, ess = convergence(idata)
        worst = max(r_hat, key=r_hat.__getitem__), min(ess, key=ess.__getitem__)
        record = replace(record, max_rhat=r_hat[worst[0]], min_ess=ess[worst[1]])
        warnings += _unconverged(record, sizes["chain"], worst, more)
        if problem.library is None:  # what follows compares with Table 1
            warnings += _of_parameters(problem, idata)
    elif record.method != "map":  # a mode alone is one draw
        text = (
            f"with {sizes['draw']} draws a chain there is no R-hat (it takes at least"
            f" 4), so whether the chains have converged is not known; {more}"
        )
        warnings.append((ConvergenceWarning, text))
    replace(record, warnings=tuple(text for _, text in warnings)).write(idata)
    for kind, text in warnings:
        warn(text, kind)
    return idata


def _of_approximations(record: PosteriorRecord) -> Iterator[_Warned]:
    """Yield warnings on linearised states, importance weights and evidences."""
    linearisation, k = record.linearisation, record.pareto_k
    if linearisation is not None and not linearisation.sd <= MOST:
        text = (
            f"the likelihood is linearised where it does not hold: at {linearisation.draws} draws"
            f" with the states smoothed again it differs by {linearisation.sd:.2g} nats (standard"
            f" deviation; want <= {MOST:g}), most in trajectory {linearisation.trajectory}; cut"
            " that where bodies meet or wheels begin to slip, or compare with a fit of single"
            " transitions"
        )
        yield LinearisationWarning, text
    if k is not None and not k <= MAX_PARETO_K:
        text = (
            f"Pareto k of the proposals' weights is {k:.2g} (want <= {MAX_PARETO_K}): they may miss"
            " a part of the posterior; raise draws, or compare with the method 'smc'"
        )
        yield ConvergenceWarning, text
    if warning := evidence_warning(record.configurations or ()):
        yield ConvergenceWarning, warning


def _unconverged(
    record: PosteriorRecord, chains: int, worst: tuple[str, str], more: str
) -> Iterator[_Warned]:
    """Yield a warning on the chains; ``worst`` names the parameters of R-hat and ESS."""
    weighted, short = record.importance_ess is not None, []
    # rounded as in the message: 1.0104 passes; weighted draws are independent, and that of few
    # of them is often above the limit
    if not weighted and not round(record.max_rhat or 0.0, 3) <= MAX_RHAT:
        short.append(f"R-hat is {record.max_rhat:.3f} for {worst[0]} (want <= {MAX_RHAT})")
    if not (record.min_ess or 0.0) >= MIN_ESS:
        size = f"{np.floor(record.min_ess or 0.0):.0f} for {worst[1]} (want >= {MIN_ESS})"
        short.append(f"effective sample size is {size}")
    failed = "the draws are too few" if weighted else "the chains have not converged"
    if chains == 1:
        text = (
            "one chain alone cannot show whether it has converged: R-hat compares chains; raise"
            " chains to 4"
        )
        yield ConvergenceWarning, text
    elif short:
        yield ConvergenceWarning, f"{failed}: {', '.join(short)}; {more}"


def _of_parameters(problem: Problem, idata: Idata) -> Iterator[_Warned]:
    """Yield warnings on parameters at a bound, and on those that the data say nothing about.

    A parameter is at its bound if more than half of its draws are within 1 % of its support from
    there.
    """
    phi, _ = parameter_draws(problem, idata)
    ends = problem.layout.supports(phi)
    margin = 0.01 * (ends[1] - ends[0])
    watched = np.isfinite(margin).all(axis=0) & ~problem.layout.discrete
    for bound in ends:
        share = (np.abs(phi - bound) < margin).mean(axis=0)
        for i in np.flatnonzero(watched & (share > 0.5)):
            text = (
                f"{problem.layout.labels[i]} is at its bound,"
                f" {np.median(bound[:, i]):g}: {share[i]:.0%} of the draws are there; check the"
                " shape and the frame of the body; an effect that the model lacks may press too"
            )
            yield BoundWarning, text
    effects = {attached.effect for attached in problem.physics.effects}
    names = list(uninformed(idata, effects=effects))
    scene = problem.scene
    alone = len(scene.bodies) == 1 and not scene.walls
    if alone and not any(isinstance(effect.stage, Structure) for effect in effects):
        # no motion of a body that can touch nothing depends on its contacts
        names = [label for label in names if label.partition("[")[0] not in ("r", "mu_c")]
    if names:
        text = (
            f"the data say nothing about {', '.join(names)}: the posterior is the prior; record"
            " motions that depend on it, or give it in the scene (known = ...)"
        )
        yield UninformedWarning, text


def _folded(problem: Problem, trace: Idata, seed: int | None) -> xr.Dataset:
    """Return the posterior with each wheel in one of its equal descriptions, in all chains.

    Between descriptions that the prior can tell apart, the draws are shared out by the prior.
    """
    posterior = group(trace, "posterior").copy(deep=True)
    if problem.library is not None:  # the draws are the library's
        return posterior
    layout = problem.layout
    phi, _ = parameter_draws(problem, trace)
    if seed is not None:
        phi = by_prior(layout, phi, np.random.default_rng([seed, len(phi)]))
    for name, values in layout.to_dict(nearest(layout, phi)).items():
        posterior[name].values[:] = values.reshape(posterior[name].shape)
    return posterior


def _with_units(problem: Problem, posterior: xr.Dataset) -> xr.Dataset:
    units = {block.name: block.unit for block in problem.layout.blocks}
    units["sigma"] = "the unit of each state dimension"
    units |= dict.fromkeys((ACCELERATION, CONTACT), "m/s^2, of omega rad/s^2")
    for name in units.keys() & posterior.data_vars.keys():
        posterior[name].attrs["units"] = units[name]
    return posterior
