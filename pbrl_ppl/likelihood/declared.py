"""Problems as users declare them, with their prior and log-posterior in numpy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.effects import attach, catalogue
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, check_start, measured_alone
from pbrl_ppl.likelihood.coordinates import ACCELERATION
from pbrl_ppl.likelihood.likelihood import TrajectoryLikelihood, TransitionLikelihood
from pbrl_ppl.likelihood.output_error import OutputErrorLikelihood, in_pieces, is_simulated
from pbrl_ppl.likelihood.problem import Problem, is_independent
from pbrl_ppl.likelihood.smoothing import along_trajectories, as_measured
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.physics import Physics, try_effect
from pbrl_ppl.state import Floats, Ints

#: Names of the likelihoods.
KINDS = tuple(
    each.name for each in (TransitionLikelihood, TrajectoryLikelihood, OutputErrorLikelihood)
)


def declared_problem(physics: Physics, history: History, **options: Any) -> Problem:
    """Return the problem of a history; see :func:`outlined_problem` and :func:`at_centre`."""
    return at_centre(outlined_problem(physics, history, **options))


def outlined_problem(
    physics: Physics,
    history: History,
    *,
    horizon: int = 1,
    likelihood: TransitionLikelihood | None = None,
    library: ParameterLibrary | None = None,
    kind: str = TransitionLikelihood.name,
) -> Problem:
    """Return the problem of a history, trajectories with states as measured.

    ``kind`` is a name of a likelihood, one of :data:`KINDS`; see :func:`pbrl_ppl.physics_model`.
    Nothing is simulated. Whole trajectories are not linearised: their variables, dimensions and
    measurements are final, and their states and the prior of their noise are not.
    """
    likelihood = likelihood or TransitionLikelihood()
    if kind not in KINDS:
        raise ValueError(f"likelihood is {kind!r}, expected one of {', '.join(KINDS)}")
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, expected at least 1")
    whole = kind != TransitionLikelihood.name
    if whole and (horizon > 1 or library is not None):
        raise ValueError(
            f"likelihood is {kind!r}, with horizon or library, which are for 'transitions': leave"
            " them out"
        )
    if whole and likelihood.scalar:
        raise ValueError(f"sigma is 'scalar', expected 'per_dimension' with likelihood {kind!r}")
    if whole:
        history = measured_alone(history)
    else:
        check_start(history, physics.scene)
    longest = int(history.dataset["n_rows"].max()) - 1
    if horizon > longest:
        raise HistoryError(
            f"horizon is {horizon} intervals, and the longest trajectory has {longest}; use a"
            " shorter horizon"
        )
    problem = Problem.of(physics, history, horizon=horizon, likelihood=likelihood, library=library)
    if not whole:
        return problem
    outline = as_measured(problem)
    if kind != OutputErrorLikelihood.name:
        return outline
    if likelihood.nu is not None or problem.tails:
        raise ValueError(
            "likelihood is 'simulation', whose noise is Gaussian: leave out nu and effects on the"
            " noise's tails, or choose 'trajectories'"
        )
    if problem.layout.discrete.any():
        raise ValueError(
            "likelihood is 'simulation' and which bodies a joint joins is unknown: name them in the"
            " scene, or choose 'trajectories'"
        )
    return in_pieces(outline, longest, outline.data.smoothed_states)


def at_centre(problem: Problem) -> Problem:
    """Return a problem with trajectories linearised about states smoothed at the prior's centre.

    It is no place to sample about: a mode has to be found first. Single transitions stay.
    """
    if is_independent(problem):
        return problem
    centre = np.array([prior.centre for prior in problem.layout.priors])
    filtered = along_trajectories(problem, centre)
    if not is_simulated(problem):
        return filtered
    return in_pieces(filtered, problem.data.horizon, filtered.data.smoothed_states)


def try_own_effects(physics: Physics, history: History) -> None:
    """Try the effects that are a user's own; see :func:`pbrl_ppl.physics.try_effect`."""
    scene = physics.scene
    bare = scene.replace(
        bodies=tuple(replace(body, effects=(), known=(), prior=()) for body in scene.bodies)
    )
    implied = {attached.effect.name for attached in attach(bare)}  # of actuators, for example
    known = {effect.name for effect in catalogue} | implied
    effects = {attached.effect.name: attached.effect for attached in physics.effects}
    for name in effects.keys() - known:
        try_effect(effects[name], scene, history)


