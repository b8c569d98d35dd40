"""Histories: measured states and actions, validated, as an `xarray.Dataset`."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import numpy as np
import numpy.typing as npt
import pandas as pd
import xarray as xr

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history.files import read_table, to_table, write_dataset
from pbrl_ppl.history.kinematics import complete_start, kinematic_bodies, path_velocities
from pbrl_ppl.history.logs import Paths, labels_in, logs_in, read_commands
from pbrl_ppl.history.resampling import resampled
from pbrl_ppl.history.rows import Rows, padded, rows_of_arrays, rows_of_table, with_lines
from pbrl_ppl.scene import Recording, Scene
from pbrl_ppl.state import STATE, STATE_UNITS, WRENCH, WRENCH_UNITS, Bools, Floats, Ints

if TYPE_CHECKING:
    from pbrl_ppl.history.conversion import TableReading


@dataclass(frozen=True, eq=False)
class Segments:
    """Pieces of a history: predict H intervals from one state.

    Attributes
    ----------
    start : (n, k, 6) array
        State to start from, complete (m, m, rad, m/s, m/s, rad/s).
    actions : (n, H, k, 3) array
        Wrench in each interval (N, N, N m); of a kinematic body the velocity that leads along its
        path (m/s, m/s, rad/s). Zero after a trajectory's end.
    observed : (n, H, k, 6) array
        State measured at the end of each interval; NaN where missing, after a trajectory's end, and
        for kinematic bodies, which nothing has to explain.
    trajectory, step : (n,) arrays of int
        Position of the trajectory and of the step where the piece starts.
    inputs : (n, H, k, 9) array
        Everything that acts in each interval, in the order of :data:`pbrl_ppl.state.INPUT`: the
        wrench, the wrench in the interval before, and when it is. The engine takes it in place of
        the actions.
    """

    start: Floats
    actions: Floats
    observed: Floats
    trajectory: Ints
    step: Ints
    inputs: Floats

    @property
    def n(self) -> int:
        """Number of segments."""
        return len(self.start)

    @property
    def horizon(self) -> int:
        """Intervals in each segment, H."""
        return int(self.actions.shape[1])


class History:
    """A measured history of the bodies of a scene that move; treat it as read-only.

    Parameters
    ----------
    dataset : xarray.Dataset
        As built by `load`, `of_arrays` and `from_dataframe`, with the variables

        - ``observed`` (trajectory, time, body, state): the measured state; NaN where missing
          (m, m, rad, m/s, m/s, rad/s);
        - ``action`` (trajectory, time, body, wrench): held over the interval that starts there;
          NaN on a trajectory's last row and after, without a meaning for a kinematic body
          (N, N, N m);
        - ``start`` (trajectory, time, body, state): the state completed through hinges, estimated
          velocities and the scene's pose;
        - ``assumed`` (body, state): columns of it that may not start single transitions (Eq. 11);
        - ``clock`` (trajectory, time): time (s);
        - ``began`` (trajectory,): time at which the trajectory began (s);
        - ``number`` (trajectory,): which trajectory of the recording it is, from 0;
        - ``before`` (trajectory, body, wrench): what acted before; zero;
        - ``n_rows`` (trajectory,): number of steps;

        and the coordinate ``kinematic`` (body,): whether a body follows its recorded path.

    Examples
    --------
    ::

        history = History.load("train.csv", scene)
        history.segments(horizon=5).start.shape
    (72, 1, 6)
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        if "began" not in dataset:  # of a file from before laws knew it
            dataset = dataset.assign(began=xr.zeros_like(dataset["number"]))
        self.dataset = dataset

    @classmethod
    def load(cls, path: Paths, scene: Scene, **reading: Unpack[TableReading]) -> History:
        """Read a history from a file, by suffix, or from several.

        Parameters
        ----------
        path : str or pathlib.Path, or sequence of them
            File with one row for each (trajectory, step, body), or one that `save` wrote. A folder
            of files, or several, are trajectories of one history, in natural order of names, which
            are their labels.
        scene : Scene
            The bodies, hinges and time step that are expected; its ``recording`` says how a file of
            another program is laid out.
        **reading
            As of `TableReading`: ``estimate_velocities``, and for tables of others
            ``columns={"x": "pos_x", "force_x": 0.0}`` (their names, or numbers),
            ``units={"x": "mm"}``, ``resample=True`` for uneven samples.

        Raises
        ------
        HistoryError
            If the file cannot be used; the message says where and what to do.
        """
        given = scene.recording or Recording()
        layout = given.with_entries(columns=reading.get("columns") or {})
        logs = logs_in(path, layout)
        parts = []
        for log in logs:
            table, commands = read_table(log, layout), read_commands(log, scene.recording)
            source = f"history {log}"
            parts += [_rows(table, scene, scene.recording, commands, source, **reading)]
        estimated = reading.get("estimate_velocities") or given.velocities == "estimate"
        return cls._of_rows(parts, scene, logs=logs, estimate_velocities=estimated)

    @classmethod
    def from_dataframe(
        cls,
        frame: pd.DataFrame,
        scene: Scene,
        *,
        layout: Recording | None = None,
        commands: pd.DataFrame | None = None,
        **reading: Unpack[TableReading],
    ) -> History:
        """Build a history from a table; arguments, errors and row numbers as `load` of a file.

        A table is a history's unless ``layout`` says otherwise, such as the scene's ``recording``.
        ``commands`` is the table of commands with times of their own.
        """
        if not isinstance(frame, pd.DataFrame):
            raise HistoryError(f"history: got {type(frame).__name__}, expected a pandas.DataFrame")
        rows = _rows(frame, scene, layout, commands, "history", **reading)
        declared = layout is not None and layout.velocities == "estimate"
        estimated = reading.get("estimate_velocities") or declared
        return cls._of_rows([rows], scene, estimate_velocities=estimated)

    @classmethod
    def of_arrays(
        cls,
        states: npt.ArrayLike,
        scene: Scene,
        actions: npt.ArrayLike | None = None,
        times: npt.ArrayLike | None = None,
        *,
        labels: Sequence[int | str] | None = None,
        estimate_velocities: bool = False,
        resample: bool = False,
    ) -> History:
        """Build a history from arrays, as a simulator or a driver's script has them.

        Parameters
        ----------
        states : array
            Measured states, shape (trajectory, time, body, 6), bodies in the order of
            ``scene.moving``; m, m, rad, m/s, m/s, rad/s; NaN where nothing was measured.
        scene : Scene
            The bodies, hinges and time step that are expected.
        actions : array, optional
            Wrenches from each row to the next, shape (trajectory, time, body, 3) or one row less;
            N, N, N m. Without them, nothing pushes.
        times : array, optional
            Shape (time,) or (trajectory, time); s; NaN after the end of a trajectory that is
            shorter than others. By default a row each ``time_step`` of the scene.
        labels : sequence of int or str, optional
            Of the trajectories; 0, 1, ... by default.
        estimate_velocities : bool
            As of `load`.
        resample : bool
            Whether uneven ``times`` are interpolated every ``time_step`` of the scene.

        Raises
        ------
        HistoryError
            If a shape, a time or a number is wrong; the message says where and what to do.

        Examples
        --------
        A puck that slides at 1 m/s, in three trajectories of twenty rows:

        >>> from pbrl_ppl.scene import Body, Scene, Shape
        >>> scene = Scene(time_step=0.1, bodies=(Body("puck", Shape.circle(0.1)),))
        >>> states = np.zeros((3, 20, 1, 6))
        >>> states[..., 0] = 0.1 * np.arange(20)[:, None]
        >>> states[..., 3] = 1.0
        >>> history = History.of_arrays(states, scene)
        >>> history.n_trajectories, history.n_transitions
        (3, 57)
        """
        rows = rows_of_arrays(states, scene, actions, times, labels)
        if resample:
            rows = resampled(rows, scene, "history")
        return cls._of_rows([rows], scene, estimate_velocities=estimate_velocities)

    @classmethod
    def _of_rows(
        cls,
        parts: Sequence[Rows],
        scene: Scene,
        *,
        logs: Sequence[Path] = (Path(),),
        estimate_velocities: bool,
    ) -> History:
        """Return the history of each log's rows at the scene's time step, after checks of all."""
        counts, *checked = zip(*(padded(rows, scene) for rows in parts), strict=True)
        n_rows = np.concatenate(counts)
        clock, state, action = (_stacked(arrays, int(n_rows.max())) for arrays in checked)
        start, assumed = complete_start(state, scene)
        if estimate_velocities:  # of positions that were measured, or that hinges give
            assumed[:, 3:] &= assumed[:, :3]
        dims = ("trajectory", "time", "body")
        states, wrenches = ({"units": ", ".join(units)} for units in (STATE_UNITS, WRENCH_UNITS))
        before = np.zeros_like(action[:, 0])
        dataset = xr.Dataset(
            {
                "observed": ((*dims, "state"), state, states),
                "action": ((*dims, "wrench"), action, wrenches),
                "start": ((*dims, "state"), start, states),
                "assumed": (("body", "state"), assumed),
                "clock": (("trajectory", "time"), clock, {"units": "s"}),
                "began": ("trajectory", clock[:, 0], {"units": "s"}),
                "n_rows": ("trajectory", n_rows),
                "number": ("trajectory", np.arange(float(len(n_rows)))),
                "before": (("trajectory", "body", "wrench"), before, wrenches),
            },
            coords={
                "trajectory": labels_in(logs, [rows.labels for rows in parts]),
                "time": np.arange(clock.shape[1]),
                "body": [body.name for body in scene.moving],
                "kinematic": ("body", kinematic_bodies(scene)),
                "state": list(STATE),
                "wrench": list(WRENCH),
            },
            attrs={"time_step": scene.time_step},
        )
        return cls(hashed(dataset))

    def to_dataframe(self) -> pd.DataFrame:
        """Return the measured rows, one for each (trajectory, step, body); steps count from 0."""
        return to_table(self.dataset)

    def save(self, path: str | Path) -> None:
        """Write what was measured as CSV, Parquet or NetCDF, by suffix, atomically.

        Raises
        ------
        OutputError
            If the suffix is unknown or the file cannot be written.
        """
        write_dataset(self.dataset, Path(path))

    def segments(self, horizon: int = 1) -> Segments:
        """Cut every trajectory into pieces of ``horizon`` intervals that do not overlap.

        Pieces start where the state is complete. The rest at a trajectory's end is dropped, but a
        trajectory that gives no whole piece gives one that its end cuts short: nothing is measured
        after it. So bodies that were seen before and after a long push need a horizon as long as
        the longest trajectory.

        Raises
        ------
        HistoryError
            If the horizon is not a whole number from 1 up, or no piece is left.
        """
        if isinstance(horizon, bool) or horizon < 1 or horizon != int(horizon):
            raise HistoryError(f"horizon is {horizon!r}, expected a whole number from 1 up")
        intervals = self.dataset["n_rows"].to_numpy() - 1
        trajectory, step = _cut(self.complete, intervals, int(horizon))
        if not len(step):
            raise HistoryError(
                f"no segment of {horizon} intervals starts from a complete state; use another "
                "horizon, or measure the states there"
            )
        start = self.dataset["start"].to_numpy()
        return self._segments(start, trajectory, step, int(horizon))

    def pieces(self, states: Floats, horizon: int, breaks: Bools | None = None) -> Segments:
        """Cut every trajectory into pieces of ``horizon`` intervals between given states.

        Pieces are the segments of multiple shooting: each is simulated from its own initial state.
        A rest of at least a third of a piece is a piece, too: nothing is measured after its end.

        Parameters
        ----------
        states : ndarray
            Shape (trajectory, time, body, 6), SI units, complete where pieces start.
        horizon : int
            Intervals in each piece, at least 1.
        breaks : ndarray of bool, optional
            Intervals that no piece goes through, shape (trajectory, interval).
        """
        begins = [
            (trajectory, step, end)
            for trajectory, n in enumerate(self.dataset["n_rows"].to_numpy() - 1)
            for first, end in _runs(n, None if breaks is None else breaks[trajectory])
            for step in range(first, end, horizon)
            if step == 0 or 3 * (end - step) >= horizon
        ]
        trajectory, step, end = np.array(begins, dtype=int).reshape(-1, 3).T
        segments = self._segments(states, trajectory, step, horizon)
        segments.observed[step[:, None] + np.arange(horizon) >= end[:, None]] = np.nan
        return segments

    def _segments(self, start: Floats, trajectory: Ints, step: Ints, horizon: int) -> Segments:
        """Return the segments of ``horizon`` intervals that start at these rows of ``start``."""
        intervals = self.dataset["n_rows"].to_numpy() - 1
        follows = self.dataset["kinematic"].to_numpy()
        rows = step[:, None] + np.arange(horizon)
        after = rows >= intervals[trajectory][:, None]
        rows = np.where(after, 0, rows)
        inputs = self._inputs()[trajectory[:, None], rows]
        observed = self.dataset["observed"].to_numpy()[trajectory[:, None], rows + 1]
        inputs[after, :, :6], inputs[after, :, 6:] = 0.0, np.inf
        observed[after] = np.nan
        observed[:, :, follows] = np.nan
        actions = inputs[..., : len(WRENCH)]
        return Segments(start[trajectory, step], actions, observed, trajectory, step, inputs)

    def transitions(self, states: Floats) -> Segments:
        """Return every interval as a segment between given states.

        Parameters
        ----------
        states : ndarray
            Shape (trajectory, time, body, 6), SI units, without gaps.
        """
        observed = self.dataset["observed"].copy(data=states)
        return History(self.dataset.assign(observed=observed)).pieces(states, 1)

    def _inputs(self) -> Floats:
        """Return all that acts in each interval, shape (trajectory, interval, body, input)."""
        data = self.dataset
        follows = data["kinematic"].to_numpy()
        action = data["action"].to_numpy().copy()
        poses = data["start"].to_numpy()[:, :, follows, :3]
        action[:, :-1, follows] = path_velocities(poses, float(data.attrs["time_step"]))
        before = data["before"].to_numpy()[:, None]
        previous = np.concatenate([before, action[:, :-1]], axis=1)
        clock = self.elapsed
        end = np.pad(clock[:, 1:], ((0, 0), (0, 1)), constant_values=np.nan)
        number = np.broadcast_to(data["number"].to_numpy()[:, None], clock.shape)
        when = np.stack([number, clock, end], axis=-1)[:, :, None]
        when = np.broadcast_to(when, (*action.shape[:-1], 3))
        return np.concatenate([action, previous, when], axis=-1)

    @property
    def elapsed(self) -> Floats:
        """Time since each trajectory began, shape (trajectory, time), s; laws know no other."""
        data = self.dataset
        return np.asarray(data["clock"].to_numpy() - data["began"].to_numpy()[:, None])

    @property
    def longest_gap(self) -> int:
        """Return the most intervals between rows with all bodies in a sparse recording, else 1.

        A recording is sparse if more than half of the steps from one such row to the next skip
        rows: a block that is seen before and after a push, say.
        """
        complete = np.asarray(~unseen(self).any(axis=-1))
        both = zip(complete, self.dataset["n_rows"].to_numpy(), strict=True)
        gaps = np.concatenate([np.diff(np.flatnonzero(seen[:n])) for seen, n in both])
        return int(gaps.max()) if len(gaps) and np.median(gaps) > 1 else 1

    @property
    def complete(self) -> Bools:
        """Whether the state is complete, so that pieces may start, shape (trajectory, time)."""
        return np.asarray(np.isfinite(self.dataset["start"].to_numpy()).all(axis=(-1, -2)))

    def split(self, test_fraction: float = 0.25, seed: int = 0) -> tuple[History, History]:
        """Return a training and a test history, each of whole trajectories.

        Raises
        ------
        HistoryError
            If there are fewer than 2 trajectories, or the fraction is not between 0 and 1.
        """
        n = self.n_trajectories
        if not 0 < test_fraction < 1:
            raise HistoryError(f"test_fraction is {test_fraction}, expected between 0 and 1")
        if n < 2:
            raise HistoryError(
                f"a history of {n} trajectory cannot be split by whole trajectories; expected at "
                "least 2; record another, cut it (cut = { every = ... } in [recording]), or give"
                " the test data in a file of their own"
            )
        n_test = min(max(round(test_fraction * n), 1), n - 1)
        shuffled = np.random.default_rng(seed).permutation(n).tolist()
        return self.select(sorted(shuffled[n_test:])), self.select(sorted(shuffled[:n_test]))

    def numbered(self, first: float) -> History:
        """Return the same trajectories, numbered from ``first``: recorded after others."""
        number = self.dataset["number"]
        return History(self.dataset.assign(number=number - number.min() + first))

    def select(self, trajectories: Sequence[int] | Ints) -> History:
        """Return the trajectories at these positions, in this order.

        Raises
        ------
        HistoryError
            If there are none, or a position is out of range or given twice.
        """
        positions = [int(position) for position in trajectories]
        n = self.n_trajectories
        if not positions or not all(0 <= position < n for position in positions):
            raise HistoryError(f"trajectories {positions} asked for, expected some of 0 to {n - 1}")
        if len(set(positions)) < len(positions):
            raise HistoryError(f"trajectories {positions} asked for; expected each once")
        chosen = self.dataset.isel(trajectory=positions)
        chosen = chosen.isel(time=slice(int(chosen["n_rows"].max())))
        return History(hashed(chosen))

    @property
    def n_trajectories(self) -> int:
        """Number of trajectories."""
        return int(self.dataset.sizes["trajectory"])

    @property
    def n_transitions(self) -> int:
        """Number of intervals: steps that have a next one, whatever the number of bodies."""
        return int((self.dataset["n_rows"] - 1).sum())

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies, in the order of the arrays."""
        return tuple(str(name) for name in self.dataset["body"].to_numpy())

    @property
    def data_sha256(self) -> str:
        """Hash of what was measured, the same for the same data in any file format."""
        return str(self.dataset.attrs["data_sha256"])

    def __repr__(self) -> str:
        return (
            f"History({self.n_trajectories} trajectories, {self.n_transitions} transitions, "
            f"bodies {', '.join(self.bodies)}, sha256 {self.data_sha256[:12]})"
        )


def _rows(
    frame: pd.DataFrame,
    scene: Scene,
    layout: Recording | None,
    commands: pd.DataFrame | None,
    source: str,
    **reading: Unpack[TableReading],
) -> Rows:
    """Return a table's rows as its layout says, resampled where that is declared."""
    from pbrl_ppl.history.conversion import as_history

    frame = with_lines(frame, source)
    table = as_history(frame, scene, source, layout, commands=commands, **reading)
    rows = rows_of_table(table, scene, source, cut=layout is not None and bool(layout.cut))
    if reading.get("resample") or (layout is not None and layout.resample):
        rows = resampled(rows, scene, source)
    return rows


