"""The one engine argument: a scene, its effects and the engine's settings."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property

from pbrl_ppl.effects import Attached, Effect, attach, needs_inputs
from pbrl_ppl.errors import SimulationError
from pbrl_ppl.history import History, Segments
from pbrl_ppl.parameters import Layout
from pbrl_ppl.physics.coupling import Parts, independent_parts, joined_parts
from pbrl_ppl.physics.parts import OneWorld, PartedSimulator
from pbrl_ppl.physics.simulator import check_engine
from pbrl_ppl.physics.table1 import build_layout
from pbrl_ppl.scene import Scene, motion_time
from pbrl_ppl.state import Floats


@dataclass(frozen=True)
class Physics:
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
        where it does not hold; ``python``: Chipmunk stepped by a plain Python loop. All agree to
        rounding for free bodies. For joined bodies, bodies on friction, and before and after a
        contact, those of Chipmunk have its error of the first order in the step.
    parts : tuple of tuple of str, optional
        Moving bodies grouped into parts that never interact; all in one part by default.
    together : tuple of str
        Bodies that are in one part whatever the history says: in predictions they meet.
    layout : Layout, optional
        Order of the parameters in phi; that of Table 1 for the scene and its effects by default.

    Raises
    ------
    SimulationError
        If substeps or threads are below 1, or the engine is unknown or not available.
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

    scene: Scene
    effects: tuple[Attached, ...] = ()
    substeps: int = None  # type: ignore[assignment]  # filled in below
    threads: int = 1
    extrapolate: bool = True
    tolerance: float = 1e-6
    engine: str = "auto"
    parts: Parts | None = None
    together: tuple[str, ...] = ()
    layout: Layout = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Fill in what the scene and the effects decide."""
        effects = tuple(attached.in_si(self.scene) for attached in self.effects)
        object.__setattr__(self, "effects", effects)
        if self.substeps is None:
            object.__setattr__(self, "substeps", self.scene.substeps)
        if self.layout is None:
            object.__setattr__(self, "layout", build_layout(self.scene, self.effects))
        if self.substeps < 1 or self.threads < 1:
            raise SimulationError(
                f"substeps is {self.substeps} and threads is {self.threads}; both must be at least"
                " 1"
            )
        if not 1e-12 <= self.tolerance <= 1e-2:
            raise SimulationError(f"tolerance is {self.tolerance:g}, expected 1e-12 to 1e-2")
        check_engine(self.engine)

    @classmethod
    def declare(
        cls, scene: Scene, effects: Iterable[Effect | Attached] = (), **settings: object
    ) -> Physics:
        """Return the physics of a scene with the effects that it declares and these.

        ``settings`` are the other fields.

        Raises
        ------
        EffectError
            If an effect is unknown or does not apply.
        """
        return cls(scene, attach(scene, effects), **settings)  # type: ignore[arg-type]

    def __getstate__(self) -> dict[str, object]:
        """Return the state to pickle: the fields, without the engine's worlds."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def simulator(self) -> PartedSimulator:
        """The engine of the likelihood, in which bodies of different parts never meet."""
        return PartedSimulator(self)

    @cached_property
    def one_world(self) -> OneWorld:
        """The engine of predictions, in which bodies of different parts may meet."""
        return OneWorld(self)

    def predict(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Predict the states after each interval; see :meth:`Simulator.__call__`."""
        return self.simulator(phi, start, actions)

    def jacobian(self, phi: Floats, start: Floats, actions: Floats) -> Floats:
        """Return the derivative of the predictions by phi; see :meth:`Simulator.jacobian`."""
        return self.simulator.jacobian(phi, start, actions)

    def inputs(self, segments: Segments) -> Floats:
        """Return what acts in segments, as far as the effects depend on it.

        Shape (transition, H, body, 3), or (transition, H, body, 9) as in
        :data:`pbrl_ppl.state.INPUT`.
        """
        return segments.inputs if needs_inputs(self.effects) else segments.actions

    @cached_property
    def coarse(self) -> Physics:
        """The same with the fewest substeps, for scans, screening and first derivatives.

        There are three levels of substeps: ``coarse``, :attr:`medium` and the engine's own.
        """
        enough = max(4, self._steps_of(0.105))
        return self.changed(substeps=min(enough, self.substeps), extrapolate=False)

    @property
    def medium(self) -> Physics:
        """The same with at most a medium number of substeps: for derivatives and changes."""
        return self.changed(substeps=min(max(10, self.fine_enough), self.substeps))

    @property
    def fine_enough(self) -> int:
        """Substeps that are short enough to begin with.

        Where rows are far apart, dry friction at a turning point shows with short steps alone.
        """
        return self._steps_of(0.021)

    def _steps_of(self, longest: float) -> int:
        """Return the substeps that are no longer than a share of the scene's motion time."""
        return math.ceil(self.scene.time_step / (longest * motion_time(self.scene)))

    def changed(self, **changes: object) -> Physics:
        """Return the same with other fields; itself, with its engines, where they are equal."""
        if not {"scene", "effects"}.isdisjoint(changes):
            changes = {"layout": None, **changes}
        copy = replace(self, **changes)  # type: ignore[arg-type]
        return self if copy == self else copy

    def in_parts(self, history: History | None = None) -> Physics:
        """Return the same with the parts that a history shows to be independent.

        Without one, bodies that are not joined go through each other.
        """
        parts = joined_parts(independent_parts(self.scene, history), self.together)
        return self.changed(parts=parts)

    def part(self, names: tuple[str, ...]) -> Physics:
        """Return the physics of some moving bodies alone."""
        scene = self.scene.subset(names)
        return replace(
            self,
            scene=scene,
            effects=tuple(attached for attached in self.effects if attached.body in names),
            parts=None,
            together=(),
            layout=self.layout.subset((*names, *scene.owners, *scene.joint_names)),
        )
