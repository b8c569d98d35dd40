"""Actuators: gains, rotation, delay, dead zone, cut-off and saturation of the command."""

import math
from dataclasses import replace

import numpy as np

from pbrl_ppl.effects.effect import Command, Effect, EffectParameter, With
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene
from pbrl_ppl.state import WRENCH, Floats

_GAIN = Prior("log_normal", mu=0.0, sigma=0.5)
_THRESHOLD = EffectParameter("threshold", "N", Prior("half_normal", sigma=0.5), scale="force")
#: The components that are a force.
_FORCE = (0, 1)
#: No actuator reaches this force, in typical forces.
_UNREACHED = 1e9
_LIMIT = Prior("log_normal", mu=0.0, sigma=1.5)
#: Intervals by which a push may be late.
_LATEST = 8


def sends_wrenches(scene: Scene, body: Body) -> bool:
    """Return whether a body's commands are forces and torques: it has no actuators."""
    return not scene.actuators_of(body.name)


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
    applies=sends_wrenches,
)


def _scale_torque(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[2] *= parameters[0]


torque_gain = replace(
    force_gain,
    name="torque_gain",
    sentence="every torque is stronger or weaker than commanded by the same factor: the motor's"
    " scale is off",
    stage=Command(_scale_torque),
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
    applies=sends_wrenches,
)


def _delay(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    # a delay that ends inside a substep is blended: the likelihood stays smooth in it
    begin, end = command[6], command[7]
    whole = min(math.floor(parameters[0]), _LATEST - 1)
    late = min(1.0, max(0.0, (parameters[0] - whole - begin) / (end - begin)))
    for i in range(3):
        before = command[3 + i] if whole == 0 else command[9 + 3 * whole + i]
        now = command[i] if whole == 0 else command[3 + i]
        if whole > 1:
            now = command[6 + 3 * whole + i]
        wrench[i] = late * before + (1.0 - late) * now


def _remember_past(state: Floats, command: Floats, parameters: Floats, memory: Floats) -> None:
    for i in range(3 * _LATEST - 4, 2, -1):
        memory[i] = memory[i - 3]
    for i in range(3):
        memory[i] = command[3 + i]


def _scan_delays(scene: Scene, history: History, body: Body) -> Floats:
    """Return the null value, where the derivative is taken, and longer delays (intervals)."""
    return np.array([[np.nan], [1.5], [2.5], [4.5]])


actuator_delay = Effect(
    "actuator_delay",
    (
        EffectParameter(
            "share", "1", Prior("truncated_normal", sigma=2.0, lower=0.0, upper=float(_LATEST))
        ),
    ),
    "the push arrives late, by so many sampling intervals (actuator_delay), or what is measured"
    " does (sensor_delay); with one clock in the log the two are the same data",
    "pure time delay of a held input, u(t - share dt)",
    Command(_delay, memory=_LATEST - 1, remember=_remember_past, jumps=True),
    scan=_scan_delays,
    family="late command",
)


def _lag(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    if parameters[0] > 0.0:
        since = 0.5 * (command[6] + command[7]) * command[10]
        left = math.exp(-since / parameters[0])
        for i in range(3):
            wrench[i] = command[i] + left * (command[12 + i] - command[i])


def _remember_lag(state: Floats, command: Floats, parameters: Floats, memory: Floats) -> None:
    left = math.exp(-command[10] / parameters[0]) if parameters[0] > 0.0 else 0.0
    for i in range(3):
        memory[i] = command[i] + left * (memory[i] - command[i])


def _scan_lags(scene: Scene, history: History, body: Body) -> Floats:
    """Return the null value, where the derivative is taken, and time constants (s)."""
    times = [scene.time_step * share for share in (1.0, 3.0, 8.0)]
    return np.array([(np.nan, 0.0), *((time, begin) for begin in (0.0, 1.0) for time in times)])


_BEGIN = EffectParameter(
    "begin", "1", Prior("truncated_normal", mu=0.0, sigma=1.0, lower=0.0, upper=1.0)
)


first_order_lag = Effect(
    "first_order_lag",
    (EffectParameter("time", "s", Prior("half_normal", sigma=5.0), scale="interval"), _BEGIN),
    "the push follows the command slowly, as a motor or a fan that has to spin up: after this time"
    " two thirds of a change have arrived, and this share of the first command had when a recording"
    " began",
    "first-order lag, T df/dt = u - f",
    Command(_lag, memory=1, remember=_remember_lag, begins=True),
    scan=_scan_lags,
    family="late command",
)


def _ramp(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    most = parameters[0] * 0.5 * (command[6] + command[7]) * command[10]
    off = math.hypot(command[0] - command[12], command[1] - command[13])
    if off > most:
        for i in range(2):
            wrench[i] = command[12 + i] + most / off * (command[i] - command[12 + i])


def _remember_ramp(state: Floats, command: Floats, parameters: Floats, memory: Floats) -> None:
    off = math.hypot(command[0] - memory[0], command[1] - memory[1])
    most = command[10] * parameters[0]
    for i in range(2):
        memory[i] += min(1.0, most / max(off, 1e-300)) * (command[i] - memory[i])


def _scan_rates(
    scene: Scene, history: History, body: Body, components: tuple[int, ...] = _FORCE
) -> Floats:
    """Return rates at which the largest change of a command takes some intervals, (rate, 1)."""
    action = history.dataset["action"].sel(body=body.name).to_numpy()[..., components]
    jumps = np.linalg.norm(np.diff(action, axis=1), axis=-1)
    most = float(np.nanmax(jumps, initial=0.0))
    shares = (1.5, 4.0, 10.0) if most > 0.0 else ()
    return np.array([most / (scene.time_step * n) for n in shares])[:, None]


_RATE = Prior("log_normal", mu=0.0, sigma=2.0)

rate_limit = Effect(
    "rate_limit",
    (EffectParameter("rate", "N/s", _RATE, null=_UNREACHED, scale="force/interval"),),
    "the push changes no faster than at a limit, whatever is commanded",
    "rate limit of an actuator",
    Command(_ramp, memory=1, remember=_remember_ramp),
    scan=_scan_rates,
    log_odds=-2.0,
    family="late command",
    applies=sends_wrenches,
    unusual="few actuators are slower than their commands in a straight line; most lag",
)


def _play(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    for i in range(2):
        low, high = command[i] - parameters[0], command[i] + parameters[0]
        wrench[i] = min(max(command[12 + i], low), high)


def _remember_play(state: Floats, command: Floats, parameters: Floats, memory: Floats) -> None:
    for i in range(2):
        memory[i] = min(max(memory[i], command[i] - parameters[0]), command[i] + parameters[0])


actuator_backlash = Effect(
    "actuator_backlash",
    (_THRESHOLD,),
    "after a turn the push lags behind the command until the play is taken up",
    "play operator (G. Tao and P. V. Kokotovic, 1996)",
    Command(_play, memory=1, remember=_remember_play),
    log_odds=-2.0,
    family="late command",
    applies=sends_wrenches,
    unusual="play needs a train of gears, and friction turns a command round likewise",
)


def _scan_levels(
    scene: Scene, history: History, body: Body, components: tuple[int, ...] = _FORCE, most: int = 0
) -> Floats:
    """Return at most so many sizes between those commanded, shape (level, 1), N or N m.

    By default 20 of a force, and 8 of a torque.
    """
    most = most or (20 if components == _FORCE else 8)
    action = history.dataset["action"].sel(body=body.name).to_numpy()[..., components]
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


def _scan_dead_zones(
    scene: Scene, history: History, body: Body, components: tuple[int, ...] = _FORCE
) -> Floats:
    """Return the null value, where the derivative is taken, and thresholds to try."""
    return np.vstack([[[np.nan]], _scan_levels(scene, history, body, components)])


dead_zone = Effect(
    "dead_zone",
    (_THRESHOLD,),
    "only what exceeds a threshold of the push acts: the actuator has play or friction",
    "dead zone of an actuator (G. Tao and P. V. Kokotovic, 1994)",
    Command(_subtract_threshold),
    scan=_scan_dead_zones,
    log_odds=-2.0,
    family="shape of the command",
    applies=sends_wrenches,
    unusual="friction of the body eats small commands likewise, and every rig has that",
)


def _cut_off(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    if math.hypot(wrench[0], wrench[1]) < parameters[0]:
        wrench[0] = 0.0
        wrench[1] = 0.0


def _scan_cutoffs(scene: Scene, history: History, body: Body) -> Floats:
    """Return many thresholds: an optimiser cannot follow the jumps at each commanded force."""
    return _scan_levels(scene, history, body, _FORCE, most=200)


force_cutoff = Effect(
    "force_cutoff",
    (_THRESHOLD,),
    "a push weaker than a threshold does nothing, a stronger one acts in full",
    "threshold of an actuator",
    Command(_cut_off),
    scan=_scan_cutoffs,
    log_odds=-3.0,
    family="shape of the command",
    applies=sends_wrenches,
    unusual="few drives switch: most give less and less",
)


def _saturate(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    size = math.hypot(wrench[0], wrench[1])
    if size > parameters[0]:
        wrench[0] *= parameters[0] / size
        wrench[1] *= parameters[0] / size


saturation = Effect(
    "saturation",
    (EffectParameter("limit", "N", _LIMIT, null=_UNREACHED, scale="force"),),
    "a push is never stronger than a limit, whatever is commanded: the actuator saturates",
    "saturation of an actuator",
    Command(_saturate),
    scan=_scan_levels,
    log_odds=-2.0,
    family="shape of the command",
    applies=sends_wrenches,
    unusual="commands are mostly limited before they are logged",
)


def of_component(
    effect: Effect,
    name: str,
    sentence: str,
    component: str,
    unit: str = "N m",
    natural: str = "torque",
    gain: float = 1.0,
) -> Effect:
    """Return a law of the commanded force for one component of the commands.

    Parameters
    ----------
    effect : Effect
        A law of the command stage.
    name, sentence : str
        Of the new law.
    component : str
        One of :data:`pbrl_ppl.state.WRENCH`.
    unit, natural : str
        Unit and natural unit of the component, in place of those of a force.
    gain : float
        Forces or torques for each unit of the component.
    """
    place, stage = WRENCH.index(component), effect.stage
    parameters = tuple(
        replace(
            one,
            unit=one.unit.replace("N", unit),
            prior=one.prior.scaled(1.0 / gain),
            null=one.null / gain,
            scale=one.scale.replace("force", natural),
        )
        for one in effect.parameters
    )
    return replace(
        effect,
        name=name,
        sentence=sentence,
        parameters=parameters,
        stage=replace(stage, alone=component) if isinstance(stage, Command) else stage,
        scan=effect.scan and With(effect.scan, (place,)),
    )


#: Laws of the commanded force that a torque and the command of any actuator may have, too: by the
#: ends of their names, with the sentences for a torque and for an actuator.
OF_COMPONENTS = {
    "dead_zone": (
        dead_zone,
        "only what exceeds a threshold of the torque acts: the motor has play or friction",
        "acts by what exceeds a threshold of its command alone",
    ),
    "saturation": (
        saturation,
        "the torque is never stronger than a limit, whatever is commanded: the motor saturates",
        "acts as if its command were never larger than a limit",
    ),
    "rate_limit": (
        rate_limit,
        "the torque changes no faster than at a limit, whatever is commanded",
        "follows its command no faster than at a limit",
    ),
    "backlash": (
        actuator_backlash,
        "after a turn the torque lags behind the command until the play is taken up",
        "lags behind its command after a turn until the play is over",
    ),
}
torque_dead_zone, torque_saturation, torque_rate_limit, torque_backlash = (
    of_component(law, f"torque_{suffix}", sentence, "torque")
    for suffix, (law, sentence, _) in OF_COMPONENTS.items()
)
