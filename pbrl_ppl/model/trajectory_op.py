"""The log-density of correlated residuals as a pytensor Op, with its derivative."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import pytensor.tensor as pt
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op
from pytensor.link.numba.dispatch.basic import numba_funcify

from pbrl_ppl.likelihood import OutputErrorLikelihood, TrajectoryLikelihood
from pbrl_ppl.state import Floats

#: Likelihoods of residuals that are correlated within a trajectory.
Correlated = TrajectoryLikelihood | OutputErrorLikelihood

#: Step of a derivative by the logarithm of a noise parameter.
_STEP = 1e-5


class _DensityOp(Op):
    """Base class of the density and its derivative.

    Inputs are measured minus linearised next states, linearised minus predicted ones, both of shape
    (transition, H, body, state), noise parameters (parameter,) and reciprocal degrees of freedom,
    one a body (body,).
    """

    __props__ = ("likelihood",)

    def __init__(self, likelihood: Correlated) -> None:
        self.likelihood = likelihood
        self._given = likelihood

    def given(self, deviation: Floats) -> Correlated:
        """Return the likelihood of these measurements; the last one is kept with its gains."""
        self._given = self._given.measuring(deviation)
        return self._given

    def density(self, deviation: Floats, residual: Floats, sigma: Floats, tail: Floats) -> Floats:
        """Return the log-density of each transition given those before, shape (transition,)."""
        if not (np.isfinite(sigma).all() and (sigma > 0).all()):
            return np.full(len(residual), -np.inf)
        nu = None
        if tail.any():
            with np.errstate(divide="ignore"):
                nu = 1.0 / np.maximum(tail, 0.0)[:, None]
        measured = np.ones(residual.shape, dtype=bool)
        return self.given(deviation).log_density(residual, sigma, measured, nu)


class TrajectoryDensityOp(_DensityOp):
    """Log-density of each transition's measurements given those before, shape (transition,).

    Parameters
    ----------
    likelihood : TrajectoryLikelihood or OutputErrorLikelihood
        Of the linearised trajectories or of simulated pieces.
    """

    def make_node(self, deviation: Any, residual: Any, sigma: Any, tail: Any) -> Apply:
        """Cast the inputs; shapes as in the base class."""
        given = (deviation, residual, sigma, tail)
        inputs = [pt.cast(pt.as_tensor(value), "float64") for value in given]
        return Apply(self, inputs, [pt.vector(dtype="float64")])

    def infer_shape(self, *arguments: Any) -> list[tuple[Any, ...]]:
        """Return (transition,) from the residuals' shape."""
        return [(arguments[-1][0][0],)]

    def perform(self, node: Apply, inputs: Any, outputs: Any) -> None:
        """Evaluate the density."""
        outputs[0][0] = self.density(*inputs)

    def pullback(
        self, inputs: Sequence[Any], outputs: Sequence[Any], cotangents: Sequence[Any]
    ) -> list[Any]:
        """Return the vector-Jacobian product: by the adjoint, by differences for the noise."""
        return list(_DerivativeOp(self.likelihood)(*inputs, cotangents[0], return_list=True))

    L_op = pullback  # its name in pytensor 2


class _DerivativeOp(_DensityOp):
    """Derivative of a weighted sum of :class:`TrajectoryDensityOp` by its inputs."""

    def make_node(
        self, deviation: Any, residual: Any, sigma: Any, tail: Any, weights: Any
    ) -> Apply:
        inputs = [pt.as_tensor(value) for value in (deviation, residual, sigma, tail, weights)]
        return Apply(self, inputs, [each.type() for each in inputs[:4]])

    def infer_shape(self, *arguments: Any) -> list[tuple[Any, ...]]:
        return list(arguments[-1][:4])

    def perform(self, node: Apply, inputs: Any, outputs: Any) -> None:
        for place, value in zip(outputs, self.derivatives(*inputs), strict=True):
            place[0] = value

    def derivatives(
        self, deviation: Floats, residual: Floats, sigma: Floats, tail: Floats, weights: Floats
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the derivatives by the inputs, in their order."""
        likelihood = self.given(deviation)
        white = likelihood.whiten(residual, sigma)
        pull = white
        if tail.any():
            with np.errstate(divide="ignore"):
                nu = np.broadcast_to(1.0 / tail[:, None], residual.shape)
            nus = np.asarray(likelihood.whitened_nu(nu, residual.shape))
            heavy = np.isfinite(nus)
            nus = np.where(heavy, nus, 1.0)
            pull = np.where(heavy, (nus + 1) * white / (nus + white**2), white)
        by_deviation, by_residual = likelihood.slopes(residual, pull * weights[:, None], sigma)

        def total(sigma: Floats, tail: Floats) -> float:
            return float(self.density(deviation, residual, sigma, tail) @ weights)

        by_sigma = np.empty_like(sigma)
        for i, step in enumerate(_STEP * sigma):
            ends = [sigma.copy(), sigma.copy()]
            ends[0][i] += step
            ends[1][i] -= step
            by_sigma[i] = (total(ends[0], tail) - total(ends[1], tail)) / (2 * step)
        by_tail = np.zeros_like(tail)
        for j in np.flatnonzero(tail):
            ends = [tail.copy(), tail.copy()]
            ends[0][j] += _STEP
            ends[1][j] = max(tail[j] - _STEP, 0.0)
            change = ends[0][j] - ends[1][j]
            by_tail[j] = (total(sigma, ends[0]) - total(sigma, ends[1])) / change
        return by_deviation, by_residual, by_sigma, by_tail


@numba_funcify.register(TrajectoryDensityOp)
def _numba_density(op: TrajectoryDensityOp, node: Any = None, **kwargs: Any) -> Any:
    """Dispatch the density in numba: a call in object mode."""
    kind = numba.types.Array(numba.float64, 1, "C")

    @numba.njit
    def density(deviation, residual, sigma, tail):  # type: ignore[no-untyped-def]
        with numba.objmode(result=kind):
            result = op.density(deviation, residual, sigma, tail)
        return result

    return density


@numba_funcify.register(_DerivativeOp)
def _numba_derivative(op: _DerivativeOp, node: Any = None, **kwargs: Any) -> Any:
    """Dispatch the derivative in numba: a call in object mode."""
    wide = numba.types.Array(numba.float64, 4, "C")
    flat = numba.types.Array(numba.float64, 1, "C")

    @numba.njit
    def derivative(deviation, residual, sigma, tail, weights):  # type: ignore[no-untyped-def]
        with numba.objmode(a=wide, b=wide, c=flat, d=flat):
            a, b, c, d = op.derivatives(deviation, residual, sigma, tail, weights)
        return a, b, c, d

    return derivative
