"""Draws of a model with a library: by the exact sum over its choices, or by a walk among them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import choose_from_library, profile_sigma
from pbrl_ppl.parameters import ParameterLibrary
from pbrl_ppl.posterior import Point, group
from pbrl_ppl.sampling.traces import as_trace

Ints = NDArray[np.intp]


def summed(model: pm.Model, draws: int, chains: int, seed: int) -> tuple[Any, Point]:
    """Draws by summing over the choices, and the most probable choice.

    Parameters
    ----------
    model : pymc.Model
        With a library.
    draws, chains, seed : int
        As for :func:`pbrl_ppl.fit`.
    """
    problem = model.problem
    phi, sigma, index, accepted, best = choose_from_library(problem, draws, chains, seed)
    values: dict[str, Any] = problem.layout.to_dict(phi)
    values |= {"library_index": index, "sigma": sigma[..., 0] if problem.scalar_sigma else sigma}
    return as_trace(model, values, {"accept": accepted}), _point(problem, best)


def prior_starts(problem: Problem, rng: np.random.Generator, chains: int) -> list[dict[str, Any]]:
    """Starts of chains: each owner's set drawn from the prior, sigma at its prior's median."""
    library, median = _library(problem), problem.noise_prior[0]
    sigma = np.exp(np.log(median).mean()) if problem.scalar_sigma else median
    laws = [library.prior(owner) for owner in problem.scene.owners]
    return [
        {"library_index": np.array([rng.choice(len(p), p=p) for p in laws]), "sigma": sigma}
        for _ in range(chains)
    ]


def most_frequent(problem: Problem, trace: Any) -> Point:
    """The most frequent choice among the draws, of bodies that meet together.

    Parameters
    ----------
    problem : Problem
        With a library.
    trace : InferenceData or DataTree
        Its draws.
    """
    drawn = group(trace, "posterior")["library_index"].transpose("chain", "draw", ...)
    index = drawn.to_numpy().reshape(-1, drawn.shape[-1])
    names = list(problem.scene.owners)
    best = np.zeros(index.shape[1], dtype=np.intp)
    for part in problem.simulator.parts:
        columns = [names.index(owner) for owner in part.physics.scene.owners]
        found, counts = np.unique(index[:, columns], axis=0, return_counts=True)
        best[columns] = found[counts.argmax()]
    return _point(problem, best)


def _point(problem: Problem, choice: Ints) -> Point:
    """Parameters of a choice (owner,), and the most probable sigma there."""
    table = _library(problem).table(problem.layout, problem.scene)
    names = list(problem.scene.owners)
    owners = [owner for block in problem.layout.blocks for owner in block.owners]
    phi = table[np.arange(len(owners)), choice[[names.index(owner) for owner in owners]]]
    return Point(phi, profile_sigma(problem, problem.residual(phi), phi), choice)


def _library(problem: Problem) -> ParameterLibrary:
    if problem.library is None:
        raise FitError("fit: the model has no library to choose from")
    return problem.library
