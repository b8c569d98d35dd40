"""Tests of what a model leaves: unexplained acceleration, whiteness, dependence, forecasts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pbrl_ppl.criticism.correlation import correlation_tests
from pbrl_ppl.criticism.criteria import Criteria
from pbrl_ppl.criticism.dependence import Dependence, find_dependence
from pbrl_ppl.criticism.forecast import forecast
from pbrl_ppl.criticism.results import Correlations, Growth, ResidualTest, Unexplained
from pbrl_ppl.criticism.unexplained import Left, noise_alone
from pbrl_ppl.likelihood import bodies_acceleration
from pbrl_ppl.modes import Mode
from pbrl_ppl.state import STATE

Array = NDArray[np.float64]

#: Names of tests, of which all a model is good for depends.
ACCELERATION, FORECASTS, PRIOR = "unexplained acceleration", "forecasts", "prior"
_NOTHING_RECORDED = "nothing that was recorded"
#: And of another.
DEPENDENCE = "dependence on state, command and time"
#: An error of a forecast counts for no more than this many times what is expected.
_FAR_OFF = 3.0
#: Lengths of forecasts that a picture shows, at most.
_LENGTHS = 6


@dataclass(frozen=True, eq=False)
class Misfit:
    """Tests of what a model leaves, and where structure is that no effect explains.

    Parameters
    ----------
    tests : tuple of ResidualTest
        In the order of the report.
    unexplained : Unexplained or None
        Where it is strongest; None where all tests are passed.
    correlations : Correlations
        Of innovations.
    growth : Growth
        Of forecasts' errors.
    """

    tests: tuple[ResidualTest, ...]
    unexplained: Unexplained | None
    correlations: Correlations
    growth: Growth

    @property
    def predicts(self) -> bool:
        """Whether steps and forecasts are as good as noise lets them be, and the prior could be."""
        needed = (ACCELERATION, FORECASTS, PRIOR)
        return all(test.passed for test in self.tests if test.name in needed)

    @property
    def random(self) -> bool:
        """Whether nothing predicts what is left, however large: a random force, and no law."""
        return all(test.passed for test in self.tests if test.name != ACCELERATION)

    @property
    def predictable(self) -> float:
        """Share of the errors that recorded quantities predict; 0 where none is sure."""
        return next(test.size for test in self.tests if test.name == DEPENDENCE)

    def with_test(self, test: ResidualTest) -> Misfit:
        """The same with one test more; what it says is where the structure is if no other fails."""
        unexplained = self.unexplained
        if unexplained is None and not test.passed:
            unexplained = Unexplained("", "", _NOTHING_RECORDED, 0.0, 0.0, test.sentence)
        return replace(self, tests=(*self.tests, test), unexplained=unexplained)


def beside_names(misfit: Misfit, mode: Mode, left: Left) -> Misfit:
    """The misfit of a revised model, with an acceleration that remains, though negligible.

    A law that is only near to the right one leaves as little as two engines differ by.
    """
    if misfit.unexplained is not None or not left.remains.any():
        return misfit
    told = _acceleration(left)
    body, dimension = _where(mode, left, mode.problem.trajectory_noise.cells.places)
    rest = Unexplained(body, dimension, _NOTHING_RECORDED, told.size, told.p_value, told.sentence)
    return replace(misfit, unexplained=rest)


def find_misfit(mode: Mode, left: Left, *, horizon: int, seed: int = 0) -> Misfit:
    """Test what a fitted model leaves of the data that it was fitted to.

    Parameters
    ----------
    mode : Mode
        Of whole trajectories.
    left : Left
        Its unexplained acceleration.
    horizon : int
        Intervals of the forecasts.
    seed : int
        Of permutations.
    """
    dependence = find_dependence(mode, left.criteria, seed=seed)
    of_correlation, correlations = correlation_tests(mode, left.criteria)
    of_forecasts, growth = _forecasts(mode, noise_alone(mode, left), horizon, left.criteria)
    tests = (
        _acceleration(left),
        *of_correlation,
        of_forecasts,
        _dependence(dependence),
    )
    failed = [test for test in tests if not test.passed]
    if not failed:
        return Misfit(tests, None, correlations, growth)
    where = dependence.found
    if where is None:
        first = failed[0]
        noise = mode.problem.trajectory_noise
        body, dimension = _where(mode, left, noise.cells.places)
        where = Unexplained(
            body=body,
            dimension=dimension,
            depends_on=_NOTHING_RECORDED,
            share=first.size,
            p_value=first.p_value,
            sentence=first.sentence,
        )
    return Misfit(tests, where, correlations, growth)


def _dependence(dependence: Dependence) -> ResidualTest:
    if not dependence.tested:
        return ResidualTest.untested(DEPENDENCE, "too few transitions")
    found = dependence.found
    if found is None:
        sentence = "the innovations depend on no recorded quantity"
        return ResidualTest(DEPENDENCE, 1.0, 0.0, True, sentence)
    return ResidualTest(DEPENDENCE, found.p_value, found.share, False, found.sentence)


def _where(mode: Mode, left: Left, places: NDArray[np.intp]) -> tuple[str, str]:
    """Body and state dimension whose innovations are largest where most is unexplained."""
    worst = int(np.argmax(left.relative))
    d = STATE.index(left.names[worst])
    own = np.flatnonzero(np.isin(places % len(STATE), (d, d - 3)))
    size = (mode.whitened_residual[:, own] ** 2).mean(axis=0)
    body = int(places[own[int(np.argmax(size))]] // len(STATE))
    return mode.problem.scene.moving[body].name, left.names[worst]


def _acceleration(left: Left) -> ResidualTest:
    """Whether a step adds more than the model says."""
    passed = not left.matters.any()
    worst = int(np.argmax(np.where(left.certain if passed else left.matters, left.relative, -1.0)))
    unit = "rad/s²" if left.names[worst] == "omega" else "m/s²"
    some = bool(left.certain.any())
    sentence = "no unexplained acceleration is significant"
    if some:
        sentence = (
            f"an acceleration of {left.size[worst]:.2g} {unit} in {left.names[worst]} is"
            f" unexplained in each interval, {100 * left.relative[worst]:.2g} % of the bodies'"
            " acceleration"
        )
        if not left.beyond_engine[worst]:
            sentence += ": engines differ by as much in their steps"
        elif passed:
            sentence += ", which is negligible"
    p_value = float(min(1.0, left.p_value[worst] * len(left.names)))
    return ResidualTest(ACCELERATION, p_value, float(left.relative[worst]), passed, sentence)


def _forecasts(
    mode: Mode, sigma: Array, horizon: int, criteria: Criteria
) -> tuple[ResidualTest, Growth]:
    """Whether errors grow with the length of a forecast as noise, sigma, makes them.

    What a negligible acceleration that lasts adds to that is no misfit.
    """
    noise = mode.problem.trajectory_noise
    lengths = np.diff(np.append(np.flatnonzero(noise.first), len(noise.first)))
    longest = min(horizon, int(lengths.max()))
    steps = np.unique(np.geomspace(1, longest, min(longest, _LENGTHS)).round().astype(int))
    every = [forecast(mode.problem, mode.phi, sigma, int(n)) for n in steps]
    allowed = criteria.negligible * bodies_acceleration(mode.problem)
    told = forecast(mode.problem, mode.phi, sigma, longest, allowed=allowed)
    worst, p_value, name = 0.0, 1.0, ""
    dimensions = np.unique(told.dimension)
    for d in dimensions:
        own = told.dimension == d
        z = (told.error[:, own] ** 2 / told.variance[:, own])[np.isfinite(told.error[:, own])]
        if not z.size:
            continue
        # forecasts overlap by half, so that half of them count; a single one that a bad frame or a
        # grazing contact spoils is no misfit
        total = np.minimum(z, _FAR_OFF**2).sum() / 2
        chance = len(dimensions) * float(chi2.sf(total, max(z.size / 2, 1)))
        if np.sqrt(z.mean()) > worst:
            worst, p_value, name = float(np.sqrt(z.mean())), min(1.0, chance), STATE[d]
    passed = p_value > criteria.false_alarm or worst < criteria.worse_forecast
    dt = mode.problem.scene.time_step
    seconds = longest * dt
    sentence = f"forecasts of {seconds:g} s are as good as noise lets them be"
    if not passed:
        sentence = (
            f"after {seconds:g} s the error of {name} is {worst:.1f} times what noise and"
            f" {100 * criteria.negligible:g} % of the bodies' acceleration make"
        )
    growth = Growth(
        steps * dt, tuple(each.rmse() for each in every), tuple(each.floor() for each in every)
    )
    return ResidualTest(FORECASTS, p_value, worst, passed, sentence), growth
