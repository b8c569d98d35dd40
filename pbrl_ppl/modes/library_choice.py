"""Exact posterior of each body's parameter set, by enumeration of all combinations."""

from __future__ import annotations

from itertools import product
from math import prod

import numpy as np
from scipy import stats
from scipy.optimize import minimize
from scipy.special import logsumexp, softmax

from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import Observations, Problem, estimate_sigma, log_noise_prior
from pbrl_ppl.modes.importance import systematic
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.physics import EnginePart
from pbrl_ppl.state import Floats, Ints


def library_of(problem: Problem) -> ParameterLibrary:
    """Return the library of a problem, which must have one."""
    if problem.library is None:
        raise FitError("fit: the model has no library to choose from")
    return problem.library


class _Combinations:
    """All combinations of parameter sets of one part's bodies, with priors and residuals.

    At most ``most`` combinations times measured numbers are summed over.
    """

    most = 50_000_000

    def __init__(self, problem: Problem, part: EnginePart, table: Floats) -> None:
        bodies = list(part.physics.scene.owners)
        priors = [library_of(problem).prior(body) for body in bodies]
        possible = [np.flatnonzero(p) for p in priors]
        count = prod(len(sets) for sets in possible)
        measured = problem.observations.values[:, :, part.bodies]
        if count * measured.size > self.most:
            raise FitError(
                f"fit: {', '.join(bodies)} meet in this history, so that {count} combinations of"
                f" parameter sets are to be summed over; give some probability 0 for some bodies,"
                " record the bodies apart, or walk among them with the method 'metropolis'"
            )
        self.likelihood = problem.likelihood
        self.observations = Observations(measured, problem.observations.columns)
        self.indices = np.array(list(product(*possible)), dtype=np.intp).reshape(count, -1)
        logs = [np.log(p[self.indices[:, i]]) for i, p in enumerate(priors)]
        self.log_prior = np.sum(logs, axis=0)
        owners = [owner for block in part.physics.layout.blocks for owner in block.owners]
        whose = [bodies.index(owner) for owner in owners]
        phi = table[part.places, self.indices[:, whose]].reshape(count, -1)
        start, inputs = problem.segments.start[:, part.bodies], problem.inputs[:, :, part.bodies]
        self.residual = self.observations.residual(part.simulator(phi, start, inputs))

    def log_joint(self, sigma: Floats, nu: float | Floats | None) -> Floats:
        """Return the log-density of data and combination given sigma, shape (draw, combination)."""
        seen = self.observations.measured
        result = np.empty((len(sigma), len(self.indices)))
        size = max(1, 4_000_000 // max(self.residual.size, 1))  # numbers held at once
        for begin in range(0, len(sigma), size):
            part = sigma[begin : begin + size, None]
            densities = self.likelihood.log_density(self.residual[None], part, seen, nu)
            result[begin : begin + size] = densities.sum(axis=-1)
        return np.asarray(result + self.log_prior)


def choose_from_library(
    problem: Problem, draws: int, chains: int, seed: int
) -> tuple[Floats, Floats, Ints, Ints]:
    """Draw sigma from its marginal posterior, and the parameter sets given sigma.

    Given sigma, bodies that have nothing to do with each other are independent, and the sum over
    every combination is a product of sums. Sigma is drawn by importance resampling about the
    maximum of that product.

    Parameters
    ----------
    problem : Problem
        With a library.
    draws, chains : int
        Draws of each chain, and chains.
    seed : int
        Of the draws.

    Returns
    -------
    phi : ndarray
        Parameters, shape (chain, draw, p).
    sigma : ndarray
        Shape (chain, draw, state), or (chain, draw, 1) for a scalar sigma.
    index : ndarray of int
        Of the parameter set in the library, shape (chain, draw, owner), as in `Scene.owners`.
    best : ndarray of int
        Most probable choice, sigma summed out by the draws, shape (owner,): of bodies that meet,
        their most probable combination.

    Raises
    ------
    FitError
        If bodies that meet have too many combinations.
    """
    rng = np.random.default_rng(seed)
    names = list(problem.scene.owners)
    table = library_of(problem).table(problem.layout, problem.scene)
    parts = [_Combinations(problem, part, table) for part in problem.physics.simulator.parts]
    median, spread = problem.noise_prior
    counts = problem.observations.measured.sum((0, 1, 2)).astype(float)
    counts, ones = problem.likelihood.pooled(counts), np.ones(len(median))

    def density(log_sigma: Floats) -> Floats:
        sigma = np.exp(log_sigma) * ones
        log_sums = [logsumexp(part.log_joint(sigma, problem.nu()), axis=1) for part in parts]
        return np.asarray(np.sum(log_sums, axis=0) + log_noise_prior(problem, log_sigma))

    begin = problem.likelihood.centre(_estimated_sigma(problem, parts, median))
    top = minimize(lambda x: -float(density(x[None])[0]), begin, method="L-BFGS-B").x
    # log sigma of n residuals has about this precision; wider, for combinations that mix
    variance = 1.2**2 / (2.0 * counts + spread**-2.0)
    proposal = stats.multivariate_t(top, np.diag(variance), df=5)
    n = draws * chains
    x = proposal.rvs(10 * n, random_state=rng).reshape(10 * n, -1)
    # in parts, for there may be many combinations
    log_densities = np.concatenate([density(some) for some in np.array_split(x, 4 * chains)])
    log_weight = log_densities - proposal.logpdf(x)
    drawn = systematic(np.exp(log_weight - log_weight.max()), n, rng)
    log_sigma = x[rng.permutation(drawn)]
    index = np.zeros((n, len(names)), dtype=np.intp)
    best = np.zeros(len(names), dtype=np.intp)
    for choice, part in zip(parts, problem.physics.simulator.parts, strict=True):
        joint = choice.log_joint(np.exp(log_sigma) * ones, problem.nu())
        # the largest of log-probabilities with Gumbel noise is a draw
        which = (joint + rng.gumbel(size=joint.shape)).argmax(axis=1)
        columns = [names.index(owner) for owner in part.physics.scene.owners]
        index[:, columns] = choice.indices[which]
        best[columns] = choice.indices[softmax(joint, axis=1).sum(axis=0).argmax()]
    owners = [owner for block in problem.layout.blocks for owner in block.owners]
    phi = table[np.arange(len(owners)), index[:, [names.index(owner) for owner in owners]]]
    shape = (chains, draws, -1)
    return phi.reshape(shape), np.exp(log_sigma).reshape(shape), index.reshape(shape), best


def _estimated_sigma(problem: Problem, parts: list[_Combinations], sigma: Floats) -> Floats:
    """Return a fixed-point estimate of sigma under each part's best combination."""
    observations = problem.observations
    residual = np.zeros_like(observations.values)
    for turn in range(3):
        for choice, part in zip(parts, problem.physics.simulator.parts, strict=True):
            z = np.nan_to_num(choice.residual / sigma, nan=1e6)
            cost = np.log1p(z**2) if turn == 0 else z**2
            best = int(cost.reshape(len(z), -1).sum(axis=1).argmin())
            residual[:, :, part.bodies] = np.nan_to_num(choice.residual[best])
        sigma = estimate_sigma(residual, observations, problem.scene)
    return sigma
