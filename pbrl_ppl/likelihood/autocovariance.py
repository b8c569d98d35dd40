"""Autocovariance of measurement errors, from residuals of fitted initial states and parameters.

The fit takes low frequencies out of the residual, so that the residual's own autocovariance is too
small. Restricted maximum likelihood allows for that: H. D. Patterson and R. Thompson, Recovery of
inter-block information when block sizes are unequal, 1971.
"""

from __future__ import annotations

import numpy as np

from pbrl_ppl.state import Bools, Floats


def autocovariance(
    residual: Floats,
    seen: Bools,
    by_start: Floats,
    by_phi: Floats,
    *,
    shortest: float = 0.5,
    n_times: int = 12,
    shares: tuple[float, ...] = (0.0, 0.02, 0.1, 0.3, 0.6, 0.9, 1.0),
    least_freedom: int = 5,
    chunk: float = 4e6,
) -> Floats:
    """Return the expected autocovariance of the errors of a dimension by lag, shape (row,).

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
    shortest : float
        Least time constant of correlated errors (rows).
    n_times : int
        Time constants up to a piece's length.
    shares : tuple of float
        Shares of correlated errors in the variance.
    least_freedom : int
        Degrees of freedom that show a correlation, at least.
    chunk : float
        Numbers that an array over grid points may hold.
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
    if freedom < least_freedom:
        return np.append((residual[seen] ** 2).mean(), np.zeros(rows - 1))
    columns = np.concatenate([start, phi, last], axis=2).reshape(*residual.shape, -1)
    times = np.geomspace(shortest, max(rows, 1.0), n_times)
    grid = np.array([(np.exp(-1 / t), share) for t in times for share in shares])
    chunks = np.ceil(len(grid) * pieces * columns.shape[-1] ** 2 / chunk)
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


def _whitened(
    columns: Floats, seen: Bools, memory: Floats, share: Floats, *, nugget: float = 1e-9
) -> tuple[Floats, Floats]:
    """Return inner products of whitened columns and log-determinants of the errors' correlation.

    Shapes (grid, piece, column, column) and (grid,). A Kalman filter of the AR(1) process, of all
    pieces, columns and grid points at once.

    ``nugget``: share of the variance that is white in any case.
    """
    pieces, rows, bodies, n = columns.shape
    mean = np.zeros((len(share), pieces, bodies, n))
    variance = np.broadcast_to(share, mean.shape[:-1])
    gram, log_det = np.zeros((len(share), pieces, n, n)), np.zeros(len(share))
    for row in range(rows):
        there = seen[:, row]
        total = np.where(there, variance + 1.0 - share + nugget, 1.0)
        off = np.where(there[..., None], columns[:, row] - mean, 0.0)
        gram += np.swapaxes(off, 2, 3) @ (off / total[..., None])
        log_det += np.log(total).sum((1, 2))
        gain = np.where(there, variance / total, 0.0)
        mean = memory[..., None] * (mean + gain[..., None] * off)
        variance = memory**2 * variance * (1.0 - gain) + (1.0 - memory**2) * share
    return gram, log_det
