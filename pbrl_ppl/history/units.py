"""Units of a recording: natural ones of its bodies, and columns in units that do not agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pbrl_ppl.history.history import History
from pbrl_ppl.scene import Scene, units_of
from pbrl_ppl.state import STATE, THETA, VELOCITY, Floats, wrapped


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
            if scene.actuators_of(body.name):  # commands are no forces
                wrench = np.zeros_like(wrench)
            duration = float(data["n_rows"].max() - 1) * scene.time_step
            units = {**vars(units_of(scene, body.name)), "time": duration}
            moment = body.shape.unit_moment
            seen = _measured(units, states[..., :3], wrench, moment, scene.time_step)
            if data["assumed"].sel(body=body.name)[THETA]:  # an angle that nobody saw may turn
                seen["turn_rate"] = max(units["turn_rate"], seen.get("turn_rate", 0.0))
            typical = {**units, **seen, **dict(body.typical)}
            body = replace(body, typical=tuple(typical.items()))
        bodies.append(body)
    return scene.replace(bodies=tuple(bodies))


def _measured(
    units: dict[str, float], poses: Floats, wrench: Floats, unit_moment: float, dt: float
) -> dict[str, float]:
    """Return the natural units that poses (trajectory, time, 3) and wrenches show.

    ``unit_moment`` is the body's moment of inertia for each unit of mass (m^2).
    """
    places = poses[..., :2]
    centre = np.nanmean(places, axis=(0, 1)) if np.isfinite(places).any() else np.zeros(2)
    reach = float(np.nanmax(np.linalg.norm(places - centre, axis=-1), initial=0.0))
    speed, acceleration = _rates(places, dt)
    turn_rate, spin_up = _rates(np.unwrap(np.nan_to_num(poses[..., THETA:]), axis=1), dt)
    force = max(units["force"], units["mass"] * acceleration, _size(wrench[..., :THETA]))
    twist = units["mass"] * unit_moment * spin_up
    torque = max(force * units["length"], twist, _size(wrench[..., THETA:]))
    # it turns a little: the noise of an angle that never changes is no turning
    turn_rate = max(turn_rate, 0.01 * speed / units["length"])
    rates = dict(speed=speed, turn_rate=turn_rate)
    return {
        "force": force,
        "torque": torque,
        "range": max(reach, units["length"]),
        "x": float(centre[0]),
        "y": float(centre[1]),
        **{name: value for name, value in rates.items() if value > 0},
    }


def _size(vectors: Floats) -> float:
    """Return the root mean square size of the vectors (..., d) that are not zero."""
    size = np.linalg.norm(vectors, axis=-1)
    size = size[size > 0]  # not NaN either
    return float(np.sqrt(np.mean(size**2))) if len(size) else 0.0


def _rates(values: Floats, dt: float, stands_out: float = 5.0) -> tuple[float, float]:
    """Return the root mean square rate and acceleration of series (trajectory, time, d).

    They are differences over as few rows as stand out of the noise by so many of its standard
    deviations. Third differences of neighbours show it.
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
            if _size(change) > stands_out * np.sqrt(gain) * noise:
                break
            lag *= 2
        rates.append(size)
    return rates[0], rates[1]


def unit_mismatches(history: History) -> tuple[str, ...]:
    """Return a sentence for each velocity that differs from its position's changes by a unit.

    Changes of a position are divided by the integral of the measured velocity. A position is left
    out where that factor varies (noise), where it is near one, or where no unit is near it.

    Parameters
    ----------
    history : History
        Positions and velocities of which both were measured are compared; an angle's turns between
        two rows count as none.

    Returns
    -------
    tuple of str
        Empty where all agree.
    """
    return tuple(sentence for sentence, _ in units_that_differ(history).values())


def units_that_differ(history: History) -> dict[tuple[int, int], tuple[str, dict[str, str]]]:
    """Return why positions and velocities are in units that differ, and the units that cure it.

    By body and position; those without a unit near the factor between them are left out.
    """
    observed, dt = history.dataset["observed"].to_numpy(), float(history.dataset.attrs["time_step"])
    every = {
        (body, d): _unit_words(name, d, rate_factor(observed[:, :, body], d, dt) or 1.0)
        for body, name in enumerate(history.bodies)
        for d in range(VELOCITY)
    }
    return {key: said for key, said in every.items() if said[0]}


def rate_factor(
    states: Floats, d: int, dt: float, *, few: int = 8, spread: float = 0.2
) -> float | None:
    """Return a position's change over the integral of its rate; None where that varies.

    Half of the single factors, of which there are at least ``few``, are within the share ``spread``
    of their median. Changes are taken over more and more intervals: measurement noise counts less.

    Parameters
    ----------
    states : ndarray
        Of a body, shape (trajectory, time, 6), SI units, NaN where missing.
    d : int
        The position's column.
    dt : float
        Time step (s).

    Returns
    -------
    float or None
        Negative where the position changes against its rate.
    """
    position, rate = states[..., d], states[..., d + VELOCITY]
    best, least, middle = None, spread, (rate[:, 1:] + rate[:, :-1]) / 2
    for span in (1, 4, 16):
        n = (position.shape[1] - 1) // span
        change = np.diff(position[:, : n * span + 1 : span], axis=1).ravel()
        integral = dt * middle[:, : n * span].reshape(len(rate), n, span).sum(axis=2).ravel()
        size = np.abs(np.where(np.isfinite(change), integral, np.nan))
        seen = np.isfinite(size).sum() >= few
        # where noise counts least
        fast = (size > 0) & (size >= np.nanquantile(size, 0.9) / 2) if seen else size > np.inf
        change, integral = change[fast], integral[fast]
        if len(integral) < few:
            continue
        # angles may have been wrapped between two rows
        off = np.median(np.abs(wrapped(change - integral)))
        if d == THETA and off < 0.5 * min(1.0, float(np.median(np.abs(integral)))):
            return 1.0
        factor = float(np.median(change / integral))
        if factor == 0.0:  # a coarse sensor's position stays where its velocity is noise
            continue
        varies = float(np.median(np.abs(change / integral - factor))) / abs(factor)
        if varies < least:
            best, least = factor, varies
    return best


def _unit_words(body: str, d: int, factor: float, near: float = 0.1) -> tuple[str, dict[str, str]]:
    """Return a sentence about a factor between a position and its rate that is near a unit's.

    A position in other units changes faster than its velocity says by that factor; where the
    velocity is too large by as much, it may be in these units per second.
    """
    place, rate = STATE[d], STATE[d + VELOCITY]
    units = {1000.0: "mm", 100.0: "cm", 9.81: ""}
    if d == THETA:
        units = {180 / np.pi: "deg", 1000.0: "mrad"}
    rates = {size: f"{unit}/s" if unit else "" for size, unit in units.items()}
    rates |= {30 / np.pi: "rpm"} if d == THETA else {}
    faster = f"{place} of {body} changes {factor:.3g} times as fast as {rate} says"
    larger = f"{rate} of {body} is {1 / factor:.3g} times the rate at which {place} changes"
    for words, column, size, known in (
        (faster, place, factor, units),
        (larger, rate, 1 / factor, rates),
    ):
        for one, unit in known.items():
            if abs(size / one - 1) < near:
                cure = f" {column} may be in {unit}; read it with --units {column}={unit}"
                return f"{words}: units?{cure if unit else ''}", {column: unit} if unit else {}
    return "", {}
