"""Iterated Kalman smoother: the linearisation point of trajectories, and their noise priors.

See B. M. Bell, The iterated Kalman smoother as a Gauss-Newton method (1994).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pbrl_ppl.history import unseen
from pbrl_ppl.likelihood.coordinates import Coordinates, first_states, observed_coordinates
from pbrl_ppl.likelihood.data import SPREAD, least_noise
from pbrl_ppl.likelihood.likelihood import LikelihoodT, TransitionLikelihood
from pbrl_ppl.likelihood.problem import FilteredProblem, Problem
from pbrl_ppl.likelihood.trajectory_noise import Sensitivity, TrajectoryNoise
from pbrl_ppl.physics import touching
from pbrl_ppl.state import STATE, THETA, VELOCITY, Bools, Floats


def along_trajectories(
    problem: Problem,
    phi: Floats,
    sigma: Floats | None = None,
    coordinates: Coordinates | None = None,
) -> FilteredProblem:
    """Return the problem with the likelihood of whole trajectories, linearised at smoothed states.

    Parameters
    ----------
    problem : Problem
        Of any horizon and noise.
    phi : ndarray
        Where to linearise, shape (p,).
    sigma : ndarray, optional
        Noise parameters to smooth with, shape (parameter,): errors of measuring each state
        dimension, then unexplained accelerations. Without it, a guess from what one step leaves.
    coordinates : Coordinates, optional
        Coordinates and noise parameters of the training data, where these are others.

    Returns
    -------
    Problem
        Of horizon 1, with a :class:`TrajectoryLikelihood`.

    Raises
    ------
    HistoryError
        If nothing moves.
    """
    continued, whole = coordinates is not None, as_measured(problem, phi, coordinates)
    coordinates = whole.likelihood.noise.coordinates
    steps = list(coordinates.accelerations)
    begin = _guess(whole, coordinates, phi)
    widths, everywhere = _steps(whole, coordinates, begin), np.full(whole.segments.n, True)
    whole = smoothed(_sloped(whole, phi, begin, widths, everywhere), phi, begin)
    if sigma is not None:
        halfway = sigma.copy()  # in the logarithm: the physics alone may diverge from rough states
        halfway[steps] = np.maximum(begin, sigma)[steps] ** 0.5 * sigma[steps] ** 0.5
        whole = smoothed(smoothed(whole, phi, halfway), phi, sigma)
    if not continued:  # the noise of measurements adds to the changes of states as measured
        moved = noise_medians(whole, coordinates)
        least = whole.noise_prior[0].copy()
        least[steps] = np.minimum(least[steps], moved[steps])
        whole = whole.with_likelihood(prior=(tuple(least.tolist()), SPREAD))
    return whole


def as_measured(
    problem: Problem, phi: Floats | None = None, coordinates: Coordinates | None = None
) -> FilteredProblem:
    """Return the problem with the likelihood of whole trajectories, not linearised yet.

    States are as measured, gaps interpolated, or predicted where phi is given. The medians of the
    noise's prior follow from them, unless there are coordinates of other data.

    Raises
    ------
    HistoryError
        If nothing moves.
    """
    history = problem.data.history
    eq_11 = problem.with_data(horizon=1, states=first_states(history))
    if phi is not None:
        eq_11 = with_predicted_gaps(eq_11, phi)
    if coordinates is None:
        coordinates = observed_coordinates(eq_11.scene, history)
        medians = noise_medians(eq_11, coordinates)
        eq_11 = eq_11.with_likelihood(scalar=False, prior=(tuple(medians.tolist()), SPREAD))
    eq_11 = eq_11.with_data(columns=coordinates.columns)
    d = len(coordinates.places)
    nothing = np.zeros((eq_11.segments.n, d, d))
    return eq_11.along(linearised(eq_11, coordinates, nothing, eq_11.noise_prior[0]))


def single_transitions(problem: Problem) -> Problem[TransitionLikelihood]:
    """Return the problem with the likelihood of single transitions (Eq. 11)."""
    horizon = problem.data.history.longest_gap
    single = problem.with_data(horizon=horizon, states=None, columns=None)
    return single.with_likelihood(prior=None)


def smoothed(problem: FilteredProblem, phi: Floats, sigma: Floats) -> FilteredProblem:
    """Return the problem linearised about states smoothed at phi and sigma.

    Near-zero unexplained accelerations are raised to a small value: with stick and slip, smoothing
    by the physics alone does not converge.
    """
    steps = list(problem.likelihood.noise.coordinates.accelerations)
    sigma = sigma.copy()
    sigma[steps] = np.maximum(sigma[steps], 0.1 * problem.noise_prior[0][steps])
    begun: Floats = np.array(np.inf)  # states at which each transition's slope was taken
    residual = problem.likelihood.noise.coordinates.of_residual(problem.residual(phi))
    for _ in range(4):  # rounds at most
        noise = problem.likelihood.noise
        coordinates = noise.coordinates
        before, after = noise.smoothed(residual, sigma)
        spread = np.sqrt(np.median(np.diagonal(noise.covariance(sigma), axis1=1, axis2=2), axis=0))
        states = _moved(problem, before, after)
        if not (np.isfinite(states).all() and np.isfinite(spread).all()):
            break  # diverged: keep the last linearisation
        moved = with_predicted_gaps(problem.with_states(states), phi)
        begin = coordinates.of(moved.segments.start)
        # slopes are stale from 0.3 standard deviations on
        far = np.asarray((np.abs(begin - begun) > 0.3 * spread).any(axis=1))
        moved = _sloped(moved, phi, sigma, spread, far)
        begun = np.where(far[:, None], begin, begun)
        residual = coordinates.of_residual(moved.residual(phi))
        if not np.isfinite(moved.likelihood.noise.filtered(residual[None], sigma)[0]).all():
            break  # diverged: nothing follows from the new one
        problem = moved
        shown = after[noise.seen.any(axis=1)]
        if (np.sqrt(np.mean(shown**2, axis=0)) < 0.05 * spread).all():
            break  # converged
    return problem


def with_sensitivity(problem: FilteredProblem, phi: Floats, sigma: Floats) -> FilteredProblem:
    """Return the problem with smoothed states that follow phi to first order.

    Parameters
    ----------
    problem : Problem
        Of whole trajectories, its states smoothed at phi and sigma.
    phi : ndarray
        Shape (p,).
    sigma : ndarray
        Noise parameters, shape (parameter,).
    """
    if not len(phi):
        return problem
    noise, segments = problem.likelihood.noise, problem.segments
    coordinates, nothing = noise.coordinates, np.zeros_like(noise.measured)
    slopes = problem.medium.physics.simulator.jacobian(phi, segments.start, problem.inputs)[:, 0]
    still = replace(noise, begin=nothing, measured=nothing, sensitivity=None)
    before = np.empty((*nothing.shape, len(phi)))
    for j, slope in enumerate(coordinates.of(np.moveaxis(slopes, -1, 0))):
        first, after = still.smoothed(-np.nan_to_num(slope), sigma)
        before[:, :, j] = np.where(noise.first[:, None], first, np.roll(after, 1, axis=0))
    if not np.isfinite(before).all():
        return problem
    origin = np.tile(phi, (segments.n, 1))
    follow = Sensitivity(problem.scene, problem.layout, coordinates, noise.slope, origin, before)
    return problem.along(replace(noise, sensitivity=follow))


def with_predicted_gaps(problem: Problem[LikelihoodT], phi: Floats) -> Problem[LikelihoodT]:
    """Return the problem with states of unobserved rows predicted from the row before.

    Interpolation between rows that are far apart would miss contacts.

    Parameters
    ----------
    problem : Problem
        Its data hold the states; of horizon 1.
    phi : ndarray
        Parameters to predict with, shape (p,).
    """
    history = problem.data.history
    if history.longest_gap == 1:
        return problem
    hidden, states = unseen(history), problem.data.smoothed_states.copy()
    segments, inputs = problem.segments, problem.inputs
    for step in np.flatnonzero(hidden.any(axis=(0, 2))):
        now = np.flatnonzero(segments.step == step - 1)
        trajectory = segments.trajectory[now]
        ends = problem.physics.one_world(phi, states[trajectory, step - 1], inputs[now])[:, 0]
        filled = hidden[trajectory, step] & np.isfinite(ends).all(axis=-1)
        states[trajectory, step] = np.where(filled[..., None], ends, states[trajectory, step])
    return problem.with_states(states)


def _steps(problem: Problem, coordinates: Coordinates, sigma: Floats) -> Floats:
    """Return the steps of finite differences by the coordinates, shape (coordinate,)."""
    error = coordinates.errors(sigma)
    known = dict(zip(coordinates.places, error / problem.scene.time_step, strict=True))
    below = np.array([known.get(place - VELOCITY, 0.0) for place in coordinates.places])
    rate = (coordinates.places % len(STATE) >= VELOCITY) & (coordinates.sensor < 0)
    return np.where(rate, np.maximum(error, below), error)


def _guess(problem: Problem, coordinates: Coordinates, phi: Floats) -> Floats:
    """Return first noise parameters, from residuals of single steps; the prior's if all diverge."""
    residual = coordinates.of_residual(problem.residual(phi))
    size, known = np.full(residual.shape[1], np.nan), np.isfinite(residual).any(axis=0)
    size[known] = np.sqrt(np.nanmedian(residual[:, known] ** 2, axis=0)) / 0.67
    typical = _by_dimension(coordinates, size**2) / np.sqrt(2)
    rates = [*coordinates.rates, *coordinates.contacts]
    changes = typical[rates] / problem.scene.time_step
    guess = np.concatenate([typical[list(coordinates.sensors)], changes])
    medians = problem.noise_prior[0]
    return np.where(np.isnan(guess), medians, np.maximum(guess, 0.01 * medians))


