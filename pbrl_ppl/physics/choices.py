"""Worlds that proposals need: the bodies that inferred joints hold, friction, wheels."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.physics.properties import COLUMN, Array, EngineInput, EngineProperties


class Choice(NamedTuple):
    """What worlds of a scene differ in.

    Attributes
    ----------
    joined : tuple of (int, int)
        Which of ``scene.joinable`` each joint of unknown bodies holds.
    slides, rolls : bool
        Whether effects put friction under bodies, and wheels on them.
    """

    joined: tuple[tuple[int, int], ...] = ()
    slides: bool = False
    rolls: bool = False


def choices(own: EngineProperties, given: EngineInput) -> Iterator[tuple[Choice, Any]]:
    """Worlds, and which of the proposals each is for, shape (proposal,).

    Friction under bodies makes a world of its own, for its joints would cost ten times as much as
    all else where the coefficient is zero, as it is when candidates are scored; so do wheels.
    """
    slide = _some(given.bodies[..., list(own.patches), :], "patch_mu")
    roll = _some(given.bodies[..., list(own.wheels), :], "mu_x", "mu_y")
    proposals, joints, _ = given.indices.shape
    keys = np.column_stack([slide, roll, given.indices.reshape(proposals, 2 * joints)])
    found, which = np.unique(keys, axis=0, return_inverse=True)
    for i, (slides, rolls, *pairs) in enumerate(found.astype(int).tolist()):
        joined = tuple(zip(pairs[::2], pairs[1::2], strict=True))
        yield Choice(joined, bool(slides), bool(rolls)), which.ravel() == i


def _some(bodies: Array, *columns: str) -> NDArray[np.bool_]:
    """Whether any of the bodies has any of these numbers, shape (proposal,)."""
    return np.asarray((bodies[..., [COLUMN[name] for name in columns]] > 0).any(axis=(1, 2, 3)))
