"""Linear torsion spring to an angle."""

import math
from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Force
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene
from pbrl_ppl.state import wrapped

_LOOKS = 8


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    # the shorter way round: a logged angle has no number of turns
    off = state[2] - parameters[1]
    off -= 2.0 * math.pi * math.floor((off + math.pi) / (2.0 * math.pi))
    wrench[2] -= parameters[0] * off


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """Angles of rest opposite to which the body does not go; the stiffness is differentiated.

    There the torque would jump, and such a saw-tooth fits whatever is missing. A body that goes all
    around has none of these, and all angles are tried.
    """
    angles = np.linspace(-np.pi, np.pi, _LOOKS, endpoint=False)
    theta = history.dataset["start"].sel(body=body.name, state="theta").to_numpy().ravel()
    off = np.abs(wrapped(theta[np.isfinite(theta), None] - angles))
    smooth = off.max(axis=0, initial=0.0) < np.pi - np.pi / _LOOKS
    return np.array([(np.nan, angle) for angle in (angles[smooth] if smooth.any() else angles)])


torsion_spring = Effect(
    "torsion_spring",
    (
        EffectParameter("stiffness", "N m/rad", Prior("half_normal", sigma=5.0)),
        EffectParameter("angle", "rad", Prior("von_mises", mu=0.0, kappa=0.0)),
    ),
    "a torque towards an angle that grows with the way from it: a twisted cable or a bent hinge",
    "Hooke's law of torsion",
    Force(_law),
    scan=_scan,
)
