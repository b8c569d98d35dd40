"""Data of a model: segments of a history and their observations."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, Segments
from pbrl_ppl.likelihood.observations import Observations
from pbrl_ppl.physics import check_history
from pbrl_ppl.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Data:
    """A history and the horizon of its predictions.

    Parameters
    ----------
    scene : Scene
        The declared scene; start states that it does not allow are refused.
    history : History
        Measured transitions.
    horizon : int
        Intervals predicted from one measured state; 1 is the paper's Eq. 11.
    columns : tuple of int, optional
        Observed state dimensions; those measured anywhere by default.
    states : ndarray, optional
        Smoothed states, shape (trajectory, time, body, 6), SI units, which take the measured ones'
        place; see :func:`pbrl_ppl.model.along_trajectories`.
    """

    scene: Scene
    history: History
    horizon: int = 1
    columns: tuple[int, ...] | None = None
    states: Array | None = None

    def __getstate__(self) -> dict[str, object]:
        """Return the fields to pickle, without computed values."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def segments(self) -> Segments:
        """Measured segments of the horizon's length, with checked start states.

        Raises
        ------
        HistoryError
            If no segment starts from a complete state.
        SimulationError
            If bodies start deep inside each other or a wall, or a hinge's bodies apart.
        """
        if self.states is not None:
            return self.history.transitions(self.states)
        segments = self.history.segments(self.horizon)
        check_history(self.scene, self.history, segments)
        return segments

    @property
    def smoothed_states(self) -> Array:
        """Smoothed states, shape (trajectory, time, body, 6).

        Raises
        ------
        HistoryError
            If there are none.
        """
        if self.states is None:
            raise HistoryError("history: its states are as measured; expected smoothed ones")
        return self.states

    @cached_property
    def observations(self) -> Observations:
        """Observations at the segments' steps."""
        return Observations.of(self.segments, self.columns)
