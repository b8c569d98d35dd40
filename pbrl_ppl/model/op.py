"""Black-box pytensor Ops of the engine and of a log-likelihood, with their derivatives."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
import pytensor.tensor as pt
from pytensor.gradient import grad_undefined
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.op import Op
from pytensor.link.numba.dispatch.basic import generate_fallback_impl, numba_funcify

from pbrl_ppl.errors import FitError, ParameterError, SimulationError
from pbrl_ppl.likelihood import Likelihood, Problem, is_filtered, is_independent
from pbrl_ppl.physics import Memory, Physics
from pbrl_ppl.state import INPUT, WRENCH, Bools, Floats

#: Symbolic sizes of an array's axes.
Shape = tuple[Variable, ...]


class LazyProblem:
    """A problem as declared, whose trajectories are linearised when it is first needed.

    Parameters
    ----------
    outline : Problem
        Has the final variables, dimensions and measurements.
    linearise : callable, optional
        Returns the problem of an outline; the outline is the problem without it.
    """

    def __init__(
        self, outline: Problem, linearise: Callable[[Problem], Problem] | None = None
    ) -> None:
        self.outline, self._linearise = outline, linearise

    @cached_property
    def problem(self) -> Problem:
        """The problem that is fitted."""
        return self.outline if self._linearise is None else self._linearise(self.outline)

    @cached_property
    def _declared(self) -> tuple[Floats, Floats]:
        """Initial states and inputs as declared."""
        return self.outline.segments.start, self.outline.inputs

    def start(self, start: Floats, actions: Floats) -> Floats:
        """Return what to start from: smoothed states, or those of data that a user has set.

        Raises
        ------
        FitError
            If they were set and the likelihood holds for the declared ones alone.
        """
        given = zip((start, actions), self._declared, strict=True)
        if all(np.array_equal(one, other, equal_nan=True) for one, other in given):
            return self.problem.segments.start
        self._refuse_other_data("start or actions", is_independent(self.outline))
        parts = len(self.outline.physics.simulator.parts)
        if parts > 1:
            raise FitError(
                f"pm.set_data: start or actions are set, and bodies are simulated in {parts} worlds"
                " because they never meet in the declared recording; declare a physics_model of"
                " the other recording"
            )
        return start

    def measured(self, value: Floats) -> Floats:
        """Return measured states, NaN where missing.

        Raises
        ------
        FitError
            If they are not the declared ones, and pieces begin at those.
        """
        value = np.ma.filled(value, np.nan)  # pm.set_data masks missing cells
        outline = self.outline
        if not (is_independent(outline) or is_filtered(outline)):
            same = np.array_equal(value, outline.measured, equal_nan=True)
            self._refuse_other_data("measured", same)
        return value

    def _refuse_other_data(self, names: str, fine: bool) -> None:
        if not fine:
            kind = self.outline.likelihood.name
            raise FitError(
                f"pm.set_data: {names} are set, and the likelihood {kind!r} is linearised along the"
                " declared recording; declare a physics_model of the other recording, or use the"
                " likelihood 'transitions'"
            )


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
    zero. The derivative by phi is by finite differences, all columns in one call of the engine.

    Parameters
    ----------
    physics : Physics
        Scene, effects and the engine's settings.
    """

    __props__: tuple[str, ...] = ("physics",)
    differentiable = (0,)
    reason = "the engine is differentiated by phi alone"

    def __init__(self, physics: Physics) -> None:
        self.physics = physics

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

    def evaluate(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Run the engine; NaN where phi is impossible."""
        try:
            return self._states(phi, start, actions)
        except ParameterError:  # samplers try such points: their likelihood is zero
            return np.full((*actions.shape[:3], 6), np.nan)

    predict = evaluate

    def _states(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        return self.physics.simulator.recall(phi, start, actions)

    def _begun(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Return initial states at phi."""
        return start

    def pulled(
        self, phi: Floats, start: Floats, actions: Floats, cotangent: Floats
    ) -> list[Floats]:
        """Return the vector-Jacobian product by phi."""
        try:
            start = self._begun(phi, start, actions)
            return [np.tensordot(cotangent, self.physics.jacobian(phi, start, actions), 4)]
        except ParameterError:
            return [np.full(len(phi), np.nan)]


class PredictionOp(SimulatorOp):
    """Predictions of a problem, as :class:`SimulatorOp`, from smoothed states if it has such.

    The derivative leaves out that smoothed initial states follow phi: the correction to them
    cancels that.

    Parameters
    ----------
    lazy : LazyProblem
        Linearised at the first evaluation.
    one_world : bool
        Let bodies of independent parts meet, as draws of next states do.
    """

    __props__ = ("lazy", "one_world")

    def __init__(self, lazy: LazyProblem, *, one_world: bool = False) -> None:
        super().__init__(lazy.outline.physics)
        self.lazy, self.one_world, self._memory = lazy, one_world, Memory()

    def _states(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        start = self.lazy.start(start, actions)
        engine = self.physics.one_world if self.one_world else self.physics.simulator.recall
        sensitivity = self.lazy.problem.likelihood.sensitivity
        if sensitivity is None:
            return engine(phi, start, actions)
        follow = partial(sensitivity.predicted, engine)
        # a copy: a graph may write into its arrays
        return self._memory.recall((phi, start, actions), follow).copy()

    def _begun(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        start = self.lazy.start(start, actions)
        sensitivity = self.lazy.problem.likelihood.sensitivity
        return start if sensitivity is None else sensitivity.begun(sensitivity.moved(phi), start)


class LogLikelihoodOp(_BlackBoxOp):
    """Log-likelihood of each transition: Eq. 11, or its density given those before.

    Inputs are measured and predicted next states, shape (transition, H, body, state) each, noise
    parameters (parameter,) and phi (p,), which the tails of the noise may depend on; the output has
    shape (transition,). The derivative by the predictions is the likelihood's adjoint, that by the
    noise parameters and the tails is by finite differences.

    Parameters
    ----------
    lazy : LazyProblem
        Its likelihood, and what was measured.
    """

    __props__ = ("lazy",)
    differentiable = (1, 2, 3)
    reason = "the log-likelihood is not differentiated by what was measured"

    def __init__(self, lazy: LazyProblem) -> None:
        self.lazy = lazy

    def make_node(self, *inputs: Variable) -> Apply:
        """Cast the inputs; shapes as in the class."""
        tensors = [pt.cast(pt.as_tensor_variable(value), "float64") for value in inputs]
        return Apply(self, tensors, [pt.vector(dtype="float64")])

    def infer_shape(self, *arguments: Any) -> list[Shape]:
        """Return (transition,) from the shape of the measurements."""
        return [(arguments[-1][0][0],)]

    @cached_property
    def _likelihood(self) -> Likelihood:
        return self.lazy.problem.likelihood

    def _residual(self, value: Floats, predicted: Floats) -> tuple[Floats, Bools]:
        """Return residuals about the linearisation, and a mask of what counts.

        The likelihood is set to the measurements.
        """
        observations, value = self.lazy.problem.observations, self.lazy.measured(value)
        measured = np.isfinite(value)
        if is_filtered(self.lazy.problem):
            linearised, measured = np.nan_to_num(observations.values), observations.measured
            deviation = np.nan_to_num(observations.wrapped(value - linearised))
            self._likelihood = self._likelihood.measuring(deviation)  # kept, with its gains
            value = linearised
        return np.where(measured, observations.wrapped(value - predicted), 0.0), measured

    def _density(self, residual: Floats, measured: Bools, sigma: Floats, phi: Floats) -> Floats:
        if not (np.isfinite(sigma).all() and (sigma > 0).all()):
            return np.full(len(residual), -np.inf)
        with np.errstate(all="ignore"):  # samplers try points where it overflows
            nu = self.lazy.problem.nu(phi)
            return self._likelihood.log_density(residual, sigma, measured, nu)

    def evaluate(self, value: Floats, predicted: Floats, sigma: Floats, phi: Floats) -> Floats:
        """Return the log-likelihoods."""
        return self._density(*self._residual(value, predicted), sigma, phi)

    def pulled(
        self, value: Floats, predicted: Floats, sigma: Floats, phi: Floats, cotangent: Floats
    ) -> list[Floats]:
        """Return derivatives by predictions, noise and phi."""
        residual, measured = self._residual(value, predicted)
        slope = self._likelihood.slope(residual, sigma, self.lazy.problem.nu(phi), cotangent)

        point, n = np.concatenate([sigma, phi]), len(sigma)
        by_point = np.zeros_like(point)
        for i in (*range(n), *(n + place for place in self.lazy.problem.tails)):
            step = 1e-5 * (point[i] if i < n else 1.0)  # relative in the noise
            ends = np.tile(point, (2, 1))
            ends[:, i] = point[i] + step, max(point[i] - step, 0.0)
            high, low = (self._density(residual, measured, end[:n], end[n:]) for end in ends)
            by_point[i] = (high - low) @ cotangent / (ends[0, i] - ends[1, i])
        return [np.where(measured, -slope, 0.0), by_point[:n], by_point[n:]]


class NoiseMediansOp(Op):
    """Medians of the prior of a problem's noise parameters, shape (parameter,).

    They follow from smoothed states, and are computed with those.

    Parameters
    ----------
    lazy : LazyProblem
        Linearised at the first evaluation.
    """

    __props__ = ("lazy",)

    def __init__(self, lazy: LazyProblem) -> None:
        self.lazy = lazy

    def make_node(self) -> Apply:
        """Return a node without inputs."""
        size = len(self.lazy.outline.noise_prior[0])
        return Apply(self, [], [pt.tensor(dtype="float64", shape=(size,))])

    def do_constant_folding(self, *arguments: object) -> bool:
        """Return False: compiling a graph smooths nothing."""
        return False

    def perform(self, node: Apply, inputs: Sequence[Floats], outputs: list[list[Floats]]) -> None:
        """Compute the medians."""
        outputs[0][0] = self.lazy.problem.noise_prior[0].copy()  # a graph may write into it


@numba_funcify.register(_BlackBoxOp)
@numba_funcify.register(_PullbackOp)
@numba_funcify.register(NoiseMediansOp)
def _in_object_mode(op: Op, node: Apply | None = None, **kwargs: object) -> object:
    """Dispatch the Op in numba as pytensor does by itself, without its warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return generate_fallback_impl(op, node=node, **kwargs)
