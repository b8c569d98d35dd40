"""The noise stage: tails of the noise that depend on the parameters."""

from __future__ import annotations

import numpy as np

from pbrl_ppl.effects import Noise, at_stage
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
    tails = np.zeros((*phi.shape[:-1], 1, 1, len(physics.scene.moving), 1))
    tails += 0.0 if nu is None else 1.0 / nu
    for i, body in enumerate(physics.scene.moving):
        for attached in at_stage(physics.effects, Noise):
            if attached.body == body.name and isinstance(attached.effect.stage, Noise):
                values = (phi[..., labels.index(label)] for label in attached.labels)
                names = (parameter.name for parameter in attached.effect.parameters)
                inverse = attached.effect.stage.tail(dict(zip(names, values, strict=True)))
                tails[..., 0, 0, i, 0] += inverse
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / np.maximum(tails, 0.0))
