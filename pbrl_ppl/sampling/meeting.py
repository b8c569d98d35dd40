"""Collisions, under fitted parameters, of bodies that were apart in the data."""

from __future__ import annotations

import json
import warnings
from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from pbrl_ppl.errors import MeetingWarning
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.model import build_model
from pbrl_ppl.posterior import linearised_as, parameter_draws

Array = NDArray[np.float64]

#: Draws of a trace at which it is looked whether bodies meet, at most.
_LOOKED_AT = 50


def joined_model(problem: Problem, phi: Array, sigma: Array) -> pm.Model | None:
    """A model with those bodies in one part that meet at draws (n, p) and (n, state); None if none.

    The likelihood simulates bodies apart that were apart in the data. Here it is looked whether
    that changes anything where the posterior is.

    Warns
    -----
    MeetingWarning
        If bodies meet.
    """
    joined = problem.joined(phi, sigma)
    if joined is problem:
        return None
    warnings.warn(
        f"fit: {', '.join(joined.physics.together)} meet under the parameters that were found, and"
        " were thought apart by where they are in the data; all is fitted again with them in one"
        " world",
        MeetingWarning,
        stacklevel=3,
    )
    return build_model(joined)


def model_of_draws(problem: Problem, trace: Any) -> pm.Model | None:
    """As :func:`joined_model`, at some of a trace's draws."""
    phi, sigma = parameter_draws(problem, trace)
    rows = np.linspace(0, len(phi) - 1, min(_LOOKED_AT, len(phi))).astype(int)
    return joined_model(problem, phi[rows], sigma[rows])


def as_in(model: pm.Model, idata: Any) -> pm.Model:
    """The model with the likelihood that a posterior was sampled with.

    Bodies are together that the posterior has together, and trajectories are linearised where its
    own are.

    Raises
    ------
    PosteriorError
        If the posterior is of other data, or of single transitions where the model is of whole
        trajectories, or the other way round.
    """
    if idata is None:
        return model
    problem = model.problem
    known = tuple(json.loads(str(idata.attrs.get("together", "[]"))))
    if not set(known) <= set(problem.physics.together):
        problem = problem.with_physics(together=known)
    problem = linearised_as(problem, idata)
    return model if problem is model.problem else build_model(problem)
