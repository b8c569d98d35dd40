"""Likelihoods: of single transitions (Eqs. 11 and 12), and of whole trajectories."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Self, final

import numpy as np
from scipy.special import gammaln
from typing_extensions import TypeVar

from pbrl_ppl.likelihood.data import Observations
from pbrl_ppl.likelihood.trajectory_noise import Sensitivity, TrajectoryNoise
from pbrl_ppl.state import Bools, Floats

#: Medians of the noise parameters' prior, and the standard deviation of their logarithm.
NoisePrior = tuple[tuple[float, ...], float]
#: Degrees of freedom of Student-t noise, one for all or an array; None for a Gaussian.
Nu = float | Floats | None

#: Degrees of freedom from which on a Student-t counts as Gaussian.
GAUSSIAN = 1e7


@dataclass(frozen=True, eq=False, kw_only=True)
class Likelihood(ABC):
    """How measured next states scatter about predictions; one of three final classes.

    Arguments ``sigma`` hold all noise parameters, shape (..., parameter), and ``nu`` the degrees of
    freedom of Student-t noise, broadcasting against residuals; None or infinite for a Gaussian.

    Parameters
    ----------
    nu : float, optional
        Degrees of freedom of Student-t noise; Gaussian without it.
    prior : tuple, optional
        Medians of the noise parameters' prior, and its log-scale; by default they are taken from
        the data.

    Attributes
    ----------
    name : str
        As users choose it; see :func:`pbrl_ppl.physics_model`.
    """

    name: ClassVar[str]

    nu: float | None = None
    prior: NoisePrior | None = None

    @property
    def sensitivity(self) -> Sensitivity | None:
        """Derivative of the initial states by phi, where they follow the parameters."""
        return None

    def variables(self, observations: Observations) -> dict[str, tuple[str, ...]]:
        """Return the noise variables with the state dimensions of each, in the order of sigma.

        ``sigma`` with the measured dimensions, unless the likelihood has others.
        """
        return {"sigma": observations.names}

    def counts(self, observations: Observations) -> Floats:
        """Return the effective number of measurements of each dimension, shape (state,)."""
        return np.asarray(observations.measured.sum((0, 1, 2)), dtype=float)

    @property
    def scalar(self) -> bool:
        """Whether one sigma serves all state dimensions."""
        return False

    def free(self, sigma: Floats) -> Floats:
        """Return the noise parameters that are inferred, shape (..., free).

        The first of equal ones where sigma is a scalar.
        """
        return sigma[..., :1] if self.scalar else sigma

    def pooled(self, counts: Floats) -> Floats:
        """Return sums over the dimensions that share a noise parameter, shape (..., free)."""
        return counts.sum(axis=-1, keepdims=True) if self.scalar else counts

    def centre(self, medians: Floats) -> Floats:
        """Return the logarithm of the prior's medians, their mean for a scalar, shape (free,)."""
        logs = np.log(medians)
        return np.asarray(logs.mean(keepdims=True) if self.scalar else logs)

    def of_data(self) -> TransitionLikelihood:
        """Return the likelihood for other data, without what was linearised along these.

        Eq. 11 with the same tails and prior.
        """
        return TransitionLikelihood(scalar=self.scalar, nu=self.nu, prior=self.prior)

    def of_parameters(self) -> Self:
        """Return the likelihood for other parameters, without what follows from these."""
        return self

    def measuring(self, deviation: Floats) -> Self:
        """Return the likelihood of measurements that deviate so much from where it is linearised.

        ``deviation`` has shape (transition, H, body, state).
        """
        return self

    @abstractmethod
    def whiten(self, residual: Floats, sigma: Floats) -> Floats:
        """Return residuals in units of their noise, independent if the model is right.

        Parameters
        ----------
        residual : ndarray
            Shape (..., transition, H, body, state).
        sigma : ndarray
            Shape (parameter,) or (..., parameter) with the same leading axes.

        Returns
        -------
        ndarray
            Shape (..., transition, coordinate), dimensionless; 0 where nothing was measured.
        """

    @abstractmethod
    def in_order(self, values: Floats) -> Floats:
        """Return values of residuals, shape (..., transition, H, body, state), as whitened ones."""

    def whitened_nu(self, nu: Nu, shape: tuple[int, ...]) -> Nu:
        """Return the degrees of freedom of whitened residuals, from those of this shape."""
        if not isinstance(nu, np.ndarray) or nu.ndim == 0:
            return nu
        return self.in_order(np.broadcast_to(nu, shape))

    def robust(self, residual: Floats, sigma: Floats, nu: Nu) -> Floats:
        """Return least-squares residuals, shape as of :meth:`whiten`; see :func:`robust`."""
        return robust(self.whiten(residual, sigma), self.whitened_nu(nu, residual.shape))

    @abstractmethod
    def unwhitened_slope(self, pull: Floats, sigma: Floats, shape: tuple[int, ...]) -> Floats:
        """Return a slope by the residual, of this shape, from minus that by whitened residuals.

        ``pull`` has the shape of :meth:`whiten`.
        """

    def slope(self, residual: Floats, sigma: Floats, nu: Nu, weights: Floats) -> Floats:
        """Return the derivative of the sum of weighted log-densities by the residual.

        ``weights`` has shape (transition,); the result that of ``residual``.
        """
        pull = self.whiten(residual, sigma)
        nus = self.whitened_nu(nu, residual.shape)
        if nus is not None:
            heavy = np.less(nus, GAUSSIAN)
            nus = np.where(heavy, nus, 1.0)
            pull = np.where(heavy, (nus + 1) * pull / (nus + pull**2), pull)
        return self.unwhitened_slope(pull * weights[:, None], sigma, residual.shape)

    @abstractmethod
    def log_density(self, residual: Floats, sigma: Floats, measured: Bools, nu: Nu) -> Floats:
        """Return the log-likelihood of each transition, shape (..., transition).

        Minus infinity where the engine diverged. ``measured`` has shape (transition, H, body,
        state).
        """

    @abstractmethod
    def random(
        self, predicted: Floats, linearised: Floats, sigma: Floats, rng: np.random.Generator, nu: Nu
    ) -> Floats:
        """Draw measured next states by Eq. 13, shape of ``predicted``.

        Parameters
        ----------
        predicted, linearised : ndarray
            Predicted states and those of the observations, shape (transition, H, body, state).
        sigma : ndarray
            Shape (parameter,).
        rng : Generator
            Source of randomness.
        nu : float, ndarray or None
            Degrees of freedom.
        """


