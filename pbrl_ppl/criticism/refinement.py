"""Mode of a declared model: its recording checked, with enough engine steps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pbrl_ppl.criticism.criteria import DEFAULT, Criteria
from pbrl_ppl.criticism.recordings import checked_histories
from pbrl_ppl.criticism.results import Stage
from pbrl_ppl.criticism.unexplained import unexplained_acceleration
from pbrl_ppl.effects import Attached, Effect, attach
from pbrl_ppl.history import History, with_units
from pbrl_ppl.likelihood import Problem, single_transitions
from pbrl_ppl.modes import FilteredMode, find_mode, nearby_mode, trajectory_mode
from pbrl_ppl.physics import Physics
from pbrl_ppl.scene import Scene, check_substeps


def checked_mode(
    scene: Scene,
    history: History,
    catalogue: tuple[Effect, ...],
    seed: int,
    substeps: int | None,
    criteria: Criteria,
    say: Callable[[str], None],
) -> FilteredMode:
    """Return the declared model's mode on a history without bad frames and unused velocities.

    Raises
    ------
    HistoryError
        If the history does not fit the scene.
    EffectError
        If the scene declares an unknown effect.
    """
    if substeps is not None:
        check_substeps(substeps)
    history, _, unused, bad = checked_histories(scene, history, history)
    for sentence in (*(velocity.sentence for velocity in unused), *bad):
        say(sentence)
    scene = with_units(scene, history)
    effects = attach(scene, (), catalogue)
    say(Stage.FIT)
    return declared_mode(scene, history, effects, seed, substeps, say, criteria)


def declared_mode(
    scene: Scene,
    history: History,
    effects: tuple[Attached, ...],
    seed: int,
    substeps: int | None,
    say: Callable[[str], None],
    criteria: Criteria = DEFAULT,
) -> FilteredMode:
    """Return the declared model's mode on whole trajectories, with enough substeps."""
    steps = scene.substeps if substeps is None else substeps
    problem = Problem.of(Physics(scene, effects, steps, threads=2), history)
    if substeps is None:
        physics = problem.physics
        problem = problem.with_physics(substeps=max(physics.substeps, physics.fine_enough))
    mode = find_mode(single_transitions(problem), seed=seed)
    return with_enough_substeps(trajectory_mode(problem, mode.phi), say, criteria)


def with_enough_substeps(
    mode: FilteredMode,
    say: Callable[[str], None],
    criteria: Criteria = DEFAULT,
    *,
    better_mode: float = 5.0,
    large: float = 0.1,
    still: float = 0.1,
) -> FilteredMode:
    """Double the substeps until neither predictions nor the acceleration test move, and refit.

    The engine's error hardly depends on the parameters, so it is measured at the mode found with
    fewer substeps. At the end smoothing restarts: an optimum with too large a noise confirms
    itself through the states that were smoothed with that noise.

    ``better_mode``: a mode is replaced by one smoothed again whose log-posterior is higher by this
    (nats).
    ``large``: an unexplained acceleration above this share of the bodies' is no numerical error.
    ``still``: nor is one that a doubling of the substeps moves by a smaller share.
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
            if fresh.log_posterior > mode.log_posterior + better_mode:
                mode = fresh
                continue
        excess = unexplained_acceleration(mode, criteria)
        if not excess.matters.any() or excess.worst > large or substeps >= limits.most_substeps:
            return mode
        finer = _refined(mode, 2 * substeps, say)
        moved = np.abs(excess.relative - unexplained_acceleration(finer, criteria).relative)
        if (moved < still * excess.relative)[excess.matters].all():
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
