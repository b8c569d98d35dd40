"""Pictures of the catalogue's laws: a motion with and without each, and the difference."""

import io
from functools import cache

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from pbrl_ppl import (
    Body,
    Effect,
    History,
    Joint,
    Noise,
    Physics,
    Scene,
    Shape,
    Structure,
    catalogue,
)
from pbrl_ppl.history import with_units
from pbrl_ppl.state import STATE, STATE_UNITS, Floats

#: Share of the motion that a law changes in its picture.
_SEEN = 0.3
#: Smaller ones have no picture, such as a bias that the start has as well.
_LEAST = 0.02
#: Parameters of a law in SI units where the middle of its prior shows nothing.
SHOWN = {
    "sensor_scale": {"length": 1.1, "angle": 1.1},
    "hidden_obstacle": {"x": 0.8, "y": 0.1, "radius": 0.1},
    "distance_joint": {"a_x": 0.0, "a_y": 0.0, "b_x": 0.0, "b_y": 1.0, "length": 1.0},
    "mass_change": {"factor": 2.0, "trajectory": 0.0, "time": 1.0},
    "first_order_lag": {"time": 0.3, "begin": 0.0},
    "actuator_delay": {"share": 3.0},
    "gravity_tilt": {"angle": 0.2},
    "cogging": {"count": 6.0},
    "upper_stop": {"angle": 0.2},
    "lower_stop": {"angle": -0.2},
}
#: Laws that change the friction of another.
BESIDE = {"sliding_stribeck": "sliding_friction"}


@cache
def rigs() -> tuple[tuple[Scene, History], ...]:
    """Return a pushed puck, a driven arm on a hinge and a cart on a rail, with their motion."""
    known = {"mass": 0.5, "r": 0.2, "mu_c": 0.3}
    puck = Body("puck", Shape.box(0.3, 0.2), known=known)
    arm = Body("arm", Shape.box(0.05, 0.4), known=known)
    cart = Body("cart", Shape.box(0.2, 0.1), known=known)
    hinge = Joint("hinge", ("arm", "world"), (0.0, 0.2), (0.0, 0.0))
    rail = Joint("slider", ("cart", "world"), (0.0, 0.0), (0.0, 0.0), axis=(1.0, 0.0))
    step = {"time_step": 0.05}
    scenes = (
        Scene(bodies=(puck,), normal_gravity=9.81, **step),
        Scene(bodies=(arm,), joints=(hinge,), gravity=(0.0, -9.81), **step),
        Scene(bodies=(cart,), joints=(rail,), **step),
    )
    time = np.arange(80) * 0.05
    square = np.sign(np.sin(2.0 * np.pi * time / 1.6)) * (0.6 + 0.4 * (time > 2.0))
    found = []
    for scene in scenes:
        start, commands = np.zeros((1, 1, 6)), np.zeros((1, len(time), 1, 3))
        if scene.joints and scene.joints[0].kind == "hinge":
            start[0, 0, 1], commands[0, :, 0, 2] = -0.2, 0.4 * square
        else:
            start[0, 0, 3] = 0.4
            commands[0, :, 0, 0] = square
            if not scene.joints:
                commands[0, :, 0, 1], commands[0, :, 0, 2] = 0.5 * np.roll(square, 8), 0.01 * square
                start[0, 0, 4:] = 0.2, 0.5
        states = Physics(scene).predict(np.zeros(0), start, commands)
        whole = np.concatenate([start[:, None], states], axis=1)
        history = History.of_arrays(whole, scene, commands)
        found.append((with_units(scene, history), history))
    return tuple(found)


def motions(effect: Effect) -> tuple[Floats, Floats, Floats] | None:
    """Return times, and the states without and with a law of a size that shows, (time, 6).

    None where no motion of these shows it.
    """
    suits = [rig for rig in rigs() if effect.applies(rig[0], rig[0].dynamic[0])]
    if not suits or isinstance(effect.stage, Noise):
        return None
    scene, history = suits[0]
    name = scene.dynamic[0].name
    beside = [one.on(name) for one in catalogue if one.name == BESIDE.get(effect.name)]
    both = [Physics(scene, tuple(beside)), Physics(scene, (*beside, effect.on(name)))]
    segments = history.pieces(history.dataset["start"].to_numpy(), history.n_transitions)

    def states(physics: Physics, size: float) -> Floats:
        phi = np.array([prior.centre for prior in physics.layout.priors])
        for attached in physics.effects[len(beside) :]:
            for i, parameter in enumerate(attached.effect.parameters):
                place = physics.layout.labels.index(attached.labels[i])
                shown = SHOWN.get(effect.name, {}).get(parameter.name)
                value = parameter.prior.centre if shown is None else shown
                if i == 0 and not isinstance(effect.stage, Structure):
                    off = value - parameter.null if abs(parameter.null) < 1e6 else 0.0
                    off = off or parameter.prior.scale
                    value = parameter.null + size * off if off != 0.0 else value
                    value = size * parameter.prior.centre if abs(parameter.null) > 1e6 else value
                    value = float(np.clip(value, *parameter.prior.support))
                phi[place] = value
        inputs = physics.inputs(segments)
        return np.asarray(physics.predict(phi, segments.start, inputs)[0, :, 0])

    without = states(both[0], 1.0)
    moved = np.ptp(without, axis=0).clip(0.05)
    tried = [states(both[1], size) for size in 2.0 ** np.arange(-14.0, 4.0)]
    shares = np.array([(np.abs(one - without) / moved).max() for one in tried])  # NaN: diverged
    seen = np.abs(np.log(np.maximum(np.nan_to_num(shares), 1e-9) / _SEEN))
    best = int(np.argmin(seen))
    if not shares[best] > _LEAST:
        return None
    return 0.05 * np.arange(1, len(without) + 1), without, tried[best]


def picture(effect: Effect) -> str | None:
    """Return an SVG of what a law does: the coordinate that it changes most, and the change."""
    found = motions(effect)
    if found is None:
        return None
    time, without, there = found
    change = there - without
    shares = np.abs(change).max(axis=0) / np.ptp(without, axis=0).clip(0.05)
    k = int(np.argmax(shares[:3])) if shares[:3].max() > 0.02 else int(np.argmax(shares))
    matplotlib.rcParams["svg.hashsalt"] = effect.name
    figure = Figure(figsize=(6.4, 1.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(time, without[:, k], color="0.6", label="without")
    left.plot(time, there[:, k], color="C0", label="with")
    left.set_ylabel(f"{STATE[k]} ({STATE_UNITS[k]})")
    left.legend(frameon=False, fontsize=8)
    right.plot(time, change[:, k], color="C3")
    right.set_ylabel(f"change ({STATE_UNITS[k]})")
    for axes in (left, right):
        axes.set_xlabel("time (s)")
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()
