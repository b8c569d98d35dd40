"""Update of a posterior with new transitions: by weights of its draws, or by a fit of all data."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import xarray as xr
from scipy.special import logsumexp

from pbrl_ppl import posterior as files
from pbrl_ppl.effects import Effect, catalogue
from pbrl_ppl.errors import HistoryError, PosteriorError, RefitWarning, warn
from pbrl_ppl.history import History, check_start, measured_alone, unused_velocities
from pbrl_ppl.likelihood import (
    OutputErrorLikelihood,
    Problem,
    along_trajectories,
    declared_problem,
    is_filtered,
    observed_coordinates,
    single_transitions,
)
from pbrl_ppl.modes import systematic
from pbrl_ppl.posterior import Idata, PosteriorRecord, from_groups, group, groups, parameter_draws
from pbrl_ppl.sampling.fitting import DEFAULT, joined_at, sample
from pbrl_ppl.sampling.methods import data_of
from pbrl_ppl.state import STATE, Floats


def update(
    idata: Idata,
    history: History,
    *,
    effects: Iterable[Effect] = catalogue,
    seed: int = 0,
    progress: bool | Callable[[str], None] = True,
) -> Idata:
    """Return a posterior updated with new transitions.

    The draws are weighted by the new transitions' likelihood and resampled within each chain, in
    their order, so that what is repeated shows as autocorrelation in ArviZ's figures (IBIS:
    Chopin, 2002). Only the new transitions are simulated, and all of them for the predictions.
    Where the weights' Pareto k is above 0.7 or fewer than 400 effective draws are left, all data
    are refitted, with the defaults of fit: that takes as long as a fit. So they are where the
    new data have noise that the posterior lacks, and, by the posterior's own method, where the
    likelihood is of simulations, whose initial states are fitted with the parameters.

    Parameters
    ----------
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit` or an earlier update, or loaded from a file.
    history : History
        New transitions of the same bodies: they must not be in the posterior yet. Trajectories
        shorter than the posterior's horizon are left out.
    effects : iterable of Effect
        Where the names of the posterior's effects are looked up; add your own to the package's.
    seed : int
        Of the resampling or the refit; the same seed gives the same posterior.
    progress : bool or callable
        Whether to show the progress of a refit; or a callable, as of :func:`pbrl_ppl.fit`.

    Returns
    -------
    InferenceData or DataTree
        A whole posterior of all data, with the prior of the first fit, noise's included. In
        ``attrs``, ``updates`` lists (as JSON) for each update the transitions, the effective share
        of the draws that the weights leave (``share``; None without weights), ``pareto_k``, and
        what was done: ``reweighted`` or ``refitted``. The stored mode is climbed to again from the
        old one under all data; over a library or joints of unknown bodies, it is the most probable
        of reweighted draws.

    Raises
    ------
    PosteriorError
        If the posterior lacks what an update needs, or holds these data already.
    HistoryError
        If the history is of other bodies, another time step or other measured dimensions, or has
        no transition of the posterior's horizon.
    EffectError
        If an effect of the posterior is not among ``effects``.

    Warns
    -----
    RefitWarning
        If all data were refitted.
    ConvergenceWarning, BoundWarning, UninformedWarning
        As for :func:`pbrl_ppl.fit`.

    Examples
    --------
    ::

        idata = pp.load_posterior("monday.nc")
        idata = pp.update(idata, pp.History.load("tuesday.csv", scene))
        json.loads(idata.attrs["updates"])[-1]["did"]  # 'reweighted'
    """
    effects = tuple(effects)
    record = _check_posterior(idata, history)
    history = _as_recorded(idata, history)
    _check_history(idata, record, history)
    entry: dict[str, object] = {"seed": seed, "did": "refitted"}
    chains, method, places, advice = group(idata, "posterior").sizes["chain"], DEFAULT, None, ""
    if record.likelihood == OutputErrorLikelihood.name:
        _check_engine(idata, effects)
        entry |= {"transitions": history.n_transitions, "share": None, "pareto_k": None}
        why = "initial states of simulations are fitted with the parameters, so that all data"
        whole = _simulated(idata, record, history, effects)
        method = record.method
    else:
        new = _weighted(idata, record, history, effects)
        entry |= {"transitions": new.likelihood.shape[1], "share": new.share}
        entry["pareto_k"] = new.k if np.isfinite(new.k) else None
        result = _reweighted(idata, record, new, seed)
        if result is not None:
            return _entered(result, record, history, entry | {"did": "reweighted"})
        why, whole = new.why_not, new.problem
        advice = "; look whether they are of the same bodies, under the same conditions"
        places = new.data["observed_data"].coords
    warn(f"update: {why} are refitted, which takes as long as a fit{advice}", RefitWarning)
    fitted = sample(whole, seed=seed, progress=progress, method=method, chains=chains)
    result = fitted.posterior
    if places is not None:
        result = files.placed(result, places)
    return _entered(result, record, history, entry)


def _entered(
    result: Idata, record: PosteriorRecord, history: History, entry: dict[str, object]
) -> Idata:
    """Return an updated posterior, with the update entered in its record."""
    hashes = {"data_sha256": history.data_sha256, "before_sha256": record.data_sha256}
    chained = f"{record.data_sha256}{history.data_sha256}"
    updated = replace(
        PosteriorRecord.of(result),
        updates=(*(record.updates or ()), {**entry, **hashes}),
        data_sha256=hashlib.sha256(chained.encode()).hexdigest(),
    )
    updated.write(result)
    return result


def _simulated(
    idata: Idata, record: PosteriorRecord, history: History, effects: tuple[Effect, ...]
) -> Problem:
    """Return the problem of simulations of a posterior's data and new ones, not yet fitted."""
    earlier = files.recorded(record.scene, group(idata, "constant_data"))
    rows, new = earlier.to_dataframe(), history.to_dataframe()
    for part, first in ((rows, 0), (new, earlier.n_trajectories)):
        part["trajectory"] = first + pd.factorize(part["trajectory"])[0]
    both = History.from_dataframe(pd.concat([rows, new]), record.scene)
    problem = declared_problem(record.physics(effects), both, kind=OutputErrorLikelihood.name)
    return problem.with_likelihood(prior=record.sigma_prior)


def _check_posterior(idata: Idata, history: History) -> PosteriorRecord:
    """Return the record of a posterior; refuse posteriors and data that an update cannot use."""
    for name in ("log_likelihood", "posterior_predictive", "observed_data", "constant_data"):
        group(idata, name)
    record = PosteriorRecord.of(idata)
    names = ("data_sha256", "before_sha256")
    known = {entry[name] for entry in record.updates or () for name in names}
    if history.data_sha256 in known | {record.data_sha256}:
        raise PosteriorError(
            "update: these data are in the posterior already, and would count twice; pass only"
            " what was recorded since"
        )
    return record


def _as_recorded(idata: Idata, history: History) -> History:
    """Return the history without the unused velocities that the posterior leaves out."""
    constants = group(idata, "constant_data")
    if "recorded_observed" not in constants:
        return history
    recorded = constants["recorded_observed"].to_numpy()
    left_out = ~np.isfinite(recorded).any(axis=(0, 1))
    unused = [
        velocity
        for velocity in unused_velocities(history)
        if left_out[history.bodies.index(velocity.body), STATE.index(velocity.state)]
    ]
    return measured_alone(history, unused)


def _check_history(idata: Idata, record: PosteriorRecord, history: History) -> None:
    """Refuse a history of other bodies, dimensions or time step, or without usable start."""
    scene, measured = record.scene, record.measured
    names = tuple(body.name for body in scene.moving)
    if history.bodies != names:
        raise HistoryError(
            f"update: the history is of {', '.join(history.bodies)}, the posterior of"
            f" {', '.join(names)}; load it with the posterior's scene"
        )
    step = float(history.dataset.attrs["time_step"])
    if not np.isclose(step, scene.time_step, atol=0.0):
        raise HistoryError(
            f"update: the history has a row each {step:g} s, the posterior's each"
            f" {scene.time_step:g} s; load it with the posterior's scene"
        )
    if "smoothed" not in group(idata, "constant_data"):
        check_start(history, scene)
    segments = history.segments(record.horizon)
    extra = [
        name
        for i, name in enumerate(STATE)
        if name not in measured and np.isfinite(segments.observed[..., i]).any()
    ]
    if extra:
        raise HistoryError(
            f"update: the history measures {', '.join(extra)}, of which the posterior knows no"
            f" noise, only of {', '.join(measured)}; leave those columns empty, or refit all"
            " data"
        )


def _check_engine(idata: Idata, effects: tuple[Effect, ...]) -> None:
    """Refuse a posterior whose stored likelihoods of the first draw this engine does not give."""
    problem = files.problem_of(idata, effects)
    phi, sigma = parameter_draws(problem, idata)
    now = problem.log_density(problem.residual(phi[0]), sigma[0], phi[0])
    then = group(idata, "log_likelihood")["next_state"].isel(chain=0, draw=0).to_numpy()
    off = float(np.median(np.abs(now - then)))
    if not off < 0.01:  # nats
        raise PosteriorError(
            f"update: the posterior's likelihoods are not what this engine gives (half of them are"
            f" off by {off:.2g} or more): it was made with other effects or another"
            " version; refit all data"
        )


@dataclass(frozen=True, eq=False)
class _Weighted:
    """Draws of a posterior, weighted by the likelihood of new transitions.

    Parameters
    ----------
    problem : Problem
        Of all data.
    data : dict of str to Dataset
        Observed and constant data, the new ones included.
    earlier, likelihood : ndarray
        Log-likelihoods of earlier and of new transitions, shape (draw, transition).
    weights : ndarray
        Shape (draw,), adding up to 1.
    k : float
        Pareto k of the weights.
    more_noise : list of str
        Noise parameters that the data have and the posterior has not.
    """

    problem: Problem
    data: dict[str, xr.Dataset]
    earlier: Floats
    likelihood: Floats
    weights: Floats
    k: float
    more_noise: list[str]

    @property
    def share(self) -> float:
        """Effective share of the draws that the weights leave."""
        square = float((self.weights**2).sum())
        return 1.0 / (len(self.weights) * square) if square else 0.0

    @property
    def heavy(self) -> bool:
        """Whether the tail of the weights is too heavy for them to be used."""
        return bool(np.isfinite(self.k) and self.k > files.MAX_PARETO_K)

    @property
    def why_not(self) -> str:
        """Why all data are refitted, as the beginning of a sentence about them."""
        if self.more_noise:
            names = ", ".join(self.more_noise)
            return f"the new data have noise that the posterior lacks ({names}), so that all data"
        reason = f"fewer than {files.MIN_ESS} effective draws are left of {len(self.weights)}"
        if self.heavy:
            reason = f"the draws' weights have a Pareto k of {self.k:.2g}"
        return f"the new data leave the posterior so far behind ({reason}) that all data"


def _weighted(
    idata: Idata, record: PosteriorRecord, history: History, effects: tuple[Effect, ...]
) -> _Weighted:
    """Weight the draws by the new transitions of a history."""
    _check_engine(idata, effects)
    problem = files.problem_of(idata, effects, history)
    phi, sigma = parameter_draws(problem, idata)
    problem = joined_at(problem, phi, sigma)
    likelihood, _ = files.evaluate(problem, phi, sigma, (), np.random.default_rng(0))
    log_weights = likelihood.sum(axis=1)
    weights, k = np.zeros(len(phi)), np.inf
    if np.isfinite(log_weights.max()):
        weights, k = files.smoothed(log_weights)
    data = _with_data(idata, problem)
    changed = replace(record, together=tuple(problem.physics.together))
    if is_filtered(problem):
        history = files.recorded(problem.scene, data["constant_data"])
        changed = replace(changed, cells=observed_coordinates(problem.scene, history))
    more_noise = [label for label in changed.noise_labels if label not in problem.noise_labels]
    both = from_groups(groups(idata) | data, dict(idata.attrs) | changed.attributes())
    earlier = group(idata, "log_likelihood")["next_state"].transpose("chain", "draw", "transition")
    whole = files.problem_of(both, effects)
    if more_noise:
        whole = along_trajectories(single_transitions(whole), np.median(phi, axis=0))
    known = earlier.to_numpy().reshape(len(phi), -1)
    return _Weighted(whole, data, known, likelihood, weights, k, more_noise)


def _reweighted(idata: Idata, record: PosteriorRecord, new: _Weighted, seed: int) -> Idata | None:
    """Return a posterior of resampled draws, or None where the weights are not good enough."""
    posterior = group(idata, "posterior").transpose("chain", "draw", ...)
    chains, n = posterior.sizes["chain"], posterior.sizes["draw"]
    if new.more_noise or new.heavy or new.share * chains * n < files.MIN_ESS:
        return None
    rng = np.random.default_rng(seed)
    # a chain without any weight is kept: then R-hat and effective sample size tell
    weights = new.weights.reshape(chains, n) + 1e-300
    ancestor = np.stack([systematic(of_chain, n, rng) for of_chain in weights])
    where = xr.DataArray(ancestor, dims=("chain", "draw"))
    drawn = posterior.isel(chain=xr.DataArray(np.arange(chains), dims="chain"), draw=where)
    labels = {"chain": posterior["chain"], "draw": posterior["draw"]}
    likelihood = np.concatenate([new.earlier, new.likelihood], axis=1)
    attributes = files.stored_fields(idata, files.SAMPLED) | {
        files.LIKELIHOOD: likelihood[(n * np.arange(chains)[:, None] + ancestor).ravel()],
        "updates": record.updates or (),
    }
    if "log_evidence" in attributes:
        mean_weight = logsumexp(new.likelihood.sum(axis=1)) - np.log(chains * n)
        attributes["log_evidence"] += float(mean_weight)
    if files.SIZE in attributes:  # the fit's draws were weighted before
        attributes[files.SIZE] *= new.share
    trace = from_groups(
        {
            **new.data,
            "posterior": drawn.assign_coords(labels),
            "sample_stats": xr.Dataset({"ancestor": where}, labels),
        },
        attributes,
    )
    if not min(files.convergence(trace)[1].values()) >= files.MIN_ESS:
        return None
    result = files.complete(new.problem, trace, seed=seed, method=record.method)
    sums = group(result, "log_likelihood")["next_state"].sum("transition")
    choice = None
    if new.problem.library is not None:
        choice = files.draws(result)["library_index"].astype(np.intp)
    mode = files.updated_mode(
        new.problem,
        files.stored_mode(new.problem, idata),
        (*parameter_draws(new.problem, result), choice),
        sums.transpose("chain", "draw").to_numpy().ravel(),
    )
    replace(PosteriorRecord.of(result), mode=mode).write(result)
    return files.placed(result, new.data["observed_data"].coords)


def _with_data(idata: Idata, problem: Problem) -> dict[str, xr.Dataset]:
    """Return the stored data and, after them, the problem's."""
    new, result = data_of(problem).drop_vars("transition"), {}
    for name in ("observed_data", "constant_data"):
        earlier = group(idata, name)
        old = earlier[[key for key in new.data_vars if key in earlier]]
        places = files.both_places(old, problem.segments)
        parts = (old.drop_vars(["transition", *places]), new[list(old.data_vars)])
        both = xr.concat(parts, "transition", combine_attrs="override").transpose("transition", ...)
        numbers = np.arange(both.sizes["transition"])
        result[name] = both.assign_coords(places | {"transition": numbers})
    more = files.both_recordings(group(idata, "constant_data"), files.recording(problem))
    result["constant_data"] = result["constant_data"].merge(more)
    return result
