"""Mass, moment of inertia and centre of mass."""

import math

import numpy as np

from pbrl_ppl.effects.effect import SIZE, Effect, EffectParameter, is_unpivoted
from pbrl_ppl.effects.stages import Clock, Force, Properties, Values
from pbrl_ppl.history import History
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import Body, Scene
from pbrl_ppl.state import Floats

_OFFSET = Prior("normal", sigma=0.2)
_SCALE = Prior("log_normal", mu=0.0, sigma=0.5)


def _scale_moment(properties: dict[str, Floats], parameters: Values, clock: Clock) -> None:
    properties["moment_per_mass"] = properties["moment_per_mass"] * parameters["scale"]


inertia_scale = Effect(
    "inertia_scale",
    (EffectParameter("scale", "1", _SCALE, null=1.0),),
    "the body is easier or harder to turn than its outline suggests: mass is not spread evenly",
    "moment of inertia about the centroid as a free parameter",
    Properties(_scale_moment),
    log_odds=-2.0,
)


def _shift_centre(properties: dict[str, Floats], parameters: Values, clock: Clock) -> None:
    properties["com_x"] = properties["com_x"] + parameters["x"]
    properties["com_y"] = properties["com_y"] + parameters["y"]


com_offset = Effect(
    "com_offset",
    (
        EffectParameter("x", "m", _OFFSET, scale="length"),
        EffectParameter("y", "m", _OFFSET, scale="length"),
    ),
    "the centre of mass is not in the middle of the outline: mass is not spread evenly",
    "centre of mass of a rigid body, in the body's frame",
    Properties(_shift_centre),
    log_odds=-1.0,
)


def _scale_mass(properties: dict[str, Floats], parameters: Values, clock: Clock) -> None:
    # the interval in which the mass changes is blended
    loaded = clock.after(parameters["time"]) * (clock.trajectory > parameters["trajectory"] - 0.5)
    properties["mass"] = properties["mass"] * (1.0 + (parameters["factor"] - 1.0) * loaded)


def _scan_begins(scene: Scene, history: History, body: Body, *, most: int = 20) -> Floats:
    """Return changes from some trajectory on, then in every trajectory from some time on.

    ``most``: trajectories, and times, of a change of mass, at most.
    """
    data = history.dataset
    numbers = data["number"].to_numpy()
    last = float(np.nanmax(data["clock"].to_numpy()))
    grid = np.linspace(0, 1, most)
    between = numbers[1:] - 0.5
    begins = np.unique(np.quantile(between, grid, method="nearest")) if len(between) else between
    times = np.linspace(0, last, most + 2)[1:-1]
    changes = [(np.nan, begin, 0.0) for begin in begins] + [(np.nan, 0.0, time) for time in times]
    return np.array(changes).reshape(-1, 3)


mass_change = Effect(
    "mass_change",
    (
        EffectParameter("factor", "1", _SCALE, null=1.0),
        EffectParameter("trajectory", "1", Prior("half_normal", sigma=100.0)),
        EffectParameter("time", "s", SIZE, scale="time"),
    ),
    "the body is heavier or lighter from some trajectory, or some time, on: it carries a load",
    "a change point in the mass",
    Properties(_scale_mass, timed=True),
    scan=_scan_begins,
    log_odds=-8.0,
)


def _slosh(state: Floats, command: Floats, parameters: Floats, change: Floats) -> None:
    rate = 2.0 * math.pi * parameters[1]
    for i in range(2):
        off, speed = command[12 + i] - state[i], command[14 + i]
        change[i] = speed
        change[2 + i] = -rate * rate * off - 2.0 * parameters[2] * rate * (speed - state[3 + i])


def _press(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    rate = 2.0 * math.pi * parameters[1]
    for i in range(2):
        off, speed = command[12 + i] - state[i], command[14 + i] - state[3 + i]
        wrench[i] += parameters[0] * (rate * rate * off + 2.0 * parameters[2] * rate * speed)


def _begin_at_rest(state: Floats, command: Floats, parameters: Floats, memory: Floats) -> None:
    for i in range(2):
        memory[i], memory[2 + i] = state[i], state[3 + i]


def _scan_frequencies(scene: Scene, history: History, body: Body) -> Floats:
    """Return frequencies of some intervals; the derivative is taken by the mass."""
    return np.array([(np.nan, 1.0 / (n * scene.time_step), 0.05) for n in (6, 12, 25)])


sloshing = Effect(
    "sloshing",
    (
        EffectParameter("mass", "kg", Prior("half_normal", sigma=0.5), scale="mass"),
        EffectParameter(
            "frequency", "Hz", Prior("log_normal", mu=-2.0, sigma=1.0), null=0.1, scale="/interval"
        ),
        EffectParameter("damping", "1", Prior("half_normal", sigma=0.2), null=0.05),
    ),
    "a mass that swings within the body, beside the body's own: a liquid, a loose load, a flexible"
    " mast",
    "a mass on a spring and a damper, at rest in the body when a transition begins",
    Force(_press, memory=4, rate=_slosh, begin=_begin_at_rest),
    applies=is_unpivoted,
    scan=_scan_frequencies,
    log_odds=-4.0,
)
