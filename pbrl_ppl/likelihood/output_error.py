"""Output-error likelihood: pieces of trajectories simulated from latent initial states.

No process noise is assumed: a law that is missing piles up along a piece, and the estimate is
consistent whatever the correlation of the residual. See L. Ljung, System Identification (2nd ed.,
1999), section 4.3. The initial states are eliminated by projection (G. H. Golub and V. Pereyra, The
differentiation of pseudo-inverses and nonlinear least squares problems whose variables separate,
1973).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, TypeGuard, final

import numpy as np

from pbrl_ppl.likelihood.coordinates import Coordinates, observed_coordinates
from pbrl_ppl.likelihood.data import Observations
from pbrl_ppl.likelihood.likelihood import Likelihood, Nu, log_norm, robust
from pbrl_ppl.likelihood.problem import Problem
from pbrl_ppl.physics import Memory
from pbrl_ppl.state import STATE, THETA, Bools, Floats, Ints, wrapped


@dataclass(frozen=True, eq=False, repr=False)
class InitialStates:
    """Linearisation of pieces about their initial states.

    Parameters
    ----------
    coordinates : Coordinates
        Coordinates of the initial states that are inferred.
    slope : ndarray
        Derivative of the observed states by the start, shape (piece, H, body, state, coordinate).
    seen : ndarray of bool
        What was measured, shape (piece, H, body, state).
    begin : ndarray
        Measured minus latent start, shape (piece, coordinate); NaN where not measured.
    given : ndarray of bool
        Initial coordinates that are given: recorded, of a dimension that is not observed. Shape
        (piece, coordinate).
    column : ndarray of int
        Place among the observed dimensions of each coordinate, -1 if it is not one; shape
        (coordinate,).
    """

    coordinates: Coordinates
    slope: Floats
    seen: Bools
    begin: Floats
    given: Bools
    column: Ints
    memory: Memory = field(init=False, default_factory=Memory)

    @cached_property
    def measured(self) -> Floats:
        """Numbers of measurements of each observed dimension, shape (state,)."""
        return self.totals(self.seen, np.isfinite(self.begin))

    def totals(self, measured: Floats | Bools, begin: Floats | Bools) -> Floats:
        """Return sums over each observed dimension, its initial coordinates among them, (state,).

        Arguments have the shapes (piece, H, body, state) and (piece, coordinate).
        """
        total, sensed = measured.sum((0, 1, 2)).astype(float), self.column >= 0
        np.add.at(total, self.column[sensed], begin.sum(axis=0)[sensed])
        return np.asarray(total)

    @cached_property
    def counts(self) -> Floats:
        """Degrees of freedom of each observed dimension, shape (state,).

        Its measurements, less its part of the directions that initial states can take up
        (restricted likelihood: H. D. Patterson and R. Thompson, Biometrika 58, 1971).
        """
        total = max(self.measured.sum(), 1.0)
        u, _ = self.basis(np.ones(self.measured.shape))
        taken = float((u**2)[self.seen_rows].sum())
        return np.asarray(self.measured * max(total - taken, 1.0) / total)

    def rows(self, residual: Floats, weight: Floats) -> Floats:
        """Return weighted residuals with those of the start, shape (..., piece, row).

        ``residual`` has shape (..., piece, H, body, state), ``weight`` (state,).
        """
        z = (residual * weight).reshape(*residual.shape[:-3], -1)
        begin = np.nan_to_num(self.begin) * self.of_coordinates(weight)
        return np.concatenate([z, np.broadcast_to(begin, (*z.shape[:-1], begin.shape[-1]))], -1)

    def series(self, rows: Floats | Bools) -> Floats:
        """Return rows as series that begin with the start, shape (piece, 1 + H, body, state, ...).

        ``rows`` has shape (piece, row, ...); a start that is not observed is 0.
        """
        pieces, horizon, bodies, state = self.seen.shape
        cut, sensed = horizon * bodies * state, self.column >= 0
        out = np.zeros((pieces, 1 + horizon, bodies, state, *rows.shape[2:]))
        out[:, 1:] = rows[:, :cut].reshape(pieces, horizon, bodies, state, *rows.shape[2:])
        body = self.coordinates.places // len(STATE)
        out[:, 0, body[sensed], self.column[sensed]] = rows[:, cut:][:, sensed]
        return out

    @property
    def seen_rows(self) -> Bools:
        """What was measured of :meth:`rows`, shape (piece, row)."""
        seen = self.seen.reshape(len(self.seen), -1)
        return np.concatenate([seen, np.isfinite(self.begin)], axis=1)

    def basis(self, weight: Floats) -> tuple[Floats, Floats]:
        """Return what initial states can take up, and how: orthonormal rows and the way back.

        Shapes (piece, row, direction) and (piece, coordinate, direction).
        """
        unit = weight.max()  # the basis depends on the weights' ratios alone
        u, back = self.memory.recall((weight / unit,), self._basis)
        return u, back / unit

    def _basis(self, weight: Floats) -> tuple[Floats, Floats]:
        """Return the basis for weights of which the largest is 1."""
        pieces, coordinates = self.begin.shape
        moved = np.where(self.seen[..., None], self.slope, 0.0) * weight[:, None]
        moved = moved.reshape(pieces, -1, coordinates)
        diagonal = np.isfinite(self.begin) * self.of_coordinates(weight)
        # what is given has far more weight than all measurements that depend on it
        diagonal += self.given * 1e6 * np.linalg.norm(moved, axis=1)
        rows = np.concatenate([moved, diagonal[:, :, None] * np.eye(coordinates)], axis=1)
        scale = np.linalg.norm(rows, axis=1)
        scale = np.where(scale > 0, scale, 1.0)
        rows = rows / scale[:, None]
        square, v = np.linalg.eigh(np.swapaxes(rows, 1, 2) @ rows)
        # directions of small singular values move nothing that was measured
        kept = square > 1e-5**2 * square.max(axis=1, keepdims=True, initial=1e-300)
        inverse = np.where(kept, 1.0 / np.sqrt(np.where(kept, square, 1.0)), 0.0)
        return rows @ v * inverse[:, None], v * inverse[:, None] / scale[:, :, None]

    def of_coordinates(self, values: Floats) -> Floats:
        """Return a dimension's value for each coordinate, 0 if not observed, (coordinate,)."""
        return np.where(self.column >= 0, values[self.column], 0.0)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class OutputErrorLikelihood(Likelihood):
    """Likelihood of simulated pieces, whose latent initial states are eliminated.

    A residual that is correlated counts as fewer measurements: the log-density of each dimension is
    divided by its integrated autocorrelation time (a composite likelihood's adjustment).

    Parameters
    ----------
    initial_states : InitialStates
        The linearisation about the initial states.
    tau : tuple of float
        Integrated autocorrelation time of each observed dimension, in rows.
    nu, prior
        As of :class:`Likelihood`.
    """

    name: ClassVar[str] = "simulation"

    initial_states: InitialStates
    tau: tuple[float, ...]

    def counts(self, observations: Observations) -> Floats:
        """Return the degrees of freedom over the autocorrelation times, shape (state,)."""
        return np.asarray(self.initial_states.counts / np.array(self.tau))

    def weight(self, sigma: Floats) -> Floats:
        """Return one over sigma and the root of tau, shape (..., state)."""
        return np.asarray(1.0 / (sigma * np.sqrt(self.tau)))

    def whiten(self, residual: Floats, sigma: Floats) -> Floats:
        """Return residuals over sigma and the root of tau, without what initial states take up."""
        weight = self.weight(sigma)
        if weight.ndim > 1:
            flat = weight.reshape(-1, weight.shape[-1])
            flattened = residual.reshape(len(flat), *residual.shape[weight.ndim - 1 :])
            projected = [self._projected(r, w) for r, w in zip(flattened, flat, strict=True)]
            return np.reshape(projected, (*weight.shape[:-1], *projected[0].shape))
        return self._projected(residual, weight)

    def _projected(self, residual: Floats, weight: Floats) -> Floats:
        z, (u, _) = self.initial_states.rows(residual, weight), self.initial_states.basis(weight)
        taken = np.matmul(np.matmul(z[..., None, :], u), np.swapaxes(u, 1, 2))[..., 0, :]
        return np.asarray(z - taken)

    def in_order(self, values: Floats) -> Floats:
        """Return a value per residual, infinity for initial states, shape (..., piece, row)."""
        rows = values.reshape(*values.shape[:-3], -1)
        begin = np.full((*rows.shape[:-1], len(self.initial_states.column)), np.inf)
        return np.concatenate([rows, begin], axis=-1)

    def log_density(self, residual: Floats, sigma: Floats, measured: Bools, nu: Nu) -> Floats:
        """Return the tempered log-likelihood of each piece, shape (..., piece)."""
        z = robust(self.whiten(residual, sigma), self.whitened_nu(nu, residual.shape))
        share = self.initial_states.counts / np.array(self.tau) / len(self.initial_states.begin)
        norm = (share * (np.max(log_norm(nu)) - np.log(sigma))).sum(axis=-1)[..., None]
        return np.where(np.isnan(z).any(axis=-1), -np.inf, norm - 0.5 * (z**2).sum(axis=-1))

    def random(
        self, predicted: Floats, linearised: Floats, sigma: Floats, rng: np.random.Generator, nu: Nu
    ) -> Floats:
        """Draw measurements with white errors about the most probable trajectories."""
        initial_states = self.initial_states
        residual = np.where(initial_states.seen, linearised - predicted, 0.0)
        angle = initial_states.column[initial_states.coordinates.places % len(STATE) == THETA]
        residual[..., angle[angle >= 0]] = wrapped(residual[..., angle[angle >= 0]])
        weight = self.weight(sigma)
        u, back = initial_states.basis(weight)
        change = back @ (np.swapaxes(u, 1, 2) @ initial_states.rows(residual, weight)[..., None])
        moved = np.einsum("phkdc,pc->phkd", initial_states.slope, change[..., 0])
        return np.asarray(predicted + moved + sigma * rng.standard_normal(predicted.shape))

    def unwhitened_slope(self, pull: Floats, sigma: Floats, shape: tuple[int, ...]) -> Floats:
        """Return what initial states do not take up, over minus sigma and the root of tau."""
        weight = self.weight(sigma)
        kept = without(self.initial_states.basis(weight)[0], pull)
        kept = kept[:, : kept.shape[1] - len(self.initial_states.column)]
        return -kept.reshape(shape) * weight

    def unwhitened(self, residual: Floats, sigma: Floats) -> tuple[Floats, Floats]:
        """Return projected residuals of the pieces and of their initial states, SI units.

        Shapes (piece, H, body, state) and (piece, coordinate).
        """
        z = self._projected(residual, 1.0 / np.asarray(sigma))
        cut = z.shape[-1] - len(self.initial_states.column)
        rows = z[..., :cut].reshape(residual.shape) * sigma
        return rows, z[..., cut:] * self.initial_states.of_coordinates(sigma)

    def profile(self, residual: Floats, least: Floats) -> Floats:
        """Return the restricted-likelihood sigma of each dimension, shape (state,).

        ``least`` are the least that they may be, shape (state,), SI units.
        """
        square = (residual**2).sum((0, 1, 2))
        sigma = np.maximum(np.sqrt(square / self.initial_states.counts), least)
        for _ in range(6):  # sigma and the projection depend on each other
            rows, begin = self.unwhitened(residual, sigma)
            square = self.initial_states.totals(rows**2, begin**2)
            last, sigma = sigma, np.maximum(np.sqrt(square / self.initial_states.counts), least)
            if np.all(abs(sigma - last) < 1e-3 * last):
                break
        return np.asarray(sigma)

    def correlation_times(self, residual: Floats, sigma: Floats) -> Floats:
        """Return the integrated autocorrelation time of each dimension in rows, shape (state,).

        Of the projected residuals, without pairs from different pieces (Geyer's initial sequence).
        A correlation below 0.05, or of fewer than ten pairs, ends the sum.
        """
        rows, _ = self.unwhitened(residual, sigma)
        seen, tau = self.initial_states.seen, np.ones(rows.shape[-1])
        for d in range(len(tau)):
            x, there = rows[..., d], seen[..., d]
            variance = (x**2).sum() / max(there.sum(), 1)
            for lag in range(1, x.shape[1]):
                pair = there[:, lag:] & there[:, :-lag]
                if pair.sum() < 10 or not variance > 0:
                    break
                correlation = (x[:, lag:] * x[:, :-lag])[pair].mean() / variance
                if correlation < 0.05:
                    break
                tau[d] += 2 * correlation
        return tau


