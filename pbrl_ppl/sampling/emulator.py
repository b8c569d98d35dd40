"""Surrogate posterior to look ahead with: an emulator of the engine about a mode, and its fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
import pymc as pm
from pymc.pytensorf import compile as compile_function
from pymc.pytensorf import join_nonshared_inputs

from pbrl_ppl.likelihood import Problem, TrajectoryLikelihood
from pbrl_ppl.modes import Mode
from pbrl_ppl.parameters import inside
from pbrl_ppl.sampling.metropolis import Gaussian, explore
from pbrl_ppl.sampling.starts import blank_point, evened_logp
from pbrl_ppl.state import Floats, Ints

#: Factor of the surrogate's log-likelihood: with lighter tails than the posterior's, chains stick.
FLATTER = 0.9
#: Degrees to try; engine runs a coefficient, at least and at most; rounds of each.
_DEGREES, _A_COEFFICIENT, _LEAST, _MOST, _ROUNDS = (1, 2), 4, 100, 400, 4
#: Standard deviation of the log-likelihood's error at which a fit ends (half of the moves are then
#: accepted), and the largest of a usable emulator (a fifth of them are).
_CLOSE, _ENOUGH = 1.0, 2.0
#: Points farther out count if their likelihood is above this quantile of the draws'.
_LIKELY = 0.05
#: Half of the runs are this many times as far from the mean as draws from the posterior.
_FARTHER = 2.0
#: Steps of the exploring chain between two runs.
_APART = 20


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

    def without(self, places: Ints) -> Pieces:
        """Return pieces that do not depend on some parameters."""
        kept = [
            replace(piece, places=np.setdiff1d(piece.places, places)) for piece in self.emulated
        ]
        return replace(self, emulated=kept)

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

    def batch(self, phi: Floats) -> Floats:
        """Return residuals for phi of shape (point, p), shape (point, transition, ...)."""
        result = np.zeros((len(phi), *self.shape))
        for i, piece in enumerate(self.pieces.emulated):
            bodies = self._residual[self._fits[i].where].shape
            values = (self.terms(phi, i) @ self._fits[i].weights).reshape(len(phi), *bodies)
            result[
                np.ix_(np.arange(len(phi)), piece.rows, np.arange(self.shape[1]), piece.bodies)
            ] = values
        if len(self.pieces.rows):
            result[:, self.pieces.rows] = self.pieces.exact(phi)
        return result

    def correct(self, phi: Floats, residual: Floats) -> None:
        """Add residuals (run, transition, H, body, state), as linear functions of phi (run, p)."""
        self._last.clear()
        for i, piece in enumerate(self.pieces.emulated):
            terms = self.terms(phi, i)[:, : 1 + len(piece.places)]
            targets = residual[:, piece.rows][:, :, :, piece.bodies].reshape(len(phi), -1)
            change = np.linalg.lstsq(terms, targets, rcond=None)[0]
            self._fits[i].weights[: len(change)] += change

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
        """Return the monomials of a piece, shape (..., term), for phi of shape (..., p)."""
        fit, x = self._fits[piece], phi[..., self.pieces.emulated[piece].places]
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


class Unpack:
    """Map from the sampler's vector to phi, sigma and the log-density of their priors.

    A wheel's equal descriptions share their prior evenly; see `evened_logp`.

    Parameters
    ----------
    model : pymc.Model
        As made by :func:`pbrl_ppl.physics_model`.
    problem : Problem
        The problem that it was made from.
    """

    def __init__(self, model: pm.Model, problem: Problem) -> None:
        variables = [model[block.name] for block in problem.layout.blocks]
        self._parameters = len(problem.layout.blocks)
        noise = [model[name] for name in problem.noise_variables]
        outputs = model.replace_rvs_by_values([*variables, *noise])
        values = model.continuous_value_vars
        point = blank_point(model, problem)
        joined_outputs, joined = join_nonshared_inputs(
            point=point,
            outputs=[model.varlogp + evened_logp(model, problem), *outputs],
            inputs=values,
            shared_inputs={},
        )
        self._function = compile_function([joined], joined_outputs)
        self._function.trust_input = True
        self._states = len(problem.noise_prior[0])

    def __call__(self, q: Floats) -> tuple[Floats, Floats, float]:
        """Return parameters (p,), noise (state,) and the log-density of prior and transforms."""
        prior, *values = self._function(q)
        phi, noise = values[: self._parameters], values[self._parameters :]
        sigma = np.concatenate([np.atleast_1d(values) for values in noise])
        return (
            np.concatenate([np.zeros(0), *phi]),
            np.broadcast_to(sigma, (self._states,)),
            float(prior),
        )


class Surrogate:
    """Log-posterior with residuals that cost less than the engine's.

    Parameters
    ----------
    problem : Problem
        The exact problem.
    unpack : Unpack
        Map of the problem's model.
    emulator : Emulator or FewSteps
        From phi, shape (p,), to residuals as of :meth:`Problem.residual`.
    """

    def __init__(self, problem: Problem, unpack: Unpack, emulator: Emulator | FewSteps) -> None:
        self.problem, self.unpack, self.emulator = problem, unpack, emulator
        # white residuals are then linear in the polynomials' terms, given the noise
        gaussian = problem.likelihood.nu is None and not problem.tails
        self._polynomials: Emulator | None = None
        if gaussian and isinstance(emulator, Emulator) and emulator.linear:
            self._polynomials = emulator
        self._noise, self._form, self._first = b"", np.zeros((0, 0)), (np.zeros(0), 0.0)

    def __call__(self, q: Floats) -> float:
        """Return the log-density at the sampler's vector."""
        phi, sigma, prior = self.unpack(q)
        if not np.isfinite(prior):
            return -np.inf
        return prior + FLATTER * self._likelihood(phi, sigma)

    def _likelihood(self, phi: Floats, sigma: Floats) -> float:
        """Return the log-likelihood; a quadratic form where the noise is that of the last call."""
        noise = sigma.tobytes()
        polynomials = self._polynomials
        if polynomials is not None and noise == self._noise:
            phi_before, before = self._first
            if not self._form.size:
                basis = polynomials.basis
                likelihood = self.problem.likelihood
                white = likelihood.whiten(basis, sigma)
                # for trajectories each includes the measurements
                white[1:] -= likelihood.whiten(0.0 * basis[0], sigma)
                flat = white.reshape(len(white), -1)
                self._form = flat @ flat.T
            new, old = (polynomials.terms(x, 0) for x in (phi, phi_before))
            return float(before - 0.5 * (new @ self._form @ new - old @ self._form @ old))
        density = self.problem.log_density(self.emulator(phi), sigma, phi)
        value = float(density.sum())
        self._noise, self._form, self._first = noise, np.zeros((0, 0)), (phi, value)
        return value