def _stacked(arrays: Sequence[Floats], length: int) -> Floats:
    """Return arrays of trajectories one after the other, with NaN up to this number of steps."""
    whole = [np.full((len(one), length, *one.shape[2:]), np.nan) for one in arrays]
    for padded_one, one in zip(whole, arrays, strict=True):
        padded_one[:, : one.shape[1]] = one
    return np.concatenate(whole)


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
        " fit whole trajectories (the likelihood 'trajectories'), measure them, declare the hinge"
        " that holds the body in the scene (it gives x, y, vx, vy from theta and omega), or have"
        " velocities estimated (estimate_velocities, --estimate-velocities: it gives vx, vy, omega"
        " from x, y, theta)"
    )


def hashed(dataset: xr.Dataset) -> xr.Dataset:
    """Return the dataset with the hash of its measured arrays among its attributes."""
    digest = hashlib.sha256()
    for name in ("trajectory", "body"):
        digest.update("\0".join(map(str, dataset[name].to_numpy())).encode())
        digest.update(b"\1")
    digest.update(dataset["n_rows"].to_numpy().astype("<i8").tobytes())
    for name in ("clock", "observed", "action"):
        values = dataset[name].to_numpy()
        # One NaN and one zero: both have several bit patterns.
        canonical = np.where(np.isnan(values), np.nan, values + 0.0)
        digest.update(np.ascontiguousarray(canonical, dtype="<f8").tobytes())
    return dataset.assign_attrs(data_sha256=digest.hexdigest())


