"""The engine as a black-box pytensor Op, with its derivative and numba dispatch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any

import numba
import numpy as np
import pytensor.tensor as pt
from pytensor.gradient import grad_undefined
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op
from pytensor.link.numba.dispatch.basic import numba_funcify

from pbrl_ppl.errors import ParameterError, SimulationError
from pbrl_ppl.likelihood import Sensitivity
from pbrl_ppl.physics import Memory, Physics
from pbrl_ppl.state import INPUT, WRENCH, Floats


class _EngineOp(Op):
    """Base class of the prediction and its derivative: checks inputs and dispatches."""

    __props__ = ("physics", "sensitivity")

    def __init__(self, physics: Physics, sensitivity: Sensitivity | None = None) -> None:
        self.physics, self.sensitivity = physics, sensitivity

    @property
    def _last(self) -> tuple[int, ...]:
        """Last dimensions of the output, after (transition, H)."""
        raise NotImplementedError

    def _compute(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        raise NotImplementedError

    def _following(
        self, engine: Callable[..., Floats], phi: Floats, start: Floats, actions: Floats
    ) -> Floats:
        """Return predictions of an engine from start states that follow phi."""
        if self.sensitivity is None:
            return engine(phi, start, actions)
        return self.sensitivity.predicted(engine, phi, start, actions)

    def make_node(self, phi: Any, start: Any, actions: Any) -> Apply:
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
        return Apply(self, inputs, [pt.tensor(dtype="float64", shape=(None, None, *self._last))])

    def infer_shape(self, *arguments: Any) -> list[tuple[Any, ...]]:
        """Return (transition, H) from the shape of the actions."""
        actions = arguments[-1][2]  # older stacks pass (fgraph, node, shapes), newer (node, shapes)
        return [(actions[0], actions[1], *self._last)]

    def perform(self, node: Apply, inputs: Any, outputs: Any) -> None:
        """Run the engine."""
        outputs[0][0] = self.predict(*inputs)

    def predict(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Run the engine; NaN where phi is impossible."""
        try:
            return self._compute(phi, start, actions)
        except ParameterError:  # samplers try such points: their likelihood is zero
            return np.full((*actions.shape[:2], *self._last), np.nan)


class SimulatorOp(_EngineOp):
    """``next_states = f(phi, start, actions)``, the deterministic part of Eq. 7.

    Inputs are phi (p,), start states (transition, body, 6) and wrenches (transition, H, body, 3),
    or all of :data:`pbrl_ppl.state.INPUT` in place of the 3; the output has shape (transition, H,
    body, 6); all float64, in SI units. A transition in which the engine diverges is NaN, and so is
    everything where phi is impossible (a mass that is not positive, say): the likelihood of that is
    zero. The derivative by phi is by finite differences, all columns in one call of the engine.

    Parameters
    ----------
    physics : Physics
        Scene, effects and the engine's settings.
    sensitivity : Sensitivity, optional
        Derivative of smoothed start states of whole trajectories by phi.
    engine : str, optional
        ``chipmunk`` or ``contact-free`` to force one; see :class:`Physics`.
    """

    def __init__(
        self,
        physics: Physics,
        sensitivity: Sensitivity | None = None,
        *,
        engine: str | None = None,
    ) -> None:
        super().__init__(physics if engine is None else physics.changed(engine=engine), sensitivity)

    @property
    def _last(self) -> tuple[int, ...]:
        return len(self.physics.scene.moving), 6

    def _compute(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        if self.sensitivity is None:
            return self.physics.simulator.recall(phi, start, actions)
        follow = partial(self._following, self.physics.simulator.recall)
        # a copy: a graph may write into its arrays
        return self._memory.recall((phi, start, actions), follow).copy()

    @cached_property
    def _memory(self) -> Memory:
        return Memory()

    def pullback(
        self, inputs: Sequence[Any], outputs: Sequence[Any], cotangents: Sequence[Any]
    ) -> list[Any]:
        """Return the vector-Jacobian product by phi; start states and actions are data."""
        jacobian = JacobianOp(self.physics, self.sensitivity)(*inputs)
        return [
            (cotangents[0][..., None] * jacobian).sum(axis=(0, 1, 2, 3)),
            *(
                grad_undefined(self, i, inputs[i], "the engine is differentiated by phi alone")
                for i in (1, 2)
            ),
        ]

    L_op = pullback  # its name in pytensor 2


class OneWorldOp(_EngineOp):
    """As :class:`SimulatorOp`, but bodies of different parts may meet; without a derivative.

    Draws of next states (prior and posterior predictive) are about its predictions.
    """

    @property
    def _last(self) -> tuple[int, ...]:
        return len(self.physics.scene.moving), 6

    def _compute(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        return self._following(self.physics.one_world, phi, start, actions)


class JacobianOp(_EngineOp):
    """Derivative of :class:`SimulatorOp` by phi, shape (transition, H, body, 6, p).

    It leaves out that start states follow phi: the correction to the smoothed starts cancels that.
    """

    @property
    def _last(self) -> tuple[int, ...]:
        return len(self.physics.scene.moving), 6, self.physics.layout.size

    def _compute(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        if self.sensitivity is not None:
            start = self.sensitivity.begun(self.sensitivity.moved(phi), start)
        return self.physics.jacobian(phi, start, actions)


@numba_funcify.register(_EngineOp)
def _numba_engine(op: _EngineOp, node: Any = None, **kwargs: Any) -> Any:
    """Dispatch the Op in numba: a call in object mode."""
    kind = numba.types.Array(numba.float64, 2 + len(op._last), "C")

    @numba.njit
    def simulate(phi, start, actions):  # type: ignore[no-untyped-def]
        with numba.objmode(result=kind):
            result = op.predict(phi, start, actions)
        return result

    return simulate
