"""Tests of a model's residual: unexplained acceleration, whiteness, dependence, forecasts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import chi2

from pbrl_ppl.criticism.criteria import Criteria
from pbrl_ppl.criticism.held_out import forecast
from pbrl_ppl.criticism.innovations import (
    UnexplainedAcceleration,
    correlation_tests,
    find_dependence,
    innovations_over_steps,
    noise_alone,
)
from pbrl_ppl.criticism.results import KindOfTest, Misfit, ResidualTest
from pbrl_ppl.criticism.score import Signature
from pbrl_ppl.likelihood import bodies_acceleration
from pbrl_ppl.modes import FilteredMode
from pbrl_ppl.state import STATE, STATE_UNITS, Floats, acceleration_unit

#: Share of the bodies' acceleration above which percentages are omitted.
LARGEST_SHARE = 0.995


def find_misfit(
    mode: FilteredMode, excess: UnexplainedAcceleration, *, horizon: int, seed: int = 0
) -> Misfit:
    """Test the residual of a fitted model on the data that it was fitted to.

    Parameters
    ----------
    mode : FilteredMode
        Fitted to whole trajectories.
    excess : UnexplainedAcceleration
        Its unexplained acceleration, with the criteria.
    horizon : int
        Intervals of the forecasts.
    seed : int
        Seed of the permutations.
    """
    of_dependence, dependence = find_dependence(mode, excess.criteria, seed=seed)
    correlations = correlation_tests(mode, excess.criteria)
    forecasts = forecast_test(mode, noise_alone(mode, excess), horizon, excess.criteria)
    tests = (_acceleration(mode, excess), *correlations, forecasts, of_dependence)
    return Misfit(tests, dependence)


def _acceleration(mode: FilteredMode, excess: UnexplainedAcceleration) -> ResidualTest:
    """Return the test of unexplained accelerations against none."""
    passed, largest = not excess.matters.any(), excess.largest
    name, relative = excess.names[largest], float(excess.relative[largest])
    sentence, body = "no unexplained acceleration is significant", ""
    if excess.certain.any():
        body = _most_unexplained(mode, name)
        sentence = (
            f"an acceleration of {acceleration_in_words(name, excess.size[largest])} of {body} is"
            f" unexplained in each interval, {share_in_words(relative)}"
        )
        if not excess.beyond_engine[largest]:
            sentence += ": engines differ by as much in their steps"
        elif passed:
            sentence += ", which is negligible"
    p_value = float(min(1.0, excess.p_value[largest] * len(excess.names)))
    return ResidualTest(
        KindOfTest.ACCELERATION, p_value, relative, passed, sentence, body, name if body else ""
    )


def _most_unexplained(mode: FilteredMode, name: str) -> str:
    """Return the body with the largest innovations of a velocity, or of its position."""
    d, places = STATE.index(name), mode.problem.likelihood.noise.coordinates.places
    columns = np.flatnonzero(np.isin(places % len(STATE), (d, d - 3)))
    size = (mode.whitened_residual[:, columns] ** 2).mean(axis=0)
    body = int(places[columns[int(np.argmax(size))]] // len(STATE))
    return mode.problem.scene.moving[body].name


def acceleration_in_words(name: str, size: float) -> str:
    """Write an acceleration of a velocity.

    Examples
    --------
    >>> acceleration_in_words("omega", 0.1234)
    '0.12 rad/s² in omega'
    """
    return f"{size:.2g} {acceleration_unit(name)} in {name}"


def share_in_words(relative: float) -> str:
    """Write a share of the bodies' acceleration; none where they hardly accelerate.

    Examples
    --------
    >>> share_in_words(0.1234), share_in_words(300.6)
    ("12 % of the bodies' acceleration", "more than the bodies' acceleration itself")
    """
    if relative < LARGEST_SHARE:
        return f"{100 * relative:.2g} % of the bodies' acceleration"
    return "more than the bodies' acceleration itself"


def simulation_test(
    simulated: Mapping[str, float],
    noise: Mapping[str, float],
    motion: Mapping[str, float],
    seconds: float,
    criteria: Criteria,
) -> ResidualTest:
    """Return the test of held-out trajectories that are simulated from fitted initial states.

    Parameters
    ----------
    simulated, noise, motion : mapping of str to float
        Error of the simulation, standard deviation of the measurement, and standard deviation of
        what was measured, by state dimension, SI units.
    seconds : float
        Length of the longest trajectory.
    criteria : Criteria
        The error may be ``worst_simulation`` times the noise, which may be correlated, or a
        ``negligible`` share of the motion.
    """
    simulated = {name: error for name, error in simulated.items() if name in noise}
    if not simulated:
        return ResidualTest.untested(
            KindOfTest.SIMULATION, "no simulation is as long as a held-out trajectory"
        )
    far = {one: size for one, size in simulated.items() if size > criteria.negligible * motion[one]}
    passed = all(size < criteria.worst_simulation * noise[one] for one, size in far.items())
    name = max(simulated if passed else far, key=lambda one: simulated[one] / noise[one])
    error, times = simulated[name], simulated[name] / noise[name]
    sentence = (
        f"held-out trajectories, simulated over {seconds:.3g} s, are {error:.3g}"
        f" {STATE_UNITS[STATE.index(name)]} off in {name}, {times:.3g} times the measurement noise"
    )
    return ResidualTest(
        KindOfTest.SIMULATION, float("nan"), times, passed, sentence, "", "" if passed else name
    )


def score_test(mode: FilteredMode, ranked: Sequence[Signature], criteria: Criteria) -> ResidualTest:
    """Return the test of the innovations for effects of the catalogue that the model lacks.

    It fails where one is significant and changes a step by more than a negligible share.
    """
    if not ranked:
        return ResidualTest.untested(KindOfTest.CANDIDATES, "no effect of the catalogue is left")
    first = min(ranked, key=lambda one: one.candidate.p_value)
    candidate, white = first.candidate, mode.whitened_residual
    change = np.sqrt(candidate.statistic) * first.direction[: white.size].reshape(white.shape)
    share = np.sqrt((change**2).mean(axis=0)) * innovations_over_steps(mode)
    size, certain = float(share.max(initial=0.0)), candidate.p_value < criteria.false_alarm
    name = f"{candidate.effect.replace('_', ' ')} on {candidate.body}"
    sentence = "no effect of the catalogue is significant in the innovations"
    if certain:
        sentence = f"{name} would change a step by {100 * size:.2g} %"
        sentence += ", which is negligible" if size < criteria.negligible else ""
    passed = not certain or size < criteria.negligible
    return ResidualTest(
        KindOfTest.CANDIDATES, candidate.p_value, size, passed, sentence, candidate.body
    )


def forecast_test(
    mode: FilteredMode, sigma: Floats, horizon: int, criteria: Criteria, *, held_out: bool = False
) -> ResidualTest:
    """Return the test of forecasts' errors against those of noise and a negligible acceleration.

    Arguments as of :func:`find_misfit`; ``sigma`` is the noise alone, and ``held_out`` tells that
    the mode's problem is of held-out trajectories. An error counts for no more than three times
    its expected size: a single one that a bad frame or a grazing contact spoils is no misfit.
    """
    noise = mode.problem.likelihood.noise
    lengths = np.diff(np.append(np.flatnonzero(noise.first), len(noise.first)))
    longest = min(horizon, int(lengths.max()))
    allowed = criteria.negligible * bodies_acceleration(mode.problem)
    last = forecast(mode.problem, mode.phi, sigma, longest, allowed=allowed)
    worst, p_value, name, body = 0.0, 1.0, "", ""
    dimensions = np.unique(last.dimension)
    for d in dimensions:
        columns = np.flatnonzero(last.dimension == d)
        error = last.error[:, columns]
        square = error**2 / last.variance[:, columns]
        z = square[~np.isnan(error)]
        if not z.size:
            continue
        # forecasts overlap by half, so half of them count
        total = np.minimum(z, 3.0**2).sum() / 2
        chance = len(dimensions) * float(chi2.sf(total, max(z.size / 2, 1)))
        if np.sqrt(z.mean()) > worst:
            worst, p_value, name = float(np.sqrt(z.mean())), min(1.0, chance), STATE[d]
            column = columns[int(np.argmax(np.nansum(square, axis=0)))]
            place = int(noise.coordinates.places[column])
            body = mode.problem.scene.moving[place // len(STATE)].name
    passed = p_value > criteria.false_alarm or worst < criteria.worse_forecast
    seconds = longest * mode.problem.scene.time_step
    if passed:
        body, name, sentence = "", "", f"errors of forecasts of {seconds:g} s are those of noise"
    elif np.isfinite(worst):
        sentence = (
            f"after {seconds:g} s the error of {name} of {body} is {worst:.1f} times what noise and"
            f" {100 * criteria.negligible:g} % of the bodies' acceleration make"
        )
    else:
        sentence = f"within {seconds:g} s forecasts of {name} of {body} diverge"
    kind = KindOfTest.HELD_OUT if held_out else KindOfTest.FORECASTS
    sentence = "held out: " * held_out + sentence
    return ResidualTest(kind, p_value, worst, passed, sentence, body, name)
