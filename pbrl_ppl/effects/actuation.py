"""Wrenches of a scene's actuators, by the simulated pose of the body that they act on."""

import math
from dataclasses import replace
from typing import Any

from pbrl_ppl.effects.actuators import OF_COMPONENTS, of_component
from pbrl_ppl.effects.effect import (
    SIGNED,
    SIZE,
    Command,
    Effect,
    EffectParameter,
    always,
    is_pivoted,
)
from pbrl_ppl.parameters import Prior
from pbrl_ppl.scene import NUMBERS, Actuator, Scene
from pbrl_ppl.state import WRENCH, Floats

#: Name of the effect of actuators.
ACTUATION = "actuators"
#: What an actuator is to the law: nothing, a force in the body's or the world's frame, a torque, or
#: a torque towards an angle or a speed.
_NONE, _FORCE, _WORLD_FORCE, _TORQUE, _TO_ANGLE, _TO_SPEED = range(6)
#: Numbers of each actuator, one after the other; its kind is among the constants.
_SIZE = 5


def _act(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    c, s = math.cos(state[2]), math.sin(state[2])
    force_x, force_y, torque = 0.0, 0.0, 0.0
    for a in range(3):
        kind, at, u = int(parameters[3 * _SIZE + a]), _SIZE * a, command[a]
        if kind in (_FORCE, _WORLD_FORCE):
            angle = parameters[at + 2] + wrench[6 + a] + (state[2] if kind == _FORCE else 0.0)
            x = c * parameters[at + 3] - s * parameters[at + 4]
            y = s * parameters[at + 3] + c * parameters[at + 4]
            d_x, d_y = math.cos(angle), math.sin(angle)
            along = d_x * (state[3] - state[5] * y) + d_y * (state[4] + state[5] * x)
            force = parameters[at] * u - parameters[at + 1] * along
            force_x += force * d_x
            force_y += force * d_y
            torque += force * (x * d_y - y * d_x)
        elif kind == _TORQUE:
            torque += parameters[at] * u - parameters[at + 1] * state[5]
        elif kind in (_TO_ANGLE, _TO_SPEED):
            off = u - state[5]
            if kind == _TO_ANGLE:
                off = u - state[2]
                off -= 2.0 * math.pi * math.floor((off + math.pi) / (2.0 * math.pi))
            turn = parameters[at] * off
            if kind == _TO_ANGLE:
                turn -= parameters[at + 1] * state[5]
            if parameters[at + 2] > 0.0:
                turn = min(max(turn, -parameters[at + 2]), parameters[at + 2])
            torque += turn
    wrench[0], wrench[1], wrench[2] = force_x, force_y, torque


def _scale(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    wrench[0] *= parameters[0]


def _turn(state: Floats, command: Floats, parameters: Floats, wrench: Floats) -> None:
    # where the law of actuators finds by how much each is turned
    wrench[6 + int(parameters[1])] = parameters[0]


#: Prior and natural unit of each number that is inferred.
_GAIN = Prior("log_normal", mu=0.0, sigma=2.0)
_PRIORS = {
    "thruster": {
        "gain": (_GAIN, "force"),
        "loss": (SIZE, "force/speed"),
        "direction": (Prior("normal", sigma=0.3), ""),
    },
    "motor": {"gain": (_GAIN, "torque"), "loss": (SIZE, "torque/turn_rate")},
    "servo": {
        "kp": (_GAIN, "torque"),
        "kd": (SIZE, "torque/turn_rate"),
        "limit": (_GAIN, "torque"),
    },
    "wrench": {},
}


def _kind(actuator: Actuator) -> int:
    """Return what an actuator is to the law."""
    if actuator.kind == "servo":
        return _TO_ANGLE if actuator.of == "angle" else _TO_SPEED
    if actuator.kind == "motor" or actuator.of == "torque":
        return _TORQUE
    return _FORCE if actuator.frame == "body" else _WORLD_FORCE


def _given(value: float) -> EffectParameter:
    """Return a number that is known."""
    return EffectParameter("given", "1", SIGNED, value, given=True)


def _numbers(actuator: Actuator) -> list[EffectParameter]:
    """Return an actuator's numbers in the order of the law, given ones at their values."""
    parameters, prior = [], dict(actuator.prior)
    for name, value in actuator.numbers.items():
        if value is not None:
            parameters.append(_given(value))
            continue
        family, scale = _PRIORS[actuator.kind][name]
        per_unit = 1.0 / actuator.full if name == "gain" else 1.0
        family = family.scaled(per_unit)
        stated: dict[str, Any] = dict(prior.get(name, ()))
        if stated:  # in SI units
            family, scale = replace(family, **stated), ""
        unit = NUMBERS[actuator.kind][name][0]
        null = per_unit if family.family == "log_normal" else 0.0
        parameters.append(
            EffectParameter(f"{actuator.name}_{name}", unit, family, null, scale=scale)
        )
    if actuator.kind == "wrench":
        turn = 0.5 * math.pi if actuator.of == "force_y" else 0.0
        parameters = [_given(1.0), _given(0.0), _given(turn)]
    places = actuator.at if _kind(actuator) in (_FORCE, _WORLD_FORCE) else (0.0, 0.0)
    parameters += [_given(0.0)] * (3 - len(parameters))
    return parameters + [_given(place) for place in places]


def actuation(scene: Scene, body: str) -> Effect | None:
    """Return the effect of a body's actuators, if it has any: commands become wrenches.

    Where the recording gives forces along the bodies' axes, a body without actuators has three that
    are its wrench, which does not act back on what the body hangs on.

    Parameters
    ----------
    scene : Scene
        Its actuators.
    body : str
        Name of a dynamic body.
    """
    acting = own = scene.actuators_of(body)
    name, sentence = ACTUATION, "commands act through "
    sentence += ", ".join(f"{one.name} ({one.kind})" for one in own)
    if not own:
        if scene.recording is None or scene.recording.forces != "body":
            return None
        name, sentence = "body_frame", "pushes are given along the body's own axes and turn with it"
        acting = tuple(Actuator(name=of, kind="wrench", body=body, of=of) for of in WRENCH)
    parameters: list[EffectParameter] = []
    for actuator in acting:
        parameters += _numbers(actuator)
    parameters += [_given(0.0)] * (_SIZE * len(WRENCH) - len(parameters))
    kinds = [float(_kind(actuator)) for actuator in acting]
    return Effect(
        name,
        tuple(
            replace(one, name=f"given_{i}") if one.given else one
            for i, one in enumerate(parameters)
        ),
        sentence,
        "forces and torques of actuators in the body's frame",
        Command(_act, reacts=bool(own) and is_pivoted(scene, scene.body(body))),
        constants=(*kinds, *[float(_NONE)] * (len(WRENCH) - len(kinds))),
    )


def laws_of_actuators(scene: Scene, body: str) -> tuple[tuple[str, Effect], ...]:
    """Return what may be wrong with each actuator of a body that is declared as known.

    Each with the name of the effect of the catalogue that it is of, empty if of none.

    Parameters
    ----------
    scene : Scene
        Its actuators.
    body : str
        Name of a dynamic body.
    """
    laws = list[tuple[str, Effect]]()
    for slot, actuator in enumerate(scene.actuators_of(body)):
        name, force = actuator.name, _kind(actuator) in (_FORCE, _WORLD_FORCE)
        if actuator.kind == "wrench" or actuator.numbers.get("gain") is not None:
            prior = Prior("log_normal", mu=0.0, sigma=0.5)
            wrong_gain = Effect(
                f"{name}_gain",
                (EffectParameter("factor", "1", prior, null=1.0),),
                f"{name} is stronger or weaker than declared by this factor",
                "gain of an actuator",
                Command(_scale, alone=WRENCH[slot]),
            )
            laws.append(("", wrong_gain))
        gain = actuator.numbers.get("gain", 1.0 if actuator.kind == "wrench" else None)
        natural = "torque" if _kind(actuator) == _TORQUE else "force"
        if not gain or actuator.kind == "servo":  # natural is a full command
            gain, natural = 1.0 / actuator.full, ""
        for suffix, (law, _, sentence) in OF_COMPONENTS.items():
            known = f"{name}_{suffix}", f"{name} {sentence}", WRENCH[slot], "1", natural, abs(gain)
            laws.append((law.name, replace(of_component(law, *known), applies=always)))
        if force and not dict(actuator.prior).get("direction"):
            wrong_direction = Effect(
                f"{name}_direction",
                (EffectParameter("angle", "rad", Prior("normal", sigma=0.3)),),
                f"{name} points in another direction than declared: it is mounted askew",
                "rotation of a vector in the plane",
                Command(_turn, acts=False),
                constants=(float(slot),),
            )
            laws.append(("", wrong_direction))
    return tuple(laws)
