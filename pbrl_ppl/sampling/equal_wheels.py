"""The model's log-density with each wheel's prior shared evenly among its equal descriptions."""

from __future__ import annotations

from functools import reduce
from typing import Any

import numpy as np
import pymc as pm

from pbrl_ppl.likelihood import Problem
from pbrl_ppl.parameters import Wheel, wheels


def evened_logp(model: pm.Model, problem: Problem) -> Any:
    """Correction of the model's log-density: `parameters.evened` as an expression.

    A chain on one hill then stands for all of the wheel's; which description a draw is to have is
    chosen afterwards, by the prior (`parameters.redescribed`).

    Parameters
    ----------
    model : pymc.Model
        Of ``problem``.
    problem : Problem
        Says which wheels are unknown.

    Returns
    -------
    tensor or float
        In terms of the model's value variables; zero where every prior is even.
    """
    uneven = [wheel for wheel in wheels(problem.layout) if wheel.period > 1]
    if not uneven:
        return 0.0
    change = sum(_of_wheel(model, problem, wheel) for wheel in uneven)
    return model.replace_rvs_by_values([change])[0]


def _of_wheel(model: pm.Model, problem: Problem, wheel: Wheel) -> Any:
    places = {
        f"{block.name}[{owner}]": (block.name, i)
        for block in problem.layout.blocks
        for i, owner in enumerate(block.owners)
    }
    angle, *mus = (model[name][i] for name, i in (places[label] for label in wheel.labels))
    direction, *frictions = wheel.priors
    terms = []
    for turns in range(4):
        term = direction.kappa * pm.math.cos(angle + turns * np.pi / 2 - direction.mu)
        for mu, prior in zip(mus[:: -1 if turns % 2 else 1], frictions, strict=True):
            term = term - 0.5 * ((mu - prior.mu) / prior.sigma) ** 2
        terms.append(term)
    return reduce(pm.math.logaddexp, terms) - np.log(4.0) - terms[0]
