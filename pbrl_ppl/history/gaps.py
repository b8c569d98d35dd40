"""Gaps of a recording: rows in which bodies were not seen, and columns that were not measured."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.history import History
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE

Bools = npt.NDArray[np.bool_]


def unseen(history: History) -> Bools:
    """Which bodies were not seen in a row, shape (trajectory, time, body).

    A trajectory's first row has a state, and a body that follows a path is where that says.
    """
    dataset = history.dataset
    hidden = ~np.isfinite(dataset["observed"].to_numpy()).any(axis=-1)
    hidden[:, 0] = False
    hidden[..., dataset["kinematic"].to_numpy()] = False
    rows = np.arange(hidden.shape[1]) < dataset["n_rows"].to_numpy()[:, None]
    return np.asarray(hidden & rows[..., None])


def longest_gap(history: History) -> int:
    """Intervals between rows that show all bodies, in a sparse recording the most; 1 otherwise.

    A recording is sparse if more than half of the steps from one such row to the next skip rows: a
    block that is seen before and after a push, say.
    """
    shown = np.asarray(~unseen(history).any(axis=-1))
    rows = history.dataset["n_rows"].to_numpy()
    gaps = [np.diff(np.flatnonzero(own[:n])) for own, n in zip(shown, rows, strict=True)]
    each = np.concatenate(gaps)
    return int(each.max()) if len(each) and np.median(each) > 1 else 1


def check_start(history: History, scene: Scene) -> None:
    """Refuse a history whose transitions start from states that rest on no measurement.

    Transitions of Eq. 11 start from states as measured; in whole trajectories states are latent.

    Raises
    ------
    HistoryError
        If a column of the states was neither measured nor allowed to be estimated.
    """
    assumed = history.dataset["assumed"].to_numpy()
    if not assumed.any():
        return
    parts = [
        f'{", ".join(np.array(STATE)[own])} of body "{body.name}"'
        for body, own in zip(scene.moving, assumed, strict=True)
        if own.any()
    ]
    raise HistoryError(
        f"history: single transitions start from measured states: missing are {'; '.join(parts)};"
        " fit whole trajectories (trajectories=True), measure them, declare the hinge that holds"
        " the body in the scene (it gives x, y, vx, vy from theta and omega), or pass"
        " estimate_velocities=True (it gives vx, vy, omega from x, y, theta)"
    )
