"""Mode of a declared model: its recordings checked and cleaned, with enough engine steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.stats import norm

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.innovations import unexplained_acceleration, without_acceleration
from pbrl_ppl.criticism.results import Stage
from pbrl_ppl.effects import Attached, Effect, attach, candidates
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import (
    History,
    UnusedVelocity,
    bad_frames,
    drawn_pieces,
    measured_alone,
    thinned,
    unused_velocities,
    with_units,
    without_bad_frames,
)
from pbrl_ppl.likelihood import Problem, observed_coordinates, single_transitions
from pbrl_ppl.modes import FilteredMode, Mode, find_mode, mode_of_more, nearby_mode, trajectory_mode
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Scene
from pbrl_ppl.state import STATE, Floats, Ints


def checked_histories(
    scene: Scene, train: History, test: History
) -> tuple[History, History, tuple[UnusedVelocity, ...], tuple[str, ...]]:
    """Return both histories without unused velocities and single bad frames, and name those.

    Parameters
    ----------
    scene : Scene
        The declared scene.
    train, test : History
        The training and the test history.

    Returns
    -------
    train, test : History
        Without them.
    unused : tuple of UnusedVelocity
        Velocity columns of the training history that are not used, in either.
    bad : tuple of str
        A sentence for each single bad frame that is left out.

    Raises
    ------
    HistoryError
        If they have other bodies, another time step or other measured dimensions, or nothing
        moves in the training history.
    """
    names = [body.name for body in scene.moving]
    for which, history in (("training", train), ("test", test)):
        if list(history.bodies) != names:
            raise HistoryError(
                f"{which} history: it is of {', '.join(history.bodies)}, the scene has"
                f" {', '.join(names)}; load it with this scene"
            )
        step = float(history.dataset.attrs["time_step"])
        if not np.isclose(step, scene.time_step, atol=0.0):
            raise HistoryError(
                f"{which} history: it has a row each {step:g} s, the scene each"
                f" {scene.time_step:g} s; load it with this scene"
            )
    same = test is train
    # a bad frame makes positions look noisy, and a measured velocity as if they predicted it
    clear = np.flatnonzero(~bad_frames(train).any(axis=(1, 2, 3)))
    most = 2 * len(clear) >= train.n_trajectories
    unused = unused_velocities(train.select(clear) if most else train)
    train, test = measured_alone(train, unused), measured_alone(test, unused)
    train, bad = without_bad_frames(train)
    test, more = without_bad_frames(test)
    observed_coordinates(scene, train)  # raises if nothing moves
    known, tested = (
        np.isfinite(history.dataset["observed"].to_numpy()).any(axis=(0, 1))
        for history in (train, test)
    )
    where = np.argwhere(tested & ~known)
    if len(where):
        missing = (f"{STATE[d]} of {scene.moving[body].name}" for body, d in where)
        raise HistoryError(
            f"test history measures {', '.join(missing)}, which the training history does"
            " not; leave those columns empty, or measure them in both"
        )
    held_out = [] if same else [f"held out: {frame}" for frame in more]
    return train, test, unused, (*map(str, bad), *held_out)


def outliers(mode: FilteredMode, criteria: Criteria) -> Floats:
    """Return errors of single measurements that a fitted model and all others contradict.

    They are judged by the residual given all other measurements (auxiliary residuals), without any
    unexplained acceleration, which would follow them, and in units of the median residual: where
    physics is missing most residuals are large, and none is far off.

    Parameters
    ----------
    mode : FilteredMode
        Fitted to whole trajectories.
    criteria : Criteria
        How far off a measurement is to be left out.

    Returns
    -------
    ndarray
        Measured minus smoothed, shape (trajectory, time, body, 6), SI units; NaN elsewhere.
    """
    problem = mode.problem
    noise, segments = problem.likelihood.noise, problem.segments
    residual = noise.coordinates.of_residual(problem.residual(mode.phi))
    sigma = without_acceleration(mode).sigma
    both, error = noise.auxiliary(residual, sigma), noise.coordinates.errors(sigma)
    size = np.abs(np.concatenate(both))  # of rows that transitions end at, then of first rows
    size[size == 0.0] = np.nan
    off = np.concatenate([noise.measured, noise.begin])
    trajectory = np.tile(segments.trajectory, 2)
    row = np.concatenate([segments.step + 1, segments.step])
    observed = problem.data.history.dataset["observed"]
    errors = np.full(observed.shape, np.nan)
    flat = errors.reshape(*errors.shape[:2], -1)
    for cell, place in enumerate(noise.coordinates.places):
        sizes = size[:, cell]
        count = np.isfinite(sizes).sum()
        if noise.coordinates.sensor[cell] < 0 or count < 12:  # too few to call one far
            continue
        far = sizes > criteria.outlier_deviations * np.nanmedian(sizes) / norm.isf(0.25)
        # from the smoothed state, which it attracts
        far &= np.abs(off[:, cell]) > 4.0 * error[cell]
        # an event that lasts moves the neighbours, too
        far &= sizes > 2.0 * np.nan_to_num(_beside(sizes, trajectory, row))
        if 0 < far.sum() <= max(0.05 * count, 1):  # where many are far off, none is left out
            flat[trajectory[far], row[far], place] = off[far, cell]
    return errors


def _beside(size: Floats, trajectory: Ints, row: Ints) -> Floats:
    """Return the larger residual of the rows before and after, shape of ``size``; NaN if none."""
    table = np.full((trajectory.max() + 1, row.max() + 3), np.nan)
    some = np.isfinite(size)
    table[trajectory[some], row[some] + 1] = size[some]
    return np.fmax(table[trajectory, row], table[trajectory, row + 2])


@dataclass(frozen=True, eq=False)
class Declared:
    """A declared model: how it is fitted, and what it may lack.

    Parameters
    ----------
    scene : Scene
        With natural units of the recording.
    catalogue : tuple of Effect
        Effects that are tried, and where declared ones are looked up.
    seed, criteria, say
        As of :func:`pbrl_ppl.close_loop`; ``say`` is its ``progress``.
    """

    scene: Scene
    catalogue: tuple[Effect, ...]
    seed: int
    criteria: Criteria
    say: Callable[[str], None]

    @property
    def effects(self) -> tuple[Attached, ...]:
        """Effects that the scene declares."""
        return attach(self.scene, (), self.catalogue)

    def cleaned(self, history: History, most: int) -> tuple[Self, History]:
        """Return the model with units of a recording, and what is left of that.

        Of a recording with more than ``most`` transitions pieces; without bad frames and unused
        velocities.

        Raises
        ------
        HistoryError
            If the history does not fit the scene.
        """
        scene, (history,), thin = thinned(self.scene, history)
        history, drawn = drawn_pieces(history, most, self.seed)
        history, _, unused, bad = checked_histories(scene, history, history)
        for sentence in (*thin, *drawn, *(velocity.sentence for velocity in unused), *bad):
            self.say(sentence)
        return replace(self, scene=with_units(scene, history)), history

    def missing(self, mode: Mode) -> tuple[Attached, ...]:
        """Return the candidate effects for a model that its recording can show."""
        problem = mode.problem
        return candidates(self.scene, problem.physics.effects, self.catalogue, problem.data.history)

    def mode(self, train: History, of_part: FilteredMode | None = None) -> FilteredMode:
        """Return the model's mode on whole trajectories, from that of a part of them, if any."""
        self.say(Stage.FIT)
        if of_part is not None:
            return mode_of_more(Problem.of(of_part.problem.physics, train), of_part)
        problem = Problem.of(Physics(self.scene, self.effects, threads=2), train)
        physics = problem.physics
        problem = problem.with_physics(substeps=max(physics.substeps, physics.fine_enough))
        mode = find_mode(single_transitions(problem), seed=self.seed)
        return with_enough_substeps(trajectory_mode(problem, mode.phi), self.say, self.criteria)