class FewSteps:
    """Residuals by the engine with few steps, corrected at a mode: where no polynomial is close.

    Parameters
    ----------
    mode : Mode
        Where the error of few steps is corrected.
    """

    def __init__(self, mode: Mode) -> None:
        self._problem = mode.problem.corrected(mode.phi)

    def __call__(self, phi: Floats) -> Floats:
        """Return residuals for phi of shape (p,)."""
        return self._problem.residual(phi)


def emulate(
    mode: Mode, unpack: Unpack, blocks: list[Gaussian], seed: int | np.random.Generator
) -> Emulator | None:
    """Fit an emulator to engine runs, drawn from the posterior of the emulator before it.

    Parameters
    ----------
    mode : Mode
        The first runs are drawn from its Laplace approximation.
    unpack : Unpack
        Map of the problem's model.
    blocks : list of Gaussian
        Together they hold every entry of the sampler's vector; they learn the posterior's shape.
    seed : int or Generator
        Source of the draws.

    Returns
    -------
    Emulator or None
        None where the polynomials' log-likelihood stays far from the engine's.
    """
    rng = np.random.default_rng(seed)
    threads = max(mode.problem.physics.threads, 2)
    problem = mode.problem.with_physics(threads=threads).corrected(mode.phi)
    q = np.empty(sum(len(block.places) for block in blocks))
    for block in blocks:
        q[block.places] = block.mean
    pieces = Pieces.of(problem)
    widest = max((len(piece.places) for piece in pieces.emulated), default=0)
    alone = np.sqrt(len(problem.simulator.parts))  # each part is judged alone
    best: tuple[float, Emulator | None] = _ENOUGH * alone, None
    for degree in _DEGREES:
        runs = max(_LEAST, _A_COEFFICIENT * monomials(np.zeros(widest), degree).size)
        if runs > _MOST:
            break
        phi = spread(problem, mode.draws(rng, runs // 2))
        residual = problem.residual(phi)
        good = np.isfinite(residual).all(axis=(1, 2, 3, 4))
        for _ in range(_ROUNDS):
            if good.sum() < 0.5 * runs:
                break
            emulator = Emulator(pieces, phi[good], residual[good], degree)
            cheap = Surrogate(problem, unpack, emulator)
            chain = explore(blocks, cheap, q, _APART * (runs // 2), rng)[_APART - 1 :: _APART]
            drawn, sigma = (np.array(x) for x in zip(*(unpack(y)[:2] for y in chain), strict=True))
            phi = spread(problem, drawn)
            residual = problem.residual(phi)
            emulated = np.array([emulator(point).copy() for point in phi])
            sigma = np.concatenate([sigma, sigma])
            exact = problem.log_density(residual, sigma, phi).sum(axis=-1)
            approximate = problem.log_density(emulated, sigma, phi).sum(axis=-1)
            off = errors(approximate, exact, len(drawn))
            good = np.isfinite(residual).all(axis=(1, 2, 3, 4))
            if np.isfinite(off).all() and off.std() < best[0]:
                best = off.std(), Emulator(pieces, phi[good], residual[good], degree)
            if best[0] < _CLOSE * alone:
                return best[1]
    return best[1]


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
