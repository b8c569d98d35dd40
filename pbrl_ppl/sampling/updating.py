"""Update of a posterior with new transitions, without a fit from scratch."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from pbrl_ppl import posterior as files
from pbrl_ppl.effects import Effect, catalogue
from pbrl_ppl.errors import RefitWarning
from pbrl_ppl.history import History
from pbrl_ppl.likelihood import (
    OutputErrorLikelihood,
    Problem,
    along_trajectories,
    declared_problem,
    single_transitions,
)
from pbrl_ppl.model import build_model
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior import (
    CELLS,
    MIN_ESS,
    PosteriorRecord,
    from_groups,
    group,
    groups,
    parameter_draws,
    problem_of,
)
from pbrl_ppl.sampling.ensemble import systematic
from pbrl_ppl.sampling.fitting import fit
from pbrl_ppl.sampling.rejuvenation import rejuvenate
from pbrl_ppl.sampling.update_checks import (
    as_recorded,
    check_engine,
    check_history,
    check_posterior,
    judgement,
)
from pbrl_ppl.state import Floats

#: Group of the fitted draws with their weights. Each update resamples these: resampling the draws
#: of the last update would lose more of them.
BASE = "before_updates"
#: Effective share of the weighted draws below which they are moved, and below which all data are
#: fitted anew.
_MOVE, _REFIT = 0.5, 0.05
#: Pareto k of the weights above which all data are fitted anew.
_HEAVY = files.MAX_PARETO_K
#: Most draws that are moved.
_WALKERS = 1000


def update(
    idata: Any,
    history: History,
    *,
    effects: Iterable[Effect] = catalogue,
    seed: int = 0,
    progress: bool = True,
) -> Any:
    """Return a posterior updated with new transitions.

    The draws are weighted by the new transitions' likelihood and resampled within each chain, in
    their order, so that what is repeated shows as autocorrelation in ArviZ's figures (IBIS:
    Chopin, 2002). Only the new transitions are simulated. Weights add up over updates; when they
    are worth less than half of the draws, or fewer than 400 effective draws are left, at most 1000
    draws are kept and moved by Metropolis steps under all data. When the weights are worth less
    than 5 % of the draws, or their Pareto k is above 0.7, all data are fitted anew, with the
    defaults of fit: that takes as long as a fit. All data are fitted anew always, by the
    posterior's own method, where the likelihood is of simulations, whose start states are fitted
    with the parameters.

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
        were worth (``share``; None without weights), ``pareto_k``, and what was done:
        ``reweighted``, ``moved`` or ``refitted``. The group ``before_updates`` holds the draws that
        the next update starts from. The stored mode is climbed to anew from the old one under all
        data; over a library or joints of unknown bodies, it is the most probable of reweighted
        draws.

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
    record = check_posterior(idata, history)
    history = as_recorded(idata, history)
    check_history(idata, record, history)
    if record.likelihood == OutputErrorLikelihood.name:
        check_engine(idata, problem_of(idata, effects))
        warnings.warn(
            "update: start states of simulations are fitted with the parameters, so that all data"
            " are fitted anew, which takes as long as a fit",
            RefitWarning,
            stacklevel=2,
        )
        model = build_model(_simulated(idata, record, history, effects))
        chains = group(idata, "posterior").sizes["chain"]
        with _relayed():
            result = fit(model, method=record.method, seed=seed, chains=chains, progress=progress)
        entry = {"transitions": history.n_transitions, "share": None, "pareto_k": None}
        return _entered(result, record, history, {**entry, "seed": seed, "did": "refitted"})
    problem = problem_of(idata, effects, history)
    check_engine(idata, problem)
    rng = np.random.default_rng(seed)
    new = _weighted(idata, record, problem, rng)
    how: dict[str, Any] = {"share": new.share, "pareto_k": new.k if np.isfinite(new.k) else None}
    with _relayed():
        result, whole, did = _without_fit(idata, new, effects, seed, rng)
    if result is None:
        why = f"their tail has a shape k of {new.k:.2g}"
        if not new.heavy:
            why = f"worth {new.share:.1%} of the draws"
        why = f"the new data leave the posterior so far behind ({why})"
        if new.more_noise:
            names = ", ".join(new.more_noise)
            why = f"the new data have noise that the posterior lacks ({names}), so"
            whole = along_trajectories(single_transitions(whole), np.median(new.phi, axis=0))
        warnings.warn(
            f"update: {why} that all of them are fitted anew, which takes as long as a fit;"
            f" {judgement(new.earlier, new.likelihood)}",
            RefitWarning,
            stacklevel=2,
        )
        with _relayed():
            chains = new.base.sizes["chain"]
            result = fit(build_model(whole), seed=seed, chains=chains, progress=progress)
        result = files.placed(result, new.base.coords)
        did = {"did": "refitted"}
    if did["did"] != "refitted":
        mode = _mode(idata, result, effects)
        result.attrs.update(replace(PosteriorRecord.of(result), mode=mode).attributes())
    entry = {"transitions": problem.segments.n, "seed": seed, **how, **did}
    return _entered(result, record, history, entry)