#: A problem whose trajectories are simulated from latent initial states.
SimulatedProblem = Problem[OutputErrorLikelihood]


def is_simulated(problem: Problem) -> TypeGuard[SimulatedProblem]:
    """Return whether the problem's trajectories are simulated from latent initial states."""
    return problem.likelihood.name == OutputErrorLikelihood.name


def without(u: Floats, rows: Floats) -> Floats:
    """Return rows (piece, row) without what orthonormal columns (piece, row, direction) explain."""
    return np.asarray(rows - (u @ (np.swapaxes(u, 1, 2) @ rows[..., None]))[..., 0])


def in_pieces(problem: Problem, length: int, states: Floats) -> SimulatedProblem:
    """Return the problem of pieces that are simulated from latent initial states.

    Parameters
    ----------
    problem : Problem
        Of any likelihood.
    length : int
        Intervals of a piece, at least 2.
    states : ndarray
        Initial states, shape (trajectory, time, body, 6), SI units.
    """
    problem = problem.with_data(horizon=length, states=states, columns=None)
    coordinates = observed_coordinates(problem.scene, problem.data.history)
    columns, dimension = problem.observations.columns, coordinates.places % len(STATE)
    column = np.array([columns.index(d) if d in columns else -1 for d in dimension])
    seen = problem.observations.measured
    slope = np.zeros((*seen.shape, len(coordinates.places)))
    begin = _begin(problem, coordinates, column, problem.segments.start)
    known = (column < 0) & np.isfinite(coordinates.of(_observed_initial_states(problem)))
    likelihood = OutputErrorLikelihood(
        initial_states=InitialStates(coordinates, slope, seen, begin, known, column),
        tau=(1.0,) * len(columns),
        nu=problem.likelihood.nu,
    )
    return Problem(problem.data, problem.physics, likelihood, problem.library)


