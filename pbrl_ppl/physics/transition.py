"""Eqs. 2 and 7 as a plain function: states and actions -> next states, all parameters given."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from pbrl_ppl.effects import Attached, Effect
from pbrl_ppl.errors import ParameterError, SimulationError
from pbrl_ppl.physics.physics import Physics
from pbrl_ppl.physics.placement import check_placement
from pbrl_ppl.scene import Scene, nearest
from pbrl_ppl.state import Floats


class Transition:
    """The deterministic f of Eqs. 2 and 7 for a scene of k bodies whose parameters are given.

    Parameters
    ----------
    scene : Scene
        Known geometry.
    parameters : mapping of str to float or ndarray
        What the scene does not know, by name, SI units: one number, or one for each body (or joint)
        that has the parameter, such as ``{"mass": [1.0, 2.0], "mu_c": 0.3, "r": 0.1}``.
    effects : iterable of Effect or Attached
        Effects beside those that the scene declares.
    substeps : int, optional
        Engine steps a sampling interval; the scene's by default.
    threads : int
        Worlds that run side by side.
    check_start : bool
        Whether initial states are refused in which bodies lie deep inside each other or a wall, or
        a hinge's bodies are apart. Off, one may go on from where the engine left bodies pressed
        together.

    Raises
    ------
    ParameterError
        If a parameter is missing, unknown, impossible or not finite; the message names the body.
    EffectError
        If an effect is unknown or does not apply.
    SimulationError
        If substeps or threads are below 1.

    Examples
    --------
    >>> from pbrl_ppl.scene import Body, Shape
    >>> scene = Scene(time_step=0.5, bodies=(Body("puck", Shape.circle(0.2)),))
    >>> f = Transition(scene, {"mass": 2.0, "r": 0.0, "mu_c": 0.0})
    >>> f([0, 0, 0, 1, 0, 0, 0, 4.0, 0, 0]).round(6)  # 1 m/s, pushed by 4 N
    array([0.75, 0.  , 0.  , 2.  , 0.  , 0.  ])
    """

    def __init__(
        self,
        scene: Scene,
        parameters: Mapping[str, object],
        effects: Iterable[Effect | Attached] = (),
        *,
        substeps: int | None = None,
        threads: int = 1,
        check_start: bool = True,
    ) -> None:
        self._physics = Physics.declare(scene, effects, substeps=substeps, threads=threads)
        layout = self._physics.layout
        names = [block.name for block in layout.blocks]
        for name in parameters:
            if name not in names:
                raise ParameterError(
                    f'parameter "{name}" is not among the unknown ones: {", ".join(names)}'
                    f"{nearest(name, names)}"
                )
        self.scene = scene
        self.phi = layout.to_vector(parameters)
        self._check_start = check_start
        # impossible parameters are refused here, not at the first call
        k = len(scene.moving)
        self._physics.predict(self.phi, np.zeros((0, k, 6)), np.zeros((0, 1, k, 3)))

    def __call__(self, state_action: ArrayLike) -> Floats:
        """Eq. 2, ``R^{6k+4} -> R^{6k}``: one body is pushed for one sampling interval.

        Parameters
        ----------
        state_action : array_like
            Shape (..., 6 k + 4): the bodies' states ``x, y, theta, vx, vy, omega`` one after the
            other, then the number of the body that is pushed (0 to k - 1) and its wrench
            ``force_x, force_y, torque``; m, rad, s, N. A kinematic body is pushed by its velocity.

        Returns
        -------
        ndarray
            The bodies' states at the interval's end, shape (..., 6 k); NaN where the engine
            diverged.

        Raises
        ------
        SimulationError
            If the last axis is not 6 k + 4 long, a value is not finite, there is no such body, or
            bodies lie deep inside each other or a wall.
        """
        x = np.asarray(state_action, dtype=float)
        k = len(self.scene.moving)
        if x.ndim == 0 or x.shape[-1] != 6 * k + 4:
            raise SimulationError(
                f"Eq. 2: the input has shape {x.shape}, expected (..., {6 * k + 4}): 6 numbers for"
                f" each of {k} bodies, the number of the one that is pushed, force_x, force_y,"
                " torque"
            )
        flat = x.reshape(-1, 6 * k + 4)
        pushed = flat[:, 6 * k]
        wrong = (pushed != np.floor(pushed)) | (pushed < 0) | (pushed >= k)
        if wrong.any():
            raise SimulationError(
                f"Eq. 2: the body that is pushed is {pushed[wrong][0]:g}, expected a whole number"
                f" from 0 to {k - 1}: {', '.join(body.name for body in self.scene.moving)}"
            )
        wrenches = np.zeros((len(flat), 1, k, 3))
        wrenches[np.arange(len(flat)), 0, pushed.astype(int)] = flat[:, 6 * k + 1 :]
        states = self.predict(flat[:, : 6 * k].reshape(-1, k, 6), wrenches)
        return states.reshape(*x.shape[:-1], 6 * k)

    def predict(self, start: ArrayLike, wrenches: ArrayLike) -> Floats:
        """Eq. 7 with a wrench on every body, for many transitions of H intervals.

        Parameters
        ----------
        start : array_like
            Initial states, shape (transition, body, 6), SI units.
        wrenches : array_like
            Held over each interval, shape (transition, H, body, 3), N and N m. Those of a kinematic
            body are its velocity over the interval (m/s, m/s, rad/s): its path is part of the
            action.

        Returns
        -------
        ndarray
            States after each interval, shape (transition, H, body, 6); NaN where the engine
            diverged.

        Raises
        ------
        SimulationError
            If the shapes do not fit together, a value is not finite, or bodies lie deep inside
            each other or a wall, or a hinge's anchors are apart; the message names the bodies.
        """
        first = np.asarray(start, dtype=float)
        result = self._physics.predict(self.phi, first, np.asarray(wrenches, dtype=float))
        if self._check_start:
            check_placement(self.scene, first)
        return result
