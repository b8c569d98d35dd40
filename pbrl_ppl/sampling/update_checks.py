"""Checks of a posterior and of new data before an update."""

from __future__ import annotations

import numpy as np

from pbrl_ppl.errors import HistoryError, PosteriorError
from pbrl_ppl.history import History, check_start, measured_alone, unused_velocities
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.posterior import (
    Idata,
    PosteriorRecord,
    from_groups,
    group,
    parameter_draws,
    problem_of,
)
from pbrl_ppl.state import STATE, Floats


def check_posterior(idata: Idata, history: History) -> PosteriorRecord:
    """Return the record of a posterior; refuse posteriors and data that an update cannot use."""
    for name in ("log_likelihood", "posterior_predictive", "observed_data", "constant_data"):
        group(idata, name)
    record = PosteriorRecord.of(idata)
    known = [record.data_sha256]
    for entry in record.updates or ():
        known += [entry["data_sha256"], entry["before_sha256"]]
    if history.data_sha256 in known:
        raise PosteriorError(
            "update: these data are in the posterior already, and would count twice; pass only"
            " what was recorded since"
        )
    return record


def as_recorded(idata: Idata, history: History) -> History:
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


def check_history(idata: Idata, record: PosteriorRecord, history: History) -> None:
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


def check_engine(
    idata: Idata, problem: Problem, *, transitions: int = 50, tolerance: float = 0.01
) -> None:
    """Refuse a posterior whose stored likelihoods are not what this problem's engine gives.

    Parameters
    ----------
    idata : InferenceData or DataTree
        The posterior.
    problem : Problem
        Of the same parameters; its data do not matter.
    transitions : int
        How many likelihoods are computed again, at the first draw.
    tolerance : float
        Largest median difference from the stored ones (nats).
    """
    whole = "smoothed" in group(idata, "constant_data")  # neighbours depend on each other
    some = {"transition": slice(None if whole else transitions)}
    few = {name: group(idata, name).isel(some) for name in ("observed_data", "constant_data")}
    earlier = from_groups(few | {"posterior": group(idata, "posterior")}, idata.attrs)
    first = problem_of(earlier, {attached.effect for attached in problem.physics.effects})
    phi, sigma = parameter_draws(problem, idata)
    now = first.log_density(first.residual(phi[0]), sigma[0], phi[0])
    then = group(idata, "log_likelihood")["next_state"].isel(chain=0, draw=0).to_numpy()
    off = float(np.median(np.abs(now - then[: len(now)])))
    if not off < tolerance:
        raise PosteriorError(
            f"update: the posterior's likelihoods are not what this engine gives (half of them are"
            f" off by {off:.2g} or more): it was made with other effects or another"
            " version; refit all data"
        )


def judgement(earlier: Floats, new: Floats, worse: float = 3.0) -> str:
    """Return a text on whether new transitions may be of the same bodies as the posterior's.

    Parameters
    ----------
    earlier, new : ndarray
        Log-likelihoods of transitions, shape (..., transition), the draws first.
    worse : float
        Fall of the mean log-likelihood, in standard errors, from which new data are predicted
        worse.
    """
    old, others = (
        densities.reshape(-1, densities.shape[-1]).mean(axis=0) for densities in (earlier, new)
    )
    error = float(np.sqrt(old.var() / len(old) + others.var() / len(others)))
    if not float(old.mean() - others.mean()) < worse * error:
        return "look whether they are of the same bodies, under the same conditions"
    return (
        "the posterior predicts them as well as its own data, so they may well be of the same"
        " bodies: it is narrower than all of the data allow"
    )