def _entered(result: Any, record: PosteriorRecord, history: History, entry: dict[str, Any]) -> Any:
    """Return an updated posterior, with the update entered in its record."""
    hashes = {"data_sha256": history.data_sha256, "before_sha256": record.data_sha256}
    chained = f"{record.data_sha256}{history.data_sha256}"
    updated = replace(
        PosteriorRecord.of(result),
        updates=(*(record.updates or ()), {**entry, **hashes}),
        data_sha256=hashlib.sha256(chained.encode()).hexdigest(),
    )
    result.attrs.update(updated.attributes())
    return result


def _simulated(
    idata: Any, record: PosteriorRecord, history: History, effects: tuple[Effect, ...]
) -> Problem:
    """Return the problem of simulations of a posterior's data and new ones, not yet fitted."""
    held = files.recorded(record.scene, group(idata, "constant_data"))
    rows, new = held.to_dataframe(), history.to_dataframe()
    for each, first in ((rows, 0), (new, held.n_trajectories)):
        each["trajectory"] = first + pd.factorize(each["trajectory"])[0]
    attached = record.attached(effects)
    physics = Physics(record.scene, attached, substeps=record.substeps, together=record.together)
    both = History.from_dataframe(pd.concat([rows, new]), record.scene)
    problem = declared_problem(physics, both, kind=OutputErrorLikelihood.name)
    return problem.with_likelihood(prior=record.sigma_prior)


