"""Univariate priors as data, bounds of a search, and finite differences."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import i0e
from scipy.stats import truncnorm

from pbrl_ppl.errors import ParameterError
from pbrl_ppl.state import Floats

FAMILIES = (
    "log_normal", "truncated_normal", "normal", "half_normal", "von_mises", "categorical"
)  # fmt: skip


@dataclass(frozen=True)
class Prior:
    """A univariate prior as data: a family of Table 1 (or a normal) and its hyper-parameters.

    Parameters
    ----------
    family : str
        ``log_normal``, ``truncated_normal``, ``normal``, ``half_normal``, ``von_mises`` or
        ``categorical``, over the whole numbers from ``lower`` to ``upper``.
    mu, sigma : float
        Location and scale; of the logarithm for ``log_normal``. A ``half_normal`` is a normal cut
        off at zero, about zero unless ``mu`` says otherwise. For ``von_mises``, ``mu`` is the mean
        direction and ``kappa`` the concentration; without any it is uniform on the circle.
    lower, upper : float
        Support of a truncated normal or a categorical distribution.
    kappa : float
        Concentration of a von Mises distribution, 0 or more.
    weights : tuple of float
        Of a categorical distribution's numbers, in proportion to their probabilities; without any
        all are equally probable.

    Raises
    ------
    ParameterError
        If the family is unknown, or the hyper-parameters make no distribution: a scale that is not
        above 0, a number that is not finite, an empty support, or one so far from ``mu`` that the
        density underflows.

    Examples
    --------
    >>> Prior("truncated_normal", mu=0.5, sigma=1.0, lower=0.0, upper=1.0).support
    (0.0, 1.0)
    """

    family: str
    mu: float = 0.0
    sigma: float = 1.0
    lower: float = -np.inf
    upper: float = np.inf
    kappa: float = 1.0
    weights: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            near = difflib.get_close_matches(str(self.family), FAMILIES, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise ParameterError(
                f"prior family {self.family!r} is unknown{hint} (known: {', '.join(FAMILIES)})"
            )
        for key in ("mu", "sigma", "kappa"):
            value = getattr(self, key)
            if not np.isfinite(value):
                raise ParameterError(f"{self.family}: {key} is {value}, expected a finite number")
            if key == "sigma" and value <= 0:
                raise ParameterError(f"{self.family}: {key} is {value}, expected more than 0")
            if key == "kappa" and value < 0:
                raise ParameterError(f"{self.family}: {key} is {value}, expected 0 or more")
        if self.family not in ("truncated_normal", "half_normal"):
            return
        lower, upper = self.support
        if not lower < upper:
            raise ParameterError(
                f"{self.family}: lower is {lower} and upper {upper}, expected lower below upper"
            )
        farthest = 30.0  # sigmas of mu outside the support: beyond, densities lose their digits
        away = max(lower - self.mu, self.mu - upper) / self.sigma
        if away > farthest:
            raise ParameterError(
                f"{self.family}: mu is {self.mu:g}, {away:.3g} sigma outside the support"
                f" [{lower:g}, {upper:g}], where the density underflows; expected at most"
                f" {farthest:g}; move mu towards the support or widen sigma"
            )

    def scaled(self, factor: float, origin: float = 0.0) -> Prior:
        """Return the prior of ``origin`` plus so many times the value.

        Raises
        ------
        ParameterError
            If the family has no scale: ``von_mises`` and ``categorical``, or an ``origin`` of
            positive values.

        Examples
        --------
        >>> Prior("half_normal", sigma=0.5).scaled(20.0).sigma
        10.0
        """
        positive = ("log_normal", "half_normal") if origin else ()
        if self.family in ("von_mises", "categorical", *positive):
            raise ParameterError(f"{self.family}: it has no scale; expected a prior of a size")
        if self.family == "log_normal":
            return replace(self, mu=self.mu + float(np.log(factor)))
        ends = {key: origin + factor * getattr(self, key) for key in ("mu", "lower", "upper")}
        return replace(self, sigma=factor * self.sigma, **ends)

    @property
    def scale(self) -> float:
        """Typical change of a value, for steps of derivatives."""
        if self.family == "log_normal":
            return min(self.sigma, 1.0) * self.centre
        if self.family in ("von_mises", "categorical"):
            return 1.0
        return min(self.sigma, self.upper - self.lower)

    @property
    def support(self) -> tuple[float, float]:
        """Smallest and largest value that the prior allows."""
        if self.family in ("log_normal", "half_normal"):
            return 0.0, np.inf
        if self.family in ("truncated_normal", "categorical"):
            return self.lower, self.upper
        return -np.inf, np.inf

    @property
    def hyper_names(self) -> tuple[str, str]:
        """Names of the two hyper-parameters that a scene may declare."""
        return ("mu", "kappa") if self.family == "von_mises" else ("mu", "sigma")

    @property
    def discrete(self) -> bool:
        """Whether the prior is categorical: its values are indices of names."""
        return self.family == "categorical"

    @property
    def probabilities(self) -> Floats:
        """Probabilities of a discrete prior's numbers from ``lower`` up, shape (number,)."""
        n = int(self.upper - self.lower) + 1
        weights = np.array(self.weights or (1.0,) * n)
        return np.asarray(weights / weights.sum())

    @property
    def uniform(self) -> bool:
        """Whether it is an angle's uniform prior: a von Mises with kappa 0."""
        return self.family == "von_mises" and self.kappa == 0

    @property
    def centre(self) -> float:
        """A central value inside the support."""
        if self.family == "log_normal":
            return float(np.exp(self.mu))
        if self.family == "half_normal":
            return max(self.mu, 0.6745 * self.sigma)
        if self.discrete:
            return self.lower
        return float(np.clip(self.mu, *self.support))

    def in_words(self, unit: str) -> str:
        """Return the prior of a value in this unit as text; ``1`` is no unit.

        Examples
        --------
        >>> Prior("half_normal", sigma=20.0).in_words("kg/s")
        'half-normal, 20 kg/s'
        >>> Prior("log_normal", mu=1.0, sigma=1.5).in_words("kg")
        'log-normal, median 2.72 kg, sigma 1.5'
        """
        name, unit = self.family.replace("_", "-"), f" {unit}" if unit != "1" else ""
        if self.family == "log_normal":
            return f"{name}, median {self.centre:.3g}{unit}, sigma {self.sigma:.3g}"
        if self.uniform:
            return "uniform on the circle"
        if self.family == "von_mises":
            return f"{name}, about {self.mu:.3g}{unit}, kappa {self.kappa:.3g}"
        about = f"{self.mu:.3g} ± " if self.mu else ""
        ends = f", in [{self.lower:.3g}, {self.upper:.3g}]" if np.isfinite(self.upper) else ""
        return f"{name}, {about}{self.sigma:.3g}{unit}{ends}"

    def residual(self, x: Floats) -> Floats:
        """Return the residual: half its square is the negative log-density up to a constant.

        Parameters
        ----------
        x : ndarray
            Values inside the support, any shape.

        Returns
        -------
        ndarray
            Residuals, dimensionless, same shape.
        """
        if self.family == "log_normal":
            # -log p = log x + (log x - mu)^2 / 2 sigma^2: a square about mu - sigma^2
            safe = np.log(np.maximum(x, 1e-300))
            return np.asarray((safe - self.mu + self.sigma**2) / self.sigma)
        if self.discrete:
            return np.zeros_like(x)
        if self.family == "von_mises":
            return np.asarray(2.0 * np.sqrt(self.kappa) * np.sin((x - self.mu) / 2.0))
        return np.asarray((x - self.mu) / self.sigma)

    def slope(self, x: Floats) -> Floats:
        """Return the derivative of :meth:`residual`, same shape."""
        if self.family == "log_normal":
            return np.asarray(1.0 / (self.sigma * np.maximum(x, 1e-300)))
        if self.discrete:
            return np.zeros_like(x)
        if self.family == "von_mises":
            return np.asarray(np.sqrt(self.kappa) * np.cos((x - self.mu) / 2.0))
        return np.full_like(x, 1.0 / self.sigma)

    def log_density(self, x: Floats) -> Floats:
        """Return the logarithm of the normalised density, minus infinity outside the support.

        Parameters
        ----------
        x : ndarray
            Values, any shape.

        Returns
        -------
        ndarray
            Same shape; of a discrete prior the log-probability.

        Examples
        --------
        >>> float(Prior("normal", sigma=2.0).log_density(np.array(0.0)).round(3))
        -1.612
        """
        x = np.asarray(x, dtype=float)
        lower, upper = self.support
        if self.discrete:
            with np.errstate(divide="ignore"):
                table = np.log(self.probabilities)
            place = np.clip(np.rint(x - lower), 0, len(table) - 1).astype(int)
            return np.asarray(np.where(x - lower == place, table[place], -np.inf))
        there = (x >= lower) & (x <= upper) & ((x > 0) | (self.family != "log_normal"))
        density = self._log_norm - 0.5 * self.residual(x) ** 2
        return np.asarray(np.where(there, density, -np.inf))

    @cached_property
    def _log_norm(self) -> float:
        """Log-density where the residual is zero."""
        if self.family == "von_mises":
            return -float(np.log(2.0 * np.pi * i0e(self.kappa)))
        normal = -0.5 * float(np.log(2.0 * np.pi)) - float(np.log(self.sigma))
        if self.family == "log_normal":
            return normal - self.mu + 0.5 * self.sigma**2
        if self.family in ("truncated_normal", "half_normal"):
            ends = (np.array(self.support) - self.mu) / self.sigma
            centre = self.centre
            law = truncnorm(*ends, self.mu, self.sigma)
            return float(law.logpdf(centre) + 0.5 * self.residual(np.array(centre)) ** 2)
        return normal

    def sample(self, rng: np.random.Generator, size: int) -> Floats:
        """Return ``size`` draws."""
        if self.family == "log_normal":
            return rng.lognormal(self.mu, self.sigma, size)
        if self.family == "von_mises":
            return rng.vonmises(self.mu, self.kappa, size)
        if self.discrete:
            p = self.probabilities
            return self.lower + rng.choice(len(p), size=size, p=p).astype(float)
        if self.family == "half_normal" and not self.mu:
            return np.abs(rng.normal(0.0, self.sigma, size))
        if self.family in ("truncated_normal", "half_normal"):
            ends = (np.array(self.support) - self.mu) / self.sigma
            draws = truncnorm.rvs(*ends, self.mu, self.sigma, size=size, random_state=rng)
            return np.asarray(np.clip(draws, *self.support))
        return rng.normal(self.mu, self.sigma, size)


