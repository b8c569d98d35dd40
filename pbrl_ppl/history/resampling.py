"""Rows at uneven times, interpolated to the scene's time step."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from pbrl_ppl.errors import HistoryError, LayoutError, ResamplingWarning, warn
from pbrl_ppl.history.kinematics import column_noise, unwrapped
from pbrl_ppl.history.rows import TIME_TOLERANCE, Rows, rows_of_arrays
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, THETA, VELOCITY, WRENCH, Bools, Floats, Ints

#: Longest gap of a trajectory, in time steps.
LONGEST = 5.0
#: A sample this near to a row's time (in time steps) is taken as it is.
_SAME = 1e-6


@dataclass(frozen=True)
class _Track:
    """One body in one trajectory: time (s), states (time, 6), wrenches (time, 3), rows."""

    time: Floats
    state: Floats
    action: Floats
    row: Ints


def resampled(rows: Rows, scene: Scene, source: str, *, reach: float = 1.9) -> Rows:
    """Return rows every ``time_step`` of the scene; the same if they are that already.

    Positions with measured velocities are interpolated by Hermite's cubics, and velocities
    linearly, both exact for a constant acceleration between samples; positions alone by monotone
    cubics, which never leave the range of the samples beside. A wrench, held until the next sample,
    is averaged over each step, which keeps its impulse. Of samples within 5 % of a time step the
    first is taken.

    Parameters
    ----------
    rows : Rows
        As recorded.
    scene : Scene
        Its time step and bodies are used.
    source : str
        Name of the recording in messages.
    reach : float
        Rows in a longer gap, in time steps, are left empty: a sample was lost there.

    Raises
    ------
    HistoryError
        If time goes back, samples are further apart than the time step, or a gap is longer than 5
        of them.

    Warns
    -----
    ResamplingWarning
        What was done, and what it does to the noise.
    """
    dt = scene.time_step
    tracks = [_tracks(rows, label, scene) for label in range(len(rows.labels))]
    spacing = np.concatenate([np.diff(track.time) for bodies in tracks for track in bodies])
    merged = sum(len(track.time) for bodies in tracks for track in bodies) < len(rows.time)
    if not merged and (np.abs(spacing - dt) <= TIME_TOLERANCE * dt).all():
        return rows
    _check_spacing(rows, tracks, dt)
    quotients = np.array([_quotients(samples) for samples in zip(*tracks, strict=True)])
    kept = []
    for label, bodies in zip(rows.labels, tracks, strict=True):
        begin = max(track.time[0] for track in bodies)
        steps = int((min(track.time[-1] for track in bodies) - begin) / dt + _SAME)
        if steps > 0:
            kept.append((label, begin + dt * np.arange(steps + 1), bodies))
    if not kept:
        raise HistoryError(
            f"{source}: no trajectory is as long as a time step of {dt:g} s; give a shorter one"
        )
    labels, grids, _ = zip(*kept, strict=True)
    shape = (len(grids), max(map(len, grids)), len(scene.moving))
    state, action = (np.full((*shape, len(names)), np.nan) for names in (STATE, WRENCH))
    clock = np.full(shape[:2], np.nan)
    between, empty = 0, 0
    for i, (_, grid, bodies) in enumerate(kept):
        clock[i, : len(grid)] = grid
        for body, track in enumerate(bodies):
            states = _states(track, grid, reach * dt, _SAME * dt)
            state[i, : len(grid), body] = states
            # the last wrench acts in an interval that was not measured
            for d, column in enumerate(track.action[:-1].T):
                action[i, : len(grid) - 1, body, d] = held_means(grid, track.time[:-1], column)
            sample = track.time[np.searchsorted(track.time, grid + _SAME * dt) - 1]
            between += int((grid - sample > _SAME * dt).sum())
            measured = ~np.isnan(track.state).all(axis=0)
            empty += int((np.isnan(states) & measured).any(axis=1).sum())
    state[:, :, quotients] = np.nan
    result = rows_of_arrays(state, scene, action, clock, labels)
    message = (
        f"{source}: samples are {spacing.min():.4g} to {spacing.max():.4g} s apart (median"
        f" {np.median(spacing):.4g} s), not {dt:g} s: {len(rows.time)} rows were resampled to"
        f" {len(result.time)}"
    )
    if between:
        message += (
            f"; {between / len(result.time):.0%} are interpolated (positions by cubics, velocities"
            " linearly; wrenches are means), with errors that are less independent than they look"
        )
    if short := len(tracks) - len(kept):
        message += f"; {short} trajectories shorter than a time step are left out"
    if empty:
        message += f"; {empty} rows have empty cells, in gaps of more than {reach * dt:.4g} s"
    if quotients.any():
        lost = [f"{STATE[d]} of {scene.moving[body].name}" for body, d in np.argwhere(quotients)]
        message += (
            f"; {', '.join(lost)}: difference quotients of the positions, no measurements, and left"
            " empty (estimate_velocities, --estimate-velocities)"
        )
    warn(message, ResamplingWarning)
    return result


def _tracks(rows: Rows, label: int, scene: Scene, near: float = 0.05) -> list[_Track]:
    """Return the rows of a trajectory by body, each with times that rise.

    A sample ``near`` to the one before (in time steps) is the same: their difference is noise.
    """
    tracks = []
    for position, body in enumerate(scene.moving):
        row = np.flatnonzero((rows.trajectory == label) & (rows.body == position))
        if not row.size:
            raise HistoryError(
                f'history: body "{body.name}" has no rows in trajectory {rows.labels[label]}; add'
                " them, or drop the trajectory"
            )
        time = rows.time[row]
        for back in np.flatnonzero(np.diff(time) <= 0):
            at = int(row[back + 1])
            raise rows.error(
                at,
                f"time does not rise in {rows.trajectory_of(at)}: {rows.time[at]:.6g} s after"
                f" {time[back]:.6g} s; sort the rows, drop duplicates",
            )
        row = row[np.append(True, np.diff(time) >= near * scene.time_step)]
        time, action = rows.time[row], rows.action[row]
        missing = np.isnan(action[:-1]).any(axis=1)
        if missing.any() and not body.kinematic:
            at = int(row[missing.argmax()])
            raise rows.error(
                at,
                f"a wrench is empty in {rows.trajectory_of(at)}; expected numbers on every row but"
                " the last; write 0 where nothing pushed",
            )
        tracks.append(_Track(time, rows.state[row], action, row))
    return tracks


def _check_spacing(rows: Rows, tracks: list[list[_Track]], dt: float) -> None:
    """Refuse samples that are too far apart, and gaps that are too long.

    With a median of more than 1.1 time steps between samples rows would be made up.
    """
    for track in (track for bodies in tracks for track in bodies if len(track.time) > 1):
        spacing = np.diff(track.time)
        worst, median = int(spacing.argmax()), np.median(spacing)
        row = int(track.row[worst + 1])
        if median > 1.1 * dt:
            raise rows.error(
                row,
                f"samples of {rows.trajectory_of(row)} are {median:.4g} s apart, more than the time"
                f" step of {dt:g} s, so that resampling would make rows up; give a time step of at"
                f" least {median:.4g} s",
            )
        if spacing[worst] > LONGEST * dt:
            gaps = float(f"{LONGEST * dt:.6g}")
            message = (
                f"{spacing[worst]:.4g} s since the sample before in {rows.trajectory_of(row)}, more"
                f" than {LONGEST:g} time steps of {dt:g} s; give the rows after the gap a"
                f" trajectory of their own, or cut = {{ gaps = {gaps:g} }} in [recording]"
            )
            raise LayoutError(str(rows.error(row, message)), cut={"gaps": gaps})


def _quotients(tracks: tuple[_Track, ...], near: float = 1e-3) -> Bools:
    """Return which velocities of a body are difference quotients of its positions, shape (6,).

    They are as near to one as the share ``near`` of their spread. After interpolation at uneven
    times they would look like independent measurements.
    """
    computed = np.zeros(len(STATE), dtype=bool)
    for d in range(VELOCITY, len(STATE)):
        off, rates = [], []
        for track in tracks:
            place, rate = track.state[:, d - VELOCITY], track.state[:, d]
            if len(place) < 3 or not np.isfinite([place, rate]).all():
                continue
            place = unwrapped(track.time, place, rate) if d - VELOCITY == THETA else place
            one = np.diff(place) / np.diff(track.time)
            two = (place[2:] - place[:-2]) / (track.time[2:] - track.time[:-2])
            off.append(np.abs(rate[1:-1] - [one[:-1], two, one[1:]]))
            rates.append(rate[1:-1])
        if rates and (spread := float(np.concatenate(rates).std())) > 0:
            # at the ends and in gaps they may be anything
            misfit = np.quantile(np.concatenate(off, axis=1), 0.95, axis=1).min()
            computed[d] = misfit < near * spread
    return computed


def _states(track: _Track, grid: Floats, gap: float, same: float) -> Floats:
    """Return the states at the grid's times, shape (step, 6); NaN in longer gaps (s)."""
    result = np.full((len(grid), len(STATE)), np.nan)
    for d in range(len(STATE)):
        finite = np.flatnonzero(np.isfinite(track.state[:, d]))
        wide = np.flatnonzero(np.diff(track.time[finite]) > gap) + 1
        for run in np.split(finite, wide) if finite.size else ():
            time, values = track.time[run], track.state[run, d]
            inside = (grid >= time[0] - same) & (grid <= time[-1] + same)
            rate = track.state[run, d + VELOCITY] if d < VELOCITY else None
            if d == THETA:
                values = unwrapped(time, values, track.state[run, 5])
            result[inside, d] = _interpolated(time, values, rate, grid[inside])
    return result