def linearised_pieces(
    problem: SimulatedProblem, start: Floats, slope: Floats, tau: Floats
) -> SimulatedProblem:
    """Return the problem of pieces with other initial states and what was linearised there.

    Parameters
    ----------
    problem : SimulatedProblem
        Result of :func:`in_pieces`.
    start : ndarray
        Initial states, shape (piece, body, 6), SI units.
    slope : ndarray
        Derivative of the observed states by them, shape (piece, H, body, state, coordinate).
    tau : ndarray
        Integrated autocorrelation time of each dimension, shape (state,).
    """
    segments, states = problem.segments, problem.data.smoothed_states.copy()
    states[segments.trajectory, segments.step] = start
    problem = linearised_about(problem, start, slope)
    return problem.with_likelihood(tau=tuple(np.asarray(tau).tolist())).with_states(states)


def linearised_about(problem: SimulatedProblem, start: Floats, slope: Floats) -> SimulatedProblem:
    """Return the problem with the likelihood about other initial states; its data stay.

    Arguments are those of :func:`linearised_pieces`.
    """
    old = problem.likelihood.initial_states
    begin = _begin(problem, old.coordinates, old.column, start)
    return problem.with_likelihood(initial_states=replace(old, slope=slope, begin=begin))


def _begin(problem: Problem, coordinates: Coordinates, column: Ints, start: Floats) -> Floats:
    """Return measured minus latent initial states (piece, coordinate); NaN where not measured."""
    off = coordinates.of(_observed_initial_states(problem)) - coordinates.of(start)
    return np.where(column >= 0, coordinates.wrapped(off), np.nan)