def prior_draws(priors: Sequence[Prior], rng: np.random.Generator, n: int) -> Floats:
    """Return independent draws from each prior, shape (n, p)."""
    columns = [prior.sample(rng, n) for prior in priors]
    return np.stack(columns, axis=1) if columns else np.zeros((n, 0))


def prior_residual(priors: Sequence[Prior], phi: Floats) -> Floats:
    """Return each prior's least-squares residual, shape (..., p)."""
    columns = [prior.residual(phi[..., i]) for i, prior in enumerate(priors)]
    return np.stack(columns, axis=-1) if columns else np.zeros_like(phi)


def prior_slopes(priors: Sequence[Prior], phi: Floats) -> Floats:
    """Return the derivative of each prior's residual by its parameter, shape (p,)."""
    slopes = [prior.slope(x) for prior, x in zip(priors, phi, strict=True)]
    return np.array(slopes, dtype=float).reshape(len(priors))


def inside(priors: Sequence[Prior], phi: Floats) -> Floats:
    """Return values moved just inside their supports, shape (..., p)."""
    lower, upper = box(priors)
    return np.clip(phi, lower, upper)


def stepped(priors: Sequence[Prior], phi: Floats, step: Floats, *, most: float = 10.0) -> Floats:
    """Return values a step on, just inside their supports, shape (p,).

    A log-normal one, such as a mass, changes by the factor ``most`` at most: at the end of its
    support, where a long step would lead, motion is too fast to simulate.
    """
    positive = np.array([prior.family == "log_normal" for prior in priors], dtype=bool)
    end = np.where(positive, np.clip(phi + step, phi / most, phi * most), phi + step)
    return inside(priors, end)


