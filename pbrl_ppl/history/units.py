"""Natural units of the bodies of a recording: typical motions, forces and places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import linregress

from pbrl_ppl.history.history import History
from pbrl_ppl.history.kinematics import hung_bodies
from pbrl_ppl.scene import MASS_PRIOR, Scene, units_of
from pbrl_ppl.state import THETA, WRENCH, Floats

#: Standard deviations of the noise by which a difference over some rows must stand out.
_STANDS_OUT = 5.0
#: Fewer accelerations show no mass.
_FEW = 8


def with_units(scene: Scene, history: History) -> Scene:
    """Return the scene with the natural units of its bodies as a recording shows them.

    Units that the scene states are kept: a scene of a posterior file, which holds those of the
    training recording, stays as it is.

    Parameters
    ----------
    scene : Scene
        See :class:`pbrl_ppl.scene.Units`.
    history : History
        Positions alone are read, and commands: computed velocities may be late or smooth.

    Examples
    --------
    ::

        with_units(scene, history).body("cart").typical
    (('mass', 2.72), ('length', 0.583), ...)
    """
    data = history.dataset
    dynamic = {body.name for body in scene.dynamic}
    bodies = []
    for body in scene.bodies:
        if body.name in dynamic:
            states = data["start"].sel(body=body.name).to_numpy()
            wrench = data["action"].sel(body=body.name).to_numpy()
            units = {**vars(units_of(scene, body.name)), "time": _duration(history, scene)}
            seen = _measured(units, states[..., :3], wrench, scene.time_step)
            typical = {**units, **seen, **dict(body.typical)}
            body = replace(body, typical=tuple(typical.items()))
        bodies.append(body)
    return scene.replace(bodies=tuple(bodies))


def _duration(history: History, scene: Scene) -> float:
    """Return the duration of the longest trajectory (s)."""
    return float(history.dataset["n_rows"].max() - 1) * scene.time_step


def _measured(
    units: dict[str, float], poses: Floats, wrench: Floats, dt: float
) -> dict[str, float]:
    """Return the natural units that poses (trajectory, time, 3) and wrenches show."""
    places = poses[..., :2]
    centre = np.nanmean(places, axis=(0, 1)) if np.isfinite(places).any() else np.zeros(2)
    reach = float(np.nanmax(np.linalg.norm(places - centre, axis=-1), initial=0.0))
    speed, acceleration = _rates(places, dt)
    turn_rate, _ = _rates(np.unwrap(np.nan_to_num(poses[..., THETA:]), axis=1), dt)
    force = max(
        units["force"], units["mass"] * acceleration, _size(wrench[..., : WRENCH.index("torque")])
    )
    torque = max(force * units["length"], _size(wrench[..., WRENCH.index("torque") :]))
    found = dict(speed=speed, turn_rate=turn_rate or speed / units["length"])
    return {
        "force": force,
        "torque": torque,
        "range": max(reach, units["length"]),
        "x": float(centre[0]),
        "y": float(centre[1]),
        **{name: value for name, value in found.items() if value > 0},
    }


def _size(vectors: Floats) -> float:
    """Return the root mean square size of the vectors (..., d) that are not zero."""
    size = np.linalg.norm(vectors, axis=-1)
    size = size[size > 0]  # not NaN either
    return float(np.sqrt(np.mean(size**2))) if len(size) else 0.0


def _rates(values: Floats, dt: float) -> tuple[float, float]:
    """Return the root mean square rate and acceleration of series (trajectory, time, d).

    They are differences over as few rows as stand out of the noise, which third differences of
    neighbours show.
    """
    noise = _size(np.diff(values, 3, axis=1)) / np.sqrt(20.0)
    rates = []
    for order, gain in ((1, 2.0), (2, 6.0)):
        lag, size = 1, 0.0
        while order * lag < values.shape[1]:
            change = values
            for _ in range(order):
                change = change[:, lag:] - change[:, :-lag]
            size = _size(change) / (lag * dt) ** order
            if _size(change) > _STANDS_OUT * np.sqrt(gain) * noise:
                break
            lag *= 2
        rates.append(size)
    return rates[0], rates[1]


def shown_mass(scene: Scene, history: History, name: str) -> float | None:
    """Return the mass (kg) that the commands and the accelerations of a body show.

    It is the regression of accelerations on commanded forces, or about a hinge of angular
    accelerations on torques: other forces make it wrong by a factor, not by orders of magnitude.

    Returns
    -------
    float or None
        None where no command moves the body measurably.
    """
    data, body = history.dataset, scene.body(name)
    pose = data["start"].sel(body=name).to_numpy()[..., :3].copy()
    pose[..., THETA] = np.unwrap(np.nan_to_num(pose[..., THETA]), axis=1)
    wrench = data["action"].sel(body=name).to_numpy()
    columns, moment = slice(0, 2), 1.0
    if name in hung_bodies(scene):
        columns = slice(2, 3)
        moment = body.shape.unit_moment + units_of(scene, name).length ** 2
    rate = np.diff(pose[..., columns], axis=1) / scene.time_step
    response = np.diff(rate, axis=1).ravel() / scene.time_step
    # between the middles of two intervals each command acts for half of the time
    push = (0.5 * (wrench[:, :-2, columns] + wrench[:, 1:-1, columns])).ravel() / moment
    seen = np.isfinite(response) & np.isfinite(push)
    if seen.sum() < _FEW or not np.any(push[seen]):
        return None
    fitted = linregress(push[seen], response[seen])
    shows = fitted.slope > _STANDS_OUT * fitted.stderr
    return 1.0 / float(fitted.slope) if shows else None


def mass_contradictions(scene: Scene, history: History) -> list[str]:
    """Return a sentence for each prior of a mass that the recording contradicts."""
    sentences = []
    for body in scene.dynamic:
        shown = shown_mass(scene, history, body.name)
        hyper = dict(zip(("mu", "sigma"), MASS_PRIOR, strict=True))
        hyper |= dict(dict(body.prior).get("mass", ()))
        if "mass" in dict(body.known) or shown is None:
            continue
        if abs(np.log(shown) - hyper["mu"]) > _STANDS_OUT * hyper["sigma"]:
            sentences.append(
                f"mass of {body.name}: commands and accelerations of the recording show some"
                f" {shown:.1g} kg, and its prior has the median {np.exp(hyper['mu']):.2g} kg;"
                f" declare prior = {{ mass = {{ mu = {np.log(shown):.1f}, sigma ="
                f" {hyper['sigma']:g} }} }} (mu is the logarithm), or known = {{ mass = ... }}; or"
                " check the units of the commands"
            )
    return sentences
