"""The physics of a scene: its engines, and predictions of transitions and of recordings.

The engine's loops can be compiled before what needs them, or beside it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from pbrl_ppl.effects import Attached, Effect
from pbrl_ppl.errors import HistoryError, ParameterError, SimulationError
from pbrl_ppl.history import History
from pbrl_ppl.physics import flow
from pbrl_ppl.physics.calls import compile_beside
from pbrl_ppl.physics.parts import OneWorld, PartedSimulator, independent_parts, joined_parts
from pbrl_ppl.physics.settings import PhysicsSettings
from pbrl_ppl.physics.solids import check_history, check_placement
from pbrl_ppl.scene import Body, Joint, Scene, Shape, Wall, nearest
from pbrl_ppl.state import Floats


@dataclass(frozen=True)
class Physics(PhysicsSettings):
    """The deterministic f of Eq. 7: a scene with effects, and the engine's settings.

    Parameters
    ----------
    scene : Scene
        Known geometry.
    effects : tuple of Attached
        All effects of the model; :meth:`declare` adds those that the scene declares.
    substeps : int, optional
        Engine steps a sampling interval; the scene's by default.
    threads : int
        Engine worlds that run side by side. The result does not depend on it.
    extrapolate : bool
        Whether runs with different numbers of substeps are combined to cancel the engine's leading
        errors.
    tolerance : float
        Largest error of a step of joined bodies, and of bodies on friction, which choose their own
        steps: a share of an angle of 1 rad, or of the smallest body's size.
    engine : str
        ``auto``: the contact-free fast path, and Chipmunk for intervals in which bodies come near
        each other; ``chipmunk``: Chipmunk for all; ``contact-free``: the fast path alone, an error
        where it does not hold. All agree to rounding for free bodies. For joined bodies, bodies on
        friction, and before and after a contact, that of Chipmunk has its error of the first order
        in the step.
    parts : tuple of tuple of str, optional
        Moving bodies grouped into parts that never interact; all in one part by default.
    together : tuple of str
        Bodies that are in one part whatever the history says: in predictions they meet.
    layout : Layout, optional
        Order of the parameters in phi; that of Table 1 for the scene and its effects by default.

    Raises
    ------
    SimulationError
        If substeps or threads are below 1, the engine is unknown, or there is none on the platform.
    ParameterError
        If a body's ``prior`` names a parameter that it does not have.

    Examples
    --------
    >>> import numpy as np
    >>> from pbrl_ppl.scene import Body, Shape
    >>> scene = Scene(time_step=0.5, bodies=(Body("puck", Shape.circle(0.2)),))
    >>> physics = Physics(scene)
    >>> physics.layout.labels
    ('mass[puck]', 'r[puck]', 'mu_c[puck]')
    >>> start, force = np.zeros((1, 1, 6)), np.array([[[[4.0, 0.0, 0.0]]]])
    >>> physics.predict(np.array([2.0, 0.1, 0.1]), start, force)[0, 0, 0, 3].round(6)  # v_x, m/s
    np.float64(1.0)
    """

    @cached_property
    def simulator(self) -> PartedSimulator:
        """The engine of the likelihood, in which bodies of different parts never meet."""
        return PartedSimulator(self)

    @cached_property
    def one_world(self) -> OneWorld:
        """The engine of predictions, in which bodies of different parts may meet."""
        return OneWorld(self.simulator)

    def predict(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Predict the states after each interval; see :meth:`Simulator.__call__`."""
        return self.simulator(phi, start, actions)

    def jacobian(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Return the derivative of the predictions by phi; see :meth:`Simulator.jacobian`."""
        return self.simulator.jacobian(phi, start, actions)

    def in_parts(self, history: History | None = None) -> Self:
        """Return the same with the parts that a history shows to be independent.

        Without one, bodies that are not joined go through each other.
        """
        parts = joined_parts(independent_parts(self.scene, history), self.together)
        return self.changed(parts=parts)


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


def simulated_recording(physics: Physics, phi: Floats, recorded: History) -> list[Floats]:
    """Return the states of a recording's trajectories as simulated from their first states.

    Parameters
    ----------
    physics : Physics
        Scene, effects and engine.
    phi : ndarray
        Parameter vectors, shape (draw, p), SI units.
    recorded : History
        Its first complete states and its commands are simulated.

    Returns
    -------
    list of ndarray
        Shape (trajectory, time, body, 6) for each draw, SI units; NaN outside a simulation.

    Raises
    ------
    HistoryError
        If a trajectory has no complete state.
    SimulationError
        If the engine diverges.
    """
    # one segment a trajectory, up to its end
    segments = recorded.segments(int(recorded.dataset["n_rows"].max()) - 1)
    lost = set(range(recorded.n_trajectories)) - set(segments.trajectory.tolist())
    if lost:
        label = recorded.dataset["trajectory"].to_numpy()[min(lost)]
        raise HistoryError(
            f"history: trajectory {label} has no complete state to start from; measure one, drop it"
            " or pass --estimate-velocities"
        )
    check_history(physics.scene, recorded, segments)
    predicted = physics.predict(phi, segments.start, segments.inputs)
    follows = recorded.dataset["kinematic"].to_numpy()
    n_rows = recorded.dataset["n_rows"].to_numpy()
    result = []
    for drawn in predicted:
        states = np.full(recorded.dataset["observed"].shape, np.nan)
        states[:, :, follows] = recorded.dataset["start"].to_numpy()[:, :, follows]
        starts = zip(segments.trajectory, segments.step, strict=True)
        for i, (trajectory, step) in enumerate(starts):
            rows = np.arange(step + 1, n_rows[trajectory])
            after = drawn[i, : len(rows)][:, ~follows]
            if not np.isfinite(after).all():
                raise SimulationError(
                    "simulate: the engine diverged under these parameters; check them and their"
                    " units, or use more substeps in the scene"
                )
            states[np.ix_([trajectory], [step], ~follows)] = segments.start[i][~follows]
            states[np.ix_([trajectory], rows, ~follows)] = after
        result.append(states)
    return result


def compile_loops(names: Iterable[str] = ("single", "joined", "touching")) -> None:
    """Compile these loops: predict one interval by each, of a puck.

    They are for single bodies, for joined ones or bodies on friction, and for contacts.
    """
    scene = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.1)),))
    hinge = Joint("hinge", ("world", "puck"), (0, 0), (0, 0))
    scenes = {
        "single": scene,
        "joined": scene.replace(joints=(hinge,)),
        "touching": scene.replace(walls=(Wall((0.11, -1), (0.11, 1)),)),
    }
    for name in names:
        puck = Transition(scenes[name], {"mass": 1.0, "r": 0.0, "mu_c": 0.0}, check_start=False)
        puck([0, 0, 0, 0.1 * (name == "touching"), 0, 0, 0, 0, 0, 0])


def compile_for_search(scene: Scene) -> None:
    """Compile beside what follows the loop that a scene does not need, but friction on it does."""
    if not scene.joints:
        code = f"from {__name__} import compile_loops; compile_loops(('joined',))"
        compile_beside(flow.rollout_tree, code)
