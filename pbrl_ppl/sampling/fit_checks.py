"""Checks of a model and of the arguments before a fit."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pymc as pm

from pbrl_ppl.errors import FitError
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import Mode

#: The sampler where none is asked for.
DEFAULT = "metropolis"


def checked_problem(
    model: pm.Model, method: str, methods: Iterable[str], start: Any, resume: Any
) -> Problem:
    """The problem of a model, if it can be fitted as asked.

    Parameters
    ----------
    model, method, start, resume
        As for :func:`pbrl_ppl.fit`.
    methods : iterable of str
        The samplers' names.

    Raises
    ------
    FitError
        If it cannot.
    """
    problem = getattr(model, "problem", None)
    if not isinstance(problem, Problem):
        raise FitError("fit: this pm.Model was not made by physics_model; use pm.sample for others")
    if method not in methods:
        raise FitError(f"fit: method is {method!r}, expected one of {', '.join(methods)}")
    if start is not None and resume is not None:
        raise FitError("fit: start= and resume= are given, but chains begin at one: leave one out")
    if start is not None and not isinstance(start, Mode):
        raise FitError(
            f"fit: start is a {type(start).__name__}, expected a Mode; pass a posterior to go on"
            " with as resume="
        )
    given = "start" if start is not None else "resume" if resume is not None else None
    if problem.library is not None and (method not in (DEFAULT, "paper") or given):
        raise FitError(
            "fit: a model with a library is summed over exactly, or walked over by method='paper';"
            " leave out method= or use that, and leave out start= and resume="
        )
    if problem.layout.discrete.any():
        if method == "smc":
            raise FitError(
                "fit: method is 'smc' and which bodies a joint joins is unknown; each choice of"
                " bodies is sampled by itself, which tempering from the prior is not made for; use"
                " 'metropolis', or name the bodies in the scene"
            )
        if given:
            raise FitError(
                f"fit: {given}= was given and which bodies a joint joins is unknown; a fit cannot"
                f" go on from one choice of bodies to all of them; leave {given} out and raise"
                " draws="
            )
    return problem
