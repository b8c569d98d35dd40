"""Data of a model: segments of a history and their measured next states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, Segments
from pbrl_ppl.physics import check_history
from pbrl_ppl.scene import Scene, state_sizes
from pbrl_ppl.state import STATE, THETA, Bools, Floats, wrapped

#: Standard deviation of the logarithm of noise under its log-normal priors.
SPREAD = 2.0


@dataclass(frozen=True)
class Observations:
    """Measured next states of segments.

    Parameters
    ----------
    values : ndarray
        Shape (transition, H, body, state), NaN where missing.
    columns : tuple of int
        Which of the six state dimensions the last axis holds.
    """

    values: Floats
    columns: tuple[int, ...]

    @classmethod
    def of(cls, segments: Segments, columns: tuple[int, ...] | None = None) -> Observations:
        """Return the observations of segments, of all measured or these dimensions.

        Raises
        ------
        HistoryError
            If nothing was measured.
        """
        observed = segments.observed
        measured = tuple(
            d for d in range(len(STATE)) if observed.size and np.isfinite(observed[..., d]).any()
        )
        if not measured:
            raise HistoryError(
                "history: it has no measured next state within"
                f" {segments.horizon} interval{'s' * (segments.horizon > 1)} of a complete state;"
                " use a longer horizon, or record more"
            )
        columns = measured if columns is None else columns
        return cls(observed[..., columns], columns)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the measured dimensions."""
        return tuple(STATE[d] for d in self.columns)

    @property
    def measured(self) -> Bools:
        """Mask of measured values, shape as ``values``."""
        return np.isfinite(self.values)

    def wrapped(self, difference: Floats) -> Floats:
        """Wrap the angles of state differences (..., state) to (-pi, pi], in place."""
        for i, d in enumerate(self.columns):
            if d == THETA:
                difference[..., i] = wrapped(difference[..., i])
        return difference

    def residual(self, predicted: Floats) -> Floats:
        """Return measured minus predicted states, angles wrapped, 0 where missing.

        Parameters
        ----------
        predicted : ndarray
            Shape (..., transition, H, body, 6).

        Returns
        -------
        ndarray
            Shape (..., transition, H, body, state).
        """
        difference = self.wrapped(self.values - predicted[..., self.columns])
        difference[..., ~self.measured] = 0.0
        return np.asarray(difference)

    def root_mean_square(self, residual: Floats) -> Floats:
        """Return that of a residual (transition, H, body, state) by dimension, shape (state,)."""
        count = np.maximum(self.measured.sum((0, 1, 2)), 1)
        return np.asarray(np.sqrt((residual**2).sum((0, 1, 2)) / count))


def least_noise(scene: Scene, columns: Sequence[int], *, share: float = 1e-9) -> Floats:
    """Return the least noise of state dimensions, shape (column,).

    ``share``: share of a dimension's typical size, for recordings without any noise.
    """
    return np.asarray(share * state_sizes(scene)[list(columns)])


def estimate_sigma(residual: Floats, observations: Observations, scene: Scene) -> Floats:
    """Return the maximum-likelihood sigma of each dimension under Eq. 11, shape (state,).

    Parameters
    ----------
    residual : ndarray
        Shape (transition, H, body, state).
    observations : Observations
        What was measured.
    scene : Scene
        Its sizes give a scale to histories without noise.
    """
    least = least_noise(scene, observations.columns)
    return np.maximum(observations.root_mean_square(residual), least)


@dataclass(frozen=True, eq=False)
class Data:
    """A history and the horizon of its predictions.

    Parameters
    ----------
    scene : Scene
        The declared scene; initial states that it does not allow are refused.
    history : History
        Measured transitions.
    horizon : int
        Intervals predicted from one measured state; 1 is the paper's Eq. 11.
    columns : tuple of int, optional
        Observed state dimensions; those measured anywhere by default.
    states : ndarray, optional
        Smoothed states, shape (trajectory, time, body, 6), SI units, which take the measured ones'
        place; see :func:`pbrl_ppl.model.along_trajectories`. With a longer horizon, pieces are
        simulated from them; see :func:`pbrl_ppl.likelihood.in_pieces`.
    breaks : ndarray of bool, optional
        Intervals that no piece goes through, shape (trajectory, interval).
    """

    scene: Scene
    history: History
    horizon: int = 1
    columns: tuple[int, ...] | None = None
    states: Floats | None = None
    breaks: Bools | None = None

    def __getstate__(self) -> dict[str, object]:
        """Return the fields to pickle, without computed values."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def segments(self) -> Segments:
        """Measured segments of the horizon's length, with checked initial states.

        Raises
        ------
        HistoryError
            If no segment starts from a complete state.
        SimulationError
            If bodies start deep inside each other or a wall, or a hinge's bodies apart.
        """
        if self.states is not None and self.horizon > 1:
            return self.history.pieces(self.states, self.horizon, self.breaks)
        if self.states is not None:
            return self.history.transitions(self.states)
        segments = self.history.segments(self.horizon)
        check_history(self.scene, self.history, segments)
        return segments

    @property
    def smoothed_states(self) -> Floats:
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
