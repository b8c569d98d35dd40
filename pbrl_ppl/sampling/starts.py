"""Space of the samplers: transforms, log-density, Laplace approximation and starting points."""

from __future__ import annotations

from functools import reduce
from typing import Any

import numpy as np
import pymc as pm
from scipy.linalg import block_diag
from scipy.special import expit

from pbrl_ppl.likelihood import Problem, TrajectoryLikelihood, TransitionLikelihood
from pbrl_ppl.modes import Mode
from pbrl_ppl.parameters import Prior, Wheel, gathered, inside, wheels
from pbrl_ppl.posterior import group, parameter_draws
from pbrl_ppl.sampling.metropolis import Gaussian
from pbrl_ppl.state import Floats

#: Distances at which a posterior is evaluated (standard deviations), and the fall (nats) from which
#: a point is outside; a Gaussian falls by 2 at the first.
_FAR, _LOW = (2.0, 4.0, 8.0, 16.0), 2.5
#: Steps of the noise a round; along trajectories one of the two noises may vanish.
_CHEAP, _CHEAP_ALONG = 5, 30


def gaussian_blocks(model: pm.Model, mode: Mode) -> list[Gaussian]:
    """Return blocks from the Laplace approximation: one a part of the scene, one for the noise."""
    problem = mode.problem
    places, offset = {}, 0
    point = blank_point(model, problem)
    for variable in model.continuous_value_vars:
        size = point[variable.name].size
        places[model.values_to_rvs[variable].name] = np.arange(offset, offset + size)
        offset += size
    where = np.concatenate([np.zeros(0, int), *(places[b.name] for b in problem.layout.blocks)])
    mean, covariance = laplace(problem, mode)
    blocks = [
        Gaussian(where[i], mean[i], covariance[np.ix_(i, i)])
        for i in (part.places for part in problem.simulator.parts)
        if len(i)
    ]
    entries = np.concatenate([places[name] for name in problem.noise_variables])
    noise_mean, noise_covariance = noise_block(mode)
    # along trajectories each change of the noise costs a run of the filter: a block by itself
    independent = isinstance(problem.likelihood, TransitionLikelihood)
    if len(blocks) == 1 and independent:
        (only,) = blocks
        both = np.concatenate([only.places, entries]), np.concatenate([only.mean, noise_mean])
        return [Gaussian(*both, block_diag(only.covariance, noise_covariance))]
    cheap = _CHEAP if independent else _CHEAP_ALONG
    return [*blocks, Gaussian(entries, noise_mean, noise_covariance, cheap)]


def noise_block(mode: Mode) -> tuple[Floats, Floats]:
    """Return the Laplace approximation of the logarithm of the free noise parameters.

    Shapes (free,) and (free, free).
    """
    problem = mode.problem
    if isinstance(problem.likelihood, TrajectoryLikelihood):
        return mode.noise_gaussian()
    # the variance of log sigma is half the inverse of the number of measurements
    counts = problem.likelihood.pooled(problem.likelihood.counts(problem.observations))
    covariance = np.diag(0.5 / np.maximum(counts, 1))
    return problem.likelihood.free(np.log(mode.sigma)), covariance


def blank_point(model: pm.Model, problem: Problem) -> dict[str, Floats]:
    """Return zeros of the shapes of the continuous variables, by their names in the sampler.

    ``model.initial_point()`` would compile a function.
    """
    shapes: dict[str, tuple[int, ...]] = {b.name: (len(b.owners),) for b in problem.layout.blocks}
    shapes |= {name: (len(own),) for name, own in problem.noise_variables.items()}
    if problem.scalar_sigma:
        shapes["sigma"] = ()
    return {
        value.name: np.zeros(shapes[model.values_to_rvs[value].name])
        for value in model.continuous_value_vars
    }


