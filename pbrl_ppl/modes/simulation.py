"""Mode of the likelihood of simulated trajectories: the last one of the ladder of lengths."""

from __future__ import annotations

from pbrl_ppl.likelihood import NoisePrior, Problem
from pbrl_ppl.modes.ladder import ladder, with_robust_covariance
from pbrl_ppl.modes.laplace import Mode
from pbrl_ppl.modes.search import find_mode
from pbrl_ppl.modes.trajectories import find_trajectory_mode
from pbrl_ppl.threads import one_blas_thread


def find_simulation_mode(problem: Problem, seed: int) -> Mode:
    """Return the best mode of simulated trajectories, from one of whole trajectories.

    Parameters
    ----------
    problem : Problem
        Of any likelihood; the prior of sigma is kept, if it is of simulated trajectories.
    seed : int
        Of the search for the mode of whole trajectories.

    Returns
    -------
    Mode
        Result of :func:`simulation_mode`.
    """
    likelihood = problem.likelihood
    prior = likelihood.prior if likelihood.simulated else None
    return simulation_mode(find_trajectory_mode(problem, seed), prior)


@one_blas_thread
def simulation_mode(mode: Mode, prior: NoisePrior | None = None, *, rounds: int = 5) -> Mode:
    """Return the mode of simulated trajectories, from one of whole trajectories.

    Parameters
    ----------
    mode : Mode
        Of whole trajectories.
    prior : tuple, optional
        Of sigma; by default it is taken from the pieces.
    rounds : int
        Of the last climb, which has all engine steps and the prior of sigma.

    Returns
    -------
    Mode
        Its problem has an :class:`pbrl_ppl.likelihood.OutputErrorLikelihood`, linearised at its
        initial states, and the prior of sigma fixed.
    """
    return tempered_mode(ladder(mode)[-1], prior, rounds=rounds)


def tempered_mode(mode: Mode, prior: NoisePrior | None = None, *, rounds: int = 5) -> Mode:
    """Return a mode of simulated pieces as the mode of their posterior; arguments as above.

    The density of each dimension is divided by its autocorrelation time.
    """
    if prior is None:
        median, spread = mode.problem.noise_prior
        prior = tuple(median.tolist()), spread
    problem = mode.problem.with_likelihood(prior=prior)
    return with_robust_covariance(find_mode(problem, initial=mode.phi, rounds=rounds))