def box(priors: Sequence[Prior], *, margin: float = 1e-6) -> tuple[Floats, Floats]:
    """Return the bounds of a search: the supports less a margin, which discrete priors lack.

    ``margin``: how far inside a bound the search stays, as a share of the prior's scale.
    """
    support = np.array([prior.support for prior in priors]).reshape(-1, 2)
    width = np.array([prior.scale for prior in priors])
    width[[prior.discrete for prior in priors]] = 0.0
    return support[:, 0] + margin * width, support[:, 1] - margin * width


def covariance_factor(covariance: Floats) -> Floats:
    """Return the Cholesky factors of covariances, which may be singular, shape (..., n, n).

    With 1e-12 of the variances added: more than rounding takes from the least eigenvalue.
    """
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)[..., None]
    sd = np.sqrt(np.maximum(variance, 1e-300))
    correlation = covariance / sd / sd.swapaxes(-1, -2) + 1e-12 * np.eye(covariance.shape[-1])
    return np.asarray(sd * np.linalg.cholesky(correlation), dtype=float)


def differentiate(
    function: Callable[[Floats], Floats], point: Floats, steps: Floats, lower: Floats, upper: Floats
) -> Floats:
    """Return a derivative by finite differences: central, or one-sided at a bound.

    Parameters
    ----------
    function : callable
        Takes points of shape (2 p, p), gives values of shape (2 p, ...).
    point, steps, lower, upper : ndarray
        Point, step and bounds of each parameter, shape (p,); a step of zero leaves its column zero.

    Returns
    -------
    ndarray
        Shape (..., p).

    Examples
    --------
    >>> x, far = np.array([3.0]), np.array([np.inf])
    >>> differentiate(lambda points: points[:, 0] ** 2, x, np.array([1e-4]), -far, far).round(6)
    array([6.])
    """
    forward = np.minimum(point + steps, upper)
    backward = np.maximum(point - steps, lower)
    p = len(point)
    points = np.tile(point, (2 * p, 1))
    points[np.arange(p), np.arange(p)] = forward
    points[p + np.arange(p), np.arange(p)] = backward
    values = function(points)
    width = np.maximum(forward - backward, 1e-300)
    return np.asarray(np.moveaxis(values[:p] - values[p:], 0, -1) / width)
