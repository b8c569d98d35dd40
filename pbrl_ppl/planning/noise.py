"""Eq. 13's noise under posterior draws: what a plan must expect of a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.likelihood import Cells, Problem, TrajectoryLikelihood, next_state_random

Array = NDArray[np.float64]


class StepNoise(Protocol):
    """Noise that a step adds to states, one distribution a posterior draw."""

    def add(self, states: Array, rng: np.random.Generator) -> Array:
        """States (draw, n, body, 6) with noise."""

    def single(self, draw: int) -> StepNoise:
        """The noise of one draw."""


@dataclass(frozen=True, eq=False)
class StateNoise:
    """Noise of each state dimension, as of Eq. 11.

    Parameters
    ----------
    sigma : ndarray
        Shape (draw, state).
    columns : tuple of int
        State dimensions that it is of.
    nu : float, ndarray or None
        Degrees of freedom, shape (draw, 1, 1, body, 1) where they are inferred.
    """

    sigma: Array
    columns: tuple[int, ...]
    nu: float | Array | None

    def add(self, states: Array, rng: np.random.Generator) -> Array:
        """States (draw, n, body, 6) with noise."""
        out, columns = states.copy(), self.columns
        for i, scale in enumerate(self.sigma):
            own = self.nu[i][0] if isinstance(self.nu, np.ndarray) else self.nu
            drawn = next_state_random(states[i][..., columns], scale, rng, nu=own)
            out[i][..., columns] = drawn
        return out

    def single(self, draw: int) -> StateNoise:
        """The noise of one draw."""
        one = slice(draw, draw + 1)
        nu = self.nu[one] if isinstance(self.nu, np.ndarray) else self.nu
        return StateNoise(self.sigma[one], self.columns, nu)


@dataclass(frozen=True, eq=False)
class AccelerationNoise:
    """Unexplained acceleration, held over an interval; errors of measuring disturb no body.

    Parameters
    ----------
    sigma : ndarray
        Noise parameters, shape (draw, parameter), m/s^2 and rad/s^2 where they are accelerations.
    cells : Cells
        What they move.
    """

    sigma: Array
    cells: Cells

    def add(self, states: Array, rng: np.random.Generator) -> Array:
        """States (draw, n, body, 6) with noise."""
        out = np.ascontiguousarray(states).copy()
        # what a contact adds is left out: it is not foreseen
        apart = np.zeros(states.shape[:2], dtype=bool)
        flat = out.reshape(*apart.shape, -1)
        flat[..., self.cells.places] += self.cells.pushes(self.sigma[:, None], apart, rng)
        return out

    def single(self, draw: int) -> AccelerationNoise:
        """The noise of one draw."""
        return AccelerationNoise(self.sigma[draw : draw + 1], self.cells)


def step_noise(problem: Problem, phi: Array, sigma: Array) -> StepNoise:
    """Noise of a step under draws of phi (draw, p) and noise parameters (draw, parameter)."""
    if isinstance(problem.likelihood, TrajectoryLikelihood):
        return AccelerationNoise(sigma, problem.trajectory_noise.cells)
    return StateNoise(sigma, problem.observations.columns, problem.nu(phi))
