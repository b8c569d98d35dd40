"""Simulations of whole recordings from their first states."""

from __future__ import annotations

import numpy as np

from pbrl_ppl.errors import HistoryError, SimulationError
from pbrl_ppl.history import History
from pbrl_ppl.physics.physics import Physics
from pbrl_ppl.physics.placement import check_history
from pbrl_ppl.state import Floats


def simulated_recording(physics: Physics, phi: Floats, recorded: History) -> list[Floats]:
    """Return the states of a recording's trajectories as simulated from their first states.

    Parameters
    ----------
    physics : Physics
        Scene, effects and engine.
    phi : ndarray
        Parameter vectors, shape (draw, p), SI units.
    recorded : History
        Its first complete states and its commands are simulated.

    Returns
    -------
    list of ndarray
        Shape (trajectory, time, body, 6) for each draw, SI units; NaN outside a simulation.

    Raises
    ------
    HistoryError
        If a trajectory has no complete state.
    SimulationError
        If the engine diverges.
    """
    # one segment a trajectory, up to its end
    segments = recorded.segments(int(recorded.dataset["n_rows"].max()) - 1)
    lost = set(range(recorded.n_trajectories)) - set(segments.trajectory.tolist())
    if lost:
        label = recorded.dataset["trajectory"].to_numpy()[min(lost)]
        raise HistoryError(
            f"history: trajectory {label} has no complete state to start from; measure one, drop it"
            " or pass --estimate-velocities"
        )
    check_history(physics.scene, recorded, segments)
    predicted = physics.predict(phi, segments.start, segments.inputs)
    follows = recorded.dataset["kinematic"].to_numpy()
    n_rows = recorded.dataset["n_rows"].to_numpy()
    result = []
    for drawn in predicted:
        states = np.full(recorded.dataset["observed"].shape, np.nan)
        states[:, :, follows] = recorded.dataset["start"].to_numpy()[:, :, follows]
        for i, (trajectory, step) in enumerate(
            zip(segments.trajectory, segments.step, strict=True)
        ):
            rows = np.arange(step + 1, n_rows[trajectory])
            after = drawn[i, : len(rows)][:, ~follows]
            if not np.isfinite(after).all():
                raise SimulationError(
                    "simulate: the engine diverged under these parameters; check them and their"
                    " units, or use more substeps in the scene"
                )
            states[np.ix_([trajectory], [step], ~follows)] = segments.start[i][~follows]
            states[np.ix_([trajectory], rows, ~follows)] = after
        result.append(states)
    return result
