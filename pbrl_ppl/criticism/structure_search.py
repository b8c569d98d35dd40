"""Mode of a model with a structure that bodies collide with, found without derivatives."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from pbrl_ppl.effects import Attached
from pbrl_ppl.likelihood import Problem
from pbrl_ppl.modes import Mode, nearby_mode, trajectory_mode
from pbrl_ppl.parameters import inside
from pbrl_ppl.state import Floats

#: A body stops within a step of where it touches: with fewer of them places come out far off.
_SUBSTEPS = 40
#: Degrees of freedom of the loss: a transition that a guess does not explain pulls little.
_NU = 4.0
#: Process noise as a share of its prior's median: more than the engine's error at contact.
_ADDED = 0.3
#: Guesses that are improved, runs of the engine for each, and how far the first ones go (prior sd).
_GUESSES, _RUNS, _SIDE = 6, 200, 0.05
#: The simplex at which a search ends, as a share of the first one.
_CLOSE = 4e-3
#: Places with losses that differ by less are the same.
_SAME = 1.0
#: Places from which the other parameters and the noise are fitted, and rounds after the first.
_PLACES, _ROUNDS = 4, 3
#: A round that gains less is the last.
_BETTER = 2.0


def structure_mode(mode: Mode, candidate: Attached, estimate: Floats) -> Mode:
    """Fit a model with a structure that bodies collide with.

    Derivatives across a collision mislead an optimiser, and the noise that fits without the
    structure hides which collisions a place explains. So guesses of the place are improved first,
    by Nelder and Mead's simplex under Student's loss with little noise; the best are fitted with
    all parameters, place and fit in turn.

    Parameters
    ----------
    mode : Mode
        Of the model that lacks the structure, fitted to whole trajectories.
    candidate : Attached
        The effect; its scan makes the guesses.
    estimate : ndarray
        A further guess, shape (q,).

    Returns
    -------
    Mode
        With at least 40 substeps an interval.
    """
    physics = mode.problem.physics
    substeps = max(_SUBSTEPS, physics.substeps)
    # where bodies touch, extrapolation gains nothing
    problem = mode.problem.with_physics(
        effects=(*physics.effects, candidate), substeps=_SUBSTEPS, extrapolate=False
    )
    layout = problem.layout
    phi = layout.from_layout(mode.problem.layout, mode.phi)
    own = [layout.labels.index(label) for label in candidate.labels]
    guesses = estimate[None]
    if candidate.effect.scan is not None:
        body = problem.scene.body(candidate.body)
        looks = candidate.effect.scan(problem.scene, problem.data.history, body)
        guesses = np.vstack([guesses, looks[np.isfinite(looks).all(axis=1)]])

    def fitted(problem: Problem, phi: Floats, place: Floats, sigma: Floats) -> Mode:
        start = phi.copy()
        start[own] = place
        return trajectory_mode(problem, inside(layout.priors, start), sigma)

    places = _places(problem, phi, problem.quiet(mode.sigma, _ADDED), own, guesses)[:_PLACES]
    fits = [fitted(problem, phi, place, mode.sigma) for place in places]
    best = max(fits, key=lambda found: found.log_posterior)
    for _ in range(_ROUNDS):
        quiet = best.problem.quiet(best.sigma, _ADDED)
        place, *_ = _places(best.problem, best.phi, quiet, own, best.phi[own][None])
        again = fitted(best.problem, best.phi, place, best.sigma)
        if again.log_posterior < best.log_posterior + _BETTER:
            break
        best = again
    exact = best.problem.with_physics(substeps=substeps, extrapolate=physics.extrapolate)
    return nearby_mode(exact, best.phi, best.sigma)


def _places(
    problem: Problem, phi: Floats, sigma: Floats, own: list[int], guesses: Floats
) -> list[Floats]:
    """Improve guesses of some parameters, the others held; return distinct ones, best first."""
    lower, upper = (bound[own] for bound in problem.layout.bounds)

    def loss(values: Floats) -> float:
        if np.any(values <= lower) or np.any(values >= upper):
            return np.inf
        here = phi.copy()
        here[own] = values
        whitened = np.nan_to_num(problem.whitened(here, sigma)).reshape(problem.segments.n, -1)
        square = (whitened**2).sum(axis=1)
        return float(0.5 * (_NU + whitened.shape[1]) * np.log1p(square / _NU).sum())

    losses = [loss(guess) for guess in guesses]
    side = _SIDE * min(problem.layout.priors[place].scale for place in own)
    found: list[tuple[float, Floats]] = []
    for i in np.argsort(losses)[:_GUESSES]:
        best = minimize(
            lambda values: loss(side * values),
            guesses[i] / side,
            method="Nelder-Mead",
            options={
                "maxfev": _RUNS,
                "initial_simplex": guesses[i] / side + np.eye(len(own) + 1, len(own), -1),
                "xatol": _CLOSE,
                "fatol": 0.1,
            },
        )
        if all(abs(best.fun - value) > _SAME for value, _ in found):
            found.append((float(best.fun), side * best.x))
    return [place for _, place in sorted(found, key=lambda entry: entry[0])]
