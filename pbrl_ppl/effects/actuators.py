"""Actuators: gains, rotation, delay, dead zone, cut-off and saturation of the command."""

import math

import numpy as np

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Command
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene
from pbrl_ppl.state import Floats

_GAIN = Prior("log_normal", mu=0.0, sigma=0.5)
_THRESHOLD = EffectParameter("threshold", "N", Prior("half_normal", sigma=0.5), scale="force")
#: Force levels that a scan tries.
_LEVELS = 20
#: No actuator reaches this force, in typical forces.
_UNREACHED = 1e9


def _rotate(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    c, s = math.cos(parameters[0]), math.sin(parameters[0])
    x = wrench[0]
    wrench[0] = c * x - s * wrench[1]
    wrench[1] = s * x + c * wrench[1]


actuator_rotation = Effect(
    "actuator_rotation",
    (EffectParameter("angle", "rad", Prior("normal", sigma=0.5)),),
    "the push points in another direction than commanded: the actuator is mounted askew",
    "rotation of a vector in the plane",
    Command(_rotate),
)


def _turn_with_body(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    c, s = math.cos(state[2]), math.sin(state[2])
    x = wrench[0]
    wrench[0] = c * x - s * wrench[1]
    wrench[1] = s * x + c * wrench[1]


#: Of scenes whose recording gives forces along the bodies' own axes; no law to be found.
body_frame = Effect(
    "body_frame",
    (),
    "pushes are given along the body's own axes and turn with it",
    "rotation of a vector in the plane",
    Command(_turn_with_body),
)


def _scale_force(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[0] *= parameters[0]
    wrench[1] *= parameters[0]


force_gain = Effect(
    "force_gain",
    (EffectParameter("factor", "1", _GAIN, null=1.0),),
    "every push is stronger or weaker than commanded by the same factor: the actuator's scale is"
    " off",
    "gain of an actuator",
    Command(_scale_force),
)


def _scale_torque(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[2] *= parameters[0]


torque_gain = Effect(
    "torque_gain",
    (EffectParameter("factor", "1", _GAIN, null=1.0),),
    "every torque is stronger or weaker than commanded by the same factor: the motor's scale is"
    " off",
    "gain of an actuator",
    Command(_scale_torque),
)


def _scale_axes(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[0] *= parameters[0]
    wrench[1] *= parameters[1]


anisotropic_gain = Effect(
    "anisotropic_gain",
    (EffectParameter("x", "1", _GAIN, null=1.0), EffectParameter("y", "1", _GAIN, null=1.0)),
    "pushes along one axis of the room are stronger or weaker than along the other: one of two"
    " actuators is off",
    "gains of two actuators at right angles",
    Command(_scale_axes),
)


def _delay(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    # a delay that ends inside a substep is blended: the likelihood stays smooth in it
    begin, end = command[6], command[7]
    late = min(1.0, max(0.0, (parameters[0] - begin) / (end - begin)))
    for i in range(3):
        wrench[i] = late * command[3 + i] + (1.0 - late) * wrench[i]


_SHARE = Prior("truncated_normal", mu=0.0, sigma=0.5, lower=0.0, upper=1.0)

actuator_delay = Effect(
    "actuator_delay",
    (EffectParameter("share", "1", _SHARE),),
    "the push arrives late, by this share of the sampling interval (actuator_delay), or what is"
    " measured does (sensor_delay); with one clock in the log the two are the same data",
    "pure time delay of a held input, u(t - share dt)",
    Command(_delay, memory=True),
)


def _force_levels(history: History, body: Body, most: int) -> Floats:
    """Return at most so many forces between the sizes of those commanded, shape (level, 1), N."""
    action = history.dataset["action"].sel(body=body.name).to_numpy()[..., :2]
    size = np.linalg.norm(action, axis=-1)
    size = size[size > 0]  # not NaN either
    _, first = np.unique(np.round(size / size.max(initial=0.0), 9), return_index=True)
    size = size[first]
    if len(size) > most + 1:
        size = np.unique(np.quantile(size, np.linspace(0, 1, most + 1)))
    return np.asarray(0.5 * (size[1:] + size[:-1]))[:, None]


def _subtract_threshold(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    size = math.hypot(wrench[0], wrench[1])
    share = 1.0 - parameters[0] / size if size > parameters[0] else 0.0
    wrench[0] *= share
    wrench[1] *= share


def _scan_dead_zones(scene: Scene, history: History, body: Body) -> Floats:
    """Return the null value, where the derivative is taken, and thresholds to try."""
    return np.vstack([[[np.nan]], _force_levels(history, body, _LEVELS)])


dead_zone = Effect(
    "dead_zone",
    (_THRESHOLD,),
    "only what exceeds a threshold of the push acts: the actuator has play or friction",
    "dead zone of an actuator (G. Tao and P. V. Kokotovic, 1994)",
    Command(_subtract_threshold),
    scan=_scan_dead_zones,
    log_odds=-2.0,
)


def _cut_off(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    if math.hypot(wrench[0], wrench[1]) < parameters[0]:
        wrench[0] = 0.0
        wrench[1] = 0.0


def _scan_cutoffs(scene: Scene, history: History, body: Body, *, levels: int = 200) -> Floats:
    """Return thresholds to try.

    ``levels``: the likelihood jumps where the cut-off passes a commanded force, and an optimiser
    cannot follow it: many levels.
    """
    return _force_levels(history, body, levels)


force_cutoff = Effect(
    "force_cutoff",
    (_THRESHOLD,),
    "a push weaker than a threshold does nothing, a stronger one acts in full",
    "threshold of an actuator",
    Command(_cut_off),
    scan=_scan_cutoffs,
    log_odds=-3.0,
)


def _saturate(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    size = math.hypot(wrench[0], wrench[1])
    if size > parameters[0]:
        wrench[0] *= parameters[0] / size
        wrench[1] *= parameters[0] / size


def _scan_limits(scene: Scene, history: History, body: Body) -> Floats:
    """Return limits to try."""
    return _force_levels(history, body, _LEVELS)


saturation = Effect(
    "saturation",
    (
        EffectParameter(
            "limit",
            "N",
            Prior("log_normal", mu=0.0, sigma=1.5),
            null=_UNREACHED,
            scale="force",
        ),
    ),
    "a push is never stronger than a limit, whatever is commanded: the actuator saturates",
    "saturation of an actuator",
    Command(_saturate),
    scan=_scan_limits,
    log_odds=-2.0,
)
