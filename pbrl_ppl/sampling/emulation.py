"""Emulators fitted to engine runs that are drawn from the posterior."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import Mode
from pbrl_ppl.parameters import inside
from pbrl_ppl.sampling.emulator import Emulator, Pieces, monomials
from pbrl_ppl.sampling.metropolis import Gaussian, explore
from pbrl_ppl.sampling.surrogate import Surrogate, Unpack

Array = NDArray[np.float64]

#: Degrees to try; engine runs a coefficient, at least and at most; rounds of each.
_DEGREES, _A_COEFFICIENT, _LEAST, _MOST, _ROUNDS = (1, 2), 4, 100, 400, 4
#: How far off (standard deviation) the log-likelihood may be: half of the moves still pass. Where
#: no round comes so close, the best will do if it is so far off: a fifth of them pass, of those
#: that would cost an engine run each.
_CLOSE, _ENOUGH = 1.0, 2.0
#: Points farther off count if their likelihood is above this quantile of the draws'.
_LIKELY = 0.05
#: Half of the runs are so many times as far from the middle as draws from the posterior.
_FARTHER = 2.0
#: Steps of the exploring chain between two runs.
_APART = 20


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
    rng = np.random.default_rng(seed)
    problem = mode.problem.with_physics(threads=max(mode.problem.physics.threads, 2))
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
            told = problem.log_density(emulated, sigma, phi).sum(axis=-1)
            off = errors(told, exact, len(drawn))
            good = np.isfinite(residual).all(axis=(1, 2, 3, 4))
            if np.isfinite(off).all() and off.std() < best[0]:
                best = off.std(), Emulator(pieces, phi[good], residual[good], degree)
            if best[0] < _CLOSE * alone:
                return best[1]
    return best[1]


def errors(told: Array, exact: Array, draws: int) -> Array:
    """Errors of log-likelihoods at an emulator's draws, and farther off where it is as likely.

    There the posterior is wider than the emulator's, whose draws alone would confirm it.

    Parameters
    ----------
    told, exact : ndarray
        Of the emulator and of the engine, shape (n,); the draws come first.
    draws : int
        How many those are.
    """
    far = exact >= np.nanquantile(exact[:draws], _LIKELY)
    far[:draws] = True
    return np.asarray((told - exact)[far])


def spread(problem: Problem, phi: Array) -> Array:
    """Draws, and as many again farther from their middle, shape (2 n, p).

    Where friction makes a kink, the posterior may go on beyond it where the first runs did not.
    """
    centre = phi.mean(axis=0)
    return np.concatenate([phi, inside(problem.layout.priors, centre + _FARTHER * (phi - centre))])