def _moved(problem: FilteredProblem, before: Floats, after: Floats) -> Floats:
    """Return the states moved by the smoothed deviations."""
    segments, first = problem.segments, problem.likelihood.noise.first
    coordinates = problem.likelihood.noise.coordinates
    states = problem.data.smoothed_states.copy()
    flat = states.reshape(*states.shape[:2], -1)
    at = segments.trajectory[:, None], segments.step[:, None] + 1, coordinates.places
    flat[at] += after
    begin = segments.trajectory[first, None], segments.step[first, None], coordinates.places
    flat[begin] += before[first]
    return coordinates.completed(problem.scene, states)


def _sloped(
    problem: FilteredProblem, phi: Floats, sigma: Floats, steps: Floats, rows: Bools
) -> FilteredProblem:
    """Return the problem linearised about its states by central differences.

    Where ``rows``, shape (transition,), is not set, the slopes are those that the problem has.
    """
    coordinates, slope = problem.likelihood.noise.coordinates, problem.likelihood.noise.slope
    inputs = problem.inputs[rows]

    def predict(states: Floats) -> Floats:
        """Return the states after an interval; a coarse engine's slope agrees with a fine one's."""
        begin = states.reshape(-1, *states.shape[2:])
        repeated = np.tile(inputs, (len(states), 1, 1, 1))
        ends = problem.medium.physics.simulator(phi, begin, repeated)[:, 0]
        return np.asarray(ends.reshape(states.shape))

    if rows.any():
        slope, start = slope.copy(), problem.segments.start[rows]
        slope[rows] = coordinates.slopes(problem.scene, start, steps, predict)
    return problem.along(linearised(problem, coordinates, slope, sigma))


