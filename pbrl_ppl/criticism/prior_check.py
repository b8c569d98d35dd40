"""Prior predictive check: whether the declared prior could have produced data like these."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from scipy.stats import binom

from pbrl_ppl.criticism.criteria import DEFAULT, PriorCriteria
from pbrl_ppl.errors import FitError
from pbrl_ppl.history import (
    History,
    measured_alone,
    measurement_noise,
    unused_velocities,
    wrong_clock,
)
from pbrl_ppl.likelihood import Problem, draw_prior
from pbrl_ppl.physics import Physics
from pbrl_ppl.posterior import HDI_PROB
from pbrl_ppl.state import POSE, STATE, STATE_UNITS, THETA, Bools, Floats, Ints, wrapped

#: Quantiles: the ends of the interval, its quartiles and the median.
QUANTILES = (0.5 - HDI_PROB / 2, 0.25, 0.5, 0.75, 0.5 + HDI_PROB / 2)
#: Factors of wrong units: m and mm or N and mN; degrees; kg for the weight of a kg.
_UNITS = {1000.0: "1000", 180 / np.pi: "57.3", 9.81: "9.81"}


@dataclass(frozen=True, eq=False)
class PriorCheck:
    """Measured changes of state over a segment against what the prior predicts.

    Parameters
    ----------
    dataset : xarray.Dataset
        With the dims body, state and quantile, in the units of the states:

        - ``predicted`` and ``measured`` (body, state, quantile): changes, all cells pooled;
        - ``share_inside`` (body, state): share of the measured cells inside the central 94 % of
          their own predictions;
        - ``share_beyond`` (body, state): share that lies beyond all of them;
        - ``largest_beyond`` (body, state): how far the farthest lies beyond them;
        - ``factor`` (body, state, quantile): how many times as large measured changes are as
          predicted ones without noise, by least squares for each draw, over the draws;
        - ``cells`` (body, state): how many were measured.
    seconds : float
        Length of a segment (s).
    draws, diverged : int
        Draws from the prior, and those on which the engine diverged, which were left out.
    criteria : PriorCriteria
        When the prior could not have made the data.
    clock : tuple of str
        What a free fall says of the recording's clock.
    """

    dataset: xr.Dataset
    seconds: float
    draws: int
    diverged: int
    criteria: PriorCriteria = DEFAULT.prior
    clock: tuple[str, ...] = ()

    @property
    def sentences(self) -> tuple[str, ...]:
        """Return where the prior could not have made the data; empty where it could."""
        limits, sentences = self.criteria, [*self.clock]
        for body in self.dataset["body"].values:
            for state in self.dataset["state"].values:
                changes = self.dataset.sel(body=body, state=state)
                unit = STATE_UNITS[STATE.index(str(state))]
                share, cells = float(changes["share_beyond"]), int(changes["cells"])
                if not share > limits.most_beyond:  # or not measured
                    continue
                # beyond either end of the draws is as likely as between any two of them
                chance = binom.sf(round(share * cells) - 1, cells, 2 / (self.draws + 1))
                if chance > limits.chance:
                    continue
                # a position changes mostly by the velocity before, which is in the same units
                size, cause = ("", "") if str(state) in POSE else _unit(changes["factor"])
                size = size or (
                    f"otherwise, by up to {float(changes['largest_beyond']):.2g} {unit}, than"
                )
                sentences.append(
                    f"{state} of {body} changes {size} draws from the prior in {self.seconds:g} s"
                    f" ({100 * share:.0f} % of changes lie beyond all of {self.draws} draws): check"
                    f" units, of commands too, or the prior's hyper-parameters{cause}"
                )
        if self.diverged > 0.1 * self.draws:
            sentences.append(
                f"the engine diverged on {self.diverged} of {self.draws} draws from the prior:"
                " narrow the prior, or use more substeps"
            )
        return tuple(sentences)

    @property
    def summary(self) -> tuple[str, ...]:
        """Return the sentences, or one that says that nothing is wrong."""
        return self.sentences or ("the declared priors could have made data like these",)


def prior_predictive_check(
    model: object, *, draws: int = 400, seed: int = 0, criteria: PriorCriteria = DEFAULT.prior
) -> PriorCheck:
    """Compare measured changes over a segment with predictions under the prior.

    The noise added to the predictions is the median of sigma's prior, or the measurement noise, if
    that is larger: the scene's where it states it, else an estimate from the measurements alone.
    Draws from sigma's prior would not do: it is scaled by the data, and so wide that noise could
    explain any change. Velocities that were computed from positions are not compared.

    Parameters
    ----------
    model : pymc.Model or Problem
        As made by :func:`pbrl_ppl.physics_model`, or the problem that it is of.
    draws : int
        Draws from the prior, at least 50; measurements beyond all of them count against the prior,
        and of few draws the largest varies from seed to seed.
    seed : int
        The same seed gives the same answer.
    criteria : PriorCriteria
        When the prior could not have made the data.

    Returns
    -------
    PriorCheck
        Its ``sentences`` are empty where the prior could have made the data.

    Raises
    ------
    FitError
        If the model was not made by ``physics_model``, or the engine diverged on every draw.
    ValueError
        If ``draws`` is below 50.

    Examples
    --------
    ::

        check = pp.prior_predictive_check(pp.physics_model(scene, history))
        check.dataset["share_inside"]
        check.sentences  # ('omega of cart changes 12 times as much as draws from the prior ...',)
    """
    if isinstance(model, Problem):
        problem = model
    else:
        from pbrl_ppl.model import problem_in  # PyMC takes seconds to load

        problem = problem_in(model)
    if draws < 50:
        raise ValueError(f"draws is {draws}, expected at least 50")
    rng = np.random.default_rng(seed)
    observations, segments = problem.observations, problem.segments
    columns = list(observations.columns)
    unused = unused_velocities(problem.data.history)
    history = measured_alone(problem.data.history, unused)
    recorded = np.isfinite(history.dataset["observed"].to_numpy()).any(axis=(0, 1))
    first = segments.start[..., columns]
    # of bodies that are seen now and then, the last measured row counts
    steps = np.arange(1, observations.values.shape[1] + 1)[:, None, None]
    last = np.maximum((steps * observations.measured).max(axis=1), 1) - 1
    measured = observations.wrapped(_at(observations.values, last) - first)
    for velocity in unused:
        if (d := STATE.index(velocity.state)) in columns:
            measured[:, history.bodies.index(velocity.body), columns.index(d)] = np.nan
    ends = _predicted_ends(problem, draw_prior(problem, rng, draws), last)
    exact = observations.wrapped(ends - first)
    predicted = ends + _noise_of_changes(problem, history) * rng.standard_normal(exact.shape)
    derived = ~recorded[:, [d if d >= len(POSE) else d + len(POSE) for d in columns]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of what was never measured all is NaN
        dataset = _compare(observations.wrapped(predicted - first), exact, measured, derived)
    fall = wrong_clock(history, problem.scene)
    bodies, states = [body.name for body in problem.scene.moving], list(observations.names)
    return PriorCheck(
        dataset.assign_coords(body=bodies, state=states, quantile=list(QUANTILES)),
        problem.data.horizon * problem.scene.time_step,
        draws,
        draws - len(ends),
        criteria,
        (fall.sentence(problem.scene),) if fall else (),
    )


def _predicted_ends(problem: Problem, phi: Floats, last: Ints, *, chunk: int = 16) -> Floats:
    """Return what is predicted at the last measured rows, (draw, transition, body, state).

    Draws on which the engine diverges are left out; ``chunk`` of them are simulated at once.

    Raises
    ------
    FitError
        If fewer than two are left.
    """
    columns, problem = list(problem.observations.columns), problem.coarse
    ends = np.concatenate(
        [
            _at(problem.predict(phi[i : i + chunk], problem.physics.one_world)[..., columns], last)
            for i in range(0, len(phi), chunk)
        ]
    )
    good = np.isfinite(ends).all(axis=(1, 2, 3))
    if good.sum() < 2:
        raise FitError(
            f"prior check: the engine diverged on {len(good) - good.sum()} of {len(good)} draws"
            " from the prior; narrow the prior's hyper-parameters, or use more substeps"
        )
    return np.asarray(ends[good])


def _noise_of_changes(problem: Problem, history: History) -> Floats:
    """Return the standard deviation of errors of measured changes, shape (body, state).

    Sensors may be worse than the prior's median; both ends of a change have an error.
    """
    known = _measurement_noise(history, dict(problem.scene.noise))
    noisy = np.sqrt(2.0) * known
    seconds = problem.data.horizon * problem.scene.time_step
    noisy[:, : len(POSE)] = np.hypot(noisy[:, : len(POSE)], seconds * known[:, len(POSE) :])
    return np.asarray(
        np.maximum(problem.noise_prior[0], noisy[:, list(problem.observations.columns)])
    )


def _unit(factor: xr.DataArray, beyond: float = 1.5) -> tuple[str, str]:
    """Return how many times as large measured changes are, and a hint if a unit has that factor.

    Both are empty where no size of predicted changes is that of the measured ones.

    ``beyond``: such a factor may lie this far beyond the range of the prior's.
    """
    low, middle, high = (float(factor[i]) for i in (0, len(QUANTILES) // 2, -1))
    if not low > 0:  # nothing was predicted, or motion the other way
        return "", ""
    over = "" if middle > 1 else "1/"
    if over:
        low, middle, high = 1 / high, 1 / middle, 1 / low
    if low < 1:
        return "", ""
    words = f"{over}{middle:.2g} times as much as"
    low, high = low / beyond, high * beyond
    near = [unit for unit in _UNITS if low < unit < high]
    if low < 1 or not near:
        return words, ""
    best = min(near, key=lambda unit: abs(np.log(unit / middle)))
    return words, f" (a factor near {over}{_UNITS[best]}: units?)"


def _at(states: Floats, step: Ints) -> Floats:
    """Return states (..., transition, H, body, state) at one step for each coordinate.

    ``step`` has the shape (transition, body, state), the result (..., transition, body, state).
    """
    picked = np.broadcast_to(step[:, None], (*states.shape[:-3], 1, *states.shape[-2:]))
    return np.asarray(np.take_along_axis(states, picked, axis=-3)[..., 0, :, :])


def check_prior(physics: Physics, history: History, **options: Any) -> PriorCheck:
    """Compare a history with draws from the prior over the horizon that its noise asks for."""
    problem = Problem.of(physics, history, horizon=informative_horizon(history))
    return prior_predictive_check(problem, **options)


def informative_horizon(history: History, signal: float = 5.0) -> int:
    """Return the intervals in which bodies move well beyond the measurement noise: often one.

    In a fast recording an interval shows hardly more than noise, which does not depend on the
    prior of the parameters. The noise is estimated by third differences of positions.

    Parameters
    ----------
    history : History
        The recording.
    signal : float
        Changes are this many times the measurement errors.
    """
    observed = history.dataset["observed"].to_numpy()[..., : len(POSE)]
    places = observed.transpose(0, 2, 3, 1).reshape(-1, observed.shape[1])
    angle = np.tile(np.arange(len(POSE)) == THETA, len(places) // len(POSE))
    longest = int(history.dataset["n_rows"].min()) - 1

    steps = [history.longest_gap]
    while steps[-1] < longest:
        steps.append(min(2 * steps[-1], longest))
    noise = _mean_square(places, angle, 1, 3) / 20.0
    changes = np.array([_mean_square(places, angle, step, 1) for step in steps])
    informative = changes >= signal**2 * noise
    # what never moves beyond its noise does not decide
    moves = (informative & (changes > 0.0)).any(axis=0)
    enough = informative[:, moves].all(axis=1) & moves.any()
    return steps[int(enough.argmax())] if enough.any() else steps[-1]


def _mean_square(values: Floats, angle: Bools, steps: int, order: int) -> Floats:
    """Return mean squares of differences over some steps of series (series, time); 0 if none.

    Differences of angles, which the mask (series,) names, are wrapped.
    """
    change = values
    for _ in range(order):
        change = change[:, steps:] - change[:, :-steps]
        change = np.where(angle[:, None], wrapped(change), change)
    count = (~np.isnan(change)).sum(axis=1)
    return np.asarray(np.nansum(change**2, axis=1) / np.maximum(count, 1))


def _measurement_noise(history: History, stated: Mapping[str, float]) -> Floats:
    """Return the measurement noise of each state, shape (body, state); 0 where it is unknown.

    It is the stated one, or an estimate; of a coordinate that never moves beyond its noise the one
    that third differences show: over all times, up to four intervals or more, its mean square
    changes are at most twice those of its noise.
    """
    noises = measurement_noise(history)
    observed = history.dataset["observed"].to_numpy()
    half = observed.shape[1] // 2
    steps = [2**k for k in range(max(half, 1).bit_length())]
    for d, name in enumerate(STATE):
        angle = np.full(len(observed), d == THETA)
        for body in range(len(noises)):
            column = observed[:, :, body, d]
            noise = float(_mean_square(column, angle, 1, 3).mean()) / 20.0
            largest = max(float(_mean_square(column, angle, step, 1).mean()) for step in steps)
            if half >= 4 and largest <= 2.0 * 2.0 * noise:
                noises[body, d] = max(noises[body, d], np.sqrt(noise))
            if name in stated and np.isfinite(column).any():
                if name in POSE and np.isnan(observed[:, :, body, d + len(POSE)]).all():
                    # a velocity that a position gives is as uncertain as the position
                    noises[body, d + len(POSE)] *= stated[name] / (noises[body, d] or stated[name])
                noises[body, d] = stated[name]
    return noises


def _compare(predicted: Floats, exact: Floats, measured: Floats, derived: Bools) -> xr.Dataset:
    """Return summaries of changes (draw, transition, body, state), and (transition, body, state).

    ``exact`` changes are predicted ones without noise. Where velocities are ``derived``, shape
    (body, state), draws reach measurements within a quarter of the usual change.
    """
    seen = np.isfinite(measured)
    low, high = np.quantile(predicted, [QUANTILES[0], QUANTILES[-1]], axis=0)
    near = 0.25 * derived * np.sqrt(np.nanmean(measured**2, axis=0))
    low_end, high_end = predicted.min(axis=0) - near, predicted.max(axis=0) + near
    farther = np.maximum(measured - high_end, low_end - measured)
    count, known = seen.sum(axis=0), np.where(seen, exact, 0.0)
    factor = (known * np.nan_to_num(measured)).sum(axis=1) / (known**2).sum(axis=1)
    # cells that were not measured count on neither side
    pooled = np.where(seen, predicted, np.nan).reshape(-1, *measured.shape[1:])
    dims = ("body", "state")
    return xr.Dataset(
        {
            "predicted": (("quantile", *dims), np.nanquantile(pooled, QUANTILES, axis=0)),
            "measured": (("quantile", *dims), np.nanquantile(measured, QUANTILES, axis=0)),
            "share_inside": (dims, ((measured >= low) & (measured <= high)).sum(axis=0) / count),
            "share_beyond": (dims, (farther > 0.0).sum(axis=0) / count),
            "largest_beyond": (dims, np.nanmax(np.where(seen, farther, 0.0), axis=0).clip(0.0)),
            "cells": (dims, count),
            "factor": (("quantile", *dims), np.nanquantile(factor, QUANTILES, axis=0)),
        }
    ).transpose("body", "state", "quantile")
