"""Check of a linearisation: log-likelihoods with the states smoothed anew at posterior draws."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.likelihood import Problem, smoothed

Array = NDArray[np.float64]

#: Attribute of a posterior that holds the check, as JSON.
LINEARISATION = "linearisation"
#: Draws at which the states are smoothed anew.
DRAWS = 16
#: Standard deviation of the differences (nats) above which the linearised posterior is another one:
#: draws weighted by exp(difference) would be worth exp(-4), 2 %, of their number.
MOST = 2.0


def linearisation_errors(problem: Problem, phi: Array, sigma: Array) -> Array:
    """Log-likelihoods with the states smoothed anew at each draw, less the linearised ones.

    Parameters
    ----------
    problem : Problem
        Of whole trajectories.
    phi, sigma : ndarray
        Draws, shapes (draw, p) and (draw, parameter).

    Returns
    -------
    ndarray
        Of each trajectory, shape (draw, trajectory), nats. A constant does not matter to a
        posterior, a difference between draws does.
    """
    of, n = problem.segments.trajectory, problem.data.history.n_trajectories
    errors = np.zeros((len(phi), n))
    for own, point, noise in zip(errors, phi, sigma, strict=True):
        anew = smoothed(problem, point, noise)
        found, held = (
            each.log_density(each.residual(point), noise, point) for each in (anew, problem)
        )
        np.add.at(own, of, found - held)
    return errors


def linearisation(problem: Problem, phi: Array, sigma: Array) -> dict[str, Any]:
    """Summary of :func:`linearisation_errors` at some of a posterior's draws.

    Parameters
    ----------
    problem : Problem
        Of whole trajectories.
    phi, sigma : ndarray
        All draws, at least two, shapes (draw, p) and (draw, parameter).

    Returns
    -------
    dict
        ``draws``, how many; ``sd`` and ``largest``, standard deviation of the differences and the
        largest from their mean (nats); ``trajectory``, the one, from 0, whose differences vary
        most.
    """
    rows = np.unique(np.linspace(0, len(phi) - 1, DRAWS).astype(int))
    errors = linearisation_errors(problem, phi[rows], sigma[rows])
    total = errors.sum(axis=1)
    return {
        "draws": len(rows),
        "sd": float(total.std(ddof=1)),
        "largest": float(np.abs(total - total.mean()).max()),
        "trajectory": int(errors.std(axis=0).argmax()),
    }


def doubt(found: dict[str, Any]) -> str | None:
    """Message about a linearisation that does not hold; None if it does."""
    if found["sd"] <= MOST:
        return None
    return (
        f"the likelihood is linearised where it does not hold: at {found['draws']} draws with the"
        f" states smoothed anew it differs by {found['sd']:.2g} nats (standard deviation; want <="
        f" {MOST:g}), most in trajectory {found['trajectory']}; cut that where"
        " bodies meet or wheels begin to slip, or compare with a fit of single transitions"
    )
