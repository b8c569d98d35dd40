"""Dry friction of a body on the floor, the same in every direction."""

from typing import Any

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Properties
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene

#: Radii that are tried, as shares of the body's: of even pressure under a disc, and others.
_RADII = (2.0 / 3.0, 0.2, 0.4, 1.0)


def _modify(properties: Any, parameters: Any, clock: Any) -> None:
    # the engine solves it together with contacts, so sticking is exact
    properties["patch_mu"] = properties["patch_mu"] + parameters["mu"]
    properties["patch_radius"] = properties["patch_radius"] + parameters["radius"]


def _scan(scene: Scene, history: History, body: Body) -> Any:
    """Radii, of a body that turns; friction is differentiated where there is next to none.

    More of it would hold the body still now and then, which is no derivative of anything.
    """
    theta = history.dataset["start"].sel(body=body.name, state="theta").to_numpy()
    shares = _RADII if np.nanmax(theta) > np.nanmin(theta) else _RADII[:1]
    return np.array([(np.nan, share * body.shape.bounding_radius) for share in shares])


def _is_pressed(scene: Scene, body: Body) -> bool:
    return scene.normal_gravity > 0


sliding_friction = Effect(
    "sliding_friction",
    (
        EffectParameter("mu", "1", Prior("half_normal", sigma=0.5)),
        EffectParameter("radius", "m", Prior("log_normal", mu=-2.0, sigma=1.0), null=0.1),
    ),
    "dry friction on the floor: a steady force and torque against any sliding and turning, which"
    " can also hold the body still",
    "Coulomb's law on a ring of contact (Goyal, Ruina and Papadopoulos, Wear 143, 1991)",
    Properties(_modify),
    applies=_is_pressed,
    scan=_scan,
)
