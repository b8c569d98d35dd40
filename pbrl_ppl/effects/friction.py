"""Friction in joints, on the floor and of wheels; the engine solves it together with contacts."""

from itertools import product

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter, body_points, is_pivoted, is_sliding
from pbrl_ppl.effects.stages import Clock, Properties, Values
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene
from pbrl_ppl.state import Floats

_FRICTION = Prior("half_normal", sigma=0.5)


def _add_pivot_damping(properties: dict[str, Floats], parameters: Values, clock: Clock) -> None:
    properties["pivot_damping"] = properties["pivot_damping"] + parameters["coefficient"]


pivot_damping = Effect(
    "pivot_damping",
    (
        EffectParameter(
            "coefficient", "N m s", Prior("half_normal", sigma=1.0), scale="torque/turn_rate"
        ),
    ),
    "viscous friction in the hinge: a torque against the rotation that grows with its speed",
    "viscous torque on the relative angular velocity, tau = -c omega",
    Properties(_add_pivot_damping),
    applies=is_pivoted,
)


def _add_pivot_torque(properties: dict[str, Floats], parameters: Values, clock: Clock) -> None:
    properties["pivot_torque"] = properties["pivot_torque"] + parameters["torque"]


pivot_friction = Effect(
    "pivot_friction",
    (EffectParameter("torque", "N m", Prior("half_normal", sigma=1.0), scale="torque"),),
    "dry friction in the hinge: a steady torque against the rotation that can also hold it still",
    "Coulomb's law of friction",
    Properties(_add_pivot_torque),
    applies=is_pivoted,
)


slider_damping = Effect(
    "slider_damping",
    (
        EffectParameter(
            "coefficient", "N s/m", Prior("half_normal", sigma=1.0), scale="force/speed"
        ),
    ),
    "viscous friction in the slider: a force against the sliding that grows with its speed",
    "viscous force on the relative velocity along the axis, F = -c v",
    Properties(_add_pivot_damping),
    applies=is_sliding,
)


def _add_slider_force(properties: dict[str, Floats], parameters: Values, clock: Clock) -> None:
    properties["pivot_torque"] = properties["pivot_torque"] + parameters["force"]


slider_friction = Effect(
    "slider_friction",
    (EffectParameter("force", "N", Prior("half_normal", sigma=1.0), scale="force"),),
    "dry friction in the slider: a steady force against the sliding that can also hold it still",
    "Coulomb's law of friction",
    Properties(_add_slider_force),
    applies=is_sliding,
)


def _add_patch(properties: dict[str, Floats], parameters: Values, clock: Clock) -> None:
    properties["patch_mu"] = properties["patch_mu"] + parameters["mu"]
    properties["patch_radius"] = properties["patch_radius"] + parameters["radius"]


def _is_pressed(scene: Scene, body: Body) -> bool:
    return scene.normal_gravity > 0


def _scan_radii(scene: Scene, history: History, body: Body) -> Floats:
    """Return radii to try, several if the body turns; the derivative is taken at zero friction.

    More friction would hold the body still now and then, where the derivative is meaningless.
    """
    theta = history.dataset["start"].sel(body=body.name, state="theta").to_numpy()
    shares = [2.0 / 3.0]  # even pressure under a disc
    if np.nanmax(theta) > np.nanmin(theta):
        shares += [0.2, 0.4, 1.0]
    return np.array([(np.nan, share * body.shape.bounding_radius) for share in shares])


sliding_friction = Effect(
    "sliding_friction",
    (
        EffectParameter("mu", "1", _FRICTION),
        EffectParameter(
            "radius", "m", Prior("log_normal", mu=-1.5, sigma=1.0), null=0.2, scale="length"
        ),
    ),
    "dry friction on the floor: a steady force and torque against any sliding and turning, which"
    " can also hold the body still",
    "Coulomb's law on a ring of contact (Goyal, Ruina and Papadopoulos, Wear 143, 1991)",
    Properties(_add_patch),
    applies=_is_pressed,
    scan=_scan_radii,
)


def _add_wheel(properties: dict[str, Floats], parameters: Values, clock: Clock) -> None:
    for name in ("w_x", "w_y", "w_theta", "mu_x", "mu_y"):
        properties[name] = properties[name] + parameters[name]


def _lacks_wheel(scene: Scene, body: Body) -> bool:
    return scene.normal_gravity > 0 and not body.wheel


def _scan_wheels(scene: Scene, history: History, body: Body, *, n_turns: int = 3) -> Floats:
    """Return places and directions to try; the derivative is taken by both frictions.

    ``n_turns``: directions of a wheel, over a right angle.
    """
    turns = np.arange(n_turns) * (0.5 * np.pi / n_turns)
    grid = product(body_points(body), turns)
    return np.array([(*place, turn, np.nan, np.nan) for place, turn in grid])


wheel = Effect(
    "wheel",
    (
        EffectParameter("w_x", "m", Prior("normal", sigma=1.0), scale="length"),
        EffectParameter("w_y", "m", Prior("normal", sigma=1.0), scale="length"),
        EffectParameter("w_theta", "rad", Prior("von_mises", mu=0.0, kappa=0.0)),
        EffectParameter("mu_x", "1", _FRICTION),
        EffectParameter("mu_y", "1", _FRICTION),
    ),
    "a wheel or a runner that the scene does not declare: dry friction at a point of the body,"
    " of one strength along it and another across",
    "anisotropic Coulomb friction, J_w of Scholz et al., ICML 2014, section 3.2",
    Properties(_add_wheel),
    applies=_lacks_wheel,
    scan=_scan_wheels,
    log_odds=-2.0,
)
