"""Mode (MAP) of a posterior: search, storage and loading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pbrl_ppl.likelihood import Problem, log_posterior
from pbrl_ppl.modes import find_mode
from pbrl_ppl.parameters import nearest
from pbrl_ppl.posterior.record import PosteriorRecord, StoredMode
from pbrl_ppl.posterior.store import Idata
from pbrl_ppl.state import Floats, Ints

#: Rounds of a climb that starts near the mode.
_CLIMB = 5


@dataclass(frozen=True, eq=False)
class ParameterPoint:
    """A point of the parameter space.

    Parameters
    ----------
    phi : ndarray
        Parameters in the layout's order, shape (p,), SI units.
    sigma : ndarray
        Noise parameters, shape (state,).
    choice : ndarray of int, optional
        Index of each owner's parameter set in the library, shape (owner,), if there is one.
    """

    phi: Floats
    sigma: Floats
    choice: Ints | None = None


def packed_mode(
    problem: Problem, mode: ParameterPoint, phi: Floats, sigma: Floats, likelihood: Floats
) -> StoredMode:
    """Return a posterior's mode for its record.

    Where a draw is higher by 0.1 nats, the mode is climbed to again from that draw. Wheels are
    described as in the draws.

    Parameters
    ----------
    problem : Problem
        What was fitted.
    mode : ParameterPoint
        The mode as it was found.
    phi, sigma : ndarray
        Posterior draws, shapes (draw, p) and (draw, state).
    likelihood : ndarray
        Log-likelihood of each draw, shape (draw,).
    """
    value = float(log_posterior(problem, mode.phi, mode.sigma, mode.choice))
    if problem.library is None and not problem.layout.discrete.any():
        draws = log_posterior(problem, phi, sigma, log_likelihood=likelihood)
        best = int(np.argmax(draws))
        if draws[best] > value + 0.1:
            climbed = find_mode(problem, initial=phi[best], rounds=_CLIMB)
            if climbed.log_posterior > value:
                mode, value = ParameterPoint(climbed.phi, climbed.sigma), climbed.log_posterior
    return _packed(problem, mode, value, phi)


def updated_mode(
    problem: Problem,
    earlier: ParameterPoint,
    draws: tuple[Floats, Floats, Ints | None],
    likelihood: Floats,
) -> StoredMode:
    """Return the mode of an updated posterior.

    It is climbed to from the earlier mode. Over a library or joints of unknown bodies there is no
    climb: there it is the draw of highest density.

    Parameters
    ----------
    problem : Problem
        Of all data.
    earlier : ParameterPoint
        The mode of the earlier data.
    draws : tuple
        Phi, shape (draw, p), sigma, shape (draw, state), and over a library the index of each
        owner's parameter set, shape (draw, owner).
    likelihood : ndarray
        Log-likelihood of each draw, shape (draw,).
    """
    phi, sigma, choice = draws
    if problem.library is None and not problem.layout.discrete.any():
        mode = find_mode(problem, initial=earlier.phi, rounds=_CLIMB)
        return _packed(problem, ParameterPoint(mode.phi, mode.sigma), mode.log_posterior, phi)
    value = log_posterior(problem, phi, sigma, choice, log_likelihood=likelihood)
    i = int(np.argmax(value))
    best = ParameterPoint(phi[i], sigma[i], None if choice is None else choice[i])
    return _packed(problem, best, float(value[i]))


def _packed(
    problem: Problem, mode: ParameterPoint, value: float, draws: Floats | None = None
) -> StoredMode:
    """Return a point for a record, its wheels described as in draws (draw, p)."""
    layout, point, sets = problem.layout, mode.phi, None
    if problem.library is None and draws is not None:
        point = nearest(layout, point[None], draws)[0]
    if problem.library is not None and mode.choice is not None:
        names = problem.library.names
        chosen = zip(problem.scene.owners, mode.choice.tolist(), strict=True)
        sets = {owner: names[i] for owner, i in chosen}
    return StoredMode(
        dict(zip(layout.labels, point.tolist(), strict=True)),
        dict(zip(problem.noise_labels, mode.sigma.tolist(), strict=False)),  # a scalar is repeated
        value,
        sets,
    )


def stored_mode(problem: Problem, idata: Idata) -> ParameterPoint:
    """Return the mode that a posterior holds, in the order of the problem's layout.

    Parameters
    ----------
    problem : Problem
        Of the posterior.
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`, or loaded.

    Raises
    ------
    PosteriorError
        If it holds no mode, or the mode lacks a parameter of the problem.
    """
    record = PosteriorRecord.of(idata)
    phi, sigma = record.mode_vectors(problem.layout)
    choice = None
    if problem.library is not None and record.mode is not None and record.mode.sets is not None:
        names = [record.mode.sets[owner] for owner in problem.scene.owners]
        choice = np.array([problem.library.names.index(name) for name in names], dtype=np.intp)
    return ParameterPoint(phi, sigma, choice)
