"""Friction in joints, on the floor and of wheels; the engine solves it together with contacts."""

import math
from dataclasses import replace
from itertools import product

import numpy as np

from pbrl_ppl.effects.effect import (
    ANY_ANGLE,
    SIGNED,
    SIZE,
    Effect,
    EffectParameter,
    Force,
    Friction,
    With,
    adding,
    body_points,
    is_pivoted,
    is_sliding,
    is_unpivoted,
    measured,
)
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene
from pbrl_ppl.state import Floats

_FRICTION = Prior("half_normal", sigma=0.5)
#: Speeds of turning and of sliding at which Stribeck's curve falls.
_SLOW = Prior("log_normal", mu=-1.5, sigma=1.0)
_TURN_RATE = EffectParameter("speed", "rad/s", _SLOW, null=0.2, scale="turn_rate")
_SPEED = EffectParameter("speed", "m/s", _SLOW, null=0.2, scale="speed")


def _scan_speeds(scene: Scene, history: History, body: Body, columns: tuple[str, ...]) -> Floats:
    """Return two speeds below the body's usual ones; the derivative is taken by the friction."""
    speed = np.linalg.norm(measured(history, body, *columns), axis=-1)
    speed = speed[speed > 0.0]
    speeds = np.quantile(speed, [0.15, 0.45]) if len(speed) else ()
    return np.array([(np.nan, speed) for speed in speeds]).reshape(-1, 2)


_SCAN_TURN_RATES = With(_scan_speeds, ("omega",))
_SCAN_SPEEDS = With(_scan_speeds, ("vx", "vy"))


pivot_damping = Effect(
    "pivot_damping",
    (EffectParameter("coefficient", "N m s", SIZE, scale="torque/turn_rate"),),
    "viscous friction in the hinge: a torque against the rotation that grows with its speed",
    "viscous torque on the relative angular velocity, tau = -c omega",
    adding(pivot_damping="coefficient"),
    applies=is_pivoted,
)


pivot_friction = Effect(
    "pivot_friction",
    (EffectParameter("torque", "N m", SIZE, scale="torque"),),
    "dry friction in the hinge: a steady torque against the rotation that can also hold it still",
    "Coulomb's law of friction",
    adding(pivot_torque="torque"),
    applies=is_pivoted,
    family="dry friction",
)


slider_damping = Effect(
    "slider_damping",
    (EffectParameter("coefficient", "N s/m", SIZE, scale="force/speed"),),
    "viscous friction in the slider: a force against the sliding that grows with its speed",
    "viscous force on the relative velocity along the axis, F = -c v",
    adding(pivot_damping="coefficient"),
    applies=is_sliding,
)


slider_friction = Effect(
    "slider_friction",
    (EffectParameter("force", "N", SIZE, scale="force"),),
    "dry friction in the slider: a steady force against the sliding that can also hold it still",
    "Coulomb's law of friction",
    adding(pivot_torque="force"),
    applies=is_sliding,
    family="dry friction",
)


def _fall_with_speed(state: Floats, load: Floats, parameters: Floats, most: Floats) -> None:
    most[0] += parameters[0] * math.exp(-((load[2] / parameters[1]) ** 2))


pivot_stribeck = Effect(
    "pivot_stribeck",
    (EffectParameter("torque", "N m", SIZE, scale="torque"), _TURN_RATE),
    "dry friction in the hinge that is stronger near standstill than in motion: it sticks, then"
    " slips",
    "Stribeck's curve, tau = tau_s exp(-(omega/omega_s)^2) beside Coulomb's",
    Friction(_fall_with_speed),
    applies=is_pivoted,
    scan=_SCAN_TURN_RATES,
    log_odds=-2.0,
    family="dry friction",
    unusual="few recordings are slow and clean enough to show it beside dry friction",
)


def _grow_with_load(state: Floats, load: Floats, parameters: Floats, most: Floats) -> None:
    most[0] += parameters[0] * abs(load[0]) + parameters[1] * abs(load[1])


pivot_load_friction = Effect(
    "pivot_load_friction",
    (EffectParameter("motor", "1", SIZE), EffectParameter("load", "1", SIZE)),
    "dry friction in the hinge that grows with the torque of the motor and of the load: gears that"
    " press harder rub harder",
    "load-dependent friction, tau = a |motor| + b |load| (M. Duclusaud et al., arXiv 2410.08650)",
    Friction(_grow_with_load),
    applies=is_pivoted,
    log_odds=-1.0,
    family="dry friction",
)


def _bend(state: Floats, command: Floats, parameters: Floats, change: Floats) -> None:
    most = parameters[1] * (1.0 + parameters[2] * math.exp(-((state[5] / parameters[3]) ** 2)))
    bend = min(max(command[12], -most), most)  # steps that are too long go beyond
    change[0] = state[5] - abs(state[5]) * bend / most


