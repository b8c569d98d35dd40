"""Emulator of the engine about a mode, by polynomials of the parameters."""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.model import Problem

Array = NDArray[np.float64]


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
            terms = monomials((own - centre) / scale, degree)
            targets = residual[:, :, :, part.bodies].reshape(len(phi), -1)
            weights = np.linalg.lstsq(terms, targets, rcond=None)[0]
            self.parts.append((part.places, part.bodies, centre, scale, weights))

    def __call__(self, phi: Array) -> Array:
        """Residuals for phi of shape (p,); the array changes with the next call."""
        for i, (places, bodies, *_, weights) in enumerate(self.parts):
            own = phi[places]
            if i in self._asked and np.array_equal(own, self._asked[i]):
                continue  # a sampler moves one part at a time
            self._asked[i] = own
            said = self.terms(phi, i) @ weights
            self._said[:, :, bodies] = said.reshape(*self.shape[:2], len(bodies), -1)
        return self._said

    def terms(self, phi: Array, part: int) -> Array:
        """What a part's residuals are linear in, for phi of shape (p,): the monomials (term,)."""
        places, _, centre, scale, _ = self.parts[part]
        return monomials((phi[places] - centre) / scale, self.degree)

    @property
    def basis(self) -> Array:
        """A single part's residuals for each term, shape (term, transition, H, body, state)."""
        weights = self.parts[0][-1]
        return np.asarray(weights.reshape(len(weights), *self.shape))


def monomials(z: Array, degree: int) -> Array:
    """The monomials of z, shape (..., p), up to a degree, shape (..., term)."""
    columns = [np.ones((*z.shape[:-1], 1)), z]
    for d in range(2, degree + 1):
        chosen = np.array(list(combinations_with_replacement(range(z.shape[-1]), d)), dtype=int)
        columns.append(z[..., chosen.reshape(-1, d)].prod(axis=-1))
    return np.concatenate(columns, axis=-1)