def noise_law(problem: Problem) -> tuple[Floats, float]:
    """Return the prior of sigma: log medians, and the standard deviation of log sigma.

    Measurement noise is log-normal. Unexplained accelerations and correlated errors are
    exponential, without the spread: penalised-complexity priors (Simpson et al., Statistical
    Science 32, 2017), under which motion follows the physics unless the data say otherwise.

    Parameters
    ----------
    problem : Problem
        Its sigma is one a state dimension, or one for all.

    Returns
    -------
    centre : ndarray
        Logarithm of the medians, shape (state,), or (1,) for a scalar sigma.
    spread : float
        Standard deviation of log sigma where it is log-normal.
    """
    median, spread = problem.noise_prior
    return problem.likelihood.centre(median), spread


def exponential(problem: Problem) -> NDArray[np.bool_]:
    """Return the mask of noise parameters with an exponential prior, shape (parameter,)."""
    variables = problem.noise_variables
    return np.array([name == ACCELERATION for name, dims in variables.items() for _ in dims], bool)


def log_noise_prior(problem: Problem, log_sigma: Floats) -> Floats:
    """Return the log-density of log sigma, shape (...), at (..., free)."""
    centre, spread = noise_law(problem)
    normal = -0.5 * ((log_sigma - centre) / spread) ** 2 - np.log(spread) - 0.5 * np.log(2 * np.pi)
    mask = exponential(problem)
    if mask.any():
        # of sigma / scale, whose density is exp(-sigma / scale)
        u = log_sigma - centre + np.log(np.log(2.0))
        normal = np.where(mask, u - np.exp(u), normal)
    return np.asarray(normal.sum(axis=-1))


def noise_prior_slope(problem: Problem, log_sigma: Floats) -> Floats:
    """Return the derivative of :func:`log_noise_prior` by log sigma, same shape."""
    centre, spread = noise_law(problem)
    normal = (centre - log_sigma) / spread**2
    mask = exponential(problem)
    if not mask.any():
        return np.asarray(normal)
    u = log_sigma - centre + np.log(np.log(2.0))
    return np.where(mask, 1.0 - np.exp(u), normal)


def log_prior(problem: Problem, phi: Floats, sigma: Floats, choice: Ints | None = None) -> Floats:
    """Return the log-density of parameters and sigma under the declared prior.

    Parameters
    ----------
    problem : Problem
        Declares it.
    phi : ndarray
        Parameters in the layout's order, shape (..., p), SI units.
    sigma : ndarray
        Shape (..., state), all the same for a scalar sigma.
    choice : ndarray of int, optional
        Which parameter set each owner has, shape (..., owner), as in `Scene.owners`, where the
        problem has such sets: then the parameters follow from it, and its probability counts.

    Returns
    -------
    ndarray
        Shape (...), normalised; of sigma, not of its logarithm, as PyMC's before transforms.
    """
    log_sigma = np.log(problem.likelihood.free(sigma))
    of_noise = log_noise_prior(problem, log_sigma) - log_sigma.sum(axis=-1)
    if problem.library is None:
        return np.asarray(of_noise + problem.layout.log_prior(phi).sum(axis=-1))
    if choice is None:
        raise ValueError("choice is missing: the parameters follow from which set each body has")
    names = list(problem.scene.owners)
    with np.errstate(divide="ignore"):  # a set that a body cannot have
        table = np.log([problem.library.prior(name) for name in names])
    return np.asarray(of_noise + table[np.arange(len(names)), choice].sum(axis=-1))


def draw_prior(problem: Problem, rng: np.random.Generator, n: int) -> Floats:
    """Draw parameters from the declared prior, shape (n, p), in SI units."""
    layout, library = problem.layout, problem.library
    if library is None:
        return layout.prior_draws(rng, n)
    table = library.table(layout, problem.scene)
    names = list(problem.scene.owners)
    chosen = {name: rng.choice(len(library.names), n, p=library.prior(name)) for name in names}
    owners = [owner for block in layout.blocks for owner in block.owners]
    columns = [row[chosen[owner]] for row, owner in zip(table, owners, strict=True)]
    return np.stack(columns, axis=1)


def log_posterior(
    problem: Problem,
    phi: Floats,
    sigma: Floats,
    choice: Ints | None = None,
    *,
    log_likelihood: Floats | None = None,
) -> Floats:
    """Return the log-posterior up to the evidence, as PyMC's without transforms.

    Parameters
    ----------
    problem : Problem
        Data and prior.
    phi, sigma, choice : ndarray
        As for :func:`log_prior`.
    log_likelihood : ndarray, optional
        Of all transitions, shape (...), where it is known already: the engine is not run.

    Returns
    -------
    ndarray
        Shape (...).
    """
    if log_likelihood is None:
        log_likelihood = problem.log_density(problem.residual(phi), sigma, phi).sum(axis=-1)
    return np.asarray(log_likelihood + log_prior(problem, phi, sigma, choice))
