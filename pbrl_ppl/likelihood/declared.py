"""Problems as users declare them, their arguments checked."""

from __future__ import annotations

import numpy as np

from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, check_start, measured_alone
from pbrl_ppl.likelihood.likelihood import TrajectoryLikelihood, TransitionLikelihood
from pbrl_ppl.likelihood.output_error import OutputErrorLikelihood, in_pieces
from pbrl_ppl.likelihood.problem import Problem
from pbrl_ppl.likelihood.smoothing import along_trajectories
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.physics import Physics

#: Names of the likelihoods.
KINDS = tuple(
    each.name for each in (TransitionLikelihood, TrajectoryLikelihood, OutputErrorLikelihood)
)


def declared_problem(
    physics: Physics,
    history: History,
    *,
    horizon: int = 1,
    likelihood: TransitionLikelihood | None = None,
    library: ParameterLibrary | None = None,
    kind: str = TransitionLikelihood.name,
) -> Problem:
    """Return the problem of a history; see :func:`pbrl_ppl.physics_model`.

    ``kind`` is a name of a likelihood, one of :data:`KINDS`. Trajectories are linearised at the
    prior's centre, which is no place to sample about: a mode has to be found first.
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
    centre = np.array([prior.centre for prior in problem.layout.priors])
    filtered = along_trajectories(problem, centre)
    if kind != OutputErrorLikelihood.name:
        return filtered
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
    return in_pieces(filtered, longest, filtered.data.smoothed_states)
