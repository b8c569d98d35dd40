"""The noise stage: tails of the noise that depend on the parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from pbrl_ppl.effects import Attached, Noise, at_stage
from pbrl_ppl.physics import Physics
from pbrl_ppl.state import Floats


def tail_places(physics: Physics) -> list[int]:
    """Return the places in phi of the parameters of the noise stage."""
    labels = physics.layout.labels
    return [
        labels.index(label)
        for attached in at_stage(physics.effects, Noise)
        for label in attached.labels
    ]


def degrees_of_freedom(physics: Physics, phi: Floats, nu: float | None) -> Floats:
    """Return the degrees of freedom of each body's noise.

    Parameters
    ----------
    physics : Physics
        Has the effects of the noise stage.
    phi : ndarray
        Parameters, shape (..., p).
    nu : float or None
        Those of the noise without the effects; None for a Gaussian.

    Returns
    -------
    ndarray
        Shape (..., 1, 1, body, 1), to go with (..., transition, H, body, state); infinite for a
        Gaussian.
    """
    labels = physics.layout.labels

    def value(attached: Attached, variable: str) -> Floats:
        return np.asarray(phi[..., labels.index(f"{variable}[{attached.body}]")])

    zero = np.full(phi.shape[:-1], 0.0 if nu is None else 1.0 / nu)
    tails = np.stack(sum_tails(physics, value, zero), axis=-1)[..., None, None, :, None]
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.maximum(tails, 0.0))


def sum_tails(physics: Physics, value: Any, zero: Any) -> list[Any]:
    """Return the sum of the effects' tails of each body; ``value`` gives a parameter."""
    acting = at_stage(physics.effects, Noise)
    result = []
    for body in physics.scene.moving:
        tail = zero
        for attached in acting:
            if attached.body == body.name and isinstance(attached.effect.stage, Noise):
                names = [parameter.name for parameter in attached.effect.parameters]
                values = [value(attached, variable) for variable in attached.variables]
                tail = tail + attached.effect.stage.tail(dict(zip(names, values, strict=True)))
        result.append(tail)
    return result
