"""Simple alternatives to the loop: regressions of the residual force on recorded quantities."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from pbrl_ppl.modes import Mode

Array = NDArray[np.float64]
#: Terms of an equation, shape (n,) each, by the effect that each stands for and its own name.
Terms = dict[tuple[str, str], Array]

#: Coefficients below this share of the residual are dropped, and the ridge, as pysindy has them.
_THRESHOLD, _RIDGE = 0.1, 0.05
#: Velocities among the state dimensions, and their names as equations.
_EQUATIONS = {3: "x", 4: "y", 5: "turn"}


def ask_baselines(declared: Mode) -> dict[str, str | None]:
    """Return the effect that each method names; None if it finds none or is not installed.

    Parameters
    ----------
    declared : Mode
        Of the declared model, of single transitions.

    Returns
    -------
    dict of str to str
        ``correlation``: the term with the largest correlation with the residual acceleration.
        ``sparse_regression``: the effect whose terms explain most of it after sequentially
        thresholded least squares (Brunton, Proctor and Kutz, 2016), by pysindy.
    """
    left, named = _equations(declared)
    return {way: name(left, named) for way, name in WAYS.items()}


def _equations(mode: Mode) -> tuple[dict[str, Array], dict[str, Terms]]:
    """Return residual accelerations and terms of each equation, shape (n,) each."""
    problem = mode.problem
    residual = problem.residual(mode.phi)[:, 0, 0] / problem.scene.time_step
    start = problem.segments.start[:, 0]
    inputs = problem.segments.inputs[:, 0, 0]
    wrench, before = inputs[:, :3], inputs[:, 3:6]
    columns = [int(d) for d in problem.observations.columns]
    seen = np.isfinite(residual).all(axis=-1)
    terms = _terms(start[seen], wrench[seen], before[seen])
    left = {
        equation: residual[seen][:, columns.index(d)]
        for d, equation in _EQUATIONS.items()
        if d in columns
    }
    return left, {equation: terms[equation] for equation in left}


def _terms(state: Array, wrench: Array, before: Array) -> dict[str, Terms]:
    """Return a library of all laws that are linear in a coefficient."""
    x, y, theta, vx, vy, omega = state.T
    force_x, force_y, torque = wrench.T
    speed, one = np.hypot(vx, vy), np.ones(len(state))
    c, s = np.cos(theta), np.sin(theta)
    pushed = np.hypot(force_x, force_y)
    some = np.median(pushed[pushed > 0]) if (pushed > 0).any() else 1.0
    weak, capped = pushed < some, np.maximum(0.0, 1.0 - some / np.maximum(pushed, 1e-300))

    def along(
        axis: str, place: Array, v: Array, across: Array, push: Array, aside: Array, held: Array
    ) -> Terms:
        return {
            ("linear_drag", f"v{axis}"): v,
            ("quadratic_drag", f"|v| v{axis}"): speed * v,
            ("sliding_friction", f"v{axis} / |v|"): v / np.maximum(speed, 1e-9),
            ("constant_force", "1"): one,
            ("body_force", "cos"): c,
            ("body_force", "sin"): s,
            ("spring", axis): place,
            ("magnus_force", "omega times v across"): omega * across,
            ("actuator_rotation", "force across"): aside,
            ("force_gain", f"force_{axis}"): push,
            ("actuator_delay", f"change of force_{axis}"): held - push,
            ("force_cutoff", f"weak force_{axis}"): weak * push,
            ("dead_zone", f"force_{axis}, at most some"): (1.0 - capped) * push,
            ("saturation", f"strong force_{axis}"): capped * push,
        }

    library = {
        "x": along("x", x, vx, vy, force_x, force_y, before[:, 0]),
        "y": along("y", y, vy, vx, force_y, force_x, before[:, 1]),
        "turn": {
            ("angular_drag", "omega"): omega,
            ("pivot_friction", "sign of omega"): np.sign(omega),
            ("quadratic_drag", "|omega| omega"): np.abs(omega) * omega,
            ("constant_torque", "1"): one,
            ("torsion_spring", "theta"): theta,
            ("gravity_tilt", "cos"): c,
            ("push_offset", "force across"): c * force_y - s * force_x,
            ("push_offset", "force along"): c * force_x + s * force_y,
            ("torque_gain", "torque"): torque,
            ("actuator_delay", "change of torque"): before[:, 2] - torque,
        },
    }
    return {
        equation: {name: own for name, own in terms.items() if own.any()}
        for equation, terms in library.items()
    }


def _largest(left: dict[str, Array], named: dict[str, Terms]) -> str | None:
    """Return the effect of the term with the largest correlation with the residual."""
    found = [
        (abs(float(np.corrcoef(own, left[equation])[0, 1])), effect)
        for equation, terms in named.items()
        for (effect, _), own in terms.items()
        if own.std() > 0 and left[equation].std() > 0
    ]
    return max(found)[1] if found else None


def _sparse(left: dict[str, Array], named: dict[str, Terms]) -> str | None:
    """Return the effect whose terms explain most of the squared residual, by pysindy."""
    try:
        from pysindy.optimizers import STLSQ
    except ImportError:  # extra `bench`
        return None
    share: dict[str, float] = {}
    for equation, terms in named.items():
        sizes = {name: float(np.sqrt((own**2).mean())) for name, own in terms.items()}
        matrix = np.column_stack([own / sizes[name] for name, own in terms.items()])
        unit = float(np.sqrt((left[equation] ** 2).mean()))
        if not unit:
            continue
        with warnings.catch_warnings():  # that nothing is left is an answer
            warnings.simplefilter("ignore")
            kept = STLSQ(threshold=_THRESHOLD, alpha=_RIDGE).fit(matrix, left[equation] / unit)
        for (effect, _), coefficient in zip(terms, kept.coef_.ravel(), strict=True):
            share[effect] = share.get(effect, 0.0) + float(coefficient**2)
    share = {effect: value for effect, value in share.items() if value > 0}
    return max(share, key=lambda effect: share[effect]) if share else None


#: What names an effect from residual accelerations and terms, by equation.
WAYS = {"correlation": _largest, "sparse_regression": _sparse}
