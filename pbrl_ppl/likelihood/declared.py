"""Problems as users declare them, their arguments checked."""

from __future__ import annotations

import numpy as np

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, check_start, measured_alone
from pbrl_ppl.likelihood.likelihood import TransitionLikelihood
from pbrl_ppl.likelihood.problem import Problem
from pbrl_ppl.likelihood.smoothing import along_trajectories
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.physics import Physics


def declared_problem(
    physics: Physics,
    history: History,
    *,
    horizon: int = 1,
    likelihood: TransitionLikelihood | None = None,
    library: ParameterLibrary | None = None,
    trajectories: bool = False,
) -> Problem:
    """Return the problem of a history; see :func:`pbrl_ppl.physics_model`.

    Whole trajectories are linearised at the prior's centre, which is no place to sample about: a
    mode has to be found first.
    """
    likelihood = likelihood or TransitionLikelihood()
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, expected at least 1")
    if trajectories and (horizon > 1 or library is not None):
        raise ValueError(
            "trajectories is given with horizon or library; whole trajectories need neither: leave"
            " it out"
        )
    if trajectories and likelihood.scalar:
        raise ValueError("sigma is 'scalar', expected 'per_dimension' with trajectories")
    if trajectories:
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
    if trajectories:
        centre = np.array([prior.centre for prior in problem.layout.priors])
        problem = along_trajectories(problem, centre)
    return problem
