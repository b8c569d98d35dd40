"""Eq. 11 as pytensor expressions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytensor.tensor as pt

from pbrl_ppl.effects import Attached
from pbrl_ppl.likelihood import GAUSSIAN, Observations, log_norm, sum_tails
from pbrl_ppl.physics import Physics
from pbrl_ppl.state import THETA


def difference(value: Any, predicted: Any, observations: Observations) -> Any:
    """Return the difference of states as a pytensor expression, angles wrapped.

    Parameters
    ----------
    value, predicted : tensor
        Shape (transition, H, body, state).
    observations : Observations
        Names the states.
    """
    residual = value - predicted  # s' - f(s, a; Phi)
    if THETA in observations.columns:
        theta = observations.columns.index(THETA)
        wrapped = np.pi - pt.mod(np.pi - residual[..., theta], 2 * np.pi)
        residual = pt.set_subtensor(residual[..., theta], wrapped)
    return residual


def next_state_logp(
    value: Any,
    predicted: Any,
    sigma: Any,
    observations: Observations,
    nu: float | None = None,
    tail: Any = None,
) -> Any:
    """Return Eq. 11 as a pytensor expression, one log-density a transition.

    Parameters
    ----------
    value, predicted : tensor
        Measured and predicted next states, shape (transition, H, body, state).
    sigma : tensor
        Noise of each state dimension, shape (state,).
    observations : Observations
        Masks missing measurements.
    nu : float, optional
        Degrees of freedom of a Student-t distribution; without it, Gaussian.
    tail : tensor, optional
        The reciprocal for each body, shape (body,), in place of ``nu``.
    """
    measured = observations.measured
    n = len(measured)
    residual = difference(value, predicted, observations)
    z = (residual / sigma * measured).reshape((n, -1))
    log_sigma = (pt.log(sigma) * measured).sum(axis=(1, 2, 3))
    count = measured.sum(axis=(1, 2, 3))
    if tail is None:
        square = z**2 if nu is None else (nu + 1) * pt.log1p(z**2 / nu)
        norm = count * log_norm(nu)
    else:
        tails = (tail[None, :, None] * np.ones(measured.shape[1:])).reshape((1, -1))
        heavy = pt.gt(tails, 1.0 / GAUSSIAN)
        nus = 1.0 / pt.switch(heavy, tails, 1.0)
        square = pt.switch(heavy, (nus + 1) * pt.log1p(z**2 / nus), z**2)
        at_zero = pt.gammaln((nus + 1) / 2) - pt.gammaln(nus / 2) - 0.5 * pt.log(nus * np.pi)
        norm = (pt.switch(heavy, at_zero, log_norm(None)) * measured.reshape((n, -1))).sum(axis=1)
    logp = -0.5 * square.sum(axis=1) - log_sigma + norm
    return pt.switch(pt.isnan(logp), -np.inf, logp)


def tail_tensor(physics: Physics, variables: Mapping[str, Any], nu: float | None) -> Any:
    """Return the reciprocal degrees of freedom of each body's noise, a tensor (body,)."""
    owners = {block.name: block.owners for block in physics.layout.blocks}

    def value(attached: Attached, variable: str) -> Any:
        return variables[variable][owners[variable].index(attached.body)]

    zero = pt.constant(0.0 if nu is None else 1.0 / nu)
    return pt.stack(sum_tails(physics, value, zero))