def _interpolated(time: Floats, values: Floats, rate: Floats | None, grid: Floats) -> Floats:
    """Return a run of samples at the grid's times; a position's ``rate`` is used where complete."""
    grid = np.clip(grid, time[0], time[-1])
    if rate is None or len(time) < 2:
        return np.interp(grid, time, values)
    if not np.isfinite(rate).all():
        return np.asarray(PchipInterpolator(time, values)(grid))
    # a position turns by an eighth of the change of its velocity, and by its noise
    part = np.clip(np.searchsorted(time, grid, side="right") - 1, 0, len(time) - 2)
    beyond = np.diff(time) * np.abs(np.diff(rate)) / 8 + column_noise([values], 2, robust=True)
    low, high = (pick(values[:-1], values[1:])[part] for pick in (np.minimum, np.maximum))
    cubic = CubicHermiteSpline(time, values, rate)(grid)
    return np.asarray(np.clip(cubic, low - beyond[part], high + beyond[part]))


def held_means(times: Floats, stamps: Floats, values: Floats) -> Floats:
    """Return the means between times of what holds from each stamp to the next, shape (n - 1,).

    They keep its impulse. Before the first stamp its value holds.

    Parameters
    ----------
    times, stamps : ndarray
        Rising, shapes (n,) and (m,), s.
    values : ndarray
        Shape (m,); the last holds after its stamp.

    Examples
    --------
    >>> held_means(np.arange(3.0), np.array([0.0, 1.5]), np.array([1.0, 3.0]))
    array([1., 2.])
    """
    which = np.clip(np.searchsorted(stamps, times, side="right") - 1, 0, None)
    impulse = np.append(0.0, np.cumsum(values[:-1] * np.diff(stamps)))
    impulse = impulse[which] + values[which] * (times - stamps[which])
    return np.asarray(np.diff(impulse) / np.diff(times))
