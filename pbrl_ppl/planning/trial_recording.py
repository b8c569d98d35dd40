"""Recordings of a declared model that are simulated before any is made."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pbrl_ppl.effects import is_pivoted
from pbrl_ppl.errors import HistoryError, ParameterError
from pbrl_ppl.history import History
from pbrl_ppl.physics import Physics, simulated_recording
from pbrl_ppl.scene import Scene, motion_time, nearest, state_sizes, units_of
from pbrl_ppl.state import STATE, Floats

#: Measurement noise where none is known, as a share of the motion.
_NOISE = 1e-3


def parameters_of(physics: Physics, given: Mapping[str, float]) -> Floats:
    """Return the parameters that are given by label or name, others at the prior's centre, (p,)."""
    labels = physics.layout.labels
    names = [label.partition("[")[0] for label in labels]
    both = [*names, *labels]
    for name in sorted({*given} - {*both}):
        raise ParameterError(f'parameters: there is no parameter "{name}"{nearest(name, both)}')
    priors = zip(labels, names, physics.layout.priors, strict=True)
    return np.array([given.get(one, given.get(name, prior.centre)) for one, name, prior in priors])


def measured(
    scene: Scene, commands: History, states: Floats, rng: np.random.Generator
) -> tuple[History, dict[str, float]]:
    """Return the recording of simulated states, and its noise by dimension, SI units.

    What the commands' file measures after the first rows is measured; if nothing, the dimensions of
    the scene's noise, or else x, y and theta.
    """
    dataset, known = commands.dataset.copy(), dict(scene.noise)
    seen = np.isfinite(dataset["observed"].to_numpy())
    if not seen[:, 1:].any():
        seen = np.isin(STATE, list(known) or STATE[:3]) & np.isfinite(states)
    motion = np.nanstd(states, axis=(0, 1)).max(axis=0)
    sd = _NOISE * np.where(motion > 0, motion, state_sizes(scene))
    sd = np.array([known.get(name, size) for name, size in zip(STATE, sd, strict=True)])
    free = ~dataset["kinematic"].to_numpy()[:, None]
    noisy = states + free * sd * rng.standard_normal(states.shape)
    dataset["observed"] = dataset["observed"].copy(data=np.where(seen, noisy, np.nan))
    dataset["start"] = dataset["start"].copy(data=states)
    noise = {name: float(sd[d]) for d, name in enumerate(STATE) if seen[..., d].any()}
    return History(dataset), noise


def simulated(
    physics: Physics, phi: Floats, commands: History | None, rng: np.random.Generator
) -> tuple[History, Floats]:
    """Return commands and simulated states, shape (trajectory, time, body, 6), SI units.

    Pushes are proposed that move each body by its size, or turn it in its hinge by 0.25 rad.
    """
    for push in (0.25, 1.0, 4.0):
        tried = _proposed(physics.scene, rng, push) if commands is None else commands
        # the engine of the pieces, so that their residual is noise alone
        (states,) = simulated_recording(physics.medium, phi[None], tried)
        x, y, theta = np.ptp(states[..., :3], axis=1).mean(axis=0).T
        bodies = zip(physics.scene.moving, np.hypot(x, y), theta, strict=True)
        if commands is not None or all(
            turn > 0.25 if is_pivoted(physics.scene, body) else way > body.shape.bounding_radius
            for body, way, turn in bodies
        ):
            break
    return tried, states


def _proposed(
    scene: Scene,
    rng: np.random.Generator,
    push: float,
    *,
    trajectories: int = 4,
    intervals: int = 100,
    turn: float = 0.2,
) -> History:
    """Return pushes, pauses and pushes back of random sizes, from rest at the scene's poses.

    Each is held for the time in which a typical force changes the motion. A body in a hinge is
    turned with ``push`` typical torques at most, another is pushed with as many typical forces and
    turned with a share ``turn`` of them.

    Raises
    ------
    HistoryError
        If a body follows a path.
    """
    bodies = scene.moving
    if any(body.kinematic for body in bodies):
        raise HistoryError("rehearse: a body follows a path; give a file of commands that has it")
    hold = max(2, round(motion_time(scene) / scene.time_step))
    states = np.full((trajectories, intervals + 1, len(bodies), len(STATE)), np.nan)
    most = np.zeros((len(bodies), 3))
    for i, body in enumerate(bodies):
        units, hinged = units_of(scene, body.name), is_pivoted(scene, body)
        shares = (0.0, 0.0, 1.0) if hinged else (1.0, 1.0, turn)
        most[i] = push * np.array(shares) * (units.force, units.force, units.torque)
        states[:, 0, i] = (*(body.pose or (0.0, 0.0, 0.0)), 0.0, 0.0, 0.0)
        if hinged:  # the hinge says where it is
            states[:, 0, i, [0, 1, 3, 4]] = np.nan
    count = -(-intervals // (4 * hold))
    size = rng.uniform(-1.0, 1.0, (trajectories, count, len(bodies), 3)) * most
    pieces = np.stack([size, 0.0 * size, -size, 0.0 * size], axis=2)
    wrenches = pieces.reshape(trajectories, -1, len(bodies), 3).repeat(hold, axis=1)
    return History.of_arrays(states, scene, wrenches[:, :intervals])
