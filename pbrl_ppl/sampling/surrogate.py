"""Surrogate of the posterior, for a sampler to look ahead with."""

from __future__ import annotations

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.pytensorf import compile as compile_function
from pymc.pytensorf import join_nonshared_inputs

from pbrl_ppl.likelihood import Problem
from pbrl_ppl.sampling.emulator import Emulator
from pbrl_ppl.sampling.equal_wheels import evened_logp
from pbrl_ppl.sampling.starts import blank_point

Array = NDArray[np.float64]

#: Where the exact posterior's tails are the heavier, a chain would stick: this covers them.
_FLATTER = 0.9


class Unpack:
    """From the sampler's vector to phi, sigma and the log-density of their priors.

    A wheel's equal descriptions share their prior evenly; see `equal_wheels`.

    Parameters
    ----------
    model : pymc.Model
        As made by :func:`pbrl_ppl.physics_model`.
    problem : Problem
        What it was made from.
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

    def __call__(self, q: Array) -> tuple[Array, Array, float]:
        """Parameters (p,), noise (state,) and the prior's log-density with the transforms'."""
        prior, *values = self._function(q)
        phi, noise = values[: self._parameters], values[self._parameters :]
        sigma = np.concatenate([np.atleast_1d(own) for own in noise])
        return (
            np.concatenate([np.zeros(0), *phi]),
            np.broadcast_to(sigma, (self._states,)),
            float(prior),
        )


class Surrogate:
    """The log-posterior with residuals that cost less than the engine's.

    Parameters
    ----------
    problem : Problem
        The exact problem.
    unpack : Unpack
        Of the problem's model.
    emulator : Emulator
        From phi, shape (p,), to residuals as of :meth:`Problem.residual`.
    """

    def __init__(self, problem: Problem, unpack: Unpack, emulator: Emulator) -> None:
        self.problem, self.unpack, self.emulator = problem, unpack, emulator
        # white residuals are then linear in the polynomials' terms, given the noise
        gaussian = problem.likelihood.nu is None and not problem.tails
        self._linear = gaussian and emulator.linear
        self._noise, self._form, self._first = b"", np.zeros((0, 0)), (np.zeros(0), 0.0)

    def __call__(self, q: Array) -> float:
        """Log-density at the sampler's vector."""
        phi, sigma, prior = self.unpack(q)
        if not np.isfinite(prior):
            return -np.inf
        return prior + _FLATTER * self._likelihood(phi, sigma)

    def _likelihood(self, phi: Array, sigma: Array) -> float:
        """Log-likelihood; a quadratic form where the noise is that of the call before."""
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
            told, told_before = (self.emulator.terms(x, 0) for x in (phi, phi_before))
            return float(
                before - 0.5 * (told @ self._form @ told - told_before @ self._form @ told_before)
            )
        density = self.problem.log_density(self.emulator(phi), sigma, phi)
        value = float(density.sum())
        self._noise, self._form, self._first = noise, np.zeros((0, 0)), (phi, value)
        return value
