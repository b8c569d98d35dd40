"""Black-box pytensor Ops of the engine and of a log-likelihood, with their derivatives."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar, cast

import numpy as np
import pytensor.tensor as pt
from pytensor.gradient import grad_undefined
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.op import Op
from pytensor.link.numba.dispatch.basic import generate_fallback_impl, numba_funcify

from pbrl_ppl.errors import ParameterError, SimulationError
from pbrl_ppl.likelihood import Problem, Sensitivity, is_filtered
from pbrl_ppl.physics import Memory, Physics
from pbrl_ppl.state import INPUT, WRENCH, Floats

#: Symbolic sizes of an array's axes.
Shape = tuple[Variable, ...]


class _BlackBoxOp(Op):
    """An Op of one output that numpy computes, with the pullback of some inputs.

    Attributes
    ----------
    evaluate : callable
        Returns the output for the inputs.
    pulled : callable
        Returns derivatives by the differentiable inputs for the inputs and a cotangent.
    differentiable, reason
        Places of those inputs, and why there is no derivative by the others.
    """

    evaluate: Callable[..., Floats]
    pulled: Callable[..., list[Floats]]
    differentiable: ClassVar[tuple[int, ...]]
    reason: ClassVar[str]

    def perform(self, node: Apply, inputs: Sequence[Floats], outputs: list[list[Floats]]) -> None:
        """Compute the output."""
        outputs[0][0] = self.evaluate(*inputs)

    def pullback(
        self,
        inputs: Sequence[Variable],
        outputs: Sequence[Variable],
        cotangents: Sequence[Variable],
    ) -> list[Variable]:
        """Return the vector-Jacobian products by the inputs."""
        gradients = _PullbackOp(self)(*inputs, cotangents[0], return_list=True)
        by = dict(zip(self.differentiable, gradients, strict=True))
        return [
            by[i] if i in by else grad_undefined(self, i, variable, self.reason)
            for i, variable in enumerate(inputs)
        ]

    L_op = pullback  # its name in pytensor 2


class _PullbackOp(Op):
    """Derivative of a black-box Op's output times a cotangent, the last input."""

    __props__ = ("op",)

    def __init__(self, op: _BlackBoxOp) -> None:
        self.op = op

    def make_node(self, *inputs: Variable) -> Apply:
        tensors = [pt.as_tensor_variable(value) for value in inputs]
        return Apply(self, tensors, [tensors[i].type() for i in self.op.differentiable])

    def infer_shape(self, *arguments: Any) -> list[Shape]:
        return [arguments[-1][i] for i in self.op.differentiable]

    def perform(self, node: Apply, inputs: Sequence[Floats], outputs: list[list[Floats]]) -> None:
        for place, value in zip(outputs, self.op.pulled(*inputs), strict=True):
            place[0] = value


