"""The log-density of whole trajectories as a pytensor Op, with its derivative."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op
from pytensor.link.numba.dispatch.basic import numba_funcify

from pbrl_ppl.model.likelihood import log_density
from pbrl_ppl.model.trajectory_noise import TrajectoryNoise

Array = NDArray[np.float64]

#: Step of a derivative by the logarithm of a noise parameter.
_STEP = 1e-5


class _DensityOp(Op):
    """Base of the density and of its derivative.

    Inputs are residuals (transition, 1, body, state), noise parameters (parameter,) and reciprocal
    degrees of freedom, one a body (body,).
    """

    __props__ = ("noise",)

    def __init__(self, noise: TrajectoryNoise) -> None:
        self.noise = noise

    def density(self, residual: Array, sigma: Array, tail: Array) -> Array:
        """Log-density of each transition given those before it, shape (transition,)."""
        if not (np.isfinite(sigma).all() and (sigma > 0).all()):
            return np.full(len(residual), -np.inf)
        nu = None
        if tail.any():
            with np.errstate(divide="ignore"):
                nu = 1.0 / np.maximum(tail, 0.0)[:, None]
        measured = np.ones(residual.shape, dtype=bool)
        return log_density(residual, sigma, self.noise, measured, nu)


class TrajectoryDensityOp(_DensityOp):
    """Log-density of each transition's measurements given those before, shape (transition,).

    Parameters
    ----------
    noise : TrajectoryNoise
        The linearised trajectories.
    """

    def make_node(self, residual: Any, sigma: Any, tail: Any) -> Apply:
        """Take tensors of the shapes named in the class."""
        inputs = [pt.cast(pt.as_tensor(value), "float64") for value in (residual, sigma, tail)]
        return Apply(self, inputs, [pt.vector(dtype="float64")])

    def infer_shape(self, *arguments: Any) -> list[tuple[Any, ...]]:
        """(transition,) from the residuals' shape."""
        return [(arguments[-1][0][0],)]

    def perform(self, node: Apply, inputs: Any, outputs: Any) -> None:
        """Run the filter."""
        outputs[0][0] = self.density(*inputs)

    def pullback(
        self, inputs: Sequence[Any], outputs: Sequence[Any], cotangents: Sequence[Any]
    ) -> list[Any]:
        """Vector-Jacobian product: by the filter's adjoint, and by differences for the noise."""
        return list(_DerivativeOp(self.noise)(*inputs, cotangents[0], return_list=True))

    L_op = pullback  # its name in pytensor 2


class _DerivativeOp(_DensityOp):
    """Derivative of a weighted sum of :class:`TrajectoryDensityOp` by its inputs."""

    def make_node(self, residual: Any, sigma: Any, tail: Any, weights: Any) -> Apply:
        inputs = [pt.as_tensor(value) for value in (residual, sigma, tail, weights)]
        return Apply(self, inputs, [each.type() for each in inputs[:3]])

    def infer_shape(self, *arguments: Any) -> list[tuple[Any, ...]]:
        return list(arguments[-1][:3])

    def perform(self, node: Apply, inputs: Any, outputs: Any) -> None:
        for place, value in zip(outputs, self.derivatives(*inputs), strict=True):
            place[0] = value

    def derivatives(
        self, residual: Array, sigma: Array, tail: Array, weights: Array
    ) -> tuple[Array, Array, Array]:
        """Derivatives by residual, noise parameters and tails."""
        noise = self.noise
        white = noise.filtered(noise.cells.of_residual(residual)[None], sigma)[0][0]
        pull = white
        if tail.any():
            with np.errstate(divide="ignore"):
                nu = np.broadcast_to(1.0 / tail[:, None], residual.shape)
            nus = noise.cells.of_residual(nu)
            heavy = np.isfinite(nus)
            nus = np.where(heavy, nus, 1.0)
            pull = np.where(heavy, (nus + 1) * white / (nus + white**2), white)
        by_cell = noise.pulled(pull * weights[:, None], sigma)[1]
        by_residual = np.zeros_like(residual)
        body, place = noise.cells.in_residual
        by_residual[:, 0, body, place] = by_cell

        def total(sigma: Array, tail: Array) -> float:
            return float(self.density(residual, sigma, tail) @ weights)

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
        return by_residual, by_sigma, by_tail


@numba_funcify.register(TrajectoryDensityOp)
def _numba_density(op: TrajectoryDensityOp, node: Any = None, **kwargs: Any) -> Any:
    """Numba dispatch: a call of the filter in object mode."""
    kind = numba.types.Array(numba.float64, 1, "C")

    @numba.njit
    def density(residual, sigma, tail):  # type: ignore[no-untyped-def]
        with numba.objmode(result=kind):
            result = op.density(residual, sigma, tail)
        return result

    return density


@numba_funcify.register(_DerivativeOp)
def _numba_derivative(op: _DerivativeOp, node: Any = None, **kwargs: Any) -> Any:
    """Numba dispatch: a call of the adjoint in object mode."""
    wide = numba.types.Array(numba.float64, 4, "C")
    flat = numba.types.Array(numba.float64, 1, "C")

    @numba.njit
    def derivative(residual, sigma, tail, weights):  # type: ignore[no-untyped-def]
        with numba.objmode(a=wide, b=flat, c=flat):
            a, b, c = op.derivatives(residual, sigma, tail, weights)
        return a, b, c

    return derivative