#: The likelihood of a problem or a mode; any without an argument.
LikelihoodT = TypeVar("LikelihoodT", bound=Likelihood, default=Likelihood, covariant=True)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class TransitionLikelihood(Likelihood):
    """Eq. 11: measured initial states are exact, and transitions independent of each other.

    Parameters
    ----------
    scalar : bool
        One sigma for all state dimensions, as in the paper; one a dimension by default.
    nu, prior
        As of :class:`Likelihood`.
    """

    name: ClassVar[str] = "transitions"

    scalar: bool = False

    @classmethod
    def declare(cls, sigma: str = "per_dimension", nu: float | None = None) -> TransitionLikelihood:
        """Return the likelihood of options as users give them.

        Raises
        ------
        ValueError
            If sigma is neither ``per_dimension`` nor ``scalar``, or nu is not above 0.
        """
        if sigma not in ("per_dimension", "scalar"):
            raise ValueError(f"sigma is {sigma!r}, expected 'per_dimension' or 'scalar'")
        if nu is not None and not 0 < nu < np.inf:
            raise ValueError(
                f"nu is {nu}, expected degrees of freedom above 0, or None for a Gaussian"
            )
        return cls(scalar=sigma == "scalar", nu=nu)

    def whiten(self, residual: Floats, sigma: Floats) -> Floats:
        """Return residuals over sigma, shape (..., transition, H * body * state)."""
        return self.in_order(residual / np.asarray(sigma)[..., None, None, None, :])

    def unwhitened_slope(self, pull: Floats, sigma: Floats, shape: tuple[int, ...]) -> Floats:
        """Return minus the pull over sigma."""
        return -pull.reshape(shape) / sigma

    def in_order(self, values: Floats) -> Floats:
        """Return one value a residual, shape (..., transition, H * body * state)."""
        return values.reshape(*values.shape[:-3], math.prod(values.shape[-3:]))

    def log_density(self, residual: Floats, sigma: Floats, measured: Bools, nu: Nu) -> Floats:
        """Return the log-likelihood of each transition (Eq. 11)."""
        axes = (-1, -2, -3)
        log_sigma = np.where(measured, np.log(sigma)[..., None, None, None, :], 0.0).sum(axes)
        norm = np.where(measured, log_norm(nu), 0.0).sum(axes)
        square = (self.robust(residual, sigma, nu) ** 2).sum(-1)
        return _finite(-0.5 * square - log_sigma + norm)

    def random(
        self, predicted: Floats, linearised: Floats, sigma: Floats, rng: np.random.Generator, nu: Nu
    ) -> Floats:
        """Draw next states by Eq. 13."""
        return next_state_random(predicted, sigma, rng, nu=nu)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class TrajectoryLikelihood(Likelihood):
    """Likelihood of whole trajectories, whose residuals share measured states.

    Parameters
    ----------
    noise : TrajectoryNoise
        The linearised trajectories.
    nu, prior
        As of :class:`Likelihood`.
    """

    name: ClassVar[str] = "trajectories"

    noise: TrajectoryNoise

    @property
    def sensitivity(self) -> Sensitivity | None:
        """Derivative of the smoothed initial states by phi."""
        return self.noise.sensitivity

    def variables(self, observations: Observations) -> dict[str, tuple[str, ...]]:
        """Return errors of measurement and unexplained accelerations."""
        return self.noise.coordinates.variables

    def of_parameters(self) -> TrajectoryLikelihood:
        """Return the same with smoothed states that do not follow the parameters."""
        return replace(self, noise=replace(self.noise, sensitivity=None))

    def measuring(self, deviation: Floats) -> TrajectoryLikelihood:
        """Return the same for other measurements; itself, with its gains, for these."""
        measured = self.noise.coordinates.of_residual(deviation)
        if np.array_equal(measured, self.noise.measured):
            return self
        return replace(self, noise=replace(self.noise, measured=measured))

    def unwhitened_slope(self, pull: Floats, sigma: Floats, shape: tuple[int, ...]) -> Floats:
        """Return the adjoint of the filter."""
        result = np.zeros(shape)
        body, place = self.noise.coordinates.in_residual
        result[:, 0, body, place] = self.noise.adjoint(pull, sigma)[1]
        return result

    def whiten(self, residual: Floats, sigma: Floats) -> Floats:
        """Return the innovations over their standard deviations."""
        return self.noise.whitened(residual, sigma)[0]

    def in_order(self, values: Floats) -> Floats:
        """Return one value an innovation, shape (..., transition, coordinate)."""
        return self.noise.coordinates.of_residual(values)

    def log_density(self, residual: Floats, sigma: Floats, measured: Bools, nu: Nu) -> Floats:
        """Return the log-density of each transition's measurements given those before."""
        z, log_scale = self.noise.whitened(residual, sigma)
        nu = self.whitened_nu(nu, residual.shape)
        norm = np.where(self.noise.seen, log_norm(nu), 0.0).sum(axis=-1)
        return _finite(norm - 0.5 * (robust(z, nu) ** 2).sum(-1) - log_scale)

    def random(
        self, predicted: Floats, linearised: Floats, sigma: Floats, rng: np.random.Generator, nu: Nu
    ) -> Floats:
        """Draw measured next states, given those before."""
        return self.noise.random(predicted, linearised, sigma, rng)


