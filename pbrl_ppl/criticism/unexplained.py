"""Unexplained acceleration: process noise of a fitted model, beside the bodies' motion."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.likelihood import bodies_acceleration
from pbrl_ppl.modes import NOTHING, FilteredMode, profile_sigma
from pbrl_ppl.state import STATE, Bools, Floats


@dataclass(frozen=True, eq=False)
class UnexplainedAcceleration:
    """Unexplained acceleration of a model, shape (velocity,) each.

    Parameters
    ----------
    names : tuple of str
        Names of the velocities.
    size : ndarray
        Standard deviation, m/s^2 and rad/s^2.
    relative : ndarray
        The same over the root mean square acceleration of the bodies.
    p_value : ndarray
        P-value of the likelihood ratio against none.
    numerical : ndarray
        Root mean square change of the bodies' accelerations if the substeps are doubled, in the
        units of size.
    criteria : Criteria
        Thresholds of significant and of negligible.
    """

    names: tuple[str, ...]
    size: Floats
    relative: Floats
    p_value: Floats
    numerical: Floats
    criteria: Criteria = DEFAULT

    def by_name(self, values: Floats) -> dict[str, float]:
        """Return values of the velocities, shape (velocity,), by name."""
        return dict(zip(self.names, values.tolist(), strict=True))

    @property
    def certain(self) -> Bools:
        """Return which are significant."""
        return np.asarray(self.p_value * len(self.names) < self.criteria.false_alarm)

    @property
    def beyond_engine(self) -> Bools:
        """Return which are larger than the engine's numerical error."""
        return np.asarray(self.size > self.criteria.engine.error_factor * self.numerical)

    @property
    def matters(self) -> Bools:
        """Return which are significant, beyond the engine's error, and not negligible."""
        large = self.relative >= self.criteria.negligible
        return np.asarray(self.remains & large)

    @property
    def remains(self) -> Bools:
        """Return which are significant and beyond the engine's error, negligible or not."""
        return np.asarray(self.certain & self.beyond_engine)

    @property
    def largest(self) -> int:
        """Return the place of the largest relative one: of those that matter, or are significant.

        Of all where none is significant.
        """
        chosen = next((one for one in (self.matters, self.certain) if one.any()), self.size >= 0)
        return int(np.argmax(np.where(chosen, self.relative, -1.0)))

    @property
    def worst(self) -> float:
        """Return the largest relative one among those that are significant; 0 without any."""
        return float(np.where(self.certain, self.relative, 0.0).max(initial=0.0))


def unexplained_acceleration(
    mode: FilteredMode, criteria: Criteria = DEFAULT
) -> UnexplainedAcceleration:
    """Return the acceleration that a fitted model leaves unexplained."""
    noise = mode.problem.likelihood.noise
    coordinates = noise.coordinates
    size = mode.sigma[coordinates.accelerations]
    relative = size / np.maximum(bodies_acceleration(mode.problem), 1e-300)
    names = tuple(STATE[d] for d in coordinates.rates)
    return UnexplainedAcceleration(
        names, size, relative, _p_values(mode), _numerical(mode), criteria
    )


def noise_alone(mode: FilteredMode, excess: UnexplainedAcceleration) -> Floats:
    """Return noise parameters without accelerations that are not significant, shape (parameter,).

    Few data do not tell measurement noise from process noise: the mode gives all to one of them.
    """
    places = mode.problem.likelihood.noise.coordinates.accelerations
    pairs = zip(places, excess.certain, strict=True)
    negligible = [place for place, certain in pairs if not certain]
    return _without(mode, negligible, mode.problem.residual(mode.phi))


def noise_without_unexplained(mode: FilteredMode, excess: UnexplainedAcceleration) -> Floats:
    """Return the noise parameters without accelerations that matter, shape (parameter,)."""
    sigma = mode.sigma.copy()
    places = np.array(mode.problem.likelihood.noise.coordinates.accelerations)
    sigma[places[excess.matters]] = NOTHING
    return sigma


def without_acceleration(mode: FilteredMode) -> FilteredMode:
    """Return the mode with the noise parameters that it has without unexplained acceleration.

    A random force follows smooth effects: their scores are small beside it.
    """
    places = mode.problem.likelihood.noise.coordinates.accelerations
    return replace(mode, sigma=_without(mode, places, mode.problem.residual(mode.phi)))


def _without(mode: FilteredMode, places: Iterable[int], residual: Floats) -> Floats:
    """Return the noise parameters that are best if those at some places are next to nothing."""
    fixed = {place: NOTHING * mode.problem.noise_prior[0][place] for place in places}
    return profile_sigma(mode.problem, residual, mode.phi, fixed)


def innovations_over_steps(mode: FilteredMode) -> Floats:
    """Return the typical innovations over the change in a step, shape (coordinate,)."""
    noise, segments = mode.problem.likelihood.noise, mode.problem.segments
    coordinates, dt = noise.coordinates, mode.problem.scene.time_step
    change = segments.observed[:, 0] - segments.start
    body, dimension = np.divmod(coordinates.places, len(STATE))
    velocity = np.where(dimension < 3, dimension + 3, dimension)
    typical = np.sqrt(np.mean(change[:, body, velocity] ** 2, axis=0))
    step = np.where(dimension < 3, dt * typical, typical)
    return np.asarray(np.median(noise.scale(mode.sigma), axis=0) / np.maximum(step, 1e-300))


def _numerical(mode: FilteredMode) -> Floats:
    """Return the rms change of accelerations if the substeps are doubled, shape (velocity,)."""
    problem, coordinates = mode.problem, mode.problem.likelihood.noise.coordinates
    finer = problem.with_physics(substeps=2 * problem.physics.substeps)
    change = coordinates.of((finer.predict(mode.phi) - problem.predict(mode.phi))[:, 0])
    square = np.nanmean(change**2, axis=0) / problem.scene.time_step**2
    dimension = coordinates.places % len(STATE)
    return np.array([np.sqrt(square[dimension == d].mean()) for d in coordinates.rates])


def _p_values(mode: FilteredMode) -> Floats:
    """Return p-values of the likelihood ratio of each acceleration against none.

    The other noises are free. At the bound of a variance: half a chi-squared with one degree.
    """
    problem = mode.problem
    residual = problem.residual(mode.phi)

    def best(sigma: Floats) -> float:
        return float(problem.log_density(residual, sigma, mode.phi).sum())

    here = best(mode.sigma)
    places = problem.likelihood.noise.coordinates.accelerations
    gains = [here - best(_without(mode, [place], residual)) for place in places]
    return np.asarray([0.5 * chi2.sf(max(2 * gain, 0.0), 1) for gain in gains])