def _hold_back(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    most = parameters[1] * (1.0 + parameters[2])
    wrench[2] -= parameters[0] * min(max(command[12], -most), most) / parameters[1]


def _begin_bent(state: Floats, command: Floats, parameters: Floats, memory: Floats) -> None:
    # as in steady motion
    memory[0] = math.copysign(parameters[1], state[5]) if state[5] != 0.0 else 0.0


def _scan_bends(scene: Scene, history: History, body: Body) -> Floats:
    """Return angles of bending without and with a rise; the derivative is taken by the torque."""
    slowest = _SCAN_TURN_RATES(scene, history, body)[:1, 1]
    grid = [(np.nan, *shape) for shape in product((0.01, 0.05), (0.0, 0.5), slowest)]
    return np.array(grid).reshape(-1, 4)


pivot_hysteresis = Effect(
    "pivot_hysteresis",
    (
        EffectParameter("torque", "N m", SIZE, scale="torque"),
        EffectParameter("angle", "rad", Prior("log_normal", mu=-4.0, sigma=1.0), null=0.02),
        EffectParameter("rise", "1", SIZE),
        _TURN_RATE,
    ),
    "dry friction in the hinge that bends before it slips: after a turn it builds up over an angle,"
    " and it may be stronger near standstill by a share",
    "LuGre friction (C. Canudas de Wit et al., IEEE Transactions on Automatic Control 40, 1995)",
    Force(_hold_back, memory=1, rate=_bend, begin=_begin_bent),
    applies=is_pivoted,
    scan=_scan_bends,
    log_odds=-3.0,
    family="dry friction",
    unusual="four numbers that take any misfit beside dry friction",
)


def _lies_free(scene: Scene, body: Body) -> bool:
    return scene.normal_gravity > 0 and is_unpivoted(scene, body)


turning_friction = Effect(
    "turning_friction",
    (EffectParameter("torque", "N m", SIZE, scale="torque"),),
    "dry friction against turning alone: a steady torque that can also hold it, and that sliding"
    " does not weaken",
    "Coulomb's law for the torque at a single foot",
    adding(turn_torque="torque"),
    applies=_lies_free,
    log_odds=-1.0,
)


def _is_pressed(scene: Scene, body: Body) -> bool:
    return scene.normal_gravity > 0


def _scan_radii(scene: Scene, history: History, body: Body) -> Floats:
    """Return radii to try, several if the body turns; the derivative is taken at zero friction.

    More friction would hold the body still now and then, where the derivative is meaningless.
    """
    shares = [2.0 / 3.0]  # even pressure under a disc
    if len(np.unique(measured(history, body, "theta"))) > 1:
        shares += [0.2, 0.4, 1.0]
    return np.array([(np.nan, share * body.shape.bounding_radius) for share in shares])


sliding_friction = Effect(
    "sliding_friction",
    (
        EffectParameter("mu", "1", _FRICTION),
        EffectParameter("radius", "m", _SLOW, null=0.2, scale="length"),
    ),
    "dry friction on the floor: a steady force and torque against any sliding and turning, which"
    " can also hold the body still",
    "Coulomb's law on a ring of contact (Goyal, Ruina and Papadopoulos, Wear 143, 1991)",
    adding(patch_mu="mu", patch_radius="radius"),
    applies=_is_pressed,
    scan=_scan_radii,
)


def _fall_by_share(state: Floats, load: Floats, parameters: Floats, most: Floats) -> None:
    most[0] *= 1.0 + parameters[0] * math.exp(-((load[2] / parameters[1]) ** 2))


sliding_stribeck = Effect(
    "sliding_stribeck",
    (EffectParameter("share", "1", SIZE), _SPEED),
    "dry friction on the floor that is stronger near standstill than in motion, by this share",
    "Stribeck's curve, mu (1 + a exp(-(v/v_s)^2))",
    Friction(_fall_by_share, under=True),
    applies=_is_pressed,
    scan=_SCAN_SPEEDS,
    log_odds=-2.0,
    unusual="few recordings are slow and clean enough to show it beside dry friction",
)


slider_stribeck = replace(
    pivot_stribeck,
    name="slider_stribeck",
    parameters=(EffectParameter("force", "N", SIZE, scale="force"), _SPEED),
    sentence="dry friction in the slider that is stronger near standstill than in motion: it"
    " sticks, then slips",
    reference="Stribeck's curve, F = F_s exp(-(v/v_s)^2) beside Coulomb's",
    applies=is_sliding,
    scan=_SCAN_SPEEDS,
)


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
        *EffectParameter.each("w_x", "w_y", unit="m", prior=SIGNED, scale="length"),
        EffectParameter("w_theta", "rad", ANY_ANGLE),
        *EffectParameter.each("mu_x", "mu_y", unit="1", prior=_FRICTION),
    ),
    "a wheel or a runner that the scene does not declare: dry friction at a point of the body,"
    " of one strength along it and another across",
    "anisotropic Coulomb friction, J_w of Scholz et al., ICML 2014, section 3.2",
    adding(w_x="w_x", w_y="w_y", w_theta="w_theta", mu_x="mu_x", mu_y="mu_y"),
    applies=_lacks_wheel,
    scan=_scan_wheels,
    log_odds=-2.0,
    unusual="wheels are seen, and declared",
)
