"""Emulator of the engine about a mode, by polynomials of the parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.likelihood import Problem, TrajectoryLikelihood

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Piece:
    """Residuals that hang on the same parameters, and are polynomials of them.

    Parameters
    ----------
    places : ndarray
        Where phi holds those, shape (parameter,).
    bodies, rows : ndarray
        Bodies and transitions of the residuals, shapes (body,) and (transition,).
    """

    places: NDArray[np.intp]
    bodies: NDArray[np.intp]
    rows: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Pieces:
    """What is emulated of a problem, and what is left to the engine.

    Bodies that meet are one part of many parameters. Where nothing touches, each moves by its own;
    the few steps in which bodies meet have kinks that no polynomial follows.

    Parameters
    ----------
    emulated : list of Piece
        Together with ``rows`` they hold every residual once.
    rows : ndarray
        Transitions that the engine predicts, shape (row,).
    exact : callable
        Their residuals, shape (row, H, body, state), for phi of shape (p,).
    """

    emulated: list[Piece]
    rows: NDArray[np.intp]
    exact: Callable[[Array], Array]

    @classmethod
    def of(cls, problem: Problem) -> Pieces:
        """A piece for each part of the scene; one for each body that joints leave alone."""
        labels = problem.layout.labels
        moving = problem.scene.moving
        met = np.zeros(problem.segments.n, dtype=bool)
        own: list[tuple[NDArray[np.intp], NDArray[np.intp]]] = []
        whole = isinstance(problem.likelihood, TrajectoryLikelihood)
        for part in problem.simulator.parts:
            if not whole or len(part.bodies) == 1 or part.physics.scene.joints:
                own.append((part.places, part.bodies))
                continue
            met = problem.trajectory_noise.touching
            for body in part.bodies:
                kept = moving[body].name, moving[body].owner
                chosen = problem.layout.subset(kept).labels
                places = np.array([labels.index(label) for label in chosen], dtype=int)
                own.append((places, np.array([body])))
        apart, rows = np.flatnonzero(~met), np.flatnonzero(met)
        pieces = [Piece(*of, apart) for of in own] if len(apart) else []
        return cls(pieces, rows, _engine(problem, rows))


def _engine(problem: Problem, rows: NDArray[np.intp]) -> Callable[[Array], Array]:
    """Residuals of some transitions by the engine, as a function of phi."""
    start, inputs = problem.segments.start[rows], problem.inputs[rows]
    observed = replace(problem.observations, values=problem.observations.values[rows])
    sensitivity = problem.likelihood.sensitivity
    followed = None if sensitivity is None else sensitivity.at(rows)

    def residual(phi: Array) -> Array:
        if followed is None:
            return observed.residual(problem.simulator(phi, start, inputs))
        return observed.residual(followed.predicted(problem.simulator, phi, start, inputs))

    return residual


class Emulator:
    """Residuals as polynomials of the parameters, by least squares, each piece's of its own.

    Regression over draws as wide as the posterior averages over the kinks of friction, which a
    derivative at one point does not.

    Parameters
    ----------
    pieces : Pieces
        Say which parameters move which residuals.
    phi : ndarray
        Where the engine was run, shape (run, p).
    residual : ndarray
        What it gave, shape (run, transition, H, body, state).
    degree : int
        Of the polynomials.
    """

    def __init__(self, pieces: Pieces, phi: Array, residual: Array, degree: int) -> None:
        self.shape, self.degree, self.pieces = residual.shape[1:], degree, pieces
        self._fits: list[tuple[Any, ...]] = []
        self._asked: dict[int, Array] = {}
        self._said = np.zeros(self.shape)
        for piece in pieces.emulated:
            own = phi[:, piece.places]
            centre, scale = own.mean(axis=0), np.maximum(own.std(axis=0), 1e-300)
            terms = monomials((own - centre) / scale, degree)
            where = np.ix_(piece.rows, np.arange(self.shape[1]), piece.bodies)
            targets = residual[:, piece.rows][:, :, :, piece.bodies].reshape(len(phi), -1)
            weights = np.linalg.lstsq(terms, targets, rcond=None)[0]
            self._fits.append((where, centre, scale, weights))

    def __call__(self, phi: Array) -> Array:
        """Residuals for phi of shape (p,); the array changes with the next call."""
        for i, piece in enumerate(self.pieces.emulated):
            own = phi[piece.places]
            if i in self._asked and np.array_equal(own, self._asked[i]):
                continue  # a sampler moves one part at a time
            self._asked[i] = own
            where, *_, weights = self._fits[i]
            said = self._said[where]
            self._said[where] = (self.terms(phi, i) @ weights).reshape(said.shape)
        if len(self.pieces.rows):
            self._said[self.pieces.rows] = self.pieces.exact(phi)
        return self._said

    @property
    def linear(self) -> bool:
        """Whether all residuals are linear in the terms of one piece."""
        return len(self.pieces.emulated) == 1 and not len(self.pieces.rows)

    def terms(self, phi: Array, piece: int) -> Array:
        """What a piece's residuals are linear in, for phi of shape (p,): the monomials (term,)."""
        _, centre, scale, _ = self._fits[piece]
        own = phi[self.pieces.emulated[piece].places]
        return monomials((own - centre) / scale, self.degree)

    @property
    def basis(self) -> Array:
        """A single piece's residuals for each term, shape (term, transition, H, body, state)."""
        weights = self._fits[0][-1]
        return np.asarray(weights.reshape(len(weights), *self.shape))


def monomials(z: Array, degree: int) -> Array:
    """The monomials of z, shape (..., p), up to a degree, shape (..., term)."""
    columns = [np.ones((*z.shape[:-1], 1)), z]
    for d in range(2, degree + 1):
        chosen = np.array(list(combinations_with_replacement(range(z.shape[-1]), d)), dtype=int)
        columns.append(z[..., chosen.reshape(-1, d)].prod(axis=-1))
    return np.concatenate(columns, axis=-1)
