"""Problems as users declare them, their arguments checked."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from pbrl_ppl.effects import Attached, Effect, attach
from pbrl_ppl.errors import HistoryError
from pbrl_ppl.history import History, check_start, measured_alone
from pbrl_ppl.likelihood.likelihood import TransitionLikelihood
from pbrl_ppl.likelihood.problem import Problem
from pbrl_ppl.likelihood.smoothing import along_trajectories
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.scene import Scene


def declared_problem(
    scene: Scene,
    history: History,
    effects: Iterable[Effect | Attached] = (),
    *,
    horizon: int = 1,
    sigma: str = "per_dimension",
    nu: float | None = None,
    substeps: int | None = None,
    threads: int = 1,
    library: ParameterLibrary | None = None,
    trajectories: bool = False,
) -> Problem:
    """Declare the problem of a scene and a history; see :func:`pbrl_ppl.physics_model`.

    Whole trajectories are linearised at the prior's centre, which is no place to sample about: a
    mode has to be found first.
    """
    if sigma not in ("per_dimension", "scalar"):
        raise ValueError(f"sigma is {sigma!r}, expected 'per_dimension' or 'scalar'")
    if horizon < 1:
        raise ValueError(f"horizon is {horizon}, expected at least 1")
    if nu is not None and not 0 < nu < np.inf:
        raise ValueError(f"nu is {nu}, expected degrees of freedom above 0, or None for a Gaussian")
    if trajectories and (horizon > 1 or library is not None):
        raise ValueError(
            "trajectories is given with horizon or library; whole trajectories need neither: leave"
            " it out"
        )
    if trajectories and sigma == "scalar":
        raise ValueError("sigma is 'scalar', expected 'per_dimension' with trajectories")
    if trajectories:
        history = measured_alone(history)
    else:
        check_start(history, scene)
    longest = int(history.dataset["n_rows"].max()) - 1
    if horizon > longest:
        raise HistoryError(
            f"horizon is {horizon} intervals, and the longest trajectory has {longest}; use a"
            " shorter horizon"
        )
    problem = Problem.of(
        scene,
        history,
        attach(scene, effects),
        horizon=horizon,
        substeps=substeps,
        threads=threads,
        likelihood=TransitionLikelihood(scalar=sigma == "scalar", nu=nu),
        library=library,
    )
    if trajectories:
        centre = np.array([prior.centre for prior in problem.layout.priors])
        problem = along_trajectories(problem, centre)
    return problem
