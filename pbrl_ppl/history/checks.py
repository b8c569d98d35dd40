"""Checks of a recording: gaps, states that rest on no measurement, and wrong units."""

import numpy as np

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.history import History
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, THETA, Bools, Floats, wrapped


def unseen(history: History) -> Bools:
    """Return which bodies were not seen in a row, shape (trajectory, time, body).

    A trajectory's first row and a kinematic body's path count as seen.
    """
    dataset = history.dataset
    hidden = ~np.isfinite(dataset["observed"].to_numpy()).any(axis=-1)
    hidden[:, 0] = False
    hidden[..., dataset["kinematic"].to_numpy()] = False
    rows = np.arange(hidden.shape[1]) < dataset["n_rows"].to_numpy()[:, None]
    return np.asarray(hidden & rows[..., None])


def longest_gap(history: History) -> int:
    """Return the most intervals between rows with all bodies in a sparse recording, else 1.

    A recording is sparse if more than half of the steps from one such row to the next skip rows: a
    block that is seen before and after a push, say.
    """
    complete = np.asarray(~unseen(history).any(axis=-1))
    rows = history.dataset["n_rows"].to_numpy()
    gaps = np.concatenate(
        [np.diff(np.flatnonzero(each[:n])) for each, n in zip(complete, rows, strict=True)]
    )
    return int(gaps.max()) if len(gaps) and np.median(gaps) > 1 else 1


def check_start(history: History, scene: Scene) -> None:
    """Refuse a history whose transitions start from states without measurements.

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
        f'{", ".join(np.array(STATE)[columns])} of body "{body.name}"'
        for body, columns in zip(scene.moving, assumed, strict=True)
        if columns.any()
    ]
    raise HistoryError(
        f"history: single transitions start from measured states: missing are {'; '.join(parts)};"
        " fit whole trajectories (trajectories=True), measure them, declare the hinge that holds"
        " the body in the scene (it gives x, y, vx, vy from theta and omega), or pass"
        " estimate_velocities=True (it gives vx, vy, omega from x, y, theta)"
    )


#: Factors by which a position in other units changes faster than its velocity says, and the units;
#: where the velocity is too large by as much, it may be in these units per second.
_LENGTHS = {1000.0: "mm", 100.0: "cm", 9.81: ""}
_SPEEDS = {1000.0: "mm/s", 100.0: "cm/s", 9.81: ""}
_ANGLES = {180 / np.pi: "deg", 1000.0: "mrad"}
_RATES = {180 / np.pi: "deg/s", 1000.0: "mrad/s", 30 / np.pi: "rpm"}
#: How far a measured factor may be from one of these, as a share of it.
_NEAR = 0.1
#: How far half of the single factors may be from their median, as a share of it.
_SPREAD = 0.2
#: Over how many intervals changes are taken: the longer, the less measurement noise counts.
_SPANS = (1, 4, 16)
#: Changes that a factor is computed from, at least.
_ENOUGH = 8


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
    observed = history.dataset["observed"].to_numpy()
    found = []
    for i, body in enumerate(history.bodies):
        for d in range(3):
            position, rate = observed[:, :, i, d], observed[:, :, i, d + 3]
            dt = float(history.dataset.attrs["time_step"])
            factor = _factor(position, rate, dt, angle=d == THETA)
            if factor is not None and (words := _sentence(body, d, factor)):
                found.append(words)
    return tuple(found)


def _factor(position: Floats, rate: Floats, dt: float, *, angle: bool) -> float | None:
    """Return a position's change over the integral of its rate; None where that varies."""
    best, least = None, _SPREAD
    for span in _SPANS:
        n = (position.shape[1] - 1) // span
        change = np.diff(position[:, : n * span + 1 : span], axis=1).ravel()
        mean = ((rate[:, 1:] + rate[:, :-1]) / 2)[:, : n * span].reshape(len(rate), n, span)
        integral = dt * span * mean.mean(axis=2).ravel()
        seen = np.isfinite(change) & np.isfinite(integral)
        change, integral = change[seen], integral[seen]
        if len(integral) < _ENOUGH:
            continue
        size = np.abs(integral)
        fast = (size > 0) & (size >= np.quantile(size, 0.9) / 2)  # where noise counts least
        change, integral = change[fast], integral[fast]
        if len(integral) < _ENOUGH:
            continue
        # angles may have been wrapped between two rows
        off = np.median(np.abs(wrapped(change - integral)))
        if angle and off < 0.5 * min(1.0, float(np.median(np.abs(integral)))):
            return 1.0
        factor = float(np.median(change / integral))
        spread = float(np.median(np.abs(change / integral - factor))) / (abs(factor) or np.inf)
        if factor > 0 and spread < least:
            best, least = factor, spread
    return best


def _sentence(body: str, d: int, factor: float) -> str:
    """Return a sentence about a factor between a position and its rate that is near a unit's."""
    place, rate = STATE[d], STATE[d + 3]
    units, rates = (_ANGLES, _RATES) if d == THETA else (_LENGTHS, _SPEEDS)
    faster = f"{place} of {body} changes {factor:.3g} times as fast as {rate} says"
    larger = f"{rate} of {body} is {1 / factor:.3g} times the rate at which {place} changes"
    for words, column, size, known in (
        (faster, place, factor, units),
        (larger, rate, 1 / factor, rates),
    ):
        for one, unit in known.items():
            if abs(size / one - 1) < _NEAR:
                cure = f" {column} may be in {unit}; read it with --units {column}={unit}"
                return f"{words}: units?{cure if unit else ''}"
    return ""
