"""Emulator of the engine about a mode: polynomials of the parameters, and their fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from scipy.linalg import lstsq

from pbrl_ppl.likelihood import Problem, TrajectoryLikelihood
from pbrl_ppl.modes import Space
from pbrl_ppl.parameters import inside
from pbrl_ppl.sampling.ensemble import Ensemble, Posterior, Reference
from pbrl_ppl.state import Bools, Floats, Ints

#: Factor of the emulator's log-likelihood: with lighter tails than the posterior's, weights have
#: heavy ones.
FLATTER = 0.9
#: Engine runs a coefficient of the emulator, at least; rounds of them.
_A_COEFFICIENT, _LEAST, _ROUNDS = 4, 160, 6
#: Largest number of coefficients of an emulator that is not linear.
_MOST = 250
#: Standard deviation of the log-likelihood's error at which a fit ends, and the largest of a usable
#: emulator.
_CLOSE, _ENOUGH = 0.7, 2.0
#: Points farther out count if their likelihood is above this quantile of the draws'.
_LIKELY = 0.05
#: Half of the runs are this many times as far from the mean as draws from the posterior.
_FARTHER = 1.4
#: Sweeps of the particles between two fits.
_SWEEPS = 3
#: The round from which the engine predicts transitions that no polynomial follows, what they leave
#: of the error's variance, and the share of such transitions above which an emulator saves little.
_KINKS, _LEFT, _BUSY = 3, 0.5, 0.7
#: Median of the absolute value of a standard normal variable.
_MEDIAN = 0.6745


@dataclass(frozen=True, eq=False)
class Piece:
    """Residuals of bodies in transitions, and the parameters that they depend on.

    Parameters
    ----------
    places : ndarray of int
        Places of the parameters in phi, shape (parameter,).
    bodies, rows : ndarray of int
        Bodies and transitions of the residuals, shapes (body,) and (transition,).
    """

    places: Ints
    bodies: Ints
    rows: Ints

    def of(self, residual: Floats) -> Floats:
        """Return these residuals of all, shape (run, transition, H, body, state)."""
        return residual[:, self.rows][:, :, :, self.bodies]


class Pieces(NamedTuple):
    """Residuals of a problem that are emulated, and those that the engine predicts.

    Together they hold every residual once.
    """

    emulated: list[Piece]
    exact: list[Piece]

    @classmethod
    def of(cls, problem: Problem, silent: Bools) -> Pieces:
        """Return a piece for each part of the scene, all emulated.

        A part of so many parameters that no square polynomial is affordable is one of its bodies,
        which move independently where they do not meet; of joined bodies it stays one.
        """
        labels, moving = problem.layout.labels, problem.scene.moving
        rows, none = np.arange(problem.segments.n), np.zeros(0, dtype=int)
        emulated, exact = [], []
        for part in problem.simulator.parts:
            loud = part.places[~silent[part.places]]
            exact.append(Piece(loud, part.bodies, none))
            if _terms(len(loud), 2) <= _MOST or part.physics.scene.joints:
                emulated.append(Piece(loud, part.bodies, rows))
                continue
            for body in part.bodies:
                kept = moving[body].name, moving[body].owner
                chosen = problem.layout.subset(kept).labels
                places = np.array([labels.index(label) for label in chosen], dtype=int)
                emulated.append(Piece(places[~silent[places]], np.array([body]), rows))
        pieces = cls(emulated, exact)
        if isinstance(problem.likelihood, TrajectoryLikelihood):  # no polynomial follows contacts
            touching = np.flatnonzero(problem.trajectory_noise.touching)
            return pieces.exactly([touching if len(own.bodies) > 1 else none for own in exact])
        return pieces

    def exactly(self, chosen: list[Ints]) -> Pieces:
        """Return pieces with these transitions of each part by the engine too."""
        exact = [
            replace(piece, rows=np.union1d(piece.rows, rows))
            for piece, rows in zip(self.exact, chosen, strict=True)
        ]
        emulated = []
        for piece in self.emulated:
            (own,) = (part for part in exact if np.isin(piece.bodies, part.bodies).all())
            emulated.append(replace(piece, rows=np.setdiff1d(piece.rows, own.rows)))
        return Pieces(emulated, exact)


class Emulator:
    """Residuals as polynomials of the parameters, fitted by least squares for each piece.

    Regression over draws as wide as the posterior averages over the kinks of friction, which a
    derivative at one point does not.

    Parameters
    ----------
    space : Space
        Of the problem, whose engine predicts what is not emulated.
    pieces : Pieces
        Which parameters change which residuals.
    phi : ndarray
        Parameters of the engine runs, shape (run, p).
    residual : ndarray
        Residuals of the runs, shape (run, transition, H, body, state).
    degree : int
        Degree of the polynomials.
    """

    def __init__(
        self, space: Space, pieces: Pieces, phi: Floats, residual: Floats, degree: int
    ) -> None:
        self.space, self.shape, self.degree = space, residual.shape[1:], degree
        self.fits: list[tuple[Piece, Floats, Floats, Floats]] = []
        for piece in pieces.emulated:
            x = phi[:, piece.places]
            centre, scale = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-300)
            terms = monomials((x - centre) / scale, degree)
            targets = piece.of(residual).reshape(len(phi), -1)
            weights = np.asarray(lstsq(terms, targets, lapack_driver="gelsy")[0], dtype=float)
            self.fits.append((piece, centre, scale, weights))
        self.exact: list[tuple[Piece, Callable[[Floats], Floats]]] = []
        self.run(pieces)

    def run(self, pieces: Pieces) -> None:
        """Take the exact pieces from the engine."""
        self.exact = [
            (piece, _engine(self.space.problem, piece.rows))
            for piece in pieces.exact
            if len(piece.rows)
        ]

    def __call__(self, phi: Floats) -> Floats:
        """Return residuals for phi of shape (point, p), shape (point, transition, ...)."""
        result = np.zeros((len(phi), *self.shape))
        points, steps = np.arange(len(phi)), np.arange(self.shape[1])
        for piece, centre, scale, weights in self.fits:
            where = np.ix_(points, piece.rows, steps, piece.bodies)
            terms = monomials((phi[:, piece.places] - centre) / scale, self.degree)
            shape = len(phi), len(piece.rows), len(steps), len(piece.bodies), self.shape[-1]
            result[where] = (terms @ weights).reshape(shape)
        for piece, engine in self.exact:
            # other parts, at equal parameters, are simulated once
            own = np.tile(self.space.centre, (len(phi), 1))
            own[:, piece.places] = phi[:, piece.places]
            where = np.ix_(points, piece.rows, steps, piece.bodies)
            result[where] = engine(own)[:, :, :, piece.bodies]
        return result

    def correct(self, phi: Floats, residual: Floats) -> None:
        """Make up for the error of few engine steps, as a linear function of phi.

        Parameters
        ----------
        phi : ndarray
            Shape (run, p).
        residual : ndarray
            What is to be added there, shape (run, transition, H, body, state).
        """
        for piece, centre, scale, weights in self.fits:
            terms = monomials((phi[:, piece.places] - centre) / scale, 1)
            targets = piece.of(residual).reshape(len(phi), -1)
            weights[: terms.shape[1]] += lstsq(terms, targets, lapack_driver="gelsy")[0]


def _engine(problem: Problem, rows: Ints) -> Callable[[Floats], Floats]:
    """Return residuals of some transitions by the engine, as a function of phi."""
    start, inputs = problem.segments.start[rows], problem.inputs[rows]
    observed = replace(problem.observations, values=problem.observations.values[rows])
    sensitivity = problem.likelihood.sensitivity
    followed = None if sensitivity is None else sensitivity.at(rows)
    defect = 0.0 if problem.defect is None else problem.defect[rows]

    def residual(phi: Floats) -> Floats:
        if followed is None:
            return observed.residual(problem.simulator(phi, start, inputs) + defect)
        predicted = followed.predicted(problem.simulator, phi, start, inputs)
        return observed.residual(predicted + defect)

    return residual


def monomials(z: Floats, degree: int) -> Floats:
    """Return the monomials of z, shape (..., p), up to a degree, shape (..., term)."""
    columns = [np.ones((*z.shape[:-1], 1)), z]
    for d in range(2, degree + 1):
        chosen = np.array(list(combinations_with_replacement(range(z.shape[-1]), d)), dtype=int)
        columns.append(z[..., chosen.reshape(-1, d)].prod(axis=-1))
    return np.concatenate(columns, axis=-1)


def emulate(
    space: Space, reference: Reference, rng: np.random.Generator
) -> tuple[Posterior, Reference] | str:
    """Fit an emulator to engine runs, drawn from the posterior of the emulator before it.

    Parameters
    ----------
    space : Space
        Of the problem; the runs are of few engine steps, corrected at the centre.
    reference : Reference
        The first runs are drawn from it.
    rng : Generator
        Source of randomness.

    Returns
    -------
    tuple or str
        The emulator's posterior, somewhat flatter than the problem's, with Gaussians of its
        particles; or why there is none.
    """
    problem = space.problem.corrected(space.centre)
    pieces = Pieces.of(problem, space.silent)
    widest = max((len(piece.places) for piece in pieces.emulated), default=0)
    degree = 2 if _terms(widest, 2) <= _MOST else 1
    half = max(_LEAST, _A_COEFFICIENT * _terms(widest, degree)) // 2
    alone = np.sqrt(len(space.parts))  # each part is accepted by itself
    particles = Ensemble(reference, reference.draw(half, rng), rng)
    runs: list[tuple[Floats, Floats]] = []
    emulator: Emulator | None = None
    off = np.inf
    steps = np.arange(problem.data.horizon)
    for turn in range(_ROUNDS + 1):
        phi = spread(problem, space.possible(particles.q))
        residual = problem.residual(phi)
        good = np.asarray(np.isfinite(residual).all(axis=(1, 2, 3, 4)))
        if good.sum() < 0.5 * len(phi):
            return "the engine diverges about the mode"
        if emulator is not None:  # judge the emulator of the round before, where its particles are
            sigma = np.tile(space.split(particles.q)[1], (2, 1))
            emulated = emulator(phi)
            for piece in pieces.exact:  # better than few engine steps
                own = np.ix_(np.arange(len(phi)), piece.rows, steps, piece.bodies)
                residual[own] = emulated[own]
            height, true = (
                problem.log_density(each, sigma, phi).sum(axis=-1) for each in (emulated, residual)
            )
            off = float(errors(height, true, half).std()) / alone
            if not off < _CLOSE and turn >= _KINKS:
                chosen = _unlike(pieces, emulated[good], residual[good])
                if sum(map(len, chosen)) > _BUSY * len(chosen) * problem.segments.n:
                    break
                pieces = pieces.exactly(chosen)
        runs.append((phi[good], residual[good]))
        phi, residual = (np.concatenate(each) for each in zip(*runs[-2:], strict=True))
        emulator = Emulator(space, pieces, phi, residual, degree)
        if off < _CLOSE:
            break
        particles.move(Posterior(space, emulator, FLATTER), _SWEEPS, noise=False)
        particles.q = space.prior_draws(particles.q, rng)
        particles.learn()
    if emulator is None or not off < _ENOUGH:
        return f"the emulator's log-likelihood is off by {off:.2g} nats"
    if problem is not space.problem:
        few = space.possible(particles.q[: _A_COEFFICIENT * (widest + 1)])
        true = space.problem.residual(few)
        emulator.correct(few, true - problem.residual(few))
        emulator.run(pieces.exactly(_unlike(pieces, emulator(few), true)))
    return Posterior(space, emulator, FLATTER), reference.learned(particles.q)


def _unlike(pieces: Pieces, emulated: Floats, residual: Floats) -> list[Ints]:
    """Return the transitions of each part that no polynomial follows: those of bodies that meet.

    The error of a log-likelihood has about the variance of the squared errors' sum in units of
    noise, which a few transitions make up; the others are close enough.
    """
    unit = np.sqrt(np.nanmedian(residual**2, axis=(0, 1, 2, 3))) / _MEDIAN
    square = (((emulated - residual) / np.maximum(unit, 1e-300)) ** 2).mean(axis=0)
    chosen = []
    for piece in pieces.exact:
        error = np.nan_to_num(square[:, :, piece.bodies]).sum(axis=(1, 2, 3))
        order = np.argsort(error)
        left = int(np.searchsorted(np.cumsum(error[order]), _LEFT * _CLOSE**2))
        chosen.append(order[left:])
    return chosen


def _terms(parameters: int, degree: int) -> int:
    """Return the number of terms of a polynomial."""
    return monomials(np.zeros(parameters), degree).size


def errors(approximate: Floats, exact: Floats, draws: int) -> Floats:
    """Return errors of log-likelihoods at an emulator's draws, and at likely points farther off.

    Draws of an emulator whose posterior is too narrow would confirm it.

    Parameters
    ----------
    approximate, exact : ndarray
        Of the emulator and of the engine, shape (n,); the draws come first.
    draws : int
        Number of draws.
    """
    far = exact >= np.nanquantile(exact[:draws], _LIKELY)
    far[:draws] = True
    return np.asarray((approximate - exact)[far])


def spread(problem: Problem, phi: Floats, farther: float = _FARTHER) -> Floats:
    """Return draws, and as many again farther from their middle, shape (2 n, p).

    Where friction makes a kink, the posterior may be wider beyond it than the first runs.
    """
    centre = phi.mean(axis=0)
    return np.concatenate([phi, inside(problem.layout.priors, centre + farther * (phi - centre))])
