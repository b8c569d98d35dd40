"""A posterior brought up to date with new transitions, without a fit from scratch."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from pbrl_ppl.effects import Effect, catalogue
from pbrl_ppl.errors import RefitWarning
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import Problem, along_trajectories, single_transitions
from pbrl_ppl.model import build_model
from pbrl_ppl.posterior import (
    MIN_ESS,
    both_places,
    both_recordings,
    checked,
    complete,
    convergence,
    evaluate,
    from_groups,
    group,
    groups,
    parameter_draws,
    placed,
    predicted_rows,
    prior_groups,
    problem_of,
    recording,
    smoothed,
)
from pbrl_ppl.sampling.fitting import fit
from pbrl_ppl.sampling.rejuvenation import rejuvenate
from pbrl_ppl.sampling.update_checks import (
    as_recorded,
    check_engine,
    check_history,
    checked_log,
    judgement,
    more_noise,
)
from pbrl_ppl.sampling.updated_mode import climb_from

Array = NDArray[np.float64]

#: Group that keeps the draws as they were fitted, with their weights: resampled anew from them at
#: every update, draws lose much less than if each update resampled the last one's.
BASE = "before_updates"
#: Share of the draws that the weights are worth: below the first the draws are moved, below the
#: second all data are fitted anew.
_MOVE, _REFIT = 0.5, 0.05
#: Shape of the weights' tail above which they say nothing of their own error.
_HEAVY = 0.7
#: How many draws are moved at most.
_WALKERS = 1000
#: Dimensions of measured next states.
CELLS = ("transition", "step", "body", "state")


def update(
    idata: Any,
    history: History,
    *,
    effects: Iterable[Effect] = catalogue,
    seed: int = 0,
    progress: bool = True,
) -> Any:
    """Bring a posterior up to date with new transitions.

    The draws are weighted by the new transitions' likelihood and resampled within each chain, in
    their order, so that what is repeated shows as autocorrelation in ArviZ's figures (IBIS:
    Chopin, 2002). Only the new transitions are simulated. Weights add up over updates; when they
    are worth less than half of the draws, or fewer than 400 effective draws are left, at most 1000
    draws are kept and moved by Metropolis steps under all data. When the weights are worth next to
    nothing, or too uneven to be relied on, all data are fitted anew, with the defaults of fit.

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
        Of the resampling and the moves; the same seed gives the same posterior.
    progress : bool
        Whether to show the progress of a refit.

    Returns
    -------
    InferenceData or DataTree
        A whole posterior of all data, with the prior of the first fit, noise's included. In
        ``attrs``, ``updates`` lists (as JSON) for each update the transitions, what the weights
        were worth (``share``), ``pareto_k``, and what was done: ``reweighted``, ``moved`` or
        ``refitted``. The group ``before_updates`` holds the draws that the next update starts from.
        The stored mode is climbed to anew from the old one under all data; over a library or joints
        of unknown bodies, reweighted draws have none.

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
        If all data were fitted anew.
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
    done = checked_log(idata, history)
    history = as_recorded(idata, history)
    check_history(idata, history)
    problem = problem_of(idata, effects, history)
    check_engine(idata, problem)
    result: Any = partial(_updated, idata, problem, effects, seed, progress)
    while callable(result):  # a refit comes after the warning of it
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            result, how = result()
        for warning in caught:  # they are the caller's
            warnings.warn(warning.message, stacklevel=2)
    entry = {
        "transitions": problem.segments.n,
        "data_sha256": history.data_sha256,
        "before_sha256": str(idata.attrs["data_sha256"]),
        "seed": seed,
        **how,
    }
    if how["did"] != "refitted":
        climb_from(idata, result, effects)
    chained = f"{idata.attrs['data_sha256']}{history.data_sha256}"
    result.attrs["updates"] = json.dumps([*done, entry])
    result.attrs["data_sha256"] = hashlib.sha256(chained.encode()).hexdigest()
    return result