def linearised(
    problem: Problem, coordinates: Coordinates, slope: Floats, sigma: Floats
) -> TrajectoryNoise:
    """Return the noise along a problem's trajectories from given slopes.

    Parameters
    ----------
    problem : Problem
        Its data hold the states.
    coordinates : Coordinates
        Coordinates and noise parameters.
    slope : ndarray
        Derivative of the next state by the state, shape (transition, coordinate, coordinate).
    sigma : ndarray
        Noise parameters at which the states were smoothed, shape (parameter,).
    """
    segments, states = problem.segments, problem.data.smoothed_states
    trajectory, step = segments.trajectory, segments.step
    observed = problem.data.history.dataset["observed"].to_numpy()
    deviation = coordinates.wrapped(coordinates.of(observed) - coordinates.of(states))
    end, begin = deviation[trajectory, step + 1], deviation[trajectory, step]
    touch = np.zeros(segments.n, dtype=bool)
    if coordinates.contacts:
        # smoothing may take one away and blame a measurement: what was measured counts as well
        for one in (states, np.where(np.isfinite(observed), observed, states)):
            touch |= touching(problem.scene, one[trajectory, step], one[trajectory, step + 1])
    # prior scale of an unmeasured state: many times its range, beside its typical size
    far = 10.0 * np.ptp(coordinates.of(states), axis=(0, 1)) + coordinates.sizes(problem.scene)
    return TrajectoryNoise(
        coordinates=coordinates,
        slope=np.ascontiguousarray(slope),
        first=step == 0,
        seen=np.isfinite(end),
        measured=np.nan_to_num(end),
        begin=np.nan_to_num(begin),
        initial_variance=np.where(np.isfinite(begin), 0.0, far**2),
        sigma=np.asarray(sigma, dtype=float),
        touching=touch,
    )


