"""The posterior's mode (MAP) as an attribute of its file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.errors import PosteriorError
from pbrl_ppl.likelihood import Problem, log_posterior
from pbrl_ppl.modes import find_mode
from pbrl_ppl.parameters import beside

Array = NDArray[np.float64]
Ints = NDArray[np.intp]

#: The attribute that holds it.
MODE = "mode"
#: A draw this much higher (log-posterior) than the mode shows that it is none.
_HIGHER = 0.1
#: Rounds of a climb that begins near the top.
_CLIMB = 5


@dataclass(frozen=True, eq=False)
class Point:
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

    phi: Array
    sigma: Array
    choice: Ints | None = None


def mode_text(problem: Problem, mode: Point, phi: Array, sigma: Array, likelihood: Array) -> str:
    """Text of a posterior's mode, for its attribute ``mode``.

    Where a draw is higher, the mode is climbed to anew from that draw. Wheels are described as in
    the draws.

    Parameters
    ----------
    problem : Problem
        What was fitted.
    mode : Point
        The mode as it was found.
    phi, sigma : ndarray
        Posterior draws, shapes (draw, p) and (draw, state).
    likelihood : ndarray
        Log-likelihood of each draw, shape (draw,).
    """
    height = float(log_posterior(problem, mode.phi, mode.sigma, mode.choice))
    if problem.library is None and not problem.layout.discrete.any():
        draws = log_posterior(problem, phi, sigma, log_likelihood=likelihood)
        best = int(np.argmax(draws))
        if draws[best] > height + _HIGHER:
            found = find_mode(problem, initial=phi[best], rounds=_CLIMB)
            if found.log_posterior > height:
                mode, height = Point(found.phi, found.sigma), found.log_posterior
    return _packed(problem, mode, height, phi)


def climbed_text(problem: Problem, begin: Point, phi: Array) -> str:
    """Text of the mode of other data, climbed to from a point; ``phi`` are draws, (draw, p)."""
    found = find_mode(problem, initial=begin.phi, rounds=_CLIMB)
    return _packed(problem, Point(found.phi, found.sigma), found.log_posterior, phi)


def _packed(problem: Problem, mode: Point, height: float, phi: Array) -> str:
    own = (
        mode.phi if problem.library is not None else beside(problem.layout, mode.phi[None], phi)[0]
    )
    sigma = mode.sigma.tolist()
    held: dict[str, Any] = {
        "parameters": dict(zip(problem.layout.labels, own.tolist(), strict=True)),
        "noise": dict(zip(problem.noise_labels, sigma, strict=False)),  # a scalar is repeated
        "log_posterior": height,
    }
    if problem.library is not None and mode.choice is not None:
        names = problem.library.names
        owners = problem.scene.owners
        held["sets"] = {
            owner: names[i] for owner, i in zip(owners, mode.choice.tolist(), strict=True)
        }
    return json.dumps(held)


def stored_mode(problem: Problem, idata: Any) -> Point | None:
    """The mode that a posterior holds; None where it holds none.

    Parameters
    ----------
    problem : Problem
        Of the posterior.
    idata : InferenceData or DataTree
        As made by :func:`pbrl_ppl.fit`, or loaded.

    Returns
    -------
    Point or None
        In the order of the problem's layout. A posterior that :func:`pbrl_ppl.update` resampled
        over joints of unknown bodies or a library has none, nor has a file of an older version.

    Raises
    ------
    PosteriorError
        If the mode lacks a parameter of the problem.
    """
    if MODE not in idata.attrs:
        return None
    held = json.loads(str(idata.attrs[MODE]))
    labels = problem.noise_labels
    missing = [label for label in problem.layout.labels if label not in held["parameters"]]
    missing += [label for label in labels if label not in held["noise"]]
    if missing:
        raise PosteriorError(f"posterior: its mode has no {', '.join(missing)}; fit it again")
    phi = np.array([held["parameters"][label] for label in problem.layout.labels], dtype=float)
    sigma = np.array([held["noise"][label] for label in labels])
    choice = None
    if problem.library is not None:
        names = [held["sets"][owner] for owner in problem.scene.owners]
        choice = np.array([problem.library.names.index(name) for name in names], dtype=np.intp)
    return Point(phi, np.broadcast_to(sigma, len(problem.noise_prior[0])).copy(), choice)
