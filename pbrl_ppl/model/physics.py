"""Physics of a model: a scene's bodies, their effects and the engine's settings."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TypeVar

from pbrl_ppl.effects import Attached
from pbrl_ppl.model.table1 import build_layout
from pbrl_ppl.parameters import Layout
from pbrl_ppl.physics import OneWorld, PartedSimulator, Parts
from pbrl_ppl.scene import Scene

#: Engine steps an interval where a rough answer will do, and how long they are at most (s).
COARSE, LONGEST_COARSE = 4, 0.025
#: Substeps for what an effect changes, and for slopes, which need no more; and how long they are at
#: most (s): where rows are far apart, dry friction at a turning point shows with short steps alone.
ROUGH, LONGEST = 10, 0.005


_Engine = TypeVar("_Engine", PartedSimulator, OneWorld)


@dataclass(frozen=True)
class Physics:
    """Bodies, effects and the engine's settings, with the engine that follows from them.

    Parameters
    ----------
    scene : Scene
        Known geometry.
    effects : tuple of Attached
        All effects of the model, declared and added.
    parts : tuple of tuple of str, optional
        Moving bodies that have to do with each other, together; all in one part without it.
    substeps : int
        Engine steps an interval.
    threads : int
        Engine worlds that run side by side.
    extrapolate : bool
        Whether the engine's leading errors are cancelled.
    together : tuple of str
        Bodies that are in one part whatever the history says: in predictions they met.
    """

    scene: Scene
    effects: tuple[Attached, ...]
    parts: Parts | None
    substeps: int
    threads: int = 1
    extrapolate: bool = True
    together: tuple[str, ...] = ()
    layout: Layout = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "layout", build_layout(self.scene, self.effects))

    def __getstate__(self) -> dict[str, object]:
        """State to pickle, without the engine's worlds."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def simulator(self) -> PartedSimulator:
        """The engine for this scene with these effects."""
        return self._engine(PartedSimulator)

    @cached_property
    def one_world(self) -> OneWorld:
        """The engine for predictions, in which bodies of different parts may meet."""
        return self._engine(OneWorld)

    def _engine(self, kind: type[_Engine]) -> _Engine:
        return kind(
            self.scene,
            self.layout,
            self.effects,
            self.parts,
            substeps=self.substeps,
            threads=self.threads,
            extrapolate=self.extrapolate,
        )

    @cached_property
    def coarse(self) -> Physics:
        """The same with few substeps: it costs little, and its derivative is nearly right."""
        enough = max(COARSE, math.ceil(self.scene.time_step / LONGEST_COARSE))
        return self.changed(substeps=min(enough, self.substeps), extrapolate=False)

    @property
    def rough(self) -> Physics:
        """The same with few substeps where it has more."""
        return self.changed(substeps=min(max(ROUGH, self.fine_enough), self.substeps))

    @property
    def fine_enough(self) -> int:
        """Substeps that are short enough to begin with."""
        return math.ceil(self.scene.time_step / LONGEST)

    def changed(self, **fields: object) -> Physics:
        """The same with other fields; itself, with its worlds, where they are equal."""
        copy = replace(self, **fields)  # type: ignore[arg-type]
        return self if copy == self else copy