def _cut(complete: Bools, intervals: Ints, horizon: int) -> tuple[Ints, Ints]:
    """Return the trajectory and the first step of pieces that do not overlap.

    A piece starts at the first complete state after the piece before it, and must end within its
    trajectory. A trajectory too short for any has one that its end cuts short.

    Parameters
    ----------
    complete : ndarray
        Whether a piece may start there, shape (trajectory, time).
    intervals : ndarray
        Number of intervals of each trajectory, shape (trajectory,).
    horizon : int
        Intervals of a piece.

    Examples
    --------
    >>> _cut(np.array([[True] * 6, [False, True, True, False, False, False]]), np.array([5, 3]), 2)
    (array([0, 0, 1]), array([0, 2, 1]))
    """
    pieces: list[tuple[int, int]] = []
    for trajectory, count in enumerate(intervals):
        free = 0
        for step in np.flatnonzero(complete[trajectory, :count]).tolist():
            if step >= free and (step + horizon <= count or not free):
                pieces.append((trajectory, step))
                free = step + horizon
    trajectories, steps = np.array(pieces, dtype=np.int64).reshape(-1, 2).T
    return trajectories, steps


def with_paths(scene: Scene, states: Floats, wrenches: Floats) -> tuple[Floats, Floats]:
    """Return states and wrenches as a recording has them: kinematic bodies follow their paths.

    Parameters
    ----------
    scene : Scene
        Says which bodies are kinematic.
    states : ndarray
        Shape (trajectory, time, body, 6), SI units.
    wrenches : ndarray
        Shape (trajectory, time - 1, body, 3); of a kinematic body its velocities, for which it has
        no wrench in the result.
    """
    states, wrenches, follows = states.copy(), wrenches.copy(), kinematic_bodies(scene)
    path = scene.time_step * np.cumsum(wrenches[:, :, follows], axis=1)
    states[:, 1:, follows, :3] = states[:, :1, follows, :3] + path
    wrenches[:, :, follows] = np.nan
    return states, wrenches


