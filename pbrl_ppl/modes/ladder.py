"""Modes of simulated pieces, which are segments of multiple shooting, up a ladder of lengths.

The simulation error of a whole trajectory has false optima; that of pieces of a few rows has not.
Each length begins at the optimum of the shorter one, its initial states on the trajectories that
were simulated there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.likelihood import (
    SimulatedProblem,
    autocovariance,
    in_pieces,
    linearised_about,
    linearised_pieces,
    with_defect,
    without,
)
from pbrl_ppl.modes.noise import finite
from pbrl_ppl.modes.search import Mode, SimulatedMode, covariance_of, near_mode, sandwich
from pbrl_ppl.parameters import box, inside, prior_residual, prior_slopes, stepped
from pbrl_ppl.state import Floats
from pbrl_ppl.system.threads import one_blas_thread

#: Largest magnification of initial states, beyond growth in proportion to time, of pieces that are
#: not too long to tell a law from.
MOST_GROWTH = 30.0


@one_blas_thread
def ladder(mode: Mode) -> list[SimulatedMode]:
    """Return the modes of simulated pieces of a model, the shortest pieces first.

    Parameters
    ----------
    mode : Mode
        Mode of whole trajectories, whose smoothed states the pieces begin with.

    Returns
    -------
    list of Mode
        One for each length; the last is the greatest where simulations do not magnify their initial
        states.

    Raises
    ------
    HistoryError
        If no trajectory has three rows, or initial states can follow all that was measured.
    """
    modes: list[SimulatedMode] = []
    states, phi = mode.problem.data.smoothed_states, mode.phi
    for length in piece_lengths(mode):
        problem = in_pieces(mode.problem, length, states)
        fitted = fit_pieces(problem, phi)
        if modes and growth(fitted.problem) > MOST_GROWTH:
            break
        modes.append(fitted)
        phi, states = fitted.phi, simulated_states(fitted)
    return [*modes[:-1], with_robust_covariance(modes[-1])]


def piece_lengths(mode: Mode) -> list[int]:
    """Return the lengths of pieces of a mode's trajectories, the shortest first.

    Raises
    ------
    HistoryError
        If no trajectory has three rows, or initial states can follow all that was measured.
    """
    history = mode.problem.data.history
    longest = int(history.dataset["n_rows"].max()) - 1
    if longest < 2:
        raise HistoryError(
            f"history: its longest trajectory has {longest + 1} rows, a simulation is judged by at"
            " least 3; record longer trajectories"
        )
    whole = in_pieces(mode.problem, longest, mode.problem.data.smoothed_states)
    initial_states = whole.likelihood.initial_states
    measured = int(initial_states.measured.sum())
    unknown = int((~initial_states.given).sum()) + len(mode.phi)
    if measured <= unknown:
        raise HistoryError(
            f"history: it has {measured} measurements, and simulations of its trajectories have"
            f" {unknown} unknown initial coordinates and parameters; record more rows of each"
            " trajectory"
        )
    return lengths(longest, history.longest_gap)


def lengths(longest: int, gap: int = 1, *, shortest: int = 4, ratio: int = 4) -> list[int]:
    """Return the lengths of pieces for trajectories of so many intervals.

    Pieces are longer than a gap of unmeasured rows, or some would have no measurement.

    ``shortest``: intervals of the shortest pieces.

    ``ratio``: ratio of a length to the one before.

    Examples
    --------
    >>> lengths(30), lengths(100), lengths(3), lengths(100, gap=11)
    ([4, 30], [4, 16, 100], [3], [22, 100])
    """
    shorter, length = [], max(shortest, 2 * gap if gap > 1 else 1)
    while 2 * length <= longest:
        shorter.append(length)
        length *= ratio
    return [*shorter, longest]


def with_robust_covariance(mode: SimulatedMode, *, many: int = 8) -> SimulatedMode:
    """Return a mode of simulated pieces with the covariance under errors as correlated as they are.

    A sandwich: the inverse precision, the variance of the score, the inverse precision. With many
    trajectories, no parameter's is less than by the scatter of the trajectories' scores (a
    cluster-robust covariance), which what differs from one to the other widens.

    ``many``: trajectories whose scores' scatter is a variance, at least.
    """
    problem, likelihood, p = mode.problem, mode.problem.likelihood, len(mode.phi)
    if not p:
        return mode
    initial_states, weight = likelihood.initial_states, likelihood.weight(mode.sigma)
    slopes = prior_slopes(problem.layout.priors, mode.phi)
    jacobian = mode.jacobian.reshape(*mode.whitened_residual.shape, p)
    u = initial_states.basis(weight)[0]
    residual, start, by_phi = map(initial_states.series, (mode.whitened_residual, u, jacobian))
    seen, score = initial_states.series(initial_states.seen_rows) > 0, np.diag(slopes**2)
    lags = np.abs(np.subtract.outer(np.arange(seen.shape[1]), np.arange(seen.shape[1])))
    for d, white in enumerate(problem.least_noise * weight):
        of_dimension = by_phi[..., d, :]
        errors = autocovariance(residual[..., d], seen[..., d], start[..., d, :], of_dimension)
        errors[0] += white**2
        operands = of_dimension, errors[lags], of_dimension
        score = score + np.einsum("arbp,rs,asbq->pq", *operands, optimize=True)
    inverse = covariance_of((mode.jacobian.T @ mode.jacobian) + np.diag(slopes**2))
    robust = sandwich(inverse, score)
    _, cluster = np.unique(problem.segments.trajectory, return_inverse=True)
    n = cluster.max() + 1
    if n >= many:
        scores = np.zeros((n, p))
        np.add.at(scores, cluster, np.einsum("arp,ar->ap", jacobian, mode.whitened_residual))
        score = n / (n - 1) * scores.T @ scores + np.diag(slopes**2)
        least = np.diag(inverse @ score @ inverse)
        wider = np.sqrt(np.maximum(least / np.maximum(np.diag(robust), 1e-300), 1.0))
        robust = robust * np.outer(wider, wider)
    return replace(mode, covariance=robust)


@one_blas_thread
def fit_pieces(
    problem: SimulatedProblem,
    phi: Floats,
    rounds: int = 20,
    tolerance: float = 0.1,
    *,
    initial_states_alone: bool = False,
    n_steps: int = 2,
    dampings: tuple[float, ...] = (0.03, 0.3, 3.0, 30.0, 300.0, 3e3, 3e4),
) -> SimulatedMode:
    """Return a mode of simulated pieces by Gauss-Newton steps, initial states projected out.

    Parameters
    ----------
    problem : Problem
        Result of :func:`pbrl_ppl.likelihood.in_pieces`.
    phi : ndarray
        Where to begin, shape (p,).
    rounds : int
        Linearisations, at most.
    tolerance : float
        Gain in log-posterior (nats) below which it ends.
    initial_states_alone : bool
        Whether phi stays, and the initial states alone are fitted.
    n_steps : int
        Steps from one linearisation.
    dampings : tuple of float
        Dampings that are tried at once, as multiples of the last good one.
    """
    # widths of derivatives that are tried where no step gains, as shares of the usual ones
    wider = (3.0, 0.1)
    priors, layout = problem.layout.priors, problem.layout
    scale = layout.scale(phi)
    sizes = problem.likelihood.initial_states.coordinates.sizes(problem.scene)
    phi, start = inside(priors, phi), problem.segments.start
    steps = 1e-4 * scale, 1e-4 * sizes
    damping, failed, one_sided = 1e-3, 0, True
    for _ in range(rounds):
        residual, *slopes = _linearised(problem, phi, start, steps, one_sided)
        step = _Step(problem, phi, start, (residual, *slopes))
        problem = step.problem
        if not failed:
            steps = step.differences(scale, sizes)
        gained, predicted_gain = 0.0, step.predicted_gain
        for _ in range(n_steps):
            tried = [step.moved(damping * factor, initial_states_alone) for factor in dampings]
            points, initial_states = (np.array(values) for values in zip(*tried, strict=True))
            residuals = _residual(problem, points, initial_states)
            costs = [step.cost(*point, z) for point, z in zip(tried, residuals, strict=True)]
            best = int(np.argmin(costs))
            gain = step.cost_before - costs[best]
            if gain > 0:
                phi, start = points[best], initial_states[best]
                step.move(phi, start, residuals[best])
            gained += max(gain, 0.0)
            if gain <= max(tolerance, 0.2 * gained):
                break
            damping = min(max(damping * dampings[best], 1e-8), 1.0)
        if gained > tolerance:
            failed = 0
            continue
        if one_sided:  # far from the optimum one side will do
            one_sided = False
            continue
        if failed == len(wider) or predicted_gain <= tolerance:
            residual = step.residual
            break
        # friction makes kinks: over another width the derivative sees others
        steps = steps[0] * wider[failed], steps[1] * wider[failed]
        damping, failed = 1e-3, failed + 1
    else:
        residual, *slopes = _linearised(problem, phi, start, steps)
    return _Step(problem, phi, start, (residual, *slopes)).mode()


@one_blas_thread
def fit_pieces_closely(problem: SimulatedProblem, phi: Floats) -> SimulatedMode:
    """Return a mode of simulated pieces that climbs from the linearised initial states confirm.

    Friction makes kinks, at which Gauss-Newton steps of parameters and initial states end. Climbs
    of the parameters alone go on from there, and the initial states follow: twice, or until that
    gains less than a nat.
    """
    mode = fit_pieces(problem, phi, rounds=8, tolerance=0.5)
    for _ in range(2):
        climbed = near_mode(mode.problem, mode.phi)
        better = fit_pieces(mode.problem, climbed.phi, rounds=8, tolerance=0.5)
        if better.log_posterior < mode.log_posterior + 1.0:
            break
        mode = better
    return mode


def corrected(mode: SimulatedMode) -> SimulatedMode:
    """Return a mode of simulated pieces with few engine steps, whose error there is corrected."""
    problem = mode.problem
    return replace(mode, problem=with_defect(problem.coarse, problem.medium, mode.phi))


def _residual(problem: SimulatedProblem, points: Floats, initial_states: Floats) -> Floats:
    """Return residuals at points (n, p) and initial states (n, piece, body, 6)."""
    engine = problem.medium if problem.defect is None else problem
    states = engine.physics.simulator(points, np.ascontiguousarray(initial_states), problem.inputs)
    states = states if problem.defect is None else states + problem.defect
    return finite(problem, problem.observations.residual(states))


def _linearised(
    problem: SimulatedProblem,
    phi: Floats,
    start: Floats,
    steps: tuple[Floats, Floats],
    one_sided: bool = False,
) -> tuple[Floats, Floats, Floats]:
    """Return residuals and the states' derivatives by phi and by initial states, in one simulation.

    Shapes (piece, H, body, state), (piece, H, body, state, p) and (piece, H, body, state, cell).
    Differences are central but for those by phi where ``one_sided``.
    """
    coordinates = problem.likelihood.initial_states.coordinates
    lower, upper = box(problem.layout.priors)
    ahead, behind = np.minimum(phi + steps[0], upper), np.maximum(phi - steps[0], lower)
    if one_sided:
        ahead, behind = np.where(ahead > phi, ahead, behind), phi
    p, c = len(phi), len(coordinates.places)
    points = np.tile(phi, (1 + (2 - one_sided) * p + 2 * c, 1))
    np.fill_diagonal(points[1 : 1 + p], ahead)
    if not one_sided:
        np.fill_diagonal(points[1 + p : 1 + 2 * p], behind)
    held = coordinates.completed(problem.scene, start.copy())
    displaced = coordinates.displaced(problem.scene, start, steps[1])
    initial_states = np.concatenate([np.tile(held, (len(points) - 2 * c, 1, 1, 1)), displaced])
    residual = _residual(problem, points, initial_states)
    width = np.where(ahead == behind, 1e-300, ahead - behind)
    before = residual[:1] if one_sided else residual[1 + p : 1 + 2 * p]
    by_phi = np.moveaxis(residual[1 : 1 + p] - before, 0, -1) / -width
    begun = residual[len(residual) - 2 * c :]
    by_start = np.moveaxis(begun[:c] - begun[c:], 0, -1) / (-2 * steps[1])
    return residual[0], by_phi, by_start


def _cost(problem: SimulatedProblem, sigma: Floats, phi: Floats) -> float:
    """Return the negative log-posterior, the noise at its profile, up to a constant."""
    weight = problem.likelihood.counts(problem.observations)
    prior = 0.5 * (prior_residual(problem.layout.priors, phi) ** 2).sum()
    return float((weight * np.log(sigma)).sum() + prior)


class _Step:
    """Gauss-Newton steps from one linearisation, with fixed noise, weights and projection."""

    def __init__(
        self, problem: SimulatedProblem, phi: Floats, start: Floats, slopes: tuple[Floats, ...]
    ) -> None:
        residual, by_phi, by_start = slopes
        problem = linearised_about(problem, start, by_start)
        likelihood, self.by_start = problem.likelihood, by_start
        self.sigma = likelihood.profile(residual, problem.least_noise)
        tau = likelihood.correlation_times(residual, self.sigma)
        self.problem = problem.with_likelihood(tau=tuple(tau.tolist()))
        likelihood = self.problem.likelihood
        self.initial_states, self.weight = likelihood.initial_states, likelihood.weight(self.sigma)
        self.u, self.back = self.initial_states.basis(self.weight)
        by_phi = np.moveaxis(by_phi, -1, 0) * self.weight
        pieces, rows = len(residual), residual[0].size
        by_phi = by_phi.reshape(len(phi), pieces, rows)
        n = self.u.shape[1] - rows
        self.by_phi = np.moveaxis(np.pad(by_phi, ((0, 0), (0, 0), (0, n))), 0, -1)
        projected = self.by_phi - self.u @ (np.swapaxes(self.u, 1, 2) @ self.by_phi)
        self.jacobian = projected.reshape(pieces * self.u.shape[1], len(phi))
        self.normal = self.jacobian.T @ self.jacobian
        self.move(phi, start, residual)

    def move(self, phi: Floats, start: Floats, residual: Floats) -> None:
        """Go on from another point, with the same derivatives."""
        self.phi, self.start, self.residual = phi, start, residual
        self.rows = self._rows(start, residual)
        left = without(self.u, self.rows)
        priors = self.problem.layout.priors
        slopes = prior_slopes(priors, phi)
        self.gradient = self.jacobian.T @ left.ravel() - slopes * prior_residual(priors, phi)
        self.precision = self.normal + np.diag(slopes**2)
        self.cost_before = self._profiled(left, residual, phi)

    def _rows(self, start: Floats, residual: Floats) -> Floats:
        """Return weighted residuals with those of the initial states, shape (piece, row)."""
        begun = linearised_about(self.problem, start, self.by_start)
        return begun.likelihood.initial_states.rows(residual, self.weight)

    def cost(self, phi: Floats, start: Floats, residual: Floats) -> float:
        """Return the negative log-posterior at a point, the noise at its profile."""
        return self._profiled(without(self.u, self._rows(start, residual)), residual, phi)

    def _profiled(self, left: Floats, residual: Floats, phi: Floats) -> float:
        """Return the cost of projected rows; ``residual`` has their shape before."""
        cut, squares = residual[0].size, left**2
        square = self.initial_states.totals(
            squares[:, :cut].reshape(residual.shape), squares[:, cut:]
        )
        sigma = np.sqrt(square / self.initial_states.counts) / self.weight
        return _cost(self.problem, np.maximum(sigma, self.problem.least_noise), phi)

    def mode(self) -> SimulatedMode:
        """Return the point as a mode, whose problem is linearised there."""
        tau = np.array(self.problem.likelihood.tau)
        problem = linearised_pieces(self.problem, self.start, self.by_start, tau)
        log_posterior = -_cost(problem, self.sigma, self.phi)
        covariance = covariance_of(self.precision)
        return Mode(problem, self.phi, self.sigma, self.jacobian, covariance, log_posterior)

    @property
    def predicted_gain(self) -> float:
        """Gain that the derivatives predict (nats)."""
        return 0.5 * float(self.gradient @ covariance_of(self.precision) @ self.gradient)

    def differences(self, scale: Floats, sizes: Floats) -> tuple[Floats, Floats]:
        """Return steps of the next derivatives, shapes (p,) and (cell,).

        They are half a standard deviation of phi, and 0.3 of a start, but within 1e-6 and 2e-2 of
        each scale.
        """
        width = 0.5 / np.sqrt(np.maximum(np.diag(self.precision), 1e-300))
        width = np.clip(width, 1e-6 * scale, 2e-2 * scale)
        by_start = np.where(self.initial_states.seen[..., None], self.by_start, 0.0)
        precision = ((by_start * self.weight[:, None]) ** 2).sum((1, 2, 3))
        of_weight = self.initial_states.of_coordinates(self.weight)
        precision += np.isfinite(self.initial_states.begin) * of_weight**2
        begin = 0.3 / np.sqrt(np.maximum(np.median(precision, axis=0), 1e-300))
        return width, np.clip(begin, 1e-6 * sizes, 2e-2 * sizes)

    def moved(self, damping: float, initial_states_alone: bool) -> tuple[Floats, Floats]:
        """Return phi and initial states a damped step on, shapes (p,) and (piece, body, 6)."""
        phi, coordinates = self.phi, self.initial_states.coordinates
        if len(phi) and not initial_states_alone:
            sd = 1.0 / np.sqrt(np.maximum(np.diag(self.precision), 1e-300))
            scaled = self.precision * np.outer(sd, sd) + damping * np.eye(len(sd))
            step = sd * np.linalg.solve(scaled, sd * self.gradient)
            if np.isfinite(step).all():  # where the engine diverges there is no slope
                phi = stepped(self.problem.layout.priors, phi, step)
        left = self.rows - self.by_phi @ (phi - self.phi)
        change = (self.back @ (np.swapaxes(self.u, 1, 2) @ left[..., None]))[..., 0]
        states = self.start.copy()
        states.reshape(len(states), -1)[:, coordinates.places] += change / (1.0 + damping)
        return phi, coordinates.completed(self.problem.scene, states)


def simulated_states(mode: Mode) -> Floats:
    """Return the states along the simulated pieces, shape (trajectory, time, body, 6)."""
    problem, segments = mode.problem, mode.problem.segments
    ends = problem.medium.physics.simulator(mode.phi, segments.start, problem.inputs)
    states = problem.data.smoothed_states.copy()
    last = problem.data.history.dataset["n_rows"].to_numpy()[segments.trajectory] - 1
    follows = np.flatnonzero(np.diff(segments.trajectory) == 0)
    last[follows] = segments.step[follows + 1]
    for i in range(segments.horizon):
        reached = (segments.step + 1 + i <= last) & np.isfinite(ends[:, i]).all(axis=(1, 2))
        states[segments.trajectory[reached], segments.step[reached] + 1 + i] = ends[reached, i]
    states[segments.trajectory, segments.step] = segments.start
    return states


def growth(problem: SimulatedProblem) -> float:
    """Return how much pieces magnify initial states, beyond growth in proportion to time."""
    slope = np.abs(problem.likelihood.initial_states.slope)
    size = np.sqrt((slope**2).sum(axis=(2, 3)))  # (piece, H, cell)
    first = max(3, min(size.shape[1] // 2, 8))
    begin = size[:, :first].max(axis=1)
    ratio = size.max(axis=1) / np.maximum(begin, 1e-300) * first / size.shape[1]
    return float(np.median(ratio, axis=0).max(initial=0.0))