def noise_medians(problem: Problem, coordinates: Coordinates, *, share: float = 0.1) -> Floats:
    """Return the medians of the noise priors, shape (parameter,), from changes of the states.

    ``share``: medians of errors of measuring and of contact accelerations, as a share of what
    states do in a step. An unexplained acceleration is larger than this share of the bodies' with a
    probability of 1 %: physics is nearly deterministic, and a random force follows whatever is
    smooth.
    """
    history, states = problem.data.history, problem.data.smoothed_states
    dt = float(history.dataset.attrs["time_step"])
    real = np.isfinite(history.dataset["clock"].to_numpy())
    shown = real & ~unseen(history).any(axis=-1)
    changes = [
        [np.diff(path[row], axis=0) for path, row in zip(states, rows, strict=True)]
        for rows in (real, shown)
    ]
    typical, seen = (_typical(coordinates, np.concatenate(each)) for each in changes)
    sensors, contacts = list(coordinates.sensors), list(coordinates.contacts)
    # of an exponential law, as a share of what it exceeds with a probability of 1 %
    median = np.log(2.0) / -np.log(0.01)
    steps = share * median * _vectors(typical, coordinates.rates) / dt
    medians = share * seen[sensors], steps, share * typical[contacts] / dt
    rates = least_noise(problem.scene, (*coordinates.rates, *contacts)) / dt
    floors = least_noise(problem.scene, sensors), rates
    return np.asarray(np.maximum(np.concatenate(medians), np.concatenate(floors)))


def _typical(coordinates: Coordinates, changes: Floats) -> Floats:
    """Return the root mean square of changes (..., body, 6) by state dimension, shape (6,)."""
    square = changes.reshape(len(changes), -1) ** 2
    return _by_dimension(coordinates, square.mean(axis=0)[coordinates.places])


def _by_dimension(coordinates: Coordinates, square: Floats) -> Floats:
    """Return the root mean of squares (coordinate,) of each state dimension, shape (6,)."""
    of = coordinates.places % len(STATE)
    return np.array([np.sqrt(square[of == d].mean()) if (of == d).any() else 0.0 for d in range(6)])


def _vectors(typical: Floats, rates: tuple[int, ...]) -> Floats:
    """Return sizes of velocity changes, x and y as one vector, shape (rate,)."""
    plane = [d for d in rates if d % VELOCITY != THETA]
    size = float(np.sqrt((typical[plane] ** 2).sum()))
    return np.array([typical[d] if d % VELOCITY == THETA else size for d in rates])


def bodies_acceleration(problem: FilteredProblem) -> Floats:
    """Return the root mean square acceleration along smoothed trajectories, shape (velocity,).

    Of x and y it is that of the vector, whatever the axes' directions (m/s^2); of omega in rad/s^2.
    """
    coordinates, segments = problem.likelihood.noise.coordinates, problem.segments
    change = segments.observed[:, 0] - segments.start
    return _vectors(_typical(coordinates, change), coordinates.rates) / problem.scene.time_step
