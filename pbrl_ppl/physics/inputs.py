"""Inputs of rollouts: their shapes; of intervals the wrench, the one before, and when."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import SimulationError
from pbrl_ppl.parameters import Layout
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import INPUT

Array = NDArray[np.float64]


def after_recording(wrenches: Array, previous: Array) -> Array:
    """Inputs of intervals that begin when the recording has ended.

    Parameters
    ----------
    wrenches, previous : ndarray
        Wrenches of each interval and of the one before, shape (..., 3) each.

    Returns
    -------
    ndarray
        Shape (..., 9), as in :data:`pbrl_ppl.state.INPUT`.
    """
    return np.concatenate([wrenches, previous, np.full_like(wrenches, np.inf)], axis=-1)


def check_shapes(scene: Scene, layout: Layout, phi: Array, start: Array, actions: Array) -> None:
    """Refuse arrays of other shapes than a rollout takes, and what is not finite.

    Parameters
    ----------
    scene, layout : Scene, Layout
        How many bodies there are, and how many parameters.
    phi, start, actions : ndarray
        As in a call of `Simulator`.

    Raises
    ------
    SimulationError
        If the shapes do not fit together, or a start state is not finite.
    """
    k, p = len(scene.moving), layout.size
    if phi.ndim not in (1, 2) or phi.shape[-1] != p:
        raise SimulationError(
            f"phi has shape {phi.shape}, expected ({p},) or (proposal, {p}):"
            f" {', '.join(layout.labels)}"
        )
    own = start.ndim == 4 and phi.ndim == 2 and len(start) == len(phi)
    if not (own or start.ndim == 3) or start.shape[-2:] != (k, 6):
        raise SimulationError(
            f"start has shape {start.shape}, expected (transition, {k}, 6), or with as many"
            " proposals first as phi has, in the order x, y, theta, vx, vy, omega"
        )
    widths = (3, len(INPUT))
    shaped = actions.ndim == 4 and actions.shape[0] == start.shape[-3] and actions.shape[2] == k
    if not shaped or actions.shape[3] not in widths:
        raise SimulationError(
            f"actions have shape {actions.shape}, expected ({start.shape[-3]}, H, {k}, 3)"
            f" in the order force_x, force_y, torque, or {len(INPUT)} in place of 3:"
            f" {', '.join(INPUT)}"
        )
    if not (np.isfinite(start).all() and np.isfinite(actions[..., :6]).all()):
        raise SimulationError("start states and actions must be finite; drop the missing rows")
