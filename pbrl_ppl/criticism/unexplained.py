"""Unexplained acceleration: what a step adds beyond the model, beside what the bodies do."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.likelihood import bodies_acceleration
from pbrl_ppl.modes import NOTHING, Mode, profile_sigma
from pbrl_ppl.state import STATE

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Left:
    """Unexplained acceleration of a model, shape (velocity,) each.

    Parameters
    ----------
    names : tuple of str
        Velocities.
    size : ndarray
        Standard deviation, m/s^2 and rad/s^2.
    relative : ndarray
        The same over the root mean square acceleration of the bodies.
    p_value : ndarray
        Of the likelihood ratio against none.
    numerical : ndarray
        Change of the bodies' accelerations if the substeps are doubled, root mean square, as size.
    criteria : Criteria
        What is significant, and what negligible.
    """

    names: tuple[str, ...]
    size: Array
    relative: Array
    p_value: Array
    numerical: Array
    criteria: Criteria = DEFAULT

    @property
    def certain(self) -> NDArray[np.bool_]:
        """Which are significant."""
        return np.asarray(self.p_value * len(self.names) < self.criteria.false_alarm)

    @property
    def beyond_engine(self) -> NDArray[np.bool_]:
        """Which are larger than what engines make of the same model."""
        return np.asarray(self.size > self.criteria.engines * self.numerical)

    @property
    def matters(self) -> NDArray[np.bool_]:
        """Which are significant, beyond the engine's error, and not negligible."""
        large = self.relative >= self.criteria.negligible
        return np.asarray(self.remains & large)

    @property
    def remains(self) -> NDArray[np.bool_]:
        """Which are significant and beyond the engine's error, negligible or not."""
        return np.asarray(self.certain & self.beyond_engine)

    @property
    def worst(self) -> float:
        """Largest relative one among those that are certain; 0 without any."""
        return float(np.where(self.certain, self.relative, 0.0).max(initial=0.0))

    @property
    def square(self) -> float:
        """Sum of squares of the relative ones that are certain."""
        return float((np.where(self.certain, self.relative, 0.0) ** 2).sum())


def unexplained_acceleration(mode: Mode, criteria: Criteria = DEFAULT) -> Left:
    """Size of the acceleration that the model of a mode leaves unexplained."""
    noise = mode.problem.trajectory_noise
    cells = noise.cells
    size = mode.sigma[cells.accelerations]
    relative = size / np.maximum(bodies_acceleration(mode.problem), 1e-300)
    names = tuple(STATE[d] for d in cells.rates)
    return Left(names, size, relative, _p_values(mode), _numerical(mode), criteria)


def noise_alone(mode: Mode, left: Left) -> Array:
    """Noise parameters as they are if what is not certain is nothing, shape (parameter,).

    Few data do not tell an error of measuring from what a step adds: the mode gives all to one.
    """
    problem, places = mode.problem, mode.problem.trajectory_noise.cells.accelerations
    held = {
        place: NOTHING * problem.noise_prior[0][place]
        for place, certain in zip(places, left.certain, strict=True)
        if not certain
    }
    return profile_sigma(problem, problem.residual(mode.phi), mode.phi, held)


def without_acceleration(mode: Mode) -> Mode:
    """The mode with the noise parameters that it has without any unexplained acceleration.

    That is a random force, and follows what is smooth: scores of such effects are small beside it.
    """
    problem = mode.problem
    places = problem.trajectory_noise.cells.accelerations
    held = {place: NOTHING * problem.noise_prior[0][place] for place in places}
    sigma = profile_sigma(problem, problem.residual(mode.phi), mode.phi, held)
    return replace(mode, sigma=sigma)


def innovations_over_steps(mode: Mode) -> Array:
    """Typical size of each cell's innovations as a share of what a step changes, shape (cell,)."""
    noise, segments = mode.problem.trajectory_noise, mode.problem.segments
    cells, dt = noise.cells, mode.problem.scene.time_step
    change = segments.observed[:, 0] - segments.start
    body, dimension = np.divmod(cells.places, len(STATE))
    velocity = np.where(dimension < 3, dimension + 3, dimension)
    typical = np.sqrt(np.mean(change[:, body, velocity] ** 2, axis=0))
    step = np.where(dimension < 3, dt * typical, typical)
    return np.asarray(np.median(noise.scale(mode.sigma), axis=0) / np.maximum(step, 1e-300))


def _numerical(mode: Mode) -> Array:
    """Change of accelerations if the substeps are doubled, root mean square, shape (velocity,)."""
    problem, cells = mode.problem, mode.problem.trajectory_noise.cells
    finer = problem.with_physics(substeps=2 * problem.physics.substeps)
    change = cells.of((finer.predict(mode.phi) - problem.predict(mode.phi))[:, 0])
    square = np.nanmean(change**2, axis=0) / problem.scene.time_step**2
    dimension = cells.places % len(STATE)
    return np.array([np.sqrt(square[dimension == d].mean()) for d in cells.rates])


def _p_values(mode: Mode) -> Array:
    """Likelihood-ratio test of each acceleration against none, the other noises free.

    At the edge of what a variance may be: half a chi-squared with one degree of freedom.
    """
    problem = mode.problem
    residual = problem.residual(mode.phi)
    median = problem.noise_prior[0]

    def best(sigma: Array) -> float:
        return float(problem.log_density(residual, sigma, mode.phi).sum())

    places = problem.trajectory_noise.cells.accelerations
    here, p_values = best(mode.sigma), np.empty(len(places))
    for i, place in enumerate(places):
        held = {place: NOTHING * median[place]}
        without = profile_sigma(problem, residual, mode.phi, held)
        p_values[i] = 0.5 * chi2.sf(max(2 * (here - best(without)), 0.0), 1)
    return p_values
