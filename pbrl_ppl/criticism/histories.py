"""Checks of the two histories before anything is fitted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import (
    History,
    UnusedVelocity,
    bad_frames,
    measured_alone,
    unused_velocities,
    without_bad_frames,
)
from pbrl_ppl.likelihood import cells_of, check_moves
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE


def checked_histories(
    scene: Scene, train: History, test: History
) -> tuple[History, History, tuple[UnusedVelocity, ...], tuple[str, ...]]:
    """Both histories without unused velocities and single bad frames, and which those are.

    Parameters
    ----------
    scene : Scene
        The declared scene.
    train, test : History
        What is fitted, and what is judged by.

    Returns
    -------
    train, test : History
        With what was measured alone.
    unused : tuple of UnusedVelocity
        Velocity columns of the training history that are not used, in either.
    bad : tuple of str
        A sentence for each single bad frame that is left out.

    Raises
    ------
    HistoryError
        If they are of other bodies, another time step or other measured dimensions, or nothing
        moves in the first.
    """
    names = [body.name for body in scene.moving]
    for which, history in (("training", train), ("test", test)):
        if list(history.bodies) != names:
            raise HistoryError(
                f"{which} history: it is of {', '.join(history.bodies)}, the scene has"
                f" {', '.join(names)}; load it with this scene"
            )
        step = float(history.dataset.attrs["time_step"])
        if not np.isclose(step, scene.time_step):
            raise HistoryError(
                f"{which} history: it has a row each {step:g} s, the scene each"
                f" {scene.time_step:g} s; load it with this scene"
            )
    same, unused = test is train, _unused(train)
    train, test = measured_alone(train, unused), measured_alone(test, unused)
    train, bad = without_bad_frames(train)
    test, more = without_bad_frames(test)
    check_moves(cells_of(scene, train), scene)
    known, asked = (
        np.isfinite(history.dataset["observed"].to_numpy()).any(axis=(0, 1))
        for history in (train, test)
    )
    if (asked & ~known).any():
        raise HistoryError(
            f"test history measures {named(scene, asked & ~known)}, which the training history does"
            " not; leave those columns empty, or measure them in both"
        )
    held_out = [] if same else [f"held out: {frame}" for frame in more]
    return train, test, unused, (*map(str, bad), *held_out)


def _unused(history: History) -> tuple[UnusedVelocity, ...]:
    """Which velocities are not used, by trajectories without bad frames if most are.

    A bad frame makes positions look noisy, and a measured velocity as if they predicted it.
    """
    clear = np.flatnonzero(~bad_frames(history).any(axis=(1, 2, 3)))
    most = 2 * len(clear) >= history.n_trajectories
    return unused_velocities(history.select(clear) if most else history)


def named(scene: Scene, columns: NDArray[np.bool_]) -> str:
    """Name columns, shape (body, state), for a message."""
    return ", ".join(f"{STATE[d]} of {scene.moving[body].name}" for body, d in np.argwhere(columns))
