"""Emulator of the engine about a mode: residuals as polynomials of the parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np

from pbrl_ppl.likelihood import Problem, TrajectoryLikelihood
from pbrl_ppl.state import Floats, Ints


@dataclass(frozen=True, eq=False)
class Piece:
    """Residuals that depend on the same parameters, and are polynomials of them.

    Parameters
    ----------
    places : ndarray
        Places of the parameters in phi, shape (parameter,).
    bodies, rows : ndarray
        Bodies and transitions of the residuals, shapes (body,) and (transition,).
    """

    places: Ints
    bodies: Ints
    rows: Ints


@dataclass(frozen=True, eq=False)
class Pieces:
    """Residuals of a problem that are emulated, and those that the engine predicts.

    Bodies that meet are one part of many parameters. Where nothing touches, they move
    independently; transitions in which bodies meet have kinks that no polynomial follows.

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
    rows: Ints
    exact: Callable[[Floats], Floats]

    @classmethod
    def of(cls, problem: Problem) -> Pieces:
        """Return a piece for each part of the scene; one for each body of a part without joints."""
        labels = problem.layout.labels
        moving = problem.scene.moving
        met = np.zeros(problem.segments.n, dtype=bool)
        found: list[tuple[Ints, Ints]] = []
        whole = isinstance(problem.likelihood, TrajectoryLikelihood)
        for part in problem.simulator.parts:
            if not whole or len(part.bodies) == 1 or part.physics.scene.joints:
                found.append((part.places, part.bodies))
                continue
            met = problem.trajectory_noise.touching
            for body in part.bodies:
                kept = moving[body].name, moving[body].owner
                chosen = problem.layout.subset(kept).labels
                places = np.array([labels.index(label) for label in chosen], dtype=int)
                found.append((places, np.array([body])))
        apart, rows = np.flatnonzero(~met), np.flatnonzero(met)
        pieces = [Piece(places, bodies, apart) for places, bodies in found] if len(apart) else []
        return cls(pieces, rows, _engine(problem, rows))


def _engine(problem: Problem, rows: Ints) -> Callable[[Floats], Floats]:
    """Return residuals of some transitions by the engine, as a function of phi."""
    start, inputs = problem.segments.start[rows], problem.inputs[rows]
    observed = replace(problem.observations, values=problem.observations.values[rows])
    sensitivity = problem.likelihood.sensitivity
    followed = None if sensitivity is None else sensitivity.at(rows)

    def residual(phi: Floats) -> Floats:
        if followed is None:
            return observed.residual(problem.simulator(phi, start, inputs))
        return observed.residual(followed.predicted(problem.simulator, phi, start, inputs))

    return residual


class _Fit(NamedTuple):
    """Polynomials of a piece: their residuals, the scaling of the parameters, and the weights."""

    where: tuple[Any, ...]
    centre: Floats
    scale: Floats
    weights: Floats


class Emulator:
    """Residuals as polynomials of the parameters, fitted by least squares for each piece.

    Regression over draws as wide as the posterior averages over the kinks of friction, which a
    derivative at one point does not.

    Parameters
    ----------
    pieces : Pieces
        Which parameters change which residuals.
    phi : ndarray
        Parameters of the engine runs, shape (run, p).
    residual : ndarray
        Residuals of the runs, shape (run, transition, H, body, state).
    degree : int
        Degree of the polynomials.
    """

    def __init__(self, pieces: Pieces, phi: Floats, residual: Floats, degree: int) -> None:
        self.shape, self.degree, self.pieces = residual.shape[1:], degree, pieces
        self._fits: list[_Fit] = []
        self._last: dict[int, Floats] = {}
        self._residual = np.zeros(self.shape)
        for piece in pieces.emulated:
            x = phi[:, piece.places]
            centre, scale = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-300)
            terms = monomials((x - centre) / scale, degree)
            where = np.ix_(piece.rows, np.arange(self.shape[1]), piece.bodies)
            targets = residual[:, piece.rows][:, :, :, piece.bodies].reshape(len(phi), -1)
            weights = np.asarray(np.linalg.lstsq(terms, targets, rcond=None)[0], dtype=float)
            self._fits.append(_Fit(where, centre, scale, weights))

    def __call__(self, phi: Floats) -> Floats:
        """Return residuals for phi of shape (p,); the next call changes the array."""
        for i, piece in enumerate(self.pieces.emulated):
            x, fit = phi[piece.places], self._fits[i]
            if i in self._last and np.array_equal(x, self._last[i]):
                continue  # a sampler moves one part at a time
            self._last[i] = x
            shape = self._residual[fit.where].shape
            self._residual[fit.where] = (self.terms(phi, i) @ fit.weights).reshape(shape)
        if len(self.pieces.rows):
            self._residual[self.pieces.rows] = self.pieces.exact(phi)
        return self._residual

    @property
    def linear(self) -> bool:
        """Whether all residuals are linear in the terms of one piece."""
        return len(self.pieces.emulated) == 1 and not len(self.pieces.rows)

    def terms(self, phi: Floats, piece: int) -> Floats:
        """Return the monomials of a piece, shape (term,), for phi of shape (p,)."""
        fit, x = self._fits[piece], phi[self.pieces.emulated[piece].places]
        return monomials((x - fit.centre) / fit.scale, self.degree)

    @property
    def basis(self) -> Floats:
        """Residuals of a single piece for each term, shape (term, transition, H, body, state)."""
        weights = self._fits[0].weights
        return np.asarray(weights.reshape(len(weights), *self.shape))


def monomials(z: Floats, degree: int) -> Floats:
    """Return the monomials of z, shape (..., p), up to a degree, shape (..., term)."""
    columns = [np.ones((*z.shape[:-1], 1)), z]
    for d in range(2, degree + 1):
        chosen = np.array(list(combinations_with_replacement(range(z.shape[-1]), d)), dtype=int)
        columns.append(z[..., chosen.reshape(-1, d)].prod(axis=-1))
    return np.concatenate(columns, axis=-1)
