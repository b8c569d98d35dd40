"""Transitions of one body in its own frame, and back in the world's (section 3.1.2, Eq. 6)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.state import THETA, wrapped

Array = NDArray[np.float64]


def inputs(states: Array, wrenches: Array, *, pose_invariant: bool) -> Array:
    """Regression inputs X of Eq. 6, or, with the pose, of Eq. 3.

    Parameters
    ----------
    states : ndarray
        Of one body, shape (n, 6), SI units.
    wrenches : ndarray
        On it, shape (n, 3), world frame, N and N m.
    pose_invariant : bool
        Whether velocity and force are turned into the body's frame and the pose is dropped.

    Returns
    -------
    ndarray
        Velocity and wrench, shape (n, 6), or pose, velocity and wrench, shape (n, 9).

    Examples
    --------
    >>> inputs(np.array([[5.0, 7.0, np.pi / 2, 0.0, 1.0, 0.3]]), np.array([[0.0, 2.0, 0.1]]),
    ...        pose_invariant=True).round(9)
    array([[1. , 0. , 0.3, 2. , 0. , 0.1]])
    """
    if pose_invariant:
        heading = states[:, THETA]
        return np.concatenate([_turned(states[:, 3:], -heading), _turned(wrenches, -heading)], 1)
    out = np.concatenate([states, wrenches], axis=1)
    out[:, THETA] = wrapped(out[:, THETA])
    return out


def displacements(states: Array, after: Array, *, pose_invariant: bool) -> Array:
    """What a transition adds to states (n, 6), in the body's frame or the world's, shape (n, 6).

    Regression on what is added and on the next state give the same answer where the state is among
    the inputs, for both are linear in it.
    """
    added = after - states
    added[:, THETA] = wrapped(added[:, THETA])
    return _both_turned(added, -states[:, THETA]) if pose_invariant else added


def displaced(states: Array, added: Array, *, pose_invariant: bool) -> Array:
    """States (n, 6) after displacements as of :func:`displacements`, in the world's frame."""
    return states + (_both_turned(added, states[:, THETA]) if pose_invariant else added)


def _both_turned(states: Array, angle: Array) -> Array:
    """Pose and velocity (n, 6) turned."""
    return np.concatenate([_turned(states[:, :3], angle), _turned(states[:, 3:], angle)], axis=1)


def _turned(triples: Array, angle: Array) -> Array:
    """A plane vector and what does not turn, (n, 3), turned by angles (n,)."""
    return np.concatenate([turned(triples[:, :2], angle), triples[:, 2:]], axis=1)


def turned(vectors: Array, angle: Array) -> Array:
    """Vectors (..., 2) turned by angles that broadcast with what is before their last axis."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)