def from_segments(scene: Scene, start: Floats, actions: Floats, observed: Floats) -> History:
    """Return a history with one trajectory a segment, each from its initial state.

    Parameters
    ----------
    scene : Scene
        Names the bodies and the time step.
    start : ndarray
        Complete initial states, shape (n, body, 6), SI units.
    actions : ndarray
        Wrenches, shape (n, H, body, 3); of a kinematic body its velocities. Inputs as in
        :data:`pbrl_ppl.state.INPUT`, shape (n, H, body, 9), also hold the wrench of the interval
        before, and times.
    observed : ndarray
        Next states, shape (n, H, body, 6), NaN where missing.
    """
    states = np.concatenate([start[:, None], observed], axis=1)
    states, wrench = with_paths(scene, states, actions[..., : len(WRENCH)])
    history = History.of_arrays(states, scene, wrench)
    if actions.shape[-1] == len(WRENCH):
        return history
    number, begin, end = np.moveaxis(actions[:, :, 0, 6:], -1, 0)
    data = history.dataset
    return History(
        data.assign(
            before=data["before"].copy(data=actions[:, 0, :, 3:6]),
            number=data["number"].copy(data=number[:, 0]),
            clock=data["clock"].copy(data=np.concatenate([begin, end[:, -1:]], axis=1)),
            began=data["began"].copy(data=np.zeros(len(begin))),
        )
    )


def _runs(n: int, breaks: Bools | None) -> list[tuple[int, int]]:
    """Return the runs of ``n`` intervals between breaks: the first, and that after the last."""
    if breaks is None:
        return [(0, n)]
    edges = [-1, *np.flatnonzero(breaks[:n]).tolist(), n]
    return [(a + 1, b) for a, b in pairwise(edges) if b - a > 2]