def _observed_initial_states(problem: Problem) -> Floats:
    """Return what was measured where pieces begin, shape (piece, body, 6), NaN where nothing."""
    segments = problem.segments
    observed = problem.data.history.dataset["observed"].to_numpy()
    return np.asarray(observed[segments.trajectory, segments.step])


def autocovariance(residual: Floats, seen: Bools, by_start: Floats, by_phi: Floats) -> Floats:
    """Return the expected autocovariance of the errors of a dimension by lag, shape (row,).

    The fit takes low frequencies out of the residual, so that the residual's own autocovariance is
    too small. Restricted maximum likelihood allows for that: H. D. Patterson and R. Thompson,
    Recovery of inter-block information when block sizes are unequal, 1971.

    Errors are white noise plus an AR(1) process. The memory and the share of the latter are
    averaged over a grid, weighted by their restricted likelihood, so that their uncertainty counts.

    Parameters
    ----------
    residual : ndarray
        Residuals of the fit, shape (piece, row, body).
    seen : ndarray of bool
        What was measured, shape (piece, row, body).
    by_start, by_phi : ndarray
        Derivatives by the initial states and by the parameters, shape (piece, row, body, column).
    """
    pieces, rows, bodies = residual.shape
    start, phi, last = (
        np.where(seen[..., None], part, 0.0).reshape(pieces, rows * bodies, -1)
        for part in (by_start, by_phi, residual[..., None])
    )
    start = _orthonormal(start)
    # what initial states follow as well is left as rounding
    least = max(1e-6 * float(np.linalg.norm(phi)), 1e-300)
    phi, last = (part - start @ (np.swapaxes(start, 1, 2) @ part) for part in (phi, last))
    phi = _orthonormal(phi.reshape(1, pieces * rows * bodies, -1), least)
    phi = phi.reshape(*last.shape[:2], -1)
    freedom = seen.sum() - (start**2).sum() - (phi**2).sum()
    if freedom < 5:  # too few degrees of freedom to show a correlation
        return np.append((residual[seen] ** 2).mean(), np.zeros(rows - 1))
    columns = np.concatenate([start, phi, last], axis=2).reshape(*residual.shape, -1)
    times = np.geomspace(0.5, max(rows, 1.0), 12)  # time constants (rows) up to a piece's length
    shares = (0.0, 0.02, 0.1, 0.3, 0.6, 0.9, 1.0)  # of correlated errors in the variance
    grid = np.array([(np.exp(-1 / t), share) for t in times for share in shares])
    chunks = np.ceil(len(grid) * pieces * columns.shape[-1] ** 2 / 4e6)  # numbers an array holds
    restricted = [
        _restricted(columns, seen, start.shape[2], *part.T)
        for part in np.array_split(grid, min(int(chunks), len(grid)))
    ]
    square, log_det = (np.concatenate(part) for part in zip(*restricted, strict=True))
    square = np.maximum(square, 1e-300)
    log_weight = -0.5 * (log_det + freedom * np.log(square))
    weight = np.exp(log_weight - log_weight.max())
    correlation = grid[:, 1:] * grid[:, :1] ** np.arange(rows)
    correlation[:, 0] = 1.0
    return np.asarray(weight * square @ correlation / weight.sum() / (freedom - 2))


