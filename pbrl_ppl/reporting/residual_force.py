"""Residual forces against recorded quantities."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from pbrl_ppl.criticism import QUANTITIES, ComparedModel, Loop, recorded_quantities
from pbrl_ppl.state import STATE, Floats, acceleration_unit


def bin_means(x: Floats, y: Floats, most: int = 10, least: int = 8) -> pd.DataFrame:
    """Return the means of y in bins of x that hold about as many values each.

    There are at most ``most`` bins, each with at least about ``least`` values; equal values of x
    share a bin. Columns are ``centre``, the median of x, ``mean`` of y and its standard ``error``
    (NaN for a single value).
    """
    wanted = int(np.clip(len(x) // least, 1, most))
    edges = np.quantile(x, np.linspace(0, 1, wanted + 1)[1:-1])
    binned = pd.DataFrame({"x": x, "y": y}).groupby(np.searchsorted(edges, x))
    return binned.agg(centre=("x", "median"), mean=("y", "mean"), error=("y", "sem"))


class ResidualForce(NamedTuple):
    """Force, torque or acceleration of a body that the model lacks.

    Parameters
    ----------
    dimension : str
        The velocity that it changes.
    values : ndarray
        Of each transition, in ``unit``, shape (transition,).
    name, unit : str
        Name and unit of the values.
    """

    dimension: str
    values: Floats
    name: str
    unit: str


class Curve(NamedTuple):
    """A simple curve: its formula, its values at the sorted x, the share of variance explained."""

    form: str
    values: Floats
    share: float


class ForceLaw(NamedTuple):
    """Residual force of a body against a quantity that it depends on.

    Parameters
    ----------
    residual : ResidualForce
        The residual force.
    quantity, unit : str
        The quantity that it depends on.
    x : ndarray
        That quantity at each transition, shape (transition,).
    curve : Curve
        The simplest curve that follows the residual.
    """

    residual: ResidualForce
    quantity: str
    unit: str
    x: Floats
    curve: Curve


def find_laws(loop: Loop, most: int = 3, least: float = 0.02) -> list[ForceLaw]:
    """Return the residual force against the quantity that it depends on, then against others.

    The residual force is the process noise that each step adds to the smoothed states, over the
    time step, times the body's mass or moment of inertia at the mode.

    Of the others, those whose curve explains at least the share ``least`` of the residual.

    Empty where the test of dependence passed, or no body is named.
    """
    remains = loop.unexplained
    if remains is None or not remains.body or remains.depends_on not in QUANTITIES:
        return []
    problem = loop.revised.innovations.problem
    body = [moving.name for moving in problem.scene.moving].index(remains.body)
    residual = _residual_force(loop.revised, body, remains.dimension)
    if residual is None:
        return []
    laws = [
        ForceLaw(residual, quantity, unit, x, _simplest(x, residual.values))
        for (quantity, unit), x in zip(
            QUANTITIES.items(), recorded_quantities(problem, body).T, strict=True
        )
        if np.ptp(x) > 1e-9 * abs(x).max()
    ]
    laws.sort(key=lambda law: (law.quantity != remains.depends_on, -law.curve.share))
    return [laws[0], *(law for law in laws[1:most] if law.curve.share > least)]


def _residual_force(model: ComparedModel, body: int, dimension: str) -> ResidualForce | None:
    """Return the process noise of a body's velocity over the time step, times its inertia."""
    problem, phi = model.innovations.problem, model.innovations.phi
    coordinates = problem.likelihood.noise.coordinates
    added = coordinates.of_residual(problem.residual(phi)) / problem.scene.time_step
    places = zip(*np.divmod(coordinates.places, len(STATE)), strict=True)
    parts = {STATE[cell]: added[:, i] for i, (which, cell) in enumerate(places) if which == body}
    if {"vx", "vy"} <= set(parts):
        theta = problem.segments.start[:, body, 2]
        c, s = np.cos(theta), np.sin(theta)
        parts["forward speed"] = c * parts["vx"] + s * parts["vy"]
        parts["sideways speed"] = c * parts["vy"] - s * parts["vx"]
    dimension = {"x": "vx", "y": "vy", "theta": "omega"}.get(dimension, dimension)
    if dimension not in parts:
        return None
    values = parts[dimension]
    moving = problem.scene.moving[body]
    sizes = dict(zip(problem.layout.labels, phi.tolist(), strict=True))
    mass = dict(moving.known).get("mass", sizes.get(f"mass[{moving.owner}]"))
    if mass is None:
        unit = acceleration_unit(dimension)
        return ResidualForce(dimension, values, "residual acceleration", unit)
    if dimension == "omega":
        moment = float(mass) * moving.shape.unit_moment
        return ResidualForce(dimension, moment * values, "residual torque", "N m")
    return ResidualForce(dimension, float(mass) * values, "residual force", "N")


def _simplest(x: Floats, y: Floats) -> Curve:
    """Return the curve of a few that has the best information criterion (BIC)."""
    one, order = np.ones_like(x), np.argsort(x)
    forms = {
        "{0:.3g}": (one,),
        "{0:.3g} {1:+.3g} q": (one, x),
        "{0:.3g} {1:+.3g} sign(q)": (one, np.sign(x)),
        "{0:.3g} {1:+.3g} q |q|": (one, x * np.abs(x)),
        "{0:.3g} {1:+.3g} q²": (one, x**2),
        "{0:.3g} {1:+.3g} q {2:+.3g} q |q|": (one, x, x * np.abs(x)),
    }
    total = max(float(((y - y.mean()) ** 2).sum()), 1e-300)
    curves = []
    for form, terms in forms.items():
        columns = np.stack(terms, axis=1)
        largest = np.maximum(abs(columns).max(axis=0), np.finfo(float).tiny)
        sizes, _, rank, _ = np.linalg.lstsq(columns / largest, y, rcond=None)
        if rank < len(terms):
            continue
        sizes = sizes / largest
        rest = max(float(((y - columns @ sizes) ** 2).sum()), 1e-300)
        bic = len(y) * np.log(rest) + len(terms) * np.log(len(y))
        text = form.format(*sizes).replace("-", "−").replace(" +", " + ").replace(" −", " − ")
        curves.append((bic, Curve(text, (columns @ sizes)[order], 1.0 - rest / total)))
    return min(curves, key=lambda one: one[0])[1]
