"""Problems as users declare them, their arguments checked."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pbrl_ppl.effects import attach, catalogue
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, check_start, measured_alone
from pbrl_ppl.likelihood.likelihood import TrajectoryLikelihood, TransitionLikelihood
from pbrl_ppl.likelihood.output_error import (
    OutputErrorLikelihood,
    in_pieces,
    is_simulated,
)
from pbrl_ppl.likelihood.problem import Problem, is_independent
from pbrl_ppl.likelihood.smoothing import along_trajectories, as_measured
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.physics import Physics, try_effect

#: Names of the likelihoods.
KINDS = tuple(
    each.name for each in (TransitionLikelihood, TrajectoryLikelihood, OutputErrorLikelihood)
)


def declared_problem(physics: Physics, history: History, **options: Any) -> Problem:
    """Return the problem of a history; see :func:`outlined_problem` and :func:`at_centre`."""
    return at_centre(outlined_problem(physics, history, **options))


def outlined_problem(
    physics: Physics,
    history: History,
    *,
    horizon: int = 1,
    likelihood: TransitionLikelihood | None = None,
    library: ParameterLibrary | None = None,
    kind: str = TransitionLikelihood.name,
) -> Problem:
    """Return the problem of a history, trajectories with states as measured.

    ``kind`` is a name of a likelihood, one of :data:`KINDS`; see :func:`pbrl_ppl.physics_model`.
    Nothing is simulated. Whole trajectories are not linearised: their variables, dimensions and
    measurements are final, and their states and the prior of their noise are not.
    """
    likelihood = likelihood or TransitionLikelihood()
    if kind not in KINDS:
        raise ValueError(f"likelihood is {kind!r}, expected one of {', '.join(KINDS)}")
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, expected at least 1")
    whole = kind != TransitionLikelihood.name
    if whole and (horizon > 1 or library is not None):
        raise ValueError(
            f"likelihood is {kind!r}, with horizon or library, which are for 'transitions': leave"
            " them out"
        )
    if whole and likelihood.scalar:
        raise ValueError(f"sigma is 'scalar', expected 'per_dimension' with likelihood {kind!r}")
    if whole:
        history = measured_alone(history)
    else:
        check_start(history, physics.scene)
    longest = int(history.dataset["n_rows"].max()) - 1
    if horizon > longest:
        raise HistoryError(
            f"horizon is {horizon} intervals, and the longest trajectory has {longest}; use a"
            " shorter horizon"
        )
    problem = Problem.of(physics, history, horizon=horizon, likelihood=likelihood, library=library)
    if not whole:
        return problem
    outline = as_measured(problem)
    if kind != OutputErrorLikelihood.name:
        return outline
    if likelihood.nu is not None or problem.tails:
        raise ValueError(
            "likelihood is 'simulation', whose noise is Gaussian: leave out nu and effects on the"
            " noise's tails, or choose 'trajectories'"
        )
    if problem.layout.discrete.any():
        raise ValueError(
            "likelihood is 'simulation' and which bodies a joint joins is unknown: name them in the"
            " scene, or choose 'trajectories'"
        )
    return in_pieces(outline, longest, outline.data.smoothed_states)


def at_centre(problem: Problem) -> Problem:
    """Return a problem with trajectories linearised about states smoothed at the prior's centre.

    It is no place to sample about: a mode has to be found first. Single transitions stay.
    """
    if is_independent(problem):
        return problem
    centre = np.array([prior.centre for prior in problem.layout.priors])
    filtered = along_trajectories(problem, centre)
    if not is_simulated(problem):
        return filtered
    return in_pieces(filtered, problem.data.horizon, filtered.data.smoothed_states)


def try_own_effects(physics: Physics, history: History) -> None:
    """Try the effects that are a user's own; see :func:`pbrl_ppl.physics.try_effect`."""
    scene = physics.scene
    bare = scene.replace(
        bodies=tuple(replace(body, effects=(), known=(), prior=()) for body in scene.bodies)
    )
    implied = {attached.effect.name for attached in attach(bare)}  # of actuators, for example
    known = {effect.name for effect in catalogue} | implied
    effects = {attached.effect.name: attached.effect for attached in physics.effects}
    for name in effects.keys() - known:
        try_effect(effects[name], scene, history)
