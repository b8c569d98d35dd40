"""Emulator of the engine about a mode, by polynomials of the parameters."""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.model import Problem
from pbrl_ppl.modes import Mode
from pbrl_ppl.sampling.metropolis import Gaussian, explore
from pbrl_ppl.sampling.surrogate import Surrogate, Unpack

Array = NDArray[np.float64]

#: Degrees to try; engine runs a coefficient, at least and at most; rounds of each.
_DEGREES, _A_COEFFICIENT, _LEAST, _MOST, _ROUNDS = (1, 2), 4, 100, 400, 4
#: How far off (standard deviation) the log-likelihood may be: half of the moves still pass.
_CLOSE = 1.0
#: Steps of the exploring chain between two runs.
_APART = 20


class Emulator:
    """Residuals as polynomials of the parameters, by least squares, each part's of its own.

    Regression over draws as wide as the posterior averages over the kinks of friction, which a
    derivative at one point does not.

    Parameters
    ----------
    problem : Problem
        Says which parameters move which bodies.
    phi : ndarray
        Where the engine was run, shape (run, p).
    residual : ndarray
        What it gave, shape (run, transition, H, body, state).
    degree : int
        Of the polynomials.
    """

    def __init__(self, problem: Problem, phi: Array, residual: Array, degree: int) -> None:
        self.shape, self.degree, self.parts = residual.shape[1:], degree, []
        self._asked: dict[int, Array] = {}
        self._said = np.empty(self.shape)
        for part in problem.simulator.parts:
            own = phi[:, part.places]
            centre, scale = own.mean(axis=0), np.maximum(own.std(axis=0), 1e-300)
            terms = _terms((own - centre) / scale, degree)
            targets = residual[:, :, :, part.bodies].reshape(len(phi), -1)
            weights = np.linalg.lstsq(terms, targets, rcond=None)[0]
            self.parts.append((part.places, part.bodies, centre, scale, weights))

    def __call__(self, phi: Array) -> Array:
        """Residuals for phi of shape (p,); the array changes with the next call."""
        for i, (places, bodies, centre, scale, weights) in enumerate(self.parts):
            own = phi[places]
            if i in self._asked and np.array_equal(own, self._asked[i]):
                continue  # a sampler moves one part at a time
            self._asked[i] = own
            said = _terms((own - centre) / scale, self.degree) @ weights
            self._said[:, :, bodies] = said.reshape(*self.shape[:2], len(bodies), -1)
        return self._said


def _terms(z: Array, degree: int) -> Array:
    """The monomials of z, shape (..., p), up to a degree, shape (..., term)."""
    columns = [np.ones((*z.shape[:-1], 1)), z]
    for d in range(2, degree + 1):
        chosen = np.array(list(combinations_with_replacement(range(z.shape[-1]), d)), dtype=int)
        columns.append(z[..., chosen.reshape(-1, d)].prod(axis=-1))
    return np.concatenate(columns, axis=-1)


def emulate(
    mode: Mode, unpack: Unpack, blocks: list[Gaussian], seed: int | np.random.Generator
) -> Emulator | None:
    """Fit an emulator to runs drawn from the posterior, as the one before it has that.

    Parameters
    ----------
    mode : Mode
        The first runs are drawn from its Laplace approximation.
    unpack : Unpack
        Of the problem's model.
    blocks : list of Gaussian
        Together they hold every entry of the sampler's vector; they learn the posterior's shape.
    seed : int or Generator
        Of the draws.

    Returns
    -------
    Emulator or None
        None where the log-likelihood of polynomials stays far from the engine's.
    """
    problem, rng = mode.problem, np.random.default_rng(seed)
    q = np.empty(sum(len(block.places) for block in blocks))
    for block in blocks:
        q[block.places] = block.mean
    widest = max(len(part.places) for part in problem.simulator.parts)
    close = _CLOSE * np.sqrt(len(problem.simulator.parts))  # each part is judged alone
    for degree in _DEGREES:
        runs = max(_LEAST, _A_COEFFICIENT * _terms(np.zeros(widest), degree).size)
        if runs > _MOST:
            break
        phi = mode.draws(rng, runs)
        residual = problem.residual(phi)
        for _ in range(_ROUNDS):
            good = np.isfinite(residual).all(axis=(1, 2, 3, 4))
            if good.sum() < 0.5 * runs:
                break
            emulator = Emulator(problem, phi[good], residual[good], degree)
            cheap = Surrogate(problem, unpack, emulator)
            chain = explore(blocks, cheap, q, _APART * runs, rng)[_APART - 1 :: _APART]
            drawn = [unpack(point)[:2] for point in chain]
            phi, sigma = (np.array(column) for column in zip(*drawn, strict=True))
            residual = problem.residual(phi)
            told = np.array([emulator(point).copy() for point in phi])
            exact = problem.log_density(residual, sigma, phi).sum(axis=-1)
            off = problem.log_density(told, sigma, phi).sum(axis=-1) - exact
            if np.isfinite(off).all() and off.std() < close:
                return Emulator(problem, phi, residual, degree)
    return None