@numba_funcify.register(_BlackBoxOp)
@numba_funcify.register(_PullbackOp)
def _in_object_mode(op: Op, node: Apply | None = None, **kwargs: object) -> object:
    """Dispatch the Op in numba as pytensor does by itself, without its warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return generate_fallback_impl(op, node=node, **kwargs)


class DensityOp(_BlackBoxOp):
    """Log-density of a point (d,), for samplers that need no derivative.

    Parameters
    ----------
    function : callable
        Returns log-densities of points (n, d), shape (n,).
    """

    __props__ = ("function",)
    differentiable, reason = (), "no derivative of it is known"

    def __init__(self, function: Callable[[Floats], Floats]) -> None:
        self.function = function

    def make_node(self, point: Variable) -> Apply:
        """Return the node of a point, shape (d,)."""
        return Apply(self, [pt.as_tensor_variable(point)], [pt.dscalar()])

    def evaluate(self, point: Floats) -> Floats:
        """Return the log-density, a number."""
        return np.asarray(self.function(point[None])[0])


class SimulatorOp(_BlackBoxOp):
    """``next_states = f(phi, start, actions)``, the deterministic part of Eq. 7.

    Inputs are phi (p,), initial states (transition, body, 6) and wrenches (transition, H, body, 3),
    or all of :data:`pbrl_ppl.state.INPUT` in place of the 3; the output has shape (transition, H,
    body, 6); all float64, in SI units. A transition in which the engine diverges is NaN, and so is
    everything where phi is impossible (a mass that is not positive, say): the likelihood of that is
    zero. The derivative by phi is by finite differences, all columns in one call of the engine. It
    leaves out that initial states follow phi: the correction to the smoothed states cancels that.

    Parameters
    ----------
    physics : Physics
        Scene, effects and the engine's settings.
    sensitivity : Sensitivity, optional
        Derivative of smoothed initial states of whole trajectories by phi.
    engine : str, optional
        ``chipmunk`` or ``contact-free`` to force one; see :class:`Physics`.
    one_world : bool
        Let bodies of independent parts meet, as draws of next states do.
    """

    __props__ = ("physics", "sensitivity", "one_world")
    differentiable = (0,)
    reason = "the engine is differentiated by phi alone"

    def __init__(
        self,
        physics: Physics,
        sensitivity: Sensitivity | None = None,
        *,
        engine: str | None = None,
        one_world: bool = False,
    ) -> None:
        self.physics = physics if engine is None else physics.changed(engine=engine)
        self.sensitivity, self.one_world = sensitivity, one_world

    def make_node(self, phi: Variable, start: Variable, actions: Variable) -> Apply:
        """Check the dimensions and static shapes of the inputs.

        Raises
        ------
        SimulationError
            If an input has the wrong number of dimensions or a static shape that does not fit.
        """
        k, p = len(self.physics.scene.moving), self.physics.layout.size
        actions = pt.as_tensor_variable(actions)
        width = len(INPUT) if actions.type.shape[-1:] == (len(INPUT),) else len(WRENCH)
        inputs = []
        for name, value, shape in (
            ("phi", phi, (p,)),
            ("start", start, (None, k, 6)),
            ("actions", actions, (None, None, k, width)),
        ):
            tensor = pt.cast(pt.as_tensor_variable(value), "float64")
            static = tensor.type.shape
            fits = len(static) == len(shape) and all(
                s is None or e is None or s == e for s, e in zip(static, shape, strict=True)
            )
            if not fits:
                expected = ", ".join("?" if e is None else str(e) for e in shape)
                raise SimulationError(
                    f"{type(self).__name__}: {name} has shape {static}, expected ({expected})"
                )
            inputs.append(tensor)
        return Apply(self, inputs, [pt.tensor(dtype="float64", shape=(None, None, k, 6))])

    def infer_shape(self, *arguments: Any) -> list[Shape]:
        """Return (transition, H) from the shape of the actions."""
        actions = arguments[-1][2]  # older stacks pass (fgraph, node, shapes), newer (node, shapes)
        return [(*actions[:3], 6)]

    @cached_property
    def _memory(self) -> Memory:
        return Memory()

    def evaluate(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Run the engine; NaN where phi is impossible."""
        try:
            if self.sensitivity is None:
                return self._engine(phi, start, actions)
            # a copy: a graph may write into its arrays
            return self._memory.recall((phi, start, actions), self._with_state_sensitivity).copy()
        except ParameterError:  # samplers try such points: their likelihood is zero
            return np.full((*actions.shape[:3], 6), np.nan)

    predict = evaluate

    @property
    def _engine(self) -> Callable[[Floats, Floats, Floats], Floats]:
        return self.physics.one_world if self.one_world else self.physics.simulator.recall

    def _with_state_sensitivity(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Return predictions from initial states that follow phi."""
        return cast(Sensitivity, self.sensitivity).predicted(self._engine, phi, start, actions)

    def pulled(
        self, phi: Floats, start: Floats, actions: Floats, cotangent: Floats
    ) -> list[Floats]:
        """Return the vector-Jacobian product by phi."""
        try:
            if self.sensitivity is not None:
                start = self.sensitivity.begun(self.sensitivity.moved(phi), start)
            return [np.tensordot(cotangent, self.physics.jacobian(phi, start, actions), 4)]
        except ParameterError:
            return [np.full(len(phi), np.nan)]


class LogLikelihoodOp(_BlackBoxOp):
    """Log-likelihood of each transition: Eq. 11, or its density given those before.

    Inputs are measured and predicted next states, shape (transition, H, body, state) each, noise
    parameters (parameter,) and phi (p,), which the tails of the noise may depend on; the output has
    shape (transition,). The derivative by the predictions is the likelihood's adjoint, that by the
    noise parameters and the tails is by finite differences.

    Parameters
    ----------
    problem : Problem
        Its likelihood, and what was measured.
    """

    __props__ = ("problem",)
    differentiable = (1, 2, 3)
    reason = "the log-likelihood is not differentiated by what was measured"

    def __init__(self, problem: Problem) -> None:
        self.problem, self._likelihood = problem, problem.likelihood

    def make_node(self, *inputs: Variable) -> Apply:
        """Cast the inputs; shapes as in the class."""
        tensors = [pt.cast(pt.as_tensor_variable(value), "float64") for value in inputs]
        return Apply(self, tensors, [pt.vector(dtype="float64")])

    def infer_shape(self, *arguments: Any) -> list[Shape]:
        """Return (transition,) from the shape of the measurements."""
        return [(arguments[-1][0][0],)]

    def _residual(self, value: Floats, predicted: Floats) -> Floats:
        """Return residuals about the linearisation, and set the likelihood to the measurements."""
        observations = self.problem.observations
        linearised = np.nan_to_num(observations.values) if is_filtered(self.problem) else value
        deviation = observations.wrapped(value - linearised)
        self._likelihood = self._likelihood.measuring(deviation)  # kept, with its gains
        residual = observations.wrapped(linearised - predicted)
        return np.where(observations.measured, residual, 0.0)

    def _density(self, residual: Floats, sigma: Floats, phi: Floats) -> Floats:
        if not (np.isfinite(sigma).all() and (sigma > 0).all()):
            return np.full(len(residual), -np.inf)
        measured = self.problem.observations.measured
        with np.errstate(all="ignore"):  # samplers try points where it overflows
            return self._likelihood.log_density(residual, sigma, measured, self.problem.nu(phi))

    def evaluate(self, value: Floats, predicted: Floats, sigma: Floats, phi: Floats) -> Floats:
        """Return the log-likelihoods."""
        return self._density(self._residual(value, predicted), sigma, phi)

    def pulled(
        self, value: Floats, predicted: Floats, sigma: Floats, phi: Floats, cotangent: Floats,
        *, step: float = 1e-5,
    ) -> list[Floats]:  # fmt: skip
        """Return derivatives by predictions, noise and phi; ``step`` is relative in the noise."""
        residual, nu = self._residual(value, predicted), self.problem.nu(phi)
        slope = self._likelihood.slope(residual, sigma, nu, cotangent)

        def by_differences(point: Floats, i: int, step: float, **others: Floats) -> float:
            ends = [point.copy(), point.copy()]
            ends[0][i] += step
            ends[1][i] = max(point[i] - step, 0.0)
            name = "sigma" if "phi" in others else "phi"
            high, low = (self._density(residual, **{name: end}, **others) for end in ends)
            return float((high - low) @ cotangent / (ends[0][i] - ends[1][i]))

        by_sigma = [by_differences(sigma, i, step * x, phi=phi) for i, x in enumerate(sigma)]
        by_phi = np.zeros_like(phi)
        for i in self.problem.tails:
            by_phi[i] = by_differences(phi, i, step, sigma=sigma)
        return [
            np.where(self.problem.observations.measured, -slope, 0.0),
            np.array(by_sigma),
            by_phi,
        ]
