"""The log-posterior in numpy, draws from the prior, and simulated trajectories."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.history import History
from pbrl_ppl.likelihood.output_error import in_pieces, is_simulated
from pbrl_ppl.likelihood.problem import FilteredProblem, Problem, is_filtered
from pbrl_ppl.likelihood.smoothing import along_trajectories
from pbrl_ppl.physics import touching
from pbrl_ppl.state import Floats, Ints


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
    return problem.likelihood.exponential(len(problem.noise_prior[0]))


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


def simulated_trajectories(
    problem: FilteredProblem, phi: Floats, sigma: Floats, rng: np.random.Generator
) -> Floats:
    """Return simulated measurements from the recorded first states and commands.

    Parameters
    ----------
    problem : Problem
        Of whole trajectories; says where each begins, what acts and what is measured.
    phi, sigma : ndarray
        Parameters and noise parameters, shapes (p,) and (parameter,).
    rng : Generator
        Of both noises.

    Returns
    -------
    ndarray
        Shape (trajectory, time, body, 6), SI units; NaN where the recording has no measurement, and
        everywhere in a trajectory in which the engine diverged.
    """
    coordinates, segments = problem.likelihood.noise.coordinates, problem.segments
    world = problem.physics.one_world
    observed = problem.data.history.dataset["observed"].to_numpy()
    states = problem.data.smoothed_states.copy()
    flat = states.reshape(*states.shape[:2], -1)
    for step in range(states.shape[1] - 1):
        now = np.flatnonzero(segments.step == step)
        trajectory = segments.trajectory[now]
        begin, inputs = states[trajectory, step], problem.inputs[now]
        lost = ~np.isfinite(begin).all(axis=(1, 2))
        ends = world(phi, np.where(lost[:, None, None], 0.0, begin), inputs)[:, 0]
        ends[lost] = np.nan
        met = touching(problem.scene, begin, np.nan_to_num(ends))
        pushes = coordinates.pushes(sigma, met, rng)
        flat[trajectory[:, None], step + 1, coordinates.places] = coordinates.of(ends) + pushes
        coordinates.completed(problem.scene, states[:, step + 1])
    drawn = rng.standard_normal((*flat.shape[:2], len(coordinates.places)))
    measured = states.copy()
    measured.reshape(flat.shape)[..., coordinates.places] += coordinates.errors(sigma) * drawn
    return np.where(np.isfinite(observed), measured, np.nan)


def with_measurements(problem: Problem, observed: Floats) -> Problem:
    """Return the problem of filtered or simulated trajectories with other measurements.

    Parameters
    ----------
    problem : Problem
        Its noise prior stays, and the coordinates of filtered trajectories.
    observed : ndarray
        Shape (trajectory, time, body, 6), SI units, NaN where missing.
    """
    dataset = problem.data.history.dataset.copy()
    start = np.where(np.isfinite(observed), observed, dataset["start"])
    for name, values in (("observed", observed), ("start", start)):
        dataset[name] = dataset[name].copy(data=values)
    history = History(dataset)
    centre = np.array([prior.centre for prior in problem.layout.priors])
    coordinates = problem.likelihood.noise.coordinates if is_filtered(problem) else None
    other = problem.with_data(history=history, states=None)
    whole = along_trajectories(other, centre, None, coordinates)
    if not is_simulated(problem):
        return whole
    pieces = in_pieces(whole, problem.data.horizon, whole.data.smoothed_states)
    return pieces.with_likelihood(prior=problem.likelihood.prior)
