"""A cheap posterior for a sampler to look ahead with: few engine steps, corrected at the mode."""

from __future__ import annotations

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.pytensorf import compile as compile_function
from pymc.pytensorf import join_nonshared_inputs

from pbrl_ppl.errors import ParameterError
from pbrl_ppl.model import Problem
from pbrl_ppl.modes import Mode

Array = NDArray[np.float64]

#: Numbers of engine steps an interval to try, and how far (standard deviation) the log-likelihood
#: may then be off among draws of the Laplace approximation: 1 still lets half of the moves pass.
_SUBSTEPS, _CLOSE, _DRAWS = (4, 8), 1.0, 32


class Unpack:
    """From the sampler's vector to phi, sigma and the log-density of their priors.

    Parameters
    ----------
    model : pymc.Model
        As made by :func:`pbrl_ppl.physics_model`.
    problem : Problem
        What it was made from.
    """

    def __init__(self, model: pm.Model, problem: Problem) -> None:
        variables = [model[block.name] for block in problem.layout.blocks]
        outputs = model.replace_rvs_by_values([*variables, model["sigma"]])
        values = model.continuous_value_vars
        point = model.initial_point()
        joined_outputs, joined = join_nonshared_inputs(
            point=point, outputs=[model.varlogp, *outputs], inputs=values, shared_inputs={}
        )
        self._function = compile_function([joined], joined_outputs)
        self._function.trust_input = True
        self._states = len(problem.observations.columns)

    def __call__(self, q: Array) -> tuple[Array, Array, float]:
        """Parameters (p,), noise (state,) and the prior's log-density with the transforms'."""
        prior, *phi, sigma = self._function(q)
        return (
            np.concatenate([np.zeros(0), *phi]),
            np.broadcast_to(sigma, (self._states,)),
            float(prior),
        )


class Surrogate:
    """The log-posterior with a coarser engine whose error at the mode is taken off everywhere.

    Parameters
    ----------
    problem : Problem
        The exact problem.
    phi : ndarray
        The mode, shape (p,).
    unpack : Unpack
        Of the problem's model.
    substeps : int
        Engine steps an interval.
    """

    def __init__(self, problem: Problem, phi: Array, unpack: Unpack, substeps: int) -> None:
        self.problem, self.unpack = problem, unpack
        self.engine = problem.engine(substeps, threads=1, extrapolate=False)
        self.correction = problem.predict(phi) - self._coarse(phi)

    def _coarse(self, phi: Array) -> Array:
        segments = self.problem.segments
        if phi.ndim == 1:
            return self.engine.recall(phi, segments.start, segments.actions)
        return self.engine(phi, segments.start, segments.actions)

    def log_likelihood(self, phi: Array, sigma: Array) -> Array:
        """Sum over transitions, shape (...), for phi (..., p) and sigma (state,)."""
        problem = self.problem
        residual = problem.observations.residual(self._coarse(phi) + self.correction)
        return np.asarray(problem.log_density(residual, sigma).sum(axis=-1))

    def __call__(self, q: Array) -> float:
        """Log-density at the sampler's vector."""
        phi, sigma, prior = self.unpack(q)
        if not np.isfinite(prior):
            return -np.inf
        try:
            return prior + float(self.log_likelihood(phi, sigma))
        except ParameterError:  # impossible, such as a mass that underflows
            return -np.inf


def surrogate(model: pm.Model, mode: Mode, seed: int) -> Surrogate | None:
    """Find the cheapest surrogate that follows the posterior about its mode.

    Parameters
    ----------
    model : pymc.Model
        Of the mode's problem.
    mode : Mode
        Where it is to be right.
    seed : int
        Of the draws that it is tried on.

    Returns
    -------
    Surrogate or None
        None where there is none that is close enough and much cheaper, as with hard contacts.
    """
    problem = mode.problem
    if not len(mode.phi) or problem.layout.discrete.any():
        return None
    draws = mode.draws(np.random.default_rng(seed), _DRAWS)
    exact = problem.log_density(problem.residual(draws), mode.sigma).sum(axis=-1)
    unpack = Unpack(model, problem)
    for substeps in _SUBSTEPS:
        if 2 * substeps > problem.substeps:
            break
        rough = Surrogate(problem, mode.phi, unpack, substeps)
        off = rough.log_likelihood(draws, mode.sigma) - exact
        if np.isfinite(off).all() and off.std() < _CLOSE:
            return rough
    return None
