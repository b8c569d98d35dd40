"""Data of a model: a history cut into segments, and the observations along them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

from pbrl_ppl.history import History, Segments
from pbrl_ppl.model.likelihood import Observations
from pbrl_ppl.physics import check_history
from pbrl_ppl.scene import Scene


@dataclass(frozen=True, eq=False)
class Data:
    """A history and how far ahead it is predicted.

    Parameters
    ----------
    scene : Scene
        The declared scene; start states that it does not allow are refused.
    history : History
        Measured transitions.
    horizon : int
        Intervals predicted from one measured state; 1 is the paper's Eq. 11.
    columns : tuple of int, optional
        State dimensions that the likelihood is over; those measured anywhere by default.
    """

    scene: Scene
    history: History
    horizon: int = 1
    columns: tuple[int, ...] | None = None

    def __getstate__(self) -> dict[str, object]:
        """State to pickle: the fields, without what was computed from them."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def segments(self) -> Segments:
        """Measured segments of the horizon's length, their start states checked.

        Raises
        ------
        HistoryError
            If no segment starts from a complete state.
        SimulationError
            If bodies start deep inside each other or a wall, or a hinge's bodies apart.
        """
        segments = self.history.segments(self.horizon)
        check_history(self.scene, self.history, segments)
        return segments

    @cached_property
    def observations(self) -> Observations:
        """Observations at the segments' steps."""
        return Observations.of(self.segments, self.columns)
