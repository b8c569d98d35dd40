"""Modes of simulated pieces, up a ladder of lengths.

The simulation error of a whole trajectory has false optima; that of pieces of a few rows has not.
Each length begins at the optimum of the shorter one, its start states on the trajectories that were
simulated there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import longest_gap
from pbrl_ppl.likelihood import (
    Problem,
    autocovariance,
    in_pieces,
    least_errors,
    linearised_about,
    linearised_pieces,
    output_error,
)
from pbrl_ppl.modes.laplace import Mode, covariance_of
from pbrl_ppl.modes.noise import finite
from pbrl_ppl.modes.threads import one_blas_thread
from pbrl_ppl.parameters import box, inside, prior_residual, prior_slopes
from pbrl_ppl.state import Floats

#: Intervals of the shortest pieces, and the ratio of a length to the one before.
SHORTEST, RATIO = 4, 4
#: A start state that is magnified by more than this, beyond growth in proportion to time, makes a
#: piece too long to tell a law from.
MOST_GROWTH = 30.0
#: Dampings that are tried at once, as multiples of the last good one, and the least.
_DAMPINGS, _LEAST_DAMPING = (0.25, 1.0, 10.0, 100.0, 1e4), 1e-8
#: Widths of derivatives that are tried where no step gains, as shares of the usual ones.
_WIDER = (3.0, 0.1)
#: Steps of derivatives: first, then shares of a posterior standard deviation of phi and of a start;
#: the least and the largest, as shares of each scale.
_FIRST, _OF_PHI, _OF_START = 1e-4, 0.5, 0.3
_LEAST, _MOST = 1e-6, 2e-2
#: Rounds of a candidate's first fit, and the gain (nats) that ends it at lower lengths.
_FEW, _LOOSE = 4, 1.0
#: Rounds of a leading candidate's fit.
_MANY = 10
#: Trajectories whose scores' scatter is a variance, at least.
_MANY_TRAJECTORIES = 8


@one_blas_thread
def ladder(mode: Mode) -> list[Mode]:
    """Return the modes of simulated pieces of a model, the shortest pieces first.

    Parameters
    ----------
    mode : Mode
        Mode of whole trajectories, whose smoothed states the pieces begin with.

    Returns
    -------
    list of Mode
        One for each length; the last is the greatest where a simulation does not magnify its start.

    Raises
    ------
    HistoryError
        If no trajectory has three rows, or start states can follow all that was measured.
    """
    history = mode.problem.data.history
    longest = int(history.dataset["n_rows"].max()) - 1
    if longest < 2:
        raise HistoryError(
            f"history: its longest trajectory has {longest + 1} rows, a simulation is judged by at"
            " least 3; record longer trajectories"
        )
    found: list[Mode] = []
    states, phi = mode.problem.data.smoothed_states, mode.phi
    starts = output_error(in_pieces(mode.problem, longest, states)).starts
    measured, unknown = int(starts.counts.sum()), starts.begin.size + len(phi)
    if measured <= unknown:
        raise HistoryError(
            f"history: it has {measured} measurements, and simulations of its trajectories have"
            f" {unknown} unknown start coordinates and parameters; record more rows of each"
            " trajectory"
        )
    for length in lengths(longest, longest_gap(history)):
        problem = in_pieces(mode.problem, length, states)
        fitted = fit_pieces(problem, phi)
        if found and growth(fitted.problem) > MOST_GROWTH:
            break
        found.append(fitted)
        phi, states = fitted.phi, simulated_states(fitted)
    return found


def lengths(longest: int, gap: int = 1) -> list[int]:
    """Return the lengths of pieces for trajectories of so many intervals.

    Pieces are longer than a gap of unmeasured rows, or some would have no measurement.

    Examples
    --------
    >>> lengths(30), lengths(100), lengths(3), lengths(100, gap=11)
    ([4, 30], [4, 16, 100], [3], [22, 100])
    """
    shorter, length = [], max(SHORTEST, 2 * gap if gap > 1 else 1)
    while 2 * length <= longest:
        shorter.append(length)
        length *= RATIO
    return [*shorter, longest]


def climb_ladder(start: Sequence[tuple[Problem, Floats]]) -> list[Mode]:
    """Return first modes of another model at the lengths of its parent, after few rounds.

    Parameters
    ----------
    start : sequence of (Problem, ndarray)
        The model's problem at each length, linearised at the parent's start states, and where it
        may begin, shape (p,).
    """
    found: list[Mode] = []
    for problem, phi in start[:-1]:  # few rounds: the next length corrects it
        begin = found[-1].phi if found else phi
        found.append(fit_pieces(problem, begin, rounds=_FEW, tolerance=_LOOSE))
    problem, phi = start[-1]
    begins = [phi, *(mode.phi for mode in found[-1:])]
    costs = [_start_cost(problem, each) for each in begins]
    return [*found, fit_pieces(problem, begins[int(np.argmin(costs))], rounds=_FEW)]


@dataclass(frozen=True, eq=False)
class _Linear:
    """Residual and derivatives at phi and start states.

    Shapes: residual (piece, H, body, state), phi (.., p) and start (.., cell) as last axes.
    """

    residual: Floats
    by_phi: Floats
    by_start: Floats


def fit_pieces(problem: Problem, phi: Floats, rounds: int = 20, tolerance: float = 0.1) -> Mode:
    """Return a mode of simulated pieces by Gauss-Newton steps, start states projected out.

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
    """
    priors, layout = problem.layout.priors, problem.layout
    scale, sizes = layout.scale(phi), output_error(problem).starts.cells.sizes(problem.scene)
    phi, start = inside(priors, phi), problem.segments.start
    steps = _FIRST * np.where(layout.discrete, 0.0, scale), _FIRST * sizes
    damping, failed = 1e-3, 0
    for _ in range(rounds):
        linear = _linearise(problem, phi, start, steps)
        problem, sigma = _with_noise(problem, start, linear)
        cost = _cost(problem, linear.residual, sigma, phi)
        step = _Step(problem, linear, sigma, phi)
        if not failed:
            steps = step.differences(scale, sizes)
        tried = [step.moved(damping * factor, start) for factor in _DAMPINGS]
        points, starts = np.array([own[0] for own in tried]), np.array([own[1] for own in tried])
        residuals = _residual(problem, points, starts)
        costs = []
        for point, begin, residual in zip(points, starts, residuals, strict=True):
            begun = linearised_about(problem, begin, linear.by_start)
            noise = output_error(begun).profile(residual, least_errors(problem))
            costs.append(_cost(begun, residual, noise, point))
        best = int(np.argmin(costs))
        gain = cost - costs[best]
        if gain > 0:
            phi, start = points[best], starts[best]
        if gain > tolerance:
            failed = 0
            damping = min(max(damping * _DAMPINGS[best], _LEAST_DAMPING), 1.0)
            continue
        if failed == len(_WIDER):
            break
        # friction makes kinks: over another width the derivative sees others
        steps = steps[0] * _WIDER[failed], steps[1] * _WIDER[failed]
        damping, failed = 1e-3, failed + 1
    linear = _linearise(problem, phi, start, steps)
    problem, sigma = _with_noise(problem, start, linear)
    step = _Step(problem, linear, sigma, phi)
    problem = linearised_pieces(problem, start, linear.by_start, _tau(problem))
    return Mode(
        problem, phi, sigma, step.jacobian, step.covariance(),
        -_cost(problem, linear.residual, sigma, phi),
    )  # fmt: skip


def refined(modes: Sequence[Mode]) -> list[Mode]:
    """Return modes with the last one fitted until it gains no more."""
    return [*modes[:-1], fit_pieces(modes[-1].problem, modes[-1].phi, rounds=_MANY)]


def _start_cost(problem: Problem, phi: Floats) -> float:
    """Return the cost at phi with the start states taken along to first order."""
    likelihood = output_error(problem)
    residual = _residual(problem, phi[None], problem.segments.start[None])[0]
    return _cost(problem, residual, likelihood.profile(residual, least_errors(problem)), phi)


def _tau(problem: Problem) -> Floats:
    """Return the integrated autocorrelation times, shape (state,)."""
    return np.array(output_error(problem).tau)


def _residual(problem: Problem, points: Floats, starts: Floats) -> Floats:
    """Return residuals at points (n, p) and starts (n, piece, body, 6)."""
    states = problem.rough.simulator(points, np.ascontiguousarray(starts), problem.inputs)
    return finite(problem, problem.observations.residual(states))


def _linearise(
    problem: Problem, phi: Floats, start: Floats, steps: tuple[Floats, Floats]
) -> _Linear:
    """Return residual and derivatives by central differences, all in one call of the engine."""
    cells = output_error(problem).starts.cells
    lower, upper = box(problem.layout.priors)
    ahead, behind = np.minimum(phi + steps[0], upper), np.maximum(phi - steps[0], lower)
    p, c = len(phi), len(cells.places)
    points = np.tile(phi, (1 + 2 * p + 2 * c, 1))
    points[1 + np.arange(p), np.arange(p)] = ahead
    points[1 + p + np.arange(p), np.arange(p)] = behind
    starts = np.tile(start, (len(points), 1, 1, 1))
    flat = starts.reshape(len(points), len(start), -1)
    for i, place in enumerate(cells.places):
        flat[1 + 2 * p + i, :, place] += steps[1][i]
        flat[1 + 2 * p + c + i, :, place] -= steps[1][i]
    residual = _residual(problem, points, cells.completed(problem.scene, starts))
    width = np.maximum(ahead - behind, 1e-300)
    by_phi = np.moveaxis(residual[1 : 1 + p] - residual[1 + p : 1 + 2 * p], 0, -1) / -width
    begun = residual[1 + 2 * p :]
    by_start = np.moveaxis(begun[:c] - begun[c:], 0, -1) / (-2 * steps[1])
    return _Linear(residual[0], by_phi, by_start)


def _with_noise(problem: Problem, start: Floats, linear: _Linear) -> tuple[Problem, Floats]:
    """Return the problem linearised there, and sigma."""
    problem = linearised_about(problem, start, linear.by_start)
    likelihood, least = output_error(problem), least_errors(problem)
    sigma = likelihood.profile(linear.residual, least)
    tau = likelihood.correlation_times(linear.residual, sigma)
    return problem.with_likelihood(tau=tuple(tau.tolist())), sigma


def _cost(problem: Problem, residual: Floats, sigma: Floats, phi: Floats) -> float:
    """Return the negative log-posterior, the noise at its profile, up to a constant."""
    likelihood = output_error(problem)
    weight = likelihood.starts.counts / np.array(likelihood.tau)
    prior = 0.5 * (prior_residual(problem.layout.priors, phi) ** 2).sum()
    return float((weight * np.log(sigma)).sum() + prior)


class _Step:
    """Gauss-Newton steps from one linearisation."""

    def __init__(self, problem: Problem, linear: _Linear, sigma: Floats, phi: Floats) -> None:
        likelihood = output_error(problem)
        self.problem, self.phi, self.starts = problem, phi, likelihood.starts
        priors = problem.layout.priors
        self.weight = weight = 1.0 / (sigma * np.sqrt(likelihood.tau))
        self.u, self.back = self.starts.basis(weight)
        self.rows = self.starts.rows(linear.residual, weight)
        by_phi = np.moveaxis(linear.by_phi, -1, 0) * weight
        pieces, rows = len(self.rows), linear.residual[0].size
        by_phi = by_phi.reshape(len(phi), pieces, rows)
        n = self.rows.shape[-1] - rows
        self.by_phi = np.moveaxis(np.pad(by_phi, ((0, 0), (0, 0), (0, n))), 0, -1)
        projected = self.by_phi - self.u @ (np.swapaxes(self.u, 1, 2) @ self.by_phi)
        taken = (self.u @ (np.swapaxes(self.u, 1, 2) @ self.rows[..., None]))[..., 0]
        self.jacobian = projected.reshape(self.rows.size, len(phi))
        self.residual = self.rows - taken
        self.slopes = prior_slopes(priors, phi) if priors else np.zeros(0)
        self.gradient = self.jacobian.T @ self.residual.ravel()
        self.gradient = self.gradient - self.slopes * prior_residual(priors, phi)
        self.precision = self.jacobian.T @ self.jacobian + np.diag(self.slopes**2)
        own = np.where(self.starts.seen[..., None], linear.by_start, 0.0) * weight[:, None]
        self.of_start = (own**2).sum((1, 2, 3)) + np.isfinite(self.starts.begin) * np.where(
            self.starts.column >= 0, weight[self.starts.column], 0.0
        ) ** 2

    def covariance(self) -> Floats:
        """Return the covariance of phi under errors as correlated as the residual, shape (p, p).

        A sandwich: the inverse precision, the variance of the score, the inverse precision. With
        many trajectories, no parameter's is less than by the scatter of the trajectories' scores
        (a cluster-robust covariance), which what differs from one to the other widens.
        """
        jacobian = self.jacobian.reshape(*self.rows.shape, len(self.phi))
        residual, start, by_phi = map(self.starts.series, (self.residual, self.u, jacobian))
        seen, score = self.starts.seen_series, np.diag(self.slopes**2)
        lags = np.abs(np.subtract.outer(np.arange(seen.shape[1]), np.arange(seen.shape[1])))
        for d, white in enumerate(least_errors(self.problem) * self.weight):
            own = by_phi[..., d, :]
            errors = autocovariance(residual[..., d], seen[..., d], start[..., d, :], own)
            errors[0] += white**2
            score = score + np.einsum("arbp,rs,asbq->pq", own, errors[lags], own, optimize=True)
        inverse = covariance_of(self.precision)
        found = inverse @ score @ inverse
        _, cluster = np.unique(self.problem.segments.trajectory, return_inverse=True)
        n = cluster.max() + 1
        if n >= _MANY_TRAJECTORIES:
            scores = np.zeros((n, len(self.phi)))
            np.add.at(scores, cluster, np.einsum("arp,ar->ap", jacobian, self.residual))
            score = n / (n - 1) * scores.T @ scores + np.diag(self.slopes**2)
            least = np.diag(inverse @ score @ inverse)
            wider = np.sqrt(np.maximum(least / np.maximum(np.diag(found), 1e-300), 1.0))
            found = found * np.outer(wider, wider)
        return np.asarray(found)

    def differences(self, scale: Floats, sizes: Floats) -> tuple[Floats, Floats]:
        """Return steps of the next derivatives, shapes (p,) and (cell,)."""
        width = _OF_PHI / np.sqrt(np.maximum(np.diag(self.precision), 1e-300))
        width = np.where(
            self.problem.layout.discrete, 0.0, np.clip(width, _LEAST * scale, _MOST * scale)
        )
        own = _OF_START / np.sqrt(np.maximum(np.median(self.of_start, axis=0), 1e-300))
        return width, np.clip(own, _LEAST * sizes, _MOST * sizes)

    def moved(self, damping: float, start: Floats) -> tuple[Floats, Floats]:
        """Return phi and start states a damped step on, shapes (p,) and (piece, body, 6)."""
        phi, cells = self.phi, self.starts.cells
        if len(phi):
            sd = 1.0 / np.sqrt(np.maximum(np.diag(self.precision), 1e-300))
            scaled = self.precision * np.outer(sd, sd) + damping * np.eye(len(sd))
            step = sd * np.linalg.solve(scaled, sd * self.gradient)
            if np.isfinite(step).all():  # where the engine diverges there is no slope
                phi = inside(self.problem.layout.priors, phi + step)
        left = self.rows - self.by_phi @ (phi - self.phi)
        change = (self.back @ (np.swapaxes(self.u, 1, 2) @ left[..., None]))[..., 0]
        states = start.copy()
        states.reshape(len(start), -1)[:, cells.places] += change / (1.0 + damping)
        return phi, cells.completed(self.problem.scene, states)


def simulated_states(mode: Mode) -> Floats:
    """Return the states along the simulated pieces, shape (trajectory, time, body, 6)."""
    problem, segments = mode.problem, mode.problem.segments
    ends = problem.rough.simulator(mode.phi, segments.start, problem.inputs)
    states = problem.data.smoothed_states.copy()
    rows = problem.data.history.dataset["n_rows"].to_numpy()[segments.trajectory]
    for i in range(segments.horizon):
        own = (segments.step + 1 + i < rows) & np.isfinite(ends[:, i]).all(axis=(1, 2))
        states[segments.trajectory[own], segments.step[own] + 1 + i] = ends[own, i]
    states[segments.trajectory, segments.step] = segments.start
    return states


def growth(problem: Problem) -> float:
    """Return by how much pieces magnify their starts, beyond growth in proportion to time."""
    slope = np.abs(output_error(problem).starts.slope)
    size = np.sqrt((slope**2).sum(axis=(2, 3)))  # (piece, H, cell)
    first = max(3, min(size.shape[1] // 2, 8))
    begin = size[:, :first].max(axis=1)
    ratio = size.max(axis=1) / np.maximum(begin, 1e-300) * first / size.shape[1]
    return float(np.median(ratio, axis=0).max(initial=0.0))