def _updated(
    idata: Any, problem: Problem, effects: tuple[Effect, ...], seed: int, progress: bool
) -> tuple[Any, dict[str, Any]]:
    """The posterior with the problem's transitions, or what fits it anew, and what was done."""
    rng = np.random.default_rng(seed)
    base = _base(idata, problem)
    names = [*(block.name for block in problem.layout.blocks), *problem.noise_variables]
    phi, sigma = parameter_draws(problem, from_groups({"posterior": base[names]}, {}))
    rows = base["row"].to_numpy()
    problem = problem.joined(phi[rows], sigma[rows])
    together = {"together": json.dumps(list(problem.physics.together))}
    likelihood, predictive = evaluate(problem, phi, sigma, rows, rng)
    data = _with_data(idata, problem)
    held_likelihood = base["log_likelihood"].to_numpy()
    base = _with_new(base, likelihood, predictive).assign_coords(data["observed_data"].coords)
    log_weights = base["log_weight"].to_numpy().ravel()
    weights, share, k = np.zeros(len(log_weights)), 0.0, np.inf
    if np.isfinite(log_weights.max()):
        weights, k = smoothed(log_weights)
        share = 1.0 / (len(weights) * float((weights**2).sum()))
    how = {"share": share, "pareto_k": k if np.isfinite(k) else None}
    heavy = np.isfinite(k) and k > _HEAVY
    # a chain that the data speak against sits where the others do not: then they must mix
    of_chains = weights.reshape(base.sizes["chain"], -1).sum(axis=1) * base.sizes["chain"]
    louder = more_noise(problem, data)
    if min(share, of_chains.min()) >= _MOVE and not heavy and not louder:
        result = _reweighted(problem, base, weights, data, idata.attrs | together, rng)
        if not _worn(base, result):
            return checked(problem, result), how | {"did": "reweighted"}
    # from here on all data are needed
    whole = problem_of(from_groups(groups(idata) | data, idata.attrs | together), effects)
    # sets of parameters, and which bodies a joint joins, cannot be moved by steps
    chosen_among = whole.library is not None or whole.layout.discrete.any()
    if share < _REFIT or heavy or chosen_among or louder:
        why = f"their tail has a shape k of {k:.2g}" if heavy else f"worth {share:.1%} of the draws"
        why = f"the new data leave the posterior so far behind ({why})"
        if louder:
            why = f"the new data have noise that the posterior lacks ({', '.join(louder)}), so"
            whole = along_trajectories(single_transitions(whole), np.median(phi, axis=0))
        warnings.warn(
            f"update: {why} that all of them are fitted anew, which takes as long as a fit;"
            f" {judgement(held_likelihood, likelihood)}",
            RefitWarning,
            stacklevel=2,
        )

        def refit() -> tuple[Any, dict[str, Any]]:
            chains = base.sizes["chain"]
            result = fit(build_model(whole), seed=seed, chains=chains, progress=progress)
            return placed(result, base.coords), how | {"did": "refitted"}

        return refit, how
    draws = min(base.sizes["draw"], -(-_WALKERS // base.sizes["chain"]))
    chosen = _systematic(weights, base.sizes["chain"] * draws, rng)
    phi, sigma, accepted = rejuvenate(whole, phi[chosen], sigma[chosen], rng)
    posterior = _walkers(whole, base[names].isel(draw=slice(draws)), phi, sigma)
    rate = np.full((base.sizes["chain"], draws), accepted)
    stats = xr.Dataset({"accept": (("chain", "draw"), rate)}, _chain_and_draw(posterior))
    trace = from_groups(data | {"posterior": posterior, "sample_stats": stats}, {})
    method = str(idata.attrs.get("method", "update"))
    result = complete(whole, trace, seed=seed, method=method)
    return placed(result, base.coords), how | {"did": "moved", "draws": draws}


def _worn(base: xr.Dataset, result: Any) -> bool:
    """Whether the effective sample size fell below its minimum, and was above it before."""
    if float(base["min_ess"]) < MIN_ESS:
        return False
    return min(convergence(result)[1].values()) < MIN_ESS


def _reweighted(
    problem: Problem,
    base: xr.Dataset,
    weights: Array,
    data: Mapping[str, xr.Dataset],
    attrs: Mapping[str, Any],
    rng: np.random.Generator,
) -> Any:
    """Equally weighted draws: those of the fit, repeated or left out within their chain."""
    chains, n = base.sizes["chain"], base.sizes["draw"]
    ancestor = np.stack(
        [_systematic(chain_weights, n, rng) for chain_weights in weights.reshape(chains, n)]
    )
    where = xr.DataArray(ancestor, dims=("chain", "draw"))
    drawn = base.isel(chain=xr.DataArray(np.arange(chains), dims="chain"), draw=where)
    drawn = drawn.assign_coords(chain=base["chain"], draw=base["draw"])
    own = ("log_likelihood", "log_weight", "next_state", "min_ess")
    posterior = _used(drawn[[str(v) for v in base.data_vars if v not in own]])
    vectors = parameter_draws(problem, from_groups({"posterior": posterior}, {}))
    rows = _systematic(weights[base["row"].to_numpy()] + 1e-300, base.sizes["row"], rng)
    predictive = base["next_state"].isel(row=rows).rename(row="draw")
    predictive = predictive.assign_coords(draw=np.arange(len(rows))).expand_dims(chain=[0])
    result = {
        **data,
        "posterior": posterior,
        "sample_stats": xr.Dataset({"ancestor": where}, _chain_and_draw(base)),
        "log_likelihood": _used(drawn[["log_likelihood"]].rename(log_likelihood="next_state")),
        "posterior_predictive": _used(predictive.to_dataset()),
        **prior_groups(problem, posterior, *vectors, int(attrs.get("seed", 0))),
        BASE: base,
    }
    return from_groups(result, {**attrs, "updates": "[]"})  # what they are is the caller's to say


def _chain_and_draw(data: xr.Dataset) -> dict[str, Any]:
    return {"chain": data["chain"].to_numpy(), "draw": data["draw"].to_numpy()}


def _used(data: xr.Dataset) -> xr.Dataset:
    """The dataset without coordinates that no variable has."""
    dims = {dim for variable in data.data_vars.values() for dim in variable.dims}
    return data.drop_vars([str(c) for c in data.coords if not set(data[c].dims) <= dims])


def _systematic(weights: Array, n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Systematic resampling: ``n`` places in increasing order, each about as often as it weighs."""
    ends = np.cumsum(weights)
    places = np.searchsorted(ends / ends[-1], (rng.uniform() + np.arange(n)) / n)
    return np.minimum(places, len(weights) - 1)


def _base(idata: Any, problem: Problem) -> xr.Dataset:
    """The draws of the last fit or move with their likelihoods, weights and predictions."""
    held = groups(idata)
    if BASE in held:
        return held[BASE]
    posterior = held["posterior"].transpose("chain", "draw", ...)
    chains, draws = posterior.sizes["chain"], posterior.sizes["draw"]
    likelihood = held["log_likelihood"]["next_state"].transpose("chain", "draw", "transition")
    foreseen = group(idata, "posterior_predictive")
    predictive = foreseen["next_state"].stack(row=("chain", "draw")).transpose("row", *CELLS)
    variables = {
        "min_ess": ((), float(idata.attrs.get("min_ess", 0.0))),
        "log_likelihood": (("chain", "draw", "transition"), likelihood.to_numpy()),
        "log_weight": (("chain", "draw"), np.zeros((chains, draws))),
        "next_state": (("row", *CELLS), predictive.to_numpy()),
    }
    return posterior.assign(variables).assign_coords(row=predicted_rows(posterior, foreseen))


def _with_new(base: xr.Dataset, likelihood: Array, predictive: Array) -> xr.Dataset:
    """The draws with likelihoods (draw, transition) of new transitions, and predictions of them."""
    shape = base.sizes["chain"], base.sizes["draw"], -1
    both = [base["log_likelihood"].to_numpy(), likelihood.reshape(shape)]
    predicted = [base["next_state"].to_numpy(), predictive]
    return base.drop_dims("transition").assign(
        log_likelihood=(("chain", "draw", "transition"), np.concatenate(both, axis=2)),
        log_weight=base["log_weight"] + likelihood.sum(axis=1).reshape(shape[:2]),
        next_state=(("row", *CELLS), np.concatenate(predicted, axis=1)),
    )


def _with_data(idata: Any, problem: Problem) -> dict[str, xr.Dataset]:
    """The stored data and, after them, the problem's."""
    segments, result = problem.segments, {}
    new = {
        "start": segments.start,
        "actions": problem.inputs,
        "next_state": problem.measured,
    }
    for name in ("observed_data", "constant_data"):
        held = group(idata, name)
        own = held[[key for key in held.data_vars if key in new]].transpose("transition", ...)
        total = own.sizes["transition"] + segments.n
        both = {
            str(key): (
                variable.dims,
                np.concatenate([variable.to_numpy(), new[str(key)]]),
                variable.attrs,
            )
            for key, variable in own.data_vars.items()
        }
        coords = dict(own.drop_dims("transition").coords) | both_places(own, segments)
        result[name] = xr.Dataset(both, coords | {"transition": np.arange(total)}, held.attrs)
    more = both_recordings(group(idata, "constant_data"), recording(problem))
    result["constant_data"] = result["constant_data"].merge(more)
    return result


def _walkers(problem: Problem, like: xr.Dataset, phi: Array, sigma: Array) -> xr.Dataset:
    """Vectors (draw, p) and (draw, state) as named draws, shaped like others."""
    named = problem.named(phi, sigma)
    return like.assign(
        {
            name: (like[name].dims, values.reshape(like[name].shape))
            for name, values in named.items()
        }
    )