def unconstrain(prior: Prior, x: Any) -> tuple[Any, Any]:
    """Return PyMC's unconstraining transform of a prior's variable at x, and its derivative.

    Numbers or arrays of any shape.
    """
    if prior.family in ("log_normal", "half_normal"):
        return np.log(x), 1.0 / x
    if prior.family == "truncated_normal":
        left, right = x - prior.lower, prior.upper - x
        return np.log(left / right), 1.0 / left + 1.0 / right
    return x, np.ones_like(x)


def constrain(prior: Prior, u: Any) -> Any:
    """Return the inverse of :func:`unconstrain`."""
    if prior.family in ("log_normal", "half_normal"):
        return np.exp(u)
    if prior.family == "truncated_normal":
        return prior.lower + (prior.upper - prior.lower) * expit(u)
    return u


def laplace(problem: Problem, mode: Mode) -> tuple[Floats, Floats]:
    """Return mode and Laplace covariance in the sampler's space, no wider than a prior's."""
    pairs = map(unconstrain, problem.layout.priors, mode.phi)
    mean, scale = np.array(list(pairs)).reshape(-1, 2).T
    covariance = scale[:, None] * mode.covariance * scale
    covariance = widened(problem, mode, mean, covariance)
    deviation = np.sqrt(np.diag(covariance))
    widest = [p.sigma if p.family == "normal" else 2.0 for p in problem.layout.priors]
    shrink = np.minimum(deviation, widest) / deviation
    covariance = shrink[:, None] * covariance * shrink
    return mean, covariance + 1e-12 * np.diag(np.diag(covariance))


def widened(problem: Problem, mode: Mode, mean: Floats, covariance: Floats) -> Floats:
    """Return a covariance in the sampler's space, widened where the posterior falls off slowly.

    At a kink, or with few contacts, the curvature overstates how well a parameter is known, and an
    adapting chain would take long to find that.

    Parameters
    ----------
    problem : Problem
        Defines the posterior.
    mode : Mode
        Point of the covariance, with its noise.
    mean, covariance : ndarray
        The mode in the sampler's space and its Laplace covariance, shapes (p,) and (p, p).
    """
    if not len(mean):
        return covariance
    variance = np.diag(covariance)
    ends = np.array([*_FAR, *(-far for far in _FAR)])[:, None]
    top = _log_density(problem, mean[None], mode.sigma)
    stretch = np.ones(len(mean))
    # one parameter at a time: each point is a simulation of all data
    for i, step in enumerate(np.diag(np.sqrt(variance))):
        fall = top - _log_density(problem, mean + ends * step, mode.sigma)
        # on either side, up to the first point that has fallen
        inside = np.nan_to_num(fall.reshape(2, -1), nan=np.inf) < _LOW
        steps = np.logical_and.accumulate(inside, axis=1).sum(axis=1)
        stretch[i] = np.array([_FAR[0], *_FAR])[steps].mean() / _FAR[0]
    return np.asarray(covariance + np.diag(variance * (stretch**2 - 1.0)))


def _log_density(problem: Problem, u: Floats, sigma: Floats) -> Floats:
    """Return the log-posterior up to a constant at points (point, p) of the sampler's space.

    It is -inf on numerical overflow: at a mass of zero, or at the end of a support.
    """
    priors, height = problem.layout.priors, np.full(len(u), -np.inf)
    with np.errstate(all="ignore"):
        phi = np.column_stack([constrain(prior, u[:, i]) for i, prior in enumerate(priors)])
        slopes = [unconstrain(prior, phi[:, i])[1] for i, prior in enumerate(priors)]
        slope = np.log(np.column_stack(slopes)).sum(axis=1)
        there = np.isfinite(phi).all(axis=1) & np.isfinite(slope)
        if there.any():
            x = phi[there]
            likelihood = problem.log_density(problem.residual(x), sigma, x).sum(axis=-1)
            height[there] = likelihood + problem.layout.log_prior(x).sum(axis=-1) - slope[there]
    return height


