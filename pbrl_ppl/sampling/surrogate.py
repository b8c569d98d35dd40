"""Surrogate of the posterior, for a sampler to look ahead with, and the fit of its emulator."""

from __future__ import annotations

import numpy as np
import pymc as pm
from pymc.pytensorf import compile as compile_function
from pymc.pytensorf import join_nonshared_inputs

from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import Mode
from pbrl_ppl.parameters import inside
from pbrl_ppl.sampling.emulator import Emulator, Pieces, monomials
from pbrl_ppl.sampling.metropolis import Gaussian, explore
from pbrl_ppl.sampling.starts import blank_point, evened_logp
from pbrl_ppl.state import Floats

#: Factor of the surrogate's log-likelihood: a chain would stick if its tails were too light.
_FLATTER = 0.9
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
    emulator : Emulator
        From phi, shape (p,), to residuals as of :meth:`Problem.residual`.
    """

    def __init__(self, problem: Problem, unpack: Unpack, emulator: Emulator) -> None:
        self.problem, self.unpack, self.emulator = problem, unpack, emulator
        # white residuals are then linear in the polynomials' terms, given the noise
        gaussian = problem.likelihood.nu is None and not problem.tails
        self._linear = gaussian and emulator.linear
        self._noise, self._form, self._first = b"", np.zeros((0, 0)), (np.zeros(0), 0.0)

    def __call__(self, q: Floats) -> float:
        """Return the log-density at the sampler's vector."""
        phi, sigma, prior = self.unpack(q)
        if not np.isfinite(prior):
            return -np.inf
        return prior + _FLATTER * self._likelihood(phi, sigma)

    def _likelihood(self, phi: Floats, sigma: Floats) -> float:
        """Return the log-likelihood; a quadratic form where the noise is that of the last call."""
        noise = sigma.tobytes()
        if self._linear and noise == self._noise:
            phi_before, before = self._first
            if not self._form.size:
                basis = self.emulator.basis
                likelihood = self.problem.likelihood
                white = likelihood.whiten(basis, sigma)
                # along trajectories what was measured is in each of them
                white[1:] -= likelihood.whiten(0.0 * basis[0], sigma)
                flat = white.reshape(len(white), -1)
                self._form = flat @ flat.T
            new, old = (self.emulator.terms(x, 0) for x in (phi, phi_before))
            return float(before - 0.5 * (new @ self._form @ new - old @ self._form @ old))
        density = self.problem.log_density(self.emulator(phi), sigma, phi)
        value = float(density.sum())
        self._noise, self._form, self._first = noise, np.zeros((0, 0)), (phi, value)
        return value


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


def spread(problem: Problem, phi: Floats) -> Floats:
    """Return draws, and as many again farther from their middle, shape (2 n, p).

    Where friction makes a kink, the posterior may be wider beyond it than the first runs.
    """
    centre = phi.mean(axis=0)
    return np.concatenate([phi, inside(problem.layout.priors, centre + _FARTHER * (phi - centre))])
