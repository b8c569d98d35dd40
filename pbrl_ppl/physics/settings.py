"""A scene, its effects and the engine's settings: what every simulation is given."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Self

from pbrl_ppl.effects import Attached, Effect, attach, needs_inputs
from pbrl_ppl.errors import SimulationError
from pbrl_ppl.history import Segments
from pbrl_ppl.parameters import Layout
from pbrl_ppl.physics import calls
from pbrl_ppl.physics.table1 import build_layout
from pbrl_ppl.scene import Scene, motion_time
from pbrl_ppl.state import Floats

Parts = tuple[tuple[str, ...], ...]
#: Engines by name; see :class:`Physics`.
ENGINES = ("auto", "chipmunk", "contact-free")


@dataclass(frozen=True)
class PhysicsSettings:
    """Fields of :class:`Physics`, without its engines."""

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
        if self.engine not in ENGINES:
            raise SimulationError(
                f"engine is {self.engine!r}, expected one of {', '.join(ENGINES)}"
            )
        if not calls.AVAILABLE:
            raise SimulationError(calls.MISSING)

    @classmethod
    def declare(
        cls, scene: Scene, effects: Iterable[Effect | Attached] = (), **settings: object
    ) -> Self:
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

    def inputs(self, segments: Segments) -> Floats:
        """Return what acts in segments, as far as the effects depend on it.

        Shape (transition, H, body, 3), or (transition, H, body, 9) as in
        :data:`pbrl_ppl.state.INPUT`.
        """
        return segments.inputs if needs_inputs(self.effects) else segments.actions

    @cached_property
    def coarse(self) -> Self:
        """The same with the fewest substeps, for scans, screening and first derivatives.

        There are three levels of substeps: ``coarse``, :attr:`medium` and the engine's own.
        """
        enough = max(4, self._steps_of(0.105))
        return self.changed(substeps=min(enough, self.substeps), extrapolate=False)

    @property
    def medium(self) -> Self:
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

    def changed(self, **changes: object) -> Self:
        """Return the same with other fields; itself, with its engines, where they are equal."""
        if not {"scene", "effects"}.isdisjoint(changes):
            changes = {"layout": None, **changes}
        copy = replace(self, **changes)  # type: ignore[arg-type]
        return self if copy == self else copy

    def part(self, names: tuple[str, ...]) -> Self:
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