def noise_labels(variables: dict[str, tuple[str, ...]], scalar: bool) -> tuple[str, ...]:
    """Return labels of noise parameters, such as ``sigma[x]``; ``sigma`` for a scalar."""
    if scalar:
        return ("sigma",)
    return tuple(
        f"{name}[{dimension}]" for name, dimensions in variables.items() for dimension in dimensions
    )


def _finite(log_density: Floats) -> Floats:
    """Return log-densities with minus infinity where the engine diverged."""
    return np.where(np.isnan(log_density), -np.inf, log_density)


def robust(z: Floats, nu: Nu) -> Floats:
    """Return residuals whose half squares are the negative log-density up to a constant.

    Parameters
    ----------
    z : ndarray
        Residuals in units of their noise, any shape.
    nu : float, ndarray or None
        Degrees of freedom; None or infinite for a Gaussian, whose residuals stay as they are.

    Examples
    --------
    >>> robust(np.array([0.1, 30.0]), 4.0).round(2)
    array([0.11, 5.21])
    """
    if nu is None:
        return z
    heavy = np.less(nu, GAUSSIAN)
    nu = np.where(heavy, nu, 1.0)
    return np.asarray(np.where(heavy, np.sign(z) * np.sqrt((nu + 1) * np.log1p(z**2 / nu)), z))


def log_norm(nu: Nu) -> Floats:
    """Return the logarithm of a standard Student-t density (or normal one) at zero."""
    normal = np.asarray(-0.5 * math.log(2 * math.pi))
    if nu is None:
        return normal
    heavy = np.less(nu, GAUSSIAN)
    nu = np.where(heavy, nu, 1.0)
    norm = gammaln((nu + 1) / 2) - gammaln(nu / 2) - 0.5 * np.log(nu * np.pi)
    return np.asarray(np.where(heavy, norm, normal))


def next_state_random(
    predicted: Floats, sigma: Floats, rng: np.random.Generator, nu: Nu = None
) -> Floats:
    """Draw next states by Eq. 13, shape as ``predicted``: (..., transition, H, body, state)."""
    shape = predicted.shape
    if nu is None:
        z = rng.standard_normal(shape)
    elif np.ndim(nu) == 0:
        z = rng.standard_t(nu, shape)
    else:
        heavy = np.less(nu, GAUSSIAN)
        heavy_z = rng.standard_t(np.where(heavy, nu, 1.0), shape)
        z = np.where(heavy, heavy_z, rng.standard_normal(shape))
    return np.asarray(predicted + z * sigma)