@contextmanager
def _relayed() -> Iterator[None]:
    """Issue the warnings of the block again, as the caller's of the function that holds it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    for warning in caught:
        warnings.warn(warning.message, stacklevel=4)


@dataclass(frozen=True, eq=False)
class _Weighted:
    """Draws of the last fit, weighted by the likelihood of all transitions since.

    Parameters
    ----------
    problem : Problem
        Of the new transitions alone.
    base : Dataset
        The draws, their likelihoods and predictions, the new transitions' included.
    phi, sigma : ndarray
        The draws as vectors, shapes (draw, p) and (draw, state).
    data : dict of str to Dataset
        Observed and constant data, the new ones included.
    attributes : dict
        Attributes of the posterior of all data.
    earlier, likelihood : ndarray
        Log-likelihoods of earlier and of new transitions, the draws first.
    weights : ndarray
        Shape (draw,), adding up to 1.
    share, k : float
        Share of the draws that the weights are worth, and the shape of their tail.
    more_noise : list of str
        Noise parameters that the data have and the posterior has not.
    """

    problem: Problem
    base: xr.Dataset
    phi: Floats
    sigma: Floats
    data: dict[str, xr.Dataset]
    attributes: dict[str, Any]
    earlier: Floats
    likelihood: Floats
    weights: Floats
    share: float
    k: float
    more_noise: list[str]

    @property
    def heavy(self) -> bool:
        """Whether the tail of the weights is too heavy for them to be used."""
        return bool(np.isfinite(self.k) and self.k > _HEAVY)

    @property
    def least_share(self) -> float:
        """Least share that the weights are worth, of all draws or of those of one chain.

        A chain that the data speak against is elsewhere than the others: then they must mix.
        """
        chains = self.base.sizes["chain"]
        of_chains = self.weights.reshape(chains, -1).sum(axis=1) * chains
        return float(min(self.share, of_chains.min()))


def _weighted(
    idata: Any, record: PosteriorRecord, problem: Problem, rng: np.random.Generator
) -> _Weighted:
    """Weight the draws by the new transitions of a problem."""
    base = _base(idata)
    names = [*(block.name for block in problem.layout.blocks), *problem.noise_variables]
    phi, sigma = parameter_draws(problem, from_groups({"posterior": base[names]}, {}))
    rows = base["row"].to_numpy()
    problem = problem.joined(phi[rows], sigma[rows])
    likelihood, predictive = files.evaluate(problem, phi, sigma, rows, rng)
    data = _with_data(idata, problem)
    earlier = base["log_likelihood"].to_numpy()
    base = _with_new(base, likelihood, predictive).assign_coords(data["observed_data"].coords)
    log_weights = base["log_weight"].to_numpy().ravel()
    weights, share, k = np.zeros(len(log_weights)), 0.0, np.inf
    if np.isfinite(log_weights.max()):
        weights, k = files.smoothed(log_weights)
        share = 1.0 / (len(weights) * float((weights**2).sum()))
    changed = replace(record, together=tuple(problem.physics.together))
    if problem.likelihood.filtered:
        cells = files.recorded_cells(problem.scene, data["constant_data"])
        changed = replace(changed, cells=cells)
    more_noise = [label for label in changed.noise_labels if label not in problem.noise_labels]
    attributes = dict(idata.attrs) | changed.attributes()
    return _Weighted(
        problem, base, phi, sigma, data, attributes, earlier, likelihood, weights, share, k,
        more_noise,
    )  # fmt: skip


def _without_fit(
    idata: Any, new: _Weighted, effects: tuple[Effect, ...], seed: int, rng: np.random.Generator
) -> tuple[Any, Problem, dict[str, Any]]:
    """Return the posterior of all data by weights or moves, the problem, and what was done.

    The posterior is None where all data must be fitted.
    """
    base = new.base
    if new.least_share >= _MOVE and not new.heavy and not new.more_noise:
        result = _reweighted(new, rng)
        # reweighting lowers the effective sample size
        ess = float(base["min_ess"])
        if ess < MIN_ESS or min(files.convergence(result)[1].values()) >= MIN_ESS:
            return files.checked(new.problem, result), new.problem, {"did": "reweighted"}
    # from here on all data are needed
    whole = problem_of(from_groups(groups(idata) | new.data, new.attributes), effects)
    # discrete choices (sets of a library, bodies of a joint) have no Metropolis steps here
    chosen_among = whole.library is not None or whole.layout.discrete.any()
    if new.share < _REFIT or new.heavy or chosen_among or new.more_noise:
        return None, whole, {}
    draws = min(base.sizes["draw"], -(-_WALKERS // base.sizes["chain"]))
    chosen = systematic(new.weights, base.sizes["chain"] * draws, rng)
    phi, sigma, accepted = rejuvenate(whole, new.phi[chosen], new.sigma[chosen], rng)
    like = base[list(whole.named(phi, sigma))].isel(draw=slice(draws))
    posterior = like.assign(
        {
            name: (like[name].dims, values.reshape(like[name].shape))
            for name, values in whole.named(phi, sigma).items()
        }
    )
    rate = np.full((base.sizes["chain"], draws), accepted)
    stats = xr.Dataset({"accept": (("chain", "draw"), rate)}, _chain_and_draw(posterior))
    trace = from_groups(new.data | {"posterior": posterior, "sample_stats": stats}, {})
    method = new.attributes["method"]
    result = files.complete(whole, trace, seed=seed, method=method)
    return files.placed(result, base.coords), whole, {"did": "moved", "draws": draws}


def _mode(earlier: Any, updated: Any, effects: tuple[Effect, ...]) -> Any:
    """Return the mode of all data for the record of an updated posterior."""
    problem = problem_of(updated, effects)
    phi, sigma = parameter_draws(problem, updated)
    sums = group(updated, "log_likelihood")["next_state"].sum("transition")
    likelihood = sums.transpose("chain", "draw").to_numpy().ravel()
    choice = None
    if problem.library is not None:
        choice = files.draws(updated)["library_index"].astype(np.intp)
    begin = files.stored_mode(problem, earlier)
    return files.updated_mode(problem, begin, (phi, sigma, choice), likelihood)


def _reweighted(new: _Weighted, rng: np.random.Generator) -> Any:
    """Return equally weighted draws: those of the fit, repeated or left out within their chain."""
    base, weights = new.base, new.weights
    chains, n = base.sizes["chain"], base.sizes["draw"]
    ancestor = np.stack(
        [systematic(chain_weights, n, rng) for chain_weights in weights.reshape(chains, n)]
    )
    where = xr.DataArray(ancestor, dims=("chain", "draw"))
    drawn = base.isel(chain=xr.DataArray(np.arange(chains), dims="chain"), draw=where)
    drawn = drawn.assign_coords(chain=base["chain"], draw=base["draw"])
    added = ("log_likelihood", "log_weight", "next_state", "min_ess", files.SIZE)
    posterior = _used(drawn[[str(v) for v in base.data_vars if v not in added]])
    vectors = parameter_draws(new.problem, from_groups({"posterior": posterior}, {}))
    rows = systematic(weights[base["row"].to_numpy()] + 1e-300, base.sizes["row"], rng)
    predictive = base["next_state"].isel(row=rows).rename(row="draw")
    predictive = predictive.assign_coords(draw=np.arange(len(rows))).expand_dims(chain=[0])
    result = {
        **new.data,
        "posterior": posterior,
        "sample_stats": xr.Dataset({"ancestor": where}, _chain_and_draw(base)),
        "log_likelihood": _used(drawn[["log_likelihood"]].rename(log_likelihood="next_state")),
        "posterior_predictive": _used(predictive.to_dataset()),
        **files.prior_groups(new.problem, posterior, *vectors, int(new.attributes["seed"])),
        BASE: base,
    }
    attributes = new.attributes | {"updates": "[]"}  # the caller adds the entry
    if files.SIZE in base:  # the fit's draws were weighted before
        worth = new.share * float(base[files.SIZE])
        attributes[files.SIZE] = min(worth, float(attributes[files.SIZE]))
    return from_groups(result, attributes)


def _chain_and_draw(data: xr.Dataset) -> dict[str, Any]:
    return {"chain": data["chain"].to_numpy(), "draw": data["draw"].to_numpy()}


def _used(data: xr.Dataset) -> xr.Dataset:
    """Return the dataset without coordinates that no variable has."""
    dims = {dim for variable in data.data_vars.values() for dim in variable.dims}
    return data.drop_vars([str(c) for c in data.coords if not set(data[c].dims) <= dims])


def _base(idata: Any) -> xr.Dataset:
    """Return the draws of the last fit or move with likelihoods, weights and predictions."""
    held = groups(idata)
    if BASE in held:
        return held[BASE]
    posterior = held["posterior"].transpose("chain", "draw", ...)
    chains, draws = posterior.sizes["chain"], posterior.sizes["draw"]
    likelihood = held["log_likelihood"]["next_state"].transpose("chain", "draw", "transition")
    predictions = group(idata, "posterior_predictive")
    predictive = predictions["next_state"].stack(row=("chain", "draw")).transpose("row", *CELLS)
    variables = {
        "min_ess": ((), float(idata.attrs.get("min_ess", 0.0))),
        "log_likelihood": (("chain", "draw", "transition"), likelihood.to_numpy()),
        "log_weight": (("chain", "draw"), np.zeros((chains, draws))),
        "next_state": (("row", *CELLS), predictive.to_numpy()),
    }
    if files.SIZE in idata.attrs:
        variables[files.SIZE] = ((), float(idata.attrs[files.SIZE]))
    return posterior.assign(variables).assign_coords(
        row=files.predicted_rows(posterior, predictions)
    )


def _with_new(base: xr.Dataset, likelihood: Floats, predictive: Floats) -> xr.Dataset:
    """Add likelihoods (draw, transition) of new transitions, and predictions of them."""
    shape = base.sizes["chain"], base.sizes["draw"], -1
    both = [base["log_likelihood"].to_numpy(), likelihood.reshape(shape)]
    predicted = [base["next_state"].to_numpy(), predictive]
    return base.drop_dims("transition").assign(
        log_likelihood=(("chain", "draw", "transition"), np.concatenate(both, axis=2)),
        log_weight=base["log_weight"] + likelihood.sum(axis=1).reshape(shape[:2]),
        next_state=(("row", *CELLS), np.concatenate(predicted, axis=1)),
    )


def _with_data(idata: Any, problem: Problem) -> dict[str, xr.Dataset]:
    """Return the stored data and, after them, the problem's."""
    segments, result = problem.segments, {}
    new = {"start": segments.start, "actions": problem.inputs, "next_state": problem.measured}
    for name in ("observed_data", "constant_data"):
        held = group(idata, name)
        old = held[[key for key in held.data_vars if key in new]].transpose("transition", ...)
        total = old.sizes["transition"] + segments.n
        both = {
            str(key): (
                variable.dims,
                np.concatenate([variable.to_numpy(), new[str(key)]]),
                variable.attrs,
            )
            for key, variable in old.data_vars.items()
        }
        coords = dict(old.drop_dims("transition").coords) | files.both_places(old, segments)
        result[name] = xr.Dataset(both, coords | {"transition": np.arange(total)}, held.attrs)
    more = files.both_recordings(group(idata, "constant_data"), files.recording(problem))
    result["constant_data"] = result["constant_data"].merge(more)
    return result