def with_enough_substeps(
    mode: FilteredMode, say: Callable[[str], None], criteria: Criteria = DEFAULT
) -> FilteredMode:
    """Double the substeps until neither predictions nor the acceleration test move, and refit.

    The engine's error hardly depends on the parameters, so it is measured at the mode found with
    fewer substeps. At the end smoothing restarts: an optimum with too large a noise confirms
    itself through the states that were smoothed with that noise.
    """
    limits = criteria.engine
    confirmed = 0  # substeps with which smoothing was restarted
    while True:  # a better engine leaves less noise, against which its error shows again
        begin = substeps = mode.problem.physics.substeps
        while shift(mode, substeps) > limits.small_shift and substeps < limits.most_substeps:
            substeps *= 2
        if substeps > begin:
            mode = _refined(mode, substeps, say)
            continue
        if confirmed < substeps:
            fresh, confirmed = trajectory_mode(mode.problem, mode.phi), substeps
            if fresh.log_posterior > mode.log_posterior + 5.0:  # nats
                mode = fresh
                continue
        excess = unexplained_acceleration(mode, criteria)
        # a tenth of the bodies' acceleration is no numerical error
        if not excess.matters.any() or excess.worst > 0.1 or substeps >= limits.most_substeps:
            return mode
        finer = _refined(mode, 2 * substeps, say)
        moved = np.abs(excess.relative - unexplained_acceleration(finer, criteria).relative)
        if (moved < 0.1 * excess.relative)[excess.matters].all():
            return mode
        mode = finer


def _refined(mode: FilteredMode, substeps: int, say: Callable[[str], None]) -> FilteredMode:
    """Return the mode refitted with more substeps."""
    say(f"using {substeps} engine steps an interval")
    return nearby_mode(mode.problem.with_physics(substeps=substeps), mode.phi, mode.sigma)


def shift(mode: FilteredMode, substeps: int | None = None) -> float:
    """Return the rms change of the innovations, over the noise, if substeps are doubled.

    Parameters
    ----------
    mode : FilteredMode
        Fitted to whole trajectories.
    substeps : int, optional
        The number to double; the mode's by default.
    """
    problem = mode.problem
    substeps = problem.physics.substeps if substeps is None else substeps
    coarse, fine = (problem.with_physics(substeps=n) for n in (substeps, 2 * substeps))
    change = coarse.whitened(mode.phi, mode.sigma) - fine.whitened(mode.phi, mode.sigma)
    return float(np.sqrt(np.nanmean(change**2, axis=0).max()))