def dispersed(mode: Mode, rng: np.random.Generator, chains: int) -> list[dict[str, Floats]]:
    """Draw starts about two posterior standard deviations from the mode, one a chain."""
    problem, priors = mode.problem, mode.problem.layout.priors
    # the 2 % and 98 % quantiles of the priors, by simulation, limit the starts
    samples = (prior.sample(np.random.default_rng(0), 2000) for prior in priors)
    quantiles = [np.quantile(sample, [0.02, 0.98]) for sample in samples]
    low, high = np.array(quantiles).reshape(-1, 2).T
    factor, starts = mode.factor, []
    centre, wide = np.log(mode.sigma), np.full(len(mode.sigma), 0.1)
    if isinstance(problem.likelihood, TrajectoryLikelihood):
        centre, covariance = mode.noise_gaussian()
        wide = np.minimum(2.0 * np.sqrt(np.diag(covariance)), 2.0)
    for _ in range(chains):
        moved = mode.phi + 2.0 * factor @ rng.standard_normal(len(mode.phi))
        moved = np.where((moved < low) | (moved > high), mode.phi, moved)
        sigma = np.exp(centre + wide * rng.standard_normal(len(centre)))
        starts.append(problem.named(inside(priors, moved), sigma))
    return starts


def from_posterior(problem: Problem, idata: Any) -> tuple[Mode, list[dict[str, Floats]]]:
    """Return a Gaussian approximation of a posterior, as a mode, and the last draw of each chain.

    Parameters
    ----------
    problem : Problem
        Of the same scene, effects and measured dimensions, as :func:`linearised_as` checks.
    idata : InferenceData or DataTree
        The posterior.

    Returns
    -------
    mode : Mode
        At the mean, with the draws' covariance.
    starts : list of dict
        One point a chain.
    """
    posterior = group(idata, "posterior")
    phi, sigma = parameter_draws(problem, idata)
    phi = gathered(problem.layout, phi)
    covariance = np.cov(phi, rowvar=False).reshape(2 * (problem.layout.size,))
    jacobian = np.zeros((problem.observations.values.size, problem.layout.size))
    mode = Mode(problem, phi.mean(axis=0), sigma.mean(axis=0), jacobian, covariance, np.nan)
    chains, draws = posterior.sizes["chain"], posterior.sizes["draw"]
    last = np.arange(1, chains + 1) * draws - 1
    return mode, [problem.named(phi[i], sigma[i]) for i in last]


def evened_logp(model: pm.Model, problem: Problem) -> Any:
    """Return a correction of the model's log-density: `parameters.evened` as an expression.

    With it the prior of each wheel is the same for all its equal descriptions, so that one mode
    stands for all. The description of each draw is chosen afterwards (`parameters.redescribed`).

    Parameters
    ----------
    model : pymc.Model
        The model of ``problem``.
    problem : Problem
        Says which wheels are unknown.

    Returns
    -------
    tensor or float
        In terms of the model's value variables; zero where every prior is even.
    """
    uneven = [wheel for wheel in wheels(problem.layout) if wheel.period > 1]
    if not uneven:
        return 0.0
    change = sum(_evened(model, problem, wheel) for wheel in uneven)
    return model.replace_rvs_by_values([change])[0]


def _evened(model: pm.Model, problem: Problem, wheel: Wheel) -> Any:
    """Return the correction for one wheel."""
    entries = [(b.name, i) for b in problem.layout.blocks for i in range(len(b.owners))]
    angle, *mus = (model[name][i] for name, i in (entries[place] for place in wheel.places))
    direction, *frictions = wheel.priors
    terms = []
    for turns in range(4):
        term = direction.kappa * pm.math.cos(angle + turns * np.pi / 2 - direction.mu)
        for mu, prior in zip(mus[:: -1 if turns % 2 else 1], frictions, strict=True):
            term = term - 0.5 * ((mu - prior.mu) / prior.sigma) ** 2
        terms.append(term)
    return reduce(pm.math.logaddexp, terms) - np.log(4.0) - terms[0]