def _orthonormal(columns: Floats, least: float = 1e-300, *, rank: float = 1e-6) -> Floats:
    """Return orthonormal columns of the same span, shape (piece, row, rank); spare ones are 0.

    ``rank``: directions with a smaller singular value, relative to the largest or to ``least``,
    change no residual.
    """
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    kept = s > rank * s.max(axis=1, keepdims=True, initial=least)
    return np.asarray((u * kept[:, None])[:, :, kept.any(axis=0)])


def _restricted(
    columns: Floats, seen: Bools, n_initial: int, memory: Floats, share: Floats
) -> tuple[Floats, Floats]:
    """Return whitened sums of squares and log-determinants at grid points, shapes (grid,).

    ``columns`` are of initial states, ``n_initial`` of them, of parameters, and the residual.
    """
    gram, log_det = _whitened(columns, seen, memory[:, None, None], share[:, None, None])
    spare = 1.0 - (columns**2).sum((1, 2))  # (piece, column)
    within = gram[..., :n_initial, :n_initial] + spare[:, :n_initial, None] * np.eye(n_initial)
    across = gram[..., :n_initial, n_initial:]
    left = gram[..., n_initial:, n_initial:] - np.swapaxes(across, 2, 3) @ np.linalg.solve(
        within, across
    )
    log_det = log_det + np.linalg.slogdet(within)[1].sum(axis=1)
    left = left.sum(axis=1)
    within, across = left[:, :-1, :-1], left[:, :-1, -1:]
    taken = (across * np.linalg.solve(within, across)).sum((1, 2))
    return left[:, -1, -1] - taken, log_det + np.linalg.slogdet(within)[1]


def _whitened(columns: Floats, seen: Bools, memory: Floats, share: Floats) -> tuple[Floats, Floats]:
    """Return inner products of whitened columns and log-determinants of the errors' correlation.

    Shapes (grid, piece, column, column) and (grid,). A Kalman filter of the AR(1) process, of all
    pieces, columns and grid points at once. A billionth of the variance is white in any case.
    """
    pieces, rows, bodies, n = columns.shape
    mean = np.zeros((len(share), pieces, bodies, n))
    variance = np.broadcast_to(share, mean.shape[:-1])
    gram, log_det = np.zeros((len(share), pieces, n, n)), np.zeros(len(share))
    for row in range(rows):
        there = seen[:, row]
        total = np.where(there, variance + 1.0 - share + 1e-9, 1.0)
        off = np.where(there[..., None], columns[:, row] - mean, 0.0)
        gram += np.swapaxes(off, 2, 3) @ (off / total[..., None])
        log_det += np.log(total).sum((1, 2))
        gain = np.where(there, variance / total, 0.0)
        mean = memory[..., None] * (mean + gain[..., None] * off)
        variance = memory**2 * variance * (1.0 - gain) + (1.0 - memory**2) * share
    return gram, log_det
